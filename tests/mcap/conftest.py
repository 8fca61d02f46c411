"""A small ROS 2 robot whose every signal is a known function of time, recorded as MCAP by the public ROS 2 writer.

Image number n is a PNG whose pixels hold n, so a test can tell which image became which frame. Joints are sines, the
head camera hangs on a static transform, the wrist camera on a moving one, 0.1 m further along a static one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap_ros2.writer import Writer

from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.episodes.source import EpisodeSource, LoadedEpisode
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.sources.open import open_source

HEIGHT, WIDTH = 12, 16
START_NS = 1_700_000_000_000_000_000

FIELDS = {
    "builtin_interfaces/Time": "int32 sec, uint32 nanosec",
    "std_msgs/Header": "builtin_interfaces/Time stamp, string frame_id",
    "geometry_msgs/Vector3": "float64 x, float64 y, float64 z",
    "geometry_msgs/Point": "float64 x, float64 y, float64 z",
    "geometry_msgs/Quaternion": "float64 x 0, float64 y 0, float64 z 0, float64 w 1",
    "geometry_msgs/Transform": "geometry_msgs/Vector3 translation, geometry_msgs/Quaternion rotation",
    "geometry_msgs/TransformStamped": "std_msgs/Header header, string child_frame_id, geometry_msgs/Transform transform",
    "geometry_msgs/Pose": "geometry_msgs/Point position, geometry_msgs/Quaternion orientation",
    "geometry_msgs/PoseStamped": "std_msgs/Header header, geometry_msgs/Pose pose",
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "sensor_msgs/CompressedImage": "std_msgs/Header header, string format, uint8[] data",
    "sensor_msgs/Image": "std_msgs/Header header, uint32 height, uint32 width, string encoding, uint8 is_bigendian, "
    "uint32 step, uint8[] data",
    "sensor_msgs/RegionOfInterest": "uint32 x_offset, uint32 y_offset, uint32 height, uint32 width, bool do_rectify",
    "sensor_msgs/CameraInfo": "std_msgs/Header header, uint32 height, uint32 width, string distortion_model, float64[] d, "
    "float64[9] k, float64[9] r, float64[12] p, uint32 binning_x, uint32 binning_y, sensor_msgs/RegionOfInterest roi",
    "sensor_msgs/JointState": "std_msgs/Header header, string[] name, float64[] position, float64[] velocity, float64[] effort",
    "sensor_msgs/Imu": "std_msgs/Header header",
    "std_msgs/MultiArrayDimension": "string label, uint32 size, uint32 stride",
    "std_msgs/MultiArrayLayout": "std_msgs/MultiArrayDimension[] dim, uint32 data_offset",
    "std_msgs/Float64MultiArray": "std_msgs/MultiArrayLayout layout, float64[] data",
    "std_msgs/String": "string data",
}


def definition(schema: str) -> str:
    """A message definition with all types, some of which it does not need."""
    own = FIELDS[schema.replace("/msg/", "/")].replace(", ", "\n")
    return own + "".join(f"\n{'=' * 80}\nMSG: {name}\n" + text.replace(", ", "\n") for name, text in FIELDS.items())


def joints(time: np.ndarray | float) -> np.ndarray:
    """(..., 2) rad."""
    return np.stack([0.5 * np.sin(np.asarray(time)), 0.3 * np.cos(0.7 * np.asarray(time))], axis=-1)


def finger(time: np.ndarray | float) -> np.ndarray:
    """0.0 closed .. 0.04 m open."""
    return 0.02 + 0.02 * np.sin(0.5 * np.asarray(time))


def wrist(time: float) -> tuple[np.ndarray, np.ndarray]:
    """Position and quaternion xyzw of the wrist in base_link: turns about z, moves along x."""
    angle = 0.8 * time
    return np.array([0.3 + 0.05 * time, 0.1, 0.4]), np.array([0.0, 0.0, np.sin(angle / 2), np.cos(angle / 2)])


def picture(number: int) -> np.ndarray:
    """uint8 (HEIGHT, WIDTH, 3) RGB that holds a number."""
    image = np.empty((HEIGHT, WIDTH, 3), np.uint8)
    image[:] = (number % 256, number // 256, 77)
    return image


def number_of(frames: np.ndarray) -> np.ndarray:
    """Return the numbers that the pictures show."""
    return frames[:, 0, 0, 0].astype(int) + 256 * frames[:, 0, 0, 1].astype(int)


def png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1].tobytes()


def header(time_ns: int, frame: str = "") -> dict[str, Any]:
    return {"stamp": {"sec": time_ns // 10**9, "nanosec": time_ns % 10**9}, "frame_id": frame}


@dataclass(frozen=True)
class Sent:
    """One message: what it says, the time it states (None: none), and when the recorder wrote it."""

    topic: str
    schema: str
    message: dict[str, Any]
    time_ns: int | None
    log_ns: int


@dataclass
class Recording:
    """Messages in the order in which the file will hold them."""

    sent: list[Sent] = field(default_factory=list)

    def add(
        self, topic: str, schema: str, seconds: float, message: dict[str, Any], *, headed: bool = True, frame: str = "",
        delay_s: float = 0.002,
    ) -> None:  # fmt: skip
        time_ns = START_NS + round(seconds * 1e9)
        if headed:
            message = {"header": header(time_ns, frame), **message}
        self.sent.append(Sent(topic, schema, message, time_ns if headed else None, time_ns + round(delay_s * 1e9)))

    def transforms(self, seconds: float, *listed: dict[str, Any], topic: str = "/tf_static") -> None:
        self.add(topic, "tf2_msgs/msg/TFMessage", seconds, {"transforms": list(listed)}, headed=False)

    def rewrite(self, topic: str, number: slice | None = None, **values: Any) -> None:
        """Other values in all messages of a topic, or in some."""
        mine = [i for i, sent in enumerate(self.sent) if sent.topic == topic]
        for i in mine[number or slice(None)]:
            self.sent[i] = replace(self.sent[i], message={**self.sent[i].message, **values})

    def change(self, topic: str, change: Callable[[list[Sent]], Iterable[Sent]]) -> None:
        """Replace the messages of a topic, in place of the first of them."""
        mine = [sent for sent in self.sent if sent.topic == topic]
        first = self.sent.index(mine[0])
        self.sent = [sent for sent in self.sent if sent.topic != topic]
        self.sent[first:first] = list(change(mine))

    def in_log_order(self) -> Recording:
        return Recording(sorted(self.sent, key=lambda sent: sent.log_ns))

    def write(self, path: Path, **options: Any) -> Path:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("wb") as stream:
            writer = Writer(stream, **{"chunk_size": 4096, **options})
            schemas = {}
            for number, sent in enumerate(self.sent):
                if sent.schema not in schemas:
                    schemas[sent.schema] = writer.register_msgdef(sent.schema, definition(sent.schema))
                writer.write_message(sent.topic, schemas[sent.schema], sent.message, sent.log_ns, sent.log_ns, number)
            writer.finish()
        return path


def shifted(sent: Sent, seconds: float, at_ns: int | None = None) -> Sent:
    """The message with another header time; the log time stays."""
    assert sent.time_ns is not None
    time_ns = (sent.time_ns if at_ns is None else at_ns) + round(seconds * 1e9)
    stamped = header(time_ns, sent.message["header"]["frame_id"])
    return replace(sent, message={**sent.message, "header": stamped}, time_ns=time_ns)


def transform(parent: str, child: str, seconds: float, place: Any, quaternion: Any) -> dict[str, Any]:
    return {
        "header": header(START_NS + round(seconds * 1e9), parent),
        "child_frame_id": child,
        "transform": {
            "translation": dict(zip("xyz", map(float, place), strict=True)),
            "rotation": dict(zip("xyzw", map(float, quaternion), strict=True)),
        },
    }


def camera_info(**changes: Any) -> dict[str, Any]:
    K = [20.0, 0.0, 7.5, 0.0, 21.0, 5.5, 0.0, 0.0, 1.0]
    roi = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False}
    return {
        "height": HEIGHT, "width": WIDTH, "distortion_model": "plumb_bob", "d": [0.0] * 5, "k": K, "r": np.eye(3).reshape(-1).tolist(),
        "p": [*K[:3], 0.0, *K[3:6], 0.0, *K[6:], 0.0], "binning_x": 0, "binning_y": 0, "roi": roi, **changes,
    }  # fmt: skip


def robot(seconds: float = 3.0, *, camera_fps: float = 30.0, jitter_s: float = 0.0, seed: int = 0) -> Recording:
    """A recording of the robot: two cameras, joints at 100 Hz, commands at 50 Hz, transforms at 50 Hz."""
    rng = np.random.default_rng(seed)
    recording = Recording()
    recording.transforms(
        0.0,
        transform("base_link", "head_optical_frame", 0.0, [1.0, 0.0, 1.0], [1.0, 0.0, 0.0, 0.0]),
        transform("wrist", "wrist_optical_frame", 0.0, [0.0, 0.0, 0.1], [0.0, 0.0, 0.0, 1.0]),
    )
    for view in ("head", "wrist"):
        frame, topic = f"{view}_optical_frame", f"/{view}/image/compressed"
        recording.add(f"/{view}/camera_info", "sensor_msgs/msg/CameraInfo", 0.0, camera_info(), frame=frame)
        for number in range(int(seconds * camera_fps)):
            time = number / camera_fps + rng.uniform(-jitter_s, jitter_s)
            message = {"format": "png", "data": png(picture(number))}
            recording.add(topic, "sensor_msgs/msg/CompressedImage", time, message, frame=frame, delay_s=0.02)
    for number in range(int(seconds * 100)):
        time = number / 100 + rng.uniform(-jitter_s, jitter_s)
        position = [float(finger(time)), *joints(time)[::-1].tolist()]
        message = {"name": ["finger", "b", "a"], "position": position, "velocity": [], "effort": []}
        recording.add("/joint_states", "sensor_msgs/msg/JointState", time, message)
    for number in range(int(seconds * 50)):
        time = number / 50
        values = [*(joints(time) + 0.01).tolist(), float(finger(time))]
        command = {"layout": {"dim": [], "data_offset": 0}, "data": values}
        recording.add("/command", "std_msgs/msg/Float64MultiArray", time, command, headed=False)
        moving = time + rng.uniform(-jitter_s, jitter_s)
        recording.transforms(moving, transform("base_link", "wrist", moving, *wrist(moving)), topic="/tf")
    return recording.in_log_order()


def declared(path: Path, **changes: Any) -> dict[str, Any]:
    """The source's configuration for `robot`."""
    opening = {"closed": 0.0, "open": 0.04}
    state = {
        "joints": {"topic": "/joint_states", "names": ["a", "b"]},
        "gripper": {"topic": "/joint_states", "names": ["finger"], "range": opening},
    }
    command = {
        "joints": {"topic": "/command", "columns": [0, 1]},
        "gripper": {"topic": "/command", "columns": [2], "range": opening},
    }
    return {
        "kind": "mcap_topics", "path": str(path), "name": "toy", "embodiment": "none", "fps": 30,
        "views": {
            "head": {"image": "/head/image/compressed", "calibration": "/head/camera_info"},
            "right_wrist": {"image": "/wrist/image/compressed", "calibration": "/wrist/camera_info"},
        },
        "arms": [{"name": "right", "state": state, "command": command}], **changes,
    }  # fmt: skip


def source(declared: dict[str, Any]) -> EpisodeSource:
    config = CurateConfig.model_validate({"sources": [declared]}).sources[0]
    return open_source(config, config.path)


def load(declared: dict[str, Any], episode: str = "toy-a") -> LoadedEpisode:
    return source(declared).load(episode)


def rejection(declared: dict[str, Any], episode: str = "toy-a") -> RejectedInputError:
    """Why an episode, or one of its views, is refused."""
    with pytest.raises(RejectedInputError, match=r"\S") as caught:
        loaded = load(declared, episode)
        for view in loaded.views:
            loaded.frames(view)
    return caught.value
