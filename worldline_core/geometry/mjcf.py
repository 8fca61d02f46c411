"""Kinematic trees from MJCF, read without MuJoCo.

The lean install has no simulator, and `pytorch_kinematics.build_chain_from_mjcf` needs one (and fails with MuJoCo 4,
whose joint types are no longer its table's keys). This reader covers what decides the pose of a body: nested bodies
with pos and quat / euler / axisangle / xyaxes / zaxis, hinge and slide joints with pos and axis, joint defaults by
class, sites, and the compiler's angle and eulerseq. Tests compare it with MuJoCo itself.
Geoms, cameras, actuators and the like are passed over; a ball joint, a free joint with children's joints to solve,
`<include>`, `<frame>` or a joint `ref` is refused rather than guessed.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from dataclasses import dataclass, field

import numpy as np

from worldline_core.errors import DataError


@dataclass(frozen=True)
class TreeJoint:
    """One degree of freedom; axis and position in the frame of its body."""

    name: str
    kind: str
    axis: np.ndarray
    position: np.ndarray


@dataclass
class TreeBody:
    """A body (or site): its pose in its parent at joint positions zero, its joints in order, its children."""

    name: str
    T_parent_body: np.ndarray
    joints: list[TreeJoint] = field(default_factory=list)
    children: list[TreeBody] = field(default_factory=list)


def parse_xml(text: str, where: object) -> ET.Element:
    """Root of an XML text, comments dropped.

    Raises:
        DataError: not XML.
    """
    try:
        # The user's own file; expat bounds the expansion of entities and fetches none.
        return ET.fromstring(text.encode())  # noqa: S314
    except ET.ParseError as error:
        raise DataError("Kinematic description is not XML", where=where, got=str(error)) from error


def read_mjcf(text: str, where: object) -> TreeBody:
    """The tree under `world`.

    Raises:
        DataError: not MJCF, or it uses something this reader does not know.
    """
    root = parse_xml(text, where)
    worldbody = root.find("worldbody")
    if root.tag != "mujoco" or worldbody is None:
        raise DataError("Not an MJCF file", where=where, expected="<mujoco> with a <worldbody>", got=f"<{root.tag}>")
    for tag in ("include", "frame", "replicate", "attach"):
        if next(root.iter(tag), None) is not None:
            raise DataError(
                f"MJCF element <{tag}> is not supported here",
                where=where,
                next_step="write the file out flat (mujoco.mj_saveLastXML)",
            )
    return _Reader(root, where).body(worldbody, "world", None)


class _Reader:
    """Holds what bodies inherit: the compiler's settings and the joint defaults by class."""

    def __init__(self, root: ET.Element, where: object) -> None:
        compiler = root.find("compiler")
        settings = {} if compiler is None else compiler.attrib
        self.where = where
        self.to_radians = 1.0 if settings.get("angle", "degree") == "radian" else math.pi / 180
        self.eulerseq = settings.get("eulerseq", "xyz")
        self.joint_defaults: dict[str, dict[str, str]] = {}
        for default in root.findall("default"):
            self._defaults(default, {}, "main")
        self.unnamed = 0
        self.body_names = {element.get("name") for element in root.iter("body")}

    def _defaults(self, element: ET.Element, inherited: dict[str, str], fallback: str) -> None:
        joint = element.find("joint")
        values = {**inherited, **({} if joint is None else joint.attrib)}
        self.joint_defaults[element.get("class", fallback)] = values
        for child in element.findall("default"):
            self._defaults(child, values, fallback)

    def body(self, element: ET.Element, name: str, childclass: str | None) -> TreeBody:
        childclass = element.get("childclass", childclass)
        body = TreeBody(name, self._pose(element))
        for joint in element:
            if joint.tag == "freejoint":
                raise DataError("A free body is no part of a kinematic description", where=f"{self.where}: {name}")
            if joint.tag == "joint":
                body.joints.append(self._joint(joint, name, childclass))
        for child in element:
            if child.tag in ("body", "site"):
                self.unnamed += 1
                child_name = child.get("name", f"{child.tag}_{self.unnamed}")
                if child.tag == "body":
                    body.children.append(self.body(child, child_name, childclass))
                else:
                    # A site may bear the name of a body; link names are unique.
                    unique = f"site:{child_name}" if child_name in self.body_names else child_name
                    body.children.append(TreeBody(unique, self._pose(child)))
        return body

    def _joint(self, element: ET.Element, body: str, childclass: str | None) -> TreeJoint:
        joint_class = element.get("class", childclass) or "main"
        values = {**self.joint_defaults.get(joint_class, {}), **element.attrib}
        kind = {"hinge": "revolute", "slide": "prismatic"}.get(values.get("type", "hinge"))
        if kind is None or float(values.get("ref", "0")) != 0.0:
            raise DataError(
                "Joint is not supported here",
                where=f"{self.where}: body {body}, joint {values.get('name')}",
                expected="type hinge or slide, ref 0",
                got=f"type {values.get('type')}, ref {values.get('ref', '0')}",
            )
        axis = _numbers(values.get("axis", "0 0 1"))
        return TreeJoint(
            values.get("name", f"{body}_joint"), kind, axis / np.linalg.norm(axis), _numbers(values.get("pos", "0 0 0"))
        )

    def _pose(self, element: ET.Element) -> np.ndarray:
        T = np.eye(4)
        T[:3, 3] = _numbers(element.get("pos", "0 0 0"))
        if "quat" in element.attrib:
            T[:3, :3] = _from_quaternion(_numbers(element.attrib["quat"]))
        elif "euler" in element.attrib:
            for letter, angle in zip(self.eulerseq, _numbers(element.attrib["euler"]) * self.to_radians, strict=True):
                turn = _about(np.eye(3)["xyz".index(letter.lower())], float(angle))
                # Lower case: about the moving axes; upper case: about the fixed ones.
                T[:3, :3] = T[:3, :3] @ turn if letter.islower() else turn @ T[:3, :3]
        elif "axisangle" in element.attrib:
            *axis, angle = _numbers(element.attrib["axisangle"])
            T[:3, :3] = _about(np.asarray(axis), float(angle) * self.to_radians)
        elif "xyaxes" in element.attrib:
            numbers = _numbers(element.attrib["xyaxes"])
            x = numbers[:3] / np.linalg.norm(numbers[:3])
            y = numbers[3:] - (numbers[3:] @ x) * x
            y = y / np.linalg.norm(y)
            T[:3, :3] = np.stack([x, y, np.cross(x, y)], axis=1)
        elif "zaxis" in element.attrib:
            z = _numbers(element.attrib["zaxis"])
            z = z / np.linalg.norm(z)
            axis = np.cross([0.0, 0.0, 1.0], z)
            sine = float(np.linalg.norm(axis))
            T[:3, :3] = _about(axis if sine > 1e-12 else np.array([1.0, 0.0, 0.0]), math.atan2(sine, float(z[2])))
        return T


def _numbers(text: str) -> np.ndarray:
    return np.array([float(value) for value in text.split()], dtype=np.float64)


def _from_quaternion(wxyz: np.ndarray) -> np.ndarray:
    w, *xyz = wxyz / np.linalg.norm(wxyz)
    axis = np.asarray(xyz)
    return _about(axis, 2 * math.atan2(float(np.linalg.norm(axis)), float(w)))


def _about(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rotation about an axis of any length (Rodrigues); the identity for a zero axis."""
    length = float(np.linalg.norm(axis))
    if length < 1e-15:
        return np.eye(3)
    x, y, z = axis / length
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * skew + (1 - math.cos(angle)) * (skew @ skew)
