"""What a LeRobot dataset does not say about itself and the user therefore declares."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from worldline_core.data.curation.checks import TRAINING_SPLITS
from worldline_core.data.sources.base import ForeignSourceConfig, GripperRange
from worldline_core.data.sources.lerobot_columns import ArmColumns


class LeRobotSourceConfig(ForeignSourceConfig):
    """A LeRobotDataset, or with `collection` every one below a folder.

    Either `arms` says which columns are whose joints and gripper, or the whole of `observation.state` and `action` is
    taken, with `grippers` naming the columns that are no joints. An episode of a dataset has the dataset's scene: where a
    dataset has several, give each its own source and `include`.
    """

    kind: Literal["lerobot_v21", "lerobot_v3"]
    embodiment: str
    angle_unit: Literal["rad", "deg"] = Field(description="unit of the joint columns")
    views: dict[str, str] = Field(description="video key of the dataset -> view, for example {...cam_high: head}")
    grippers: dict[str, GripperRange] = Field(
        default={}, description="state column -> its readings when closed and open; without `arms`"
    )
    arms: tuple[ArmColumns, ...] | None = Field(
        default=None, min_length=1, description="left, right: columns of joints and grippers; null: the whole state"
    )
    collection: bool = Field(default=False, description="read every dataset below the folder")
    calibration: str | None = Field(
        default=None,
        description="file in the dataset's folder with K and poses of the views (docs/sources.md); a name with "
        "{episode_index:06d} is a file an episode",
    )
    task_column: str = Field(default="task_index", description="column of indices into the dataset's tasks")
    task_separator: str | None = Field(
        default=None, min_length=1, description="of texts in several languages the part after the last one is taken"
    )
    success_column: str | None = Field(default=None, description="column of truth values: the episode's outcome")
    evaluation_only: bool = Field(
        default=False, description="refuse the splits train and validation; DROID is always refused them"
    )

    @model_validator(mode="after")
    def _consistent(self) -> LeRobotSourceConfig:
        if self.evaluation_only and self.split in TRAINING_SPLITS:
            raise ValueError(
                f"these recordings are for evaluation only: split {self.split} is refused, use test or ood_test"
            )
        if self.arms is not None and self.grippers:
            raise ValueError("give arms (which name their grippers) or grippers, not both")
        if len(set(self.views.values())) != len(self.views):
            raise ValueError("two video keys are given the same view")
        return self
