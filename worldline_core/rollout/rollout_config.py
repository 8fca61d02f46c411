"""Configurations of the rollout steps and of the import of other simulators' videos; imports no torch."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Self, cast

from pydantic import BeforeValidator, Field, field_validator, model_validator

from worldline_core.actions.actions_config import TEMPORAL_FACTOR
from worldline_core.config import ImageSize, StrictModel
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.model.world_model_config import FULL_STEPS, TextConfig
from worldline_core.policies.openpi import PolicyConfig
from worldline_core.processor import bfloat16_by_default

Controls = Literal["true", "zero", "shuffled", "mirrored", "delayed"]
"""The episode's own controls, none, those of another episode, or its own changed in a known way
(`actions.changed_controls`)."""


class _ModelSampler(StrictModel):
    """A sampler of a model of ours.

    Attributes:
        decoder: folder of a small decoder that train_tokenizer made for the model's tokenizer; it decodes instead of the
            tokenizer's own decoder, with a fraction of the operations.
    """

    decoder: Path | None = None


class FullClipConfig(_ModelSampler):
    """A Stage II model predicts a clip at once.

    Attributes:
        steps: Euler steps.
        shift: moves the noise levels of the steps towards noise, which helps few steps.
        clip_frames: frames of the longest clip that is predicted at once (1 + 4 k). Longer predictions are chained: each clip
            begins at the last predicted frame of the one before. None: all at once.
    """

    kind: Literal["full_clip"] = "full_clip"
    steps: int = Field(default=FULL_STEPS, ge=1)
    shift: float = Field(default=1.0, gt=0)
    clip_frames: int | None = Field(default=None, ge=5)

    @field_validator("clip_frames")
    @classmethod
    def _whole_latent_frames(cls, frames: int | None) -> int | None:
        if frames is not None and (frames - 1) % TEMPORAL_FACTOR:
            raise ValueError(f"1 + a multiple of {TEMPORAL_FACTOR} frames, not {frames}")
        return frames


class BlockCausalConfig(_ModelSampler):
    """A causal model predicts block by block.

    Attributes:
        steps: Euler steps per block; None: as the model was trained.
    """

    kind: Literal["block_causal"] = "block_causal"
    steps: int | None = Field(default=None, ge=1)


class TextToVideoConfig(_ModelSampler):
    """A base or Stage I model predicts each view from its first image and the instruction.

    Attributes:
        steps, shift: as of :class:`FullClipConfig`.
        text: how instructions become ids; None: as the checkpoint says that it was trained.
    """

    kind: Literal["text_to_video"] = "text_to_video"
    steps: int = Field(default=FULL_STEPS, ge=1)
    shift: float = Field(default=1.0, gt=0)
    text: TextConfig | None = None


class CopyFirstFrameConfig(StrictModel):
    """The baseline without a model: every frame is the observed one."""

    kind: Literal["copy_first_frame"] = "copy_first_frame"


class GeSimConfig(StrictModel):
    """A simulator behind HTTP in the protocol of GE-Sim 2.0.

    Attributes:
        url: of the server, such as http://127.0.0.1:9000.
        image_size: (H, W) of the pictures that it takes and gives.
        timeout_s: for each whole answer.
    """

    kind: Literal["ge_sim"] = "ge_sim"
    url: str = Field(pattern=r"^https?://[^/\s@]+/?$")
    image_size: ImageSize = (384, 512)
    timeout_s: float = Field(default=300.0, gt=0)


def _usual_kind(value: object) -> object:
    return {"kind": "block_causal", **cast("Mapping[str, object]", value)} if isinstance(value, Mapping) else value


Sampler = Annotated[
    FullClipConfig | BlockCausalConfig | TextToVideoConfig | CopyFirstFrameConfig | GeSimConfig,
    Field(discriminator="kind"),
    BeforeValidator(_usual_kind),
]
"""The sampler of a rollout; ``block_causal`` where no ``kind`` is given."""


class RolloutConfig(StrictModel):
    """Selection of episodes, and the sampler that predicts them.

    Attributes:
        method: name of the predictions in scores and reports.
        actions: controls that drive the predictions.
        banks, embodiments: only episodes of these candidate banks, of these robots; None: all.
        views: ``all_present``: the largest set of views that each episode has and that the model was trained on; the model's
            first one is always among them. Or names of views: episodes that lack one of them are left out.
        cameras: false: as if no camera were known, so that a model that also takes control vectors is driven by these alone.
        num_frames: longest prediction; shorter episodes are predicted as far as whole blocks (or latent frames) go.
            ``whole``: every recording to its end; the last block (or clip) keeps the last controls, and its frames after the
            end are cut off.
        stride: predict every ``stride``-th frame; the model must have been trained at this stride.
        bfloat16: compute in mixed precision; false by default on a processor without native bfloat16.
        weights: type of the model's weights in memory, and of those of a Wan autoencoder, which then computes in bfloat16
            too: half the memory, without any copy in float32.
        compile: torch.compile of each layer but its attention, for a GPU.
    """

    method: str = Field(default="worldline", min_length=1)
    sampler: Sampler = BlockCausalConfig()
    actions: Controls = "true"
    seeds: tuple[int, ...] = Field(default=(42,), min_length=1)
    splits: tuple[str, ...] = ("test",)
    banks: tuple[str, ...] | None = None
    embodiments: tuple[str, ...] | None = None
    max_episodes_per_embodiment: int | None = Field(default=None, ge=1)
    views: Literal["all_present"] | tuple[str, ...] = "all_present"
    cameras: bool = True
    num_frames: Annotated[int, Field(ge=5)] | Literal["whole"] = 33
    stride: int = Field(default=1, ge=1)
    batch_size: int = Field(default=8, ge=1)
    crf: int = Field(default=8, ge=0, le=51)
    weights: Literal["float32", "bfloat16"] = "float32"
    compile: bool = False
    device: str = "cpu"
    bfloat16: bool = Field(default_factory=bfloat16_by_default)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        kind = self.sampler.kind
        if len(set(self.seeds)) != len(self.seeds):
            raise ValueError(f"seeds repeat: {self.seeds}")
        if self.weights == "bfloat16" and not self.bfloat16:
            raise ValueError("weights: bfloat16 are computed with in bfloat16; set bfloat16, or hold them in float32")
        if kind in ("text_to_video", "ge_sim") and self.actions != "true":
            raise ValueError(f"actions: {kind} cannot be driven by {self.actions} ones; leave them out")
        if kind == "ge_sim" and (self.views != "all_present" or len(self.seeds) > 1):
            raise ValueError(
                "ge_sim predicts three views and its protocol has no seeds: leave views out, name one seed"
            )
        return self

    def weights_read(self) -> Mapping[str, Path | None]:
        """Folders whose content counts in the cache key."""
        text = self.sampler.text if isinstance(self.sampler, TextToVideoConfig) else None
        decoder = self.sampler.decoder if isinstance(self.sampler, _ModelSampler) else None
        return ({} if text is None else text.files_read()) | ({} if decoder is None else {"decoder": decoder})


class PolicyRolloutConfig(StrictModel):
    """A policy that drives the simulator from recorded first frames on.

    Attributes:
        method: name of the predictions. The cache knows a policy by its address alone: name each one.
        down_sample: take every so-many-th of the policy's actions, which come at its own rate.
        length_scale: frames of a video for each ``down_sample``-th frame of the recording.
        splits: recordings that are starts.
        steps: Euler steps of the model; None: as it was trained.
    """

    method: str = Field(min_length=1)
    policy: PolicyConfig
    down_sample: int = Field(default=1, ge=1)
    length_scale: float = Field(default=1.2, gt=0)
    splits: tuple[str, ...] = ("test",)
    seed: int = Field(default=42, ge=0)
    steps: int | None = Field(default=None, ge=1)
    crf: int = Field(default=8, ge=0, le=51)
    device: str = "cpu"
    bfloat16: bool = Field(default_factory=bfloat16_by_default)


NAME_FIELD = re.compile(r"\{(\w+)\}|(\*)")
"""A field of a name template, or ``*`` for anything."""


@dataclass(frozen=True)
class VideoLayout:
    """Layout in which a benchmark or another simulator writes its videos of one view.

    Attributes:
        name, episode_id: as of :class:`ImportRolloutsConfig`, where it says nothing else.
        size: the least (H, W), and the proportions, of their pictures; None: any.
        fps: their rate; None: any.
        frames: how many each has; None: any; ``whole``: as many as its recording.
    """

    name: str
    episode_id: str
    size: tuple[int, int] | None = None
    fps: float | None = None
    frames: int | Literal["whole"] | None = None


LAYOUTS: Mapping[str, VideoLayout] = {
    # tsinghua-fib-lab/WorldArena, assets/README_submission.md: videos of action-driven models are as long as their trajectories.
    # Names are episode<N>.mp4 or <task>_episode<N>.mp4: video_quality/README.md, embodied_task/worldarena_track2.
    "worldarena": VideoLayout(
        "*episode{episode}.mp4", "worldarena-fixed_scene_task-episode{episode}", (480, 640), 24.0, "whole"
    ),
    # wuzy2115/oscar, README.md ("Run inference") and scripts/run_inference.sh: outputs/<case>.mp4.
    "oscar": VideoLayout("{episode}.mp4", "oscar-{episode}-rgb", (480, 640), None, 81),
    # NVIDIA/cosmos-framework, docs/inference.md ("Outputs"): <sample_name>/vision.mp4. Its page on bimanual inference: the first
    # frame and one for each action (900 actions, 901 frames), at the input's rate and proportions.
    "sim_bimanual": VideoLayout("{episode}/vision.mp4", "{episode}"),
}
"""By name: WorldArena's track 1, OSCAR's cases, Cosmos3-Nano-Sim-Bimanual's samples; each with the source of these facts."""


class ImportRolloutsConfig(StrictModel):
    """Names and content of the videos of a folder, and what may be missing.

    Attributes:
        method: name that the predictions carry in scores and reports.
        layout: of whom the videos are: fills in ``name``, ``episode_id`` and ``views`` where they are not given, and what
            videos are checked for (`LAYOUTS`).
        name: template of a file's path below the folder, with ``{episode}``, ``{view}``, ``{seed}``, and ``*`` for anything.
        views: our view for each of the names that files or tiles use; default: our own names. ``{"": head}``: names say no
            view, all videos are of this one.
        tiles: rows and columns of the views that one video shows side by side; null for a part that is none.
        episode_id: our id of the episode that their names call ``{episode}``.
        splits: every episode of these splits is expected.
        fps: rate that the videos show, where their container says another.
        resize: bring pictures to the recordings' size instead of refusing another one.
        missing, unknown: refuse, or report in ``files.parquet``, expected videos that are not there and files that are none
            of the expected.
    """

    method: str = Field(min_length=1)
    layout: Literal["worldarena", "oscar", "sim_bimanual"] | None = None
    name: str = "{episode}_{view}.mp4"
    views: dict[str, str] | None = None
    tiles: tuple[tuple[str | None, ...], ...] | None = Field(default=None, min_length=1)
    episode_id: str = Field(default="{episode}", pattern=r"^[^{}]*\{episode\}[^{}]*$")
    splits: tuple[str, ...] = ("test",)
    fps: float | None = Field(default=None, gt=0)
    resize: bool = False
    missing: Literal["refuse", "report"] = "refuse"
    unknown: Literal["refuse", "report"] = "refuse"

    @model_validator(mode="before")
    @classmethod
    def _of_a_layout(cls, values: object) -> object:
        if not isinstance(values, Mapping):
            return values
        given = cast("Mapping[str, object]", values)
        layout = LAYOUTS.get(str(given.get("layout")))
        usual = {} if layout is None else {"name": layout.name, "episode_id": layout.episode_id, "views": {"": "head"}}
        return {**usual, **given}

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        fields = {field for field, _ in NAME_FIELD.findall(self.name) if field}
        needed = {"episode"} if self.tiles is not None or list(self.names) == [""] else {"episode", "view"}
        if not needed <= fields <= needed | {"seed"}:
            raise ValueError(f"name: {self.name} has the fields {sorted(fields)}; needed are {sorted(needed)}")
        if self.tiles is not None and (len({len(row) for row in self.tiles}) != 1 or not self.shown):
            raise ValueError("tiles: rows of equal length, with at least one view among them")
        if not set(self.shown) <= set(VIEWS) or len(set(self.shown)) != len(self.shown):
            raise ValueError(f"views and tiles name some of {VIEWS}, each once, not {self.shown}")
        return self

    @property
    def names(self) -> dict[str, str]:
        """Our view by their name of it."""
        return self.views or {view: view for view in VIEWS}

    @property
    def shown(self) -> tuple[str, ...]:
        """Our views that the videos of an episode show."""
        if self.tiles is None:
            return tuple(self.names.values())
        return tuple(self.names.get(tile, tile) for row in self.tiles for tile in row if tile is not None)
