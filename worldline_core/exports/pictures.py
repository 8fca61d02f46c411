"""Scaling and encoding of single pictures: PNG for plots and sheets, JPEG for video posters; deterministic bytes."""

from __future__ import annotations

from io import BytesIO
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

Upscale = Literal["lanczos", "nearest"]


def scaled_size(height: int, width: int, target_height: int) -> tuple[int, int]:
    """Display size (h, w): a whole multiple for small frames, a plain reduction for large ones; both sides even.

    Whole multiples keep every recorded pixel the same size on the screen.
    """
    if height <= target_height:
        factor = max(1, target_height // height)
        scaled = (height * factor, width * factor)
    else:
        scaled = (target_height, round(width * target_height / height))
    return scaled[0] + scaled[0] % 2, scaled[1] + scaled[1] % 2


def scale_frames(frames: NDArray[np.uint8], size: tuple[int, int], upscale: Upscale = "lanczos") -> NDArray[np.uint8]:
    """Scales `n h w 3` frames to size (h, w); enlarging uses `upscale`, reducing averages areas."""
    height, width = size
    if frames.shape[1:3] == (height, width):
        return frames
    enlarge = {"lanczos": cv2.INTER_LANCZOS4, "nearest": cv2.INTER_NEAREST}[upscale]
    interpolation = enlarge if height >= frames.shape[1] else cv2.INTER_AREA
    return np.stack([cv2.resize(frame, (width, height), interpolation=interpolation) for frame in frames])


def png_bytes(picture: NDArray[np.uint8]) -> bytes:
    """Encodes one RGB picture as PNG."""
    buffer = BytesIO()
    Image.fromarray(picture).save(buffer, format="PNG", optimize=False, compress_level=9)
    return buffer.getvalue()


def jpeg_bytes(picture: NDArray[np.uint8], quality: int = 88) -> bytes:
    """Encodes one RGB picture as JPEG without chroma subsampling (coloured objects are small here)."""
    buffer = BytesIO()
    Image.fromarray(picture).save(buffer, format="JPEG", quality=quality, subsampling=0, optimize=True)
    return buffer.getvalue()
