"""What every episode source offers, and what their configurations share."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Protocol

import numpy as np
from pydantic import Field, model_validator

from worldline_core.config.base import StrictModel
from worldline_core.data.conventions import RecordedConventions
from worldline_core.data.curate_checks import TRAINING_SPLITS
from worldline_core.data.episode import Episode, Outcome, Split, TaskFamily
from worldline_core.errors import CalibrationError
from worldline_core.geometry.distortion import Distortion, DistortionModel


@dataclass(frozen=True)
class LoadedEpisode:
    """An episode at the source's own rate and image size.

    Attributes:
        views: views that have images.
        frames: view -> uint8 (episode.num_video_frames, H, W, 3); decodes when called.
        robot_masks: view -> bool (N, H, W), or None where the source has none.
        distortions: lenses of the views whose images are not those of a pinhole; K is then that of the lens.
    """

    episode: Episode
    views: tuple[str, ...]
    frames: Callable[[str], np.ndarray]
    robot_masks: Callable[[str], np.ndarray | None]
    distortions: Mapping[str, Distortion] = field(default_factory=dict)


class EpisodeSource(Protocol):
    """A collection of recordings. `load` raises a DataError for a bad episode; the others are not touched by it."""

    def episode_ids(self) -> list[str]: ...

    def load(self, episode_id: str) -> LoadedEpisode: ...


class SourceConfigBase(StrictModel):
    """Fields of every source."""

    path: Path = Field(description="folder of the recordings")
    name: str | None = Field(default=None, description="name of the source in the index; default: the folder's name")
    include: tuple[str, ...] | None = Field(
        default=None, description="shell patterns of the episode ids to read; null: all"
    )
    conventions: RecordedConventions = Field(
        default=RecordedConventions(),
        description="how these recordings depart from the contract; `worldline calibrate check` finds out",
    )

    @property
    def label(self) -> str:
        return self.name or self.path.name

    def includes(self, episode_id: str) -> bool:
        """Whether the configuration asks for this episode."""
        return self.include is None or any(fnmatchcase(episode_id, pattern) for pattern in self.include)


class ForeignSourceConfig(SourceConfigBase):
    """What foreign recordings do not say about themselves and the user therefore declares."""

    split: Split = Field(default="test", description="never train without saying so")
    scene: str | None = Field(default=None, description="scene of all episodes; default: one scene an episode folder")
    task_family: TaskFamily = "unknown"
    outcome: Outcome = "unknown"


class EvaluationSourceConfig(ForeignSourceConfig):
    """A source that results are compared on, and that therefore never trains or selects a model."""

    @model_validator(mode="after")
    def _not_for_training(self) -> EvaluationSourceConfig:
        if self.split in TRAINING_SPLITS:
            raise ValueError(
                f"these recordings are for evaluation only: split {self.split} is refused, use test or ood_test"
            )
        return self


class LensConfig(StrictModel):
    """A lens that a format has no place for, declared by the user: OpenCV's model and coefficients."""

    model: DistortionModel
    coefficients: tuple[float, ...]

    @model_validator(mode="after")
    def _usable(self) -> LensConfig:
        try:
            _ = self.distortion
        except CalibrationError as error:
            raise ValueError(str(error)) from error
        return self

    @property
    def distortion(self) -> Distortion:
        return Distortion(self.model, self.coefficients)


class GripperRange(StrictModel):
    """Raw gripper readings at the two ends."""

    closed: float
    open: float

    def opening(self, raw: np.ndarray) -> tuple[np.ndarray, int]:
        """Opening in 0 closed .. 1 open, clipped, and how many readings lay outside."""
        value = (np.asarray(raw, dtype=np.float64) - self.closed) / (self.open - self.closed)
        return np.clip(value, 0.0, 1.0), int(np.count_nonzero((value < 0.0) | (value > 1.0)))


def no_masks(view: str) -> None:
    """Robot masks of a source that has none."""
    del view
