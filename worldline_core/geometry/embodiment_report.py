"""Output of `worldline embodiment`: the list of robots, one robot, and its forward kinematics against MuJoCo.

MuJoCo is an independent engine here: nothing of this project's readers is used on its side. The description's text goes
to MuJoCo's own MJCF or URDF compiler, after meshes and all else that decides no pose were taken out (they are often not
there).
"""

from __future__ import annotations

import importlib
import importlib.util
import math
import xml.etree.ElementTree as ET
from typing import Any

import numpy as np

from worldline_core.errors import ConfigError, UnavailableError, WorldLineError, installing
from worldline_core.geometry.embodiment import (
    Embodiment,
    embodiment_names,
    how_to_get,
    load_embodiment,
    read_description,
)
from worldline_core.geometry.kinematic_tree import TreeBody, parse_xml
from worldline_core.geometry.transforms import rotation_angle

POSITION_TOLERANCE_M = 1e-5
ROTATION_TOLERANCE_RAD = 1e-5
LIMIT_TOLERANCE = 0.01
"""Limits [rad or m] of the YAML and of the description that differ by more are reported."""

_NO_POSE = (
    "asset", "actuator", "sensor", "tendon", "equality", "contact", "keyframe", "visual", "statistic", "option",
    "custom", "extension", "size", "deformable",
)  # fmt: skip
_NO_POSE_OF_A_BODY = ("geom", "camera", "light", "inertial", "composite", "flexcomp", "plugin")
_BOUNDS = {"boundmass": "0.001", "boundinertia": "0.000001"}


def list_embodiments() -> list[dict[str, Any]]:
    """One row per embodiment: arms, joints, state size, whether its description is here, whether it is verified."""
    return [_row(name) for name in embodiment_names()]


def _row(name: str) -> dict[str, Any]:
    try:
        embodiment = load_embodiment(name)
    except WorldLineError as error:
        # A package in another version makes one robot unusable, not the list of the others.
        return {"name": name, "found": False, "problem": str(error)}
    package, found = embodiment.description.package, embodiment.description_path.is_file()
    return {
        "name": name,
        "arms": {arm.name: len(arm.joints) for arm in embodiment.arms},
        "state_size": embodiment.state_size,
        "wrist_cameras": [arm.camera_view for arm in embodiment.arms if arm.wrist_camera is not None],
        "description": f"package {package}" if package else "shipped" if found else "your file",
        "found": found,
        "path": str(embodiment.description_path),
        "how_to_get": None if found else how_to_get(embodiment),
        "verified": embodiment.verified,
        "unverified_reason": embodiment.unverified_reason,
    }


def format_list(rows: list[dict[str, Any]]) -> str:
    """A table of the robots, and below it what is missing or not verified."""
    cells = [("name", "arms (joints)", "state", "wrist cameras", "description", "verified")]
    notes: list[str] = []
    for row in rows:
        name = row["name"]
        if "problem" in row:
            cells.append((name, "-", "-", "-", "not usable", "-"))
            notes.append(f"{name}: {row['problem']}")
            continue
        arms = ", ".join(f"{arm} ({joints})" for arm, joints in row["arms"].items())
        wrists, verified = ", ".join(row["wrist_cameras"]) or "-", "yes" if row["verified"] else "no"
        description = row["description"] if row["found"] else f"{row['description']}: not here"
        cells.append((name, arms, str(row["state_size"]), wrists, description, verified))
        notes += [] if row["found"] else [f"{name}: {row['how_to_get']}"]
        notes += [] if row["verified"] else [f"{name}: not verified: {row['unverified_reason']}"]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in cells]
    return "\n".join([*lines, *([""] if notes else []), *notes])


def describe_embodiment(embodiment: Embodiment) -> str:
    """All that the file states, with the column of each joint and gripper in the state."""
    description = embodiment.description
    here = "" if embodiment.description_path.is_file() else f" (not here: {how_to_get(embodiment)})"
    lines = [
        f"{embodiment.name}: state of {embodiment.state_size} columns, angles in {embodiment.joint_units}, "
        f"poses in {embodiment.base_link}",
        f"  description  {description.format}, {embodiment.description_path}{here}",
        *([f"  source       {description.source}"] if description.source else []),
        f"  verified     {'yes' if embodiment.verified else f'no: {embodiment.unverified_reason}'}",
    ]
    for name, offset in description.mounts.items():
        lines.append(f"  mount        {name}: {offset.translation} m, wxyz {offset.rotation_wxyz}")
    if embodiment.posture:
        lines.append("  posture      " + ", ".join(f"{name} {value:g}" for name, value in embodiment.posture.items()))
    for arm in embodiment.arms:
        gripper, tool, width = arm.gripper, arm.T_link_tool, max(map(len, arm.joints))
        lines.append(f"  arm {arm.name}")
        start = embodiment.joint_columns(arm).start
        for number, (joint, (low, high)) in enumerate(zip(arm.joints, arm.limits, strict=True), start):
            limits = "no limits" if (low, high) == (-math.inf, math.inf) else f"{low:g} to {high:g}"
            lines.append(f"    column {number:<3} {joint:<{width}}  {limits}")
        fingers = ", ".join(f"{f.name} {f.closed:g} to {f.open:g}" for f in gripper.finger_joints) or "no finger joints"
        lines += [
            f"    column {embodiment.gripper_column(arm):<3} {'gripper':<{width}}  {gripper.closed:g} closed, "
            f"{gripper.open:g} open; {fingers}",
            f"    tool       in {arm.end_effector_link}: {tool.translation} m, wxyz {tool.rotation_wxyz}",
        ]
        if arm.wrist_camera is not None:
            lines.append(f"    camera     {arm.camera_view} in {arm.wrist_camera.link}")
    return "\n".join(lines)


def check_embodiment(embodiment: Embodiment, samples: int = 1000, seed: int = 0) -> dict[str, Any]:
    """Compare forward kinematics with MuJoCo at random joint positions within the limits.

    Returns: errors of every end-effector, tool and wrist camera, and of all links together; notes on differences that
        are no pose error, such as limits that are not those of the description; whether all errors are tolerable.

    Raises:
        UnavailableError: MuJoCo is not installed, or the kinematic description is not here.
        ConfigError, DataError: the embodiment and its description do not fit each other.
    """
    if samples < 1:
        raise ConfigError("A check needs random joint positions", expected="--samples of at least 1", got=samples)
    if importlib.util.find_spec("mujoco") is None:
        raise UnavailableError(
            "The check compares with MuJoCo, which is not installed",
            expected="the extra `sim`",
            next_step=installing("sim"),
        )
    mujoco = importlib.import_module("mujoco")
    from worldline_core.geometry.kinematics import ArmKinematics  # torch, which the other commands do without

    kinematics = ArmKinematics(embodiment)
    state = random_states(embodiment, samples, seed)
    ours = {name: poses.numpy() for name, poses in kinematics.link_poses(state).items()}
    theirs = _mujoco_poses(mujoco, embodiment, state, kinematics.links)
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
    notes = _limit_notes(embodiment, kinematics.tree)
    if missing := [name for name in kinematics.links if name not in theirs and "#" not in name]:
        notes.append(f"not compared, MuJoCo has no name for them: {', '.join(missing)}")
    return {
        "name": embodiment.name,
        "engine": f"MuJoCo {mujoco.__version__}",
        "samples": samples,
        "seed": seed,
        "errors": errors,
        "notes": notes,
        "tolerances": {"position_m": POSITION_TOLERANCE_M, "rotation_rad": ROTATION_TOLERANCE_RAD},
        "passed": all(error["passed"] for error in errors),
    }


def _pose_error(kind: str, frame: str, poses: np.ndarray, expected: np.ndarray) -> dict[str, Any]:
    """Differences between poses (N, 4, 4) of a frame."""
    position = np.linalg.norm(poses[:, :3, 3] - expected[:, :3, 3], axis=-1)
    rotation = rotation_angle(np.swapaxes(expected[:, :3, :3], -1, -2) @ poses[:, :3, :3])
    return {
        "frame": frame,
        "kind": kind,
        "max_position_m": float(position.max()),
        "mean_position_m": float(position.mean()),
        "max_rotation_rad": float(rotation.max()),
        "mean_rotation_rad": float(rotation.mean()),
        "passed": bool(position.max() <= POSITION_TOLERANCE_M and rotation.max() <= ROTATION_TOLERANCE_RAD),
    }


def format_check(check: dict[str, Any]) -> str:
    """The errors of a check as a table, the verdict last."""
    return "\n".join(
        [
            f"{check['name']}: forward kinematics against {check['engine']}, {check['samples']} random joint positions "
            f"(seed {check['seed']})",
            f"  {'frame':<49} {'max m':>9} {'mean m':>9} {'max rad':>9} {'mean rad':>9}",
            *(
                f"  {e['kind']:<12} {e['frame']:<36} {e['max_position_m']:>9.1e} {e['mean_position_m']:>9.1e} "
                f"{e['max_rotation_rad']:>9.1e} {e['mean_rotation_rad']:>9.1e}  {'ok' if e['passed'] else 'FAILED'}"
                for e in check["errors"]
            ),
            *(f"  note: {note}" for note in check["notes"]),
            f"  {'passed' if check['passed'] else 'FAILED'}: the limit is {POSITION_TOLERANCE_M:g} m and "
            f"{ROTATION_TOLERANCE_RAD:g} rad",
        ]
    )


def random_states(embodiment: Embodiment, samples: int, seed: int = 0) -> np.ndarray:
    """(samples, J) float64: joints uniform within their limits (a whole turn where there is none), grippers too."""
    turn = math.pi if embodiment.joint_units == "rad" else 180.0
    ranges: list[tuple[float, float]] = []
    for arm in embodiment.arms:
        ranges += [(-turn if low == -math.inf else low, turn if high == math.inf else high) for low, high in arm.limits]
        ranges.append((min(arm.gripper.closed, arm.gripper.open), max(arm.gripper.closed, arm.gripper.open)))
    low, high = np.asarray(ranges).T
    return np.random.default_rng(seed).uniform(low, high, (samples, embodiment.state_size))


def _mujoco_poses(
    mujoco: Any, embodiment: Embodiment, state: np.ndarray, links: tuple[str, ...]
) -> dict[str, np.ndarray]:
    """T_base_link (N, 4, 4) of every link that MuJoCo knows by name."""
    model = _compile(mujoco, embodiment)
    data = mujoco.MjData(model)
    addresses = {model.joint(j).name: (int(model.jnt_qposadr[j]), int(model.jnt_type[j])) for j in range(model.njnt)}
    hinge = int(mujoco.mjtJoint.mjJNT_HINGE)
    qpos = np.tile(np.asarray(model.qpos0, dtype=np.float64), (len(state), 1))
    for name, values in _joint_columns(embodiment, state).items():
        address, kind = addresses[name]
        qpos[:, address] = np.deg2rad(values) if embodiment.joint_units == "deg" and kind == hinge else values
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
    """Positions of the joints that the embodiment names, in its own units; read from the YAML's own words."""
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
    mounts = embodiment.description.mounts
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
            in_default = parent.tag == "default" and child.tag not in ("joint", "default")
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


def _limit_notes(embodiment: Embodiment, tree: TreeBody) -> list[str]:
    """Limits of the YAML that are not those of the description."""
    described = {joint.name: joint for body in tree.walk() for joint in body.joints}
    notes = []
    for arm in embodiment.arms:
        for name, limits in zip(arm.joints, arm.limits, strict=True):
            joint = described[name]
            if joint.limits is None:
                continue
            scale = math.pi / 180 if embodiment.joint_units == "deg" and joint.kind == "revolute" else 1.0
            if any(abs(a * scale - b) > LIMIT_TOLERANCE for a, b in zip(limits, joint.limits, strict=True)):
                unit = "rad" if joint.kind == "revolute" else "m"
                notes.append(
                    f"{name}: limits {limits[0] * scale:g} to {limits[1] * scale:g} {unit}, "
                    f"the description has {joint.limits[0]:g} to {joint.limits[1]:g}"
                )
    return notes
