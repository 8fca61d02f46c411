"""Read back the MCAP files that `mcap_io` writes."""

from __future__ import annotations

import base64
import binascii
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader

from worldline_core.data.episodes.episode import CameraTrack, Episode
from worldline_core.data.episodes.recorded_poses import camera_pose, rejected_as
from worldline_core.data.guards.images import decode_image
from worldline_core.data.guards.limits import regular_file
from worldline_core.data.guards.plain_files import parse_json, well_formed
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.guards.source_paths import local_file
from worldline_core.data.mcap.chunks import DAMAGE, check_chunks
from worldline_core.data.mcap.io import EPISODE_METADATA, READABLE_VERSIONS
from worldline_core.geometry.distortion import Distortion, distortion_from_ros
from worldline_core.geometry.transforms import pose_from_quaternion_wxyz

_TEXTS = (
    "episode_id",
    "source",
    "embodiment",
    "scene",
    "task_family",
    "instruction",
    "outcome",
    "split",
    "primary_view",
    "state_kind",
)


@dataclass(frozen=True)
class McapEpisode:
    """An episode with its images (uint8 RGB), robot masks (bool) and lenses by view; a pinhole has no lens entry."""

    episode: Episode
    frames: dict[str, np.ndarray]
    robot_masks: dict[str, np.ndarray]
    distortions: dict[str, Distortion]


def read_episode_id(path: Path) -> str:
    """The episode id that a file states.

    Raises: DataError when the file is damaged or holds no episode of this project.
    """
    with well_formed(path, f"metadata {EPISODE_METADATA}"):
        return str(_metadata(path)["episode_id"])


def _metadata(path: Path) -> dict[str, Any]:
    file = regular_file(path, "MCAP file")
    check_chunks(file, path)
    try:
        with file.open("rb") as stream:
            found = {record.name: record.metadata for record in make_reader(stream).iter_metadata()}
    except (*DAMAGE, OSError) as error:
        raise RejectedInputError("unreadable", "MCAP file is damaged", where=path, got=repr(error)) from error
    if EPISODE_METADATA not in found:
        raise RejectedInputError(
            "unreadable",
            "MCAP file holds no episode of a known layout",
            where=path,
            expected=f"a metadata record {EPISODE_METADATA}",
            got=", ".join(found) or "none",
        )
    values = {key: parse_json(value, f"{path}, {EPISODE_METADATA}") for key, value in found[EPISODE_METADATA].items()}
    if values.get("format_version") not in READABLE_VERSIONS:
        raise RejectedInputError(
            "unreadable",
            "MCAP episode has another version",
            where=path,
            expected=" or ".join(map(str, READABLE_VERSIONS)),
            got=values.get("format_version"),
        )
    return values


def read_episode_mcap(path: Path) -> McapEpisode:
    """Read one episode: png images exactly, times to 1 ns, K exactly, poses to 1e-12.

    Raises: DataError when the file is damaged, or messages are missing.
    """
    about = _metadata(path)
    messages: dict[str, list[tuple[int, dict[str, Any]]]] = {}
    try:
        with local_file(path).open("rb") as stream:
            for _, channel, message in make_reader(stream).iter_messages():
                content = parse_json(message.data, f"{path}, topic {channel.topic}")
                messages.setdefault(channel.topic, []).append((message.log_time, content))
    except (*DAMAGE, OSError) as error:
        raise RejectedInputError("unreadable", "MCAP file is damaged", where=path, got=repr(error)) from error
    with well_formed(path, "an episode as mcap_io writes it"):
        return _assembled(about, messages, path)


def _assembled(about: dict[str, Any], messages: dict[str, list[tuple[int, dict[str, Any]]]], path: Path) -> McapEpisode:
    for name in _TEXTS:
        if not isinstance(about[name], str):
            raise TypeError(f"{name} is no text")
    num_frames = int(about["num_frames"])
    states = _take(messages, "/joint_states", num_frames, path)
    commands = _take(messages, "/joint_commands", num_frames, path)
    times = np.array([time for time, _ in states], dtype=np.float64) / 1e9
    video_frames = num_frames if about["video_frames"] is None else int(about["video_frames"])
    frames = {
        view: np.stack([_decode(m, path) for _, m in _take(messages, f"/{view}/image", video_frames, path)])
        for view in about["views"]
    }
    masks = {
        view: np.stack([_decode(m, path)[..., 0] > 127 for _, m in messages[f"/{view}/robot_mask"]])
        for view in about["views"]
        if f"/{view}/robot_mask" in messages
    }
    transforms: dict[str, list[dict[str, Any]]] = {}
    for _, message in messages.get("/tf", []):
        transforms.setdefault(message["child_frame_id"], []).append(message)
    cameras: dict[str, CameraTrack] = {}
    distortions: dict[str, Distortion] = {}
    for view, moving in about["cameras"].items():
        cameras[view], lens = _camera(view, bool(moving), messages, transforms, num_frames, path)
        if lens is not None:
            distortions[view] = lens
    tools = [_poses(transforms, f"tool_{arm}", num_frames, path) for arm in range(int(about["num_arms"]))]
    episode = Episode(
        episode_id=about["episode_id"],
        source=about["source"],
        embodiment=about["embodiment"],
        scene=about["scene"],
        task_family=about["task_family"],
        instruction=about["instruction"],
        outcome=about["outcome"],
        split=about["split"],
        fps=float(about["fps"]),
        state=np.array([_positions(m) for _, m in states], dtype=np.float32),
        action=np.array([_positions(m) for _, m in commands], dtype=np.float32),
        timestamps=times,
        cameras=cameras,
        bank=about["bank"],
        candidate=about["candidate"],
        T_base_ee=np.stack(tools, axis=1) if tools else None,
        gripper=None if about["gripper"] is None else np.array(about["gripper"], dtype=np.float64),
        primary_view=about["primary_view"],
        state_names=None if about["state_names"] is None else tuple(about["state_names"]),
        state_kind=about["state_kind"],
        video_frames=about["video_frames"],
        conventions=about["conventions"],
    )
    return McapEpisode(episode, frames, masks, distortions)


def _positions(message: dict[str, Any]) -> list[float]:
    """Of foxglove.JointStates, or of version 1's list of positions."""
    return [joint["position"] for joint in message["joints"]] if "joints" in message else message["position"]


def _take(
    messages: dict[str, list[tuple[int, dict[str, Any]]]], topic: str, count: int, path: Path
) -> list[tuple[int, dict[str, Any]]]:
    found = messages.get(topic, [])
    if len(found) != count:
        raise RejectedInputError(
            "length_mismatch",
            "Messages are missing",
            where=f"{path}, topic {topic}",
            expected=f"{count} messages",
            got=f"{len(found)} messages",
            evidence={"topic": topic, "expected": count, "found": len(found)},
        )
    return found


def _decode(message: dict[str, Any], path: Path) -> np.ndarray:
    try:
        raw = base64.b64decode(message["data"], validate=True)
    except (binascii.Error, KeyError, TypeError, ValueError) as error:
        raise RejectedInputError("unreadable", "Image message is damaged", where=path, got=repr(error)) from error
    return decode_image(raw, path)


def _poses(transforms: dict[str, list[dict[str, Any]]], child: str, count: int, path: Path) -> np.ndarray:
    found = transforms.get(child, [])
    if len(found) != count:
        raise RejectedInputError(
            "missing_calibration",
            "Transforms are missing",
            where=f"{path}, frame {child}",
            expected=count,
            got=len(found),
            evidence={"frame": child, "expected": count, "found": len(found)},
        )
    position = np.array([[m["translation"][axis] for axis in "xyz"] for m in found], dtype=np.float64)
    quaternion = np.array([[m["rotation"][axis] for axis in "wxyz"] for m in found], dtype=np.float64)
    with rejected_as("invalid_extrinsics", f"{path}, frame {child}", {"frame": child}):
        return pose_from_quaternion_wxyz(position, quaternion)


def _camera(
    view: str,
    moving: bool,
    messages: dict[str, list[tuple[int, dict[str, Any]]]],
    transforms: dict[str, list[dict[str, Any]]],
    num_frames: int,
    path: Path,
) -> tuple[CameraTrack, Distortion | None]:
    _, calibration = _take(messages, f"/{view}/calibration", 1, path)[0]
    poses = _poses(transforms, f"{view}_camera", num_frames if moving else 1, path)
    K = np.array(calibration["K"], dtype=np.float64).reshape(3, 3)
    model, coefficients = str(calibration.get("distortion_model", "")), calibration.get("D", [])
    where = f"{path}, topic /{view}/calibration"
    with rejected_as("invalid_distortion", where, {"view": view, "model": model, "coefficients": coefficients}):
        lens = distortion_from_ros(model, coefficients, None)
    pose = camera_pose(view, poses, extrinsics="camera_to_base", axes="opencv", where=where)
    width, height = int(calibration["width"]), int(calibration["height"])
    return CameraTrack.from_pose(view, K, pose, width=width, height=height), lens
