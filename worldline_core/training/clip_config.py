"""Settings of clips: which are drawn, and how they are read (cached latents, or frames encoded during training). Without torch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BeforeValidator, ByteSize, Field, model_validator

from worldline_core.actions.actions_config import TEMPORAL_FACTOR
from worldline_core.config import ImageSize, StrictModel

JOINT, SUBSET, PRIMARY = "joint", "subset", "primary"
"""In place of a view's name: all views of the model together; some of an episode's views, the first one among them (view dropout);
the task-facing view of each episode (Stage I)."""


def view_subsets(views: Sequence[str]) -> list[tuple[str, ...]]:
    """Proper subsets of some views that hold the first of them; of a single view itself."""
    first, *others = views
    chosen = (rest for count in range(max(len(others), 1)) for rest in combinations(others, count))
    return [(first, *rest) for rest in chosen]


def _coded(frames: int) -> int:
    if frames < 1 or (frames - 1) % TEMPORAL_FACTOR:
        raise ValueError(f"{frames} frames: a causal tokenizer codes clips of 4 k + 1")
    return frames


ClipFrames = Annotated[int, AfterValidator(_coded)]


def _expand_range(value: Any) -> Any:
    if not isinstance(value, Mapping):
        return value
    if set(value) != {"from", "to"} or not all(isinstance(number, int) for number in value.values()):
        raise ValueError("a range of clip lengths has the whole numbers `from` and `to`")
    return tuple(range(value["from"], value["to"] + 1, TEMPORAL_FACTOR))


class ClipSampling(StrictModel):
    """Sampling of clips.

    ``lengths``: clip lengths in video frames (4 k + 1), equally likely; a list, or ``{from: 33, to: 129}`` for every
    such length between. ``strides``: temporal strides.
    ``source_weights``: weight of an episode by its source (default 1).
    ``view_weights``: None trains all views of an episode jointly (Stage II); otherwise what a step trains on is drawn by these
    weights: "joint" (all views), "subset" (some of them, the first among them: such sets can then be predicted, too), the
    name of a view, or "primary" (each episode's own task-facing view; Stage I).
    ``single_view_factor``: multiplies the batch of steps on one view, which cost a fraction of joint ones.
    """

    lengths: Annotated[tuple[ClipFrames, ...], BeforeValidator(_expand_range)] = Field(default=(33,), min_length=1)
    strides: tuple[int, ...] = Field(default=(1,), min_length=1)
    source_weights: dict[str, float] = Field(default_factory=dict)
    view_weights: dict[str, float] | None = None
    single_view_factor: int = Field(default=1, ge=1)

    def shown_views(self, views: Sequence[str]) -> tuple[str, ...]:
        """Those of some views that clips may show."""
        drawn = {name for name, weight in (self.view_weights or {JOINT: 1.0}).items() if weight > 0}
        return tuple(view for view in views if drawn & {JOINT, SUBSET, view})


class LatentInput(StrictModel):
    """Latents cached by encode_latents.

    ``workers``: processes that read two micro-batches ahead each; 0 reads in the training process when a batch is needed.
    ``resident``: keep latents, action tracks and shares of things of all episodes on the training device, for sets that fit
    there: a small model then never waits for reading.
    """

    kind: Literal["latents"] = "latents"
    workers: int = Field(default=0, ge=0)
    resident: bool = False

    @model_validator(mode="after")
    def _resident_needs_no_workers(self) -> Self:
        if self.resident and self.workers:
            raise ValueError("resident: nothing is read during training, so leave workers out")
        return self


class FrameInput(StrictModel):
    """Frames straight from the EpisodeSet, which the tokenizer encodes during training.

    ``image_size``: (H, W) that frames are resized to, as in encode_latents. ``start_step``: clips start at multiples of it.
    ``workers``: as for latents.
    """

    kind: Literal["frames"] = "frames"
    workers: int = Field(default=0, ge=0)
    image_size: ImageSize = (64, 96)
    start_step: int = Field(default=1, ge=1)


ClipInput = Annotated[LatentInput | FrameInput, Field(discriminator="kind")]


class EncodeLatentsConfig(StrictModel):
    """Settings of cached latents.

    ``start_step``: clips may start at multiples of it. ``strides``: temporal strides that training may ask for.
    ``views``: those that are encoded of an episode that has them, beside its task-facing one.
    ``clip_frames``: most frames of a clip that training may ask for; None: all that follow its start. A tokenizer with a long memory
    stores each start's clip by itself, so this decides how much is stored.
    ``disk``: most bytes that the latents may take: ``start_step`` is doubled until they fit.
    """

    splits: tuple[str, ...] | None = None
    views: tuple[str, ...] = ("head", "left_wrist", "right_wrist")
    image_size: ImageSize = (64, 96)
    start_step: int = Field(default=4, ge=1)
    strides: tuple[int, ...] = Field(default=(1,), min_length=1)
    clip_frames: ClipFrames | None = Field(default=None, ge=1 + TEMPORAL_FACTOR)
    disk: ByteSize | None = Field(default=None, gt=0)
    episodes_per_shard: int = Field(default=16, ge=1)
    device: str = "cpu"
