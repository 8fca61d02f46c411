"""RoboMIND 1 and 2: one HDF5 file per episode, images as JPEG bytes or bare pixels, joints of the robot (puppet) and of what leads it (master).

    <robot>/<task>/success_episodes/[train|val/]<episode>/data/trajectory.hdf5
    version 1: observations/rgb_images/<camera>, {puppet,master}/joint_position[_left,_right]
    version 2: camera_observations/color_images/<camera>, {puppet,master}/{arm,end_effector}_{left,right}_position_align/data

Joints are radians. No extrinsics are published: Stage I only. Episodes of one task share a scene, whatever the release's
own train and val folders say: they split by trajectory. Not read: version 1's simulated robots (states at about four times
the rate of the images), version 2's dexterous hands, and poses of end effectors (readers disagree on the quaternions).

For version 1 the publisher's `all_robot_h5_info_v1.2.md` (columns) and `robomind.yaml` (commands, exchanged channels) say
where arms and cameras are; for version 2 it is what independent readers of the files agree on. What is stated nowhere, or
stated differently, is left out here and must be declared.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from worldline_core.config import FrameRate
from worldline_core.data.episodes.episode import NO_EMBODIMENT
from worldline_core.data.episodes.source import (
    EmbodimentName,
    EpisodeFiles,
    ForeignSourceConfig,
    GripperRange,
    LoadedEpisode,
)
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.guards.source_paths import AnyPath, find_files, inside
from worldline_core.data.sources.hdf5 import (
    ArmPlace,
    Channels,
    Columns,
    Hdf5File,
    hdf5_images,
    open_hdf5,
    require_h5py,
)
from worldline_core.data.sources.video_folder import caption_table
from worldline_core.untrusted_text import printable

_RAW_SIZES = {720 * 1280 * 3: (720, 1280), 480 * 640 * 3: (480, 640)}
"""Some frames are pixels without a header; the publisher's reader knows their size by their number of bytes."""

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


@dataclass(frozen=True)
class RobomindLayout:
    """One folder of the release.

    Attributes:
        embodiment: `none` for robots that no file of configs/embodiments describes.
        views: view -> camera, of the views whose place is known.
        commanded: whether the master is the command; otherwise the action repeats the state.
        channels: None where it is stated nowhere.
    """

    version: Literal[1, 2]
    embodiment: str
    arms: tuple[ArmPlace, ...]
    views: Mapping[str, str]
    commanded: bool
    channels: Channels | None = None

    @property
    def images(self) -> str:
        """Group of the cameras."""
        return "observations/rgb_images" if self.version == 1 else "camera_observations/color_images"

    @property
    def grippers(self) -> bool:
        return any(arm.gripper is not None for arm in self.arms)


def _one_vector(*arms: tuple[Literal["left", "right"], int], gripper: bool = True) -> tuple[ArmPlace, ...]:
    """Arms one after the other in `joint_position`, each with its gripper behind it."""
    key, width = "{track}/joint_position", sum(joints + gripper for _, joints in arms)
    places: list[ArmPlace] = []
    start = 0
    for name, joints in arms:
        stop = start + joints
        last = Columns(key, slice(stop, stop + 1), (width,)) if gripper else None
        places.append(ArmPlace(name, Columns(key, slice(start, stop), (width,)), last))
        start = stop + gripper
    return tuple(places)


def _per_side(joints: str, num_joints: int, widths: tuple[int, ...], gripper: str, last: slice) -> tuple[ArmPlace, ...]:
    """Arms with datasets of their own, whose names hold `SIDE`; some have one more column than joints."""
    return tuple(
        ArmPlace(
            side,
            Columns(joints.replace("SIDE", side), slice(0, num_joints), widths),
            Columns(gripper.replace("SIDE", side), last, widths if gripper == joints else (1,)),
        )
        for side in ("left", "right")
    )


def _aligned(num_joints: int) -> tuple[ArmPlace, ...]:
    joints, gripper = "{track}/arm_SIDE_position_align/data", "{track}/end_effector_SIDE_position_align/data"
    return _per_side(joints, num_joints, (num_joints, num_joints + 1), gripper, slice(0, 1))


def _three(head: str, left: str, right: str) -> dict[str, str]:
    return {"head": head, "left_wrist": left, "right_wrist": right}


_ARM_7, _ARM_6 = _one_vector(("right", 7)), _one_vector(("right", 6))
_ARMS_7 = _one_vector(("left", 7), ("right", 7))
_HANDS = _one_vector(("left", 7), ("right", 7), gripper=False)
_AGILEX = _per_side("{track}/joint_position_SIDE", 6, (7,), "{track}/joint_position_SIDE", slice(6, 7))
_TOP = {"head": "camera_top"}
_WRISTS = _three("camera_front", "camera_wrist_left", "camera_wrist_right")
_AGILEX_1 = _three("camera_front", "camera_left_wrist", "camera_right_wrist")
_AGILEX_2 = _three("camera_front", "camera_left", "camera_right")

ROBOMIND_LAYOUTS: dict[LayoutName, RobomindLayout] = {
    "h5_franka_1rgb": RobomindLayout(1, "franka_panda", _ARM_7, _TOP, False),
    "h5_franka_3rgb": RobomindLayout(1, "franka_panda", _ARM_7, _TOP, False, "standard"),
    "h5_franka_fr3_dual": RobomindLayout(1, NO_EMBODIMENT, _ARMS_7, {"head": "camera_front"}, True),
    "h5_ur_1rgb": RobomindLayout(1, "ur5e", _ARM_6, _TOP, False, "standard"),
    "h5_agilex_3rgb": RobomindLayout(1, NO_EMBODIMENT, _AGILEX, _AGILEX_1, True, "as_written"),
    "h5_tienkung_gello_1rgb": RobomindLayout(1, NO_EMBODIMENT, _ARMS_7, _TOP, True, "as_written"),
    "h5_tienkung_prod1_gello_1rgb": RobomindLayout(1, NO_EMBODIMENT, _ARMS_7, _TOP, True),
    "h5_tienkung_xsens_1rgb": RobomindLayout(1, NO_EMBODIMENT, _HANDS, _TOP, False, "as_written"),
    "v2_franka": RobomindLayout(2, NO_EMBODIMENT, _aligned(7), _WRISTS, True),
    "v2_ur": RobomindLayout(2, NO_EMBODIMENT, _aligned(6), _WRISTS, True),
    "v2_agilex": RobomindLayout(2, NO_EMBODIMENT, _aligned(6), _AGILEX_2, True),
}


class RobomindSourceConfig(ForeignSourceConfig):
    """A folder of one robot. The files say neither their rate nor what a gripper reading means."""

    kind: Literal["robomind"] = "robomind"
    layout: LayoutName = Field(description="the release's folder name (version 1), or v2_ and it (version 2)")
    fps: FrameRate = Field(description="of the images and states; stated in no file")
    embodiment: EmbodimentName | None = Field(default=None, description="default: the layout's")
    views: dict[str, str] | None = Field(
        default=None, min_length=1, description="view -> camera; default: the layout's"
    )
    channels: Channels | None = Field(
        default=None, description="of the images; default: the layout's, where it is known"
    )
    gripper_state: GripperRange | None = Field(default=None, description="readings of the puppet's gripper")
    gripper_command: GripperRange | None = Field(default=None, description="readings of the master's gripper")
    instructions: str | None = Field(
        default=None,
        description="RoboMIND_v1_2_instr.csv in this folder; default: what the file itself says, or nothing",
    )

    @model_validator(mode="after")
    def _declared(self) -> RobomindSourceConfig:
        layout = ROBOMIND_LAYOUTS[self.layout]
        needed = {
            "channels": layout.channels is None,
            "gripper_state": layout.grippers,
            "gripper_command": layout.grippers and layout.commanded,
        }
        missing = [name for name, wanted in needed.items() if wanted and getattr(self, name) is None]
        if missing:
            raise ValueError(f"RoboMIND does not say it of {self.layout}, so declare {', '.join(missing)}")
        return self


class RobomindSource(EpisodeFiles[RobomindSourceConfig]):
    """Reads every `trajectory.hdf5` below the root; images are decoded one by one when they are asked for."""

    looked_for = "trajectory.hdf5"

    def __init__(self, config: RobomindSourceConfig, root: AnyPath) -> None:
        require_h5py()
        super().__init__(config, root, find_files(root, self.looked_for), _episode_parts)
        self._layout = ROBOMIND_LAYOUTS[config.layout]
        table = config.instructions
        self._instructions = None if table is None else caption_table(inside(root, table), "task", "instruction")

    def load(self, episode_id: str) -> LoadedEpisode:
        config, layout = self.config, self._layout
        relative, path = self.files[episode_id], self.path(episode_id)
        with open_hdf5(path) as file:
            state = file.arms(layout.arms, config.gripper_state, track="puppet")
            length = len(state.values)
            action = (
                file.arms(layout.arms, config.gripper_command, track="master", length=length)
                if layout.commanded
                else None
            )
            views, absent = file.cameras(layout.images, config.views or layout.views)
            # Who collected it: some stations recorded the arms exchanged.
            collector = file.attribute("metadata", "collector") if layout.version == 2 else None
            text = self._text(file, relative, path)
        episode = self.episode(
            episode_id,
            "-".join([config.label, *_task_parts(relative)]),
            layout=f"robomind {layout.version}",
            state=state.values,
            action=action and action.values,
            overshoot=state.overshoot + (action.overshoot if action else 0),
            embodiment=config.embodiment or layout.embodiment,
            instruction=text,
            outcome=_outcome(relative, config.outcome),
            primary_view=next(iter(config.views or layout.views)),
            state_names=state.names,
            conventions={} if collector is None else {"collector": collector},
        )
        channels: Channels = config.channels or layout.channels or "standard"

        def images(view: str) -> Iterator[np.ndarray]:
            return hdf5_images(path, f"{layout.images}/{views[view]}", length, channels, raw_sizes=_RAW_SIZES)

        return LoadedEpisode(episode, tuple(views), images, absent=absent)

    def _text(self, file: Hdf5File, relative: PurePosixPath, path: AnyPath) -> str:
        if self._instructions is None:
            if self._layout.version == 1:
                return (file.text("language_raw") or "").strip()
            return (file.attribute("metadata", "language_instruction") or "").replace("_", " ").strip()
        task = (_task_parts(relative) or ("",))[-1]
        if task not in self._instructions:
            raise RejectedInputError(
                "missing_column", "Table of instructions does not name the task", where=path, expected=task
            )
        return self._instructions[task]


def _episode_parts(file: PurePosixPath) -> tuple[str, ...]:
    """The path that names an episode: without the file's own name and the folder `data`, the same for all."""
    parts = file.parts[:-1]
    return parts[:-1] if parts and parts[-1] == "data" else parts


def _task_parts(file: PurePosixPath) -> tuple[str, ...]:
    """The folders down to the task's: those before `success_episodes`, else all but the episode's own."""
    parts = _episode_parts(file)
    named = parts[: parts.index("success_episodes")] if "success_episodes" in parts else parts[:-1]
    return tuple(map(printable, named))


def _outcome(file: PurePosixPath, declared: str) -> str:
    if declared != "unknown":
        return declared
    if "success_episodes" in file.parts:
        return "success"
    return "failure" if any(part.lower().startswith("fail") for part in file.parts[:-2]) else "unknown"
