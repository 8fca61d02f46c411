"""Shape of a world model: widths, RoPE layout, view slots, and what the network emits."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, Self

from pydantic import Field, model_validator

from worldline_core.config import StrictModel

VIEWS = ("head", "left_wrist", "right_wrist")
ActionConditioning = Literal["maps", "native_film"]


class WorldModelConfig(StrictModel):
    """Hyper-parameters of :class:`~worldline_core.model.world_model.WorldModel`.

    The defaults are the small model that trains on two CPU cores; :func:`cosmos3_nano_config` is the full size.
    """

    latent_channels: int = Field(default=32, ge=1)
    patch_size: int = Field(default=2, ge=1)
    hidden_size: int = Field(default=192, ge=2)
    num_layers: int = Field(default=8, ge=1, le=1024)
    num_heads: int = Field(default=3, ge=1)
    num_kv_heads: int = Field(default=1, ge=1)
    head_dim: int = Field(default=64, ge=2)
    intermediate_size: int = Field(default=576, ge=1)
    rms_norm_eps: float = Field(default=1e-6, gt=0)

    rope_sections: tuple[int, int, int] = (12, 10, 10)
    """Rotary frequencies given to (time, height, width); they add up to ``head_dim / 2``."""
    rope_theta: float = Field(default=100.0, gt=1)
    """Small grids need high frequencies: with 5e6 most of them would not turn over 4 x 6 patches."""
    fps: float | None = Field(default=None, gt=0)
    """When given, temporal positions advance by ``base_fps / fps`` per latent frame (Cosmos3's fps modulation), with the
    rate of each clip itself where it is known. None counts latent frames, whatever the rate."""
    base_fps: float = Field(default=24.0, gt=0)
    temporal_margin: float = Field(default=16.0, ge=0)
    """Gap on the temporal axis between the last text token and the first video token."""

    views: tuple[str, ...] = VIEWS
    view_offsets: tuple[float, ...] = (0.0, 8.0, 20.0)
    """RoPE height coordinate at which each view starts (same order as ``views``)."""
    view_offset_unit: Literal["patch", "pixel"] = "patch"
    """``patch``: added to the patch row as it is. ``pixel``: divided by the pixels a patch covers first."""
    spatial_compression: int = Field(default=8, ge=1)
    """Pixels a latent cell covers; only used to read offsets given in pixels."""
    view_embedding: bool = True
    """A learned, zero-initialised vector per view. Not in Cosmos3 (a pretrained model keeps it off): RoPE tells a token
    where the others are, never where it is itself, which a small model trained from scratch learns slowly."""

    towers: Literal["both", "generation"] = "both"
    vocab_size: int = Field(default=512, ge=1)
    timestep_scale: float = Field(default=0.1, gt=0)
    """The time embedding sees ``1000 * sigma * timestep_scale`` (Cosmos3: 0.001)."""
    action_channels: int = Field(default=9, ge=1)
    """Channels of the map of one control frame; with ``native_film`` the size that control vectors are padded to."""
    # Left out of dumps at their defaults: checkpoints without them stay the same bytes.
    action_frames: Literal[1, 4] = Field(default=1, exclude_if=lambda value: value == 1)
    """Control frames whose maps a latent frame takes: its own (the paper), or all four of its interval."""
    action_conditioning: ActionConditioning = Field(default="maps", exclude_if=lambda value: value == "maps")
    """``maps``: added to the tokens (the method). ``native_film``: control vectors by FiLM (the paper's ablation)."""
    prediction: Literal["velocity", "sample", "first_frame_residual"] = "velocity"
    """What the head emits. ``sample``: the clean latents; the velocity follows as ``(x - x0) / sigma``.
    ``first_frame_residual``: the clean latents less those of the clean first frame, so that what stands still is free
    (for tokenizers that code a still group like its first frame)."""
    first_frame_std: float | None = Field(default=None, gt=0)
    """With ``first_frame_residual``: the expected deviation s of later latents from the first frame. The head then
    corrects, in units of the remaining uncertainty, the best guess that the noisy latents and the first frame allow
    under z ~ N(z_first, s^2) (the preconditioning of EDM, centred on the first frame). Without it, a small model has to
    copy its noisy input through all layers to do well at low noise."""
    minimum_sigma: float = Field(default=0.05, gt=0, le=1)
    """Lower bound of the divisor where clean latents are emitted."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.head_dim % 2:
            raise ValueError(f"head_dim must be even, got {self.head_dim}")
        if sum(self.rope_sections) != self.head_dim // 2:
            raise ValueError(f"rope_sections {self.rope_sections} must add up to head_dim / 2 = {self.head_dim // 2}")
        if 3 * max(self.rope_sections[1:]) > self.head_dim // 2:
            raise ValueError(f"rope_sections {self.rope_sections}: height and width interleave by three and do not fit")
        if self.num_heads % self.num_kv_heads:
            raise ValueError(f"num_heads {self.num_heads} must be a multiple of num_kv_heads {self.num_kv_heads}")
        if self.action_conditioning == "native_film" and self.action_frames != 1:
            raise ValueError("action_frames: control vectors by FiLM are those of one frame, not of a whole interval")
        if len(self.views) != len(self.view_offsets) or len(set(self.views)) != len(self.views):
            raise ValueError(f"views {self.views} and view_offsets {self.view_offsets} must pair up, without repeats")
        return self

    @property
    def map_channels(self) -> int:
        """Channels of the action maps (or vectors) of one latent frame."""
        return self.action_channels * self.action_frames

    @property
    def native_size(self) -> int | None:
        """Size of the control vectors that a model with FiLM takes; None for a model of action maps."""
        return self.action_channels if self.action_conditioning == "native_film" else None

    @property
    def patch_dim(self) -> int:
        """Values of one video patch (``patch_size**2 * latent_channels``)."""
        return self.patch_size**2 * self.latent_channels


def cosmos3_nano_config(**changes: object) -> WorldModelConfig:
    """The generation and understanding towers of Cosmos3-Nano, three views at 480x640 (paper, implementation)."""
    values: dict[str, object] = {
        "latent_channels": 48,
        "hidden_size": 4096,
        "num_layers": 36,
        "num_heads": 32,
        "num_kv_heads": 8,
        "head_dim": 128,
        "intermediate_size": 12288,
        "rope_sections": (24, 20, 20),
        "rope_theta": 5e6,
        "temporal_margin": 15000.0,
        "view_offsets": (0.0, 480.0, 992.0),
        "spatial_compression": 16,
        "view_embedding": False,
        "vocab_size": 151936,
        "timestep_scale": 0.001,
    }
    return WorldModelConfig.model_validate(values | changes)


class TextConfig(StrictModel):
    """``bytes`` needs nothing; ``cosmos3`` reads the backbone's tokenizer from the local folder ``path``.

    ``max_length``: tokens of a text; longer instructions are cut.
    """

    kind: Literal["bytes", "cosmos3"] = "bytes"
    path: str | None = None
    max_length: int = Field(default=48, ge=2)

    def files_read(self) -> dict[str, Path | None]:
        """The tokenizer's folder, whose content counts in the keys of what reads it."""
        return {"text": None if self.path is None else Path(self.path)}


class ImportBackboneConfig(StrictModel):
    """How the pretrained weights are read and stored."""

    fps: float = Field(default=30.0, gt=0, description="rate of clips that state none: positions advance by 24 / fps")
    dtype: Literal["bfloat16", "float16"] = "bfloat16"
    changes: dict[str, Any] = Field(default={}, description="fields of the model's config to set besides (view slots)")
