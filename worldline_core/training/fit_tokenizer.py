"""Bases of the patch tokenizer: principal components of static and of moving patches."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from einops import rearrange
from torch import Tensor

from worldline_core.errors import DataError
from worldline_core.model.patch_tokenizer import PatchTokenizer, PatchTokenizerConfig


@dataclass
class _Moments:
    static: Tensor
    motion: Tensor
    total: Tensor
    weight: float = 0.0


def fit_patch_tokenizer(
    clips: Iterable[Tensor],
    *,
    channels: int = 32,
    spatial: int = 8,
    temporal: int = 4,
    motion_weight: float = 4.0,
    whitening: float = 0.5,
    refinement_width: int = 48,
    refinement_depth: int = 2,
) -> PatchTokenizer:
    """Fit the linear part to clips ``(b, 3, 1 + k * temporal, h, w)`` in [-1, 1].

    Static and motion components lie in orthogonal subspaces, so the best ``channels`` of the two spectra together are
    the best basis of this form; how many are static follows from the data.

    Args:
        motion_weight: extra weight of patches that differ from the clip's first frame (arms and what they move).
        whitening: 0 divides all channels by one number, 1 each by its standard deviation, in between by that power of
            it. Always followed by one number, so that latents have unit variance over all channels of a group.

    Raises:
        DataError: there are no clips.
    """
    pixels = 3 * spatial**2
    moments = _Moments(
        torch.zeros(pixels, pixels, dtype=torch.float64),
        torch.zeros(temporal * pixels, temporal * pixels, dtype=torch.float64),
        torch.zeros(pixels, dtype=torch.float64),
    )
    for video in clips:
        _accumulate(moments, video.float(), spatial, temporal, motion_weight)
    if moments.weight == 0:
        raise DataError("No clips to fit the tokenizer to", next_step="check the selection of episodes")
    mean = moments.total / moments.weight
    static_values, static_vectors = torch.linalg.eigh(moments.static / moments.weight - torch.outer(mean, mean))
    motion_values, motion_vectors = torch.linalg.eigh(moments.motion / moments.weight)
    # A static vector stands for `temporal` equal frames: its energy in pixels is that many times its variance.
    energies = torch.cat((static_values.flip(0) * temporal, motion_values.flip(0)[: channels - 1]))
    chosen = torch.argsort(energies, descending=True)[:channels]
    static_count = int((chosen < pixels).sum())
    tokenizer = PatchTokenizer(
        PatchTokenizerConfig(
            static_channels=static_count,
            motion_channels=channels - static_count,
            spatial_compression=spatial,
            temporal_compression=temporal,
            refinement_width=refinement_width,
            refinement_depth=refinement_depth,
        )
    )
    static_basis = _signed(static_vectors.flip(1)[:, :static_count].T)
    motion_basis = _signed(motion_vectors.flip(1)[:, : channels - static_count].T)
    kept = torch.cat(
        (static_values.flip(0)[:static_count] * temporal, motion_values.flip(0)[: channels - static_count])
    )
    deviation = kept.clamp_min(1e-12).sqrt()
    scale = deviation**whitening
    scale = scale * ((deviation / scale) ** 2).mean().sqrt()
    scale[:static_count] /= temporal**0.5
    tokenizer.mean.copy_(mean)
    tokenizer.static_basis.copy_(static_basis)
    tokenizer.motion_basis.copy_(motion_basis)
    tokenizer.scale.copy_(scale)
    return tokenizer


def _accumulate(moments: _Moments, video: Tensor, spatial: int, temporal: int, motion_weight: float) -> None:
    patches = rearrange(video, "b c t (h p) (w q) -> b t (h w) (c p q)", p=spatial, q=spatial)
    groups = rearrange(patches[:, 1:], "b (n g) s d -> b n s g d", g=temporal)
    means = groups.mean(dim=3)
    change = (groups - rearrange(patches[:, 0], "b s d -> b 1 s 1 d")).abs().mean(dim=(3, 4))
    weights = 1.0 + motion_weight * (change > 0.05).float()
    flat = rearrange(means, "b n s d -> (b n s) d")
    weight = rearrange(weights, "b n s -> (b n s) 1")
    moments.static += ((flat * weight).T @ flat).double()
    moments.total += (flat * weight).sum(dim=0).double()
    moments.weight += float(weight.double().sum())
    moving = rearrange(groups - rearrange(means, "b n s d -> b n s 1 d"), "b n s g d -> (b n s) (g d)")
    moments.motion += ((moving * weight).T @ moving).double()


def _signed(basis: Tensor) -> Tensor:
    """Eigenvectors have no sign of their own; make the largest entry positive, so that equal data give equal bases."""
    largest = basis.gather(1, basis.abs().argmax(dim=1, keepdim=True))
    return basis * torch.where(largest < 0, -1.0, 1.0)
