"""Episodes and rollouts as MCAP files that Foxglove opens.

Messages are JSON in Foxglove's schemas, one instant a frame, stamped with the frame's time in nanoseconds:
`/<view>/image` CompressedImage (png is exact, jpeg is not), `/<view>/calibration` CameraCalibration, `/tf` FrameTransform
(cameras, tools), `/joint_states` and `/joint_commands` JointStates. Everything else about an episode is one
metadata record. The same input gives the same bytes.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from mcap.writer import CompressionType, Writer

from worldline_core.data.episodes.episode import CameraTrack, Episode
from worldline_core.data.mcap.schemas import SCHEMAS
from worldline_core.errors import DataError
from worldline_core.geometry.distortion import Distortion
from worldline_core.geometry.rotations import quaternion_wxyz_from_rotation
from worldline_core.store.atomic import atomic_path

ImageFormat = Literal["png", "jpeg"]
EPISODE_METADATA = "worldline.episode"
FORMAT_VERSION = 2
READABLE_VERSIONS = (1, 2)
"""1 wrote joints as names and positions, in a schema of its own."""
_JPEG_QUALITY = 95


class _Recorder:
    """Registers channels on first use and writes JSON messages."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._sequence: dict[str, int] = {}

    def add(self, topic: str, schema: str, time_ns: int, message: Mapping[str, Any]) -> None:
        if schema not in self._schemas:
            text = json.dumps(SCHEMAS[schema], sort_keys=True).encode()
            self._schemas[schema] = self._writer.register_schema(schema, "jsonschema", text)
        if topic not in self._channels:
            self._channels[topic] = self._writer.register_channel(topic, "json", self._schemas[schema])
        sequence = self._sequence.get(topic, 0)
        self._sequence[topic] = sequence + 1
        data = json.dumps(message, separators=(",", ":"), allow_nan=False).encode()
        self._writer.add_message(self._channels[topic], time_ns, data, time_ns, sequence)


def nanoseconds(seconds: float) -> int:
    """A time as whole nanoseconds."""
    return round(float(seconds) * 1e9)


def _stamp(time_ns: int) -> dict[str, int]:
    return {"sec": time_ns // 10**9, "nsec": time_ns % 10**9}


def _image(frame: np.ndarray, frame_id: str, time_ns: int, image_format: ImageFormat) -> dict[str, Any]:
    if frame.dtype == bool:
        pixels, image_format = frame.astype(np.uint8) * 255, "png"
    else:
        pixels = cv2.cvtColor(frame, cv2.COLOR_RGB2BGR)
    settings = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY] if image_format == "jpeg" else [cv2.IMWRITE_PNG_COMPRESSION, 6]
    done, encoded = cv2.imencode(".jpg" if image_format == "jpeg" else ".png", pixels, settings)
    if not done:
        raise DataError("Image cannot be compressed", where=frame_id, expected=image_format, got=str(frame.shape))
    data = base64.b64encode(encoded.tobytes()).decode()
    return {"timestamp": _stamp(time_ns), "frame_id": frame_id, "data": data, "format": image_format}


_MODEL_NAMES = {"radtan": "plumb_bob", "fisheye": "kannala_brandt"}


def _calibration(camera: CameraTrack, time_ns: int, distortion: Distortion | None = None) -> dict[str, Any]:
    """Foxglove's CameraCalibration; a lens with more than five radtan coefficients is a rational_polynomial."""
    model, coefficients = "plumb_bob", (0.0,) * 5
    if distortion is not None:
        coefficients = distortion.coefficients
        model = "rational_polynomial" if len(coefficients) > 5 else _MODEL_NAMES[distortion.model]
    K = camera.K.reshape(-1).tolist()
    return {
        "timestamp": _stamp(time_ns),
        "frame_id": f"{camera.view}_camera",
        "width": camera.width,
        "height": camera.height,
        "distortion_model": model,
        "D": list(coefficients),
        "K": K,
        "R": np.eye(3).reshape(-1).tolist(),
        "P": [*K[0:3], 0.0, *K[3:6], 0.0, *K[6:9], 0.0],
    }


def _transform(parent: str, child: str, pose: np.ndarray, time_ns: int) -> dict[str, Any]:
    w, x, y, z = (float(value) for value in quaternion_wxyz_from_rotation(pose[:3, :3]))
    return {
        "timestamp": _stamp(time_ns),
        "parent_frame_id": parent,
        "child_frame_id": child,
        "translation": dict(zip("xyz", (float(v) for v in pose[:3, 3]), strict=True)),
        "rotation": {"x": x, "y": y, "z": z, "w": w},
    }


def _describe(episode: Episode, views: list[str], image_format: str) -> dict[str, str]:
    values = {
        "format_version": FORMAT_VERSION,
        "episode_id": episode.episode_id,
        "source": episode.source,
        "embodiment": episode.embodiment,
        "scene": episode.scene,
        "task_family": episode.task_family,
        "instruction": episode.instruction,
        "outcome": episode.outcome,
        "split": episode.split,
        "fps": episode.fps,
        "bank": episode.bank,
        "candidate": episode.candidate,
        "primary_view": episode.primary_view,
        "state_names": None if episode.state_names is None else list(episode.state_names),
        "state_kind": episode.state_kind,
        "conventions": dict(episode.conventions),
        "views": views,
        "cameras": {view: bool(camera.moving) for view, camera in episode.cameras.items()},
        "num_frames": episode.num_frames,
        "video_frames": episode.video_frames,
        "num_arms": 0 if episode.T_base_ee is None else int(episode.T_base_ee.shape[1]),
        "gripper": None if episode.gripper is None else np.asarray(episode.gripper, np.float64).tolist(),
        "image_format": image_format,
    }
    return {key: json.dumps(value, sort_keys=True) for key, value in values.items()}


def write_episode_mcap(
    path: Path,
    episode: Episode,
    frames: Mapping[str, np.ndarray],
    *,
    image_format: ImageFormat = "png",
    robot_masks: Mapping[str, np.ndarray] | None = None,
    distortions: Mapping[str, Distortion] | None = None,
) -> None:
    """Write one episode.

    Args:
        frames: by view, uint8 (episode.num_video_frames, H, W, 3) RGB.
        image_format: png keeps pixels exactly; jpeg (quality 95) is smaller and keeps them on average within 4 of 255.
        robot_masks: by view, bool (N, H, W), always exact.
        distortions: lenses by view, where frames and K are those of a distorting lens.

    Raises: DataError when frames and states differ in number.
    """
    for view, images in frames.items():
        if len(images) != episode.num_video_frames:
            raise DataError(
                "Images and states differ in number",
                where=f"{path}, view {view}",
                expected=episode.num_video_frames,
                got=len(images),
            )
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD)
        writer.start(profile="", library="worldline")
        writer.add_metadata(EPISODE_METADATA, _describe(episode, list(frames), image_format))
        recorder = _Recorder(writer)
        joint_names = list(episode.state_names or (f"state_{i}" for i in range(episode.state.shape[1])))
        for index, time in enumerate(episode.timestamps):
            time_ns = nanoseconds(time)
            for topic, values in (("/joint_states", episode.state), ("/joint_commands", episode.action)):
                joints = [{"name": n, "position": v} for n, v in zip(joint_names, values[index].tolist(), strict=True)]
                recorder.add(topic, "foxglove.JointStates", time_ns, {"timestamp": _stamp(time_ns), "joints": joints})
            for view, camera in episode.cameras.items():
                if index == 0:
                    message = _calibration(camera, time_ns, (distortions or {}).get(view))
                    recorder.add(f"/{view}/calibration", "foxglove.CameraCalibration", time_ns, message)
                if index == 0 or camera.moving:
                    pose = camera.T_base_camera[index if camera.moving else 0]
                    message = _transform("base", f"{view}_camera", pose, time_ns)
                    recorder.add("/tf", "foxglove.FrameTransform", time_ns, message)
            if episode.T_base_ee is not None:
                for arm in range(episode.T_base_ee.shape[1]):
                    message = _transform("base", f"tool_{arm}", episode.T_base_ee[index, arm], time_ns)
                    recorder.add("/tf", "foxglove.FrameTransform", time_ns, message)
            if index < episode.num_video_frames:
                _add_images(recorder, frames, robot_masks or {}, index, time_ns, image_format)
        writer.finish()


def _add_images(
    recorder: _Recorder,
    frames: Mapping[str, np.ndarray],
    robot_masks: Mapping[str, np.ndarray],
    index: int,
    time_ns: int,
    image_format: ImageFormat,
) -> None:
    for kind, images in (("image", frames), ("robot_mask", robot_masks)):
        for view, stack in images.items():
            message = _image(stack[index], f"{view}_camera", time_ns, image_format)
            recorder.add(f"/{view}/{kind}", "foxglove.CompressedImage", time_ns, message)


def write_rollout_mcap(
    path: Path,
    frames_by_view: Mapping[str, np.ndarray],
    fps: float,
    *,
    metadata: Mapping[str, str] | None = None,
    cameras: Mapping[str, CameraTrack] | None = None,
    T_base_ee: np.ndarray | None = None,
    image_format: ImageFormat = "jpeg",
) -> None:
    """Write predicted videos.

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
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD)
        writer.start(profile="", library="worldline")
        record = {"fps": json.dumps(fps), "views": json.dumps(list(frames_by_view)), **(metadata or {})}
        writer.add_metadata("worldline.rollout", record)
        recorder = _Recorder(writer)
        for index in range(next(iter(lengths.values()))):
            time_ns = nanoseconds(index / fps)
            for view, camera in (cameras or {}).items():
                if index == 0:
                    recorder.add(
                        f"/{view}/calibration", "foxglove.CameraCalibration", time_ns, _calibration(camera, time_ns)
                    )
                if index == 0 or camera.moving:
                    pose = camera.T_base_camera[index if camera.moving else 0]
                    recorder.add(
                        "/tf", "foxglove.FrameTransform", time_ns, _transform("base", f"{view}_camera", pose, time_ns)
                    )
            if T_base_ee is not None:
                for arm, pose in enumerate(T_base_ee[index]):
                    recorder.add(
                        "/tf", "foxglove.FrameTransform", time_ns, _transform("base", f"tool_{arm}", pose, time_ns)
                    )
            _add_images(recorder, frames_by_view, {}, index, time_ns, image_format)
        writer.finish()
