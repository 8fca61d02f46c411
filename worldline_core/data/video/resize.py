"""Images and masks at another size."""

from __future__ import annotations

from typing import Literal

import numpy as np

from worldline_core.geometry.image_transforms import ImageTransform

Fit = Literal["stretch", "letterbox", "crop"]


def fitted(from_size: tuple[int, ...], size: tuple[int, int] | None, fit: Fit) -> ImageTransform:
    """From (height, width) to a wanted one: stretched, whole with black bars, or filled with the rest cut away."""
    transform = ImageTransform.of((from_size[0], from_size[1]))
    if size is None:
        return transform
    match fit:
        case "stretch":
            return transform.resize(size)
        case "letterbox":
            return transform.letterbox(size)
        case "crop":
            return transform.centre_crop(size)


def resize_frames(frames: np.ndarray, size: tuple[int, int] | None) -> np.ndarray:
    """uint8 (N, H, W, 3) at (height, width): area averages when shrinking, linear when enlarging."""
    return frames if size is None else _resized(frames, size).frames(frames)


def resize_masks(masks: np.ndarray, size: tuple[int, int] | None) -> np.ndarray:
    """bool (N, H, W) at (height, width): True where at least half of a pixel's area was."""
    return masks if size is None else _resized(masks, size).masks(masks)


def _resized(images: np.ndarray, size: tuple[int, int]) -> ImageTransform:
    return fitted((images.shape[1], images.shape[2]), size, "stretch")
