"""Metrics that are measured where ``evaluate_video.metrics`` names them: paths of the tools, and still scenes.

HSD, nDTW and DYN follow EWMBench (arXiv 2505.09694): reciprocals of distances, in hundredths of the frame's height, of the arms that
move. Tools cannot be found more precisely than about one hundredth, so places are no nearer than that, and a perfect path scores 1
instead of infinity. docs/evaluation.md states the formulas and the differences.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from einops import reduce
from scipy.spatial.distance import cdist, directed_hausdorff
from scipy.stats import wasserstein_distance

from worldline_core.evaluation.metrics import SSIM_WINDOW, frames_to_unit, ssim_map

OUTLINE_FRACTION = 0.1  # half side of the outline, of the frame's height
STEP_FRACTION = 0.1  # farthest way of a tool from one frame to the next, of the frame's height
RESOLUTION = 1.0  # smallest distance that can be measured, hundredths of the height
LEAST_PATH = 5.0  # diagonal of the box around the path of an arm that moves, hundredths of the height
LEAST_FOUND = 0.2  # share of the true path's frames in which a tool must be found (EWMBench's)
LEAST_MOTION = 0.1  # mean speed and acceleration of a tool that rests, hundredths of the height a frame
MIN_DIFFERENCE = 3.0  # difference of two controls that the videos can show, hundredths of the height
_NEARER = 1e-3  # of equal places the nearer one: a hundredth of a pixel's difference at ten pixels' distance
STILL_LEVELS = 10  # a pixel of the recording within so many grey levels of its first frame has not moved
LEAST_STILL_SHARE = 0.05  # of the frame


class ToolFinder:
    """Finds the tools in one predicted video, whose frames come in pieces.

    The true mask shows the gripper's outline around the projected tool; the place in the predicted mask where this outline differs in
    the fewest pixels is where the tool is found. The search begins at the first frame, which both videos share, and continues from the
    place of the frame before, at most STEP_FRACTION of the height further: later controls play no part. How far this can be trusted is
    measured with exact masks (docs/evaluation.md).
    """

    def __init__(self) -> None:
        self._last: np.ndarray | None = None

    def find(self, true: np.ndarray, predicted: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Places (n, arms, 2) u, v [px] in the next frames; NaN where the true place is unknown or no robot is there.

        Args:
            true, predicted: bool (n, h, w), masks of the same frames.
            points: (n, arms, 2) true places [px], NaN where unknown.
        """
        found = np.full(points.shape, np.nan)
        if self._last is None:
            self._last = np.full(points.shape[1:], np.nan)
        for frame, arm in np.argwhere(np.isfinite(points).all(axis=-1)):
            start = self._last[arm] if np.isfinite(self._last[arm]).all() else points[frame, arm]
            place = _fit(true[frame], predicted[frame], points[frame, arm], start)
            if place is not None:
                found[frame, arm] = self._last[arm] = place
        return found


def _fit(true: np.ndarray, predicted: np.ndarray, point: np.ndarray, start: np.ndarray) -> np.ndarray | None:
    """Place u, v [px] in ``predicted`` near ``start`` where the outline around ``point`` in ``true`` fits best."""
    height = len(true)
    half, step = (max(2, round(fraction * height)) for fraction in (OUTLINE_FRACTION, STEP_FRACTION))
    (u, v), (x, y) = np.rint(point).astype(int), np.rint(start).astype(int)
    outline = _around(true, u, v, half)
    if not outline.any():
        return None
    region = _around(predicted, x, y, half + step)
    differing = cv2.matchTemplate(region, outline, cv2.TM_SQDIFF)
    offsets = np.arange(-step, step + 1)
    differing += _NEARER * (offsets[:, None] ** 2 + offsets[None] ** 2)
    row, column = np.unravel_index(int(np.argmin(differing)), differing.shape)
    # What rounding took from the true place belongs to the found one, too.
    return np.array([x + offsets[column], y + offsets[row]]) + point - np.rint(point)


def _around(mask: np.ndarray, u: int, v: int, half: int) -> np.ndarray:
    """uint8 (2 half + 1, 2 half + 1) of a mask around a pixel; zeros outside of the frame. OpenCV takes 20 times as long for float32."""
    height, width = mask.shape
    cut = np.zeros((2 * half + 1, 2 * half + 1), dtype=np.uint8)
    rows, columns = (slice(max(0, c - half), max(0, min(size, c + half + 1))) for c, size in ((v, height), (u, width)))
    top, left = rows.start - (v - half), columns.start - (u - half)
    part = mask[rows, columns]
    cut[top : top + part.shape[0], left : left + part.shape[1]] = part
    return cut


def hausdorff_score(true: np.ndarray, found: np.ndarray) -> float | None:
    """HSD: 1 / max(h(A, B), h(B, A)), h the directed Hausdorff distance of two paths' points."""

    def distance(a: np.ndarray, b: np.ndarray) -> float:
        return max(directed_hausdorff(a, b)[0], directed_hausdorff(b, a)[0])

    return _over_arms(true, found, distance)


def time_warping_score(true: np.ndarray, found: np.ndarray) -> float | None:
    """nDTW: 1 / (D / n), D the least sum of distances over all monotone alignments, n the steps of the true path."""
    return _over_arms(true, found, lambda a, b: time_warping_distance(a, b) / len(a))


def dynamics_score(true: np.ndarray, found: np.ndarray) -> float | None:
    """DYN: 1 / (1 + (W(v) / mean(v) + W(a) / mean(a)) / 2), W the Wasserstein-1 distance of the true and the found
    distribution of speed v and of acceleration a, the means those of the true path."""

    def distance(a: np.ndarray, b: np.ndarray) -> float:
        total = 0.0
        for order in (1, 2):
            own, other = (np.linalg.norm(np.diff(path, n=order, axis=0), axis=-1) for path in (a, b))
            total += wasserstein_distance(own, other) / max(float(own.mean()), LEAST_MOTION)
        return 1.0 + total / 2

    return _over_arms(true, found, distance, least=3)


def time_warping_distance(first: np.ndarray, second: np.ndarray) -> float:
    """Dynamic time warping (Sakoe and Chiba 1978, steps (1, 0), (0, 1), (1, 1)) of paths (n, 2) and (m, 2)."""
    cost = cdist(first, second)
    total = np.full((len(first) + 1, len(second) + 1), np.inf)
    total[0, 0] = 0.0
    for i, j in np.ndindex(cost.shape):
        total[i + 1, j + 1] = cost[i, j] + min(total[i, j], total[i, j + 1], total[i + 1, j])
    return float(total[-1, -1])


def _over_arms(
    true: np.ndarray, found: np.ndarray, distance: Callable[[np.ndarray, np.ndarray], float], least: int = 1
) -> float | None:
    """Mean over the arms that move of 1 / distance of the true and the found path; None where no arm moves.

    An arm that is hardly found, or in fewer than ``least`` frames, scores 0.
    """
    scores = []
    for arm in range(true.shape[1]):
        known = np.isfinite(true[:, arm]).all(axis=-1)
        path = true[known, arm]
        if len(path) < least or np.linalg.norm(np.ptp(path, axis=0)) < LEAST_PATH:
            continue
        seen = known & np.isfinite(found[:, arm]).all(axis=-1)
        hardly = seen.sum() < max(least, LEAST_FOUND * len(path))
        scores.append(0.0 if hardly else 1.0 / max(distance(path, found[seen, arm]), RESOLUTION))
    return sum(scores) / len(scores) if scores else None


@dataclass(frozen=True)
class ControlledPair:
    """Two predictions of one start by one model, under the true and under changed controls.

    Attributes (all (n, arms, 2), hundredths of the frame's height, NaN where unknown):
        true: where the true controls put the tools.
        found, found_changed: where they are in the two predictions.
        changed: where the changed controls put them; None where that is not known.
    """

    true: np.ndarray
    found: np.ndarray
    found_changed: np.ndarray
    changed: np.ndarray | None


def action_following(pair: ControlledPair) -> float | None:
    """d' / (d + d'), d and d' the mean distances of the tools found under the true and the changed controls from where
    the true controls put them; 0.5 where both are below the resolution."""
    distances = np.linalg.norm(np.stack([pair.found, pair.found_changed]) - pair.true, axis=-1)
    seen = np.isfinite(distances).all(axis=0)
    if not seen.any():
        return None
    own, changed = (max(float(values[seen].mean()), RESOLUTION) for values in distances)
    return changed / (own + changed)


def counterfactual_direction(pair: ControlledPair) -> float | None:
    """Share of frames and arms in which found - found' and true - changed make an angle below 90 degrees.

    Only where the controls put a tool MIN_DIFFERENCE apart; a difference of the videos of zero points nowhere: it
    counts half.
    """
    if pair.changed is None:
        return None
    wanted, shown = pair.true - pair.changed, pair.found - pair.found_changed
    apart = np.isfinite(shown).all(axis=-1) & (np.linalg.norm(np.nan_to_num(wanted), axis=-1) >= MIN_DIFFERENCE)
    if not apart.any():
        return None
    agreement = np.sign((wanted[apart] * shown[apart]).sum(axis=-1))
    return float((agreement.mean() + 1) / 2)


@dataclass(frozen=True)
class SceneFrames:
    """Some frames of a recorded and a predicted head view.

    Attributes:
        true, predicted: uint8 (n, h, w, 3).
        true_first, predicted_first: the videos' first frames (h, w, 3).
        robots: bool (n, h, w), where a robot is in the true or the predicted frame, or was in the first one.
    """

    true: np.ndarray
    predicted: np.ndarray
    true_first: np.ndarray
    predicted_first: np.ndarray
    robots: np.ndarray


def scene_consistency(frames: SceneFrames) -> list[float | None]:
    """SSIM of each predicted frame with the prediction's first one, over the positions of the window in which the
    recording stays as it was in its first frame and no robot is; None where hardly any place is still."""
    change = np.abs(frames.true.astype(np.int16) - frames.true_first).max(axis=-1)
    moving = ((change > STILL_LEVELS) | frames.robots).astype(np.uint8)
    kernel = np.ones((SSIM_WINDOW, SSIM_WINDOW), dtype=np.uint8)
    inner = SSIM_WINDOW // 2
    still = np.stack([cv2.dilate(mask, kernel) == 0 for mask in moving])[:, inner:-inner, inner:-inner]
    now = frames_to_unit(torch.from_numpy(np.ascontiguousarray(frames.predicted)))
    first = frames_to_unit(torch.from_numpy(frames.predicted_first[None].copy())).expand_as(now)
    likeness = reduce(ssim_map(now, first), "n c h w -> n h w", "mean").numpy()
    return [
        float(values[places].mean()) if places.mean() >= LEAST_STILL_SHARE else None
        for values, places in zip(likeness, still, strict=True)
    ]
