"""A robot as a tree of bodies and joints, however its description was written."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from worldline_core.errors import DataError

_PREFIX = re.compile(r"</?([A-Za-z_][\w.-]*):|\s([A-Za-z_][\w.-]*):[\w.-]+\s*=")


@dataclass(frozen=True)
class TreeJoint:
    """One degree of freedom; `kind` is revolute or prismatic, axis (unit) and position [m] are in its body's frame.

    `limits` [rad or m] are those of the description, None where it sets none.
    """

    name: str
    kind: str
    axis: np.ndarray
    position: np.ndarray
    limits: tuple[float, float] | None = None


@dataclass
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


def kept_for(tree: TreeBody, wanted: set[str]) -> TreeBody | None:
    """The part of a tree that decides the poses of some bodies: they and what lies between them and the root."""
    children = [kept for child in tree.children if (kept := kept_for(child, wanted)) is not None]
    if not children and tree.name not in wanted:
        return None
    return replace(tree, children=children)


def mounted(tree: TreeBody, T_world_root: Mapping[str, np.ndarray]) -> TreeBody:
    """One copy of a tree for each entry under a body `world`, its names prefixed by the entry's and a slash."""
    world = TreeBody("world", np.eye(4))
    for prefix, T in T_world_root.items():
        copy = _prefixed(tree, prefix)
        copy.T_parent_body = T @ tree.T_parent_body
        world.children.append(copy)
    return world


def _prefixed(body: TreeBody, prefix: str) -> TreeBody:
    return TreeBody(
        f"{prefix}/{body.name}",
        body.T_parent_body,
        [replace(joint, name=f"{prefix}/{joint.name}") for joint in body.joints],
        [_prefixed(child, prefix) for child in body.children],
    )


def parse_xml(text: str, where: object) -> ET.Element:
    """Root of an XML text, comments dropped.

    Descriptions made by xacro often keep a prefix whose namespace they no longer declare (`drake:acceleration`);
    ROS and MuJoCo read those, so they are declared here.

    Raises:
        DataError: not XML.
    """
    try:
        return _parse(text)
    except ET.ParseError as error:
        if "unbound prefix" in str(error):
            prefixes = sorted({name for match in _PREFIX.findall(text) for name in match} - {"", "xml", "xmlns"})
            declarations = "".join(f' xmlns:{p}="urn:{p}"' for p in prefixes if f"xmlns:{p}=" not in text)
            declared = re.sub(r"<(robot|mujoco)\b", rf"<\1{declarations}", text, count=1)
            try:
                return _parse(declared)
            except ET.ParseError as still:
                error = still
        raise DataError("Kinematic description is not XML", where=where, got=str(error)) from error


def _parse(text: str) -> ET.Element:
    # The user's own file; expat bounds the expansion of entities and fetches none.
    return ET.fromstring(text.encode())  # noqa: S314


def numbers(text: str, count: int, where: object) -> np.ndarray:
    """(count,) float64 from an attribute.

    Raises:
        DataError: another number of values, or one that is not a finite number.
    """
    try:
        values = np.array([float(value) for value in text.split()], dtype=np.float64)
    except ValueError as error:
        raise DataError("Not numbers", where=where, expected=f"{count} numbers", got=text) from error
    if len(values) != count or not np.isfinite(values).all():
        raise DataError("Not the numbers that belong here", where=where, expected=f"{count} finite numbers", got=text)
    return values


def unit(vector: np.ndarray, where: object) -> np.ndarray:
    """The vector at length 1.

    Raises:
        DataError: it is zero.
    """
    length = float(np.linalg.norm(vector))
    if length == 0.0:
        raise DataError("A direction of length zero", where=where, expected="a vector that is not zero")
    return vector / length
