"""What clips are cut, drawn and read: of latents that are cached, or of frames on the way. No torch in here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from worldline_core.actions.actions_config import TEMPORAL_FACTOR
from worldline_core.config import ImageSize, StrictModel
from worldline_core.data.video.frame_decoder import DecoderChoice

JOINT = "joint"
"""In place of a view's name: all views of the model together."""


def _lengths(value: Any) -> Any:
    """``{from: 33, to: 129}`` (``step``: 4 unless given) as the lengths that it means."""
    if not isinstance(value, Mapping):
        return value
    if not {"from", "to"} <= set(value) <= {"from", "to", "step"} or not all(
        isinstance(v, int) for v in value.values()
    ):
        raise ValueError("a range of clip lengths has the whole numbers `from`, `to` and perhaps `step`")
    step = value.get("step", TEMPORAL_FACTOR)
    if step < 1 or step % TEMPORAL_FACTOR or value["to"] < value["from"]:
        raise ValueError(f"a range of clip lengths rises in steps of a multiple of {TEMPORAL_FACTOR} frames")
    return tuple(range(value["from"], value["to"] + 1, step))


class ClipSampling(StrictModel):
    """How clips are drawn.

    ``lengths``: clip lengths in video frames (4 k + 1), drawn with ``length_weights`` (default: equal); a list, or
    ``{from: 33, to: 129}`` for all of them. ``strides``: temporal strides.
    ``source_weights``: weight of an episode by its source (default 1).
    ``view_weights``: None trains all views jointly (Stage II); otherwise what a step trains on is drawn by these
    weights: the name of a view, "primary" (each episode's own task-facing view; Stage I), or "joint" (all views).
    Steps on one view cost a fraction of joint ones and teach most of what controls look like: where compute is short,
    a mixture learns faster. ``single_view_factor`` multiplies the batch of such steps.
    ``order``: "weighted" draws without end by the weights; "epochs" takes every clip (each length and stride at every
    ``hop``-th frame of every episode) once per epoch, and allows no weights of lengths and sources.
    ``hop``: frames between the starts of neighbouring clips of an epoch (default: the smallest that the source has).
    ``optional_views``: views that an episode may lack. A batch holds clips that have the same of them, so that nothing is
    padded and a clip is trained as it would be alone.
    """

    lengths: Annotated[tuple[int, ...], BeforeValidator(_lengths)] = Field(default=(33,), min_length=1)
    length_weights: tuple[float, ...] | None = None
    strides: tuple[int, ...] = Field(default=(1,), min_length=1)
    source_weights: dict[str, float] = Field(default_factory=dict)
    view_weights: dict[str, float] | None = None
    single_view_factor: int = Field(default=1, ge=1)
    # Left out of dumps at their defaults: what was made before they existed keeps its key in the store.
    order: Literal["weighted", "epochs"] = Field(default="weighted", exclude_if=lambda value: value == "weighted")
    hop: int | None = Field(default=None, ge=1, exclude_if=lambda value: value is None)
    optional_views: tuple[str, ...] = Field(default=(), exclude_if=lambda value: not value)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        odd = [length for length in self.lengths if length < 1 or (length - 1) % TEMPORAL_FACTOR]
        if odd:
            raise ValueError(f"lengths {odd}: a causal tokenizer codes clips of 4 k + 1 frames")
        if self.length_weights is not None and len(self.length_weights) != len(self.lengths):
            raise ValueError(f"length_weights: every one of the {len(self.lengths)} clip lengths needs one weight")
        if self.order == "weighted" and self.hop is not None:
            raise ValueError("hop: only epochs have one; set order to epochs, or leave it out")
        weighted = self.length_weights is not None or self.source_weights or self.single_view_factor != 1
        if self.order == "epochs" and weighted:
            raise ValueError(
                "order: epochs take every clip once, so they allow neither length_weights nor source_weights nor a "
                "single_view_factor; take order weighted, or leave them out"
            )
        return self

    def absent_views(self, recorded: Sequence[str]) -> tuple[str, ...]:
        """Optional views that a recording lacks."""
        return tuple(view for view in self.optional_views if view not in recorded)

    def needed_views(self, views: Sequence[str]) -> tuple[str, ...]:
        """Views, of a model's, that every episode must have."""
        drawn = (
            None if self.view_weights is None else {name for name, weight in self.view_weights.items() if weight > 0}
        )
        shown = [view for view in views if drawn is None or JOINT in drawn or view in drawn]
        return tuple(view for view in shown if view not in self.optional_views)


class ReadingConfig(StrictModel):
    """How clips are read, whatever they are.

    ``workers``: processes that read ahead, each ``prefetch`` micro-batches at most; 0 reads in the training process when
    a batch is needed. What is trained on does not depend on either.
    ``on_unreadable``: "raise" stops at the first clip that cannot be read; "skip" takes another clip in its place, names
    it in the log and in ``run/skipped_clips-*.jsonl``, counts it, and stops after ``max_skipped``.
    """

    workers: int = Field(default=0, ge=0)
    prefetch: int = Field(default=2, ge=1)
    on_unreadable: Literal["raise", "skip"] = "raise"
    max_skipped: int = Field(default=100, ge=1)


class LatentInput(ReadingConfig):
    """Latents that encode_latents cached."""

    kind: Literal["latents"] = "latents"


class FrameInput(ReadingConfig):
    """Frames straight from the EpisodeSet; the tokenizer encodes them during training.

    ``image_size``: (H, W) that frames are resized to, as in encode_latents. ``start_step``: clips start at multiples of
    it. ``decoder``: "auto" is torchcodec where it loads, else PyAV. ``open_files``: video files that a process keeps open.
    """

    kind: Literal["frames"] = "frames"
    image_size: ImageSize = (64, 96)
    start_step: int = Field(default=1, ge=1)
    decoder: DecoderChoice = "auto"
    open_files: int = Field(default=16, ge=1)


ClipInput = Annotated[LatentInput | FrameInput, Field(discriminator="kind")]


class EncodeLatentsConfig(StrictModel):
    """Which latents are cached.

    ``start_step``: clips may start at multiples of it. ``strides``: temporal strides that training may ask for.
    ``primary_alone``: also encode, by their task-facing view alone, episodes that lack some of ``views``: Stage I takes
    them (plain videos have one view), Stage II does not.
    ``optional_views``: of ``views``, those that an episode may lack: its others are encoded.
    ``layout``: "auto" compares both layouts on the first episode and takes ``groups`` only where it is exact.
    """

    splits: tuple[str, ...] | None = None
    views: tuple[str, ...] = ("head", "left_wrist", "right_wrist")
    primary_alone: bool = False
    # Left out of dumps at its default: latents made before it existed keep their key in the store.
    optional_views: tuple[str, ...] = Field(default=(), exclude_if=lambda value: not value)
    image_size: ImageSize = (64, 96)
    start_step: int = Field(default=4, ge=1)
    strides: tuple[int, ...] = Field(default=(1,), min_length=1)
    layout: Literal["auto", "groups", "clips"] = "auto"
    episodes_per_shard: int = Field(default=16, ge=1)
    device: str = "cpu"
