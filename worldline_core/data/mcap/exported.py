"""Files that `writer` wrote, one episode each: a layout of the general reader that needs no declaration.

Which topics there are, and all that is said about the episode in words, stands in the metadata. What differs from the
recordings of others: a frame's messages are all of one time, so the instants are those of the states and nothing is
resampled; states and gripper openings are taken as they are; robot masks are images.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from worldline_core.data.episodes.episode import ARRAYS, CameraTrack, Episode, EpisodeDescription
from worldline_core.data.episodes.recorded_poses import RecordedCameras, rejected_as
from worldline_core.data.episodes.source import LoadedEpisode
from worldline_core.data.guards.plain_files import parse_json, well_formed
from worldline_core.data.guards.rejection import RejectedInputError, check_length
from worldline_core.data.mcap.cameras import add_camera
from worldline_core.data.mcap.file import McapFile, Stream, read_streams
from worldline_core.data.mcap.images import ImageTrack
from worldline_core.data.mcap.messages import IMAGE_KINDS, Kind, Transform
from worldline_core.data.mcap.writer import EPISODE_METADATA, FORMAT_VERSION, STATIC_TRANSFORMS
from worldline_core.data.video.frames import MadeFrames
from worldline_core.geometry.transforms import pose_from_quaternion_xyzw

READABLE_VERSIONS = (1, FORMAT_VERSION)
"""1 wrote joints as names and positions, in a schema of its own."""


def exported_episode_id(file: McapFile) -> str:
    """The episode id that a file states.

    Raises: RejectedInputError (unreadable) when the file is damaged or holds no episode of this project.
    """
    with well_formed(file.path, f"metadata {EPISODE_METADATA}"):
        return str(_metadata(file)["episode_id"])


def read_exported_episode(file: McapFile) -> LoadedEpisode:
    """One episode: png images exactly, times to 1 ns, K exactly, poses to 1e-12. Images stay in the file until asked for.

    Raises: RejectedInputError: unreadable, length_mismatch or missing_calibration where messages are missing.
    """
    file.check_sums()
    about = _metadata(file)
    with well_formed(file.path, "an episode as this project writes it"):
        return _assembled(file, about)


def _metadata(file: McapFile) -> dict[str, Any]:
    if EPISODE_METADATA not in file.metadata:
        raise RejectedInputError(
            "unreadable",
            "MCAP file holds no episode of a known layout",
            where=file.path,
            expected=f"a metadata record {EPISODE_METADATA}",
            got=", ".join(file.metadata) or "none",
        )
    where = f"{file.path}, {EPISODE_METADATA}"
    about = {key: parse_json(value, where) for key, value in file.metadata[EPISODE_METADATA].items()}
    if about.get("format_version") not in READABLE_VERSIONS:
        raise RejectedInputError(
            "unreadable",
            "MCAP episode has another version",
            where=file.path,
            expected=" or ".join(map(str, READABLE_VERSIONS)),
            got=about.get("format_version"),
        )
    return about


def _assembled(file: McapFile, about: Mapping[str, Any]) -> LoadedEpisode:
    views, moving = tuple(about["views"]), dict(about["cameras"])
    num_frames = int(about["num_frames"])
    video_frames = num_frames if about["video_frames"] is None else int(about["video_frames"])
    roles: dict[str, tuple[Kind, ...]] = {
        "/joint_states": ("joints",),
        "/joint_commands": ("joints",),
        **dict.fromkeys(("/tf", STATIC_TRANSFORMS), ("transforms",)),
        **dict.fromkeys((f"/{view}/calibration" for view in moving), ("calibration",)),
        **dict.fromkeys((f"/{view}/{kind}" for view in views for kind in ("image", "robot_mask")), IMAGE_KINDS),
    }
    streams = read_streams(file, roles)
    joints = {name: _all_of(streams, f"/joint_{name}s", num_frames, file) for name in ("state", "command")}
    images = {view: _all_of(streams, f"/{view}/image", video_frames, file) for view in views}
    masks = {view: _track(file, streams[topic]) for view in views if (topic := f"/{view}/robot_mask") in streams}
    poses: dict[str, list[Transform]] = {}
    for topic in ("/tf", STATIC_TRANSFORMS):
        for message in streams[topic].values if topic in streams else ():
            for transform in message:
                poses.setdefault(transform.child, []).append(transform)

    cameras = RecordedCameras()
    for view in moving:
        topic, frame = f"/{view}/calibration", f"{view}_camera"
        (calibration,) = _all_of(streams, topic, 1, file).values
        camera_poses = _poses(poses, frame, num_frames if moving[view] else 1, file)
        add_camera(cameras, view, calibration, camera_poses, where=file.path, frame=frame, topic=topic)
    tools = [_poses(poses, f"tool_{arm}", num_frames, file) for arm in range(int(about["num_arms"]))]
    state, action = (
        np.array([value.position for value in joints[name].values], dtype=ARRAYS["state"].dtype)
        for name in ("state", "command")
    )
    episode = Episode(
        **EpisodeDescription.arguments(about),
        state=state,
        action=action,
        timestamps=np.array(joints["state"].log_ns, dtype=np.float64) / 1e9,
        cameras=cameras.tracks,
        T_base_ee=np.stack(tools, axis=1) if tools else None,
        gripper=None if about["gripper"] is None else np.array(about["gripper"], dtype=ARRAYS["gripper"].dtype),
        video_frames=about["video_frames"],
    )
    tracks = {view: _track(file, images[view], cameras.tracks.get(view)) for view in views}

    def robot_masks(view: str) -> MadeFrames | None:
        if view not in masks:
            return None
        size = next(masks[view].frames()).shape[:2]
        count = len(masks[view].chosen)
        return MadeFrames(lambda: (image[..., 0] > 127 for image in masks[view].frames()), (count, *size), bool)

    return LoadedEpisode(episode, views, lambda view: tracks[view].frames(), robot_masks, cameras.lenses)


def _all_of(streams: Mapping[str, Stream], topic: str, count: int, file: McapFile) -> Stream:
    found = len(streams[topic].log_ns) if topic in streams else 0
    check_length("Messages", f"{file.path}, topic {topic}", states=max(count, 1), unit="messages", found=found)
    return streams[topic]


def _track(file: McapFile, stream: Stream, camera: CameraTrack | None = None) -> ImageTrack:
    every = np.arange(len(stream.log_ns))
    return ImageTrack(file, stream.topic, stream.kind, (None, None), every, every, camera=camera)


def _poses(found: Mapping[str, list[Transform]], child: str, count: int, file: McapFile) -> np.ndarray:
    transforms = found.get(child, [])
    if len(transforms) != count:
        raise RejectedInputError(
            "missing_calibration",
            "Transforms are missing",
            where=f"{file.path}, frame {child}",
            expected=count,
            got=len(transforms),
        )
    values = np.array([transform.values for transform in transforms], dtype=np.float64)
    with rejected_as("invalid_extrinsics", f"{file.path}, frame {child}", {"frame": child}):
        return pose_from_quaternion_xyzw(values[:, :3], values[:, 3:])
