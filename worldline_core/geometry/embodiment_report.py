"""Output of `worldline embodiment`: the list of robots, and the forward kinematics of one against MuJoCo.

Nothing of this project's readers is used on MuJoCo's side: its own compiler reads the description, after meshes and all else
that decides no pose were taken out (they are often not there).
"""

from __future__ import annotations

import importlib
import math
import xml.etree.ElementTree as ET
from typing import Any

import numpy as np

from worldline_core.errors import ConfigError, needing
from worldline_core.geometry.embodiment import (
    Embodiment,
    embodiment_names,
    how_to_get,
    load_embodiment,
    read_description,
)
from worldline_core.geometry.kinematic_tree import parse_xml
from worldline_core.geometry.transforms import rotation_angle

POSITION_TOLERANCE_M, ROTATION_TOLERANCE_RAD = 1e-5, 1e-5
LIMIT_TOLERANCE = 0.01
"""Limits [rad or m] of the YAML and of the description that differ by more are reported."""

_NO_POSE = (
    "asset", "actuator", "sensor", "tendon", "equality", "contact", "keyframe", "visual", "statistic", "option",
    "custom", "extension", "size", "deformable",
)  # fmt: skip
_NO_POSE_OF_A_BODY = ("geom", "camera", "light", "inertial", "composite", "flexcomp", "plugin")
_BOUNDS = {"boundmass": "0.001", "boundinertia": "0.000001"}


def list_embodiments() -> str:
    """A table of the robots, and below it what is missing or not verified."""
    cells = [("name", "arms (joints)", "state", "wrist cameras", "description", "verified")]
    notes: list[str] = []
    for name in embodiment_names():
        embodiment = load_embodiment(name)
        here, doubt = embodiment.description_path.is_file(), embodiment.unverified_reason
        arms = ", ".join(f"{arm.name} ({len(arm.joints)})" for arm in embodiment.arms)
        wrists = ", ".join(arm.camera_view for arm in embodiment.arms if arm.wrist_camera is not None) or "-"
        description = "here" if here else "not here"
        cells.append((name, arms, str(embodiment.state_size), wrists, description, "no" if doubt else "yes"))
        notes += [] if here else [f"{name}: {how_to_get(embodiment)}"]
        notes += [f"{name}: not verified: {doubt}"] if doubt else []
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in cells]
    return "\n".join([*lines, "", *notes])


def check_embodiment(embodiment: Embodiment, samples: int = 1000) -> dict[str, Any]:
    """Compare forward kinematics with MuJoCo at random joint positions within the limits.

    Returns: errors of every end-effector, tool and wrist camera, and of all links together; notes on differences that
        are no pose error, such as limits that are not those of the description; whether all errors are tolerable.

    Raises:
        UnavailableError: MuJoCo is not installed, or the kinematic description is not here.
        ConfigError, DataError: the embodiment and its description do not fit each other.
    """
    if samples < 1:
        raise ConfigError("A check needs random joint positions", expected="--samples of at least 1", got=samples)
    with needing("sim", "MuJoCo"):
        mujoco = importlib.import_module("mujoco")
    from worldline_core.geometry.kinematics import ArmKinematics  # torch, which the list does without

    kinematics = ArmKinematics(embodiment)
    state = random_states(embodiment, samples)
    model = _compile(mujoco, embodiment)
    ours = {name: poses.numpy() for name, poses in kinematics.link_poses(state).items()}
    theirs = _mujoco_poses(mujoco, model, embodiment, state, kinematics.links)
    tools, cameras = kinematics.tool_poses(state).numpy(), kinematics.wrist_camera_poses(state)
    errors = []
    for index, arm in enumerate(embodiment.arms):
        link, flange, offset = arm.end_effector_link, theirs[arm.end_effector_link], np.eye(4)
        rotation = np.zeros(9)
        quaternion = np.asarray(arm.T_link_tool.rotation_wxyz)
        mujoco.mju_quat2Mat(rotation, quaternion / np.linalg.norm(quaternion))
        offset[:3, :3], offset[:3, 3] = rotation.reshape(3, 3), arm.T_link_tool.translation
        errors.append(_pose_error("end-effector", link, ours[link], flange))
        errors.append(_pose_error("tool", arm.name, tools[:, index], flange @ offset))
        if arm.wrist_camera is not None:
            expected = theirs[arm.wrist_camera.link] @ np.asarray(arm.wrist_camera.T_link_camera, dtype=np.float64)
            errors.append(_pose_error("camera", arm.camera_view, cameras[arm.camera_view].numpy(), expected))
    links = [name for name in kinematics.links if name in theirs]
    worst = max(links, key=lambda name: np.abs(ours[name] - theirs[name]).max())
    together = (np.concatenate([poses[name] for name in links]) for poses in (ours, theirs))
    errors.append(_pose_error("all links", f"{len(links)} links, worst {worst}", *together))
    notes = []
    for arm in embodiment.arms:
        for name, limits in zip(arm.joints, arm.limits, strict=True):
            joint = model.joint(name)
            if joint.limited[0] and np.abs(joint.range - limits).max() > LIMIT_TOLERANCE:
                low, high = joint.range
                notes.append(f"{name}: limits {limits[0]:g} to {limits[1]:g}, the description has {low:g} to {high:g}")
    if missing := [name for name in kinematics.links if name not in theirs and "#" not in name]:
        notes.append(f"not compared, MuJoCo has no name for them: {', '.join(missing)}")
    return {"errors": errors, "notes": notes, "passed": all(error["passed"] for error in errors)}


def _pose_error(kind: str, frame: str, poses: np.ndarray, expected: np.ndarray) -> dict[str, Any]:
    """Largest differences between poses (N, 4, 4) of a frame."""
    position = float(np.linalg.norm(poses[:, :3, 3] - expected[:, :3, 3], axis=-1).max())
    rotation = float(rotation_angle(np.swapaxes(expected[:, :3, :3], -1, -2) @ poses[:, :3, :3]).max())
    passed = position <= POSITION_TOLERANCE_M and rotation <= ROTATION_TOLERANCE_RAD
    return {"frame": frame, "kind": kind, "position_m": position, "rotation_rad": rotation, "passed": passed}


def format_check(check: dict[str, Any]) -> str:
    """The errors of a check as a table, the verdict last."""
    rows = [
        f"  {e['kind']:<12} {e['frame']:<36} {e['position_m']:>9.1e} m {e['rotation_rad']:>9.1e} rad"
        f"  {'ok' if e['passed'] else 'FAILED'}"
        for e in check["errors"]
    ]
    limit = f"the limit is {POSITION_TOLERANCE_M:g} m and {ROTATION_TOLERANCE_RAD:g} rad"
    verdict = f"  {'passed' if check['passed'] else 'FAILED'}: {limit}"
    return "\n".join([*rows, *(f"  note: {note}" for note in check["notes"]), verdict])


def random_states(embodiment: Embodiment, samples: int, seed: int = 0) -> np.ndarray:
    """(samples, J) float64: joints uniform within their limits (a whole turn where there is none), grippers too."""
    ranges: list[tuple[float, float]] = []
    for arm in embodiment.arms:
        ranges += [
            (-math.pi if low == -math.inf else low, math.pi if high == math.inf else high) for low, high in arm.limits
        ]
        ranges.append((min(arm.gripper.closed, arm.gripper.open), max(arm.gripper.closed, arm.gripper.open)))
    low, high = np.asarray(ranges).T
    return np.random.default_rng(seed).uniform(low, high, (samples, embodiment.state_size))


def _mujoco_poses(
    mujoco: Any, model: Any, embodiment: Embodiment, state: np.ndarray, links: tuple[str, ...]
) -> dict[str, np.ndarray]:
    """T_base_link (N, 4, 4) of every link that MuJoCo knows by name."""
    data = mujoco.MjData(model)
    qpos = np.tile(np.asarray(model.qpos0, dtype=np.float64), (len(state), 1))
    for name, values in _joint_columns(embodiment, state).items():
        qpos[:, model.joint(name).qposadr[0]] = values
    bodies = {model.body(b).name: b for b in range(model.nbody)}
    if embodiment.description.format == "urdf":
        # MuJoCo makes the root link of a URDF its world.
        roots = [name for name in links if name.rpartition("/")[2] not in {b.rpartition("/")[2] for b in bodies}]
        bodies.update(dict.fromkeys(roots if not embodiment.description.mounts else [], 0))
    sites = {model.site(s).name: s for s in range(model.nsite)}
    known: dict[str, tuple[str, int]] = {}
    for name in links:
        plain = name.removeprefix("site:")
        if name in bodies:
            known[name] = ("body", bodies[name])
        elif plain in sites:
            known[name] = ("site", sites[plain])
    poses = {name: np.tile(np.eye(4), (len(state), 1, 1)) for name in {*known, embodiment.base_link}}
    for n, positions in enumerate(qpos):
        data.qpos[:] = positions
        mujoco.mj_kinematics(model, data)
        for name, (kind, index) in known.items():
            xpos, xmat = (data.xpos, data.xmat) if kind == "body" else (data.site_xpos, data.site_xmat)
            poses[name][n, :3, :3] = xmat[index].reshape(3, 3)
            poses[name][n, :3, 3] = xpos[index]
    base = np.linalg.inv(poses[embodiment.base_link])
    return {name: base @ poses[name] for name in known}


def _joint_columns(embodiment: Embodiment, state: np.ndarray) -> dict[str, np.ndarray | float]:
    """Positions of the joints that the embodiment names, read from the YAML's own words."""
    columns: dict[str, np.ndarray | float] = dict(embodiment.posture)
    for arm in embodiment.arms:
        start = embodiment.joint_columns(arm).start
        columns.update({name: state[:, start + i] for i, name in enumerate(arm.joints)})
        gripper = arm.gripper
        opening = (state[:, embodiment.gripper_column(arm)] - gripper.closed) / (gripper.open - gripper.closed)
        for finger in gripper.finger_joints:
            columns[finger.name] = np.interp(opening, [0.0, 1.0], [finger.closed, finger.open])
    return columns


def _compile(mujoco: Any, embodiment: Embodiment) -> Any:
    """MuJoCo's model of the description, with its mounts."""
    root = parse_xml(read_description(embodiment), embodiment.description_path)
    text = ET.tostring(bare_urdf(root) if embodiment.description.format == "urdf" else bare_mjcf(root), "unicode")
    spec = mujoco.MjSpec.from_string(text)
    mounts = embodiment.known_mounts()
    if not mounts:
        return spec.compile()
    stage = mujoco.MjSpec()
    for name, offset in mounts.items():
        frame = stage.worldbody.add_frame(pos=list(offset.translation), quat=list(offset.rotation_wxyz))
        stage.attach(mujoco.MjSpec.from_string(text), prefix=f"{name}/", frame=frame)
    return stage.compile()


def bare_urdf(robot: ET.Element) -> ET.Element:
    """A URDF of links and joints only, for MuJoCo; changed in place."""
    for element in list(robot):
        if element.tag not in ("link", "joint"):
            robot.remove(element)
        elif element.tag == "link":
            for child in list(element):
                element.remove(child)
    # Static links would be merged into their parents, and could then not be compared.
    ET.SubElement(ET.SubElement(robot, "mujoco"), "compiler", {"fusestatic": "false", **_BOUNDS})
    return robot


def bare_mjcf(root: ET.Element) -> ET.Element:
    """An MJCF of bodies, joints and sites only, for MuJoCo; changed in place."""
    for element in list(root):
        if element.tag in _NO_POSE:
            root.remove(element)
    for parent in list(root.iter()):
        for child in list(parent):
            in_default = parent.tag == "default" and child.tag not in ("joint", "site", "default")
            if in_default or (parent.tag in ("body", "worldbody") and child.tag in _NO_POSE_OF_A_BODY):
                parent.remove(child)
            elif child.tag == "site":
                child.attrib.pop("material", None)
            elif child.tag == "default":
                # Older MuJoCo passed over other attributes, and some published models have them.
                child.attrib = {key: value for key, value in child.attrib.items() if key == "class"}
    compiler = root.find("compiler")
    if compiler is None:
        compiler = ET.SubElement(root, "compiler")
    compiler.attrib.update(_BOUNDS)
    return root
