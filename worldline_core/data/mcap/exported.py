"""Episodes and rollouts as MCAP files that Foxglove opens, and the reading of such an episode.

Messages are in Foxglove's schemas (JSON or protobuf) or those of ROS 2 (CDR), all of a frame stamped with the frame's time
in nanoseconds: `/<view>/image` CompressedImage (png is exact, jpeg is not), `/<view>/calibration` CameraCalibration, `/tf`
FrameTransform (cameras, tools), `/joint_states` and `/joint_commands` JointStates. In ROS 2 fixed cameras are in
`/tf_static`. Everything else about an episode is one metadata record. The same input gives the same bytes.

Read, it is a layout of the general reader that needs no declaration: the metadata say which topics there are. What differs
from the recordings of others: a frame's messages are all of one time, so the instants are those of the states and nothing is
resampled; states and gripper openings are taken as they are; robot masks are images.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from worldline_core.data.episodes.episode import ARRAYS, CameraTrack, Episode, EpisodeDescription
from worldline_core.data.episodes.recorded_poses import RecordedCameras, rejected_as
from worldline_core.data.episodes.source import LoadedEpisode
from worldline_core.data.guards.plain_files import expect_layout, parse_json
from worldline_core.data.guards.rejection import RejectedInputError, check_length
from worldline_core.data.mcap.cameras import add_camera
from worldline_core.data.mcap.encodings import Encoding, FoxgloveSchema, MessageFile, message_file
from worldline_core.data.mcap.file import McapFile, Stream, read_streams
from worldline_core.data.mcap.images import ImageTrack
from worldline_core.data.mcap.messages import IMAGE_KINDS, Kind, Transform
from worldline_core.data.video.frames import Frames, MadeFrames, in_step
from worldline_core.errors import DataError
from worldline_core.geometry.rotations import quaternion_wxyz_from_rotation
from worldline_core.geometry.transforms import pose_from_quaternion_xyzw
from worldline_core.store.atomic import atomic_path

ImageFormat = Literal["png", "jpeg"]
EPISODE_METADATA = "worldline.episode"
FORMAT_VERSION = 2
READABLE_VERSIONS = (1, FORMAT_VERSION)
"""1 wrote joints as names and positions, in a schema of its own."""
STATIC_TRANSFORMS = "/tf_static"
_JPEG_QUALITY = 95


def write_episode_mcap(
    path: Path,
    episode: Episode,
    frames: Mapping[str, Frames],
    robot_masks: Mapping[str, Frames] | None = None,
    *,
    encoding: Encoding = "json",
) -> None:
    """Write one episode; images are exact (png).

    Args:
        frames: by view, uint8 (episode.num_video_frames, H, W, 3) RGB.
        robot_masks: by view, bool (N, H, W).

    Raises: RejectedInputError (length_mismatch) when frames and states differ in number.
    """
    streams = {("image", view): images for view, images in frames.items()}
    streams |= {("robot_mask", view): masks for view, masks in (robot_masks or {}).items()}
    for (kind, view), images in streams.items():
        where = f"{path}, {kind} of {view}"
        check_length("Images", where, states=episode.num_video_frames, unit="frames", found=len(images))
    pictures = in_step(streams)
    names = list(episode.state_names or (f"state_{i}" for i in range(episode.state.shape[1])))
    with _new_file(path, EPISODE_METADATA, _metadata(episode, list(frames)), encoding) as messages:
        for index, time in enumerate(episode.timestamps):
            messages.time_ns = round(float(time) * 1e9)
            for topic, values in (("/joint_states", episode.state), ("/joint_commands", episode.action)):
                joints = [{"name": n, "position": v} for n, v in zip(names, values[index].tolist(), strict=True)]
                messages.add(topic, "JointStates", {"joints": joints})
            messages.add_poses(index, episode.cameras, episode.T_base_ee)
            messages.add_images(next(pictures, {}), "png")


def write_rollout_mcap(
    path: Path,
    frames_by_view: Mapping[str, Frames],
    fps: float,
    *,
    metadata: Mapping[str, str] | None = None,
    cameras: Mapping[str, CameraTrack] | None = None,
    T_base_ee: np.ndarray | None = None,
    encoding: Encoding = "json",
) -> None:
    """Write predicted videos, as JPEG of quality 95 (on average within 4 of 255).

    Args:
        frames_by_view: uint8 (N, H, W, 3) RGB by view.
        metadata: what to remember about the rollout (method, seed, checkpoint).
        cameras: calibration to show along with the images; their size must be that of the images.
        T_base_ee: (N, A, 4, 4) commanded tool poses.

    Raises: DataError when the views differ in length or there are none.
    """
    lengths = {view: len(images) for view, images in frames_by_view.items()}
    if len(set(lengths.values())) != 1:
        raise DataError("Views of a rollout differ in length", where=str(path), expected="one length", got=lengths)
    record = {"fps": json.dumps(fps), "views": json.dumps(list(frames_by_view)), **(metadata or {})}
    with _new_file(path, "worldline.rollout", record, encoding) as messages:
        streams = {("image", view): images for view, images in frames_by_view.items()}
        for index, pictures in enumerate(in_step(streams)):
            messages.time_ns = round(float(index / fps) * 1e9)
            messages.add_poses(index, cameras or {}, T_base_ee)
            messages.add_images(pictures, "jpeg")


@contextmanager
def _new_file(path: Path, name: str, metadata: Mapping[str, str], encoding: Encoding) -> Iterator[_Messages]:
    """A file with a metadata record, which appears when its messages are complete."""
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        file = message_file(stream, encoding)
        file.add_metadata(name, metadata)
        yield _Messages(file, static_transforms=STATIC_TRANSFORMS if encoding == "ros2" else "/tf")
        file.finish()


class _Messages:
    """Writes messages of the time `time_ns`; ROS 2 has a topic of its own for transforms that stay."""

    def __init__(self, file: MessageFile, static_transforms: str) -> None:
        self.time_ns = 0
        self._file = file
        self._static_transforms = static_transforms
        self._sequence: dict[str, int] = {}

    def add(self, topic: str, schema: FoxgloveSchema, message: Mapping[str, Any]) -> None:
        sequence = self._sequence.get(topic, 0)
        self._sequence[topic] = sequence + 1
        self._file.write(topic, schema, message, self.time_ns, sequence)

    def add_poses(self, index: int, cameras: Mapping[str, CameraTrack], T_base_ee: np.ndarray | None) -> None:
        """Calibrations and fixed cameras with the first frame; moving cameras and tools with every frame."""
        for view, camera in cameras.items():
            if index == 0:
                self.add(f"/{view}/calibration", "CameraCalibration", _calibration(camera))
            if index == 0 or camera.moving:
                pose = camera.T_base_camera[index if camera.moving else 0]
                topic = "/tf" if camera.moving else self._static_transforms
                self.add(topic, "FrameTransform", _transform(f"{view}_camera", pose))
        for arm, pose in enumerate(T_base_ee[index] if T_base_ee is not None else ()):
            self.add("/tf", "FrameTransform", _transform(f"tool_{arm}", pose))

    def add_images(self, images: Mapping[tuple[str, str], np.ndarray], image_format: ImageFormat) -> None:
        """By kind (image, robot_mask) and view."""
        for (kind, view), image in images.items():
            self.add(f"/{view}/{kind}", "CompressedImage", _image(image, f"{view}_camera", image_format))


def _metadata(episode: Episode, views: list[str]) -> dict[str, str]:
    values = {
        "format_version": FORMAT_VERSION,
        **episode.described(),
        "views": views,
        "cameras": {view: bool(camera.moving) for view, camera in episode.cameras.items()},
        "num_frames": episode.num_frames,
        "video_frames": episode.video_frames,
        "num_arms": 0 if episode.T_base_ee is None else int(episode.T_base_ee.shape[1]),
        "gripper": None if episode.gripper is None else np.asarray(episode.gripper, np.float64).tolist(),
        "image_format": "png",
    }
    return {key: json.dumps(value, sort_keys=True) for key, value in values.items()}


def _image(frame: np.ndarray, frame_id: str, image_format: ImageFormat) -> dict[str, Any]:
    pixels = frame.astype(np.uint8) * 255 if frame.dtype == bool else cv2.cvtColor(frame, cv2.COLOR_RGB2BGR)
    settings = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY] if image_format == "jpeg" else [cv2.IMWRITE_PNG_COMPRESSION, 6]
    done, encoded = cv2.imencode(f".{image_format}", pixels, settings)
    if not done:
        raise DataError("Image cannot be compressed", where=frame_id, expected=image_format, got=str(frame.shape))
    return {"frame_id": frame_id, "data": encoded.tobytes(), "format": image_format}


def _calibration(camera: CameraTrack) -> dict[str, Any]:
    K = camera.K.reshape(-1).tolist()
    return {
        "frame_id": f"{camera.view}_camera",
        "width": camera.width,
        "height": camera.height,
        "distortion_model": "plumb_bob",
        "D": [0.0] * 5,
        "K": K,
        "R": np.eye(3).reshape(-1).tolist(),
        "P": [*K[0:3], 0.0, *K[3:6], 0.0, *K[6:9], 0.0],
    }


def _transform(child: str, pose: np.ndarray) -> dict[str, Any]:
    w, x, y, z = (float(value) for value in quaternion_wxyz_from_rotation(pose[:3, :3]))
    return {
        "parent_frame_id": "base",
        "child_frame_id": child,
        "translation": dict(zip("xyz", (float(v) for v in pose[:3, 3]), strict=True)),
        "rotation": {"x": x, "y": y, "z": z, "w": w},
    }


def exported_episode_id(file: McapFile) -> str:
    """The episode id that a file states.

    Raises: RejectedInputError (unreadable) when the file is damaged or holds no episode of this project.
    """
    with expect_layout(file.path, f"metadata {EPISODE_METADATA}"):
        return str(_stated(file)["episode_id"])


def read_exported_episode(file: McapFile) -> LoadedEpisode:
    """One episode: png images exactly, times to 1 ns, K exactly, poses to 1e-12. Images stay in the file until asked for.

    Raises: RejectedInputError: unreadable, length_mismatch or missing_calibration where messages are missing.
    """
    file.check_sums()
    about = _stated(file)
    with expect_layout(file.path, "an episode as this project writes it"):
        return _assembled(file, about)


def _stated(file: McapFile) -> dict[str, Any]:
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
