"""Layers that all networks share: rotary positions with one height slot per view, attention, the action branch.

Axis order of a video sequence everywhere in this package: ``(t v h w)``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, cast

import torch
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Bool, Float
from torch import Tensor, nn

from worldline_core.errors import ConfigError, DataError
from worldline_core.model.world_model_config import WorldModelConfig

Rotation = tuple[Tensor, Tensor]
"""Cosines and sines of the rotation angles, each ``(..., n, head_dim)``, float32."""


def view_starts(config: WorldModelConfig, views: Sequence[str]) -> list[float]:
    """Height coordinate, in patch rows, at which each of ``views`` begins. Raises: ConfigError for an unknown or repeated view."""
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
        fps: frames per second of each clip, as it is shown (a stride lowers the rate): latent frame ``j`` is at
            ``j base_fps / fps``. None takes the config's; a model whose config has none counts latent frames.
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


def rotate(values: Float[Tensor, "*batch heads n d"], by: Rotation) -> Float[Tensor, "*batch heads n d"]:
    """Rotate queries or keys; ``by`` broadcasts over batch and heads."""
    cosine, sine = (part.to(values.dtype) for part in by)
    half = values.shape[-1] // 2
    first, second = values.chunk(2, dim=-1)
    rotated = values * cosine
    rotated[..., :half].addcmul_(second, sine[..., :half], value=-1)
    rotated[..., half:].addcmul_(first, sine[..., half:])
    return rotated


class GenerationAttention(Protocol):
    """Attention among video tokens, of normalised, not yet rotated queries and keys, ``(b heads n d)``."""

    def __call__(
        self, layer: int, queries: Tensor, keys: Tensor, values: Tensor, text: tuple[Tensor, Tensor] | None
    ) -> Tensor: ...


def grouped_attention(queries: Tensor, keys: Tensor, values: Tensor, mask: Tensor | None = None) -> Tensor:
    """Attention of ``h`` query heads over ``g <= h`` key heads, ``(b heads n d)``.

    The query heads that share a key head are interleaved as rows of one head. That is the same sum, needs no
    copies of keys and values, and stays on the fused kernels (``enable_gqa`` falls back to the slow one).

    Args:
        mask: boolean, True where attention is allowed, broadcastable to ``(b 1 queries keys)``.
    """
    groups = queries.shape[1] // keys.shape[1]
    rows = rearrange(queries, "b (k g) n d -> b k (n g) d", g=groups)
    if mask is not None and mask.shape[-2] != 1:
        mask = mask.repeat_interleave(groups, dim=-2)
    mixed = F.scaled_dot_product_attention(rows, keys, values, attn_mask=mask)
    return rearrange(mixed, "b k (n g) d -> b n (k g d)", g=groups)


@dataclass(frozen=True)
class TextContext:
    """A text as each layer reads it: keys and values, or tokens (Wan). It depends on neither the video nor sigma: compute it once.

    ``ignored``: the video does not see the text. Only the way back passes through the text tower, with zero gradients,
    because processes that share its weights must gather them together.
    """

    layers: tuple[tuple[Tensor, ...], ...]
    mask: Bool[Tensor, "b m"] | None
    size: int
    ignored: bool = False


class RMSNorm(nn.Module):
    """Root-mean-square normalisation over the last axis, in float32 for half-precision inputs."""

    def __init__(self, size: int, eps: float) -> None:
        super().__init__()
        self.eps = eps
        self.weight = nn.Parameter(torch.ones(size))

    def forward(self, values: Tensor) -> Tensor:
        return F.rms_norm(values, (values.shape[-1],), self.weight.to(values.dtype), self.eps)


def sinusoids(times: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape 256"]:
    """128 cosines, then sines, of ``times`` at frequencies 1 down to 1e-4 (geometric), float32."""
    half = 128
    exponent = -math.log(10000.0) * torch.arange(half, dtype=torch.float32, device=times.device) / half
    angles = times.to(torch.float32).unsqueeze(-1) * exponent.exp()
    return torch.cat((angles.cos(), angles.sin()), dim=-1)


class TimeEmbedder(nn.Module):
    """Two-layer perceptron on the sinusoids; runs in the dtype of its weights, outside autocast (Cosmos3: float32)."""

    def __init__(self, hidden_size: int) -> None:
        super().__init__()
        self.linear_1 = nn.Linear(256, hidden_size)
        self.linear_2 = nn.Linear(hidden_size, hidden_size)

    def forward(self, times: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape d"]:
        with torch.autocast(device_type=times.device.type, enabled=False):
            features = sinusoids(times).to(self.linear_1.weight.dtype)
            return self.linear_2(F.silu(self.linear_1(features)))


def check_shapes(config: WorldModelConfig, latents: Tensor, views: Sequence[str], action_maps: Tensor | None) -> None:
    """Raises: DataError for latents that are not those of ``views``, or controls of another grid (vectors alone: 1 x 1)."""
    if (
        latents.ndim != 6
        or latents.shape[1:3] != (len(views), config.latent_channels)
        or latents.shape[-1] % config.patch_size
        or latents.shape[-2] % config.patch_size
    ):
        expected = f"(b, {len(views)}, {config.latent_channels}, t, h, w), h and w multiples of {config.patch_size}"
        raise DataError("Latents have the wrong shape", expected=expected, got=tuple(latents.shape))
    if action_maps is not None:
        grid = latents.shape[4:] if config.takes_maps else (1, 1)
        wanted = (*latents.shape[:2], config.control_channels, latents.shape[3], *grid)
        if action_maps.shape != wanted:
            raise DataError("Controls have the wrong shape", expected=wanted, got=tuple(action_maps.shape))


def velocity_of(
    config: WorldModelConfig, emitted: Tensor, noisy: Tensor, sigma: Tensor, reference: Tensor | None
) -> Tensor:
    """Velocity under the config's ``prediction``; in float32 where clean latents are emitted.

    Args:
        emitted: output of the head, ``(b v c t h w)``.
        sigma: noise level, broadcastable to ``emitted``.
        reference: clean latents of the first frame, ``(b v c 1 h w)``.

    Raises:
        ConfigError: residuals to the first frame are predicted, but there is none.
    """
    if config.prediction == "velocity":
        return emitted
    if reference is None:
        raise ConfigError("The cache holds no first frame", next_step="write the observed frame first")
    emitted, noisy, reference = emitted.float(), noisy.float(), reference.float()
    if config.first_frame_std is not None:
        return preconditioned_velocity(emitted, noisy, sigma, reference, config.first_frame_std)
    return (noisy - (emitted + reference)) / sigma.clamp_min(config.minimum_sigma)


def preconditioned_velocity(emitted: Tensor, noisy: Tensor, sigma: Tensor, reference: Tensor, std: float) -> Tensor:
    """Velocity of the posterior mean under z ~ N(reference, std^2), corrected by ``emitted`` posterior deviations.

    With D = (1 - sigma)^2 std^2 + sigma^2 the posterior of z given the noisy latents has the mean
    ``reference + (1 - sigma) std^2 / D (noisy - (1 - sigma) reference)`` and the deviation ``sigma std / sqrt(D)``.
    ``(noisy - z) / sigma`` then has no division by sigma left.
    """
    spread = (1 - sigma) ** 2 * std**2 + sigma**2
    mean = ((sigma - (1 - sigma) * std**2) * noisy - sigma * reference) / spread
    return mean - std * emitted * spread.rsqrt()


class ActionEncoder(nn.Module):
    """``Conv3D(9 -> 9, 1 x 3 x 3)`` added to its input, 2 x 2 patches, and a zero-initialised linear layer.

    Because the last layer starts at zero, a model that gains this branch computes what it computed before. Maps of
    several control frames pass the convolution one by one and meet in the linear layer.
    """

    def __init__(self, config: WorldModelConfig) -> None:
        super().__init__()
        self.frames, self.patch_size = config.action_frames, config.patch_size
        self.conv = nn.Conv3d(config.action_channels, config.action_channels, (1, 3, 3), padding=(0, 1, 1))
        self.proj = nn.Linear(config.action_channels * config.action_frames * config.patch_size**2, config.hidden_size)
        nn.init.zeros_(self.proj.weight)
        nn.init.zeros_(self.proj.bias)

    def forward(self, controls: Float[Tensor, "b v c t h w"]) -> Float[Tensor, "b n d"]:
        """Residuals for the video tokens, in order ``(t v h w)``, from the maps: the first channels of every control frame."""
        flat = rearrange(controls, "b v (k c) t h w -> (b v k) c t h w", k=self.frames)[:, : self.conv.in_channels]
        flat = flat + self.conv(flat)
        patches = rearrange(
            flat,
            "(b v k) c t (h p) (w q) -> b (t v h w) (k p q c)",
            v=controls.shape[1],
            k=self.frames,
            p=self.patch_size,
            q=self.patch_size,
        )
        return self.proj(patches)


class NativeActionFilm(nn.Module):
    """``tokens (1 + scale) + shift`` before every layer, both linear in ``SiLU(linear(vector of the latent frame))``.

    Tokens of a view without a vector stay as they are. The last linear layers start at zero, so a model that gains this branch
    computes what it computed before.
    """

    def __init__(self, config: WorldModelConfig, native_size: int) -> None:
        super().__init__()
        self.frames, self.native_size = config.action_frames, native_size
        self.hidden = nn.Linear(native_size * config.action_frames, 256)
        self.proj = nn.ModuleList([nn.Linear(256, 2 * config.hidden_size) for _ in range(config.num_layers)])
        for parameter in self.proj.parameters():
            nn.init.zeros_(parameter)

    def forward(
        self, tokens: Float[Tensor, "b n d"], controls: Float[Tensor, "b v c t h w"], layer: int
    ) -> Float[Tensor, "b n d"]:
        """Tokens in order ``(t v h w)``, modulated for ``layer`` by the last channels of every control frame: the vector, and 1
        where there is one.
        """
        own = rearrange(controls[..., 0, 0], "b v (k c) t -> b t v k c", k=self.frames).to(self.hidden.weight.dtype)
        given, vectors = own[..., 0, -1:], own[..., -1 - self.native_size : -1]
        features = F.silu(self.hidden(rearrange(vectors, "b t v k c -> b t v 1 (k c)")))
        change = cast("Tensor", self.proj[layer](features)) * given[..., None, :]
        scale, shift = change.to(tokens.dtype).chunk(2, dim=-1)
        grid = rearrange(tokens, "b (t v n) d -> b t v n d", t=controls.shape[3], v=controls.shape[1])
        return rearrange(grid * (1 + scale) + shift, "b t v n d -> b (t v n) d")


def is_action_parameter(name: str) -> bool:
    """Returns whether a parameter belongs to a branch through which controls reach the model."""
    return name.startswith(("action_encoder.", "action_film."))


def action_branches(config: WorldModelConfig) -> tuple[ActionEncoder | None, NativeActionFilm | None]:
    """The branches of maps and of vectors that a model of this configuration has; they start without effect."""
    maps = ActionEncoder(config) if config.takes_maps else None
    return maps, None if config.native_size is None else NativeActionFilm(config, config.native_size)


def new_action_tensors(config: WorldModelConfig) -> dict[str, Tensor]:
    """Weights of the action branches as they start, by their names in the model."""
    branches = zip(("action_encoder", "action_film"), action_branches(config), strict=True)
    return {
        f"{name}.{key}": value
        for name, branch in branches
        if branch is not None
        for key, value in branch.state_dict().items()
    }
