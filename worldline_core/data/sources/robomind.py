"""RoboMIND 1 and 2: one HDF5 file per episode, images as JPEG bytes, joints of the robot (puppet) and of what leads it (master).

    <robot>/<task>/success_episodes/[train|val/]<episode>/data/trajectory.hdf5
    version 1: observations/rgb_images/<camera>, {puppet,master}/joint_position[_left,_right]
    version 2: camera_observations/color_images/<camera>, {puppet,master}/{arm,end_effector}_{left,right}_position_align/data

Joints are radians. No extrinsics are published: Stage I only. Episodes of one task share a scene, whatever the release's
own train and val folders say: they split by trajectory. The simulated robots of version 1 (states at about four times the
rate of the images, in tracks of different lengths) and robots with dexterous hands in version 2 are not read.

Where each robot's arms and cameras are: for version 1 the publisher's `all_robot_h5_info_v1.2.md` (columns) and
`robomind.yaml` (which track is the command, and which robots' images have exchanged channels) say it; for version 2 it is
what independent readers of the files agree on. What is stated nowhere, or stated differently, is left out here and must be
declared: rates, gripper readings, orders of channels, and the poses of end effectors (readers disagree on version 2's
quaternions).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from worldline_core.data.episodes.episode import NO_EMBODIMENT
from worldline_core.data.episodes.source import (
    EmbodimentName,
    ForeignSourceConfig,
    GripperRange,
    LoadedEpisode,
    joint_names,
)
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.guards.source_paths import AnyPath, find_files, inside
from worldline_core.data.sources.episode_files import EpisodeFiles, printable
from worldline_core.data.sources.hdf5 import Channels, Hdf5File, hdf5_images, open_hdf5, require_h5py
from worldline_core.data.sources.video_folder import caption_table

LayoutName = Literal[
    "h5_franka_1rgb",
    "h5_franka_3rgb",
    "h5_franka_fr3_dual",
    "h5_ur_1rgb",
    "h5_agilex_3rgb",
    "h5_tienkung_gello_1rgb",
    "h5_tienkung_prod1_gello_1rgb",
    "h5_tienkung_xsens_1rgb",
    "v2_franka",
    "v2_ur",
    "v2_agilex",
]
Track = Literal["puppet", "master"]


@dataclass(frozen=True)
class ArmPlace:
    """One arm: joints are the first `num_joints` columns from `start` of a dataset; `{track}` is puppet or master.

    Attributes:
        widths: how many columns the dataset of joints may have.
        gripper: dataset and column of the gripper, None where the robot has a hand of several joints.
    """

    name: Literal["left", "right"]
    joints: str
    start: int
    num_joints: int
    widths: tuple[int, ...]
    gripper: tuple[str, int] | None


@dataclass(frozen=True)
class RobomindLayout:
    """One folder of the release.

    Attributes:
        embodiment: `none` for robots that no file of configs/embodiments describes.
        views: view -> camera, of the views whose place is known.
        command: track that is the command; "puppet" means that the action repeats the state.
        channels: None where it is stated nowhere.
    """

    version: Literal[1, 2]
    embodiment: str
    arms: tuple[ArmPlace, ...]
    views: Mapping[str, str]
    command: Track
    channels: Channels | None = None

    @property
    def images(self) -> str:
        """Group of the cameras."""
        return "observations/rgb_images" if self.version == 1 else "camera_observations/color_images"


def _one_vector(*blocks: tuple[Literal["left", "right"], int], gripper: bool = True) -> tuple[ArmPlace, ...]:
    """Arms that lie one after the other in `joint_position`, each with its gripper behind it."""
    width = sum(joints + gripper for _, joints in blocks)
    arms: list[ArmPlace] = []
    start = 0
    for name, joints in blocks:
        key = "{track}/joint_position"
        arms.append(ArmPlace(name, key, start, joints, (width,), (key, start + joints) if gripper else None))
        start += joints + gripper
    return tuple(arms)


def _one_per_side(
    num_joints: int, joints: str, gripper: tuple[str, int], widths: tuple[int, ...]
) -> tuple[ArmPlace, ...]:
    """Arms with datasets of their own, whose names have the side for `SIDE`."""
    key, column = gripper
    return tuple(
        ArmPlace(side, joints.replace("SIDE", side), 0, num_joints, widths, (key.replace("SIDE", side), column))
        for side in ("left", "right")
    )


def _aligned(num_joints: int) -> tuple[ArmPlace, ...]:
    """Version 2: some datasets have one more column than joints."""
    gripper = "{track}/end_effector_SIDE_position_align/data", 0
    return _one_per_side(
        num_joints, "{track}/arm_SIDE_position_align/data", gripper, widths=(num_joints, num_joints + 1)
    )


_ARM_7, _ARM_6 = _one_vector(("right", 7)), _one_vector(("right", 6))
_ARMS_7 = _one_vector(("left", 7), ("right", 7))
_HANDS = _one_vector(("left", 7), ("right", 7), gripper=False)
_AGILEX = _one_per_side(6, "{track}/joint_position_SIDE", ("{track}/joint_position_SIDE", 6), widths=(7,))


def _three(head: str, left: str, right: str) -> dict[str, str]:
    return {"head": head, "left_wrist": left, "right_wrist": right}


_TOP = {"head": "camera_top"}
_WRISTS = _three("camera_front", "camera_wrist_left", "camera_wrist_right")
_AGILEX_1 = _three("camera_front", "camera_left_wrist", "camera_right_wrist")
_AGILEX_2 = _three("camera_front", "camera_left", "camera_right")

ROBOMIND_LAYOUTS: dict[LayoutName, RobomindLayout] = {
    "h5_franka_1rgb": RobomindLayout(1, "franka_panda", _ARM_7, _TOP, "puppet"),
    "h5_franka_3rgb": RobomindLayout(1, "franka_panda", _ARM_7, _TOP, "puppet", "standard"),
    "h5_franka_fr3_dual": RobomindLayout(1, NO_EMBODIMENT, _ARMS_7, {"head": "camera_front"}, "master"),
    "h5_ur_1rgb": RobomindLayout(1, "ur5e", _ARM_6, _TOP, "puppet", "standard"),
    "h5_agilex_3rgb": RobomindLayout(1, NO_EMBODIMENT, _AGILEX, _AGILEX_1, "master", "as_written"),
    "h5_tienkung_gello_1rgb": RobomindLayout(1, NO_EMBODIMENT, _ARMS_7, _TOP, "master", "as_written"),
    "h5_tienkung_prod1_gello_1rgb": RobomindLayout(1, NO_EMBODIMENT, _ARMS_7, _TOP, "master"),
    "h5_tienkung_xsens_1rgb": RobomindLayout(1, NO_EMBODIMENT, _HANDS, _TOP, "puppet", "as_written"),
    "v2_franka": RobomindLayout(2, NO_EMBODIMENT, _aligned(7), _WRISTS, "master"),
    "v2_ur": RobomindLayout(2, NO_EMBODIMENT, _aligned(6), _WRISTS, "master"),
    "v2_agilex": RobomindLayout(2, NO_EMBODIMENT, _aligned(6), _AGILEX_2, "master"),
}


_FILE = "trajectory.hdf5"
_SUCCESS, _FAILURE = "success_episodes", "fail"


class RobomindSourceConfig(ForeignSourceConfig):
    """A folder of one robot. The files say neither their rate nor what a gripper reading means."""

    kind: Literal["robomind"] = "robomind"
    layout: LayoutName = Field(description="the release's folder name (version 1), or v2_ and it (version 2)")
    fps: float = Field(gt=0, description="of the images and states; stated in no file")
    embodiment: EmbodimentName | None = Field(default=None, description="default: the layout's")
    views: dict[str, str] | None = Field(
        default=None, min_length=1, description="view -> camera; default: the layout's"
    )
    channels: Channels | None = Field(
        default=None, description="of the images; default: the layout's, where it is known"
    )
    action: Track | None = Field(
        default=None, description="puppet: the action repeats the state; default: the layout's"
    )
    gripper_state: GripperRange | None = Field(default=None, description="readings of the puppet's gripper")
    gripper_command: GripperRange | None = Field(default=None, description="readings of the master's gripper")
    instructions: str | None = Field(
        default=None,
        description="RoboMIND_v1_2_instr.csv in this folder; default: what the file itself says, or nothing",
    )

    @model_validator(mode="after")
    def _declared(self) -> RobomindSourceConfig:
        layout, missing = ROBOMIND_LAYOUTS[self.layout], []
        grippers = any(arm.gripper is not None for arm in layout.arms)
        if self.channels is None and layout.channels is None:
            missing.append("channels")
        if grippers and self.gripper_state is None:
            missing.append("gripper_state")
        if grippers and self.command == "master" and self.gripper_command is None:
            missing.append("gripper_command")
        if missing:
            raise ValueError(f"RoboMIND does not say it of {self.layout}, so declare {', '.join(missing)}")
        return self

    @property
    def command(self) -> Track:
        return self.action or ROBOMIND_LAYOUTS[self.layout].command


class RobomindSource(EpisodeFiles[RobomindSourceConfig]):
    """Reads every `trajectory.hdf5` below the root; images are decoded one by one when they are asked for."""

    looked_for = _FILE

    def __init__(self, config: RobomindSourceConfig, root: AnyPath) -> None:
        require_h5py()
        super().__init__(config, root, find_files(root, _FILE), _episode_parts)
        self._layout = ROBOMIND_LAYOUTS[config.layout]
        table = config.instructions
        self._instructions = None if table is None else caption_table(inside(root, table), "task", "instruction")

    def load(self, episode_id: str) -> LoadedEpisode:
        config, layout = self.config, self._layout
        relative, path = self.files[episode_id], self.path(episode_id)
        views = dict(config.views or layout.views)
        with open_hdf5(path) as file:
            state, overshoot = self._vector(file, path, "puppet")
            action, more = (None, 0) if config.command == "puppet" else self._vector(file, path, "master")
            self._check_compression(file, path)
            file.require_cameras(layout.images, views)
            # Who collected it: some stations recorded the arms exchanged.
            collector = file.attribute("metadata", "collector") if layout.version == 2 else None
            text = self._text(file, relative, path)
        grippers = any(arm.gripper is not None for arm in layout.arms)
        episode = self.episode(
            episode_id,
            "-".join([config.label, *_task_parts(relative)]),
            layout=f"robomind {layout.version}",
            state=state,
            action=action,
            overshoot=overshoot + more,
            embodiment=config.embodiment or layout.embodiment,
            instruction=text,
            outcome=_outcome(relative, config.outcome),
            primary_view=next(iter(views)),
            state_names=joint_names({arm.name: arm.num_joints for arm in layout.arms}, gripper=grippers),
            conventions={} if collector is None else {"collector": collector},
        )
        channels: Channels = config.channels or layout.channels or "standard"
        return LoadedEpisode(
            episode,
            tuple(views),
            lambda view: hdf5_images(path, f"{layout.images}/{views[view]}", len(state), channels),
        )

    def _vector(self, file: Hdf5File, path: AnyPath, track: Track) -> tuple[np.ndarray, int]:
        """(N, J) in the contract's layout, and how many gripper readings were clipped."""
        span = self.config.gripper_state if track == "puppet" else self.config.gripper_command
        blocks: list[np.ndarray] = []
        overshoot, length = 0, None
        for arm in self._layout.arms:
            key = arm.joints.format(track=track)
            values = file.columns(key, length)
            if values.shape[1] not in arm.widths:
                raise RejectedInputError(
                    "length_mismatch",
                    "Joints have another number of columns than this robot's",
                    where=f"{path}, {key}",
                    expected=" or ".join(map(str, arm.widths)),
                    got=values.shape[1],
                    next_step="check curate.sources[].layout: each robot has a folder and a layout of its own",
                )
            length = len(values)
            blocks.append(values[:, arm.start : arm.start + arm.num_joints])
            if arm.gripper is None or span is None:
                continue
            key, column = arm.gripper[0].format(track=track), arm.gripper[1]
            values = file.columns(key, length)
            if self._layout.version == 2 and values.shape[1] != 1:
                raise RejectedInputError(
                    "invalid_gripper",
                    "End effector is no gripper of one value",
                    where=f"{path}, {key}",
                    expected="1 value per frame",
                    got=f"{values.shape[1]} (a dexterous hand?)",
                )
            opening, outside = span.opening(values[:, column : column + 1])
            overshoot += outside
            blocks.append(opening)
        return np.concatenate(blocks, axis=1), overshoot

    def _check_compression(self, file: Hdf5File, path: AnyPath) -> None:
        compressed = file.attribute("/", "compress") if self._layout.version == 1 else None
        if compressed is not None and compressed not in ("True", "1"):
            raise RejectedInputError(
                "unreadable",
                "Images are stored without compression",
                where=f"{path}, attribute compress",
                expected="True: encoded images",
                got=compressed,
            )

    def _text(self, file: Hdf5File, relative: PurePosixPath, path: AnyPath) -> str:
        if self._instructions is not None:
            task = (_task_parts(relative) or ("",))[-1]
            if task not in self._instructions:
                raise RejectedInputError(
                    "missing_column",
                    "Table of instructions does not name the task",
                    where=str(path),
                    expected=task,
                    got=f"{len(self._instructions)} tasks",
                )
            return self._instructions[task]
        if self._layout.version == 1:
            return (file.text("language_raw") or "").strip()
        return (file.attribute("metadata", "language_instruction") or "").replace("_", " ").strip()


def _episode_parts(file: PurePosixPath) -> tuple[str, ...]:
    """The path that names an episode: without the file's own name and the folder `data`, the same for all."""
    parts = file.parts[:-1]
    return parts[:-1] if parts and parts[-1] == "data" else parts


def _task_parts(file: PurePosixPath) -> tuple[str, ...]:
    """The folders down to the task's: what stands before `success_episodes`, else all but the episode's own."""
    parts = _episode_parts(file)
    named = parts[: parts.index(_SUCCESS)] if _SUCCESS in parts else parts[:-1]
    return tuple(map(printable, named))


def _outcome(file: PurePosixPath, declared: str) -> str:
    if declared != "unknown":
        return declared
    if _SUCCESS in file.parts:
        return "success"
    return "failure" if any(part.lower().startswith(_FAILURE) for part in file.parts[:-2]) else "unknown"
