"""Where a stage's clips come from and how they are read: configuration."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from worldline_core.config.base import StrictModel
from worldline_core.data.video.frame_decoder import DecoderChoice


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
    image_size: tuple[int, int] = (64, 96)
    start_step: int = Field(default=1, ge=1)
    decoder: DecoderChoice = "auto"
    open_files: int = Field(default=16, ge=1)


ClipInput = Annotated[LatentInput | FrameInput, Field(discriminator="kind")]
