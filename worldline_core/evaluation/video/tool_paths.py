"""Where the tools of a predicted robot are, and how their paths fit the true ones.

**Finding.** A segmenter masks the robot in the true and in the predicted head view, independently of each other. The true
place of a tool is the projection of the controls. Around it, the true mask shows the gripper's outline in its pose of that
moment; the place in the predicted mask where this outline differs in the fewest pixels is where the tool is found. The search
begins at the first frame, which both videos share, and goes on from where the tool was found in the frame before, at most
STEP_FRACTION of the frame's height further: where the controls lead after the first frame plays no part. Where nothing fits
better, a tool stays where it was.

How far that can be trusted is measured where the truth is known (docs/evaluation.md): with the exact masks of two recordings
of one start under different controls, one taken for the prediction of the other, or of a recording and its delayed self.

**Measures.** Places are in hundredths of the frame's height, so that videos of any size compare. HSD, nDTW and DYN follow
EWMBench (arXiv 2505.09694): reciprocals of distances. The finding cannot tell distances below about one hundredth of the
height apart, so places are no nearer than that, and a perfect path scores 1 instead of infinity. The two terms of DYN are
relative to the true path's own motion instead of weighted by constants of a data set. Each is the mean over the arms that
are seen.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.distance import cdist, directed_hausdorff
from scipy.stats import wasserstein_distance

OUTLINE_FRACTION = 0.1  # half side of the outline, of the frame's height
STEP_FRACTION = 0.1  # farthest that a tool goes from one frame to the next, of the frame's height
RESOLUTION = 1.0  # smallest distance that is told from none, hundredths of the height
LEAST_MOTION = 0.1  # mean speed and acceleration of a tool that stands still, hundredths of the height a frame
MIN_DIFFERENCE = 3.0  # difference of two controls that the videos can show, hundredths of the height
_NEARER = 1e-3  # of equal places the nearer one: a hundredth of a pixel's difference at ten pixels' distance


class ToolFinder:
    """Finds the tools in one predicted video, whose frames come in pieces."""

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
    """Where in ``predicted`` the outline around ``point`` in ``true`` fits best near ``start``; u, v [px]."""
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
    """float32 (2 half + 1, 2 half + 1) of a mask around a pixel; zeros outside of the frame."""
    height, width = mask.shape
    cut = np.zeros((2 * half + 1, 2 * half + 1), dtype=np.float32)
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
    """Mean over arms of 1 / distance of their paths; None where no arm is found in ``least`` frames."""
    scores = []
    for arm in range(true.shape[1]):
        seen = np.isfinite(true[:, arm]).all(axis=-1) & np.isfinite(found[:, arm]).all(axis=-1)
        if seen.sum() >= least:
            scores.append(1.0 / max(distance(true[seen, arm], found[seen, arm]), RESOLUTION))
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
