"""Augmentations of training frames: unseen scenes, and what predicted frames look like.

A predicted frame has passed a lossy tokenizer and an imperfect model, is blurred and blocky, and shows faint copies of a moving arm.
Intensities are in [0, 1]; every frame of a batch draws its own numbers.
"""

from __future__ import annotations

import math

import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

_BLOCK = 8


def degrade(frames: Float[Tensor, "n c h w"], generator: torch.Generator) -> Float[Tensor, "n c h w"]:
    """Each frame by chance sharp, blurred, or rebuilt from few 8x8 cosine coefficients (as a patch tokenizer would)."""
    choice = torch.rand(len(frames), generator=generator)
    result = frames.clone()
    blurred, rebuilt = choice < 0.35, choice > 0.65
    if blurred.any():
        result[blurred] = _blur(frames[blurred], generator)
    if rebuilt.any():
        result[rebuilt] = _truncate_blocks(frames[rebuilt], generator)
    return result


def uniform(
    frames: Float[Tensor, "n c h w"], low: float, high: float, generator: torch.Generator
) -> Float[Tensor, "n 1 1 1"]:
    """One number a frame."""
    return low + (high - low) * torch.rand(len(frames), 1, 1, 1, generator=generator)


def mix_ghosts(
    frames: Float[Tensor, "n c h w"], ghosts: Float[Tensor, "n c h w"], generator: torch.Generator
) -> Float[Tensor, "n c h w"]:
    """A quarter of the frames shows a faint second exposure."""
    strength = uniform(frames, 0.0, 0.35, generator) * (torch.rand(len(frames), 1, 1, 1, generator=generator) < 0.25)
    return frames * (1 - strength) + ghosts * strength


def move(pictures: Float[Tensor, "n c h w"], generator: torch.Generator, *, mirror: bool) -> Float[Tensor, "n c h w"]:
    """Scale 0.85..1.2, shift 8 %, turn 6 degrees, and mirror every other one where that is wanted; all channels alike."""
    count, _, height, width = pictures.shape
    draw = torch.rand(5, count, generator=generator)
    scale = 0.85 + 0.35 * draw[0]
    angle = (2 * draw[1] - 1) * math.radians(6)
    side = torch.where(draw[2] < 0.5, -1.0, 1.0) if mirror else torch.ones(count)
    aspect = width / height
    cosine, sine = torch.cos(angle) / scale, torch.sin(angle) / scale
    # normalised coordinates: a turn in pixels needs the aspect ratio on its off-diagonal terms
    top = torch.stack([side * cosine, -sine / aspect, 0.16 * (draw[3] - 0.5)], dim=-1)
    bottom = torch.stack([side * sine * aspect, cosine, 0.16 * (draw[4] - 0.5)], dim=-1)
    grid = functional.affine_grid(torch.stack([top, bottom], dim=1), [count, 3, height, width], align_corners=False)
    return functional.grid_sample(pictures, grid, mode="bilinear", padding_mode="reflection", align_corners=False)


def change_colours(frames: Float[Tensor, "n 3 h w"], generator: torch.Generator) -> Float[Tensor, "n 3 h w"]:
    """Brightness, contrast, gamma, saturation, tint; one frame in eight has its channels permuted."""
    permuted = torch.rand(len(frames), generator=generator) < 0.125
    order = torch.randperm(3, generator=generator)
    frames = torch.where(permuted[:, None, None, None], frames[:, order], frames)
    frames = frames.clamp(min=1e-3) ** uniform(frames, 0.7, 1.45, generator)
    grey = frames.mean(dim=1, keepdim=True)
    frames = grey + (frames - grey) * uniform(frames, 0.4, 1.5, generator)
    middle = frames.mean(dim=(1, 2, 3), keepdim=True)
    frames = middle + (frames - middle) * uniform(frames, 0.7, 1.35, generator)
    tint = 1 + 0.15 * (2 * torch.rand(len(frames), 3, 1, 1, generator=generator) - 1)
    return (frames * tint + uniform(frames, -0.12, 0.12, generator)).clamp(0, 1)


def _blur(frames: Tensor, generator: torch.Generator) -> Tensor:
    """Gaussian blur, one sigma of 0.4..2 px for all of them."""
    channels = frames.shape[1]
    sigma = 0.4 + 1.6 * float(torch.rand((), generator=generator))
    offsets = torch.arange(-4, 5, dtype=frames.dtype)
    kernel = torch.exp(-offsets.square() / (2 * sigma**2))
    kernel = kernel / kernel.sum()
    padded = functional.pad(frames, (4, 4, 4, 4), mode="replicate")
    rows = functional.conv2d(padded, kernel.view(1, 1, 9, 1).expand(channels, 1, 9, 1), groups=channels)
    return functional.conv2d(rows, kernel.view(1, 1, 1, 9).expand(channels, 1, 1, 9), groups=channels)


def _truncate_blocks(frames: Tensor, generator: torch.Generator) -> Tensor:
    """Keep the cosine coefficients (i, j) with i + j <= k of every 8x8 block, k = 1..4."""
    height, width = frames.shape[-2:]
    padded = functional.pad(frames, (0, -width % _BLOCK, 0, -height % _BLOCK), mode="replicate")
    index = torch.arange(_BLOCK, dtype=frames.dtype)
    basis = torch.cos(math.pi * (index[None] + 0.5) * index[:, None] / _BLOCK) * math.sqrt(2 / _BLOCK)
    basis[0] /= math.sqrt(2)
    limit = int(torch.randint(1, 5, (), generator=generator))
    kept = ((index[:, None] + index[None]) <= limit).to(frames.dtype)
    blocks = rearrange(padded, "n c (h p) (w q) -> n c h w p q", p=_BLOCK, q=_BLOCK)
    coefficients = torch.einsum("ip,nchwpq,jq->nchwij", basis, blocks, basis) * kept
    blocks = torch.einsum("ip,nchwij,jq->nchwpq", basis, coefficients, basis)
    return rearrange(blocks, "n c h w p q -> n c (h p) (w q)")[..., :height, :width]
