"""Images and masks at another size."""

from __future__ import annotations

import cv2
import numpy as np


def resize_frames(frames: np.ndarray, size: tuple[int, int] | None) -> np.ndarray:
    """uint8 (N, H, W, 3) at (height, width): area averages when shrinking, linear when enlarging."""
    if size is None or tuple(frames.shape[1:3]) == tuple(size):
        return frames
    height, width = size
    shrinking = height <= frames.shape[1] and width <= frames.shape[2]
    method = cv2.INTER_AREA if shrinking else cv2.INTER_LINEAR
    return np.stack([cv2.resize(frame, (width, height), interpolation=method) for frame in frames])


def resize_masks(masks: np.ndarray, size: tuple[int, int] | None) -> np.ndarray:
    """bool (N, H, W) at (height, width): True where at least half of a pixel's area was."""
    if size is None or tuple(masks.shape[1:]) == tuple(size):
        return masks
    height, width = size
    areas = [cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA) for mask in masks]
    return np.stack(areas) >= 0.5
