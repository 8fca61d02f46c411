"""Thumbnails of pictures that do not come from a video, for tests and benchmarks."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np

from worldline_core.data.video.thumbnails import ThumbnailMaker, ViewThumbnails


def view_thumbnails(frames_rgb: Iterable[np.ndarray], fps: float = 30.0) -> ViewThumbnails:
    """Thumbnails of pictures that do not come from a video.

    Args:
        frames_rgb: uint8 (H, W, 3) each, RGB.
        fps: their rate, from which follows how often sharpness is measured.

    Raises: RejectedInputError when there are none, or they differ in shape.
    """
    maker = ThumbnailMaker(fps)
    for frame in frames_rgb:
        maker.add(cv2.cvtColor(np.ascontiguousarray(frame), cv2.COLOR_RGB2GRAY), full_range=True)
    return maker.thumbnails()
