"""Write ``configs/embodiments/<name>.{xml,yaml}`` from the robots that the recorder drives.

The XML holds bodies, joints and sites only (no meshes, actuators, defaults or free joints), rotations as
quaternions, both arms at their places in the base frame; the YAML is the embodiment's description.
Run: ``python -m tools.kinematics_export configs/embodiments``.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import yaml

from tools.description_import import kinematics_text
from worldline_core.recorder.bodies import BODIES
from worldline_core.recorder.rendering import OPENCV_AXES, prepare_rendering, wrist_camera_pose
from worldline_core.recorder.scene import SceneModel, build_scene

# Capsule radii [m] of the kinematic robot masks (links, hand, fingers) per model, fitted to the exact masks of recordings.
RADII = {
    "viperx": (0.036, 0.045, 0.010),
    "ur5e": (0.050, 0.034, 0.026),
    "xarm7": (0.080, 0.020, 0.008),
    "panda": (0.075, 0.021, 0.013),
}


def kinematics_xml(scene: SceneModel) -> str:
    """MJCF text of bodies, joints and sites of all arms."""
    model, prefixes = scene.model, tuple(f"{arm.name}/" for arm in scene.robot.arms)
    bodies = {body for body in range(1, model.nbody) if model.body(body).name.startswith(prefixes)}
    names = {model.body(body).name for body in bodies}
    names |= {model.site(site).name for site in range(model.nsite) if model.site_bodyid[site] in bodies}
    return kinematics_text(model, scene.robot.name, names)


def embodiment_yaml(scene: SceneModel) -> str:
    """YAML text of the embodiment's description."""
    model, robot = scene.model, scene.robot
    closed, opened = robot.finger_travel
    link_radius, hand_radius, gripper_radius = RADII[robot.model]
    arms = []
    for number, (arm, indices) in enumerate(zip(robot.arms, scene.arms, strict=True)):
        site = indices.tool_site
        ee = f"{arm.name}/ee"
        mount = np.eye(4)
        mount[:3, 3], rotation = wrist_camera_pose(scene, number)
        mount[:3, :3] = rotation @ OPENCV_AXES
        arms.append(
            {
                "name": arm.name,
                "joints": list(indices.joint_names),
                "limits": [[round(float(v), 6) for v in pair] for pair in indices.limits],
                "end_effector_link": ee,
                "T_link_tool": {
                    "translation": [round(float(v), 9) for v in model.site_pos[site]],
                    "rotation_wxyz": [round(float(v), 9) for v in model.site_quat[site]],
                },
                "gripper": {
                    "closed": 0.0,
                    "open": 1.0,
                    "finger_joints": [
                        {"name": name, "closed": closed, "open": opened} for name in indices.finger_names
                    ],
                },
                "wrist_camera": {
                    "link": ee,
                    "T_link_camera": [[round(float(v), 9) + 0.0 for v in row] for row in mount],
                },
                "link_radius": round(link_radius * robot.link_scale, 4),
                "hand_radius": hand_radius,
                "gripper_radius": gripper_radius,
            }
        )
    description = {
        "name": robot.name,
        "description": {"format": "mjcf", "file": f"{robot.name}.xml"},
        "base_link": "world",
        "arms": arms,
    }
    source = "gym-aloha (Apache-2.0)" if robot.model == "viperx" else "robosuite (MIT)"
    head = (
        f"# Kinematics from {source}; written by tools.kinematics_export.\n"
        "# Base frame: on the table at the middle between the arm bases, x forward, y left, z up.\n"
    )
    return head + yaml.safe_dump(description, sort_keys=False, default_flow_style=None, width=110)


def main() -> None:
    """Write the kinematics and descriptions of all embodiments into a folder."""
    parser = argparse.ArgumentParser(description="Write the embodiments' kinematics and descriptions.")
    parser.add_argument("output", type=Path)
    output = parser.parse_args().output
    prepare_rendering()
    output.mkdir(parents=True, exist_ok=True)
    for body in BODIES.values():
        scene = build_scene(body)
        name = scene.robot.name
        (output / f"{name}.xml").write_text(kinematics_xml(scene))
        (output / f"{name}.yaml").write_text(embodiment_yaml(scene))


if __name__ == "__main__":
    main()
