"""The classical segmenter: colour models of robot and background, started from projected points, and GrabCut.

Independent of anything learned. What is unlike the table around the projected tool centres of the first frame says what
the robot looks like; GrabCut (Rother et al. 2004) grows from there. Later frames start from the mask of the frame before, with the
colour models of the first frame, so the points are used once only.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

SEED_FRACTION = 0.10  # the robot is surely within this distance of a point, of the frame height
TABLE_DISTANCE = 28.0  # from the frame's median colour, in 8-bit Lab units: farther is no table
REACH_FRACTION = 1.0  # the robot is looked for within this distance of a point, of the frame height
CARRY_FRACTION = 0.12  # how far the robot may move between two frames, of the frame height
_BINS = 12


class ColourSegmenter:
    """GrabCut from points in the first frame, carried from frame to frame."""

    name = "colour"
    follows = True
    description = "colour models and GrabCut, started from the projected tool centres of the first frame"

    def __init__(self, iterations: int = 3) -> None:
        self.iterations = iterations

    def segment(self, video: np.ndarray, points: np.ndarray | None) -> np.ndarray:
        """Bool masks (n, h, w) of uint8 frames (n, h, w, 3).

        Without a valid point in the first frame nothing can be started: all masks are empty.
        """
        return self.stream()(video, points)

    def stream(self) -> Callable[[np.ndarray, np.ndarray | None], np.ndarray]:
        """Masks of a video that comes piece by piece; the points of its first frame alone are used."""
        following: _Following | None = None

        def masks_of(video: np.ndarray, points: np.ndarray | None) -> np.ndarray:
            nonlocal following
            if len(video) == 0:
                return np.zeros(video.shape[:3], dtype=bool)
            if following is None:
                following = _Following(self.iterations, video[0], points)
            return np.stack([following.mask(frame) for frame in video])

        return masks_of


class _Following:
    """One video: colour models of its first frame, and the mask of the frame before."""

    def __init__(self, iterations: int, first: np.ndarray, points: np.ndarray | None) -> None:
        self._iterations = iterations
        self._previous: np.ndarray | None = None
        self._foreground, self._background = np.zeros((1, 65)), np.zeros((1, 65))
        start = np.zeros((0, 2)) if points is None else points[0][np.isfinite(points[0]).all(axis=-1)]
        height, width = first.shape[:2]
        self._start = start[(start >= 0).all(axis=-1) & (start[:, 0] < width) & (start[:, 1] < height)]
        self._colours = np.zeros(0)

    def mask(self, frame: np.ndarray) -> np.ndarray:
        """Bool (h, w) of the next frame."""
        mask = np.zeros(frame.shape[:2], dtype=bool)
        if len(self._start) == 0:
            return mask
        lab, begins = cv2.cvtColor(frame, cv2.COLOR_RGB2LAB), self._previous is None
        if self._previous is None:
            cv2.setRNGSeed(0)  # GrabCut starts its colour models by k-means
            labels = self._first_labels(lab, self._start)
            self._colours = colour_ratio(lab, np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD)))
        else:
            labels = self._carried_labels(self._previous, robot_likely(lab, self._colours))
        if np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD)).any() and np.isin(labels, (cv2.GC_BGD, cv2.GC_PR_BGD)).any():
            mode = cv2.GC_INIT_WITH_MASK if begins else cv2.GC_EVAL_FREEZE_MODEL
            rounds = self._iterations if begins else 1
            picture = np.ascontiguousarray(frame[..., ::-1])
            cv2.grabCut(picture, labels, (0, 0, 0, 0), self._background, self._foreground, rounds, mode)
            mask = (labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)
            if begins:
                self._colours = colour_ratio(lab, mask)
        self._previous = mask
        return mask

    def _first_labels(self, lab: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Sure robot: what is unlike the table near the points. Likely robot: what hangs together with it.

        A tool centre lies between the fingers, so the pixel at the point itself often shows the table.
        """
        height, width = lab.shape[:2]
        rows, columns = np.mgrid[:height, :width]
        distance = np.min([np.hypot(columns - u, rows - v) for u, v in points], axis=0)
        table = np.median(lab.reshape(-1, 3), axis=0)
        unlike = np.linalg.norm(lab.astype(np.float64) - table, axis=-1) > TABLE_DISTANCE
        seeds = unlike & (distance <= SEED_FRACTION * height)
        if not seeds.any():
            seeds = distance <= max(1.5, 0.4 * SEED_FRACTION * height)
        _, components = cv2.connectedComponents((unlike | seeds).astype(np.uint8))
        robot = np.isin(components, np.unique(components[seeds])) & (distance < REACH_FRACTION * height)
        labels = np.full((height, width), cv2.GC_PR_BGD, dtype=np.uint8)
        labels[distance >= REACH_FRACTION * height] = cv2.GC_BGD
        labels[robot] = cv2.GC_PR_FGD
        labels[seeds] = cv2.GC_FGD
        return labels

    def _carried_labels(self, previous: np.ndarray, likely: np.ndarray) -> np.ndarray:
        """Likely robot where colours fit near the previous mask; far from it is background."""
        size = 2 * max(1, round(CARRY_FRACTION * previous.shape[0])) + 1
        near = cv2.dilate(previous.astype(np.uint8), np.ones((size, size), np.uint8)) > 0
        labels = np.full(previous.shape, cv2.GC_BGD, dtype=np.uint8)
        labels[near] = cv2.GC_PR_BGD
        labels[near & likely] = cv2.GC_PR_FGD
        return labels


def colour_ratio(lab: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Log ratio of the colour histograms inside and outside of ``mask``: (bins, bins, bins), above 0 is robot-like."""
    edges = [(0, 256)] * 3
    inside, _ = np.histogramdd(lab[mask], bins=_BINS, range=edges)
    outside, _ = np.histogramdd(lab[~mask], bins=_BINS, range=edges)
    inside, outside = (cv2.GaussianBlur(h.astype(np.float32), (3, 3), 0.8) for h in (inside, outside))
    return np.log((inside / max(1.0, float(inside.sum())) + 1e-5) / (outside / max(1.0, float(outside.sum())) + 1e-5))


def robot_likely(lab: np.ndarray, ratio: np.ndarray) -> np.ndarray:
    """Pixels whose colour is more frequent inside the robot than outside (h, w)."""
    index = np.clip(lab.astype(np.int32) * _BINS // 256, 0, _BINS - 1)
    return ratio[index[..., 0], index[..., 1], index[..., 2]] > 0
