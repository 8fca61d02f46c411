"""Foreign LeRobot datasets, v2.1 and v3.0, without a camera sidecar.

LeRobot states neither the unit of joint angles nor what a gripper reading means, so both are declared in the
configuration. Without calibration such episodes serve action-free training.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from worldline_core.data.episode import Episode
from worldline_core.data.lerobot_v3 import LeRobotV3Dataset
from worldline_core.data.lerobot_v21 import LeRobotV21Dataset
from worldline_core.data.rejection import RejectedInputError
from worldline_core.data.sources.base import ForeignSourceConfig, GripperRange, LoadedEpisode, no_masks
from worldline_core.errors import ConfigError

_RATE_TOLERANCE = 1e-2


class LeRobotSourceConfig(ForeignSourceConfig):
    """A LeRobotDataset and what it does not say about itself."""

    kind: Literal["lerobot_v21", "lerobot_v3"]
    embodiment: str
    angle_unit: Literal["rad", "deg"] = Field(description="unit of the joint columns")
    views: dict[str, str] = Field(description="video key of the dataset -> view, for example {...cam_high: head}")
    primary_view: str = "head"
    grippers: dict[str, GripperRange] = Field(
        default={}, description="state column -> its readings when closed and open"
    )


class LeRobotSource:
    """Reads a LeRobotDataset.

    Raises: DataError when the folder is no such dataset; ConfigError when a declared column or view is unknown.
    """

    def __init__(self, config: LeRobotSourceConfig, root: Path) -> None:
        self._config = config
        self._dataset = LeRobotV21Dataset(root) if config.kind == "lerobot_v21" else LeRobotV3Dataset(root)
        self._names = _flat_names(self._dataset.features.get("observation.state", {}))
        for what, wanted, known in (
            ("video key", config.views, self._dataset.video_keys),
            ("state column", config.grippers, self._names),
        ):
            unknown = sorted(set(wanted) - set(known))
            if unknown:
                raise ConfigError(
                    f"The dataset has no {what} of this name",
                    where=str(root),
                    expected=", ".join(known),
                    got=", ".join(unknown),
                )

    def episode_ids(self) -> list[str]:
        return [f"{self._config.label}-{row['episode_index']:06d}" for row in self._dataset.episodes]

    def load(self, episode_id: str) -> LoadedEpisode:
        config, dataset = self._config, self._dataset
        index = int(episode_id.rsplit("-", 1)[1])
        state, overshoot = self._normalised(dataset.column(index, "observation.state"))
        action, command_overshoot = self._normalised(dataset.column(index, "action"))
        times = dataset.column(index, "timestamp").reshape(-1).astype(np.float64)
        tasks = dataset.tasks
        task_index = int(dataset.column(index, "task_index").reshape(-1)[0])
        key_of = {view: key for key, view in config.views.items()}
        for view, key in key_of.items():
            rate = dataset.video_rate(index, key)
            if abs(rate - dataset.fps) > _RATE_TOLERANCE * dataset.fps:
                raise RejectedInputError(
                    "wrong_fps",
                    "Video and dataset differ in frame rate",
                    where=f"{episode_id}, view {view}",
                    expected=f"{dataset.fps} fps",
                    got=f"{rate} fps",
                    evidence={"expected_fps": dataset.fps, "video_fps": rate},
                )
        episode = Episode(
            episode_id=episode_id,
            source=config.label,
            embodiment=config.embodiment,
            scene=config.scene or config.label,
            task_family=config.task_family,
            instruction=tasks.get(task_index, ""),
            outcome=config.outcome,
            split=config.split,
            fps=dataset.fps,
            state=state,
            action=action,
            timestamps=times - times[0],
            primary_view=config.primary_view,
            state_names=tuple(self._names) or None,
            conventions={
                "layout": f"lerobot {dataset.info['codebase_version']}",
                "declared_angle_unit": config.angle_unit,
                "gripper_overshoot": overshoot + command_overshoot,
            },
        )
        return LoadedEpisode(episode, tuple(key_of), lambda view: dataset.frames(index, key_of[view]), no_masks)

    def _normalised(self, values: np.ndarray) -> tuple[np.ndarray, int]:
        """Radians and openings; how many gripper readings were clipped."""
        result = values.astype(np.float64)
        result = result[:, None] if result.ndim == 1 else result
        grippers = [self._names.index(name) for name in self._config.grippers]
        if self._config.angle_unit == "deg":
            joints = [column for column in range(result.shape[1]) if column not in grippers]
            result[:, joints] = np.deg2rad(result[:, joints])
        overshoot = 0
        for column, span in zip(grippers, self._config.grippers.values(), strict=True):
            result[:, column], outside = span.opening(result[:, column])
            overshoot += outside
        return result.astype(np.float32), overshoot


def _flat_names(feature: dict[str, Any]) -> list[str]:
    """LeRobot writes names as a list, a list of one list, or a dict of a list."""
    names = feature.get("names") or []
    if isinstance(names, dict):
        names = next(iter(names.values()), [])
    if names and isinstance(names[0], list):
        names = names[0]
    return [str(name) for name in names]
