"""What every video tokenizer offers: RGB in [-1, 1] to normalised latents and back, causal in time.

Also frames as stored (uint8) to tensors as models see them, and back; one place decides how frames are resized.

Axis legend: b batch, c channel, t frame, h w pixels; ``_l`` marks the latent grid.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float, UInt8
from torch import Tensor

from worldline_core.data.video.frames import Frames
from worldline_core.errors import DataError


@runtime_checkable
class VideoTokenizer(Protocol):
    """Causal video codec. Latents are normalised to about unit scale; latent frame 0 codes RGB frame 0 alone."""

    latent_channels: int
    spatial_compression: int
    temporal_compression: int

    def encode(self, video: Float[Tensor, "b 3 t h w"]) -> Float[Tensor, "b c t_l h_l w_l"]: ...

    def decode(
        self, latents: Float[Tensor, "b c t_l h_l w_l"], reference: Float[Tensor, "b 3 h w"] | None = None
    ) -> Float[Tensor, "b 3 t h w"]:
        """Latents to video; ``reference``, the observed first frame, helps tokenizers that can use it."""
        ...

    def decoder(self, reference: Float[Tensor, "b 3 h w"] | None = None) -> VideoDecoder:
        """As :meth:`decode`, but for latents that arrive one after the other."""
        ...


class VideoDecoder(Protocol):
    """Decodes clips as their latents arrive; it keeps no more of them than later frames need."""

    def __call__(self, latents: Float[Tensor, "b c t_l h_l w_l"]) -> Float[Tensor, "b 3 t h w"]:
        """Frames of the next latents, the first of them those of frame 0."""
        ...

    def copy(self) -> VideoDecoder:
        """A decoder in the same state that goes on separately."""
        ...


class GroupDecoder:
    """A `VideoDecoder` for tokenizers whose later latent frames are decoded each by itself, beside latent frame 0."""

    def __init__(self, decode: Callable[[Tensor, Tensor | None], Tensor], reference: Tensor | None) -> None:
        self._decode = decode
        self._reference = reference
        self._first: Tensor | None = None

    def __call__(self, latents: Float[Tensor, "b c t_l h_l w_l"]) -> Float[Tensor, "b 3 t h w"]:
        if self._first is None:
            self._first = latents[:, :, :1]
            return self._decode(latents, self._reference)
        return self._decode(torch.cat((self._first, latents), dim=2), self._reference)[:, :, 1:]

    def copy(self) -> GroupDecoder:
        """A decoder in the same state that goes on separately."""
        return copy(self)


def check_video(tokenizer: VideoTokenizer, video: Tensor) -> None:
    """Refuse a video whose length or size the tokenizer cannot code.

    Raises:
        DataError: it is not ``(b, 3, 1 + k * temporal, multiple of spatial, multiple of spatial)``.
    """
    space, time = tokenizer.spatial_compression, tokenizer.temporal_compression
    if (
        video.ndim != 5
        or video.shape[1] != 3
        or (video.shape[2] - 1) % time
        or video.shape[3] % space
        or video.shape[4] % space
    ):
        raise DataError(
            "The tokenizer cannot code a video of this shape",
            expected=f"(b, 3, 1 + k * {time}, multiple of {space}, multiple of {space})",
            got=tuple(video.shape),
        )


def check_latents(tokenizer: VideoTokenizer, latents: Tensor) -> None:
    """Refuse latents of another layout.

    Raises:
        DataError: not five axes, or another number of channels.
    """
    if latents.ndim != 5 or latents.shape[1] != tokenizer.latent_channels:
        expected = f"(b, {tokenizer.latent_channels}, t, h, w)"
        raise DataError("Not latents of this tokenizer", expected=expected, got=tuple(latents.shape))


def resize_frame(frame: np.ndarray, size: tuple[int, int], *, out: np.ndarray) -> None:
    """``uint8 (H, W, 3)`` at ``size`` (H, W) into ``out``: area averages when shrinking, linear when enlarging."""
    if frame.shape[:2] == tuple(size):
        out[...] = frame
        return
    shrinking = size[0] <= frame.shape[0] and size[1] <= frame.shape[1]
    cv2.resize(frame, (size[1], size[0]), dst=out, interpolation=cv2.INTER_AREA if shrinking else cv2.INTER_LINEAR)


def resized_video(frames: Frames, size: tuple[int, int]) -> UInt8[Tensor, "3 t h w"]:
    """RGB frames ``(N, H, W, 3)``, gone through one by one, at ``size`` (H, W)."""
    resized = np.empty((len(frames), *size, 3), np.uint8)
    for frame, target in zip(frames, resized, strict=True):
        resize_frame(frame, size, out=target)
    return rearrange(torch.from_numpy(resized), "t h w c -> c t h w").contiguous()


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
