"""What a checkpoint was trained with and all who use it must keep: the meaning of its controls, and its causal blocks.

Both are saved in ``checkpoint.json`` and read from there alone. No field has a default: a checkpoint that lacks one is
refused by the field's name.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import TYPE_CHECKING, Literal, Self

from pydantic import Field, field_validator

from worldline_core.actions.actions_config import REFERENCE_CANVAS, WristProjection
from worldline_core.config import StrictModel
from worldline_core.errors import CheckpointError

if TYPE_CHECKING:
    from torch import Tensor

    from worldline_core.actions.episode_tracks import ActionTracks
    from worldline_core.model.block_causal_attention import KVCache

NATIVE_VECTORS = "none: native control vectors, zero-padded"
"""In place of maps: what drives a model with FiLM. Their layout is that of the embodiment's state."""
FULL_STEPS = 35
"""Euler steps of the whole-clip sampler, at even noise levels."""
CAUSAL_SHIFT = 5.0
CAUSAL_SIGMAS = (1.0, 15 / 16, 5 / 6, 5 / 8, 0.0)
"""Nodes of the paper's four-step causal sampler: shift 5 on 1, 3/4, 1/2, 1/4, 0."""


OWN_FRAME = "latent frame 0 takes frame 0, latent frame j takes frame 4 j"
INTERVAL = "latent frame 0 takes frame 0, latent frame j takes frames 4 j, 4 j - 1, 4 j - 2, 4 j - 3"
TEMPORAL = {1: OWN_FRAME, 4: INTERVAL}
"""Which controls a latent frame takes, by the number of control frames (``WorldModelConfig.action_frames``)."""


class ActionContract(StrictModel):
    """What the action maps mean; a model understands no other maps than those it was trained with.

    Attributes:
        controls: what is projected: commands, measured joints, or recorded tool poses.
        maps, depth_unit, rotation, gripper, temporal, reference_canvas: conventions of this version of the maps.
        sigma_px_ref: width of the Gaussian, pixels on the reference canvas (H, W).
        wrist_projection: into each frame's wrist camera, or into that of the clip's first frame.
        fps: control frames per second of the recordings.
        grid_size: (rows, columns) of the latents and of the maps.
        tokenizer: fingerprint of the encoder that the latents come from.
    """

    controls: Literal["action", "state", "ee_pose"]
    maps: Literal["[h, d h, r1 h .. r6 h, g h], arms added", "none: native control vectors, zero-padded"]
    depth_unit: Literal["m"]
    rotation: Literal["rot6d, end effector in the camera frame"]
    gripper: Literal["0 closed, 1 open"]
    temporal: Literal[
        "latent frame 0 takes frame 0, latent frame j takes frame 4 j",
        "latent frame 0 takes frame 0, latent frame j takes frames 4 j, 4 j - 1, 4 j - 2, 4 j - 3",
    ]
    reference_canvas: tuple[Literal[384], Literal[512]]
    sigma_px_ref: float = Field(gt=0)
    wrist_projection: WristProjection
    fps: float = Field(gt=0)
    grid_size: tuple[int, int]
    tokenizer: str = Field(min_length=1)

    @classmethod
    def of_these_maps(cls, **values: object) -> Self:
        """With the conventions of the maps that this version draws, and ``values`` for the other fields."""
        conventions = {
            "maps": "[h, d h, r1 h .. r6 h, g h], arms added",
            "depth_unit": "m",
            "rotation": "rot6d, end effector in the camera frame",
            "gripper": "0 closed, 1 open",
            "temporal": OWN_FRAME,
            "reference_canvas": REFERENCE_CANVAS,
        }
        return cls.model_validate(conventions | values)

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
        self.require(where=tracks.root, sigma_px_ref=tracks.sigma_px_ref)
        for episode_id in episode_ids:
            if episode_id in tracks:
                self.require(where=f"{tracks.root}, episode {episode_id}", controls=tracks.controls(episode_id))


class TrainedClips(StrictModel):
    """What the clips of a training showed, where it was less or more than all of the model's views at every frame.

    Attributes:
        views: that were trained, in the order of the model's slots; the first one is in every clip.
        strides: recorded frames from one frame of a clip to the next.
    """

    views: tuple[str, ...] = Field(min_length=1)
    strides: tuple[int, ...] = Field(min_length=1)


class CausalSpec(StrictModel):
    """Blocks of a block-causal model: the same in training and in a rollout.

    A block sees the sink and the recent blocks before it at positions counted from the start of that window, whether its
    history lies in a cache (:meth:`new_cache`) or beside it in one pass (``WorldModel.forward_teacher_forcing``).

    Attributes:
        block_size: latent frames per block.
        sink_blocks: finished blocks that stay visible from the start (the observed latent frame is block 0).
        recent_blocks: most recent finished blocks that stay visible besides.
        sigmas: noise levels at which a block's Euler steps start, 0 at the end.
    """

    block_size: int = Field(ge=1)
    sink_blocks: int = Field(ge=1)
    recent_blocks: int = Field(ge=0)
    sigmas: tuple[float, ...] = Field(min_length=2)

    @field_validator("sigmas")
    @classmethod
    def _falling(cls, sigmas: tuple[float, ...]) -> tuple[float, ...]:
        if sigmas[0] > 1 or sigmas[-1] != 0 or any(later >= earlier for earlier, later in itertools.pairwise(sigmas)):
            raise ValueError(f"noise levels must fall from at most 1 to 0, not {list(sigmas)}")
        return sigmas

    @property
    def steps(self) -> int:
        """Euler steps per block."""
        return len(self.sigmas) - 1

    def new_cache(self, fps: Tensor | None = None) -> KVCache:
        """An empty cache with this window, for clips of ``fps`` frames per second ``(b)``."""
        from worldline_core.model.block_causal_attention import KVCache

        return KVCache(self.sink_blocks, self.recent_blocks, fps)
