"""Shape of a world model, and the contract of a checkpoint: the meaning of its controls, and its causal blocks.

A contract is saved in ``checkpoint.json`` and read from there alone; none of its fields has a default.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self, cast

from pydantic import Discriminator, Field, Tag, field_validator, model_validator

from worldline_core.config import StrictModel
from worldline_core.errors import CheckpointError, DataError

if TYPE_CHECKING:
    from worldline_core.actions.episode_tracks import ActionTracks


VIEWS = ("head", "left_wrist", "right_wrist")
ActionConditioning = Literal["maps", "vectors", "either"]


class WorldModelConfig(StrictModel):
    """Hyper-parameters that every network has: shape, view slots, controls, and what its head predicts."""

    latent_channels: int = Field(default=32, ge=1)
    patch_size: int = Field(default=2, ge=1)
    hidden_size: int = Field(default=192, ge=2)
    num_layers: int = Field(default=8, ge=1, le=1024)
    num_heads: int = Field(default=3, ge=1)
    head_dim: int = Field(default=64, ge=2)
    intermediate_size: int = Field(default=576, ge=1)
    fps: float | None = Field(default=None, gt=0)
    """Rate of the video [1/s]: temporal positions advance by ``base_fps / fps`` per latent frame (Cosmos3's fps modulation).
    A clip of known rate uses its own. None counts latent frames, whatever the rate."""
    base_fps: float = Field(default=24.0, gt=0)

    views: tuple[str, ...] = VIEWS
    view_offsets: tuple[float, ...] = (0.0, 8.0, 20.0)
    """RoPE height coordinate at which each view starts (same order as ``views``)."""
    view_offset_unit: Literal["patch", "pixel"] = "patch"
    """``patch``: added to the patch row as it is. ``pixel``: divided by the pixels a patch covers first."""
    spatial_compression: int = Field(default=8, ge=1)
    """Pixels a latent cell covers; only used to read offsets given in pixels."""
    view_embedding: bool = True
    """A learned, zero-initialised vector per view. Pretrained models have none and keep it off: RoPE tells a token
    where the others are, never where it is itself, which a small model trained from scratch learns slowly."""

    towers: Literal["both", "generation"] = "both"
    """``generation``: the model takes no text, and has no tower for it."""
    action_channels: int = Field(default=9, ge=1)
    """Channels of the map of one control frame."""
    native_size: int | None = Field(default=None, ge=1)
    """Size that the control vector of one control frame is padded to; None: the model takes no vectors."""
    action_frames: Literal[1, 4] = 1
    """Control frames that a latent frame takes: its own (the paper), or all four of its interval."""
    action_conditioning: ActionConditioning = "maps"
    """``maps``: added to the tokens (the method). ``vectors``: by FiLM (the paper's ablation). ``either``: each view of a clip
    takes one of the two."""
    prediction: Literal["velocity", "first_frame_residual"] = "velocity"
    """Output of the head. ``first_frame_residual``: the clean latents less those of the clean first frame, so that still parts are
    free (for tokenizers that code a still group like its first frame)."""
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
        if (self.action_conditioning == "maps") != (self.native_size is None):
            raise ValueError(f"native_size: {self.native_size}, of a model that takes {self.action_conditioning}")
        if len(self.views) != len(self.view_offsets) or len(set(self.views)) != len(self.views):
            raise ValueError(f"views {self.views} and view_offsets {self.view_offsets} must pair up, without repeats")
        return self

    @property
    def takes_maps(self) -> bool:
        """The model has the branch of action maps."""
        return self.action_conditioning != "vectors"

    @property
    def control_channels(self) -> int:
        """Channels of the controls of one latent frame: those of `ControlDrawing`."""
        maps, vectors = self.takes_maps * self.action_channels, 0 if self.native_size is None else self.native_size + 1
        return (maps + vectors) * self.action_frames

    @property
    def patch_dim(self) -> int:
        """Values of one video patch (``patch_size**2 * latent_channels``)."""
        return self.patch_size**2 * self.latent_channels


class MixtureConfig(WorldModelConfig):
    """Hyper-parameters of :class:`~worldline_core.model.mixture.MixtureModel`.

    The defaults are the small model that trains on two CPU cores; :func:`cosmos3_config` has the published ones.
    """

    network: Literal["mixture"] = "mixture"
    num_kv_heads: int = Field(default=1, ge=1)
    rms_norm_eps: float = Field(default=1e-6, gt=0)
    feed_forward: Literal["swiglu", "squared_relu"] = "swiglu"
    """``squared_relu``: without a gate (Cosmos3-Edge)."""
    text_keys: Literal["normalised", "normalised_for_video"] = "normalised"
    """Queries and keys of the text are normalised; or the text reads its keys as they are, and the video reads them normalised
    (Cosmos3-Edge)."""

    rope_sections: tuple[int, int, int] = (12, 10, 10)
    """Rotary frequencies given to (time, height, width); they add up to ``head_dim / 2``."""
    rope_theta: float = Field(default=100.0, gt=1)
    """Small grids need high frequencies: with 5e6 most of them would not turn over 4 x 6 patches."""
    temporal_margin: float = Field(default=16.0, ge=0)
    """Gap on the temporal axis between the last text token and the first video token."""
    vocab_size: int = Field(default=512, ge=1)
    timestep_scale: float = Field(default=0.1, gt=0)
    """The time embedding sees ``1000 * sigma * timestep_scale`` (Cosmos3: 0.001)."""

    @model_validator(mode="after")
    def _heads_fit(self) -> Self:
        if sum(self.rope_sections) != self.head_dim // 2:
            raise ValueError(f"rope_sections {self.rope_sections} must add up to head_dim / 2 = {self.head_dim // 2}")
        if 3 * max(self.rope_sections[1:]) > self.head_dim // 2:
            raise ValueError(f"rope_sections {self.rope_sections}: height and width interleave by three and do not fit")
        if self.num_heads % self.num_kv_heads:
            raise ValueError(f"num_heads {self.num_heads} must be a multiple of num_kv_heads {self.num_kv_heads}")
        return self


class WanConfig(WorldModelConfig):
    """Hyper-parameters of :class:`~worldline_core.model.wan.WanModel`; :func:`wan_config` has the published ones."""

    network: Literal["wan"] = "wan"
    norm_eps: float = Field(default=1e-6, gt=0)
    rope_theta: float = Field(default=10_000.0, gt=1)
    text_size: int = Field(default=4096, ge=1)
    """Values of the embedding of a token of text (umT5)."""
    text_length: int = Field(default=512, ge=1, le=4096)
    """Tokens that every text is filled up to."""
    prompt_length: int = Field(default=0, ge=0)
    """Tokens of the model's own prompt, which it reads where it is given no text; 0: padding alone."""

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.hidden_size != self.num_heads * self.head_dim:
            raise ValueError(
                f"hidden_size must be num_heads * head_dim = {self.num_heads * self.head_dim}, got {self.hidden_size}"
            )
        if self.prompt_length > self.text_length:
            raise ValueError(f"prompt_length {self.prompt_length} must fit text_length {self.text_length}")
        return self


def wan_config(**changes: object) -> WanConfig:
    """Wan2.2-TI2V-5B, three views at 480x640: view slots as for Cosmos3, in pixels, so that rows stay near those it was trained on."""
    published: dict[str, object] = {
        "latent_channels": 48,
        "hidden_size": 3072,
        "num_layers": 30,
        "num_heads": 24,
        "head_dim": 128,
        "intermediate_size": 14336,
        "view_offsets": (0.0, 480.0, 992.0),
        "view_offset_unit": "pixel",
        "spatial_compression": 16,
        "view_embedding": False,
    }
    return WanConfig.model_validate(published | changes)


def _network(values: Any) -> str:
    """The network that values describe; a mixture where they do not say so."""
    named = (
        cast("Mapping[str, Any]", values).get("network")
        if isinstance(values, Mapping)
        else getattr(values, "network", None)
    )
    return "mixture" if named is None else str(named)


NetworkConfig = Annotated[
    Annotated[MixtureConfig, Tag("mixture")] | Annotated[WanConfig, Tag("wan")],
    Discriminator(_network, custom_error_type="network", custom_error_message="network must be mixture or wan"),
]


Cosmos3Size = Literal["nano", "edge"]
_COSMOS3: dict[str, object] = {
    "latent_channels": 48,
    "num_kv_heads": 8,
    "head_dim": 128,
    "rope_sections": (24, 20, 20),
    "temporal_margin": 15000.0,
    "view_offsets": (0.0, 480.0, 992.0),
    "spatial_compression": 16,
    "view_embedding": False,
    "timestep_scale": 0.001,
}
_COSMOS3_SIZES: dict[Cosmos3Size, dict[str, object]] = {
    "nano": {
        "hidden_size": 4096,
        "num_layers": 36,
        "num_heads": 32,
        "intermediate_size": 12288,
        "rope_theta": 5e6,
        "vocab_size": 151936,
    },
    "edge": {
        "hidden_size": 2048,
        "num_layers": 28,
        "num_heads": 16,
        "intermediate_size": 9216,
        "rope_theta": 1e8,
        "vocab_size": 131072,
        "feed_forward": "squared_relu",
        "text_keys": "normalised_for_video",
        "rms_norm_eps": 1e-5,
    },
}


def cosmos3_config(size: Cosmos3Size, **changes: object) -> MixtureConfig:
    """Both towers of Cosmos3-Nano (paper, implementation) or Cosmos3-Edge, three views at 480x640."""
    return MixtureConfig.model_validate(_COSMOS3 | _COSMOS3_SIZES[size] | changes)


class TextConfig(StrictModel):
    """``bytes`` needs nothing; ``cosmos3`` reads the backbone's tokenizer from the local folder ``path``; ``stored`` reads umT5's
    embeddings of the texts from the file ``path``, as ``import_backbone.prompts`` leaves them beside the weights (Wan).

    ``system_prompt``: the chat begins with one, as Cosmos3-Nano's; Cosmos3-Edge was trained without.
    ``max_length``: tokens of a text; longer instructions are cut.
    """

    kind: Literal["bytes", "cosmos3", "stored"] = "bytes"
    path: str | None = None
    system_prompt: bool = True
    max_length: int = Field(default=48, ge=2)

    def files_read(self) -> dict[str, Path | None]:
        """The folder or file read, whose content counts in the keys of what reads it."""
        return {"text": None if self.path is None else Path(self.path)}


class ImportBackboneConfig(StrictModel):
    """Import of pretrained weights: which, their frame rate and the stored type.

    ``prompts``: Wan alone; texts whose umT5 embeddings are stored beside the weights, by the folder's own text encoder. The model
    reads the first one where it is given no text, or padding alone where there is none.
    """

    size: Cosmos3Size | Literal["wan2.2-ti2v-5b"] = "nano"
    revision: str | None = Field(default=None, description="commit of the hub; published weights have been renewed")
    fps: float = Field(
        default=30.0, gt=0, description="rate of clips that state none: Cosmos3's positions advance by 24 / fps"
    )
    dtype: Literal["bfloat16", "float16"] = "bfloat16"
    changes: dict[str, Any] = Field(default={}, description="fields of the model's config to set besides (view slots)")
    prompts: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _prompts_are_read(self) -> Self:
        if self.prompts and self.size != "wan2.2-ti2v-5b":
            raise ValueError(f"prompts: {self.size} reads texts by its own tower; leave them out")
        return self

    @property
    def published(self) -> MixtureConfig | WanConfig:
        """Shape of the model that the import makes of the published weights."""
        if self.size == "wan2.2-ti2v-5b":
            return wan_config(**self.changes)
        return cosmos3_config(self.size, fps=self.fps, **self.changes)


FULL_STEPS = 35
"""Euler steps of the whole-clip sampler, at even noise levels."""
CAUSAL_SHIFT = 5.0
CAUSAL_SIGMAS = (1.0, 15 / 16, 5 / 6, 5 / 8, 0.0)
"""Nodes of the paper's four-step causal sampler: shift 5 on 1, 3/4, 1/2, 1/4, 0."""


class ActionContract(StrictModel):
    """Meaning of the action maps; a model understands no other maps than those it was trained with.

    Of each arm, maps hold ``[h, d h, r1 h .. r6 h, g h]``: the Gaussian h, the depth d [m], the rotation r of the end effector in
    the camera frame (rot6d), and the gripper's opening g (0 closed, 1 open). Arms are added.

    Attributes:
        controls: what is projected: commands, measured joints, or recorded tool poses.
        sigma_px_ref: width of the Gaussian, pixels on the reference canvas (H, W); None: the model takes no maps.
        fps: control frames per second of the recordings.
        grid_size: (rows, columns) of the latents and of the maps.
        tokenizer: fingerprint of the encoder that the latents come from.
    """

    controls: Literal["action", "state", "ee_pose"]
    sigma_px_ref: Annotated[float, Field(gt=0)] | None
    wrist_projection: Literal["current_camera"] = "current_camera"  # as the shipped checkpoints have it
    fps: float = Field(gt=0)
    grid_size: tuple[int, int]
    tokenizer: str = Field(min_length=1)

    def require(self, *, where: object, **found: object) -> None:
        """Refuse data that other maps would be drawn from, naming every field that differs.

        Args:
            where: the data, for the message.
            found: fields of the contract as they are there.

        Raises:
            CheckpointError: a field differs from the one the model was trained with.
        """
        differing = {name: value for name, value in found.items() if getattr(self, name) != value}
        if differing:
            raise CheckpointError(
                "The action contract differs from the one the model was trained with",
                where=f"{where}: {', '.join(differing)}",
                expected={name: getattr(self, name) for name in differing},
                got=differing,
                next_step="make the action tracks and latents as the model's contract says, or use another checkpoint",
            )

    def require_tracks(self, episode_ids: Iterable[str], tracks: ActionTracks) -> None:
        """Refuse action tracks before the first step where maps would be drawn of other controls or at another width.

        Raises:
            CheckpointError: naming the first episode that differs, and the field.
        """
        if self.sigma_px_ref is not None and tracks.drawn:
            self.require(where=tracks.root, sigma_px_ref=tracks.sigma_px_ref)
        for episode_id in episode_ids:
            if episode_id in tracks:
                self.require(where=f"{tracks.root}, episode {episode_id}", controls=tracks.controls(episode_id))


class NativeVectors(StrictModel):
    """Control vectors that a model was trained on.

    Attributes:
        embodiments: robots whose vectors it knows; the columns of another one mean nothing to it.
        share: how often a view with a camera took the vector instead of the map.
    """

    embodiments: tuple[str, ...] = Field(min_length=1)
    share: float = Field(gt=0, le=1)


class TrainedClips(StrictModel):
    """Views and strides of the clips of a training, where these were not all views together at every frame.

    Attributes:
        view_sets: views that clips showed together, each set in the order of the model's slots.
        strides: recorded frames from one frame of a clip to the next.
    """

    view_sets: tuple[Annotated[tuple[str, ...], Field(min_length=1)], ...] = Field(min_length=1)
    strides: tuple[int, ...] = Field(min_length=1)


def match_views(view_sets: Sequence[tuple[str, ...]], views: Iterable[str], where: object = None) -> tuple[str, ...]:
    """Return the one of a model's view sets that holds exactly these views, in the model's order.

    Raises:
        DataError: the model was not trained on these views together.
    """
    names = sorted(views)
    for trained in view_sets:
        if sorted(trained) == names:
            return trained
    raise DataError(
        "The model was not trained on these views together",
        where=where,
        expected=" or ".join(" + ".join(trained) for trained in view_sets),
        got=" + ".join(names) or "no view",
        next_step='give the views of one of these sets, or train on yours (docs/training_input.md, "Sets of views")',
    )


class CausalSpec(StrictModel):
    """Blocks of a block-causal model: the same in training and in a rollout.

    A block sees the sink and the recent blocks before it at positions counted from the start of that window, whether its
    history is in a cache (:meth:`new_cache`) or beside it in one pass (``WorldModel.forward_teacher_forcing``).

    Attributes:
        block_size: latent frames per block.
        sink_blocks: finished blocks that stay visible from the start (the observed latent frame is block 0).
        recent_blocks: most recent finished blocks that stay visible besides.
        anchor_blocks: after so many predicted blocks a rollout begins anew at its own last picture, with an empty cache; None:
            never. What happened then lasts: a model whose window slides off it falls back to the first picture.
        sigmas: noise levels at which a block's Euler steps start, 0 at the end.
    """

    block_size: int = Field(ge=1)
    sink_blocks: int = Field(ge=1)
    recent_blocks: int = Field(ge=0)
    anchor_blocks: int | None = Field(ge=1)
    sigmas: tuple[float, ...] = Field(min_length=2)

    @field_validator("sigmas")
    @classmethod
    def _falling(cls, sigmas: tuple[float, ...]) -> tuple[float, ...]:
        if sigmas[0] > 1 or sigmas[-1] != 0 or any(later >= earlier for earlier, later in itertools.pairwise(sigmas)):
            raise ValueError(f"noise levels must fall from at most 1 to 0, not {list(sigmas)}")
        return sigmas

    @property
    def steps(self) -> int:
        return len(self.sigmas) - 1
