"""Which episodes are predicted, and how; or whose videos are imported as predictions. No torch in here."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from worldline_core.actions.actions_config import TEMPORAL_FACTOR
from worldline_core.config import ImageSize, StrictModel
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.model.world_model_config import TextConfig

Controls = Literal["true", "zero", "shuffled", "mirrored", "delayed"]
"""What drives a prediction: the episode's own controls, none, those of another episode, or its own changed in a known way
(`actions.changed_controls`)."""


class GeSimConfig(StrictModel):
    """A simulator behind HTTP in the protocol of GE-Sim 2.0.

    Attributes:
        url: where it listens, such as http://127.0.0.1:9000.
        image_size: (H, W) of the pictures that it takes and gives.
        timeout_s: for each whole answer.
        tool_offset_m: from the end link of an arm to the tool, along its z.
    """

    url: str = Field(pattern=r"^https?://[^/\s@]+/?$")
    image_size: ImageSize = (384, 512)
    timeout_s: float = Field(default=300.0, gt=0)
    tool_offset_m: float = 0.15


class RolloutConfig(StrictModel):
    """Which episodes are predicted, and how."""

    method: str = Field(default="worldline", min_length=1)
    """Name the predictions carry in scores and reports."""
    sampler: Literal["full_clip", "block_causal", "text_to_video", "copy_first_frame", "ge_sim"] = "block_causal"
    steps: int | None = Field(default=None, ge=1)
    """Euler steps; by default 35 for a whole clip, and per block those the causal model was trained with."""
    # Left out of dumps at its default: rollouts made before it existed keep their key in the store.
    shift: float = Field(default=1.0, gt=0, exclude_if=lambda value: value == 1.0)
    """Full clip: moves the noise levels of the steps towards noise; few steps are worth more there."""
    actions: Controls = "true"
    seeds: tuple[int, ...] = Field(default=(42,), min_length=1)
    splits: tuple[str, ...] = ("test",)
    banks: tuple[str, ...] | None = None
    """Only episodes of these candidate banks."""
    embodiments: tuple[str, ...] | None = None
    max_episodes_per_embodiment: int | None = Field(default=None, ge=1)
    views: Literal["all_present"] | tuple[str, ...] = Field(
        default="all_present", exclude_if=lambda value: value == "all_present"
    )
    """``all_present``: of every episode the views that it has (with their cameras) and the model was trained on, the
    model's first one always. Or the names of views: episodes without one of them are left out."""
    num_frames: Annotated[int, Field(ge=5)] | Literal["whole"] = 33
    """Longest prediction; shorter episodes are predicted as far as whole blocks (or groups) go. ``whole``: every recording
    to its end; the last block (or clip) keeps the last controls, and what it predicts after the end is cut off."""
    clip_frames: int | None = Field(default=None, ge=5, exclude_if=lambda value: value is None)
    """Full clip: frames of the longest clip that is predicted at once (1 + 4 k). Longer predictions are chained: each clip
    begins at the last predicted frame of the one before."""
    stride: int = Field(default=1, ge=1, exclude_if=lambda value: value == 1)
    """Every how many-th frame of the recordings is predicted; the model must have been trained at this stride."""
    batch_size: int = Field(default=8, ge=1)
    sink_blocks: int | None = Field(default=None, ge=1)
    recent_blocks: int | None = Field(default=None, ge=0)
    """Window of the cache; by default the one that the causal model was trained with."""
    crf: int = Field(default=8, ge=0, le=51)
    text: TextConfig | None = Field(default=None, exclude_if=lambda value: value is None)
    """Text to video: how instructions become ids; by default as the checkpoint says that it was trained."""
    server: GeSimConfig | None = Field(default=None, exclude_if=lambda value: value is None)
    """GE-Sim: where it is."""
    bfloat16: bool = True
    # Left out of dumps at its default: rollouts made before it existed keep their key in the store.
    weights: Literal["float32", "bfloat16"] = Field(default="float32", exclude_if=lambda value: value == "float32")
    """How the model's weights are held, and those of a Wan autoencoder, which then computes in bfloat16 too: half the
    memory, and no copy in float32 is ever made."""
    decoder: Path | None = Field(default=None, exclude_if=lambda value: value is None)
    """Folder of a small decoder that train_tokenizer made for the model's tokenizer: it decodes in place of the tokenizer's
    own, which takes many times its operations."""
    device: str = "cpu"
    captured: bool = Field(default=False, exclude_if=lambda value: not value)
    """On a GPU: record the passes of a block (or of a step of a whole clip) once, and replay them as CUDA graphs."""
    timed_blocks: int = Field(default=0, ge=0)
    """Blocks of one long block-causal rollout made to measure what each costs; it changes no prediction."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if len(set(self.seeds)) != len(self.seeds):
            raise ValueError(f"seeds repeat: {self.seeds}")
        if self.weights == "bfloat16" and not self.bfloat16:
            raise ValueError("weights: bfloat16 are computed with in bfloat16; set bfloat16, or hold them in float32")
        if self.captured and (self.sampler not in ("full_clip", "block_causal") or not self.device.startswith("cuda")):
            raise ValueError(
                f"captured needs the sampler full_clip or block_causal on the device cuda, not {self.sampler} on {self.device}: "
                "leave it out there, nothing else changes"
            )
        if self.decoder is not None and self.sampler in ("copy_first_frame", "ge_sim"):
            raise ValueError(f"decoder: the sampler {self.sampler} has no latents to decode; leave it out there")
        if self.timed_blocks and self.sampler != "block_causal":
            raise ValueError(f"timed_blocks needs the sampler block_causal, not {self.sampler}")
        if self.shift != 1.0 and self.sampler not in ("full_clip", "text_to_video"):
            raise ValueError(f"shift needs the sampler full_clip or text_to_video, not {self.sampler}")
        if self.sampler == "text_to_video" and self.actions != "true":
            raise ValueError(f"actions: text_to_video takes none, so {self.actions} ones have no meaning")
        if self.sampler != "text_to_video" and self.text is not None:
            raise ValueError(f"text needs the sampler text_to_video, not {self.sampler}")
        if (self.sampler == "ge_sim") != (self.server is not None):
            raise ValueError(f"server: the sampler ge_sim needs one, and no other; the sampler is {self.sampler}")
        if self.server is not None and (self.actions, self.views, len(self.seeds)) != ("true", "all_present", 1):
            raise ValueError(
                "the sampler ge_sim predicts three views under the recorded actions, and its protocol knows no seeds: leave "
                "views and actions out, and name one seed"
            )
        if self.clip_frames is not None and (self.sampler != "full_clip" or (self.clip_frames - 1) % TEMPORAL_FACTOR):
            raise ValueError(
                f"clip_frames needs the sampler full_clip and 1 + a multiple of {TEMPORAL_FACTOR} frames, not "
                f"{self.sampler} and {self.clip_frames}"
            )
        return self

    def weights_read(self) -> Mapping[str, Path | None]:
        read = {} if self.text is None else self.text.files_read()
        return read if self.decoder is None else {**read, "decoder": self.decoder}


NAME_FIELD = re.compile(r"\{(\w+)\}|(\*)")
"""A field of a name template, or ``*`` for anything."""


class ImportRolloutsConfig(StrictModel):
    """How the videos of a folder are named, what they show, and what may be missing.

    Attributes:
        method: name that the predictions carry in scores and reports.
        name: template of a file's path below the folder, with ``{episode}``, ``{view}``, ``{seed}``, and ``*`` for anything.
        index: file in the folder that lists them instead: rows of path, episode, and perhaps view and seed (CSV with a header,
            or a JSON list of objects).
        views: our view for each of the names that files or tiles use; default: our own names.
        tiles: rows and columns of the views that one video shows side by side; null for a part that is none.
        episode_prefix: what our episode ids have before theirs.
        splits: every episode of these splits is expected.
        fps: rate that the videos show, where their container says another.
        resize: bring pictures to the recordings' size instead of refusing another one.
        num_frames: frames that are kept of longer videos.
        missing, unknown: refuse, or report in ``files.parquet``, expected videos that are not there and files that are none
            of the expected.
    """

    method: str = Field(min_length=1)
    name: str = "{episode}_{view}.mp4"
    index: str | None = None
    views: dict[str, str] | None = None
    tiles: tuple[tuple[str | None, ...], ...] | None = Field(default=None, min_length=1)
    episode_prefix: str = ""
    splits: tuple[str, ...] = ("test",)
    fps: float | None = Field(default=None, gt=0)
    resize: bool = False
    num_frames: int | None = Field(default=None, ge=1)
    missing: Literal["refuse", "report"] = "refuse"
    unknown: Literal["refuse", "report"] = "refuse"
    crf: int = Field(default=0, ge=0, le=51, description="of videos that are written anew: cut, resized or in tiles")

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        fields = {field for field, _ in NAME_FIELD.findall(self.name) if field}
        needed = {"episode"} if self.tiles is not None else {"episode", "view"}
        if self.index is None and not needed <= fields <= needed | {"seed"}:
            raise ValueError(f"name: {self.name} has the fields {sorted(fields)}; needed are {sorted(needed)}")
        if self.tiles is not None and (len({len(row) for row in self.tiles}) != 1 or not self.shown):
            raise ValueError("tiles: rows of equal length, with at least one view among them")
        if not set(self.shown) <= set(VIEWS) or len(set(self.shown)) != len(self.shown):
            raise ValueError(f"views and tiles stand for some of {VIEWS}, each once, not {self.shown}")
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
