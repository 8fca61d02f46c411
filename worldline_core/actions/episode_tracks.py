"""Tracks of one episode: where every end-effector is in every view, frame by frame, before any map is drawn.

Axis legend: n frames, v views, a arms, s capsules. Frames of reference: base, tool (between the fingertips, +z out
of the gripper), camera (OpenCV axes). Units: metres, pixels of the recorded frame size (centre of the first pixel
is 0), gripper opening 0 closed .. 1 open.

A sample is masked, and counted by its cause, when the tool is behind the camera, outside of the image, or when the
calibration of the view is invalid (method, section 2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from worldline_core.errors import DataError
from worldline_core.geometry.cameras import MIN_DEPTH_M, inside_image, valid_intrinsics
from worldline_core.geometry.rot6d import rot6d_from_rotation
from worldline_core.geometry.se3 import invert, is_rigid

WristProjection = Literal["current_camera", "clip_start_camera"]
CAUSES = ("valid", "behind_camera", "outside_image", "invalid_calibration")
"""What `Projection.cause` counts; 0 is valid."""
HEAD_VIEW = "head"


@dataclass(frozen=True)
class Projection:
    """End-effectors seen by cameras. Where `valid` is false, depth, rot6d and gripper still hold what is known, or 0."""

    uv: Float[Tensor, "*n v a 2"]
    depth: Float[Tensor, "*n v a"]
    rot6d: Float[Tensor, "*n v a 6"]
    gripper: Float[Tensor, "*n v a"]
    valid: Bool[Tensor, "*n v a"]
    cause: Int[Tensor, "*n v a"]


def project_tools(
    T_base_tool: Float[Tensor, "*n a 4 4"],
    gripper: Float[Tensor, "*n a"],
    K: Float[Tensor, "*#n v 3 3"],
    T_base_camera: Float[Tensor, "*#n v 4 4"],
    image_size: tuple[int, int],
) -> Projection:
    """Project every arm's tool into every view, in float64.

    d is the depth of the tool in the camera, r its orientation in the camera frame (Rot6D), g the gripper opening,
    clipped to 0..1.

    Args:
        K: pixels at image_size.
        T_base_camera: maps camera points to base.
        image_size: (height, width).
    """
    cameras = T_base_camera.double()
    calibrated = valid_intrinsics(K.double()) & is_rigid(cameras)
    tools = T_base_tool.double()[..., None, :, :, :]
    known = calibrated[..., None] & torch.isfinite(tools).all(-1).all(-1)
    eye = torch.eye(4, dtype=torch.float64, device=tools.device)
    cameras = torch.where(calibrated[..., None, None], cameras, eye)
    intrinsics = torch.where(calibrated[..., None, None], K.double(), eye[:3, :3])
    T_camera_tool = invert(cameras)[..., :, None, :, :] @ torch.where(known[..., None, None], tools, eye)
    position = T_camera_tool[..., :3, 3]
    depth = position[..., 2]
    in_front = depth > MIN_DEPTH_M
    plane = position / torch.where(in_front, depth, torch.ones_like(depth))[..., None]
    uv = (intrinsics[..., :, None, :2, :] @ plane[..., None])[..., 0]
    visible = inside_image(uv, image_size)
    uv = torch.where((known & in_front)[..., None], uv, torch.zeros_like(uv))
    opening = gripper.double()[..., None, :].expand(depth.shape)
    cause = torch.where(visible, 0, 2)
    cause = torch.where(in_front, cause, 1)
    cause = torch.where(known & torch.isfinite(opening), cause, 3)
    rot6d = rot6d_from_rotation(T_camera_tool[..., :3, :3])
    return Projection(
        uv=uv,
        depth=torch.where(known, depth, torch.zeros_like(depth)),
        rot6d=torch.where(known[..., None], rot6d, torch.zeros_like(rot6d)),
        gripper=torch.nan_to_num(opening).clamp(0.0, 1.0),
        valid=cause == 0,
        cause=cause,
    )


@dataclass(frozen=True)
class EpisodeTracks:
    """Tracks of one episode (or of a clip of it), numpy, float32.

    Attributes:
        views: always the three of the project, in their order; a view that the episode lacks is never valid.
        uv, depth, rot6d, gripper, valid: (N, V, A, ...).
        T_base_tool: (N, A, 4, 4) and T_base_camera (N, V, 4, 4), from which other projections are possible.
        K: (V, 3, 3), pixels at image_size (height, width).
        camera_motion: by view, where T_base_camera comes from: "static" (first frame), "kinematics" (of the
            controls), "first_frame_mount" (kinematics, mount solved at the first frame), "recorded", or "absent".
        controls: "state", "action", or "ee_pose" where a source records tool poses.
        capsules: (N, S, 2, 3) robot parts as base-frame segments, capsule_radii (S,) in metres.
    """

    episode_id: str
    embodiment: str
    views: tuple[str, ...]
    arms: tuple[str, ...]
    image_size: tuple[int, int]
    controls: str
    camera_motion: tuple[str, ...]
    uv: np.ndarray
    depth: np.ndarray
    rot6d: np.ndarray
    gripper: np.ndarray
    valid: np.ndarray
    T_base_tool: np.ndarray
    T_base_camera: np.ndarray
    K: np.ndarray
    capsules: np.ndarray
    capsule_radii: np.ndarray

    @property
    def num_frames(self) -> int:
        return len(self.depth)

    def clip(
        self,
        frames: Sequence[int] | np.ndarray,
        *,
        wrist_projection: WristProjection = "current_camera",
        start: int | None = None,
    ) -> EpisodeTracks:
        """Tracks at these frame numbers.

        With `clip_start_camera`, wrist views are projected into the camera's pose at frame `start` (default: the
        first of `frames`): a wrist camera sees its own gripper at a constant pixel, so only so does that arm's map
        in that view carry motion. Head tracks and stored camera poses are unchanged.

        Raises: DataError for a frame outside of the episode.
        """
        index = np.asarray(frames, dtype=np.int64)
        first = int(index[0]) if start is None and len(index) else int(start or 0)
        if len(index) == 0 or min(index.min(), first) < 0 or max(int(index.max()), first) >= self.num_frames:
            raise DataError(
                "Frames outside of the action tracks",
                where=f"episode {self.episode_id}",
                expected=f"0..{self.num_frames - 1}",
                got=f"{index.tolist()[:4]}..., start {first}",
            )
        cut = replace(
            self,
            **{
                name: getattr(self, name)[index]
                for name in ("uv", "depth", "rot6d", "gripper", "valid", "T_base_tool", "T_base_camera", "capsules")
            },
        )
        wrists = [i for i, view in enumerate(self.views) if view != HEAD_VIEW]
        if wrist_projection == "current_camera" or not wrists:
            return cut
        seen = project_tools(
            torch.from_numpy(cut.T_base_tool),
            torch.from_numpy(cut.gripper[:, 0]),
            torch.from_numpy(self.K[wrists]),
            torch.from_numpy(self.T_base_camera[first, wrists]),
            self.image_size,
        )
        arrays = {name: getattr(cut, name).copy() for name in ("uv", "depth", "rot6d", "valid")}
        for name, array in arrays.items():
            array[:, wrists] = getattr(seen, name).numpy().astype(array.dtype)
        return replace(cut, **arrays)


@dataclass(frozen=True)
class TrackBatch:
    """Tracks of several clips as tensors on one device; episodes with fewer arms are padded with invalid ones."""

    uv: Float[Tensor, "b t v a 2"]
    depth: Float[Tensor, "b t v a"]
    rot6d: Float[Tensor, "b t v a 6"]
    gripper: Float[Tensor, "b t v a"]
    valid: Bool[Tensor, "b t v a"]

    def to(self, device: torch.device | str) -> TrackBatch:
        """The same batch on another device."""
        return TrackBatch(*(getattr(self, name).to(device) for name in ("uv", "depth", "rot6d", "gripper", "valid")))


def collate_tracks(clips: Sequence[EpisodeTracks], views: Sequence[str] | None = None) -> TrackBatch:
    """Stack clips of equal length, views in the given order (default: the views of the first clip).

    Raises: DataError when a clip lacks a view, or the clips differ in length or frame size.
    """
    if not clips:
        raise DataError("No action tracks to collate", expected="at least one clip", got="none")
    order = tuple(views or clips[0].views)
    num_arms = max(len(clip.arms) for clip in clips)
    columns: dict[str, list[np.ndarray]] = {name: [] for name in ("uv", "depth", "rot6d", "gripper", "valid")}
    for clip in clips:
        missing = [view for view in order if view not in clip.views]
        if missing or clip.num_frames != clips[0].num_frames or clip.image_size != clips[0].image_size:
            raise DataError(
                "Action tracks do not fit together in one batch",
                where=f"episode {clip.episode_id}",
                expected=f"views {order}, {clips[0].num_frames} frames of {clips[0].image_size}",
                got=f"views {clip.views}, {clip.num_frames} frames of {clip.image_size}",
            )
        index = [clip.views.index(view) for view in order]
        for name, column in columns.items():
            values = getattr(clip, name)[:, index]
            padding = [(0, 0)] * values.ndim
            padding[2] = (0, num_arms - len(clip.arms))
            column.append(np.pad(values, padding))
    return TrackBatch(**{name: torch.from_numpy(np.stack(column)) for name, column in columns.items()})
