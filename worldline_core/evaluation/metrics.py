"""Metrics of predicted videos, frame by frame; means over time are taken by the caller, per trajectory and view.

Full frame: PSNR and SSIM (appendix "Full-frame metrics" of the paper). The conditioning frame counts like every other.

Robot-mask IoU, head view only (appendix "Robot-mask IoU"). A frame in which both masks are empty is left out; one in
which only one is empty counts 0. A video whose masks are empty in every frame is left out.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from einops import rearrange, reduce
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from worldline_core.errors import DataError

# Frames are stored in 8 bits. Rounding alone leaves a mean squared error of 1/12 grey level squared, so a smaller
# error cannot be distinguished from none: PSNR ends there (58.9 dB) instead of at infinity, and a mean over time stays finite.
QUANTISATION_MSE = 1.0 / (12.0 * 255.0**2)
MAX_PSNR_DB = -10.0 * math.log10(QUANTISATION_MSE)

SSIM_WINDOW = 11
_SSIM_FRAMES = 8
_WINDOW_SIGMA = 1.5
_K1, _K2 = 0.01, 0.03


def psnr(predicted: Float[Tensor, "n 3 h w"], true: Float[Tensor, "n 3 h w"]) -> Float[Tensor, " n"]:
    """Peak signal-to-noise ratio of each frame [dB]; intensities in [0, 1]; at most MAX_PSNR_DB.

    Raises: DataError when the shapes differ.
    """
    _check(predicted, true)
    squared_error = reduce((predicted - true).square(), "n c h w -> n", "mean")
    return -10.0 * torch.log10(squared_error.clamp(min=QUANTISATION_MSE))


def ssim(predicted: Float[Tensor, "n 3 h w"], true: Float[Tensor, "n 3 h w"]) -> Float[Tensor, " n"]:
    """Structural similarity of each frame (Wang et al. 2004): Gaussian window 11, sigma 1.5, mean over channels.

    Intensities in [0, 1]. Only window positions fully inside the frame count, as in scikit-image.

    Raises: DataError when the shapes differ or a frame is smaller than the window.
    """
    return reduce(ssim_map(predicted, true), "n c h w -> n", "mean")


def ssim_map(predicted: Float[Tensor, "n 3 h w"], true: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 3 y x"]:
    """Structural similarity at each position of the window, y = h - 10, x = w - 10; as :func:`ssim`."""
    _check(predicted, true)
    if min(predicted.shape[-2:]) < SSIM_WINDOW:
        raise DataError(
            "Frame smaller than the SSIM window", expected=f">= {SSIM_WINDOW}", got=str(tuple(predicted.shape))
        )
    offsets = torch.arange(SSIM_WINDOW, dtype=predicted.dtype, device=predicted.device) - SSIM_WINDOW // 2
    gaussian = torch.exp(-offsets.square() / (2 * _WINDOW_SIGMA**2))
    gaussian = gaussian / gaussian.sum()
    # Some frames at a time: their moments stay in a processor's cache, which halves the time.
    pieces = zip(predicted.split(_SSIM_FRAMES), true.split(_SSIM_FRAMES), strict=True)
    return torch.cat([_likeness(p, t, gaussian) for p, t in pieces])


def _likeness(
    predicted: Float[Tensor, "n c h w"], true: Float[Tensor, "n c h w"], gaussian: Float[Tensor, " k"]
) -> Float[Tensor, "n c y x"]:
    channels = predicted.shape[1]
    rows = gaussian.view(1, 1, SSIM_WINDOW, 1).expand(channels, 1, SSIM_WINDOW, 1)
    columns = gaussian.view(1, 1, 1, SSIM_WINDOW).expand(channels, 1, 1, SSIM_WINDOW)
    # Variances are differences of squares: taken around mid-grey they keep their digits in single precision.
    p, t = predicted - 0.5, true - 0.5
    moments = torch.cat([p, t, p.square(), t.square(), p * t], dim=1)
    rows, columns = (kernel.repeat(5, 1, 1, 1) for kernel in (rows, columns))
    smoothed = functional.conv2d(functional.conv2d(moments, rows, groups=5 * channels), columns, groups=5 * channels)
    mean_p, mean_t, square_p, square_t, product = smoothed.chunk(5, dim=1)
    variance_p, variance_t = square_p - mean_p.square(), square_t - mean_t.square()
    covariance = product - mean_p * mean_t
    mean_p, mean_t = mean_p + 0.5, mean_t + 0.5
    c1, c2 = _K1**2, _K2**2
    return ((2 * mean_p * mean_t + c1) * (2 * covariance + c2)) / (
        (mean_p.square() + mean_t.square() + c1) * (variance_p + variance_t + c2)
    )


def frames_to_unit(frames: Tensor) -> Float[Tensor, "n 3 h w"]:
    """uint8 frames (n, h, w, 3) to float32 in [0, 1], channels first."""
    return rearrange(frames.to(torch.float32) / 255.0, "n h w c -> n c h w")


def _check(predicted: Tensor, true: Tensor) -> None:
    if predicted.shape != true.shape or predicted.ndim != 4:
        raise DataError(
            "Predicted and true frames differ in shape",
            expected=f"(n, 3, h, w) = {tuple(true.shape)}",
            got=str(tuple(predicted.shape)),
            next_step="predict at the recording's frame size, one frame for each recorded one",
        )


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
