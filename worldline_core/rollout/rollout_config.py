"""Which episodes are predicted, and how."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from worldline_core.actions.actions_config import TEMPORAL_FACTOR
from worldline_core.config import StrictModel
from worldline_core.model.world_model_config import TextConfig

Controls = Literal["true", "zero", "shuffled"]
"""Whose controls drive a prediction: the episode's own, none, or those of another episode."""


class RolloutConfig(StrictModel):
    """Which episodes are predicted, and how."""

    method: str = Field(default="worldline", min_length=1)
    """Name the predictions carry in scores and reports."""
    sampler: Literal["full_clip", "block_causal", "text_to_video", "copy_first_frame"] = "block_causal"
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
    bfloat16: bool = True
    device: str = "cpu"
    timed_blocks: int = Field(default=0, ge=0)
    """Blocks of one long block-causal rollout made to measure what each costs; it changes no prediction."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if len(set(self.seeds)) != len(self.seeds):
            raise ValueError(f"seeds repeat: {self.seeds}")
        if self.timed_blocks and self.sampler != "block_causal":
            raise ValueError(f"timed_blocks needs the sampler block_causal, not {self.sampler}")
        if self.shift != 1.0 and self.sampler not in ("full_clip", "text_to_video"):
            raise ValueError(f"shift needs the sampler full_clip or text_to_video, not {self.sampler}")
        if self.sampler == "text_to_video" and self.actions != "true":
            raise ValueError(f"actions: text_to_video takes none, so {self.actions} ones have no meaning")
        if self.sampler != "text_to_video" and self.text is not None:
            raise ValueError(f"text needs the sampler text_to_video, not {self.sampler}")
        if self.clip_frames is not None and (self.sampler != "full_clip" or (self.clip_frames - 1) % TEMPORAL_FACTOR):
            raise ValueError(
                f"clip_frames needs the sampler full_clip and 1 + a multiple of {TEMPORAL_FACTOR} frames, not "
                f"{self.sampler} and {self.clip_frames}"
            )
        return self
