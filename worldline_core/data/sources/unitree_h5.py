"""HDF5 sets that Unitree's tools make from their LeRobot datasets, in two layouts.

UnifoLM-WMA (`prepare_training_data.py`), found by the folder `transitions`:
    transitions/<dataset>/<n>.h5                observation.state, action; attributes state_type, action_type, robot_type
    videos/<dataset>/<camera>/<n>.mp4
    <dataset>.csv                               videoid, data_dir (<dataset>/<camera>), instruction
unitree_IL_lerobot (`convert_lerobot_to_h5.py`):
    <any folders>/episode_<n>.hdf5              observations/qpos, action, observations/images/<camera>, language_raw

Vectors are joint positions [rad] and gripper readings in the order of the robot's motors, as unitree_IL_lerobot lists them.
Neither layout has camera calibration. What a gripper reading means is stated nowhere, and has to be declared. The second
layout's images are uncompressed and hold blue before green and red: the tool exchanges LeRobot's channels.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import PurePosixPath
from typing import Literal

import numpy as np
from pydantic import Field

from worldline_core.data.episodes.source import (
    EmbodimentName,
    ForeignSourceConfig,
    GripperRange,
    LoadedEpisode,
    joint_names,
)
from worldline_core.data.guards.plain_files import expect_layout, read_text
from worldline_core.data.guards.rejection import RejectedInputError, check_rate, unreadable
from worldline_core.data.guards.source_paths import AnyPath, find_files, inside, is_file, relative_name
from worldline_core.data.sources.episode_files import EpisodeFiles
from worldline_core.data.sources.hdf5 import Hdf5File, open_hdf5, raw_images, require_h5py
from worldline_core.data.video.clip import VideoClip, video_size

Robot = Literal["z1_single", "z1_dual", "g1_dex1"]
_TRANSITIONS = "transitions"
_IMAGES = "observations/images"
_JOINT_POSITION = "joint position"


@dataclass(frozen=True)
class ArmPlace:
    """One arm: its joints are `num_joints` columns from `start`, its gripper is one column."""

    name: Literal["left", "right"]
    start: int
    num_joints: int
    gripper: int


ROBOTS: Mapping[Robot, tuple[ArmPlace, ...]] = {
    "z1_single": (ArmPlace("right", 0, 6, 6),),
    "z1_dual": (ArmPlace("left", 0, 6, 6), ArmPlace("right", 7, 6, 13)),
    "g1_dex1": (ArmPlace("left", 0, 7, 14), ArmPlace("right", 7, 7, 15)),
}


class UnitreeH5SourceConfig(ForeignSourceConfig):
    """A folder of one robot's recordings."""

    kind: Literal["unitree_h5"] = "unitree_h5"
    robot: Robot = Field(
        description="whose motors the columns are: two arms with Dex1 grippers (G1), one or two Z1 arms"
    )
    embodiment: EmbodimentName
    fps: float = Field(gt=0, description="of the states; videos must have it (Unitree records 30 Hz)")
    views: dict[str, str] = Field(
        min_length=1, description="view -> camera: the name of its folder of videos, or of its images in the file"
    )
    gripper_state: GripperRange = Field(description="measured readings")
    gripper_command: GripperRange = Field(description="commanded readings")


class UnitreeH5Source(EpisodeFiles[UnitreeH5SourceConfig]):
    """Reads every recording of either layout below the root; frames are decoded when they are asked for."""

    looked_for = f"{_TRANSITIONS}/*/*.h5 or episode_*.hdf5"

    def __init__(self, config: UnitreeH5SourceConfig, root: AnyPath) -> None:
        require_h5py()
        found = [path for path in find_files(root, "*.h5") if relative_name(path, root).parts[:-2] == (_TRANSITIONS,)]
        super().__init__(config, root, [*found, *find_files(root, "episode_*.hdf5")], _episode_parts)
        self._instructions = lru_cache(maxsize=1)(self._read_instructions)  # episodes are read in order of datasets

    def load(self, episode_id: str) -> LoadedEpisode:
        config, relative, path = self.config, self.files[episode_id], self.path(episode_id)
        trained = relative.suffix == ".h5"
        with open_hdf5(path) as file:
            state, overshoot = self._vector(file, path, "observation.state" if trained else "observations/qpos", None)
            action, more = self._vector(file, path, "action", len(state))
            for kind in ("state_type", "action_type"):
                _check_kind(file.attribute("/", kind), kind, path)
            robot = file.attribute("/", "robot_type")
            if trained:
                text = self._instruction(relative, path)
            else:
                file.require_cameras(_IMAGES, config.views)
                text = (file.text("language_raw") or "").strip()
        clips: dict[str, VideoClip] = {}
        if trained:
            folder = f"videos/{relative.parent.name}"
            for view, camera in config.views.items():
                video = inside(self.root, f"{folder}/{camera}/{relative.stem}.mp4")
                check_rate(video_size(video)[2], config.fps, video, tolerance=0.02)
                clips[view] = VideoClip.whole_file(video, len(state), config.fps)
        episode = self.episode(
            episode_id,
            "-".join([config.label, *_episode_parts(relative)[:-1]]),
            layout="unitree unifolm" if trained else "unitree hdf5",
            state=state,
            action=action,
            overshoot=overshoot + more,
            instruction=text,
            primary_view=next(iter(config.views)),
            state_names=joint_names({arm.name: arm.num_joints for arm in ROBOTS[config.robot]}),
            conventions={} if robot is None else {"robot_type": robot},
        )
        return LoadedEpisode(
            episode,
            tuple(config.views),
            lambda view: _exchanged(raw_images(path, f"{_IMAGES}/{config.views[view]}", len(state))),
            clips=clips,
        )

    def _vector(self, file: Hdf5File, path: AnyPath, key: str, length: int | None) -> tuple[np.ndarray, int]:
        """(N, J) in the contract's layout, and how many gripper readings were clipped."""
        arms = ROBOTS[self.config.robot]
        values = file.array(key, (length, None))
        wanted = sum(arm.num_joints + 1 for arm in arms)
        if values.shape[1] != wanted:
            raise RejectedInputError(
                "length_mismatch",
                "Vector has another number of columns than this robot's",
                where=f"{path}, {key}",
                expected=f"{wanted} ({self.config.robot})",
                got=values.shape[1],
                next_step="check curate.sources[].robot; robots with dexterous hands are not read",
            )
        span = self.config.gripper_command if key == "action" else self.config.gripper_state
        blocks: list[np.ndarray] = []
        overshoot = 0
        for arm in arms:
            opening, outside = span.opening(values[:, [arm.gripper]])
            overshoot += outside
            blocks += [values[:, arm.start : arm.start + arm.num_joints], opening]
        return np.concatenate(blocks, axis=1), overshoot

    def _instruction(self, relative: PurePosixPath, path: AnyPath) -> str:
        table = self._instructions(relative.parent.name)
        if table is None:
            return ""
        if relative.stem not in table:
            raise RejectedInputError(
                "missing_column",
                "Table of the dataset does not name the recording",
                where=path,
                expected=f"a row with videoid {relative.stem} in {relative.parent.name}.csv",
                got=f"{len(table)} recordings",
            )
        return table[relative.stem]

    def _read_instructions(self, dataset: str) -> dict[str, str] | None:
        """Recording -> instruction of a dataset; None where it has no table."""
        path = inside(self.root, f"{dataset}.csv")
        if not is_file(path):
            return None
        text = io.StringIO(read_text(path, encoding="utf-8-sig"), newline="")
        with unreadable("Table is no CSV", path, (csv.Error,)), expect_layout(path, "columns videoid, instruction"):
            return {row["videoid"]: row["instruction"].strip() for row in csv.DictReader(text, strict=True)}


def _episode_parts(file: PurePosixPath) -> tuple[str, ...]:
    """The path that names an episode: without the folder `transitions`, the same for all."""
    parts = file.with_suffix("").parts
    return parts[1:] if parts[0] == _TRANSITIONS else parts


def _check_kind(found: str | None, name: str, path: AnyPath) -> None:
    if found is not None and found != _JOINT_POSITION:
        raise RejectedInputError(
            "unreadable",
            "Recording holds no joint positions",
            where=f"{path}, attribute {name}",
            expected=_JOINT_POSITION,
            got=found,
        )


def _exchanged(images: Iterator[np.ndarray]) -> Iterator[np.ndarray]:
    for image in images:
        yield np.ascontiguousarray(image[..., ::-1])
