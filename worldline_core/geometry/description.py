"""The kinematic description of a robot (MJCF or URDF): where it is, and how to get it where it is not.

In this order: a path given by the caller, the environment variable `WORLDLINE_DESCRIPTION_<NAME>`, a file of an
installed Python package (`package`), a file beside the embodiment's YAML.

A robot as a tree of bodies and joints, however its description was written.
"""

from __future__ import annotations

import os
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from importlib import metadata
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np
from packaging.specifiers import InvalidSpecifier, SpecifierSet
from pydantic import Field, model_validator

from worldline_core.config import StrictModel
from worldline_core.errors import ConfigError, DataError, UnavailableError
from worldline_core.geometry.transforms import RigidOffset


class Description(StrictModel):
    """The kinematic description.

    Attributes:
        file: path beside the YAML; with `package`, path as in the wheel, package folder first
            (`robosuite/models/assets/...`).
        package: distribution on PyPI that carries the file.
        version: versions of the distribution for which the embodiment was written, for example `>=0.2,<0.3`.
        obtain: how to get the file, in words. With `package` this is `pip install` unless given.
        source: where the file comes from, with version and licence.
        mounts: the description is one arm and is placed once per entry, `T_world_root` each; its links and joints
            bear the entry's name, a slash, and their own name (`left/joint1`), under a common link `world`.
    """

    format: Literal["mjcf", "urdf"]
    file: str = Field(min_length=1)
    package: str | None = None
    version: str | None = None
    obtain: str | None = None
    source: str | None = None
    mounts: dict[str, RigidOffset] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _consistent(self) -> Description:
        if self.version is not None and self.package is None:
            raise ValueError("version says which versions of package fit, and there is no package")
        if self.package is not None:
            path = PurePosixPath(self.file)
            if path.is_absolute() or ".." in path.parts or len(path.parts) < 2:
                raise ValueError(f"file {self.file!r} is not a path inside the package {self.package}")
        if self.version is not None:
            try:
                SpecifierSet(self.version)
            except InvalidSpecifier as error:
                raise ValueError(f"version {self.version!r} is no version specifier like '>=0.2,<0.3'") from error
        return self

    @property
    def how_to_get(self) -> str | None:
        """What a user without the file can do."""
        if self.obtain is None and self.package is not None:
            return f"pip install '{self.package}{self.version or ''}'"
        return self.obtain


def description_variable(name: str) -> str:
    """Environment variable that says where the kinematic description of an embodiment is."""
    return f"WORLDLINE_DESCRIPTION_{name.upper()}"


def locate_description(name: str, description: Description, folder: Path, override: Path | str | None) -> Path:
    """Where the description of an embodiment is, or would be; nothing is opened.

    Args:
        folder: of the embodiment's YAML.
        override: a path that goes before everything else.
    """
    chosen = override or os.environ.get(description_variable(name))
    if chosen:
        return Path(chosen)
    if description.package is not None:
        return _in_package(description, description.package) or Path(description.package) / description.file
    return folder / description.file


def _in_package(description: Description, package: str) -> Path | None:
    """The file of an installed distribution, or None where the distribution is not installed.

    Raises:
        ConfigError: the distribution has no such file, or the file lies outside of its package folder.
        UnavailableError: another version than `version` is installed.
    """
    try:
        distribution = metadata.distribution(package)
    except metadata.PackageNotFoundError:
        return None
    if description.version is not None and not SpecifierSet(description.version).contains(
        distribution.version, prereleases=True
    ):
        raise UnavailableError(
            "The installed package that carries the kinematic description has another version",
            where=package,
            expected=description.version,
            got=distribution.version,
            next_step=f"pip install '{package}{description.version}'",
        )
    top = PurePosixPath(description.file).parts[0]
    root = Path(str(distribution.locate_file(top))).resolve()
    path = Path(str(distribution.locate_file(description.file)))
    if not path.resolve().is_relative_to(root):
        raise ConfigError("The kinematic description lies outside of its package", where=root, got=path.resolve())
    if not path.is_file():
        raise ConfigError(
            "The installed package has no such kinematic description",
            where=f"{package} {distribution.version}",
            expected=description.file,
            next_step="check description.file and description.version of the embodiment",
        )
    return path


def read_description_file(name: str, description: Description, path: Path) -> str:
    """Text of the kinematic description.

    Raises:
        UnavailableError: the file is not there; the message says how to get it.
    """
    if not path.is_file():
        raise UnavailableError(
            f"The kinematic description of {name} is not here",
            where=path,
            expected=description.file,
            next_step=(description.how_to_get or "restore the file beside the embodiment's YAML")
            + (
                ""
                if description.package is not None
                else f"; then set {description_variable(name)}=/path/to/it or pass description_path"
            ),
        )
    return path.read_text(encoding="utf-8")


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
