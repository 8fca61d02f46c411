"""Places of the tools in predicted pictures.

End-effector error: how far from the commanded place the gripper appears. The paper has no such metric. Around the
projected tool centre of a frame a patch of the *true* frame is taken, and the place where it fits the *predicted* frame
best (normalised correlation) is searched within a radius. The distance from that place to the projected point is the
error [px of the recording's frame]. A gripper that correlates with nothing within reach counts with the search radius.
True videos score 0 by construction.

For a static camera, the recording's background is subtracted first. Otherwise the correlation would match the table behind a
small robot, and a video in which the robot does not move would score 0. Without a known camera, the part of the picture that
has moved most stands for the tool.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import cv2
import numpy as np
from scipy.fft import irfft2, next_fast_len, rfft2

from worldline_core.pictures import evenly_spaced

PATCH_FRACTION = 0.15  # half side of the patch, of the frame height: the gripper and some of what is behind it
MIN_CONTRAST = 8.0  # standard deviation of a patch [grey levels]; flatter ones fit everywhere and say nothing
SEARCH_FRACTION = 0.25  # search radius, of the frame height
MIN_CORRELATION = 0.4
LEAST_CHANGE = 8.0  # blurred change that is motion [grey levels]
BACKGROUND_FRAMES = 15


def end_effector_error(
    true: np.ndarray, predicted: np.ndarray, points: np.ndarray, background: np.ndarray | None = None
) -> np.ndarray:
    """Error of each frame and point (n, p) float64 [px]; NaN where a point is invalid or its patch leaves the frame.

    Args:
        true, predicted: uint8 (n, h, w, 3), same size.
        points: (n, p, 2) projected tool centres u, v [px]; NaN where invalid.
        background: float32 (h, w, 3) that is taken from both.
    """
    least_contrast = MIN_CONTRAST
    if background is not None:
        true, predicted, least_contrast = _apart(true, background), _apart(predicted, background), MIN_CONTRAST / 2
    height, width = true.shape[1:3]
    half = max(2, round(PATCH_FRACTION * height))
    radius = max(2, round(SEARCH_FRACTION * height))
    errors = np.full(points.shape[:2], np.nan)
    for frame, arm in np.argwhere(np.isfinite(points).all(axis=-1)):
        u, v = (round(float(x)) for x in points[frame, arm])
        if not (half <= u < width - half and half <= v < height - half):
            continue
        patch = true[frame, v - half : v + half + 1, u - half : u + half + 1]
        if patch.std(axis=(0, 1)).max() < least_contrast:
            continue
        top, left = max(0, v - half - radius), max(0, u - half - radius)
        region = predicted[frame, top : v + half + radius + 1, left : u + half + radius + 1]
        correlation = normalised_correlation(region, patch)
        row, column = np.unravel_index(int(np.argmax(correlation)), correlation.shape)
        distance = float(np.hypot(left + half + column - u, top + half + row - v))
        found = correlation[row, column] >= MIN_CORRELATION
        errors[frame, arm] = min(distance, radius) if found else radius
    return errors


def normalised_correlation(region: np.ndarray, patch: np.ndarray) -> np.ndarray:
    """OpenCV's TM_CCOEFF_NORMED of a patch at each place of a region; 0 where the region is flat. Takes an eighth of OpenCV's time.

    Args:
        region, patch: uint8 (h, w, 3) and (a, b, 3), a <= h, b <= w.

    Returns: (h - a + 1, w - b + 1) float64.
    """
    rows, columns = region.shape[0] - patch.shape[0] + 1, region.shape[1] - patch.shape[1] + 1
    template = patch - patch.mean(axis=(0, 1))
    size = [next_fast_len(side, real=True) for side in region.shape[:2]]
    spectrum, own = (cast("np.ndarray", rfft2(values, size, axes=(0, 1))) for values in (region, template))
    product = cast("np.ndarray", irfft2((spectrum * own.conj()).sum(axis=2), size))[:rows, :columns]

    sums, squares = (
        table[-rows:, -columns:] - table[:rows, -columns:] - table[-rows:, :columns] + table[:rows, :columns]
        for table in cv2.integral2(region)
    )
    variance = (squares - sums.astype(np.float64) ** 2 / patch[..., 0].size).sum(axis=2)
    scale = np.sqrt(variance * np.square(template).sum())
    return np.divide(product, scale, out=np.zeros_like(product), where=variance > 0.5)


def _apart(frames: np.ndarray, background: np.ndarray) -> np.ndarray:
    """Halve the difference, rounded to grey levels around 128."""
    return np.rint((frames - background) / 2 + 128).clip(0, 255).astype(np.uint8)


def background_of(count: int, pictures: Callable[[list[int]], np.ndarray]) -> np.ndarray:
    """(h, w, 3) float32 median of frames of a recording, evenly spaced.

    Args:
        count: frames of the recording.
        pictures: gives those of these numbers, (n, h, w, 3).
    """
    return np.median(pictures(evenly_spaced(count, BACKGROUND_FRAMES)), axis=0).astype(np.float32)


def moving_part(first: np.ndarray, later: np.ndarray, background: np.ndarray) -> np.ndarray:
    """(1, 2) the place u, v of the later picture that has changed most and is no background; NaN where hardly anything has."""
    height, width = later.shape[:2]
    half = max(2, round(PATCH_FRACTION * height))

    def blurred(values: np.ndarray) -> np.ndarray:
        return cv2.GaussianBlur(values, (0, 0), half / 2)[half : height - half, half : width - half]

    apart = later - background
    change = blurred(np.minimum(np.abs(later.astype(np.float32) - first), np.abs(apart)).max(axis=-1))
    grey = apart.mean(axis=-1)
    contrast = np.sqrt(np.maximum(blurred(grey**2) - blurred(grey) ** 2, 0))
    likely = np.where((change >= LEAST_CHANGE) & (contrast >= MIN_CONTRAST), change * contrast, 0)
    if not likely.any():
        return np.full((1, 2), np.nan)
    row, column = np.unravel_index(int(np.argmax(likely)), likely.shape)
    return np.array([[column + half, row + half]], dtype=np.float64)
