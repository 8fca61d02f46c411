"""This project's own MCAP files: episodes and rollouts written for Foxglove and ROS 2 tools, and episodes read back.

All messages of a frame have one time, so nothing is resampled: `/<view>/image` CompressedImage (png is exact, jpeg is not),
`/<view>/calibration` CameraCalibration, `/tf` FrameTransform (cameras, tools; fixed cameras in ROS 2: `/tf_static`),
`/joint_states` and `/joint_commands` JointStates. Everything else is one metadata record. The same input gives the same bytes.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO, Literal

import cv2
import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import register_schema
from mcap_ros2.writer import Writer as Ros2Writer

from worldline_core.data.episodes.episode import ARRAYS, CameraTrack, Episode, EpisodeDescription
from worldline_core.data.episodes.recorded_poses import RecordedCameras, rejected_as
from worldline_core.data.episodes.source import LoadedEpisode
from worldline_core.data.guards.plain_files import expect_layout, parse_json
from worldline_core.data.guards.rejection import RejectedInputError, check_length
from worldline_core.data.mcap.file import ImageTrack, McapFile, Stream
from worldline_core.data.mcap.messages import IMAGE_KINDS, Kind
from worldline_core.data.mcap.resampling import add_camera
from worldline_core.data.video.frames import Frames, MadeFrames, in_step
from worldline_core.errors import DataError
from worldline_core.geometry.transforms import pose_from_quaternion_xyzw, quaternion_wxyz_from_rotation
from worldline_core.store.atomic import atomic_path

Encoding = Literal["protobuf", "ros2"]
Message = Mapping[str, Any]
EPISODE_METADATA = "worldline.episode"
FORMAT_VERSION = 3
STATIC_TRANSFORMS = "/tf_static"
_JPEG_QUALITY = 95


def write_episode_mcap(
    path: Path,
    episode: Episode,
    frames: Mapping[str, Frames],
    robot_masks: Mapping[str, Frames] | None = None,
    *,
    encoding: Encoding = "protobuf",
) -> None:
    """Writes one episode with its frames by view, uint8 (episode.num_video_frames, H, W, 3) RGB, exactly (png), and bool masks."""
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
                messages.add(topic, JointStates, {"joints": joints})
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
    encoding: Encoding = "protobuf",
) -> None:
    """Writes predicted videos, as JPEG of quality 95 (on average within 4 of 255).

    Args:
        frames_by_view: uint8 (N, H, W, 3) RGB by view, of one length.
        metadata: facts about the rollout (method, seed, checkpoint).
        cameras: calibration for the size of the images.
        T_base_ee: (N, A, 4, 4) commanded tool poses.
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
        messages = _Messages(stream, encoding)
        messages.writer.add_metadata(name, dict(metadata))
        yield messages
        messages.writer.finish()


class _Messages:
    """Writes messages of the time `time_ns`, given in the fields of Foxglove's schemas.

    `protobuf`: with the descriptors that Foxglove publishes; `ros2`: in CDR, as the equivalents of sensor_msgs and tf2_msgs.
    """

    def __init__(self, stream: BinaryIO, encoding: Encoding) -> None:
        self.time_ns = 0
        self.writer: Writer | Ros2Writer
        self._schemas: dict[type, Any] = {}
        self._channels: dict[str, int] = {}
        self._static_transforms = STATIC_TRANSFORMS if encoding == "ros2" else "/tf"
        if encoding == "ros2":
            self.writer = Ros2Writer(stream, compression=CompressionType.ZSTD)
        else:
            self.writer = Writer(stream, compression=CompressionType.ZSTD, enable_data_crcs=True)
            self.writer.start(profile="", library="worldline")

    def add(self, topic: str, schema: Any, message: Message) -> None:
        """Adds a message of one of Foxglove's classes."""
        writer, (seconds, nanoseconds) = self.writer, divmod(self.time_ns, 10**9)
        if isinstance(writer, Ros2Writer):
            name, converted = _ROS2[schema]
            if schema not in self._schemas:
                self._schemas[schema] = writer.register_msgdef(name.replace("/", "/msg/"), _definition(name))
            stamp = {"sec": seconds, "nanosec": nanoseconds}
            header = {"stamp": stamp, "frame_id": message.get("frame_id", message.get("parent_frame_id", ""))}
            writer.write_message(topic, self._schemas[schema], converted(message, header), self.time_ns)
            return
        if schema not in self._schemas:
            self._schemas[schema] = register_schema(writer, schema)
        if topic not in self._channels:
            self._channels[topic] = writer.register_channel(topic, "protobuf", self._schemas[schema])
        data = schema(timestamp={"seconds": seconds, "nanos": nanoseconds}, **message).SerializeToString()
        writer.add_message(self._channels[topic], self.time_ns, data, self.time_ns)

    def add_poses(self, index: int, cameras: Mapping[str, CameraTrack], T_base_ee: np.ndarray | None) -> None:
        """Calibrations and fixed cameras with the first frame; moving cameras and tools with every frame."""
        for view, camera in cameras.items():
            if index == 0:
                self.add(f"/{view}/calibration", CameraCalibration, _calibration(camera))
            if index == 0 or camera.moving:
                pose = camera.T_base_camera[index if camera.moving else 0]
                topic = "/tf" if camera.moving else self._static_transforms
                self.add(topic, FrameTransform, _transform(f"{view}_camera", pose))
        poses = () if T_base_ee is None else T_base_ee[index]
        for frame, pose in zip(_tool_frames(len(poses)), poses, strict=True):
            self.add("/tf", FrameTransform, _transform(frame, pose))

    def add_images(self, images: Mapping[tuple[str, str], np.ndarray], image_format: Literal["png", "jpeg"]) -> None:
        """By kind (image, robot_mask) and view."""
        jpeg = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
        settings = jpeg if image_format == "jpeg" else [cv2.IMWRITE_PNG_COMPRESSION, 6]
        for (kind, view), image in images.items():
            pixels = image.astype(np.uint8) * 255 if image.dtype == bool else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
            _, encoded = cv2.imencode(f".{image_format}", pixels, settings)
            message = {"frame_id": f"{view}_camera", "data": encoded.tobytes(), "format": image_format}
            self.add(f"/{view}/{kind}", CompressedImage, message)


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
    }
    return {key: json.dumps(value, sort_keys=True) for key, value in values.items()}


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


def _camera_info(message: Message, header: Message) -> Message:
    same = {name: message[name] for name in ("height", "width", "distortion_model")}
    matrices = {name.lower(): list(message[name]) for name in "DKRP"}
    return {"header": header, **same, **matrices, "binning_x": 0, "binning_y": 0, "roi": {}}


def _tf_message(message: Message, header: Message) -> Message:
    transform = {name: message[name] for name in ("translation", "rotation")}
    return {"transforms": [{"header": header, "child_frame_id": message["child_frame_id"], "transform": transform}]}


def _joint_state(message: Message, header: Message) -> Message:
    names, positions = ([joint[field] for joint in message["joints"]] for field in ("name", "position"))
    return {"header": header, "name": names, "position": positions, "velocity": [], "effort": []}


_ROS2: dict[type, tuple[str, Callable[[Message, Message], Message]]] = {
    CompressedImage: ("sensor_msgs/CompressedImage", lambda message, header: {"header": header, **message}),
    CameraCalibration: ("sensor_msgs/CameraInfo", _camera_info),
    FrameTransform: ("tf2_msgs/TFMessage", _tf_message),
    JointStates: ("sensor_msgs/JointState", _joint_state),
}
# Fields as ROS 2's common_interfaces and geometry2 define them, without their comments.
_ROS2_FIELDS = {
    "builtin_interfaces/Time": "int32 sec, uint32 nanosec",
    "std_msgs/Header": "builtin_interfaces/Time stamp, string frame_id",
    "geometry_msgs/Vector3": "float64 x, float64 y, float64 z",
    "geometry_msgs/Quaternion": "float64 x 0, float64 y 0, float64 z 0, float64 w 1",
    "geometry_msgs/Transform": "geometry_msgs/Vector3 translation, geometry_msgs/Quaternion rotation",
    "geometry_msgs/TransformStamped": "std_msgs/Header header, string child_frame_id, geometry_msgs/Transform transform",
    "sensor_msgs/RegionOfInterest": "uint32 x_offset, uint32 y_offset, uint32 height, uint32 width, bool do_rectify",
    "sensor_msgs/CompressedImage": "std_msgs/Header header, string format, uint8[] data",
    "sensor_msgs/CameraInfo": "std_msgs/Header header, uint32 height, uint32 width, string distortion_model, float64[] d, "
    "float64[9] k, float64[9] r, float64[12] p, uint32 binning_x, uint32 binning_y, sensor_msgs/RegionOfInterest roi",
    "sensor_msgs/JointState": "std_msgs/Header header, string[] name, float64[] position, float64[] velocity, float64[] effort",
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms",
}


def _definition(name: str) -> str:
    """Text of a message type: its own fields, then those of every type in them."""
    types = [name]
    for kind in types:  # grows
        inner = [field.split()[0].removesuffix("[]") for field in _ROS2_FIELDS[kind].split(", ")]
        types += [found for found in dict.fromkeys(inner) if found in _ROS2_FIELDS and found not in types]
    own, *others = (_ROS2_FIELDS[kind].replace(", ", "\n") for kind in types)
    return own + "".join(f"\n{'=' * 80}\nMSG: {kind}\n{text}" for kind, text in zip(types[1:], others, strict=True))


def exported_episode_id(file: McapFile) -> str:
    """The episode id in a file's metadata."""
    with expect_layout(file.path, f"metadata {EPISODE_METADATA}"):
        return str(_read_metadata(file)["episode_id"])


def read_exported_episode(file: McapFile) -> LoadedEpisode:
    """One episode: png images exactly, times to 1 ns, K exactly, poses to 1e-12. Images stay in the file until asked for.

    Raises: RejectedInputError: unreadable, length_mismatch or missing_calibration where messages are missing.
    """
    file.check_sums()
    about = _read_metadata(file)
    with expect_layout(file.path, "an episode as this project writes it"):
        return _assembled(file, about)


def _read_metadata(file: McapFile) -> dict[str, Any]:
    if EPISODE_METADATA not in file.metadata:
        what = f"MCAP file holds no episode of a known layout (metadata {EPISODE_METADATA})"
        raise RejectedInputError("unreadable", what, where=file.path, got=", ".join(file.metadata))
    where = f"{file.path}, {EPISODE_METADATA}"
    about = {key: parse_json(value, where) for key, value in file.metadata[EPISODE_METADATA].items()}
    if about.get("format_version") != FORMAT_VERSION:
        what, found = "MCAP episode has another version", about.get("format_version")
        raise RejectedInputError("unreadable", what, where=file.path, expected=FORMAT_VERSION, got=found)
    return about


def _assembled(file: McapFile, about: Mapping[str, Any]) -> LoadedEpisode:
    views, moving = tuple(about["views"]), dict(about["cameras"])
    num_frames = int(about["num_frames"])
    video_frames = num_frames if about["video_frames"] is None else int(about["video_frames"])
    roles: dict[str, tuple[Kind, ...]] = {
        **dict.fromkeys(("/joint_states", "/joint_commands"), ("joints",)),
        **dict.fromkeys(("/tf", STATIC_TRANSFORMS), ("transforms",)),
        **dict.fromkeys((f"/{view}/calibration" for view in moving), ("calibration",)),
        **dict.fromkeys((f"/{view}/{kind}" for view in views for kind in ("image", "robot_mask")), IMAGE_KINDS),
    }
    streams = file.streams(roles)

    def all_of(topic: str, count: int) -> Stream:
        found = len(streams[topic].log_ns) if topic in streams else 0
        check_length("Messages", f"{file.path}, topic {topic}", states=max(count, 1), unit="messages", found=found)
        return streams[topic]

    joints = [all_of(topic, num_frames) for topic in ("/joint_states", "/joint_commands")]
    masks = {view: _track(file, streams[topic]) for view in views if (topic := f"/{view}/robot_mask") in streams}
    poses: dict[str, list[tuple[float, ...]]] = {}
    for stream in (streams[topic] for topic in ("/tf", STATIC_TRANSFORMS) if topic in streams):
        for transform in chain.from_iterable(stream.values):
            poses.setdefault(transform.child, []).append(transform.values)

    cameras = RecordedCameras()
    for view in moving:
        topic = f"/{view}/calibration"
        (calibration,) = all_of(topic, 1).values
        camera_poses = _poses(poses, f"{view}_camera", num_frames if moving[view] else 1, file)
        add_camera(cameras, view, calibration, camera_poses, f"{file.path}, topic {topic}")
    tools = [_poses(poses, frame, num_frames, file) for frame in _tool_frames(int(about["num_arms"]))]
    state, action = (np.array([each.position for each in stream.values], ARRAYS["state"].dtype) for stream in joints)
    episode = Episode(
        **EpisodeDescription.arguments(about),
        state=state,
        action=action,
        timestamps=np.array(joints[0].log_ns, dtype=np.float64) / 1e9,
        cameras=cameras.tracks,
        T_base_ee=np.stack(tools, axis=1) if tools else None,
        gripper=None if about["gripper"] is None else np.array(about["gripper"], dtype=ARRAYS["gripper"].dtype),
        video_frames=about["video_frames"],
    )
    images = {view: all_of(f"/{view}/image", video_frames) for view in views}
    tracks = {view: _track(file, stream, cameras.tracks.get(view)) for view, stream in images.items()}

    def robot_masks(view: str) -> MadeFrames | None:
        if view not in masks:
            return None
        size = next(masks[view].frames()).shape[:2]
        count = len(masks[view].chosen)
        return MadeFrames(lambda: (image[..., 0] > 127 for image in masks[view].frames()), (count, *size), bool)

    return LoadedEpisode(episode, views, lambda view: tracks[view].frames(), robot_masks, cameras.lenses)


def _tool_frames(num_arms: int) -> tuple[str, ...]:
    """Names of the tools' frames in the order of the arms; a single arm is the right one."""
    return ("left_tool", "right_tool")[-num_arms:] if num_arms else ()


def _track(file: McapFile, stream: Stream, camera: CameraTrack | None = None) -> ImageTrack:
    every = np.arange(len(stream.log_ns))
    return ImageTrack(file, stream, every, every, camera=camera)


def _poses(found: Mapping[str, list[tuple[float, ...]]], child: str, count: int, file: McapFile) -> np.ndarray:
    where, values = f"{file.path}, frame {child}", np.array(found.get(child, []), np.float64)
    if len(values) != count:
        what = "Transforms are missing"
        raise RejectedInputError("missing_calibration", what, where=where, expected=count, got=len(values))
    with rejected_as("invalid_extrinsics", where, {"frame": child}):
        return pose_from_quaternion_xyzw(values[:, :3], values[:, 3:])
