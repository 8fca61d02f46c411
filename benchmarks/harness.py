"""Command line, clocks and tables that the benchmarks share."""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from worldline_core.data.episodes.episode import CameraTrack, Episode
from worldline_core.shipped import shipped_folder

RECORDINGS = shipped_folder() / "recordings"


def command_line(description: str | None) -> argparse.ArgumentParser:
    """Parser whose help is the module's docstring as it is written."""
    return argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)


def cpu_seconds() -> float:
    """Processor time of this process and of its children that ended."""
    return sum(os.times()[:4])


def timed[T](work: Callable[[], T]) -> tuple[T, float, float]:
    """Result, wall seconds and processor seconds of one call."""
    wall, processor = time.perf_counter(), cpu_seconds()
    result = work()
    return result, time.perf_counter() - wall, cpu_seconds() - processor


def seconds_of(call: Callable[[], object]) -> float:
    """Median time of one call, on a GPU until it has finished."""
    from torch.utils.benchmark import Timer

    return Timer("call()", globals={"call": call}).blocked_autorange(min_run_time=1).median


def read_recordings(
    facts_file: Path, pictures: str, robot: str, fps: float, **facts: Any
) -> list[tuple[Episode, dict[str, np.ndarray]]]:
    """(episode with the true cameras, pictures by view) of each recording of a drawn set.

    Args:
        pictures: name of their arrays: (n, h, w) or (n, h, w, 3) uint8.
    """
    written = json.loads(facts_file.read_text())
    found: list[tuple[Episode, dict[str, np.ndarray]]] = []
    with np.load(facts_file.with_suffix(".npz"), allow_pickle=False) as arrays:
        for number in range(written["episodes"]):
            shown = {view: arrays[f"{number}/{pictures}/{view}"] for view in written["views"]}
            cameras = {
                view: CameraTrack(view, arrays[f"{number}/K/{view}"], arrays[f"{number}/T/{view}"], *each.shape[2:0:-1])
                for view, each in shown.items()
            }
            state = arrays[f"{number}/state"]
            action = arrays.get(f"{number}/action", state)
            episode = Episode(
                episode_id=f"{facts_file.stem}-{number:02d}", source=facts_file.stem, embodiment=robot, scene="drawn",
                task_family="unknown", instruction="move", outcome="success", split="test", fps=fps, state=state,
                action=action, timestamps=np.arange(len(state)) / fps, cameras=cameras, T_base_ee=None, gripper=None,
                state_kind="joints", **facts,
            )  # fmt: skip
            found.append((episode, shown))
    return found


def print_table(columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Prints a Markdown table, each row as soon as it is known; floats with three digits."""
    print(f"\n| {' | '.join(columns)} |\n|{'---|' * len(columns)}")
    for row in rows:
        cells = (f"{cell:,.3g}" if isinstance(cell, float) and abs(cell) < 1000 else
                 f"{cell:,.0f}" if isinstance(cell, int | float) and not isinstance(cell, bool) else str(cell)
                 for cell in row)  # fmt: skip
        print(f"| {' | '.join(cells)} |", flush=True)
