"""Camera poses that say their convention: the only way to make one is to name what the recorded matrices map and mean.

Axes: `opencv` is x right, y down, z forward; `opengl` (also Blender, MuJoCo, USD) is x right, y up, z backward.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NoReturn

import numpy as np

from worldline_core.errors import CalibrationError
from worldline_core.geometry.rigid import RotationRepair, repair_rotations, rigid_inverse

CameraAxes = Literal["opencv", "opengl"]
_OPENCV_FROM: dict[str, np.ndarray] = {"opencv": np.eye(4), "opengl": np.diag([1.0, -1.0, -1.0, 1.0])}


@dataclass(frozen=True, init=False, eq=False)
class CameraPose:
    """Where a camera is: what a bare (N, 4, 4) array does not say. Made by `from_camera_to_base`, `from_base_to_camera`.

    Attributes:
        T_base_camera: (N, 4, 4) float64, N = 1 for a fixed camera; maps camera points (OpenCV axes, metres) to base.
        repair: rotations that were not orthonormal and were given the nearest rotation, counted.
    """

    T_base_camera: np.ndarray
    repair: RotationRepair

    def __init__(self) -> None:
        raise TypeError("Say what the matrices map: CameraPose.from_camera_to_base or CameraPose.from_base_to_camera")

    @classmethod
    def from_camera_to_base(cls, T_base_camera: np.ndarray, *, axes: CameraAxes, where: object) -> CameraPose:
        """From matrices (N or 1, 4, 4) or (4, 4) that map camera points to base (the camera's pose).

        Raises: CalibrationError when one is not rigid, beyond what `repair_rotations` mends.
        """
        poses, repair = _rigid(T_base_camera, where)
        return cls._of(poses @ _OPENCV_FROM[axes] if axes != "opencv" else poses, repair)

    @classmethod
    def from_base_to_camera(cls, T_camera_base: np.ndarray, *, axes: CameraAxes, where: object) -> CameraPose:
        """From matrices (N or 1, 4, 4) or (4, 4) that map base points to camera (OpenCV's rvec and tvec, COLMAP).

        Raises: CalibrationError when one is not rigid, beyond what `repair_rotations` mends.
        """
        poses, repair = _rigid(T_camera_base, where)
        return cls._of(rigid_inverse(poses) @ _OPENCV_FROM[axes], repair)

    @classmethod
    def _of(cls, T_base_camera: np.ndarray, repair: RotationRepair) -> CameraPose:
        pose = object.__new__(cls)
        object.__setattr__(pose, "T_base_camera", T_base_camera)
        object.__setattr__(pose, "repair", repair)
        return pose

    def __len__(self) -> int:
        return len(self.T_base_camera)

    def __array__(self, *_: object, **__: object) -> NoReturn:
        raise TypeError("A CameraPose is no array: use its T_base_camera (camera to base, OpenCV axes)")


def _rigid(matrices: np.ndarray, where: object) -> tuple[np.ndarray, RotationRepair]:
    poses = np.asarray(matrices, dtype=np.float64)
    poses = poses[None] if poses.ndim == 2 else poses
    if poses.ndim != 3 or poses.shape[1:] != (4, 4) or len(poses) == 0:
        raise CalibrationError(
            "Camera poses have a wrong shape", where=where, expected="(N or 1, 4, 4) or (4, 4)", got=np.shape(matrices)
        )
    return repair_rotations(poses, where)
