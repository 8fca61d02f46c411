"""The kinematic description of a robot (an MJCF or URDF file): where it is, and how to get it where it is not.

It is looked for in this order: a path given by the caller, the environment variable `WORLDLINE_DESCRIPTION_<NAME>`, a
file of an installed Python package (`package`), a file beside the embodiment's YAML.
"""

from __future__ import annotations

import math
import os
from importlib import metadata
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np
from packaging.specifiers import InvalidSpecifier, SpecifierSet
from pydantic import Field, model_validator

from worldline_core.config import StrictModel
from worldline_core.errors import ConfigError, UnavailableError
from worldline_core.geometry.rotations import rotation_from_quaternion_wxyz

QUATERNION_TOLERANCE = 1e-3
"""Largest deviation of a quaternion's length from 1 that is taken for rounding and normalised away."""


class RigidOffset(StrictModel):
    """A fixed transform by translation [m] and quaternion (wxyz); a length within 1e-3 of 1 is normalised."""

    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation_wxyz: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)

    @model_validator(mode="after")
    def _proper(self) -> RigidOffset:
        if not all(math.isfinite(value) for value in (*self.translation, *self.rotation_wxyz)):
            raise ValueError("translation and rotation_wxyz must be finite numbers")
        norm = float(np.linalg.norm(self.rotation_wxyz))
        if norm == 0.0:
            raise ValueError("rotation_wxyz is the zero quaternion, which is no rotation (no rotation: 1 0 0 0)")
        if abs(norm - 1.0) > QUATERNION_TOLERANCE:
            raise ValueError(f"rotation_wxyz has length {norm:.6f}, expected 1")
        return self

    def matrix(self) -> np.ndarray:
        """(4, 4) float64."""
        T = np.eye(4)
        T[:3, :3] = rotation_from_quaternion_wxyz(np.array(self.rotation_wxyz))
        T[:3, 3] = self.translation
        return T


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
