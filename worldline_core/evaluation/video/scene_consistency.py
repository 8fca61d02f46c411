"""Does what should not move stay where it is?"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from einops import reduce

from worldline_core.evaluation.metrics import SSIM_WINDOW, frames_to_unit, ssim_map

STILL_LEVELS = 10  # a pixel of the recording within so many grey levels of its first frame has not moved
LEAST_SHARE = 0.05  # of the frame that must be still


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
        float(values[places].mean()) if places.mean() >= LEAST_SHARE else None
        for values, places in zip(likeness, still, strict=True)
    ]
