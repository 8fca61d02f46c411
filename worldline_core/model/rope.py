"""Interleaved three-axis rotary positions (time, height, width), with one height slot per view.

Axis order of a video sequence everywhere in this package: ``(t v h w)``.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor

from worldline_core.errors import ConfigError
from worldline_core.model.world_model_config import WorldModelConfig

Rotation = tuple[Tensor, Tensor]
"""Cosines and sines of the rotation angles, each ``(..., n, head_dim)``, float32."""


def view_starts(config: WorldModelConfig, views: Sequence[str]) -> list[float]:
    """Height coordinate, in patch rows, at which each of ``views`` begins.

    Raises:
        ConfigError: a view has no slot in the config, or is named twice.
    """
    if not views or len(set(views)) != len(views) or any(view not in config.views for view in views):
        raise ConfigError("Unknown or repeated view", expected=f"a choice of {list(config.views)}", got=list(views))
    scale = 1.0
    if config.view_offset_unit == "pixel":
        scale = 1.0 / (config.spatial_compression * config.patch_size)
    slots = dict(zip(config.views, config.view_offsets, strict=True))
    return [slots[view] * scale for view in views]


def video_positions(
    config: WorldModelConfig,
    frames: Tensor,
    grid: tuple[int, int],
    views: Sequence[str],
    temporal_offset: float = 0.0,
    fps: Float[Tensor, " b"] | None = None,
) -> Float[Tensor, "3 *batch n"]:
    """Coordinates of the video tokens, flattened in order ``(t v h w)``.

    Args:
        frames: index of each latent frame, ``(t,)``.
        grid: patch rows and columns of one view.
        views: names of the views, all sharing the temporal coordinates (docs/method.md section 3).
        temporal_offset: added to the temporal axis (text length plus margin when there is text).
        fps: frames per second of each clip, as it is shown (a stride lowers the rate): latent frame ``j`` stands at
            ``j base_fps / fps``. None takes the config's; a model whose config has none counts latent frames.

    Returns:
        the coordinates of all clips, or with ``fps`` those of each clip, ``(3 b n)``.
    """
    rows, columns = grid
    device = frames.device
    time = frames.to(torch.float32)
    if config.fps is not None:
        rate = config.fps if fps is None else rearrange(fps.to(device, torch.float32), "b -> b 1")
        time = time / rate * config.base_fps
    time = time + temporal_offset
    # Filled on the device: a GPU would wait for numbers that are copied to it.
    starts = torch.stack([torch.full((), start, device=device) for start in view_starts(config, views)])
    height = rearrange(starts, "v -> v 1") + torch.arange(rows, device=device, dtype=torch.float32)
    width = torch.arange(columns, device=device, dtype=torch.float32)
    shape = (*time.shape, len(views), rows, columns)
    axes = (
        rearrange(time, "... t -> ... t 1 1 1").expand(shape),
        rearrange(height, "v h -> 1 v h 1").expand(shape),
        rearrange(width, "w -> 1 1 1 w").expand(shape),
    )
    return rearrange(torch.stack(axes), "xyz ... t v h w -> xyz ... (t v h w)")


def text_positions(lengths: Tensor, size: int) -> Float[Tensor, "3 b n"]:
    """Coordinates of right-padded text tokens.

    Cosmos3 counts text 0..n-1 on all axes and starts the video at ``n + margin``. In a batch the video start is shared
    (``size + margin``), so shorter texts are moved on the temporal axis until they end where the longest ends: rotary
    attention depends on differences only, so every sample sees the distances it would see alone.
    """
    index = torch.arange(size, device=lengths.device, dtype=torch.float32)
    index = rearrange(index, "n -> 1 n").expand(len(lengths), size)
    time = index + rearrange(size - lengths.to(torch.float32), "b -> b 1")
    return torch.stack((time, index, index))


def rotation(config: WorldModelConfig, positions: Float[Tensor, "3 *batch n"]) -> Rotation:
    """Cosines and sines for ``positions``; frequency ``i`` belongs to axis ``i % 3`` within the sections, else to time."""
    half = config.head_dim // 2
    # Angles stay in float32 even under autocast: bfloat16 cannot tell consecutive integers apart beyond 256.
    exponent = torch.arange(0, config.head_dim, 2, dtype=torch.float32, device=positions.device) / config.head_dim
    frequencies = 1.0 / (config.rope_theta**exponent)
    axis_of = torch.zeros(half, dtype=torch.long, device=positions.device)
    for axis in (1, 2):
        axis_of[axis : config.rope_sections[axis] * 3 : 3] = axis
    chosen = positions.to(torch.float32)[axis_of]
    angles = torch.movedim(chosen, 0, -1) * frequencies
    angles = torch.cat((angles, angles), dim=-1)
    return angles.cos(), angles.sin()


def rotate(values: Float[Tensor, "*batch heads n d"], by: Rotation) -> Float[Tensor, "*batch heads n d"]:
    """Rotate queries or keys; ``by`` broadcasts over batch and heads."""
    cosine, sine = (part.to(values.dtype) for part in by)
    first, second = values.chunk(2, dim=-1)
    return values * cosine + torch.cat((-second, first), dim=-1) * sine
