"""A robot as a tree of bodies and joints, read from MJCF or URDF without MuJoCo, in float64 (`pytorch_kinematics` reads
URDF in float32, and MJCF with MuJoCo only). Tests compare both readers with MuJoCo itself.

MJCF: nested bodies and sites with pos and quat, euler, axisangle, xyaxes or zaxis, hinge and slide joints, defaults of joints
and sites by class, the compiler's angle and eulerseq; sections that are there twice are merged, as MuJoCo does. URDF: links, joints, origins and axes; a `mimic` joint is a joint of its own, listed
among the embodiment's finger joints. All else that decides a pose is refused by name.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType

import numpy as np

from worldline_core.errors import DataError
from worldline_core.geometry.embodiment import Embodiment, RigidOffset, read_description
from worldline_core.geometry.transforms import rotation_about_axis, rotation_from_euler_fixed_xyz

_UNDECLARED_PREFIX = re.compile(r"</?([A-Za-z_][\w.-]*):|\s([A-Za-z_][\w.-]*):[\w.-]+\s*=")
MAX_BODIES, MAX_DEPTH = 5_000, 200
"""Bodies, links and sites of one description, and how many hang below each other; robots have some hundreds."""
_URDF_KINDS = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic", "fixed": None}
_MJCF_KINDS = {"hinge": "revolute", "slide": "prismatic"}
_ORIENTATIONS = ("quat", "euler", "axisangle", "xyaxes", "zaxis")
_MOVED_OTHERWISE = {"body": ("mocap",), "site": ("fromto",), "compiler": ("coordinate",)}
"""Attributes of MJCF that decide a pose in a way that this reader does not know."""
_XACRO = re.compile(r"\$[{(]")


@dataclass(frozen=True)
class TreeJoint:
    """One degree of freedom; `kind` is revolute or prismatic, axis (unit) and position [m] are in its body's frame."""

    name: str
    kind: str
    axis: np.ndarray
    position: np.ndarray


@dataclass(eq=False)
class TreeBody:
    """A body, link or site: its pose in its parent at joint positions zero, its joints in order, its children."""

    name: str
    T_parent_body: np.ndarray
    joints: list[TreeJoint] = field(default_factory=list)
    children: list[TreeBody] = field(default_factory=list)

    def walk(self) -> Iterator[TreeBody]:
        """This body and everything below it, parents first."""
        yield self
        for child in self.children:
            yield from child.walk()

    def prefixed(self, prefix: str) -> TreeBody:
        """A copy in which every body and joint is named `prefix/name`."""
        joints = [replace(joint, name=f"{prefix}/{joint.name}") for joint in self.joints]
        children = [child.prefixed(prefix) for child in self.children]
        return TreeBody(f"{prefix}/{self.name}", self.T_parent_body, joints, children)


def mounted(tree: TreeBody, T_world_root: Mapping[str, np.ndarray]) -> TreeBody:
    """One copy of a tree for each entry under a body `world`, its names prefixed by the entry's and a slash."""
    copies = [(tree.prefixed(name), T) for name, T in T_world_root.items()]
    children = [replace(copy, T_parent_body=T @ tree.T_parent_body) for copy, T in copies]
    return TreeBody("world", np.eye(4), children=children)


def parse_xml(text: str, where: object) -> ET.Element:
    """Root of an XML text, comments dropped.

    Descriptions made by xacro often keep a prefix whose namespace they no longer declare (`drake:acceleration`);
    ROS and MuJoCo read those, so they are declared here.

    Raises: DataError when the text is not XML.
    """
    # Expat bounds the expansion of entities and fetches none.
    try:
        return ET.fromstring(text.encode())  # noqa: S314
    except (ET.ParseError, ValueError, LookupError) as error:  # the last two: of its encoding
        problem = error
    if "unbound prefix" in str(problem):
        prefixes = sorted({name for match in _UNDECLARED_PREFIX.findall(text) for name in match} - {"", "xml", "xmlns"})
        declarations = "".join(f' xmlns:{p}="urn:{p}"' for p in prefixes if f"xmlns:{p}=" not in text)
        declared = re.sub(r"<(robot|mujoco)\b", rf"<\1{declarations}", text, count=1)
        try:
            return ET.fromstring(declared.encode())  # noqa: S314
        except ET.ParseError as error:
            problem = error
    raise DataError("Kinematic description is not XML", where=where, got=str(problem))


def _check_expanded(root: ET.Element, where: object) -> None:
    """Raises: DataError when expressions or elements of xacro are left in a description."""
    for element in root.iter():
        found = [f"{name}={value!r}" for name, value in element.attrib.items() if _XACRO.search(value)]
        if "xacro" in element.tag or (found and element.tag not in ("mesh", "texture", "material")):
            raise DataError(
                "Description holds xacro that was not expanded",
                where=where,
                got=f"<{element.tag.rpartition('}')[2]} {' '.join(found)}>",
                next_step="expand it first: xacro FILE > robot.urdf",
            )


def _check_size[T](root: T, children: Callable[[T], Iterable[T]], where: object) -> None:
    """Raises: DataError for more bodies or deeper chains than readers of trees, which call themselves, can take."""
    level, bodies, depth = [root], 1, 1
    while level := [child for element in level for child in children(element)]:
        bodies, depth = bodies + len(level), depth + 1
        _require_size(bodies, depth, where)


def _require_size(bodies: int, depth: int, where: object) -> None:
    if bodies > MAX_BODIES or depth > MAX_DEPTH:
        limit = f"at most {MAX_BODIES:,} bodies, {MAX_DEPTH} below each other"
        raise DataError("Kinematic description is too large", where=where, expected=limit, got=(bodies, depth))


def _check_names(tree: TreeBody, where: object) -> None:
    """Raises: DataError when two joints have one name: a column of the state would turn both."""
    joints = Counter(joint.name for body in tree.walk() for joint in body.joints)
    if doubled := [name for name, count in joints.items() if count > 1]:
        raise DataError("Joints have the same name", where=where, got=", ".join(doubled[:8]))


def _numbers(text: str, count: int, where: object) -> np.ndarray:
    """(count,) float64 from an attribute.

    Raises: DataError for another number of values, or one that is not a finite number.
    """
    try:
        values = np.array([float(value) for value in text.split()], dtype=np.float64)
    except ValueError as error:
        raise DataError("Not numbers", where=where, expected=f"{count} numbers", got=text) from error
    if len(values) != count or not np.isfinite(values).all():
        raise DataError("Not the numbers that belong here", where=where, expected=f"{count} finite numbers", got=text)
    return values


def _unit(vector: np.ndarray, where: object) -> np.ndarray:
    """The vector at length 1.

    Raises: DataError when it is zero, or so long or short that its square is no number.
    """
    length = float(np.linalg.norm(vector))
    if not 1e-100 < length < 1e100:
        expected = "a vector that is not zero, and not beyond 1e100"
        raise DataError(
            "A direction of length zero, or without a usable one",
            where=where,
            expected=expected,
            got=f"length {length:g}",
        )
    return vector / length


def read_mjcf(text: str, where: object) -> TreeBody:
    """The tree under `world`.

    Raises: DataError when the text is not MJCF, or uses something this reader does not know.
    """
    root = parse_xml(text, where)
    worlds = root.findall("worldbody")
    if root.tag != "mujoco" or not worlds:
        raise DataError("Not an MJCF file", where=where, expected="<mujoco> with a <worldbody>", got=f"<{root.tag}>")
    _check_expanded(root, where)
    worldbody, *others = worlds
    for other in others:
        worldbody.extend(list(other))
    for tag in ("include", "frame", "replicate", "attach"):
        if next(root.iter(tag), None) is not None:
            raise DataError(
                f"MJCF element <{tag}> is not supported here",
                where=where,
                next_step="write the file out flat (mujoco.mj_saveLastXML)",
            )
    for tag, names in _MOVED_OTHERWISE.items():
        for element in root.iter(tag):
            if unread := [f'{name}="{element.get(name)}"' for name in names if element.get(name, "false") != "false"]:
                raise DataError(
                    f"Attribute of a {tag} is not supported here",
                    where=f"{where}: {tag} {element.get('name', '')}".rstrip(),
                    got=", ".join(unread),
                    next_step="give the pose by pos and quat (mujoco.mj_saveLastXML writes it so)",
                )
    for part, tags in ((worldbody, ("body", "site")), (root, ("default",))):
        _check_size(part, lambda element, tags=tags: (child for child in element if child.tag in tags), where)
    tree = _MjcfReader(root, where).body(worldbody, "world", None)
    _check_names(tree, where)
    return tree


def overlaid(inherited: Mapping[str, str], own: Mapping[str, str]) -> dict[str, str]:
    """Attributes of both, the own ones first; an own orientation, in any form, replaces the inherited one."""
    replaced = _ORIENTATIONS if any(name in own for name in _ORIENTATIONS) else ()
    return {**{name: value for name, value in inherited.items() if name not in replaced}, **own}


def mjcf_defaults(root: ET.Element, tags: Iterable[str], where: object) -> dict[str, dict[str, dict[str, str]]]:
    """Default attributes of elements with these tags, by class; a class inherits those of the one around it.

    Raises: DataError for a class without a name, or one that is there twice.
    """
    defaults: dict[str, dict[str, dict[str, str]]] = {"main": {tag: {} for tag in tags}}

    def read(element: ET.Element, name: str, parent: str) -> None:
        defaults[name] = dict(defaults[parent])
        for tag in defaults[name]:
            for part in element.findall(tag):
                defaults[name][tag] = overlaid(defaults[name][tag], part.attrib)
        for child in element.findall("default"):
            child_name = child.get("class", "")
            if not child_name or child_name in defaults:
                raise DataError("A class of defaults has no name, or is there twice", where=where, got=child_name)
            read(child, child_name, name)

    for default in root.findall("default"):
        read(default, "main", "main")
    return defaults


class _MjcfReader:
    """Reader of an MJCF; holds what bodies inherit: the compiler's settings and the joint defaults by class."""

    def __init__(self, root: ET.Element, where: object) -> None:
        settings = {name: value for part in root.findall("compiler") for name, value in part.attrib.items()}
        self.where = where
        self.to_radians = 1.0 if settings.get("angle", "degree") == "radian" else math.pi / 180
        self.eulerseq = settings.get("eulerseq", "xyz")
        if not re.fullmatch("[xyzXYZ]{3}", self.eulerseq):
            raise DataError("Not a sequence of axes", where=f"{where}: eulerseq", expected="xyz", got=self.eulerseq)
        self.defaults = mjcf_defaults(root, ("joint", "site"), where)
        self.unnamed = 0
        self.body_names = {element.get("name") for element in root.iter("body")}

    def _with_defaults(self, element: ET.Element, childclass: str | None) -> dict[str, str]:
        """Attributes of a joint or site, with those of its class."""
        name = element.get("class", childclass) or "main"
        if name not in self.defaults:
            place = f"{self.where}: {element.tag} {element.get('name', '')}"
            raise DataError("No such class of defaults", where=place, expected=", ".join(self.defaults), got=name)
        return overlaid(self.defaults[name][element.tag], element.attrib)

    def body(self, element: ET.Element, name: str, childclass: str | None) -> TreeBody:
        childclass = element.get("childclass", childclass)
        body = TreeBody(name, self._pose(element, element.attrib))
        if element.find("freejoint") is not None:
            raise DataError("A free body is no part of a kinematic description", where=f"{self.where}: {name}")
        body.joints = [self._joint(joint, name, childclass) for joint in element.findall("joint")]
        for child in element:
            if child.tag not in ("body", "site"):
                continue
            self.unnamed += 1
            child_name = child.get("name", f"{child.tag}_{self.unnamed}")
            if child.tag == "body":
                body.children.append(self.body(child, child_name, childclass))
            else:
                # A site may have the name of a body; link names are unique.
                unique = f"site:{child_name}" if child_name in self.body_names else child_name
                pose = self._pose(child, self._with_defaults(child, childclass))
                body.children.append(TreeBody(unique, pose))
        return body

    def _joint(self, element: ET.Element, body: str, childclass: str | None) -> TreeJoint:
        values = self._with_defaults(element, childclass)
        kind = _MJCF_KINDS.get(values.get("type", "hinge"))
        reference = _numbers(values.get("ref", "0"), 1, f"{self.where}: ref of a joint of {body}")[0]
        if kind is None or reference != 0.0:
            raise DataError(
                "Joint is not supported here",
                where=f"{self.where}: body {body}, joint {values.get('name')}",
                expected="type hinge or slide, ref 0",
                got=f"type {values.get('type')}, ref {values.get('ref', '0')}",
            )
        name = values.get("name", f"{body}_joint")
        place = f"{self.where}: joint {name}"
        axis = _unit(_numbers(values.get("axis", "0 0 1"), 3, place), place)
        return TreeJoint(name, kind, axis, _numbers(values.get("pos", "0 0 0"), 3, place))

    def _pose(self, element: ET.Element, given: Mapping[str, str]) -> np.ndarray:
        """T_parent_body from pos and the one form of orientation among five that is given."""
        place = f"{self.where}: {element.tag} {element.get('name', '')}"
        if len(forms := [name for name in _ORIENTATIONS if name in given]) > 1:
            raise DataError("An orientation is given twice", where=place, expected="one form", got=", ".join(forms))
        T = np.eye(4)
        T[:3, 3] = _numbers(given.get("pos", "0 0 0"), 3, place)
        if "quat" in given:
            w, *xyz = _unit(_numbers(given["quat"], 4, place), place)
            # Through axis and angle: digests of action tracks hold the last bit of this.
            T[:3, :3] = rotation_about_axis(np.array(xyz), 2 * math.atan2(float(np.linalg.norm(xyz)), float(w)))
        elif "euler" in given:
            for letter, angle in zip(self.eulerseq, _numbers(given["euler"], 3, place) * self.to_radians, strict=True):
                turn = rotation_about_axis(np.eye(3)["xyz".index(letter.lower())], float(angle))
                # Lower case: about the moving axes; upper case: about the fixed ones.
                T[:3, :3] = T[:3, :3] @ turn if letter.islower() else turn @ T[:3, :3]
        elif "axisangle" in given:
            *axis, angle = _numbers(given["axisangle"], 4, place)
            T[:3, :3] = rotation_about_axis(np.asarray(axis), float(angle) * self.to_radians)
        elif "xyaxes" in given:
            axes = _numbers(given["xyaxes"], 6, place)
            x = _unit(axes[:3], place)
            y = _unit(axes[3:] - (axes[3:] @ x) * x, place)
            T[:3, :3] = np.stack([x, y, np.cross(x, y)], axis=1)
        elif "zaxis" in given:
            z = _unit(_numbers(given["zaxis"], 3, place), place)
            axis = np.cross([0.0, 0.0, 1.0], z)
            sine = float(np.linalg.norm(axis))
            axis = axis if sine > 1e-12 else np.array([1.0, 0.0, 0.0])
            T[:3, :3] = rotation_about_axis(axis, math.atan2(sine, float(z[2])))
        return T


def read_urdf(text: str, where: object) -> TreeBody:
    """The tree under the root link.

    Raises: DataError for what is no URDF, a joint without a link, a link with two parents, none or several roots, or a
        kind of joint that is not known here.
    """
    robot = parse_xml(text, where)
    if robot.tag != "robot":
        raise DataError("Not a URDF file", where=where, expected="<robot> with links and joints", got=f"<{robot.tag}>")
    _check_expanded(robot, where)
    bodies: dict[str, TreeBody] = {}
    links = robot.findall("link")
    _require_size(len(links), 1, where)
    for link in links:
        name = link.get("name", "")
        if not name or name in bodies:
            raise DataError("A link without a name, or named twice", where=where, got=name)
        bodies[name] = TreeBody(name, np.eye(4))
    parents: dict[str, str] = {}
    for joint in robot.findall("joint"):
        parent, child = (_joint_end(joint, end, bodies, where) for end in ("parent", "child"))
        if child in parents:
            raise DataError("A link has two parents", where=f"{where}: {child}", got=f"{parents[child]} and {parent}")
        parents[child] = parent
        bodies[child].T_parent_body = _urdf_origin(joint, where)
        bodies[child].joints = _urdf_joints(joint, where)
        bodies[parent].children.append(bodies[child])
    roots = [name for name in bodies if name not in parents]
    if len(roots) != 1:
        raise DataError("A URDF has one root link", where=where, expected="one without a parent", got=f"{roots[:8]}")
    root = bodies[roots[0]]
    _check_size(root, lambda body: body.children, where)
    _check_names(root, where)
    if (reached := sum(1 for _ in root.walk())) != len(bodies):
        raise DataError("Links form a circle", where=where, got=f"{reached} of {len(bodies)} reached from {roots}")
    return root


def _joint_end(joint: ET.Element, end: str, bodies: dict[str, TreeBody], where: object) -> str:
    """Name of the parent or child link of a joint."""
    element = joint.find(end)
    name = "" if element is None else element.get("link", "")
    if name not in bodies:
        raise DataError(
            f"A joint's {end} is no link of the description",
            where=f"{where}: joint {joint.get('name')}",
            expected=f"one of {', '.join(list(bodies)[:40])}",
            got=name,
        )
    return name


def _urdf_origin(joint: ET.Element, where: object) -> np.ndarray:
    """T_parent_child at position zero; rpy is about fixed axes."""
    T = np.eye(4)
    origin = joint.find("origin")
    if origin is not None:
        place = f"{where}: joint {joint.get('name')}, origin"
        if unread := sorted(set(origin.attrib) - {"xyz", "rpy"}):
            raise DataError(
                "Attribute of an origin is not supported here",
                where=place,
                expected="xyz and rpy",
                got=", ".join(f'{name}="{origin.get(name)}"' for name in unread),
                next_step="write the rotation as rpy: most simulators read nothing else",
            )
        T[:3, 3] = _numbers(origin.get("xyz", "0 0 0"), 3, place)
        T[:3, :3] = rotation_from_euler_fixed_xyz(_numbers(origin.get("rpy", "0 0 0"), 3, place))
    return T


def _urdf_joints(joint: ET.Element, where: object) -> list[TreeJoint]:
    """The joint's one degree of freedom, none of a fixed one; its axis is given in the child's frame."""
    name, kind = joint.get("name", ""), joint.get("type", "")
    place = f"{where}: joint {name}"
    if not name or kind not in _URDF_KINDS:
        expected = f"one of {', '.join(_URDF_KINDS)}"
        raise DataError("Joint is not supported here", where=place, expected=expected, got=kind)
    moves = _URDF_KINDS[kind]
    if moves is None:
        return []
    axis = joint.find("axis")
    direction = _unit(_numbers("1 0 0" if axis is None else axis.get("xyz", "1 0 0"), 3, place), place)
    return [TreeJoint(name, moves, direction, np.zeros(3))]


def read_tree(embodiment: Embodiment) -> TreeBody:
    """The tree of an embodiment's description, with its mounts; the same object for the same description.

    Raises:
        UnavailableError, DataError: it cannot be read.
        ConfigError: a mount is unknown.
    """
    mounts = embodiment.known_mounts()
    text, path = read_description(embodiment), embodiment.description_path
    return _read(text, path, embodiment.description.format, tuple(mounts.items()))


@lru_cache(maxsize=64)
def _read(text: str, path: Path, form: str, mounts: tuple[tuple[str, RigidOffset], ...]) -> TreeBody:
    tree = read_urdf(text, path) if form == "urdf" else read_mjcf(text, path)
    return mounted(tree, {name: offset.matrix() for name, offset in mounts}) if mounts else tree


def tool_poses(
    embodiment: Embodiment, tree: TreeBody, state: np.ndarray, posture: Mapping[str, float] = MappingProxyType({})
) -> np.ndarray:
    """T_base_tool (n, a, 4, 4) of a state (n, j), as `ArmKinematics.tool_poses` without torch; fingers are at zero.

    Args:
        posture: positions [rad, m] of joints outside the state; the embodiment's own where not given.
    """
    from scipy.spatial.transform import Rotation  # takes a third of a reader's start, which few need

    positions: dict[str, np.ndarray] = {
        name: np.full(len(state), value) for name, value in {**embodiment.posture, **posture}.items()
    }
    for arm in embodiment.arms:
        start = embodiment.joint_columns(arm).start
        positions.update({name: state[:, start + i] for i, name in enumerate(arm.joints)})
    poses: dict[str, np.ndarray] = {}

    def place(body: TreeBody, T_root_parent: np.ndarray) -> None:
        T = T_root_parent @ body.T_parent_body
        for joint in body.joints:
            position = np.asarray(positions.get(joint.name, np.zeros(len(state))), dtype=np.float64)[:, None]
            step = np.tile(np.eye(4), (len(state), 1, 1))
            if joint.kind == "revolute":  # about the joint's own place
                step[:, :3, :3] = Rotation.from_rotvec(position * joint.axis).as_matrix()
                step[:, :3, 3] = joint.position - step[:, :3, :3] @ joint.position
            else:
                step[:, :3, 3] = position * joint.axis
            T = T @ step
        poses[body.name] = T
        for child in body.children:
            place(child, T)

    place(tree, np.tile(np.eye(4), (len(state), 1, 1)))
    T_base_root = np.linalg.inv(poses[embodiment.base_link])
    tools = [T_base_root @ poses[arm.end_effector_link] @ arm.T_link_tool.matrix() for arm in embodiment.arms]
    return np.stack(tools, axis=1)
