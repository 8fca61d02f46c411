"""Departures of a source from the contract, and their repair.

The contract (`worldline_core.data.episodes.episode`): `T_base_camera` maps camera points to base, cameras have OpenCV axes,
metres, radians, quaternions xyzw, state blocks left then right, tool poses between the fingertips, K at the image's own size,
all arrays of one frame from one instant, gripper 0 closed .. 1 open.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from worldline_core.config import StrictModel
from worldline_core.data.episodes.episode import CameraTrack, Episode
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.errors import ConfigError
from worldline_core.geometry.cameras import OPENGL_AXES
from worldline_core.geometry.transforms import (
    quaternion_xyzw_from_rotation,
    reread_as_moving,
    reread_as_wxyz,
    rigid_inverse,
    rotation_from_quaternion_xyzw,
)


def is_gripper(name: str) -> bool:
    """True if a state column is called a gripper, in any source's spelling (`right/gripper`, `gripper.pos`)."""
    return "gripper" in name.lower()


def arm_blocks(episode: Episode) -> tuple[tuple[int, ...], ...]:
    """State columns of each arm: a block ends with its gripper. Empty where the state is not named like that."""
    names = episode.state_names or ()
    ends = [i + 1 for i, name in enumerate(names) if name.endswith("gripper")]
    if not ends or ends[-1] != len(names):
        return ()
    return tuple(tuple(range(start, end)) for start, end in zip([0, *ends[:-1]], ends, strict=True))


def _two_equal_arms(episode: Episode) -> bool:
    blocks = arm_blocks(episode)
    equal = len(blocks) == 2 and len(blocks[0]) == len(blocks[1])
    return equal and (episode.T_base_ee is None or episode.T_base_ee.shape[1] == 2)


_CAMERA = ("a calibrated camera", lambda episode: bool(episode.cameras))
_POSES = ("recorded tool poses", lambda episode: episode.T_base_ee is not None)
_NEEDS: dict[str, tuple[str, Callable[[Episode], bool]]] = {
    **dict.fromkeys(("extrinsics", "camera_axes", "extrinsics_unit", "intrinsics_size"), _CAMERA),
    **dict.fromkeys(("pose_unit", "quaternion", "euler", "tool_offset_z_m"), _POSES),
    "camera_lag_frames": (
        "a calibrated camera that moves",
        lambda episode: any(camera.moving for camera in episode.cameras.values()),
    ),
    "angle_unit": ("joint positions in the state", lambda episode: episode.state_kind == "joints"),
    "arms": ("two arms with equal state blocks, each ending with its gripper", _two_equal_arms),
    "image_lag_frames": ("anything", lambda _: True),
    "gripper": ("state columns whose names end with gripper", lambda episode: bool(arm_blocks(episode))),
}
"""Requirements of an episode for a field of `RecordedConventions` to apply to it, in words and as a test."""


def applicable(episode: Episode, field: str) -> bool:
    """True if a field of `RecordedConventions` applies to the episode."""
    return _NEEDS[field][1](episode)


def check_applicable(episode: Episode, fields: Iterable[str]) -> None:
    """Raises: RejectedInputError (convention_not_applicable) for the first field that does not apply to the episode."""
    for field in fields:
        if not applicable(episode, field):
            raise RejectedInputError(
                "convention_not_applicable",
                "The episode has nothing that a declared convention applies to",
                where=f"episode {episode.episode_id}, conventions.{field}",
                expected=_NEEDS[field][0],
                got=f"state {episode.state_kind}, {len(episode.cameras)} cameras, "
                + ("tool poses" if episode.T_base_ee is not None else "no tool poses"),
                next_step="remove the line, or give these episodes a source of their own",
                evidence={"field": field},
            )


class RecordedConventions(StrictModel):
    """Departures of a source's numbers from the contract; the default says: as the contract.

    One field per common mistake; setting it is the configuration line that repairs it.
    """

    extrinsics: Literal["camera_to_base", "base_to_camera"] = Field(
        default="camera_to_base", description="what the recorded camera matrices map"
    )
    camera_axes: Literal["opencv", "opengl"] = Field(
        default="opencv", description="opencv: x right, y down, z forward; opengl: x right, y up, z backward"
    )
    extrinsics_unit: Literal["m", "mm"] = "m"
    pose_unit: Literal["m", "mm"] = Field(default="m", description="of recorded tool poses")
    quaternion: Literal["xyzw", "wxyz"] = Field(default="xyzw", description="order in recorded tool poses")
    euler: Literal["fixed_xyz", "moving_xyz"] = Field(
        default="fixed_xyz", description="what roll, pitch, yaw turn about: R = Rz Ry Rx (fixed) or Rx Ry Rz (moving)"
    )
    angle_unit: Literal["rad", "deg"] = Field(default="rad", description="of recorded joint positions")
    arms: Literal["as_written", "exchanged"] = Field(
        default="as_written", description="exchanged: the state's left block is the right arm's, and the reverse"
    )
    tool_offset_z_m: float = Field(
        default=0.0, ge=-1, le=1, description="from the recorded tool poses to the fingertips, along the tool's +z"
    )
    intrinsics_size: tuple[int, int] | None = Field(
        default=None, description="(height, width) of the image that K belongs to; null: the recorded image's"
    )
    camera_lag_frames: int = Field(
        default=0, ge=-100, le=100, description="camera poses trail the states by so many frames"
    )
    image_lag_frames: int = Field(default=0, ge=-100, le=100, description="images trail the states by so many frames")
    gripper: Literal["as_written", "inverted"] = Field(default="as_written", description="inverted: 1 means closed")
    views: tuple[str, ...] | None = Field(
        default=None,
        description="views that extrinsics, camera_axes, extrinsics_unit, intrinsics_size and image_lag_frames speak of; "
        "null: all",
    )

    @model_validator(mode="after")
    def _positive_size(self) -> RecordedConventions:
        if self.intrinsics_size is not None and min(self.intrinsics_size) < 1:
            raise ValueError(f"intrinsics_size {self.intrinsics_size} is no image size")
        return self

    def image_lag(self, view: str) -> int:
        """Frames by which the images of a view trail the states."""
        return self.image_lag_frames if self.views is None or view in self.views else 0

    @property
    def departures(self) -> tuple[str, ...]:
        """Names of the fields that differ from the contract, without `views`."""
        default = RecordedConventions()
        return tuple(
            name
            for name in type(self).model_fields
            if name != "views" and getattr(self, name) != getattr(default, name)
        )

    def config_lines(self, prefix: str = "curate.sources[].conventions") -> tuple[str, ...]:
        """The lines that a configuration needs for a source which writes like this."""
        lines = []
        for name in (*self.departures, *(("views",) if self.views is not None and self.departures else ())):
            value = getattr(self, name)
            text = f"[{', '.join(str(v) for v in value)}]" if isinstance(value, tuple) else str(value)
            lines.append(f"{prefix}.{name}: {text}")
        return tuple(lines)


def with_image_lags(conventions: RecordedConventions, lags: Mapping[str, int]) -> RecordedConventions:
    """The conventions of a source whose pictures were measured to trail the states by so many frames more, by view. Where all
    measured views trail alike, the others do as well: the states are early.

    Raises: ConfigError where views need different lags.
    """
    late = set(lags.values()) - {0}
    if not late:
        return conventions
    views = None if len(set(lags.values())) == 1 else tuple(view for view, lag in lags.items() if lag)
    if len(late) > 1 or conventions.views is not None or (views and conventions.image_lag_frames):
        raise ConfigError(
            "Views trail the states by different numbers of frames", where="curate.sources[].conventions", expected="one lag",
            got=", ".join(f"{view} by {conventions.image_lag(view) + lag}" for view, lag in lags.items()),
            next_step="shift the pictures where they are recorded, or leave views out",
        )  # fmt: skip
    lag = conventions.image_lag_frames + late.pop()
    return conventions.model_copy(update={"image_lag_frames": lag, "views": views})


def image_frames(num_frames: int, conventions: RecordedConventions, view: str) -> slice:
    """Indices of a view's recorded images that belong to the frames of the repaired episode, in order."""
    first, last = frames_with_all(num_frames, conventions)
    lag = conventions.image_lag(view)
    return slice(first + lag, last + lag)


def apply_conventions(episode: Episode, conventions: RecordedConventions) -> Episode:
    """The episode in the contract's conventions, from one whose numbers were read as they were written.

    A lag of k frames loses k frames: of state i the camera pose is read at i + camera_lag_frames and the image at i +
    image_lag_frames (`image_frames` says which images remain).

    Raises:
        RejectedInputError (convention_not_applicable): the episode has nothing that a departing field speaks of, for
            example a quaternion order where no tool poses are recorded; (too_short): a lag leaves fewer than two frames.
    """
    check_applicable(episode, conventions.departures)
    episode = shift(episode, conventions)
    episode = replace(episode, cameras={v: _repair_camera(c, conventions) for v, c in episode.cameras.items()})
    if conventions.angle_unit == "deg":
        episode = scale_joints(episode, np.pi / 180)
    offset = source_offset(episode)
    poses = episode.T_base_ee
    if poses is not None:
        poses = along_tool_z(poses, -offset)
        poses = scaled(poses, 1e-3 if conventions.pose_unit == "mm" else 1.0)
        if conventions.quaternion == "wxyz":
            poses = rotated(poses, reread_as_wxyz(poses[..., :3, :3]))
        if conventions.euler == "moving_xyz":
            poses = rotated(poses, reread_as_moving(poses[..., :3, :3]))
        poses = along_tool_z(poses, offset + conventions.tool_offset_z_m)
        episode = replace(episode, T_base_ee=poses)
    if {"pose_unit", "quaternion", "euler"} & set(conventions.departures):
        scale = 1e-3 if conventions.pose_unit == "mm" else 1.0
        episode = pose_columns(episode, scale, lambda xyzw: _reread(xyzw, conventions))
    if conventions.arms == "exchanged":
        episode = exchange_arms(episode)
    return invert_gripper(episode) if conventions.gripper == "inverted" else episode


def along_tool_z(poses: np.ndarray, offset_m: float) -> np.ndarray:
    """Poses (..., 4, 4) moved along their own +z."""
    moved = poses.copy()
    moved[..., :3, 3] += offset_m * poses[..., :3, 2]
    return moved


def _repair_camera(camera: CameraTrack, conventions: RecordedConventions) -> CameraTrack:
    if conventions.views is not None and camera.view not in conventions.views:
        return camera
    poses = scaled(camera.T_base_camera, 1e-3 if conventions.extrinsics_unit == "mm" else 1.0)
    poses = rigid_inverse(poses) if conventions.extrinsics == "base_to_camera" else poses
    poses = poses @ OPENGL_AXES if conventions.camera_axes == "opengl" else poses
    K = camera.K
    if conventions.intrinsics_size is not None:
        height, width = conventions.intrinsics_size
        K = replace(camera, width=width, height=height).resized(camera.width, camera.height).K
    return replace(camera, K=K, T_base_camera=poses)


def _reread(xyzw: np.ndarray, conventions: RecordedConventions) -> np.ndarray:
    """The true quaternions (..., 4) of a state, whose columns are in the order of the file."""
    if conventions.quaternion == "wxyz":
        xyzw = np.roll(xyzw, -1, axis=-1)
    return turned(xyzw, reread_as_moving) if conventions.euler == "moving_xyz" else xyzw


def frames_with_all(num_frames: int, conventions: RecordedConventions) -> tuple[int, int]:
    """First and end (exclusive) of the state frames for which camera pose and image exist."""
    lags = (0, conventions.camera_lag_frames, conventions.image_lag_frames)
    return max(0, -min(lags)), num_frames - max(0, *lags)


def shift(episode: Episode, conventions: RecordedConventions) -> Episode:
    """State i with the camera pose of i + camera_lag_frames; frames without one are cut."""
    if conventions.camera_lag_frames == 0 and conventions.image_lag_frames == 0:
        return episode
    first, last = frames_with_all(episode.num_frames, conventions)
    if last - first < 2:
        raise RejectedInputError(
            "too_short",
            "A lag leaves fewer than two frames",
            where=f"episode {episode.episode_id}",
            expected="an episode longer than its lag",
            got=f"{episode.num_frames} frames, lags {conventions.camera_lag_frames}, {conventions.image_lag_frames}",
        )
    lag = conventions.camera_lag_frames
    cameras = {view: camera.cut(first + lag, last + lag) for view, camera in episode.cameras.items()}
    cut = episode.cut(first, last)
    with_images = None
    if episode.video_frames is not None:
        lags = {conventions.image_lag_frames} | ({0} if conventions.views is not None else set())
        with_images = max(0, min(min(episode.video_frames, last + late) - first - late for late in lags))
    return replace(cut, cameras=cameras, video_frames=with_images)


def scaled(poses: np.ndarray, scale: float) -> np.ndarray:
    """Poses (..., 4, 4) with their places scaled."""
    if scale == 1.0:
        return poses
    result = poses.copy()
    result[..., :3, 3] *= scale
    return result


def rotated(poses: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Poses (..., 4, 4) with other rotations (..., 3, 3)."""
    result = poses.copy()
    result[..., :3, :3] = rotation
    return result


def source_offset(episode: Episode) -> float:
    """Offset along z that the source's reader already added to the recorded poses [m]."""
    return float(episode.conventions.get("tool_offset_m", 0.0))


def scale_joints(episode: Episode, scale: float) -> Episode:
    """The state's columns except grippers, scaled."""
    factors = np.full(episode.state.shape[1], scale, episode.state.dtype)
    factors[[block[-1] for block in arm_blocks(episode)]] = 1
    return replace(episode, state=episode.state * factors, action=episode.action * factors)


def exchange_arms(episode: Episode) -> Episode:
    """The left block, tool and gripper as the right one's, and the reverse."""
    first, second = arm_blocks(episode)
    order = [*second, *first]
    return replace(
        episode,
        state=episode.state[:, order],
        action=episode.action[:, order],
        # Copies: torch takes no array that is read backwards.
        T_base_ee=None if episode.T_base_ee is None else episode.T_base_ee[:, ::-1].copy(),
        gripper=None if episode.gripper is None else episode.gripper[:, ::-1].copy(),
    )


def invert_gripper(episode: Episode) -> Episode:
    """Openings o as 1 - o."""
    columns = [block[-1] for block in arm_blocks(episode)]
    state, action = episode.state.copy(), episode.action.copy()
    state[:, columns] = 1 - state[:, columns]
    action[:, columns] = 1 - action[:, columns]
    return replace(
        episode, state=state, action=action, gripper=None if episode.gripper is None else 1 - episode.gripper
    )


def pose_columns(episode: Episode, scale: float, change: Callable[[np.ndarray], np.ndarray]) -> Episode:
    """A state of tool poses with the places of its blocks (x y z qx qy qz qw) scaled and their quaternions changed."""
    if episode.state_kind != "ee_pose":
        return episode
    names = episode.state_names or ()
    arrays: list[np.ndarray] = []
    for values in (episode.state, episode.action):
        result = values.astype(np.float64)
        for block in arm_blocks(episode):
            column = {names[i].rsplit("/", 1)[-1]: i for i in block}
            result[:, [column[axis] for axis in "xyz" if axis in column]] *= scale
            if all(name in column for name in ("qx", "qy", "qz", "qw")):
                xyzw = [column[name] for name in ("qx", "qy", "qz", "qw")]
                result[:, xyzw] = change(result[:, xyzw])
        arrays.append(result.astype(values.dtype))
    return replace(episode, state=arrays[0], action=arrays[1])


def turned(xyzw: np.ndarray, change: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Quaternions (..., 4) whose rotation matrices are changed."""
    return quaternion_xyzw_from_rotation(change(rotation_from_quaternion_xyzw(xyzw)))
