"""What a robot is made of, as far as this project needs: arms, joint order, tools, grippers, wrist cameras.

One YAML file an embodiment in `configs/embodiments/`, beside it (or at the user) the kinematic description.
`observation.state` and `action` hold, for each arm in order, its joint positions [rad or m], then its gripper.
"""

from __future__ import annotations

import difflib
import os
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from worldline_core.config import StrictModel, read_yaml, validate
from worldline_core.config.loader import CONFIG_ROOT
from worldline_core.errors import ConfigError, DataError, UnavailableError

EMBODIMENT_ROOT = CONFIG_ROOT / "embodiments"

Limits = Annotated[tuple[float, float], Field(description="lower, upper")]


class Description(StrictModel):
    """The kinematic description: where it is and, where it may not be shipped, how to get it."""

    format: Literal["mjcf", "urdf"]
    file: str = Field(min_length=1)
    obtain: str | None = None


class RigidOffset(StrictModel):
    """A fixed transform by translation [m] and unit quaternion (wxyz)."""

    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation_wxyz: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)

    @model_validator(mode="after")
    def _unit(self) -> RigidOffset:
        norm = float(np.linalg.norm(self.rotation_wxyz))
        if abs(norm - 1.0) > 1e-3:
            raise ValueError(f"rotation_wxyz has length {norm:.6f}, expected 1")
        return self

    def matrix(self) -> np.ndarray:
        """(4, 4) float64."""
        w, x, y, z = np.asarray(self.rotation_wxyz, dtype=np.float64) / np.linalg.norm(self.rotation_wxyz)
        T = np.eye(4)
        T[:3, :3] = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
        T[:3, 3] = self.translation
        return T


class FingerJoint(StrictModel):
    """A finger joint of the description and its positions at a closed and at an open gripper (for robot masks)."""

    name: str
    closed: float
    open: float


class Gripper(StrictModel):
    """How the gripper is written in the state: right after the arm's joints, linear from closed to open."""

    index_after_joints: Literal[True] = True
    closed: float = 0.0
    open: float = 1.0
    finger_joints: tuple[FingerJoint, ...] = ()

    @model_validator(mode="after")
    def _range(self) -> Gripper:
        if self.closed == self.open:
            raise ValueError("closed and open are equal")
        return self


class WristCamera(StrictModel):
    """Where the arm's camera is mounted; `T_link_camera` maps camera points (OpenCV axes) to the link."""

    link: str
    T_link_camera: tuple[tuple[float, ...], ...]
    view: str | None = None

    @model_validator(mode="after")
    def _rigid(self) -> WristCamera:
        T = (
            np.asarray(self.T_link_camera, dtype=np.float64)
            if {len(r) for r in self.T_link_camera} == {4}
            else np.zeros(0)
        )
        if T.shape != (4, 4):
            raise ValueError("T_link_camera is not a 4x4 matrix")
        R = T[:3, :3]
        if (
            not np.allclose(R @ R.T, np.eye(3), atol=1e-4)
            or np.linalg.det(R) < 0
            or not np.allclose(T[3], [0, 0, 0, 1])
        ):
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
    wrist_camera: WristCamera | None = None
    link_radius: float = Field(0.05, gt=0, lt=1)
    hand_radius: float | None = Field(None, gt=0, lt=1, description="default: gripper_radius")
    gripper_radius: float = Field(0.04, gt=0, lt=1)

    @model_validator(mode="after")
    def _limits(self) -> Arm:
        if len(self.limits) != len(self.joints):
            raise ValueError(f"{len(self.limits)} limits for {len(self.joints)} joints")
        if any(low >= high for low, high in self.limits):
            raise ValueError("a lower limit is not below its upper limit")
        return self

    @property
    def camera_view(self) -> str:
        """Name of the view of the wrist camera."""
        named = self.wrist_camera.view if self.wrist_camera is not None else None
        return named or f"{self.name}_wrist"


class Embodiment(StrictModel):
    """A robot. `posture` holds joints that are no part of the state (waist, head) at fixed positions."""

    name: str
    description: Description
    base_link: str
    arms: tuple[Arm, ...] = Field(min_length=1)
    posture: dict[str, float] = Field(default_factory=dict)
    description_path: Path

    @model_validator(mode="after")
    def _unique(self) -> Embodiment:
        joints = [joint for arm in self.arms for joint in arm.joints] + list(self.posture)
        doubled = sorted({joint for joint in joints if joints.count(joint) > 1})
        if doubled:
            raise ValueError(f"joints named twice: {', '.join(doubled)}")
        names = [arm.name for arm in self.arms]
        if len(set(names)) != len(names):
            raise ValueError(f"arms named twice: {', '.join(names)}")
        return self

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
                "Joint positions are not finite",
                where=f"{where}, frame {row}, {self.state_names[column]}",
                expected="finite numbers",
                got=float(state[row, column]),
            )

    def outside_limits(self, state: np.ndarray, tolerance_rad: float = 0.02) -> np.ndarray:
        """Bool (N, J): joint positions beyond their limits by more than the tolerance; gripper columns are False."""
        outside = np.zeros(state.shape, dtype=bool)
        for arm in self.arms:
            columns, limits = self.joint_columns(arm), np.asarray(arm.limits, dtype=np.float64)
            joints = state[:, columns].astype(np.float64)
            outside[:, columns] = (joints < limits[:, 0] - tolerance_rad) | (joints > limits[:, 1] + tolerance_rad)
        return outside


def embodiment_names() -> list[str]:
    """Names of the embodiments that ship with the project."""
    return sorted(path.stem for path in EMBODIMENT_ROOT.glob("*.yaml"))


def description_variable(name: str) -> str:
    """Environment variable that says where the kinematic description of an embodiment is."""
    return f"WORLDLINE_DESCRIPTION_{name.upper()}"


def load_embodiment(name_or_path: str | Path, description_path: Path | str | None = None) -> Embodiment:
    """Load an embodiment by its name, or from a YAML file.

    The kinematic description is looked for at `description_path`, then where the environment variable
    `WORLDLINE_DESCRIPTION_<NAME>` points, then beside the YAML file. It is opened only when kinematics are built.

    Raises:
        ConfigError: no embodiment of that name (the message lists those there are), or the YAML is not valid.
    """
    path = Path(name_or_path)
    if path.suffix not in (".yaml", ".yml"):
        if str(name_or_path) not in embodiment_names():
            close = difflib.get_close_matches(str(name_or_path), embodiment_names(), n=1)
            raise ConfigError(
                "Unknown embodiment",
                expected=f"one of {', '.join(embodiment_names())}, or a path to a YAML file",
                got=str(name_or_path),
                next_step=f"did you mean {close[0]!r}?" if close else f"add configs/embodiments/{name_or_path}.yaml",
            )
        path = EMBODIMENT_ROOT / f"{name_or_path}.yaml"
    values = read_yaml(path)
    if "description_path" in values:
        raise ConfigError(
            "description_path is not a key of the file", where=path, next_step="use description: {file: ...}"
        )
    described = values.get("description")
    file = described.get("file", "") if isinstance(described, dict) else ""
    override = description_path or os.environ.get(description_variable(str(values.get("name", ""))))
    return validate(Embodiment, {**values, "description_path": Path(override or path.parent / str(file))}, where=path)


def read_description(embodiment: Embodiment) -> str:
    """Text of the kinematic description.

    Raises:
        UnavailableError: the file is not there; the message says how to get it.
    """
    path = embodiment.description_path
    if not path.is_file():
        raise UnavailableError(
            f"The kinematic description of {embodiment.name} is not here",
            where=path,
            expected=embodiment.description.file,
            next_step=(embodiment.description.obtain or "restore the file beside the embodiment's YAML")
            + f"; then set {description_variable(embodiment.name)}=/path/to/it or pass description_path",
        )
    return path.read_text(encoding="utf-8")
