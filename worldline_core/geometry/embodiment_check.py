"""An embodiment's forward kinematics checked against MuJoCo.

MuJoCo is an independent engine here: nothing of this project's readers is used on its side. The description's text goes
to MuJoCo's own MJCF or URDF compiler, after meshes and all else that decides no pose were taken out (they are often not
there).
"""

from __future__ import annotations

import importlib
import importlib.util
import math
import xml.etree.ElementTree as ET
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from worldline_core.errors import ConfigError, UnavailableError, installing
from worldline_core.geometry.embodiment import Embodiment, RigidOffset, read_description
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


@dataclass(frozen=True)
class PoseError:
    """Difference between this project's pose of a frame and MuJoCo's, over all samples."""

    frame: str
    kind: str
    max_position_m: float
    mean_position_m: float
    max_rotation_rad: float
    mean_rotation_rad: float

    @property
    def passed(self) -> bool:
        """Whether both maxima are within the tolerances."""
        return self.max_position_m <= POSITION_TOLERANCE_M and self.max_rotation_rad <= ROTATION_TOLERANCE_RAD


@dataclass(frozen=True)
class EmbodimentCheck:
    """What comparing an embodiment with MuJoCo gave.

    Attributes:
        errors: by frame: every end-effector, tool and wrist camera, and the worst of all links together.
        notes: differences that are no pose error, such as limits that are not those of the description.
    """

    name: str
    engine: str
    samples: int
    seed: int
    errors: tuple[PoseError, ...]
    notes: tuple[str, ...]

    @property
    def passed(self) -> bool:
        """Whether every frame is within the tolerances."""
        return all(error.passed for error in self.errors)


def check_embodiment(embodiment: Embodiment, samples: int = 1000, seed: int = 0) -> EmbodimentCheck:
    """Compare forward kinematics with MuJoCo at random joint positions within the limits.

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
    errors: list[PoseError] = []
    for index, arm in enumerate(embodiment.arms):
        flange = theirs[arm.end_effector_link]
        errors.append(_pose_error("end-effector", arm.end_effector_link, ours[arm.end_effector_link], flange))
        expected = flange @ _offset_matrix(mujoco, arm.T_link_tool)
        errors.append(_pose_error("tool", arm.name, tools[:, index], expected))
        if arm.wrist_camera is not None:
            expected = theirs[arm.wrist_camera.link] @ np.asarray(arm.wrist_camera.T_link_camera, dtype=np.float64)
            errors.append(_pose_error("camera", arm.camera_view, cameras[arm.camera_view].numpy(), expected))
    links = [_pose_error("link", name, ours[name], theirs[name]) for name in kinematics.links if name in theirs]
    worst = max(links, key=lambda e: max(e.max_position_m, e.max_rotation_rad))
    together = PoseError(
        f"{len(links)} links, worst {worst.frame}",
        "all links",
        max(e.max_position_m for e in links),
        float(np.mean([e.mean_position_m for e in links])),
        max(e.max_rotation_rad for e in links),
        float(np.mean([e.mean_rotation_rad for e in links])),
    )
    notes = _limit_notes(embodiment, kinematics.tree)
    if missing := [name for name in kinematics.links if name not in theirs and "#" not in name]:
        notes.append(f"not compared, MuJoCo has no name for them: {', '.join(missing)}")
    engine = f"MuJoCo {mujoco.__version__}"
    return EmbodimentCheck(embodiment.name, engine, samples, seed, (*errors, together), tuple(notes))


def _pose_error(kind: str, frame: str, poses: np.ndarray, expected: np.ndarray) -> PoseError:
    """Of poses (N, 4, 4)."""
    position = np.linalg.norm(poses[:, :3, 3] - expected[:, :3, 3], axis=-1)
    rotation = rotation_angle(np.swapaxes(expected[:, :3, :3], -1, -2) @ poses[:, :3, :3])
    return PoseError(frame, kind, *(float(value) for m in (position, rotation) for value in (m.max(), m.mean())))


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


_BOUNDS = {"boundmass": "0.001", "boundinertia": "0.000001"}


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


def _offset_matrix(mujoco: Any, offset: RigidOffset) -> np.ndarray:
    """(4, 4) of a fixed offset, its quaternion converted by MuJoCo."""
    flat, T = np.zeros(9), np.eye(4)
    mujoco.mju_quat2Mat(flat, np.asarray(offset.rotation_wxyz) / np.linalg.norm(offset.rotation_wxyz))
    T[:3, :3], T[:3, 3] = flat.reshape(3, 3), offset.translation
    return T


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


def format_check(check: EmbodimentCheck) -> str:
    """The errors of a check as a table, the verdict last."""
    rows = [
        f"  {e.kind:<12} {e.frame:<36} {e.max_position_m:>9.1e} {e.mean_position_m:>9.1e} "
        f"{e.max_rotation_rad:>9.1e} {e.mean_rotation_rad:>9.1e}  {'ok' if e.passed else 'FAILED'}"
        for e in check.errors
    ]
    verdict = "passed" if check.passed else "FAILED"
    return "\n".join(
        [
            f"{check.name}: forward kinematics against {check.engine}, {check.samples} random joint positions (seed "
            f"{check.seed})",
            f"  {'frame':<49} {'max m':>9} {'mean m':>9} {'max rad':>9} {'mean rad':>9}",
            *rows,
            *(f"  note: {note}" for note in check.notes),
            f"  {verdict}: the limit is {POSITION_TOLERANCE_M:g} m and {ROTATION_TOLERANCE_RAD:g} rad",
        ]
    )


def check_as_json(check: EmbodimentCheck) -> dict[str, Any]:
    """The same as plain values."""
    errors = [{**asdict(error), "passed": error.passed} for error in check.errors]
    tolerances = {"position_m": POSITION_TOLERANCE_M, "rotation_rad": ROTATION_TOLERANCE_RAD}
    return {**asdict(check), "errors": errors, "tolerances": tolerances, "passed": check.passed}
