"""Nine-channel action maps, rendered straight at latent resolution (paper, "Cross-Embodiment Spatial Action Conditioning").

    A = [h, d h, r1 h .. r6 h, g h],   h(u) = exp(-|u - u_t|^2 / (2 sigma^2))

Axis legend: b clips, t frames, v views, a arms, h and w grid rows and columns.

Pixel centres. Image pixels and grid cells both have their centres at whole numbers and cover half a unit to each
side, so the image is -0.5 <= u < W - 0.5 and a point u of the image lies at (u + 0.5) w / W - 0.5 of a grid of w
columns. Rendering on the grid of a resized image therefore equals rendering with the resized camera.

Sigma is `sigma_px_ref` pixels on the reference canvas (384 x 512), scaled to the grid on each axis by itself, so the
Gaussian covers the same part of the picture at every resolution. On a grid where sigma falls below about half a
cell, a point between cells all but vanishes: choose a larger `sigma_px_ref` for coarse grids (0.78 cells is the
paper's 30 x 40; a grid of 8 x 12 needs 33..37).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from einops import rearrange, repeat
from jaxtyping import Bool, Float
from torch import Tensor

from worldline_core.actions.actions_config import REFERENCE_CANVAS, SIGMA_PX_REFERENCE, TEMPORAL_FACTOR
from worldline_core.actions.episode_tracks import TrackBatch
from worldline_core.errors import ConfigError

NUM_CHANNELS = 9
CHANNELS = ("h", "d", "r1", "r2", "r3", "r4", "r5", "r6", "g")


def latent_frame_indices(num_frames: int) -> list[int]:
    """RGB frames whose controls the latent frames take: 0, 4, 8, ... (latent frame 0 is frame 0, j is frame 4j).

    Raises: ConfigError when num_frames is not 1 + a multiple of four.
    """
    if num_frames < 1 or (num_frames - 1) % TEMPORAL_FACTOR:
        raise ConfigError(
            "A clip does not fit the tokenizer",
            expected=f"1 + a multiple of {TEMPORAL_FACTOR} frames",
            got=num_frames,
            next_step=f"use {1 + max(0, num_frames - 1) // TEMPORAL_FACTOR * TEMPORAL_FACTOR} frames",
        )
    return list(range(0, num_frames, TEMPORAL_FACTOR))


def control_frames(num_frames: int, per_latent_frame: int = 1) -> list[int]:
    """RGB frames whose controls the latent frames take, latest first: for latent frame j, frame 4 j and as many before it
    as are wanted. With four of them nothing that happens between two latent frames is left out; latent frame 0, before
    which nothing happened, repeats frame 0.

    Raises: ConfigError when num_frames is not 1 + a multiple of four.
    """
    return [max(0, frame - back) for frame in latent_frame_indices(num_frames) for back in range(per_latent_frame)]


def stack_controls(
    maps: Float[Tensor, "b v c frames h w"], per_latent_frame: int
) -> Float[Tensor, "b v channels t h w"]:
    """Channels of :func:`control_frames`, those of one latent frame stacked: the first ones are of frame 4 j."""
    return rearrange(maps, "b v c (t k) h w -> b v (k c) t h w", k=per_latent_frame)


def grid_sigma(grid_size: tuple[int, int], sigma_px_ref: float = SIGMA_PX_REFERENCE) -> tuple[float, float]:
    """(sigma_rows, sigma_columns) in grid cells."""
    return sigma_px_ref * grid_size[0] / REFERENCE_CANVAS[0], sigma_px_ref * grid_size[1] / REFERENCE_CANVAS[1]


def render_action_maps(
    tracks: TrackBatch,
    image_size: tuple[int, int],
    grid_size: tuple[int, int],
    sigma_px_ref: float = SIGMA_PX_REFERENCE,
    dtype: torch.dtype = torch.float32,
) -> Float[Tensor, "b v 9 t h w"]:
    """Render the maps of every frame of the batch; the arms are added, beyond 1 where they overlap.

    A sample that is not valid leaves exact zeros whatever it holds. A valid one near the border keeps the part of its
    Gaussian that lies inside. Float32 maps equal the equation to 1e-6 (for values up to 8: it is their rounding),
    float64 ones to 1e-12.

    The Gaussian is a product of a row and a column profile, so the cost is that of one small matrix product per frame
    and view. Differentiable in uv, depth, rot6d and gripper; runs on the device of the tracks. The profiles are
    computed in float64 (they are small), the products in `dtype`.

    Args:
        image_size: (height, width) to which uv belongs.
        grid_size: (rows, columns) of the latent.

    Raises: ConfigError for an empty grid or sigma that is not positive.
    """
    if min(*grid_size, *image_size) < 1 or sigma_px_ref <= 0:
        raise ConfigError(
            "Cannot render action maps",
            expected="positive sizes and sigma",
            got=f"image {image_size}, grid {grid_size}, sigma {sigma_px_ref}",
        )
    sigma_rows, sigma_columns = grid_sigma(grid_size, sigma_px_ref)
    uv = torch.where(tracks.valid[..., None], tracks.uv, torch.zeros_like(tracks.uv)).double()
    columns = _profile((uv[..., 0] + 0.5) * (grid_size[1] / image_size[1]) - 0.5, grid_size[1], sigma_columns)
    rows = _profile((uv[..., 1] + 0.5) * (grid_size[0] / image_size[0]) - 0.5, grid_size[0], sigma_rows)
    values = torch.cat(
        [torch.ones_like(tracks.depth)[..., None], tracks.depth[..., None], tracks.rot6d, tracks.gripper[..., None]],
        dim=-1,
    )
    # An invalid sample may hold anything, NaN included: where, not a product with zero.
    values = torch.where(tracks.valid[..., None], values, torch.zeros_like(values)).to(dtype)
    weighted_rows = torch.einsum("btvac,btvah->btvcha", values, rows.to(dtype))
    clips, _, views, arms = tracks.depth.shape
    maps = torch.bmm(
        rearrange(weighted_rows, "b t v c h a -> (b t v) (c h) a", a=arms),
        rearrange(columns.to(dtype), "b t v a w -> (b t v) a w"),
    )
    return rearrange(maps, "(b t v) (c h) w -> b v c t h w", b=clips, v=views, c=NUM_CHANNELS)


@dataclass(frozen=True)
class ControlDrawing:
    """Controls as a model takes them: action maps, control vectors, or in each view of a clip one of the two.

    Channels of a control frame: the nine of the maps, then the vector (the same in every cell) and 1 where it is given. A
    view whose camera is not known takes the vector. Zeros are no controls.

    Attributes:
        grid_size: (rows, columns) of the latent.
        sigma_px_ref: width of the Gaussian; None: a model without maps.
        native_size: of the vectors; None: a model without vectors.
        frames: control frames that a latent frame takes.
    """

    grid_size: tuple[int, int]
    sigma_px_ref: float | None
    native_size: int | None = None
    frames: int = 1

    def draw(
        self, tracks: TrackBatch, image_size: tuple[int, int], by_vector: Bool[Tensor, "b v"] | None = None
    ) -> Float[Tensor, "b v channels t h w"]:
        """Controls of the latent frames whose `control_frames` the tracks hold.

        Args:
            by_vector: views that take the vector though their camera is known, of a model that takes vectors.
        """
        parts: list[Tensor] = []
        vector = torch.zeros_like(tracks.valid.any(dim=-1)) if tracks.camera is None else ~tracks.camera
        if by_vector is not None and self.native_size is not None:
            vector = vector | by_vector[:, None]
        if self.sigma_px_ref is not None:
            drawn = replace(tracks, valid=tracks.valid & ~vector[..., None])
            parts.append(render_action_maps(drawn, image_size, self.grid_size, self.sigma_px_ref))
        if self.native_size is not None and tracks.native is not None:
            given = torch.ones_like(vector) if self.sigma_px_ref is None else vector
            numbers = torch.cat((tracks.native, torch.ones_like(tracks.native[..., :1])), dim=-1)
            rows, columns = (1, 1) if self.sigma_px_ref is None else self.grid_size
            shown = repeat(numbers, "b t c -> b v c t h w", v=given.shape[2], h=rows, w=columns)
            parts.append(shown * rearrange(given, "b t v -> b v 1 t 1 1"))
        return stack_controls(parts[0] if len(parts) == 1 else torch.cat(parts, dim=2), self.frames)


def _profile(centre: Float[Tensor, "*b"], size: int, sigma: float) -> Float[Tensor, "*b size"]:
    """exp(-(x - centre)^2 / (2 sigma^2)) at the cell centres x = 0 .. size - 1."""
    cells = torch.arange(size, dtype=centre.dtype, device=centre.device)
    return torch.exp(-0.5 * ((cells - centre[..., None]) / sigma) ** 2)
