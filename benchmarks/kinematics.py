"""Speed of forward kinematics: batches against one frame at a time, and against MuJoCo.

Run: `python benchmarks/kinematics.py [--threads 1] [--embodiment franka_panda]`. One pose is the tool pose of one arm
at one frame, float64, from a state vector that is checked for length and finite numbers. All methods get the same
states and the largest difference between their results is printed. MuJoCo computes every body of the description.
Rates are per second of processor time, so with one thread they are those of one core, busy machine or not.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import mujoco
import numpy as np
import torch

from worldline_core.geometry.embodiment import Embodiment, load_embodiment
from worldline_core.geometry.embodiment_check import random_states
from worldline_core.geometry.kinematic_tree import TreeBody
from worldline_core.geometry.kinematics import ArmKinematics

FRAMES, FRAMES_ONE_BY_ONE = 4096, 256


def seconds(call: Callable[[], object], at_least: float = 1.0) -> float:
    """Best processor time of one call, over at least `at_least` seconds of calls."""
    call()
    best, spent = float("inf"), 0.0
    while spent < at_least:
        start = time.process_time()
        call()
        took = time.process_time() - start
        best, spent = min(best, took), spent + took
    return best


def frame_by_frame(kinematics: ArmKinematics) -> Callable[[np.ndarray], np.ndarray]:
    """4 x 4 products in NumPy along each arm, one frame after the other: what a script does without a library."""
    embodiment = kinematics.embodiment
    chains = {arm.name: path_to(kinematics.tree, arm.end_effector_link) for arm in embodiment.arms}
    base = np.linalg.inv(fixed_pose(path_to(kinematics.tree, embodiment.base_link)))

    def poses(states: np.ndarray) -> np.ndarray:
        result = np.zeros((len(states), len(embodiment.arms), 4, 4))
        for n, state in enumerate(states):
            for a, arm in enumerate(embodiment.arms):
                columns = embodiment.joint_columns(arm)
                values = dict(zip(arm.joints, state[columns], strict=True)) | embodiment.posture
                T = base
                for body in chains[arm.name]:
                    T = T @ body.T_parent_body
                    for joint in body.joints:
                        T = T @ turn(joint.axis, values.get(joint.name, 0.0))
                result[n, a] = T @ arm.T_link_tool.matrix()
        return result

    return poses


def path_to(tree: TreeBody, name: str) -> list[TreeBody]:
    """Bodies from the root to a link."""
    if tree.name == name:
        return [tree]
    return next(([tree, *path] for child in tree.children if (path := path_to(child, name))), [])


def fixed_pose(path: list[TreeBody]) -> np.ndarray:
    """Pose at the end of a path without joints."""
    T = np.eye(4)
    for body in path:
        if body.joints:
            raise SystemExit(f"the base {path[-1].name} moves: choose another embodiment")
        T = T @ body.T_parent_body
    return T


def turn(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rotation about a unit axis through the origin."""
    x, y, z = axis
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    T = np.eye(4)
    T[:3, :3] += np.sin(angle) * skew + (1 - np.cos(angle)) * (skew @ skew)
    return T


def mujoco_poses(embodiment: Embodiment) -> Callable[[np.ndarray], np.ndarray]:
    """`mj_kinematics` for each frame."""
    model = mujoco.MjModel.from_xml_path(str(embodiment.description_path))
    data = mujoco.MjData(model)
    address = [int(model.joint(j).qposadr[0]) for arm in embodiment.arms for j in arm.joints]
    columns = np.concatenate([np.r_[embodiment.joint_columns(arm)] for arm in embodiment.arms])
    links = [model.body(arm.end_effector_link).id for arm in embodiment.arms]
    base = model.body(embodiment.base_link).id
    tools = np.stack([arm.T_link_tool.matrix() for arm in embodiment.arms])

    def poses(states: np.ndarray) -> np.ndarray:
        flange = np.tile(np.eye(4), (len(states), len(links), 1, 1))
        root = np.tile(np.eye(4), (len(states), 1, 1, 1))
        for n, joints in enumerate(states[:, columns]):
            data.qpos[address] = joints
            mujoco.mj_kinematics(model, data)
            flange[n, :, :3, :3] = data.xmat[links].reshape(-1, 3, 3)
            flange[n, :, :3, 3] = data.xpos[links]
            root[n, 0, :3, :3], root[n, 0, :3, 3] = data.xmat[base].reshape(3, 3), data.xpos[base]
        return np.linalg.inv(root) @ flange @ tools

    return poses


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--embodiment", default="franka_panda")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    embodiment = load_embodiment(arguments.embodiment)
    kinematics = ArmKinematics(embodiment)
    states = random_states(embodiment, FRAMES)
    few = states[:FRAMES_ONE_BY_ONE]
    by_hand, by_mujoco = frame_by_frame(kinematics), mujoco_poses(embodiment)

    reference = kinematics.tool_poses(states).numpy()
    difference = max(np.abs(by_mujoco(states) - reference).max(), np.abs(by_hand(few) - reference[: len(few)]).max())
    arms = len(embodiment.arms)
    batched = FRAMES * arms / seconds(lambda: kinematics.tool_poses(states))
    rows = [
        ("batched", batched),
        (
            "the same, one frame a call",
            len(few) * arms / seconds(lambda: [kinematics.tool_poses(s[None]) for s in few]),
        ),
        ("4 x 4 products frame by frame", len(few) * arms / seconds(lambda: by_hand(few))),
        ("MuJoCo mj_kinematics frame by frame", len(states) * arms / seconds(lambda: by_mujoco(states))),
    ]
    joints = "+".join(str(len(arm.joints)) for arm in embodiment.arms)
    print(f"{embodiment.name}, {joints} joints, {arguments.threads} thread(s), largest difference {difference:.1e}")
    print("| method | tool poses/s | batched is faster by |\n|---|---:|---:|")
    for method, rate in rows:
        print(f"| {method} | {rate:,.0f} | {batched / rate:.1f} |")


if __name__ == "__main__":
    main()
