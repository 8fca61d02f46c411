"""Kinematic trees from URDF, in float64.

`pytorch_kinematics` reads URDF in float32 (about 1e-7 of the robot's size lost at every joint) and stops at planar and
floating joints with a KeyError; this reader is exact and says what it does not know. Links, joints, their origins,
axes and limits are read; everything else (meshes, inertia, vendor tags) decides no pose. A `mimic` joint is a joint
of its own here: the embodiment lists it among its finger joints.
Reference: https://wiki.ros.org/urdf/XML/joint: origin is T_parent_child at position zero, rpy about fixed axes
(R = Rz Ry Rx), the axis is given in the child's frame.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET

import numpy as np

from worldline_core.errors import DataError
from worldline_core.geometry.description import TreeBody, TreeJoint, numbers, parse_xml, unit

_KINDS = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic", "fixed": None}


def read_urdf(text: str, where: object) -> TreeBody:
    """The tree under the root link.

    Raises:
        DataError: not a URDF; a joint without a link, a link with two parents, none or several roots, or a kind of
            joint that is not known here.
    """
    robot = parse_xml(text, where)
    if robot.tag != "robot":
        raise DataError("Not a URDF file", where=where, expected="<robot> with links and joints", got=f"<{robot.tag}>")
    bodies: dict[str, TreeBody] = {}
    for link in robot.findall("link"):
        name = link.get("name", "")
        if not name or name in bodies:
            raise DataError("A link without a name, or named twice", where=where, got=name)
        bodies[name] = TreeBody(name, np.eye(4))
    parents: dict[str, str] = {}
    for joint in robot.findall("joint"):
        parent, child = (_end(joint, end, bodies, where) for end in ("parent", "child"))
        if child in parents:
            raise DataError("A link has two parents", where=f"{where}: {child}", got=f"{parents[child]} and {parent}")
        parents[child] = parent
        body = bodies[child]
        body.T_parent_body = _origin(joint, where)
        body.joints = _degrees_of_freedom(joint, where)
        bodies[parent].children.append(body)
    roots = [name for name in bodies if name not in parents]
    if len(roots) != 1:
        raise DataError(
            "A URDF has one root link", where=where, expected="one link that is nobody's child", got=f"{roots}"
        )
    root = bodies[roots[0]]
    if (reached := sum(1 for _ in root.walk())) != len(bodies):
        raise DataError(
            "Links go round in a circle", where=where, got=f"{reached} of {len(bodies)} reached from {roots}"
        )
    return root


def _end(joint: ET.Element, end: str, bodies: dict[str, TreeBody], where: object) -> str:
    element = joint.find(end)
    name = "" if element is None else element.get("link", "")
    if name not in bodies:
        raise DataError(
            f"A joint's {end} is no link of the description",
            where=f"{where}: joint {joint.get('name')}",
            expected=f"one of {', '.join(bodies)}",
            got=name,
        )
    return name


def _origin(joint: ET.Element, where: object) -> np.ndarray:
    T = np.eye(4)
    origin = joint.find("origin")
    if origin is None:
        return T
    place = f"{where}: joint {joint.get('name')}, origin"
    T[:3, 3] = numbers(origin.get("xyz", "0 0 0"), 3, place)
    roll, pitch, yaw = numbers(origin.get("rpy", "0 0 0"), 3, place)
    cr, sr, cp, sp, cy, sy = (f(a) for a in (roll, pitch, yaw) for f in (math.cos, math.sin))
    T[:3, :3] = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return T


def _degrees_of_freedom(joint: ET.Element, where: object) -> list[TreeJoint]:
    name, kind = joint.get("name", ""), joint.get("type", "")
    place = f"{where}: joint {name}"
    if not name or kind not in _KINDS:
        raise DataError("Joint is not supported here", where=place, expected=f"one of {', '.join(_KINDS)}", got=kind)
    if _KINDS[kind] is None:
        return []
    axis = joint.find("axis")
    direction = unit(numbers("1 0 0" if axis is None else axis.get("xyz", "1 0 0"), 3, place), place)
    return [TreeJoint(name, str(_KINDS[kind]), direction, np.zeros(3), _limits(joint, kind, place))]


def _limits(joint: ET.Element, kind: str, place: str) -> tuple[float, float] | None:
    limit = joint.find("limit")
    if limit is None or kind == "continuous":
        return None
    lower, upper = (float(numbers(limit.get(key, "0"), 1, place)[0]) for key in ("lower", "upper"))
    return (lower, upper)
