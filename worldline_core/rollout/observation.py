"""First images, controls and cameras of one prediction as an episode and its action tracks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from worldline_core.actions.action_tracks import compute_tracks
from worldline_core.actions.episode_tracks import HEAD_VIEW, EpisodeTracks
from worldline_core.data.episodes.episode import CameraTrack, Episode
from worldline_core.errors import CalibrationError, DataError
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.geometry.tensor_transforms import is_rigid, valid_intrinsics


@dataclass(frozen=True)
class Camera:
    """Pinhole camera of one view.

    Attributes:
        K: (3, 3), pixels of the image that is given for this view.
        T_base_camera: camera points to the robot's base, OpenCV axes. (4, 4): the pose at the first frame; the head
            camera keeps it, a wrist camera follows its arm from there. (frames, 4, 4): the pose at every frame. None:
            a wrist camera whose mount the embodiment's file knows.
    """

    K: np.ndarray
    T_base_camera: np.ndarray | None = None


def ordered_views(trained: Sequence[str], given: Iterable[str]) -> tuple[str, ...]:
    """Given views in the order of the model's.

    Raises:
        DataError: one is none of the model's, or the model's first one is missing.
    """
    names = set(given)
    if not names <= set(trained) or trained[0] not in names:
        raise DataError(
            "The images are not those of the model's views",
            expected=f"{trained[0]}" + (f", and any of {tuple(trained[1:])}" if len(trained) > 1 else " alone"),
            got=sorted(names),
            next_step="leave out the views that the model was not trained on",
        )
    return tuple(view for view in trained if view in names)


def given_tracks(
    images: Mapping[str, np.ndarray],
    controls: np.ndarray | None,
    cameras: Mapping[str, Camera],
    embodiment: str | Path | None,
    tool_poses: np.ndarray | None,
    gripper: np.ndarray | None,
    *,
    fps: float,
    unit: int,
) -> EpisodeTracks:
    """Action tracks of the arguments of `WorldLine.predict`.

    Args:
        unit: a prediction has 1 + k * ``unit`` frames.

    Raises:
        DataError: a camera is missing, a shape does not fit, or the number of frames is not 1 + k whole units.
        CalibrationError: a camera cannot be used.
        ConfigError: there is no such embodiment.
    """
    if (controls is None) == (tool_poses is None) or (controls is not None and embodiment is None):
        raise DataError(
            "A prediction is driven by controls of an embodiment, or by tool poses",
            expected="controls and embodiment, or tool_poses and gripper",
            got={"controls": controls is not None, "embodiment": embodiment, "tool_poses": tool_poses is not None},
        )
    driven = np.asarray(controls if controls is not None else tool_poses, np.float64)
    frames = len(driven)
    if frames <= unit or (frames - 1) % unit:
        raise DataError(
            "The model predicts one observed frame and whole units",
            expected=f"1 + k * {unit} rows of controls",
            got=frames,
            next_step=f"give {1 + max(1, (frames - 1) // unit) * unit} rows",
        )
    height, width = image_size(images, cameras)
    kinematics = None if controls is None or embodiment is None else ArmKinematics(load_embodiment(embodiment))
    return project_controls(
        cameras,
        (height, width),
        kinematics,
        controls=driven if controls is not None else driven.reshape(frames, -1),
        tool_poses=None if controls is not None else driven,
        gripper=gripper,
        fps=fps,
    )


def image_size(images: Mapping[str, np.ndarray], cameras: Mapping[str, Camera]) -> tuple[int, int]:
    """(H, W) of first images that have a usable camera each.

    Raises:
        DataError: a camera is missing, or the images differ in size.
        CalibrationError: nothing can be drawn into a camera, so that a prediction would be one without controls.
    """
    if set(cameras) != set(images):
        raise DataError("The cameras are not those of the images", expected=list(images), got=list(cameras))
    shapes = {view: image.shape for view, image in images.items()}
    height, width = next(iter(shapes.values()), (0, 0))[:2]
    if any(shape != (height, width, 3) for shape in shapes.values()):
        raise DataError("First images are RGB and of one size", expected="(H, W, 3) in every view", got=shapes)
    for view, camera in cameras.items():
        _check_usable(view, camera)
    return height, width


def project_controls(
    cameras: Mapping[str, Camera],
    size: tuple[int, int],
    kinematics: ArmKinematics | None,
    *,
    controls: np.ndarray,
    fps: float,
    tool_poses: np.ndarray | None = None,
    gripper: np.ndarray | None = None,
) -> EpisodeTracks:
    """Action tracks of controls ``(frames, state size)``; the first row belongs to the moment of the cameras' poses.

    Args:
        size: (H, W) of the images that the cameras took.
        kinematics: without, the robot is where ``tool_poses`` and ``gripper`` say.

    Raises:
        DataError, CalibrationError: as :func:`given_tracks`.
    """
    frames = len(controls)
    arms = () if kinematics is None else kinematics.embodiment.arms
    known = {arm.camera_view for arm in arms if arm.wrist_camera}
    poses, follow = _poses(cameras, known, frames)
    episode = Episode(
        episode_id="prediction",
        source="prediction",
        embodiment="" if kinematics is None else kinematics.embodiment.name,
        scene="",
        task_family="unknown",
        instruction="",
        outcome="unknown",
        split="test",
        fps=fps,
        state=controls,
        action=controls,
        timestamps=np.arange(frames) / fps,
        cameras={
            view: CameraTrack(view, np.asarray(cameras[view].K, np.float64), pose, size[1], size[0])
            for view, pose in poses.items()
        },
        T_base_ee=tool_poses,
        gripper=gripper,
    )
    tracks, _ = compute_tracks(
        episode,
        kinematics,
        controls="action" if kinematics is not None else "state",  # given tool poses stand for themselves
        without_mount="first_frame_mount" if follow else "recorded",
    )
    return tracks


def _check_usable(view: str, camera: Camera) -> None:
    """Numbers alone; shapes are checked where they are used."""
    K = np.asarray(camera.K, np.float64)
    if K.shape == (3, 3) and not bool(valid_intrinsics(torch.from_numpy(K))):
        raise CalibrationError(
            "A camera matrix is not usable", where=view, expected="[[fx, s, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0",
            got=K.tolist(),
        )  # fmt: skip
    poses = np.eye(4) if camera.T_base_camera is None else np.asarray(camera.T_base_camera, np.float64)
    if poses.shape[-2:] == (4, 4) and not bool(is_rigid(torch.from_numpy(poses)).all()):
        raise CalibrationError(
            "A camera pose is not a rigid transform", where=f"{view}, T_base_camera",
            expected="R R^T = I, det R = 1, last row 0 0 0 1", got=poses.reshape(-1, 4, 4)[:1].tolist(),
        )  # fmt: skip


def _poses(cameras: Mapping[str, Camera], mounted: set[str], frames: int) -> tuple[dict[str, np.ndarray], bool]:
    """Poses ``(1 or frames, 4, 4)`` per view, and whether wrist cameras follow their arms from the first frame's pose.

    Raises:
        DataError: a pose has a wrong shape or is missing, or wrist cameras are given in two ways.
    """
    poses: dict[str, np.ndarray] = {}
    forms: dict[str, int] = {}
    for view, camera in cameras.items():
        if camera.T_base_camera is None and view not in mounted:
            raise DataError(
                "A camera without a pose",
                where=view,
                expected="T_base_camera, or an embodiment whose file knows the mount of this wrist camera",
                got=f"known mounts: {sorted(mounted)}",
            )
        pose = np.eye(4) if camera.T_base_camera is None else np.asarray(camera.T_base_camera, np.float64)
        if pose.shape not in ((4, 4), (frames, 4, 4)):
            raise DataError(
                "A camera pose has a wrong shape", where=view, expected=f"(4, 4) or ({frames}, 4, 4)", got=pose.shape
            )
        wrist = view != HEAD_VIEW and view not in mounted
        if wrist:
            forms[view] = pose.ndim
        poses[view] = np.repeat(pose[None], frames, axis=0) if wrist and pose.ndim == 2 else pose.reshape(-1, 4, 4)
    if len(set(forms.values())) > 1:
        raise DataError(
            "Wrist cameras are given in two ways", expected="a pose each, or a pose per frame each", got=forms
        )
    return poses, 2 in forms.values()
