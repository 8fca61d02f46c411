"""Calibration beside recordings whose format has no place for it, in JSON or YAML.

    views:
      head:
        width: 1280                  # of the image that K belongs to
        height: 720
        K: [[910.0, 0.0, 640.0], [0.0, 910.0, 360.0], [0.0, 0.0, 1.0]]
        maps: camera_to_base         # what T maps: camera_to_base or base_to_camera
        axes: opencv                 # opencv (x right, y down, z forward) or opengl (x right, y up, z backward)
        T: [[...], [...], [...], [0, 0, 0, 1]]        # one matrix of a fixed camera, or a list of one per frame; metres
        distortion: {model: radtan, coefficients: [...]}      # only where the images still have it

Instead of T a view may name a feature of the dataset that holds the pose of each frame: `T_feature: {name: ..., format:
xyz_rpy_fixed}` (x y z [m], roll pitch yaw [rad] about fixed axes) or `format: matrix` (16 numbers, row by row). Or, of a wrist
camera, `mount: embodiment`: where the robot's description mounts it, by the measured joints (no T, maps or axes then); or
`T_tool_camera: [[...], ...]`: where it is in its tool's frame (OpenCV axes, metres), by the measured joints.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml
from pydantic import Field, model_validator

from worldline_core.config import StrictModel, read_yaml
from worldline_core.data.episodes.episode import Episode
from worldline_core.data.episodes.recorded_poses import RecordedCameras, camera_pose
from worldline_core.data.episodes.source import LensConfig, LoadedEpisode
from worldline_core.data.guards.plain_files import read_json, validated
from worldline_core.data.guards.rejection import RejectedInputError, check_shape, unreadable
from worldline_core.data.guards.source_paths import AnyPath, inside, regular_file
from worldline_core.errors import ConfigError, UnavailableError
from worldline_core.geometry.cameras import CameraAxes, Extrinsics, ImageTransform
from worldline_core.geometry.embodiment import Embodiment, load_embodiment
from worldline_core.geometry.transforms import pose_from_euler_fixed_xyz

_ASPECT_TOLERANCE = 0.01


class PoseFeature(StrictModel):
    """A feature of the dataset that holds a camera's pose."""

    name: str
    format: Literal["xyz_rpy_fixed", "matrix"]


Row = tuple[float, float, float, float]


class CameraEntry(StrictModel):
    """One view. `T` is checked for its shape when it is read: it may have thousands of rows."""

    width: int = Field(ge=1)
    height: int = Field(ge=1)
    K: tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
    maps: Extrinsics | None = None
    axes: CameraAxes | None = None
    T: list[Any] | None = None
    T_feature: PoseFeature | None = None
    mount: Literal["embodiment"] | None = None
    T_tool_camera: tuple[Row, Row, Row, Row] | None = None
    distortion: LensConfig | None = None

    @model_validator(mode="after")
    def _one_pose(self) -> CameraEntry:
        if sum(given is not None for given in (self.T, self.T_feature, self.mount, self.T_tool_camera)) != 1:
            raise ValueError("give T, T_feature, mount or T_tool_camera, one of them")
        conventions = self.maps is not None, self.axes is not None
        if any(conventions) if self.on_hand else not all(conventions):
            raise ValueError("maps and axes belong to T and T_feature, and to nothing else")
        return self

    @property
    def on_hand(self) -> bool:
        """True if the camera is placed by the measured joints."""
        return self.mount is not None or self.T_tool_camera is not None


class CalibrationFile(StrictModel):
    """The whole file."""

    views: dict[str, CameraEntry] = Field(min_length=1)


def read_calibration(root: AnyPath, name: str) -> Mapping[str, CameraEntry]:
    """Cameras by view from a calibration file: one in the source's folder, or by an absolute path the user's own.

    Raises: RejectedInputError: missing_calibration (no such file), path_traversal, unreadable, too_large, missing_column (a key that
        is unknown or missing, or a value of another kind).
    """
    path = Path(name) if Path(name).is_absolute() else inside(root, name)
    try:
        file = regular_file(path, "Calibration file")
    except RejectedInputError as error:
        if error.reason != "missing_file":
            raise
        next_step = "write the file, or leave `calibration` out: such episodes then serve action-free training"
        raise RejectedInputError(
            "missing_calibration", "Calibration file is missing", where=path, next_step=next_step
        ) from error
    faults = (ConfigError, OSError, UnicodeDecodeError, RecursionError, yaml.YAMLError)
    with unreadable("Calibration file is no YAML", path, faults):
        content = read_json(path) if path.suffix.lower() == ".json" else read_yaml(file)
    return validated(CalibrationFile, content, path, "Calibration file").views


def calibrated(
    loaded: LoadedEpisode,
    entries: Mapping[str, CameraEntry],
    where: str,
    views: Collection[str],
    read_feature: Callable[[str], np.ndarray] | None = None,
) -> LoadedEpisode:
    """The episode as it was recorded with the cameras of a calibration file, in place of its own; those on hands follow by
    `LoadedEpisode.with_mounted`.

    Args:
        views: names that views of the source may have, whether this recording has them or not.
        read_feature: a column of the recording by its name, for files that name one.

    Raises: RejectedInputError: missing_view, missing_calibration (K is of another picture), length_mismatch, invalid_extrinsics,
        missing_column.
    """
    if not entries.keys() <= set(views):
        expected, got = ", ".join(sorted(filter(None, views))), ", ".join(entries)
        raise RejectedInputError(
            "missing_view", "Calibration names views that are not read", where=where, expected=expected, got=got
        )
    shown = {view: entry for view, entry in entries.items() if view in loaded.views}
    placed = {view: entry for view, entry in shown.items() if not entry.on_hand}
    mounted = {view: entry for view, entry in shown.items() if entry.on_hand}

    def recorded(view: str, entry: CameraEntry, episode: Episode) -> np.ndarray | None:
        at, length = f"{where}, view {view}", episode.num_frames
        if entry.T_feature is None:
            return still_poses(entry, length, at)
        if read_feature is None:
            raise RejectedInputError(
                "missing_column",
                "Recordings of this kind have no features",
                where=at,
                got=entry.T_feature.name,
                next_step="give T",
            )
        return _feature_poses(entry.T_feature, read_feature, length, at)

    def by_joints(view: str, entry: CameraEntry, episode: Episode) -> np.ndarray:
        at = f"{where}, view {view}"
        if episode.state_kind != "joints":
            raise RejectedInputError("missing_calibration", "A mount needs joints", where=at, next_step="give T")
        return mounted_poses(view, entry, episode.embodiment, episode.state, at)

    loaded = _with_cameras(loaded, placed, recorded, where)
    return replace(loaded, with_mounted=lambda later: _with_cameras(later, mounted, by_joints, where))


def _with_cameras(
    loaded: LoadedEpisode,
    entries: Mapping[str, CameraEntry],
    poses: Callable[[str, CameraEntry, Episode], np.ndarray | None],
    where: str,
) -> LoadedEpisode:
    """The episode with these cameras and their lenses; without a pose a view keeps what it has."""
    cameras, episode = RecordedCameras(), loaded.episode
    for view, entry in entries.items():
        image_size = loaded.image_size(view)
        if (matrices := poses(view, entry, episode)) is not None:
            add_camera(cameras, view, entry, matrices, image_size, f"{where}, view {view}")
    lenses = {view: lens for view, lens in loaded.distortions.items() if view not in cameras.tracks}
    known, conventions = {**episode.cameras, **cameras.tracks}, {**episode.conventions, **cameras.notes()}
    episode = replace(episode, cameras=known, conventions=conventions)
    return replace(loaded, episode=episode, distortions=lenses | cameras.lenses)


def add_camera(
    cameras: RecordedCameras,
    view: str,
    entry: CameraEntry,
    matrices: np.ndarray,
    image_size: tuple[int, int],
    where: str,
) -> None:
    """Add a camera of a file, with these of its poses (n or 1, 4, 4), for images of (height, width): K follows where only the scale
    differs.

    Raises: RejectedInputError: missing_calibration (K is of another picture), invalid_extrinsics.
    """
    height, width = image_size
    if abs(entry.width * height / (entry.height * width) - 1) > _ASPECT_TOLERANCE:
        raise RejectedInputError(
            "missing_calibration",
            "Calibration is of an image of another shape",
            where=where,
            expected=f"the aspect of {width}x{height}",
            got=f"{entry.width}x{entry.height}",
            next_step="give K for the recorded image: the sizes do not show what was cropped",
        )
    extrinsics, axes = entry.maps or "camera_to_base", entry.axes or "opencv"
    pose = camera_pose(view, matrices, extrinsics=extrinsics, axes=axes, where=where)
    K = ImageTransform.of((entry.height, entry.width)).resize(image_size).intrinsics(np.asarray(entry.K))
    cameras.add(view, K, pose, image_size, None if entry.distortion is None else entry.distortion.distortion)
    if entry.T_tool_camera is not None:
        cameras.mounted.append(view)


def mounted_poses(view: str, entry: CameraEntry, robot: str | Embodiment, state: np.ndarray, where: str) -> np.ndarray:
    """T_base_camera (n, 4, 4) of a wrist camera, by its robot's description or in its tool's frame, from joints (n, j).

    Raises: RejectedInputError (missing_calibration) where the description is not here, or has no such arm or camera.
    """
    from worldline_core.geometry.kinematics import ArmKinematics  # needs torch, which configurations do without

    try:
        embodiment = load_embodiment(robot) if isinstance(robot, str) else robot
        kinematics, state = ArmKinematics(embodiment), state.astype(np.float64)
        if entry.T_tool_camera is not None:
            tools = kinematics.tool_poses(state).numpy()
            names = [arm.camera_view for arm in embodiment.arms]
            poses = {name: tools[:, i] @ np.array(entry.T_tool_camera) for i, name in enumerate(names)}
        else:
            poses = {name: pose.numpy() for name, pose in kinematics.wrist_camera_poses(state).items()}
    except (ConfigError, UnavailableError) as error:
        raise RejectedInputError(
            "missing_calibration", "The robot's description mounts no camera", where=where, got=error.what,
            next_step="give T or T_feature",
        ) from error  # fmt: skip
    if view not in poses:
        raise RejectedInputError(
            "missing_calibration", "The robot's description mounts no camera of this view", where=where,
            expected=f"one of {', '.join(poses)}" if poses else f"wrist_camera in {embodiment.name}.yaml", got=view,
            next_step="give T or T_feature, or add wrist_camera to the embodiment (docs/embodiments.md)",
        )  # fmt: skip
    return poses[view]


def still_poses(entry: CameraEntry, num_frames: int, where: str) -> np.ndarray:
    """(1 or num_frames, 4, 4). Raises: RejectedInputError: invalid_extrinsics, length_mismatch."""
    try:
        values = np.asarray(entry.T or [], dtype=np.float64)
        values = values.reshape(-1, 4, 4) if values.shape[-2:] == (4, 4) else values.reshape(0, 4, 4)
    except (ValueError, TypeError, OverflowError) as error:
        raise RejectedInputError(
            "invalid_extrinsics", "Camera matrices have a wrong shape", where=where, expected="(4, 4)", got=str(error)
        ) from error
    if len(values) not in (1, num_frames):
        raise RejectedInputError(
            "length_mismatch",
            "Camera poses and states differ in length",
            where=where,
            expected=f"1 or {num_frames} matrices",
            got=len(values),
        )
    return values


def _feature_poses(
    feature: PoseFeature, read_feature: Callable[[str], np.ndarray], num_frames: int, where: str
) -> np.ndarray | None:
    """(N or 1, 4, 4); one where all frames agree; None where nothing but zeros is written."""
    values = read_feature(feature.name).astype(np.float64)
    wanted = 6 if feature.format == "xyz_rpy_fixed" else 16
    check_shape("Camera pose", f"{where}, {feature.name}", values.shape, (num_frames, wanted))
    if not values.any():
        return None
    if (values == values[0]).all():
        values = values[:1]
    if feature.format == "matrix":
        return values.reshape(-1, 4, 4)
    return pose_from_euler_fixed_xyz(values[:, :3], values[:, 3:])
