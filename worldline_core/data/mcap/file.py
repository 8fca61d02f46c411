"""One MCAP file: its topics, the messages of chosen topics, and their images (https://mcap.dev/spec)."""

from __future__ import annotations

import re
import struct
import zlib
from collections import deque
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import chain
from typing import Any, cast

import av
import av.error
import cv2
import numpy as np
import zstandard
from av.video.codeccontext import VideoCodecContext
from mcap.exceptions import McapError
from mcap.reader import FOOTER_SIZE, McapReader, NonSeekingReader, SeekingReader
from mcap.records import Channel, Footer, Schema
from mcap.records import Message as Record
from mcap.stream_reader import MAGIC_SIZE, StreamReader
from mcap.summary import Summary

from worldline_core.data.episodes.episode import CameraTrack
from worldline_core.data.guards.plain_files import UPRIGHT, decode_image, turned_view
from worldline_core.data.guards.rejection import (
    MAX_CHUNK_BYTES,
    RejectedInputError,
    check_image_size,
    depth_picture,
    unreadable,
)
from worldline_core.data.guards.source_paths import AnyPath, regular_file
from worldline_core.data.mcap.messages import IMAGE_KINDS, VIDEO_CODECS, EncodedImage, Kind, RawImage, decode
from worldline_core.data.video.clip import Picture

# What the library raises for a damaged file: its own errors, and those of the decompressors and parsers below it.
_DAMAGE = (
    McapError, zstandard.ZstdError, EOFError, OSError, ValueError, RuntimeError, LookupError, struct.error, OverflowError,
)  # fmt: skip
_PNG = b"\x89PNG"
# ROS and Foxglove name -> bytes per pixel, and OpenCV's conversion to RGB.
_ENCODINGS: dict[str, tuple[int, int | None]] = {
    "rgb8": (3, None),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "mono8": (1, cv2.COLOR_GRAY2RGB),
}

_DEPTH = re.compile(r"(?i)16[us]c1|32[fs]c1|compresseddepth|^z16|\bdepth")
"""ROS' names of depth, as a pixel encoding or in a compressed image's format ("16UC1; compressedDepth png")."""


@dataclass
class Stream:
    """Messages of one topic in the order of the file.

    Attributes:
        stamps_ns: times in the messages' headers; None where the schema has none.
        log_ns: times at which the recorder wrote them.
        values: decoded contents; empty for images, whose coordinate frame is `frame`.
        key_frames: messages of a video with which decoding can begin.
    """

    topic: str
    kind: Kind
    stamps_ns: list[int | None] = field(default_factory=list)
    log_ns: list[int] = field(default_factory=list)
    values: list[Any] = field(default_factory=list)
    key_frames: list[bool] = field(default_factory=list)
    frame: str = ""


class McapFile:
    """Read access to one file, which is open only while it is read.

    Every method raises RejectedInputError: missing_file, special_file, unreadable (damaged, not finished), out_of_memory.
    """

    def __init__(self, path: AnyPath) -> None:
        self.path = path
        _ = self._summary

    @cached_property
    def _summary(self) -> Summary | None:
        """None for a complete file without a summary, which is then read from its beginning."""
        with _reading(self.path), regular_file(self.path, "MCAP file").open("rb") as stream:
            begins = stream.read(16)
            for magic, (got, next_step) in _OTHER_FORMATS.items():
                if begins.startswith(magic):
                    what = "Recording is in another format"
                    raise RejectedInputError(
                        "unreadable", what, where=self.path, expected="MCAP", got=got, next_step=next_step
                    )
            stream.seek(0)
            summary = SeekingReader(stream, record_size_limit=MAX_CHUNK_BYTES).get_summary()
            chunks = [] if summary is None else [index.chunk_start_offset for index in summary.chunk_indexes]
            if len(set(chunks)) < len(chunks):
                raise ValueError("an index that leads to one chunk twice")
            return summary

    def check_sums(self) -> None:
        """Compares the whole file with the checksums of its data and its summary (0: none)."""
        path = regular_file(self.path, "MCAP file")
        with _reading(self.path), path.open("rb") as stream:
            reader = StreamReader(stream, emit_chunks=True, validate_crcs=True, record_size_limit=MAX_CHUNK_BYTES)
            footer = cast("Footer", deque(reader.records, maxlen=1)[0])  # with which the records end
            end = path.stat().st_size - MAGIC_SIZE
            stream.seek(footer.summary_start or end - FOOTER_SIZE)
            if footer.summary_crc not in (0, zlib.crc32(stream.read(end - 4 - stream.tell()))):
                raise ValueError("a summary that does not fit its checksum")

    @cached_property
    def metadata(self) -> dict[str, dict[str, str]]:
        """Metadata records by name; the last one where a name is repeated."""
        with self._reader() as reader:
            return {record.name: record.metadata for record in reader.iter_metadata()}

    @cached_property
    def topics(self) -> dict[str, str]:
        """Topic -> schema name of everything in the file."""
        if self._summary is None or not self._summary.channels:
            found = {channel.topic: schema.name if schema else "" for schema, channel, _ in self._records(None)}
            return dict(sorted(found.items()))
        schemas = {number: schema.name for number, schema in self._summary.schemas.items()}
        return {channel.topic: schemas.get(channel.schema_id, "") for channel in self._summary.channels.values()}

    @property
    def first_log_ns(self) -> int:
        """Log time of the first message; a file without messages is rejected (missing_topic)."""
        statistics = self._summary.statistics if self._summary is not None else None
        if statistics is None:
            first = min((record.log_time for _, _, record in self._records(None)), default=None)
        else:
            first = statistics.message_start_time if statistics.message_count else None
        if first is None:
            raise RejectedInputError("missing_topic", "MCAP file holds no messages", where=self.path)
        return first

    def lacks_topics(self, missing: Collection[str]) -> RejectedInputError:
        got = ", ".join(f"{topic} ({schema})" for topic, schema in self.topics.items()) or "no topics"
        return RejectedInputError(
            "missing_topic", "MCAP file lacks a topic", where=self.path, expected=", ".join(sorted(missing)), got=got,
            next_step="correct the topics in curate.sources[]",
        )  # fmt: skip

    def messages(
        self, topics: Collection[str], start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[tuple[str, Kind, int, int | None, Any]]:
        """(topic, kind, log time, header time or None, content) of these topics' messages with start <= log time < stop.

        Every message of a video is a picture: parameter sets in a message of their own are put before the next one.
        """
        held: dict[str, list[bytes]] = {}
        for schema, channel, record in self._records(topics, start_ns, stop_ns):
            where = f"{self.path}, topic {channel.topic}"
            kind, stamp_ns, value = decode(channel, schema, record.data, where)
            if kind == "video":
                value.check_video(where)
                sets = held.setdefault(channel.topic, [])
                if value.picture is None:
                    sets += value.parameter_sets()
                    continue
                value = replace(value, data=b"".join([*sets, value.data]))
                sets.clear()
            yield channel.topic, kind, record.log_time, stamp_ns, value

    def streams(
        self, roles: Mapping[str, tuple[Kind, ...]], start_ns: int | None = None, stop_ns: int | None = None
    ) -> dict[str, Stream]:
        """Messages with start <= log time < stop by topic, for the topics of `roles` (topic -> accepted kinds).

        Raises: RejectedInputError (unknown_schema) for a topic with messages of another kind, or of several.
        """
        streams: dict[str, Stream] = {}
        for topic, kind, log_ns, stamp_ns, value in self.messages(roles, start_ns, stop_ns):
            expected = (streams[topic].kind,) if topic in streams else roles[topic]
            if kind not in expected:
                what = "Topic has messages of another kind than its role or its first message"
                where, got = f"{self.path}, topic {topic}", f"{kind} ({self.topics.get(topic, '')})"
                raise RejectedInputError("unknown_schema", what, where=where, expected=" or ".join(expected), got=got)
            stream = streams.setdefault(topic, Stream(topic, kind))
            stream.log_ns.append(log_ns)
            stream.stamps_ns.append(stamp_ns)
            if kind not in IMAGE_KINDS:
                stream.values.append(value)
                continue
            stream.frame = stream.frame or value.frame
            if kind == "video":
                stream.key_frames.append(value.picture == "key")
        return streams

    def _records(
        self, topics: Collection[str] | None, start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[tuple[Schema | None, Channel, Record]]:
        with self._reader() as reader:
            read = partial(
                reader.iter_messages, topics, log_time_order=False, starting_at=start_ns, ending_before=stop_ns
            )
            summary = reader.get_summary() if isinstance(reader, SeekingReader) else None
            if summary is None:
                yield from read()
                return
            # Chunk by chunk: in the order of the file the reader unpacks all of them before it gives the first
            # message, in the order of log times all that overlap.
            for chunk in summary.chunk_indexes:
                summary.chunk_indexes = [chunk]
                yield from read()

    @contextmanager
    def _reader(self) -> Iterator[McapReader]:
        """A reader of the open file, by its index where the summary has one."""
        summary = self._summary
        indexed = summary is not None and summary.chunk_indexes and summary.channels
        with _reading(self.path), regular_file(self.path, "MCAP file").open("rb") as stream:
            kind = SeekingReader if indexed else NonSeekingReader
            yield kind(stream, validate_crcs=True, record_size_limit=MAX_CHUNK_BYTES)


class SplitMcap(McapFile):
    """The parts of one recording, read one after the other as one file; `path` is their folder.

    Raises: RejectedInputError as `McapFile`, for any part.
    """

    def __init__(self, folder: AnyPath, parts: Sequence[AnyPath]) -> None:
        self.path = folder
        self.parts = [McapFile(part) for part in parts]  # each with its own summary

    @cached_property
    def topics(self) -> dict[str, str]:
        return {topic: schema for part in self.parts for topic, schema in part.topics.items()}

    @property
    def first_log_ns(self) -> int:
        return self.parts[0].first_log_ns

    def _records(
        self, topics: Collection[str] | None, start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[tuple[Schema | None, Channel, Record]]:
        for part in self.parts:
            yield from part._records(topics, start_ns, stop_ns)


_reading = partial(
    unreadable,
    "MCAP file is damaged or was not finished",
    faults=_DAMAGE,
    next_step="copy the file again, or try `mcap recover`",
)
_OTHER_FORMATS = {
    b"\x28\xb5\x2f\xfd": ("packed as a whole by zstd", "unpack it: zstd -d FILE"),
    b"\x1f\x8b": ("packed as a whole by gzip", "unpack it: gunzip FILE"),
    b"SQLite format 3\0": ("a bag of ROS 2 in SQLite", "convert it: mcap convert FILE.db3 FILE.mcap"),
    b"#ROSBAG V": ("a bag of ROS 1", "convert it: rosbags-convert --src FILE.bag --dst FOLDER --dst-storage mcap"),
}
"""First bytes of what is often recorded for MCAP: what it is, and how it becomes MCAP."""


@dataclass(frozen=True)
class ImageTrack:
    """Frames of a view as images of a topic, read in order of time and decoded only when an instant needs them.

    Attributes:
        order: (n,) index in the stream of the i-th message in time.
        chosen: (t,) index in time of each frame's image; ascending, an image may repeat.
        around_ns: log times between which the stream was read; None: the file's beginning or end.
        camera: the images must have its size; None: any size.
    """

    file: McapFile
    stream: Stream
    order: np.ndarray
    chosen: np.ndarray
    around_ns: tuple[int | None, int | None] = (None, None)
    camera: CameraTrack | None = None

    @property
    def key_frames(self) -> np.ndarray:
        """(n,) bool: frames of a video, in order of time, with which decoding can begin."""
        return np.array(self.stream.key_frames, bool)[self.order]

    @property
    def log_ns(self) -> np.ndarray:
        """(n,) log times in order of time: of a video with B-frames in another order, that of decoding."""
        return np.array(self.stream.log_ns, np.int64)[self.order]

    @property
    def where(self) -> str:
        return f"{self.file.path}, topic {self.stream.topic}"

    def frames(self) -> Iterator[np.ndarray]:
        """uint8 (H, W, 3) RGB of each frame, in order; any fault is a RejectedInputError."""
        where = self.where
        decoded = self._video() if self.stream.kind == "video" else self._images()
        number, image = next(decoded)
        shape, camera = image.shape, self.camera
        if camera is not None and shape[:2] != (camera.height, camera.width):
            what, where = "Calibration belongs to another image size", f"{where}, view {camera.view}"
            expected, got = f"{shape[1]}x{shape[0]}", f"{camera.width}x{camera.height}"
            raise RejectedInputError("missing_calibration", what, where=where, expected=expected, got=got)
        for wanted in self.chosen:
            while number < wanted:
                number, image = next(decoded)
            if image.shape != shape:
                what = "Images of a topic differ in size"
                raise RejectedInputError("unreadable", what, where=where, expected=shape[:2], got=image.shape[:2])
            yield image

    def _images(self) -> Iterator[tuple[int, np.ndarray]]:
        numbers = np.unique(self.chosen)
        for number, value in zip(numbers.tolist(), self._messages(self.order[numbers]), strict=True):
            place = f"{self.where}, image {number}"
            if isinstance(value, RawImage):
                yield number, _raw_pixels(value, place)
                continue
            if _DEPTH.search(value.format) or value.data[12:16] == _PNG:  # ROS' compressedDepth puts 12 bytes before it
                raise depth_picture(place, repr(value.format))
            yield number, decode_image(value.data, place, calibrated=self.camera is not None)

    def _video(self) -> Iterator[tuple[int, np.ndarray]]:
        """Frames from the last key frame before the first chosen one on, in order of time; none may be missing.

        Messages are decoded in the order in which they were logged, and each picture has the number of its message.
        """
        keys = np.flatnonzero(self.key_frames[: self.chosen[0] + 1])
        if not len(keys):
            what = "No key frame comes before the first frame of the episode"
            raise RejectedInputError("truncated_video", what, where=self.where, next_step="begin the episode later")
        first, last = int(keys[-1]), int(self.chosen[-1])
        logged = np.lexsort((self.order, self.log_ns))
        place = np.argsort(logged)
        expected, previous = first, -1
        for number, image in self._decoded(logged[place[first] : place[first : last + 1].max() + 1]):
            if number <= previous:
                raise RejectedInputError(
                    "clock_skew", "Pictures of a video come in another order than their times", where=self.where,
                    expected="times of presentation in the headers of a video with B-frames",
                    got=f"frame {number} is shown after frame {previous}",
                    next_step="set time: header; or encode the video without B-frames",
                )  # fmt: skip
            previous = number
            # Others lean on an earlier key frame, are shown after the last, or come after one that is lost.
            if number == expected <= last:
                expected += 1
                yield number, image
        if expected <= last:
            what, where = "Video frames are missing or damaged", f"{self.where}, frame {expected}"
            raise RejectedInputError("truncated_video", what, where=where, next_step="cut the recording at the damage")

    def _decoded(self, numbers: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
        """(number, RGB) of these messages, each one frame in Annex B, in the order in which they are shown; up to a damaged one."""
        messages = self._messages(self.order[numbers])
        first: EncodedImage = next(messages)
        decoder = cast("VideoCodecContext", VideoCodecContext.create(VIDEO_CODECS[first.format], "r"))
        decoder.thread_type = "NONE"
        sets = b"" if first.parameter_sets() else self._parameter_sets(int(self.log_ns[numbers[0]]))

        def shown() -> Iterator[av.VideoFrame]:
            for place, (number, image) in enumerate(zip(numbers.tolist(), chain([first], messages), strict=True)):
                packet = av.Packet(image.data if place else sets + image.data)
                packet.pts, packet.dts = number, place
                yield from decoder.decode(packet)
            yield from decoder.decode(None)

        try:
            for frame in shown():
                check_image_size(frame.width, frame.height, self.where)
                if frame.is_corrupt or frame.pts is None:
                    return
                picture = Picture(frame, self.where)
                if self.camera is not None and picture.orientation != UPRIGHT:
                    raise turned_view(self.where, picture.orientation)
                yield frame.pts, picture.rgb
        except av.error.FFmpegError as error:
            what = "Video cannot be decoded"
            raise RejectedInputError("truncated_video", what, where=self.where, got=str(error)) from error

    def _parameter_sets(self, log_ns: int) -> bytes:
        """Those of the file up to a log time, the last ones last."""
        found: dict[bytes, None] = {}
        for *_, value in self.file.messages([self.stream.topic], None, log_ns + 1):
            for unit in value.parameter_sets():
                found.pop(unit, None)
                found[unit] = None
        return b"".join(found)

    def _messages(self, wanted: np.ndarray) -> Iterator[Any]:
        """Contents of the messages with these indices in the file, in this order."""
        indices = wanted.tolist()
        waiting: dict[int, Any] = {}
        needed, done = set(indices), 0
        for message, (*_, value) in enumerate(self.file.messages([self.stream.topic], *self.around_ns)):
            if message in needed:
                waiting[message] = value
            while done < len(indices) and indices[done] in waiting:
                yield waiting.pop(indices[done])
                done += 1
            if done == len(indices):
                return
        what = "File holds fewer images than when it was first read"
        raise RejectedInputError("changed_while_reading", what, where=self.where, expected=len(indices), got=done)


def frames_after_loss(times_ns: np.ndarray, step_ns: float, key_frames: np.ndarray, log_ns: np.ndarray) -> np.ndarray:
    """(n,) bool: video frames between a gap of more than 1.5 steps and the next key frame.

    After a lost message a decoder returns wrong pictures, without an error, until the next key frame. B-frames before the
    gap may depend on it too: as many as a picture is logged before its turn.
    """
    lost = np.concatenate([[False], np.diff(times_ns) > 1.5 * step_ns])
    early = int((np.arange(len(lost)) - np.argsort(np.argsort(log_ns, kind="stable"))).max())
    for gap in np.flatnonzero(lost):
        lost[max(gap - early, 0) : gap] = True
    last_loss = np.maximum.accumulate(np.where(lost, np.arange(len(lost)), -1))
    last_key = np.maximum.accumulate(np.where(key_frames, np.arange(len(lost)), -1))
    return last_loss > last_key


def _raw_pixels(image: RawImage, where: str) -> np.ndarray:
    if _DEPTH.search(image.encoding):
        raise depth_picture(where, image.encoding)
    if image.encoding not in _ENCODINGS:
        what, expected = "Pixel encoding is not supported", ", ".join(_ENCODINGS)
        raise RejectedInputError("unreadable", what, where=where, expected=expected, got=image.encoding)
    channels, conversion = _ENCODINGS[image.encoding]
    check_image_size(image.width, image.height, where)
    if image.step < image.width * channels or len(image.data) != image.step * image.height:
        what = "Image has another number of bytes than its size"
        expected = f"{image.height} rows of {image.step} bytes, at least {image.width * channels} each"
        raise RejectedInputError("unreadable", what, where=where, expected=expected, got=f"{len(image.data)} bytes")
    rows = np.frombuffer(image.data, np.uint8).reshape(image.height, image.step)
    pixels = rows[:, : image.width * channels].reshape(image.height, image.width, channels)
    return np.ascontiguousarray(pixels) if conversion is None else cv2.cvtColor(pixels, conversion)
