"""The classical segmenter: colour models of robot and background, started from projected points, and GrabCut.

Independent of anything learned. What is unlike the table around the projected tool centres of the first frame says what
the robot looks like; GrabCut (Rother et al. 2004) grows from there. Later frames start from the mask of the frame before, with the
colour models of the first frame, so the points are used once only.
"""

from __future__ import annotations

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
        masks = np.zeros(video.shape[:3], dtype=bool)
        if points is None or len(video) == 0:
            return masks
        start = points[0][np.isfinite(points[0]).all(axis=-1)]
        height, width = video.shape[1:3]
        start = start[(start >= 0).all(axis=-1) & (start[:, 0] < width) & (start[:, 1] < height)]
        if len(start) == 0:
            return masks
        cv2.setRNGSeed(0)  # GrabCut starts its colour models by k-means
        foreground, background = np.zeros((1, 65)), np.zeros((1, 65))
        lab = np.stack([cv2.cvtColor(frame, cv2.COLOR_RGB2LAB) for frame in video])
        labels = self._first_labels(lab[0], start)
        colours = colour_ratio(lab[0], np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD)))
        for index in range(len(video)):
            if index > 0:
                labels = self._carried_labels(masks[index - 1], robot_likely(lab[index], colours))
            if not (
                np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD)).any()
                and np.isin(labels, (cv2.GC_BGD, cv2.GC_PR_BGD)).any()
            ):
                continue
            mode = cv2.GC_INIT_WITH_MASK if index == 0 else cv2.GC_EVAL_FREEZE_MODEL
            rounds = self.iterations if index == 0 else 1
            frame = np.ascontiguousarray(video[index][..., ::-1])
            cv2.grabCut(frame, labels, (0, 0, 0, 0), background, foreground, rounds, mode)
            masks[index] = (labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)
            if index == 0:
                colours = colour_ratio(lab[0], masks[0])
        return masks

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
