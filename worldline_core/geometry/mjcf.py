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

import numpy as np

from worldline_core.errors import DataError
from worldline_core.geometry.description import TreeBody, TreeJoint, numbers, parse_xml, unit


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
        self.autolimits = settings.get("autolimits", "true") == "true"
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
        name = values.get("name", f"{body}_joint")
        place = f"{self.where}: joint {name}"
        axis = unit(numbers(values.get("axis", "0 0 1"), 3, place), place)
        return TreeJoint(
            name, kind, axis, numbers(values.get("pos", "0 0 0"), 3, place), self._limits(values, kind, place)
        )

    def _limits(self, values: dict[str, str], kind: str, place: str) -> tuple[float, float] | None:
        limited = values.get("limited", "auto")
        if "range" not in values or limited == "false" or (limited == "auto" and not self.autolimits):
            return None
        lower, upper = numbers(values["range"], 2, place) * (self.to_radians if kind == "revolute" else 1.0)
        return float(lower), float(upper)

    def _pose(self, element: ET.Element) -> np.ndarray:
        place = f"{self.where}: {element.tag} {element.get('name', '')}"
        T = np.eye(4)
        T[:3, 3] = numbers(element.get("pos", "0 0 0"), 3, place)
        if "quat" in element.attrib:
            T[:3, :3] = _from_quaternion(unit(numbers(element.attrib["quat"], 4, place), place))
        elif "euler" in element.attrib:
            angles = numbers(element.attrib["euler"], 3, place) * self.to_radians
            for letter, angle in zip(self.eulerseq, angles, strict=True):
                turn = _about(np.eye(3)["xyz".index(letter.lower())], float(angle))
                # Lower case: about the moving axes; upper case: about the fixed ones.
                T[:3, :3] = T[:3, :3] @ turn if letter.islower() else turn @ T[:3, :3]
        elif "axisangle" in element.attrib:
            *axis, angle = numbers(element.attrib["axisangle"], 4, place)
            T[:3, :3] = _about(np.asarray(axis), float(angle) * self.to_radians)
        elif "xyaxes" in element.attrib:
            axes = numbers(element.attrib["xyaxes"], 6, place)
            x = unit(axes[:3], place)
            y = unit(axes[3:] - (axes[3:] @ x) * x, place)
            T[:3, :3] = np.stack([x, y, np.cross(x, y)], axis=1)
        elif "zaxis" in element.attrib:
            z = unit(numbers(element.attrib["zaxis"], 3, place), place)
            axis = np.cross([0.0, 0.0, 1.0], z)
            sine = float(np.linalg.norm(axis))
            T[:3, :3] = _about(axis if sine > 1e-12 else np.array([1.0, 0.0, 0.0]), math.atan2(sine, float(z[2])))
        return T


def _from_quaternion(wxyz: np.ndarray) -> np.ndarray:
    w, *xyz = wxyz
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
