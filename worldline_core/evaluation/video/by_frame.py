"""Metrics against time: means over trajectories of every frame, to see drift along a rollout."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path

import pyarrow as pa

from worldline_core.evaluation.scores import write_table

BY_FRAME_SCHEMA = pa.schema(
    [
        ("method", pa.string()),
        ("split", pa.string()),
        ("view", pa.string()),
        ("metric", pa.string()),
        ("frame", pa.int32()),
        ("mean", pa.float64()),
        ("count", pa.int32()),
    ]
)


def write_by_frame(path: Path, videos: Iterable[tuple[str, str, str, str, Sequence[float | None]]]) -> None:
    """Average per-frame values over videos.

    Args:
        videos: (method, split, view, metric, value of each frame; None where a frame is left out).
    """
    cells: dict[tuple[str, str, str, str, int], list[float]] = defaultdict(list)
    for method, split, view, metric, frames in videos:
        for frame, value in enumerate(frames):
            if value is not None:
                cells[method, split, view, metric, frame].append(value)
    rows = [
        {
            "method": method,
            "split": split,
            "view": view,
            "metric": metric,
            "frame": frame,
            "mean": sum(values) / len(values),
            "count": len(values),
        }
        for (method, split, view, metric, frame), values in sorted(cells.items())
    ]
    write_table(path, rows, BY_FRAME_SCHEMA)
