"""Robots as data: arms, joint order, tools, grippers, wrist cameras.

One YAML file per embodiment: the package's, those of `configs/embodiments` in the working folder, those that opened recordings
carry with them, or any that is named by its path. `observation.state` and `action` hold, for each arm in order, its
joint positions, then its gripper.
"""

from __future__ import annotations

import difflib
import math
import os
from collections.abc import Iterable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from worldline_core.config import CONFIG_ROOT, StrictModel, read_yaml, validate
from worldline_core.errors import ConfigError, DataError, UnavailableError
from worldline_core.geometry.transforms import pose_from_quaternion_wxyz, rotation_deviation

MAX_DESCRIPTION_BYTES = 16 << 20
QUATERNION_TOLERANCE = 1e-3
"""Largest deviation of a quaternion's length from 1 that is taken for rounding and normalised away."""
EMBODIMENT_ROOT = CONFIG_ROOT / "embodiments"
OWN_ROOT = Path("configs", "embodiments")
"""Embodiments of the working folder."""
LIMIT_TOLERANCE_RAD = 0.02
"""Joint positions may pass their limits by this much."""

Bound = Annotated[float, Field(allow_inf_nan=True)]
Limits = Annotated[tuple[Bound, Bound], Field(description="lower, upper; -.inf and .inf where there is none")]


class RigidOffset(StrictModel):
    """A fixed transform by translation [m] and quaternion (wxyz); a length within 1e-3 of 1 is normalised."""

    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation_wxyz: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)

    @model_validator(mode="after")
    def _proper(self) -> RigidOffset:
        norm = float(np.linalg.norm(self.rotation_wxyz))
        if abs(norm - 1.0) > QUATERNION_TOLERANCE:
            raise ValueError(f"rotation_wxyz has length {norm:.6f}, expected 1")
        return self

    def matrix(self) -> np.ndarray:
        """(4, 4) float64."""
        return _matrix(self.translation, self.rotation_wxyz).copy()


@lru_cache(maxsize=256)
def _matrix(translation: tuple[float, ...], rotation_wxyz: tuple[float, ...]) -> np.ndarray:
    return pose_from_quaternion_wxyz(np.array(translation), np.array(rotation_wxyz))


class Description(StrictModel):
    """The kinematic description.

    Attributes:
        file: path beside the YAML.
        obtain: where a user gets a file that is not shipped.
        source: where the file comes from, with version and licence.
        mounts: the description is one arm and is placed once per entry, `T_world_root` each; its links and joints
            are named by the entry, a slash, and their own name (`left/joint1`), under a common link `world`. Of a pair one
            may be `unknown`: `worldline calibrate estimate` finds it.
    """

    format: Literal["mjcf", "urdf"]
    file: str = Field(min_length=1)
    obtain: str | None = None
    source: str | None = None
    mounts: dict[str, RigidOffset | Literal["unknown"]] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _one_of_two(self) -> Description:
        if (unknown := list(self.mounts.values()).count("unknown")) and (unknown, len(self.mounts)) != (1, 2):
            raise ValueError("one mount of two may be unknown: the other one is the frame that it is found in")
        return self

    @property
    def unknown_mount(self) -> str | None:
        """The entry whose base is not known."""
        return next((name for name, offset in self.mounts.items() if offset == "unknown"), None)


class FingerJoint(StrictModel):
    """A finger joint of the description and its positions at a closed and at an open gripper (for robot masks)."""

    name: str
    closed: float
    open: float


class Gripper(StrictModel):
    """Layout of a gripper in the state: right after the arm's joints, linear from closed to open."""

    closed: float = 0.0
    open: float = 1.0
    finger_joints: tuple[FingerJoint, ...] = ()

    @model_validator(mode="after")
    def _range(self) -> Gripper:
        if self.closed == self.open:
            raise ValueError("closed and open are equal")
        return self


_MOUNT_TOLERANCE = 1.1e-4  # largest entry of |R R^T - I| of a wrist camera's mount


class WristMount(StrictModel):
    """Mount of an arm's camera; `T_link_camera` maps camera points (OpenCV axes) to the link."""

    link: str
    T_link_camera: tuple[tuple[float, ...], ...]

    @model_validator(mode="after")
    def _rigid(self) -> WristMount:
        if [len(row) for row in self.T_link_camera] != [4] * 4:
            raise ValueError("T_link_camera is not a 4x4 matrix")
        T = np.asarray(self.T_link_camera, dtype=np.float64)
        if rotation_deviation(T[:3, :3]) > _MOUNT_TOLERANCE or not np.allclose(T[3], [0, 0, 0, 1]):
            raise ValueError("T_link_camera is not a rigid transform (R R^T = I, det R = 1, last row 0 0 0 1)")
        return self


class Arm(StrictModel):
    """One arm: joints in state order, tool, gripper, camera, and capsule radii [m] of its robot mask."""

    name: str
    joints: tuple[str, ...] = Field(min_length=1)
    limits: tuple[Limits, ...]
    end_effector_link: str
    T_link_tool: RigidOffset = RigidOffset()
    gripper: Gripper = Gripper()
    wrist_camera: WristMount | None = None
    link_radius: float = Field(0.05, gt=0, lt=1)
    hand_radius: float | None = Field(None, gt=0, lt=1, description="default: gripper_radius")
    gripper_radius: float = Field(0.04, gt=0, lt=1)

    @model_validator(mode="after")
    def _limits(self) -> Arm:
        if len(self.limits) != len(self.joints):
            raise ValueError(f"{len(self.limits)} limits for {len(self.joints)} joints")
        for joint, (low, high) in zip(self.joints, self.limits, strict=True):
            if not low < high:
                raise ValueError(f"a lower limit is not below its upper limit: {joint}, {low} to {high}")
        return self

    @property
    def camera_view(self) -> str:
        """Name of the view of the wrist camera."""
        return f"{self.name}_wrist"


class Embodiment(StrictModel):
    """A robot; angles in radians, slides in metres.

    Attributes:
        posture: joints that are no part of the state (waist, head), at fixed positions.
        unverified_reason: why names, limits and poses could not be checked against the description itself.
        description_path: where the kinematic description is expected.
    """

    name: str
    description: Description
    base_link: str
    arms: tuple[Arm, ...] = Field(min_length=1)
    posture: dict[str, float] = Field(default_factory=dict)
    unverified_reason: str | None = None
    description_path: Path

    @model_validator(mode="after")
    def _consistent(self) -> Embodiment:
        joints = [joint for arm in self.arms for joint in arm.joints] + list(self.posture)
        doubled = sorted({joint for joint in joints if joints.count(joint) > 1})
        if doubled:
            raise ValueError(f"joints named twice: {', '.join(doubled)}")
        names = [arm.name for arm in self.arms]
        if len(set(names)) != len(names):
            raise ValueError(f"arms named twice: {', '.join(names)}")
        return self

    def known_mounts(self) -> dict[str, RigidOffset]:
        """The description's mounts. Raises: ConfigError where one is unknown."""
        known = {name: offset for name, offset in self.description.mounts.items() if isinstance(offset, RigidOffset)}
        if (unknown := self.description.unknown_mount) is not None:
            raise ConfigError(
                "The place of an arm's base is unknown", where=f"embodiment {self.name}, description.mounts.{unknown}",
                expected="translation and rotation_wxyz", got="unknown",
                next_step="worldline calibrate estimate CONFIG finds it: write the line that it prints into the file",
            )  # fmt: skip
        return known

    def with_mounts(self, mounts: Mapping[str, RigidOffset]) -> Embodiment:
        """The same robot, whose arms stand elsewhere."""
        return self.model_copy(update={"description": self.description.model_copy(update={"mounts": dict(mounts)})})

    @property
    def state_size(self) -> int:
        """J: joints and grippers of all arms."""
        return sum(len(arm.joints) + 1 for arm in self.arms)

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the state columns."""
        return tuple(name for arm in self.arms for name in (*arm.joints, f"{arm.name}/gripper"))

    def joint_columns(self, arm: Arm) -> slice:
        """Columns of an arm's joints in the state."""
        start = 0
        for other in self.arms:
            if other.name == arm.name:
                return slice(start, start + len(arm.joints))
            start += len(other.joints) + 1
        raise ConfigError("Unknown arm", where=self.name, expected=", ".join(a.name for a in self.arms), got=arm.name)

    def gripper_column(self, arm: Arm) -> int:
        """Column of an arm's gripper in the state."""
        return self.joint_columns(arm).stop

    def noted_posture(self, notes: Mapping[str, object]) -> dict[str, float]:
        """Positions [rad, m] of joints outside the state (waist, head) where an episode's conventions note them.

        A note `waist_lift`, or `waist_lift_m`, is of the joint whose name has these words (`idx01_waist_lift_joint`).
        """
        noted = {n.removesuffix("_rad").removesuffix("_m"): v for n, v in notes.items() if type(v) in (int, float)}
        return {
            joint: float(value)  # type: ignore[arg-type]
            for joint in self.posture
            for name, value in noted.items()
            if f"_{name}_" in f"_{joint}_"
        }

    def check_state(self, state: np.ndarray, where: object) -> None:
        """Raises: DataError when the joint vector has a wrong length or holds values that are not finite."""
        if state.ndim != 2 or state.shape[1] != self.state_size:
            raise DataError(
                "Joint vector has a wrong length for this embodiment",
                where=f"{where}, embodiment {self.name}",
                expected=f"(N, {self.state_size}): {', '.join(self.state_names)}",
                got=str(tuple(state.shape)),
                next_step="check the embodiment's name and the order of the state",
            )
        if not np.isfinite(state).all():
            row, column = np.argwhere(~np.isfinite(state))[0]
            raise DataError(
                "Joint positions or gripper openings are not finite",
                where=f"{where}, frame {row}, {self.state_names[column]}",
                expected="finite numbers",
                got=float(state[row, column]),
            )

    def outside_limits(self, state: np.ndarray, tolerance_rad: float = LIMIT_TOLERANCE_RAD) -> np.ndarray:
        """Bool (N, J): joint positions beyond their limits by more than the tolerance; gripper columns are False."""
        outside = np.zeros(state.shape, dtype=bool)
        for arm in self.arms:
            columns, limits = self.joint_columns(arm), np.asarray(arm.limits, dtype=np.float64)
            joints = state[:, columns].astype(np.float64)
            outside[:, columns] = (joints < limits[:, 0] - tolerance_rad) | (joints > limits[:, 1] + tolerance_rad)
        return outside

    def check_limits(self, state: np.ndarray, where: object, tolerance_rad: float = LIMIT_TOLERANCE_RAD) -> None:
        """Raises: DataError naming the joint that is furthest out, its value and its limits."""
        self.check_state(state, where)
        outside = self.outside_limits(state, tolerance_rad)
        if not outside.any():
            return
        free = (-math.inf, math.inf)
        lower, upper = np.array([limits for arm in self.arms for limits in (*arm.limits, free)]).T
        beyond = np.where(outside, np.maximum(lower - state, state - upper), -math.inf)
        frame, joint = np.unravel_index(int(beyond.argmax()), beyond.shape)
        raise DataError(
            "Joint position is beyond its limit",
            where=f"{where}, embodiment {self.name}, frame {frame}, {self.state_names[joint]}",
            expected=f"{lower[joint]:g} to {upper[joint]:g}",
            got=f"{state[frame, joint]:g}; {int(outside[:, joint].sum())} of {len(state)} frames are outside",
            next_step="check the joint order, the units and the sign of this joint",
        )


_carried: dict[str, Path] = {}
"""Files of robots that recordings carry or that a configuration names by their paths, by name."""


def embodiment_files() -> dict[str, Path]:
    """Files of all embodiments by name: the package's, the working folder's, and, before those, what opened recordings carry.

    Raises: ConfigError when a robot has the name of one that ships with the project, and is another.
    """
    shipped = {path.stem: path for path in EMBODIMENT_ROOT.glob("*.yaml")}
    apart = OWN_ROOT.is_dir() and not OWN_ROOT.samefile(EMBODIMENT_ROOT)  # one folder in a checkout
    own = ({path.stem: path for path in OWN_ROOT.glob("*.yaml")} if apart else {}) | _carried
    for name in shipped.keys() & own.keys():
        _require_same(name, shipped[name], own[name])
    return own | shipped


def _require_same(name: str, one: Path, other: Path) -> None:
    if one.read_bytes() != other.read_bytes():
        raise ConfigError(
            "Two files describe one robot differently", where=f"{one}, {other}", got=name,
            next_step="rename one (the file and its `name`), or curate its recordings again",
        )  # fmt: skip


def own_embodiment(name_or_path: str) -> Path | None:
    """File of a robot that does not ship with the project, by name or path; None of those that do, or are not there."""
    path = Path(name_or_path) if _is_path(name_or_path) else embodiment_files().get(name_or_path)
    return None if path is None or not path.is_file() or path.parent == EMBODIMENT_ROOT else path


def carry_embodiments(paths: Iterable[Path]) -> list[str]:
    """Let robots be found by their names, whose files are anywhere; returns the names.

    Raises: ConfigError when a file is no embodiment, or another robot has its name already.
    """
    names = []
    for path in paths:
        name = load_embodiment(path).name
        known = _carried.get(name, path)
        if known.is_file():
            _require_same(name, known, path)
        _carried[name] = path
        names.append(name)
    return names


def _is_path(name: str | Path) -> bool:
    return Path(name).suffix in (".yaml", ".yml")


def embodiment_names() -> list[str]:
    """Names of the embodiments that can be found by name."""
    return sorted(embodiment_files())


def check_embodiment_name(name: str) -> None:
    """Raises: ConfigError when no embodiment has this name; the message lists those there are."""
    names = embodiment_names()
    if name not in names:
        close = difflib.get_close_matches(name, names, n=1)
        next_step = f"add configs/embodiments/{name}.yaml to the working folder (docs/embodiments.md)"
        if close:
            next_step = f"did you mean {close[0]!r}?"
        if name == "none":
            next_step = (
                "a robot without a description has no kinematics: describe it (docs/embodiments.md), then curate again"
            )
        raise ConfigError("Unknown embodiment", expected=f"one of {', '.join(names)}", got=name, next_step=next_step)


def load_embodiment(name_or_path: str | Path, description_path: Path | str | None = None) -> Embodiment:
    """Load an embodiment by its name, or from a YAML file.

    The kinematic description is expected at `description_path`, else where the environment variable
    `WORLDLINE_DESCRIPTION_<NAME>` points, else beside the YAML file. It is opened when kinematics are built.

    Raises: ConfigError when there is no embodiment of that name (the message lists the names), or the YAML is not valid.
    """
    path = Path(name_or_path)
    if not _is_path(name_or_path):
        name, files = str(name_or_path), embodiment_files()
        if name not in files:
            check_embodiment_name(name)
        path = files[name]
    embodiment = _validated(path, path.read_bytes() if path.is_file() else None)
    chosen = description_path or os.environ.get(description_variable(embodiment.name))
    located = Path(chosen) if chosen else path.parent / embodiment.description.file
    return embodiment.model_copy(update={"description_path": located})


@lru_cache(maxsize=128)  # more than there are robots: a dataset is compared with all of them
def _validated(path: Path, content: bytes | None) -> Embodiment:
    """The embodiment of a file with this content, which takes some milliseconds."""
    return validate(Embodiment, {**read_yaml(path), "description_path": path.parent}, where=path)


def description_variable(name: str) -> str:
    """Environment variable with the path of an embodiment's kinematic description."""
    return f"WORLDLINE_DESCRIPTION_{name.upper()}"


def how_to_get(embodiment: Embodiment) -> str:
    """Instructions for a user without the kinematic description."""
    name = embodiment.name
    return (
        f"{embodiment.description.obtain or 'restore the file beside its YAML'}; then set {description_variable(name)}="
        f"/path/to/it, or render_actions.description_paths.{name} in the configuration"
    )


def read_description(embodiment: Embodiment) -> str:
    """Text of the kinematic description.

    Raises:
        UnavailableError: the file is not there; the message says how to get it.
        DataError: it is far larger than a description, or no UTF-8.
    """
    description, path = embodiment.description, embodiment.description_path
    if not path.is_file():
        raise UnavailableError(
            f"The kinematic description of {embodiment.name} is not here",
            where=path,
            expected=description.file,
            next_step=how_to_get(embodiment),
        )
    if (size := path.stat().st_size) > MAX_DESCRIPTION_BYTES:
        limit = f"at most {MAX_DESCRIPTION_BYTES:,} bytes"
        raise DataError("Kinematic description is too large", where=path, expected=limit, got=size)
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise DataError("Kinematic description is not UTF-8", where=path, got=str(error)) from error
