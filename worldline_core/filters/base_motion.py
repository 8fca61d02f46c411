"""Base motion: nearly the whole picture of a camera changes because the chassis drives, not because the arms move.

Arms, however large, sweep over a part of the picture within half a second; a driving base moves all of it. Of several
measurements tried on labelled clips (flow across edges, dense flow with a robust fit of one global motion, the changed
area), the changed area alone keeps the two apart where the arms carry most of the texture: see docs/filters.md.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from worldline_core.filters.filter_config import BaseMotionConfig, FilterConfig
from worldline_core.filters.pictures import PICTURE_FAULTS
from worldline_core.filters.signals import Signals
from worldline_core.filters.verdict import Curve, Finding, Verdict, bad_frames, long_runs

_CELL = 8
_CELL_SHARE = 0.1
"""A cell has changed when this share of its pixels has."""
_SAMPLE_S = 0.12


def changed_area(gray: np.ndarray, usable: np.ndarray, fps: float, config: BaseMotionConfig) -> np.ndarray:
    """(n,) share of cells that differ between half a lag before a frame and half a lag after it; 0 where unknown.

    A change of exposure is divided out where that explains more.

    Args:
        gray: uint8 (n, h, w).
        usable: bool (n,) frames whose pictures are in order.
    """
    count, height, width = gray.shape
    area = np.zeros(count)
    lag = max(1, round(config.lag_s * fps))
    if count <= lag:
        return area
    cells = (max(1, width // _CELL), max(1, height // _CELL))
    every = max(1, round(_SAMPLE_S * fps))
    medians = np.median(gray[:, ::2, ::2].reshape(count, -1), axis=1) + 1.0
    sampled = np.arange(0, count, every)
    for i in sampled:
        before = min(max(0, i - lag // 2), count - 1 - lag)
        after = before + lag
        if not (usable[before] and usable[after]):
            continue
        found = _share(gray[before], gray[after], cells, config.min_level_change)
        gain = float(medians[after] / medians[before])
        if found > 0 and abs(gain - 1) > 0.03:
            lit = cv2.convertScaleAbs(gray[before], alpha=gain)
            found = min(found, _share(lit, gray[after], cells, config.min_level_change))
        area[i] = found
    return area[sampled[np.searchsorted(sampled, np.arange(count), side="right") - 1]]


def _share(a: np.ndarray, b: np.ndarray, cells: tuple[int, int], min_level_change: float) -> float:
    _, changed = cv2.threshold(cv2.absdiff(a, b), min_level_change, 255, cv2.THRESH_BINARY)
    share = cv2.resize(changed, cells, interpolation=cv2.INTER_AREA)
    return float((share > 255 * _CELL_SHARE).mean())


def detect_base_motion(area: np.ndarray, fps: float, config: BaseMotionConfig) -> Verdict:
    """Stretches in which the whole picture moves.

    Args:
        area: (n,) from `changed_area` of a camera that stands still in the base frame.
    """
    bad = long_runs(area > config.min_changed_area, config.min_run_s * fps, gap=0.25 * fps)
    share = float(bad.mean())
    return Verdict(
        "base_motion",
        share <= config.max_moving_share,
        {
            "moving_share": share,
            "median_changed_area": float(np.median(area)),
            "max_changed_area": float(area.max()),
            "threshold_changed_area": config.min_changed_area,
            "threshold_share": config.max_moving_share,
        },
        bad,
        {"changed_area": Curve(area, config.min_changed_area)},
    )


def find_base_motion(signals: Signals, config: FilterConfig, found: Sequence[Finding]) -> list[Finding]:
    """In the primary view, unless its camera is known to move."""
    view = signals.primary_view
    camera = signals.episode.cameras.get(view)
    if camera is not None and camera.moving:
        return []
    unusable = bad_frames(found, len(signals.gray[view]), *PICTURE_FAULTS, view=view)
    area = changed_area(signals.gray[view], ~unusable, signals.episode.fps, config.base_motion)
    verdict = detect_base_motion(area, signals.episode.fps, config.base_motion)
    return [Finding("base_motion", view, 1, verdict)]
