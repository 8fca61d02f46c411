"""Action rendering: from an episode's controls to its action tracks, the projected end-effectors (paper, "Action rendering").

Projected commands look at no future observation: tool poses are their forward kinematics, also where a source records
tool poses, for those were measured. The head camera keeps the pose of the first frame. A wrist camera follows from the
controls and its mount (`wrist_camera` of the embodiment); where a source publishes no mount, either the mount is solved
once at the first frame or the recorded extrinsics are used, and the tracks say so (`camera_motion`): of a recorded camera
the future is seen.

Axis legend: n frames (any number of leading axes), v views, a arms; a sample is one frame, view and arm. Frames of
reference: base, tool (between the fingertips, +z out of the gripper), camera (OpenCV axes). Units: metres, pixels
(centre of the first pixel is 0), gripper opening 0 closed .. 1 open.

A sample that is not valid has exactly one cause, the first in this order that applies:

1. `invalid_calibration`: K is no pinhole matrix, T_base_camera is not rigid, or the control itself is unknown (a tool
   pose or an opening that is not finite);
2. `behind_camera`: depth <= MIN_DEPTH_M, so a depth of 0 and of exactly MIN_DEPTH_M too;
3. `outside_image`: not on a pixel, that is not -0.5 <= u < width - 0.5 and -0.5 <= v < height - 0.5.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Literal

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Bool, Float, Int
from torch import Tensor

from worldline_core.actions.actions_config import TEMPORAL_FACTOR
from worldline_core.actions.episode_tracks import HEAD_VIEW, EpisodeTracks
from worldline_core.actions.robot_masks import robot_capsules, tool_capsules
from worldline_core.data.episodes.episode import VIEWS, Episode
from worldline_core.errors import CalibrationError, DataError
from worldline_core.geometry.cameras import MIN_DEPTH_M, inside_image
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.geometry.tensor_transforms import invert, is_rigid, rot6d_from_rotation, valid_intrinsics
from worldline_core.geometry.transforms import rotation_angle_deg

CAUSES = ("valid", "behind_camera", "outside_image", "invalid_calibration")
"""Names of the values of `Projection.cause`; 0 is valid."""
FRAMES_AT_ONCE = 2048
"""On a CPU, longer recordings are projected in pieces whose temporary arrays stay in the cache; the bits are the same."""
_VALID, _BEHIND, _OUTSIDE, _INVALID = range(len(CAUSES))


@dataclass(frozen=True)
class Projection:
    """End-effectors seen by cameras. Where `valid` is false, the values are finite: what is known of them, or 0."""

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
    """Project every arm's tool into every view, in float64 (paper, "Cross-Embodiment Spatial Action Conditioning").

    uv is the pixel of the tool's origin, depth [m] its distance along the camera's axis, rot6d its orientation in the
    camera frame (first two columns), gripper the opening clipped to 0..1. Differentiable in every input; the gradient
    of a masked sample is finite.

    Args:
        T_base_tool: maps tool points to base [m].
        gripper: opening, not clipped.
        K: pixels at image_size.
        T_base_camera: maps camera points (OpenCV axes) to base [m].
        image_size: (height, width).
    """
    frames = T_base_tool.shape[0]
    if T_base_tool.ndim != 4 or frames <= FRAMES_AT_ONCE or T_base_tool.device.type != "cpu":
        return _project(T_base_tool, gripper, K, T_base_camera, image_size)
    parts = []
    for start in range(0, frames, FRAMES_AT_ONCE):
        piece = slice(start, start + FRAMES_AT_ONCE)
        # Cameras given once for all frames have no frame axis, or one of length 1.
        cut_K, cut_cameras = (x[piece] if x.ndim == 4 and len(x) == frames else x for x in (K, T_base_camera))
        parts.append(_project(T_base_tool[piece], gripper[piece], cut_K, cut_cameras, image_size))
    return Projection(**{f.name: torch.cat([getattr(part, f.name) for part in parts]) for f in fields(Projection)})


def _project(
    T_base_tool: Tensor, gripper: Tensor, K: Tensor, T_base_camera: Tensor, image_size: tuple[int, int]
) -> Projection:
    tools, cameras, intrinsics = T_base_tool.double(), T_base_camera.double(), K.double()
    eye = torch.eye(4, dtype=torch.float64, device=tools.device)
    calibrated = valid_intrinsics(intrinsics) & is_rigid(cameras)
    posed = torch.isfinite(tools).flatten(-2).all(-1)
    # Unknown poses are replaced before any arithmetic, so that neither a value nor a gradient becomes NaN.
    tools = torch.where(posed[..., None, None], tools, eye)
    cameras = torch.where(calibrated[..., None, None], cameras, eye)
    intrinsics = torch.where(calibrated[..., None, None], intrinsics, eye[:3, :3])

    # One product per frame turns the x axis, the y axis and the origin of all tools into all cameras: rows are those of
    # R_camera_base of each view, columns those of each tool. The third axis and the last row are never needed.
    R_base_camera, origin = cameras[..., :3, :3], cameras[..., :3, 3]
    turns = rearrange(R_base_camera, "... v j i -> ... (v i) j")
    columns = rearrange(torch.cat([tools[..., :3, :2], tools[..., :3, 3:]], -1), "... a j c -> ... j (a c)")
    turned = rearrange(turns @ columns, "... (v i) (a c) -> ... v a c i", i=3, c=3)
    x, y, depth = (turned[..., 2, :] - (R_base_camera.mT @ origin[..., None]).mT).unbind(-1)

    in_front = depth > MIN_DEPTH_M
    divisor = torch.where(in_front, depth, 1.0)
    x, y = x / divisor, y / divisor
    (fx, skew, cx), (skew_y, fy, cy) = (row[..., None, :].unbind(-1) for row in intrinsics[..., :2, :].unbind(-2))
    uv = torch.stack([fx * x + skew * y + cx, skew_y * x + fy * y + cy], dim=-1)

    opening = gripper.double()
    located = calibrated[..., None] & posed[..., None, :]
    known = located & torch.isfinite(opening)[..., None, :]
    cause = torch.where(inside_image(uv, image_size), _VALID, _OUTSIDE)
    cause = torch.where(in_front, cause, _BEHIND)
    cause = torch.where(known, cause, _INVALID)
    return Projection(
        uv=torch.where((located & in_front)[..., None], uv, 0.0),
        depth=torch.where(located, depth, 0.0),
        rot6d=torch.where(located[..., None], rot6d_from_rotation(turned[..., :2, :].mT), 0.0),
        gripper=torch.nan_to_num(opening).clamp(0.0, 1.0)[..., None, :].expand(depth.shape),
        valid=cause == _VALID,
        cause=cause,
    )


def count_samples(
    cause: Int[Tensor, "n v a"], opening: Float[Tensor, "n a"], outside_joint_limits: int
) -> dict[str, int]:
    """Counts of one episode: valid + behind_camera + outside_image + invalid_calibration = samples.

    A sample is one frame, view and arm. `gripper_clipped` counts frames and arms, `outside_joint_limits` frames and joints.

    Args:
        cause: of the views that the episode has.
        opening: gripper opening before it is clipped.
    """
    by_cause = torch.bincount(cause.flatten(), minlength=len(CAUSES)).tolist()
    return {
        "episodes": 1,
        "samples": cause.numel(),
        **dict(zip(CAUSES, by_cause, strict=True)),
        "outside_joint_limits": outside_joint_limits,
        "gripper_clipped": int(((opening < 0) | (opening > 1)).sum()),
    }


def add_counts(parts: Sequence[dict[str, int]]) -> dict[str, int]:
    """Counts of several episodes together."""
    return {name: sum(part[name] for part in parts) for name in parts[0]}


Controls = Literal["action", "state"]
Fallback = Literal["recorded", "first_frame_mount"]
MAX_POSE_ERROR_M, MAX_POSE_ERROR_DEG = 0.01, 2.0
"""Between recorded tool poses and those of the measured joints: published recordings agree to 2 mm and 0.6 degrees."""


class MissingActionsError(DataError):
    """The controls that are asked for are not recorded."""


def compute_tracks(
    episode: Episode,
    kinematics: ArmKinematics | None,
    *,
    controls: Controls = "action",
    without_mount: Fallback = "recorded",
    image_size: tuple[int, int] | None = None,
) -> tuple[EpisodeTracks, dict[str, int]]:
    """Tracks of every frame, view and arm of an episode, and counts of what was masked or clipped.

    An unusable camera (a singular K, a pose that is not rigid) masks the samples of its view and is counted; controls
    that are not finite refuse the episode, whether they are joints or recorded tool poses.

    Args:
        kinematics: of the episode's embodiment; not needed for a measured state with recorded tool poses.
        controls: whether commands or the measured state are projected.
        without_mount: what a moving wrist camera without a known mount follows.
        image_size: (height, width) of the pictures; None: that of the cameras, of which there must be one.

    Raises:
        MissingActionsError: commands are asked for, and none are recorded; or the episode is a plain video.
        CalibrationError: the episode has no camera at all.
        DataError: its joints do not fit the embodiment, are not finite, or do not lead to its recorded tool poses; these
            are not rigid or lack openings; its cameras differ in image size.
    """
    where = f"episode {episode.episode_id}"
    _check_recorded(episode, controls, where)
    image_size = image_size or _image_size(episode, where)
    outside_limits = 0
    wrist_cameras: dict[str, Tensor] = {}
    recorded = None if episode.T_base_ee is None else _recorded_tools(episode.T_base_ee, where)
    if recorded is not None and controls == "state":
        T_base_tool = recorded
        gripper = _recorded_gripper(episode.gripper, T_base_tool.shape[:2], where)
        capsules, radii = tool_capsules(T_base_tool)
        kind = "ee_pose"
        arms = ("left", "right") if T_base_tool.shape[1] == 2 else tuple(f"arm{i}" for i in range(T_base_tool.shape[1]))
    elif kinematics is not None and episode.state_kind == "joints":
        values = np.asarray(episode.action if controls == "action" else episode.state, dtype=np.float64)
        kinematics.embodiment.check_state(values, where)
        links = kinematics.link_poses(values, kinematics.embodiment.noted_posture(episode.conventions))
        T_base_tool, gripper = kinematics.tools_of(links), kinematics.gripper(values)
        if recorded is not None:
            T_base_tool = T_base_tool @ _tool_offsets(kinematics, episode, recorded, where)
        capsules, radii = robot_capsules(kinematics, links)
        wrist_cameras = kinematics.wrist_cameras_of(links)
        outside_limits = int(kinematics.embodiment.outside_limits(values).sum())
        kind = controls
        arms = tuple(arm.name for arm in kinematics.embodiment.arms)
    else:
        raise DataError(
            "Commands are projected through kinematics" if recorded is not None else "Joints without kinematics",
            where=f"{where}, embodiment {episode.embodiment}",
            expected="joints and an embodiment file" + ("" if recorded is not None else ", or recorded tool poses"),
            got=f"state of {episode.state_kind}" + ("" if kinematics is not None else ", no embodiment file"),
            next_step="give the embodiment" + ("" if recorded is None else ", or project the measured state instead"),
        )
    cameras, motion = _camera_poses(episode, T_base_tool, arms, wrist_cameras, without_mount)
    # Zeros are the matrix of no camera: nothing is valid in a view that the episode lacks.
    intrinsics = [episode.cameras[view].K if view in episode.cameras else np.zeros((3, 3)) for view in VIEWS]
    K = torch.from_numpy(np.stack(intrinsics).astype(np.float64))
    seen = project_tools(T_base_tool, gripper, K, cameras, image_size)
    tracks = tracks_of_projection(
        episode, seen, T_base_tool, cameras, K, capsules, radii,
        views=VIEWS, arms=arms, image_size=image_size, controls=kind, camera_motion=motion,
    )  # fmt: skip
    present = [number for number, view in enumerate(VIEWS) if view in episode.cameras]
    native = np.asarray(episode.action if kind == "action" else episode.state, dtype=np.float32)
    return replace(tracks, native=native), count_samples(seen.cause[:, present], gripper, outside_limits)


def tracks_of_projection(
    episode: Episode,
    seen: Projection,
    T_base_tool: Tensor,
    T_base_camera: Tensor,
    K: Tensor,
    capsules: Tensor,
    capsule_radii: Tensor,
    *,
    views: Sequence[str],
    arms: Sequence[str],
    image_size: tuple[int, int],
    controls: str,
    camera_motion: Sequence[str],
) -> EpisodeTracks:
    """Tracks of a projection in the types that tracks are stored in (float32, uv float64); unknown poses become zeros."""
    kept = {
        "T_base_tool": T_base_tool, "T_base_camera": T_base_camera, "K": K, "capsules": capsules,
        "capsule_radii": capsule_radii,
    }  # fmt: skip
    return EpisodeTracks(
        episode_id=episode.episode_id,
        embodiment=episode.embodiment,
        views=tuple(views),
        arms=tuple(arms),
        image_size=image_size,
        controls=controls,
        camera_motion=tuple(camera_motion),
        uv=seen.uv.numpy(),
        valid=seen.valid.numpy(),
        depth=seen.depth.float().numpy(),
        rot6d=seen.rot6d.float().numpy(),
        gripper=seen.gripper.float().numpy(),
        **{name: torch.nan_to_num(value).float().numpy() for name, value in kept.items()},
    )


def _check_recorded(episode: Episode, controls: Controls, where: str) -> None:
    if episode.state_kind == "none":
        raise MissingActionsError(
            "Recording has no states and no actions", where=where, expected="a robot's recording", got="a plain video"
        )
    if controls == "action" and not episode.commanded:
        raise MissingActionsError(
            "Recording has no commands",
            where=where,
            expected="commanded joints",
            got=f"the action {episode.conventions['action']}",
            next_step="project the measured state instead: render_actions.source=state",
        )


def _tool_offsets(kinematics: ArmKinematics, episode: Episode, recorded: Tensor, where: str) -> Tensor:
    """T_tool_recorded (a, 4, 4): from the embodiment's tools to the recorded ones, as at the first frame.

    Raises: DataError where the measured joints do not lead to the recorded poses of all frames: commands would then be
        projected to a wrong place as well.
    """
    state = np.asarray(episode.state, dtype=np.float64)
    tools = kinematics.tool_poses(state, kinematics.embodiment.noted_posture(episode.conventions))
    if tools.shape != recorded.shape:
        raise DataError(
            "Recorded tool poses and embodiment differ in the number of arms",
            where=f"{where}, embodiment {kinematics.embodiment.name}",
            expected=f"{tools.shape[1]} tool poses a frame",
            got=recorded.shape[1],
        )
    offsets = invert(tools[0]) @ recorded[0]
    apart = invert(tools @ offsets) @ recorded
    metres, degrees = apart[..., :3, 3].norm(dim=-1).numpy(), rotation_angle_deg(apart[..., :3, :3].numpy())
    frame = int(np.maximum(metres / MAX_POSE_ERROR_M, degrees / MAX_POSE_ERROR_DEG).max(axis=1).argmax())
    if metres.max() > MAX_POSE_ERROR_M or degrees.max() > MAX_POSE_ERROR_DEG:
        raise DataError(
            "The measured joints do not lead to the recorded tool poses, so commands would be projected to a wrong place",
            where=f"{where}, frame {frame}, embodiment {kinematics.embodiment.name}",
            expected=f"at most {1e3 * MAX_POSE_ERROR_M:g} mm and {MAX_POSE_ERROR_DEG:g} deg apart in all frames",
            got=f"{1e3 * metres[frame].max():.0f} mm and {degrees[frame].max():.1f} deg",
            next_step="check the kinematic description, and whether the waist moves; or project the measured state "
            "instead: render_actions.source=state",
        )
    return offsets


def _image_size(episode: Episode, where: str) -> tuple[int, int]:
    sizes = {(camera.height, camera.width) for camera in episode.cameras.values()}
    if not sizes:
        raise CalibrationError(
            "Episode has no calibrated camera", where=where, expected="K and T_base_camera per view", got="none"
        )
    if len(sizes) > 1:
        raise DataError(
            "Views differ in image size", where=where, expected="one size in an EpisodeSet", got=sorted(sizes)
        )
    return sizes.pop()


def _recorded_tools(recorded: np.ndarray, where: str) -> Tensor:
    poses = torch.from_numpy(np.asarray(recorded, dtype=np.float64))
    bad = torch.nonzero(~is_rigid(poses))
    if len(bad):
        frame, arm = bad[0].tolist()
        raise DataError(
            "Recorded tool poses are not finite, or not rigid transforms",
            where=f"{where}, frame {frame}, arm {arm}",
            expected="R R^T = I, det R = 1, last row 0 0 0 1",
            got=f"{len(bad)} bad, the first {poses[frame, arm].tolist()}",
        )
    return poses


def _recorded_gripper(recorded: np.ndarray | None, shape: tuple[int, ...], where: str) -> Tensor:
    opening = None if recorded is None else np.asarray(recorded, dtype=np.float64)
    if opening is None or opening.shape != shape or not np.isfinite(opening).all():
        bad = None if opening is None else np.argwhere(~np.isfinite(opening))[:1].tolist()
        raise DataError(
            "Recorded tool poses need a finite gripper opening each",
            where=where if not bad else f"{where}, frame {bad[0][0]}, arm {bad[0][1]}",
            expected=f"gripper {tuple(shape)} (frames, arms), 0 closed .. 1 open",
            got=None if opening is None else opening.shape,
        )
    return torch.from_numpy(opening)


def _camera_poses(
    episode: Episode, T_base_tool: Tensor, arms: tuple[str, ...], from_kinematics: dict[str, Tensor], fallback: Fallback
) -> tuple[Tensor, tuple[str, ...]]:
    """T_base_camera (n, v, 4, 4) and where each view's poses come from."""
    num_frames = len(T_base_tool)
    poses, motion = [], []
    for view in VIEWS:
        camera = episode.cameras.get(view)
        if camera is None:
            poses.append(torch.eye(4, dtype=torch.float64).expand(num_frames, 4, 4))
            motion.append("absent")
            continue
        recorded = torch.from_numpy(np.asarray(camera.T_base_camera, dtype=np.float64))
        arm = view.removesuffix("_wrist")
        if view == HEAD_VIEW or (not camera.moving and view not in from_kinematics):
            poses.append(recorded[:1].expand(num_frames, 4, 4))
            motion.append("static")
        elif view in from_kinematics:
            poses.append(from_kinematics[view])
            motion.append("kinematics")
        elif fallback == "first_frame_mount" and arm in arms:
            tools = T_base_tool[:, arms.index(arm)]
            poses.append(tools @ (invert(tools[0]) @ recorded[0]))
            motion.append("first_frame_mount")
        else:
            poses.append(recorded)
            motion.append("recorded")
    return torch.stack(poses, dim=1), tuple(motion)


Change = Literal["mirrored", "delayed"]
DELAY_FRAMES = TEMPORAL_FACTOR
_MIRROR = np.diag([-1.0, 1.0, 1.0])


def changed_tracks(tracks: EpisodeTracks, change: Change) -> EpisodeTracks:
    """An episode's tracks under controls changed in a known way: what a prediction under them should show is known as well.

    - ``mirrored``: each tool moves, from where it is at first, as if seen in a mirror: in the head camera's frame the
      displacement along x and the turns about y and z change their sign. A wrist camera stays mounted to its tool.
    - ``delayed``: each control comes DELAY_FRAMES later; the first one holds until then.

    Both leave the first frame as it is, so that they fit the same observed picture. They are poses, not joint positions: no
    joint limit is looked at, and models of native control vectors know no mirrored ones.

    Raises: DataError for a head view without a camera, in whose frame motion is mirrored.
    """
    if change == "delayed":
        return tracks.clip(np.maximum(np.arange(tracks.num_frames) - DELAY_FRAMES, 0))
    head = tracks.views.index(HEAD_VIEW)
    if tracks.camera_motion[head] == "absent":
        raise DataError(
            "Mirrored controls need the head camera", where=f"episode {tracks.episode_id}",
            expected="a calibrated head view", next_step="leave the episode out, or use delayed controls",
        )  # fmt: skip
    T_base_tool = tracks.T_base_tool.astype(np.float64)
    T_head_base = np.linalg.inv(tracks.T_base_camera[0, head].astype(np.float64))
    seen = T_head_base @ T_base_tool
    moved = seen.copy()
    moved[..., :3, 3] = seen[:1, :, :3, 3] + (seen[..., :3, 3] - seen[:1, :, :3, 3]) @ _MIRROR
    first = seen[:1, :, :3, :3]
    turn = seen[..., :3, :3] @ np.swapaxes(first, -1, -2)
    moved[..., :3, :3] = _MIRROR @ turn @ _MIRROR @ first
    T_base_moved = np.linalg.inv(T_head_base) @ moved
    cameras = tracks.T_base_camera.astype(np.float64).copy()
    for column, view in enumerate(tracks.views):
        arm = next((i for i, name in enumerate(tracks.arms) if view == f"{name}_wrist"), None)
        if arm is not None and tracks.camera_motion[column] not in ("static", "absent"):
            cameras[:, column] = T_base_moved[:, arm] @ np.linalg.inv(T_base_tool[:, arm]) @ cameras[:, column]
    projected = project_tools(
        torch.from_numpy(T_base_moved),
        torch.from_numpy(tracks.gripper[:, head].astype(np.float64)),
        torch.from_numpy(tracks.K.astype(np.float64)),
        torch.from_numpy(cameras),
        tracks.image_size,
    )
    arrays = {
        name: getattr(projected, name).numpy().astype(getattr(tracks, name).dtype)
        for name in ("uv", "depth", "rot6d", "gripper", "valid")
    }
    return replace(
        tracks,
        **arrays,
        T_base_tool=T_base_moved.astype(np.float32),
        T_base_camera=cameras.astype(np.float32),
        native=None,
    )
