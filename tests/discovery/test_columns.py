"""Columns of usual robots, as LeRobot and others name them."""

from __future__ import annotations

from typing import Any

import pytest

from worldline_core.discovery.columns import columns_of, find_arms

SO = ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll"]
VIPERX = ["waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate"]
G1_ARM = ["ShoulderPitch", "ShoulderRoll", "ShoulderYaw", "Elbow", "WristRoll", "WristPitch", "WristYaw"]
G1_LEGS = [f"k{side}{joint}.q" for side in ("Left", "Right") for joint in ("HipPitch", "HipYaw", "Knee", "AnklePitch")]


def both(names: list[str], form: str = "{side}_{name}") -> list[str]:
    return [form.format(side=side, Side=side.title(), name=name) for side in ("left", "right") for name in names]


CASES: dict[str, tuple[list[str], list[tuple[int, str | None]]]] = {
    "so101_follower": ([f"{n}.pos" for n in (*SO, "gripper")], [(5, "gripper.pos")]),
    "so100 before PR 777": ([f"main_{n}" for n in (*SO, "gripper")], [(5, "main_gripper")]),
    "bi_so_follower": ([f"{n}.pos" for n in both([*SO, "gripper"])], [(5, "left_gripper.pos"), (5, "right_gripper.pos")]),
    "lekiwi": ([*(f"arm_{n}.pos" for n in (*SO, "gripper")), "x.vel", "y.vel", "theta.vel"], [(5, "arm_gripper.pos")]),
    "aloha": (both([*VIPERX, "gripper"]), [(6, "left_gripper"), (6, "right_gripper")]),
    "trossen stationary": (
        both(["waist", "shoulder", "shoulder_shadow", "elbow", "elbow_shadow", *VIPERX[3:], "gripper"]),
        [(6, "left_gripper"), (6, "right_gripper")],
    ),
    "trossen ai": (
        [f"{n}.pos" for n in both([*(f"joint_{i}" for i in range(6)), "left_carriage_joint"])],
        [(6, "left_left_carriage_joint.pos"), (6, "right_left_carriage_joint.pos")],
    ),
    "unitree_g1 of lerobot": (
        [*G1_LEGS, "kWaistYaw.q", *both(G1_ARM, "k{Side}{name}.q"), "imu.quat.w"],
        [(7, None), (7, None)],
    ),
    "unitree_g1 with dex1": (
        [*both(G1_ARM, "k{Side}{name}"), "kLeftGripper", "kRightGripper"],
        [(7, "kLeftGripper"), (7, "kRightGripper")],
    ),
    "xarm": ([*(f"joint{i}.pos" for i in range(1, 8)), "gripper.pos"], [(7, "gripper.pos")]),
    "droid": ([*(f"joint_{i}" for i in range(7)), "gripper"], [(7, "gripper")]),
    "panda of ROS": ([*(f"panda_joint{i}" for i in range(1, 8)), "panda_finger_joint1", "panda_finger_joint2"], [(7, "panda_finger_joint1")]),
    "openarm": ([f"{n}.pos" for n in both([*(f"joint_{i}" for i in range(1, 8)), "gripper"])], [(7, "left_gripper.pos"), (7, "right_gripper.pos")]),
    "viperx alone": ([*VIPERX, "gripper"], [(6, "gripper")]),
    "left arm alone": ([f"left_{n}" for n in (*VIPERX, "gripper")], [(6, "left_gripper")]),
    "poses alone": (["x", "y", "z", "roll", "pitch", "yaw", "gripper"], []),
    "motor_0 ..": ([f"motor_{i}" for i in range(14)], [(6, "motor_6"), (6, "motor_13")]),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_arms_and_grippers_by_their_names(name: str) -> None:
    names, expected = CASES[name]
    arms, why = find_arms(columns_of("observation.state", names, len(names), "observation.state"))
    found: list[Any] = [(len(arm.joints), arm.gripper and arm.gripper.name) for arm in arms]
    assert found == expected, why
    assert [arm.side for arm in arms] == {0: [], 1: ["right"], 2: ["left", "right"]}[len(arms)]
