"""Where RoboMIND 1 and 2 keep the arms and cameras of each robot.

Version 1: the publisher's `all_robot_h5_info_v1.2.md` (columns) and `robomind.yaml` (which track is the command, and which
robots' images have exchanged channels). Version 2 has no such page; its entries are what independent readers of the
files agree on. What is stated nowhere, or stated differently, is left out here and must be declared: rates, gripper
readings, orders of channels, and the poses of end effectors (readers disagree on version 2's quaternions).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from worldline_core.data.guards.hdf5 import Channels

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
        images: group of the cameras.
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
    images: str = field(default="observations/rgb_images")


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


def _by_side(num_joints: int) -> tuple[ArmPlace, ...]:
    """Version 1's AgileX: one dataset a side, six joints and the gripper."""
    return tuple(
        ArmPlace(side, key, 0, num_joints, (num_joints + 1,), (key, num_joints))
        for side in ("left", "right")
        for key in ("{track}/joint_position_" + side,)
    )


def _aligned(num_joints: int) -> tuple[ArmPlace, ...]:
    """Version 2: arm and end effector of each side in datasets of their own; some have one more column than joints."""
    return tuple(
        ArmPlace(
            side,
            "{track}/arm_" + side + "_position_align/data",
            0,
            num_joints,
            (num_joints, num_joints + 1),
            ("{track}/end_effector_" + side + "_position_align/data", 0),
        )
        for side in ("left", "right")
    )


_COLOUR = "camera_observations/color_images"
_WRISTS = {"head": "camera_front", "left_wrist": "camera_wrist_left", "right_wrist": "camera_wrist_right"}
_TOP = {"head": "camera_top"}

ROBOMIND_LAYOUTS: dict[str, RobomindLayout] = {
    "h5_franka_1rgb": RobomindLayout(1, "franka_panda", _one_vector(("right", 7)), _TOP, "puppet"),
    "h5_franka_3rgb": RobomindLayout(1, "franka_panda", _one_vector(("right", 7)), _TOP, "puppet", "standard"),
    "h5_franka_fr3_dual": RobomindLayout(
        1, "franka_fr3_pair", _one_vector(("left", 7), ("right", 7)), {"head": "camera_front"}, "master"
    ),
    "h5_ur_1rgb": RobomindLayout(1, "ur5e", _one_vector(("right", 6)), _TOP, "puppet", "standard"),
    "h5_agilex_3rgb": RobomindLayout(
        1,
        "agilex_cobot_magic",
        _by_side(6),
        {"head": "camera_front", "left_wrist": "camera_left_wrist", "right_wrist": "camera_right_wrist"},
        "master",
        "as_written",
    ),
    "h5_tienkung_gello_1rgb": RobomindLayout(
        1, "tienkung", _one_vector(("left", 7), ("right", 7)), _TOP, "master", "as_written"
    ),
    "h5_tienkung_prod1_gello_1rgb": RobomindLayout(
        1, "tienkung", _one_vector(("left", 7), ("right", 7)), _TOP, "master"
    ),
    "h5_tienkung_xsens_1rgb": RobomindLayout(
        1, "tienkung", _one_vector(("left", 7), ("right", 7), gripper=False), _TOP, "puppet", "as_written"
    ),
    "v2_franka": RobomindLayout(2, "franka_pair", _aligned(7), _WRISTS, "master", images=_COLOUR),
    "v2_ur": RobomindLayout(2, "ur5e_station", _aligned(6), _WRISTS, "master", images=_COLOUR),
    "v2_agilex": RobomindLayout(
        2,
        "agilex_cobot_magic",
        _aligned(6),
        {"head": "camera_front", "left_wrist": "camera_left", "right_wrist": "camera_right"},
        "master",
        images=_COLOUR,
    ),
}
