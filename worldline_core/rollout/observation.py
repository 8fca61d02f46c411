"""First images, controls and cameras of one prediction as an episode and its action tracks."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from worldline_core.actions.action_tracks import compute_tracks
from worldline_core.actions.episode_tracks import HEAD_VIEW, EpisodeTracks
from worldline_core.data.episodes.episode import CameraTrack, Episode
from worldline_core.errors import CalibrationError, DataError
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.geometry.tensor_transforms import is_rigid, valid_intrinsics
from worldline_core.model.checkpoint import CheckpointInfo


@dataclass(frozen=True)
class Camera:
    """Pinhole camera of one view.

    Attributes:
        K: (3, 3), pixels of the image that is given for this view.
        T_base_camera: (4, 4), camera points to the robot's base, OpenCV axes, at the first frame; the head camera keeps it, a
            wrist camera follows its arm from there. None: a wrist camera whose mount the embodiment's file knows.
    """

    K: np.ndarray
    T_base_camera: np.ndarray | None = None


FURTHEST_CAMERA_M = 20.0
"""A camera further than this from the robot's base has its position in millimetres."""
LARGEST_CENTRE_OFFSET = 0.2
"""Offset of the principal point from the image's centre, as a share of the side; more is a K of another image size."""
START_TOLERANCE_RAD, START_OPENING = 0.5, 1.0
"""A recorded start may be a little beyond the limits; one that is further out, or an opening that is further than this from
half open, is in another unit or of another robot."""
COMMAND_TOLERANCE_RAD, COMMAND_OPENING = 2 * math.pi, 1.5
"""The same of commands that are held within the limits anyway: a policy may ask for more than the robot can do."""


def real_numbers(values: Any, what: str) -> np.ndarray:
    """Numbers as float64.

    Raises:
        DataError: they are complex, boolean, texts or objects, or some of them are masked.
    """
    try:
        found = np.ma.asanyarray(values) if np.ma.isMaskedArray(values) else np.asarray(values)
    except (ValueError, TypeError, RuntimeError) as error:
        raise DataError("Not an array of numbers", where=what, got=str(error)) from error
    if found.dtype.kind not in "fiu" or np.ma.is_masked(found):
        got = "masked values" if np.ma.is_masked(found) else found.dtype
        raise DataError("Not an array of numbers", where=what, expected="real numbers", got=got)
    return np.asarray(found, np.float64, order="C")


def checked_seeds(seeds: object, count: int) -> list[int]:
    """One seed for each clip.

    Raises:
        DataError: a seed is no integer in 0..2^63 - 1.
    """
    given: list[Any] = list(seeds) if isinstance(seeds, Sequence | np.ndarray) else [seeds] * count
    for seed in given:
        if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or not 0 <= seed < 2**63:
            raise DataError("Not a seed", expected="an integer, 0 to 2^63 - 1", got=repr(seed))
    return [int(seed) for seed in given]


def check_controls(
    kinematics: ArmKinematics,
    controls: np.ndarray,
    where: str,
    tolerance_rad: float = START_TOLERANCE_RAD,
    opening: float = START_OPENING,
) -> None:
    """Refuse controls (n, j) in another unit: degrees, LeRobot's -100..100, a gripper in millimetres.

    Raises:
        DataError: a joint or a gripper is far beyond its limits, or a number is not finite.
    """
    embodiment = kinematics.embodiment
    embodiment.check_limits(controls, where, tolerance_rad)
    openings = kinematics.gripper(controls).numpy()
    if (beyond := (np.abs(openings - 0.5) >= opening)).any():
        row, arm = np.argwhere(beyond)[0]
        raise DataError(
            "A gripper is far beyond its range",
            where=f"{where}, row {row}, arm {embodiment.arms[arm].name}",
            expected="0 (closed) to 1 (open), in the units of the embodiment's file",
            got=f"an opening of {openings[row, arm]:g}",
            next_step="check the gripper's units and its column",
        )


def image_size(images: Mapping[str, np.ndarray], cameras: Mapping[str, Camera]) -> tuple[int, int]:
    """(H, W) of first images; those that have a camera have a usable one.

    Raises:
        DataError: a camera has no image, the images differ in size, or a pose has a wrong shape.
        CalibrationError: nothing can be drawn into a camera, so that a prediction would be one without controls.
    """
    if not set(cameras) <= set(images):
        raise DataError("The cameras are not those of the images", expected=list(images), got=list(cameras))
    for view, image in images.items():
        if not isinstance(image, np.ndarray) or image.dtype != np.uint8 or np.ma.is_masked(image):
            got = getattr(image, "dtype", type(image).__name__)
            raise DataError("First images are arrays of uint8", where=view, expected="0..255, none masked", got=got)
    shapes = {view: image.shape for view, image in images.items()}
    height, width = next(iter(shapes.values()), (0, 0))[:2]
    if any(shape != (height, width, 3) for shape in shapes.values()):
        raise DataError("First images are RGB and of one size", expected="(H, W, 3) in every view", got=shapes)
    for view, camera in cameras.items():
        K = real_numbers(camera.K, f"{view}, K")
        if K.shape != (3, 3) or not bool(valid_intrinsics(torch.from_numpy(K))):
            raise CalibrationError(
                "A camera matrix is not usable", where=view,
                expected="[[fx, s, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0", got=K.tolist(),
            )  # fmt: skip
        size = np.array((width, height))
        offset = float(np.abs((K[:2, 2] - (size - 1) / 2) / size).max())
        if offset > LARGEST_CENTRE_OFFSET:
            raise CalibrationError(
                "A camera matrix belongs to another image size", where=f"{view}, K", got=f"cx {K[0, 2]:g}, cy {K[1, 2]:g}",
                expected=f"a principal point near the centre of {width} x {height}",
                next_step="scale K by the factor the image was resized by",
            )  # fmt: skip
        pose = (
            np.eye(4) if camera.T_base_camera is None else real_numbers(camera.T_base_camera, f"{view}, T_base_camera")
        )
        if pose.shape != (4, 4):
            raise DataError("A camera pose has a wrong shape", where=view, expected="(4, 4)", got=pose.shape)
        if not bool(is_rigid(torch.from_numpy(pose))):
            raise CalibrationError(
                "A camera pose is not a rigid transform", where=f"{view}, T_base_camera",
                expected="R R^T = I, det R = 1, last row 0 0 0 1", got=pose.tolist(),
            )  # fmt: skip
        if (distance := float(np.abs(pose[:3, 3]).max())) > FURTHEST_CAMERA_M:
            raise CalibrationError(
                "A camera is too far from the robot", where=f"{view}, T_base_camera", got=f"{distance:g} m",
                expected=f"at most {FURTHEST_CAMERA_M:g} m", next_step="give the position in metres",
            )  # fmt: skip
    return height, width


def require_drivable(
    info: CheckpointInfo, views: Sequence[str], cameras: Mapping[str, Camera], embodiment: str
) -> None:
    """Refuse what a model cannot be driven by: views without a camera, for a model of action maps alone, or the control vectors
    of a robot that it has not seen.

    Raises: DataError: naming the views, or the robot.
    """
    missing = [view for view in views if view not in cameras or not info.config.takes_maps]
    if missing and info.vectors is None:
        raise DataError(
            f"No camera of the view {', '.join(missing)}: the model takes action maps alone, which are drawn through cameras",
            expected=f"cameras of {', '.join(views)}", got=", ".join(cameras) or "none",
            next_step="give K and T_base_camera of the view, or use a model that also takes control vectors "
            "(train_stage2.native_size)",
        )  # fmt: skip
    if missing and info.vectors is not None and embodiment not in info.vectors.embodiments:
        raise DataError(
            f"No camera of the view {', '.join(missing)}, and the model does not know this robot's control vectors",
            expected=f"a robot that it was trained on: {', '.join(info.vectors.embodiments)}", got=embodiment,
            next_step="give cameras to a model that takes action maps, or train on this robot",
        )  # fmt: skip


def project_controls(
    cameras: Mapping[str, Camera],
    size: tuple[int, int],
    kinematics: ArmKinematics,
    *,
    controls: np.ndarray,
    fps: float,
) -> EpisodeTracks:
    """Action tracks of controls ``(frames, state size)``; the first row belongs to the moment of the cameras' poses.

    Args:
        cameras: of some or all views; nothing is drawn into others.
        size: (H, W) of the images.

    Raises:
        DataError: a camera has neither a pose nor a known mount, or the controls do not fit the embodiment.
    """
    frames, embodiment = len(controls), kinematics.embodiment
    mounted = {arm.camera_view for arm in embodiment.arms if arm.wrist_camera}
    tracks: dict[str, CameraTrack] = {}
    for view, camera in cameras.items():
        if camera.T_base_camera is None and view not in mounted:
            raise DataError(
                "A camera without a pose",
                where=view,
                expected="T_base_camera, or an embodiment whose file knows the mount of this wrist camera",
                got=f"known mounts: {sorted(mounted)}",
            )
        pose = np.eye(4) if camera.T_base_camera is None else np.asarray(camera.T_base_camera, np.float64)
        moving = view != HEAD_VIEW and view not in mounted
        poses = np.repeat(pose[None], frames if moving else 1, axis=0)
        tracks[view] = CameraTrack(view, np.asarray(camera.K, np.float64), poses, size[1], size[0])
    episode = Episode(
        episode_id="prediction",
        source="prediction",
        embodiment=embodiment.name,
        scene="",
        task_family="unknown",
        instruction="",
        outcome="unknown",
        split="test",
        fps=fps,
        state=controls,
        action=controls,
        timestamps=np.arange(frames) / fps,
        cameras=tracks,
    )
    return compute_tracks(episode, kinematics, without_mount="first_frame_mount", image_size=size)[0]
