"""Frames as stored (uint8) to tensors as models see them, and back; one place decides how frames are resized."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor

from worldline_core.errors import DataError


def resize_frame(frame: np.ndarray, size: tuple[int, int], *, out: np.ndarray) -> None:
    """``uint8 (H, W, 3)`` at ``size`` (H, W) into ``out``: area averages when shrinking, linear when enlarging."""
    if frame.shape[:2] == tuple(size):
        out[...] = frame
        return
    shrinking = size[0] <= frame.shape[0] and size[1] <= frame.shape[1]
    cv2.resize(frame, (size[1], size[0]), dst=out, interpolation=cv2.INTER_AREA if shrinking else cv2.INTER_LINEAR)


def frames_to_video(frames: np.ndarray, size: tuple[int, int] | None = None) -> Float[Tensor, "3 t h w"]:
    """``uint8 (N, H, W, 3)`` RGB to float32 in [-1, 1], resized to ``size`` (H, W) by area averaging.

    Raises:
        DataError: the frames have another shape or type.
    """
    if frames.ndim != 4 or frames.shape[3] != 3 or frames.dtype != np.uint8:
        raise DataError("Not RGB frames", expected="uint8 (N, H, W, 3)", got=f"{frames.dtype} {frames.shape}")
    if size is not None and frames.shape[1:3] != tuple(size):
        resized = np.empty((len(frames), *size, 3), np.uint8)
        for frame, target in zip(frames, resized, strict=True):
            resize_frame(frame, size, out=target)
        frames = resized
    return rearrange(torch.from_numpy(np.ascontiguousarray(frames)), "t h w c -> c t h w").float() / 127.5 - 1.0


def video_to_frames(video: Float[Tensor, "3 t h w"]) -> np.ndarray:
    """[-1, 1] to ``uint8 (N, H, W, 3)`` RGB, clamped and rounded."""
    levels = ((video.detach().float() + 1.0) * 127.5).round().clamp(0, 255).to(torch.uint8)
    return rearrange(levels.cpu(), "c t h w -> t h w c").contiguous().numpy()
