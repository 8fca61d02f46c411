"""Images of a topic: read from the file in order of time, each decoded only when an instant needs it.

Memory holds one decoded image and those that are out of order in the file, never a whole episode.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, cast

import av
import av.error
import cv2
import numpy as np
from av.video.codeccontext import VideoCodecContext

from worldline_core.data.episodes.episode import CameraTrack
from worldline_core.data.guards.plain_files import decode_image
from worldline_core.data.guards.rejection import RejectedInputError, check_image_size
from worldline_core.data.mcap.file import McapFile
from worldline_core.data.mcap.messages import EncodedImage, Kind, RawImage

_CODECS = {"h264": "h264", "h265": "hevc"}
# ROS and Foxglove name -> bytes per pixel, and OpenCV's conversion to RGB.
_ENCODINGS: dict[str, tuple[int, int | None]] = {
    "rgb8": (3, None),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "mono8": (1, cv2.COLOR_GRAY2RGB),
}


@dataclass(frozen=True)
class ImageTrack:
    """Frames of a view as images of a topic.

    Attributes:
        around_ns: log times between which the topic's messages were counted; None: the file's beginning or end.
        order: (n,) index in the file of the i-th message in time.
        chosen: (t,) index in time of each frame's image; ascending, an image may repeat.
        key_frames: of a video, (n,) in order of time, whether decoding can begin there.
        camera: the images must have its calibrated size; None: any size.
    """

    file: McapFile
    topic: str
    kind: Kind
    around_ns: tuple[int | None, int | None]
    order: np.ndarray
    chosen: np.ndarray
    key_frames: np.ndarray | None = None
    camera: CameraTrack | None = None

    def frames(self) -> Iterator[np.ndarray]:
        """uint8 (H, W, 3) RGB of each frame, in order.

        Raises: RejectedInputError: unreadable, truncated_video, too_large; missing_calibration when the images are not of
            the size that is calibrated.
        """
        where = f"{self.file.path}, topic {self.topic}"
        decoded = self._video(where) if self.kind == "video" else self._images(where)
        number, image = next(decoded)
        shape = image.shape
        if self.camera is not None and shape[:2] != (self.camera.height, self.camera.width):
            raise RejectedInputError(
                "missing_calibration",
                "Calibration belongs to another image size",
                where=f"{where}, view {self.camera.view}",
                expected=f"{shape[1]}x{shape[0]}",
                got=f"{self.camera.width}x{self.camera.height}",
            )
        for wanted in self.chosen:
            while number < wanted:
                number, image = next(decoded)
            if image.shape != shape:
                raise RejectedInputError(
                    "unreadable",
                    "Images of a topic differ in size",
                    where=where,
                    expected=f"{shape[1]}x{shape[0]}",
                    got=f"{image.shape[1]}x{image.shape[0]}",
                )
            yield image

    def _images(self, where: str) -> Iterator[tuple[int, np.ndarray]]:
        for number, value in self._in_time(np.unique(self.chosen)):
            place = f"{where}, image {number}"
            yield number, _raw_pixels(value, place) if isinstance(value, RawImage) else decode_image(value.data, place)

    def _video(self, where: str) -> Iterator[tuple[int, np.ndarray]]:
        """Frames from the last key frame before the first chosen one on."""
        keys = np.flatnonzero([] if self.key_frames is None else self.key_frames[: self.chosen[0] + 1])
        if not len(keys):
            raise RejectedInputError(
                "truncated_video",
                "No key frame comes before the first frame of the episode",
                where=where,
                expected=f"a key frame up to image {self.chosen[0]}",
                next_step="begin the episode later",
            )
        numbers = np.arange(keys[-1], self.chosen[-1] + 1)
        expected = iter(numbers)
        for number, image in _decoded(self._in_time(numbers), where):
            if number != next(expected, None):
                raise _lost_frame(where, number)
            yield number, image
        if next(expected, None) is not None:
            raise _lost_frame(where, None)

    def _in_time(self, numbers: np.ndarray) -> Iterator[tuple[int, Any]]:
        """(index in time, content) of the messages with these indices, ascending."""
        place = {int(message): number for number, message in enumerate(self.order)}
        waiting: dict[int, Any] = {}
        wanted = [int(number) for number in numbers]
        needed, done = set(wanted), 0
        for message, (*_, value) in enumerate(self.file.messages([self.topic], *self.around_ns)):
            number = place.get(message, -1)
            if number in needed:
                waiting[number] = value
            while done < len(wanted) and wanted[done] in waiting:
                yield wanted[done], waiting.pop(wanted[done])
                done += 1
            if done == len(wanted):
                return
        raise RejectedInputError(
            "changed_while_reading",
            "File holds fewer images than when it was first read",
            where=f"{self.file.path}, topic {self.topic}",
            expected=len(wanted),
            got=done,
        )


def frames_after_loss(times_ns: np.ndarray, step_ns: float, key_frames: np.ndarray) -> np.ndarray:
    """(n,) bool: video frames between a gap of more than 1.5 steps and the next key frame.

    After a lost message a decoder returns wrong pictures, without an error, until the next key frame; so the loss is detected
    by the times of the messages.
    """
    lost = np.concatenate([[False], np.diff(times_ns) > 1.5 * step_ns])
    last_loss = np.maximum.accumulate(np.where(lost, np.arange(len(lost)), -1))
    last_key = np.maximum.accumulate(np.where(key_frames, np.arange(len(lost)), -1))
    return last_loss > last_key


def _decoded(messages: Iterator[tuple[int, EncodedImage]], where: str) -> Iterator[tuple[int, np.ndarray]]:
    """(index in time, RGB) of video messages, each one frame in Annex B.

    Raises: RejectedInputError: unknown_schema for another codec, truncated_video for data that does not decode.
    """
    decoder: VideoCodecContext | None = None
    try:
        for number, image in messages:
            if decoder is None:
                if image.format not in _CODECS:
                    raise RejectedInputError(
                        "unknown_schema",
                        "Video codec is not supported",
                        where=where,
                        expected=" or ".join(_CODECS),
                        got=repr(image.format),
                    )
                decoder = cast("VideoCodecContext", VideoCodecContext.create(_CODECS[image.format], "r"))
                decoder.thread_type = "NONE"
            packet = av.Packet(image.data)
            packet.pts = packet.dts = number
            for frame in decoder.decode(packet):
                yield _picture(frame, where)
        for frame in decoder.decode(None) if decoder is not None else ():
            yield _picture(frame, where)
    except av.error.FFmpegError as error:
        raise RejectedInputError("truncated_video", "Video cannot be decoded", where=where, got=str(error)) from error


def _picture(frame: av.VideoFrame, where: str) -> tuple[int, np.ndarray]:
    check_image_size(frame.width, frame.height, where)
    if frame.is_corrupt or frame.pts is None:
        raise _lost_frame(where, frame.pts)
    return int(frame.pts), frame.to_ndarray(format="rgb24")


def _lost_frame(where: str, number: int | None) -> RejectedInputError:
    return RejectedInputError(
        "truncated_video",
        "Video frames are missing or damaged",
        where=where if number is None else f"{where}, frame {number}",
        expected="one frame per message, each decodable from those before it",
        next_step="cut the recording at the damage",
    )


def _raw_pixels(image: RawImage, where: str) -> np.ndarray:
    if image.encoding not in _ENCODINGS:
        raise RejectedInputError(
            "unreadable",
            "Pixel encoding is not supported",
            where=where,
            expected=", ".join(_ENCODINGS),
            got=repr(image.encoding),
        )
    channels, conversion = _ENCODINGS[image.encoding]
    check_image_size(image.width, image.height, where)
    if image.step < image.width * channels or len(image.data) != image.step * image.height:
        raise RejectedInputError(
            "unreadable",
            "Image has another number of bytes than its size",
            where=where,
            expected=f"{image.height} rows of {image.step} bytes, at least {image.width * channels} each",
            got=f"{len(image.data)} bytes",
        )
    rows = np.frombuffer(image.data, np.uint8).reshape(image.height, image.step)
    pixels = rows[:, : image.width * channels].reshape(image.height, image.width, channels)
    return np.ascontiguousarray(pixels) if conversion is None else cv2.cvtColor(pixels, conversion)
