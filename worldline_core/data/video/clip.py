"""The encoded video of one view of an episode: its place, what its file says, and its pictures: all, or exact ones.

A picture keeps the decoder's frame, shown in the colours that its stream states and turned as its file asks: grey values cost
nothing, colours are converted only when they are asked for. Matrix and range are those of the frame (FFmpeg takes them from the
stream, or else from the container). A stream that states no matrix has BT.709's from 720 lines on and BT.601's below; one that
states no range has the limited one.
"""

from __future__ import annotations

import math
import struct
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import av
import av.error
import numpy as np
from av.container import InputContainer
from av.video.frame import VideoFrame
from av.video.reformatter import ColorRange, Interpolation, VideoReformatter
from av.video.stream import VideoStream

from worldline_core.data.guards.plain_files import QUARTER_TURNS, UPRIGHT, orientation_of, turned_view, upright
from worldline_core.data.guards.rejection import (
    MAX_PIXELS,
    RejectedInputError,
    check_image_size,
    depth_picture,
    too_large,
)
from worldline_core.data.guards.source_paths import AnyPath, local_file, regular_file
from worldline_core.errors import DataError
from worldline_core.store.store import disk_full

_LUMA_FIRST = frozenset(
    ("yuv420p", "yuvj420p", "yuv422p", "yuvj422p", "yuv444p", "yuvj444p", "nv12", "nv21", "gray", "yuv440p", "yuvj440p")
)
_FULL_RANGE = frozenset(("yuvj420p", "yuvj422p", "yuvj444p", "yuvj440p"))
# ITU-T H.273, table 4: the matrices that libswscale knows by the same numbers.
_BT709, _BT601 = 1, 6
_MATRICES = {_BT709: "BT.709", 4: "FCC", 5: "BT.601", _BT601: "BT.601", 7: "SMPTE 240M", 9: "BT.2020", 10: "BT.2020"}
_UNSPECIFIED = 2
_HD_LINES = 720


class Picture:
    """One decoded frame.

    Args:
        where: the file or topic that it comes from, for errors.
        reformatter: shared by frames of one size and format, since setting one up costs as much as a small frame.
    """

    def __init__(self, frame: VideoFrame, where: object, reformatter: VideoReformatter | None = None) -> None:
        self._frame = frame
        self._where = where
        self._reformatter = reformatter

    @cached_property
    def orientation(self) -> int:
        """Turn by which the frame is shown, as EXIF counts (1: as it is)."""
        found = self._frame.side_data.get("DISPLAYMATRIX")
        if found is None:
            return UPRIGHT
        a, b, _, c, d = struct.unpack("<5i", bytes(found)[:20])
        return orientation_of(((a, b), (c, d)))

    @property
    def stored_size(self) -> tuple[int, int]:
        """(height, width) before it is turned."""
        return self._frame.height, self._frame.width

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) as it is shown."""
        height, width = self.stored_size
        return (width, height) if self.orientation in QUARTER_TURNS else (height, width)

    @property
    def full_range(self) -> bool:
        """True if black is 0 and white 255 in `luma`, instead of 16 and 235."""
        frame = self._frame
        gray = frame.format.name == "gray" and frame.color_range != ColorRange.MPEG
        return gray or frame.format.is_rgb or frame.format.name in _FULL_RANGE or frame.color_range == ColorRange.JPEG

    @property
    def luma(self) -> np.ndarray:
        """uint8 (H, W), a view into the decoder's memory where the format allows it."""
        frame = self._frame
        if frame.format.is_rgb:
            frame = frame.reformat(
                format="yuv420p", src_colorspace=_BT709, dst_colorspace=_BT601, dst_color_range=ColorRange.JPEG
            )
        elif frame.format.name not in _LUMA_FIRST:  # more than 8 bits
            frame = frame.reformat(
                format="yuv420p", src_color_range=frame.color_range, dst_color_range=frame.color_range
            )
        plane = frame.planes[0]
        rows = np.frombuffer(plane, dtype=np.uint8, count=plane.line_size * plane.height)
        return upright(rows.reshape(plane.height, plane.line_size)[:, : plane.width], self.orientation)

    @property
    def rgb(self) -> np.ndarray:
        """uint8 (H, W, 3).

        Raises: RejectedInputError (unreadable) for a matrix that cannot be converted.
        """
        frame, reformatter = self._frame, self._reformatter or VideoReformatter()
        if frame.format.is_rgb:
            converted = reformatter.reformat(frame, format="rgb24")
        else:
            matrix = self._matrix()
            converted = reformatter.reformat(
                frame,
                format="rgb24",
                src_colorspace=matrix,
                # RGB has no matrix, but PyAV hands the source's on only where the two differ.
                dst_colorspace=_BT709 if matrix != _BT709 else _BT601,
                src_color_range=ColorRange.JPEG if self.full_range else ColorRange.MPEG,
                interpolation=Interpolation.BICUBIC,
            )
        return upright(converted.to_ndarray(), self.orientation)

    @property
    def damaged(self) -> bool:
        """True if the decoder had to make up parts of it."""
        return bool(self._frame.is_corrupt)

    def _matrix(self) -> int:
        stated = int(self._frame.colorspace)
        if stated == _UNSPECIFIED or self._frame.format.name == "gray":
            return _BT709 if self._frame.height >= _HD_LINES else _BT601
        if stated not in _MATRICES:
            raise RejectedInputError(
                "unreadable",
                "Colours of the video cannot be converted",
                where=self._where,
                expected="a matrix of " + ", ".join(dict.fromkeys(_MATRICES.values())),
                got=f"matrix coefficients {stated} (ITU-T H.273)",
                next_step="encode the video again with -vf scale=out_color_matrix=bt709 -colorspace bt709",
            )
        return stated


FRAME_TOLERANCE = 0.25
"""A decoded frame is the wanted one when their times differ by less than this share of a frame's duration."""
_BOUNDED = {"max_pixels": str(MAX_PIXELS)}
_MAX_STREAMS = 16
_DEEP_GRAY = ("gray9", "gray1", "gray3", "grayf", "ya16")
"""Beginnings of pixel formats of one channel with more than 8 bits."""


@dataclass(frozen=True)
class VideoClip:
    """One view's frames inside of a video file.

    Attributes:
        path: of the file, local or remote.
        num_frames: of the clip.
        fps: rate of the clip.
        from_time: presentation time [s] of the first frame where several episodes share a file; frames are then found by
            time. None: frames are counted from the file's first one, whatever times they carry.
        skip: frames between that first one and the clip's.
        file_frames: how many frames the whole file must have (from_time None); None: not known.
    """

    path: AnyPath
    num_frames: int
    fps: float
    from_time: float | None = None
    skip: int = 0
    file_frames: int | None = None

    @classmethod
    def whole_file(cls, path: AnyPath, num_frames: int, fps: float) -> VideoClip:
        """A file that holds this episode's view and nothing else; another number of frames in it is an error."""
        return cls(path, num_frames, fps, file_frames=num_frames)

    def cut(self, start: int, stop: int) -> VideoClip:
        """Frames start..stop (exclusive) of the clip."""
        return replace(self, skip=self.skip + start, num_frames=stop - start)

    @property
    def start_time(self) -> float:
        """Presentation time [s] of the clip's frame 0, where frames are found by time."""
        return (self.from_time or 0.0) + self.skip / self.fps


_QUICKTIME = (b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide", b"pnot", b"styp")
_MATROSKA = b"\x1aE\xdf\xa3"


def check_video_header(path: AnyPath) -> Path:
    """The file to open.

    Raises: RejectedInputError: missing_file, special_file, truncated_video (empty), unreadable (no mp4, QuickTime, Matroska,
        WebM or AVI file).
    """
    file = regular_file(path, "Video file")
    try:
        with file.open("rb") as stream:
            head = stream.read(12)
    except OSError as error:
        raise undecodable(path, error) from error
    if not head:
        raise undecodable(path, "0 bytes")
    if not (head[4:8] in _QUICKTIME or head.startswith(_MATROSKA) or (head[:4] == b"RIFF" and head[8:] == b"AVI ")):
        raise RejectedInputError(
            "unreadable",
            "File is no video container",
            where=path,
            expected="mp4, QuickTime, Matroska, WebM or AVI",
            got=f"a file that begins with {head.hex()}",
        )
    return file


def undecodable(path: AnyPath, got: object) -> RejectedInputError:
    """The rejection of a video that breaks off."""
    return RejectedInputError(
        "truncated_video",
        "Video cannot be decoded",
        where=path,
        expected="a complete video file",
        got=got,
        next_step="copy the file again; it may be truncated",
    )


@contextmanager
def open_video(path: AnyPath) -> Iterator[tuple[InputContainer, VideoStream]]:
    """A video file and its first video stream, once what its header claims has been checked.

    FFmpeg's errors inside of the block become RejectedInputErrors as well.

    Raises: RejectedInputError (missing_file, unreadable, truncated_video, too_large, special_file).
    """
    file = local_file(path)
    check_video_header(file)
    try:
        # The streams' own headers may claim what the container's did not, and no other file may be drawn in.
        with av.open(  # pyright: ignore[reportCallIssue] - the stubs take stream_options for a list of str
            str(file),
            options={"protocol_whitelist": "file"},
            stream_options=[_BOUNDED] * _MAX_STREAMS,  # pyright: ignore[reportArgumentType]
            metadata_errors="replace",
        ) as container:
            if not container.streams.video:
                raise RejectedInputError(
                    "unreadable", "File holds no video stream", where=path, expected="one video stream", got="none"
                )
            stream = container.streams.video[0]
            if stream.codec_context is None:  # the type stubs know no such stream
                raise undecodable(path, "a codec that this FFmpeg does not know")
            check_image_size(stream.width, stream.height, str(path))
            pixel_format = str(stream.codec_context.pix_fmt)
            if pixel_format.startswith(_DEEP_GRAY):
                raise depth_picture(path, f"a video of {pixel_format}")
            claimed, size = stream.frames, file.stat().st_size
            if claimed > size:
                raise too_large("Video claims more frames than it has bytes", where=path, limit=size, got=claimed)
            stream.codec_context.options = _BOUNDED
            stream.thread_type = "NONE"  # small pictures decode faster than threads start
            yield container, stream
    except av.error.MemoryError:
        raise  # for the process that limits it
    except av.error.FFmpegError as error:
        if disk_full(error):
            raise  # of a video that is written inside of the block
        raise undecodable(path, error) from error


def video_size(path: AnyPath) -> tuple[int, int, float]:
    """(height, width, frames per second) from the container, without decoding: not turned by a display matrix.

    Raises: DataError when the file is missing or not a video.
    """
    with open_video(path) as (_, stream):
        rate = stream.average_rate or stream.base_rate or Fraction(0)
        return stream.height, stream.width, float(rate)


def shown_size(path: AnyPath) -> tuple[int, int, int]:
    """(height, width, orientation as EXIF counts) of the first picture as it is shown.

    Raises: RejectedInputError as `open_video`; truncated_video where there is no picture.
    """
    with open_video(path) as (container, stream):
        frame = next(container.decode(stream), None)
        if frame is None:
            raise undecodable(path, "no frames")
        picture = Picture(frame, path)
        return *picture.size, picture.orientation


def frame_times(path: AnyPath) -> np.ndarray:
    """(N,) float64 presentation times [s] of a video's frames from the first one's, in the order of presentation.

    A packet of video is one frame; those that an edit list cuts away are marked and left out.

    Raises: RejectedInputError: missing_file, special_file, too_large, unreadable (no video, or frames without a time),
        truncated_video.
    """
    with open_video(path) as (container, stream):
        base = stream.time_base or Fraction(1, 1000)
        ticks = [packet.pts for packet in container.demux(stream) if packet.size and not packet.is_discard]
    timed = [tick for tick in ticks if tick is not None]
    if not ticks:
        raise undecodable(path, "no frames")
    if len(timed) < len(ticks):
        raise RejectedInputError(
            "unreadable",
            "Frames of the video have no time",
            where=path,
            expected=f"{len(ticks)} frames with a time",
            got=f"{len(timed)}",
        )
    ordered = np.sort(np.asarray(timed, dtype=np.int64))
    return (ordered - ordered[0]) * float(base)


def seek_before(container: InputContainer, stream: VideoStream, time: float) -> Iterator[VideoFrame]:
    """Decoded frames from a key frame at or before a presentation time [s].

    Where frames are stored in another order than shown, a container may seek to a key frame shown after the wanted
    time (it is stored before it): then again, from further back.
    """
    time_base = stream.time_base or Fraction(1, 1000)
    tolerance = FRAME_TOLERANCE / float(stream.average_rate or 30)
    margin = 0.0
    while time - margin > 0:
        container.seek(max(round((time - margin) / time_base), 0), stream=stream, backward=True, any_frame=False)
        frames = container.decode(stream)
        first = next((frame for frame in frames if frame.pts is not None), None)
        if first is not None and first.pts is not None and float(first.pts * time_base) <= time + tolerance:
            yield first
            yield from frames
            return
        margin = max(2 * margin, 0.25)
    container.seek(0, stream=stream, backward=True, any_frame=False)
    yield from container.decode(stream)


def read_clip(clip: VideoClip, *, calibrated: bool = False) -> Iterator[Picture]:
    """The pictures of a clip in order, num_frames of them.

    Args:
        calibrated: whether the view has a camera; of turned pictures it is not known to which K belongs.

    Raises: RejectedInputError (missing_file, unreadable, too_large; truncated_video when frames are missing,
        length_mismatch when the file has too many; missing_calibration for turned pictures of a calibrated view).
    """
    for picture in _counted(clip) if clip.from_time is None else _timed(clip):
        if calibrated and picture.orientation != UPRIGHT:
            raise turned_view(clip.path, picture.orientation)
        yield picture


def _counted(clip: VideoClip) -> Iterator[Picture]:
    seen, reformatter = 0, VideoReformatter()
    expected = clip.file_frames if clip.file_frames is not None else clip.skip + clip.num_frames
    with named_break(clip, lambda: seen), open_video(clip.path) as (container, stream):
        for frame in container.decode(stream):
            if frame.pts is None:
                continue
            if clip.skip <= seen < clip.skip + clip.num_frames:
                yield Picture(frame, clip.path, reformatter)
            seen += 1
            if clip.file_frames is None and seen == expected:
                return
    if seen != expected:
        raise wrong_count(clip.path, expected, seen)


def _timed(clip: VideoClip) -> Iterator[Picture]:
    found, nearest, reformatter = 0, math.inf, VideoReformatter()
    with named_break(clip, lambda: found), open_video(clip.path) as (container, stream):
        time_base = stream.time_base or Fraction(1, 1000)
        for frame in seek_before(container, stream, clip.start_time):
            if frame.pts is None:
                continue
            number = (float(frame.pts * time_base) - clip.start_time) * clip.fps
            if round(number) == found and abs(number - found) < FRAME_TOLERANCE:
                yield Picture(frame, clip.path, reformatter)
                found, nearest = found + 1, math.inf
            elif abs(number - found) < abs(nearest):
                nearest = number - found
            if found == clip.num_frames:
                return
            if number > found + 1:
                break
    if FRAME_TOLERANCE <= abs(nearest) <= 1 - FRAME_TOLERANCE:
        raise _off_grid(clip, found, nearest)
    raise wrong_count(clip.path, clip.num_frames, found)


def _off_grid(clip: VideoClip, number: int, offset: float) -> RejectedInputError:
    """The rejection of a clip whose frame ``number`` is there, but a part of a frame early or late."""
    due = clip.start_time + number / clip.fps
    cause = "the start of the window" if number == 0 else "the rate"
    return RejectedInputError(
        "wrong_fps",
        f"Frames of the video do not fit {cause}",
        where=clip.path,
        expected=f"frame {number} at {due:.6g} s: from_timestamp {clip.start_time:.6g} s, {clip.fps:g} fps",
        got=f"nearest frame at {due + offset / clip.fps:.6g} s, {abs(offset):.2f} of a frame "
        + ("late" if offset > 0 else "early"),
        next_step=f"correct {'from_timestamp' if number == 0 else 'fps'} in the metadata",
        evidence={"frame": number, "offset_frames": round(offset, 4)},
    )


@contextmanager
def named_break(clip: VideoClip, seen: Callable[[], int]) -> Iterator[None]:
    """A stream that breaks while it is read: the error names how many frames there were and should be."""
    try:
        yield
    except RejectedInputError as error:
        if error.reason != "truncated_video" or "decoded_frames" in error.evidence:
            raise
        raise wrong_count(clip.path, clip.file_frames or clip.num_frames, seen(), str(error.got)) from error


def damaged_frame(clip: VideoClip, picture: Picture, number: int) -> RejectedInputError:
    """The rejection of a video with a frame that is not whole, or of another size than the video."""
    return RejectedInputError(
        "truncated_video",
        "Frame is damaged" if picture.damaged else "Frame has another size than its video",
        where=f"{clip.path}, frame {number}",
        expected="a whole frame of the video's size",
        got="one that the decoder had to make up in part" if picture.damaged else str(picture.stored_size),
        next_step="copy the file again; it may be damaged",
        evidence={"frame": number, "decoded_frames": number, "expected_frames": clip.num_frames},
    )


def wrong_count(path: AnyPath, expected: int | None, got: int, cause: str | None = None) -> RejectedInputError:
    """The rejection of a video with another number of frames than it should have."""
    too_few = cause is not None or (expected or 1) > got
    return RejectedInputError(
        "truncated_video" if too_few else "length_mismatch",
        "Video is truncated or undecodable" if too_few else "Video has too many frames",
        where=path,
        expected="at least 1 frame" if expected is None else f"{expected} frames",
        got=f"{got} frames" + (f" ({cause})" if cause else ""),
        next_step="copy the file again, or leave the episode in quarantine",
        evidence={"expected_frames": expected, "decoded_frames": got},
    )


class FrameDecoder:
    """Exact frames of clips, found by their presentation times: a neighbouring frame is an error and never returned.

    Files stay open, for clips of joined videos come from the same files again and again.

    Args:
        open_files: largest number of them; the least recently used one is closed first.
    """

    name = f"PyAV {av.__version__}"

    def __init__(self, open_files: int = 16) -> None:
        self._limit = open_files
        self._open: OrderedDict[str, tuple[InputContainer, VideoStream, ExitStack]] = OrderedDict()
        self._reformatter = VideoReformatter()  # one for all frames: setting one up costs as much as a small frame

    def __reduce__(self) -> tuple[type[FrameDecoder], tuple[int]]:
        # Another process opens files itself.
        return FrameDecoder, (self._limit,)

    def frames(self, clip: VideoClip, indices: Sequence[int]) -> Iterator[np.ndarray]:
        """uint8 (H, W, 3) RGB of the clip's frames ``indices`` (increasing), one after the other.

        Raises: RejectedInputError: missing_file; unreadable, truncated_video when a frame is not there. DataError when the
            indices are not increasing, or outside of the clip.
        """
        if not indices or any(b <= a for a, b in pairwise(indices)):
            raise DataError(
                "Frames are read in order", where=clip.path, expected="increasing indices", got=list(indices)
            )
        if indices[0] < 0 or indices[-1] >= clip.num_frames:
            raise DataError(
                "Frame index outside of the clip",
                where=clip.path,
                expected=f"0 <= index < {clip.num_frames}",
                got=f"{indices[0]}..{indices[-1]}",
            )
        times = [clip.start_time + index / clip.fps for index in indices]
        found, cause = 0, "a frame is not where it should be"
        try:
            for frame in seek_before(*self._file(clip.path), times[0]):
                if frame.time is None or (late := (float(frame.time) - times[found]) * clip.fps) < -FRAME_TOLERANCE:
                    continue
                if late > FRAME_TOLERANCE:
                    break
                yield Picture(frame, clip.path, self._reformatter).rgb
                found += 1
                if found == len(times):
                    return
        except av.error.FFmpegError as error:
            cause = str(error)
        self._close(str(clip.path))
        raise wrong_count(clip.path, len(times), found, cause)

    def close(self) -> None:
        """Close the files that are kept open."""
        for path in list(self._open):
            self._close(path)

    def _file(self, path: AnyPath) -> tuple[InputContainer, VideoStream]:
        if str(path) not in self._open:
            with ExitStack() as stack:
                container, stream = stack.enter_context(open_video(path))
                # dav1d starts threads of its own by default; loader processes are parallel already.
                stream.codec_context.thread_count = 1
                self._open[str(path)] = container, stream, stack.pop_all()
            while len(self._open) > self._limit:
                self._close(next(iter(self._open)))
        self._open.move_to_end(str(path))
        return self._open[str(path)][:2]

    def _close(self, path: str) -> None:
        if path in self._open:
            self._open.pop(path)[2].close()


def decode_video(path: AnyPath, expected_frames: int | None = None) -> np.ndarray:
    """All frames of a video, uint8 (N, H, W, 3).

    Raises: RejectedInputError naming the file and the frame counts when it is truncated, undecodable or of another length.
    """
    count = len(frame_times(path)) if expected_frames is None else expected_frames
    return np.stack([picture.rgb for picture in read_clip(VideoClip.whole_file(path, count, 1.0))])


def decode_frames(clip: VideoClip, indices: Sequence[int] | None = None) -> np.ndarray:
    """Exact frames of one clip, uint8 (len, H, W, 3).

    Args:
        indices: frame numbers inside the clip, in any order, also repeated; None for all.

    Raises: DataError when an index is outside of the clip; RejectedInputError when a frame cannot be decoded.
    """
    wanted = range(clip.num_frames) if indices is None else [int(index) for index in indices]
    ordered = sorted(set(wanted))
    decoder = FrameDecoder(open_files=1)
    try:
        frames = dict(zip(ordered, decoder.frames(clip, ordered), strict=True))
    finally:
        decoder.close()
    return np.stack([frames[index] for index in wanted])
