"""Robot-mask IoU by the paper's rules (appendix "Robot-mask IoU"; method.md section 6). Head view only.

A frame in which both masks are empty is left out; one in which only one is empty counts 0. Valid frames are averaged
within a video, then videos are averaged. A video whose masks are empty in every frame is left out.
"""

from __future__ import annotations

import numpy as np

from worldline_core.errors import DataError


def frame_iou(true: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    """Intersection over union of each frame (n,) float64; NaN where both masks are empty.

    Args:
        true, predicted: bool (n, h, w).

    Raises: DataError for masks of different shape or another type.
    """
    if true.shape != predicted.shape or true.ndim != 3 or true.dtype != bool or predicted.dtype != bool:
        raise DataError(
            "Robot masks do not fit each other",
            expected=f"bool (n, h, w), both {true.shape}",
            got=f"{true.dtype} {true.shape} and {predicted.dtype} {predicted.shape}",
        )
    intersection = np.count_nonzero(true & predicted, axis=(1, 2)).astype(np.float64)
    union = np.count_nonzero(true | predicted, axis=(1, 2)).astype(np.float64)
    return np.divide(intersection, union, out=np.full_like(union, np.nan), where=union > 0)


def video_iou(true: np.ndarray, predicted: np.ndarray) -> float | None:
    """Mean IoU over the valid frames of one video; None when every frame is empty in both (the video is left out)."""
    values = frame_iou(true, predicted)
    valid = values[~np.isnan(values)]
    return float(valid.mean()) if valid.size else None
