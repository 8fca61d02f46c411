"""Taking one episode's clip out of a video file without encoding it again.

The packets are copied as they are; only their times are written anew, on the exact grid of the clip's rate, so that
frame i of the copy lies at i / fps whatever the source's times were. The copy is decoded while it is made.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.container import InputContainer
from av.packet import Packet
from av.video.stream import VideoStream

from worldline_core.data.video.clip import FRAME_TOLERANCE, Picture, VideoClip, damaged_frame, wrong_count
from worldline_core.data.video.encoder import BITEXACT, frame_rate, length_prefixed

COPIED_CODECS = ("h264", "hevc", "av1", "vp9")
"""Codecs that mp4 holds and that the usual readers of datasets (torchcodec, PyAV, LeRobot) decode."""
# A clip that is larger than this is read from the file twice rather than held in memory.
_HELD_BYTES = 64 << 20
# Codecs store a frame at most this many frames before or after the place where it is shown (H.264 and HEVC: 16).
_REORDERED = 32


@dataclass(frozen=True)
class _Selection:
    """Which packets of a file, counted in the order of decoding from `start_time`'s key frame, make up a clip.

    Attributes:
        first: number of the first packet; the others follow without a gap.
        shown_at: (n,) for each packet, as how many-th its frame is shown.
        delay: frames by which decoding must run ahead of showing.
        packets: the packets themselves, None where they are too many to hold.
    """

    first: int
    shown_at: np.ndarray
    delay: int
    packets: list[Packet] | None


class ClipCopy:
    """A clip that can be copied: iterate its pictures and, in the same pass, the copy is written to `target`.

    Use `clip_copy` to make one.
    """

    def __init__(self, clip: VideoClip, container: InputContainer, stream: VideoStream, selection: _Selection) -> None:
        self._clip = clip
        self._container = container
        self._stream = stream
        self._selection = selection
        self._size = stream.height, stream.width

    def pictures(self, target: Path, fps: float | None = None) -> Iterator[Picture]:
        """The decoded frames in order; when they are exhausted, the mp4 at `target` is complete.

        Args:
            fps: rate of the copy, by default the clip's.

        Raises: RejectedInputError (truncated_video) when a frame cannot be decoded or only in part.
        """
        time_base = 1 / frame_rate(fps or self._clip.fps)
        shown_at = self._selection.shown_at.tolist()
        found = 0
        with av.open(str(target), "w", format="mp4", options=BITEXACT) as out:
            written = out.add_stream_from_template(self._stream, opaque=True)
            written.time_base = time_base
            for number, packet in enumerate(self._packets()):
                for frame in self._stream.codec_context.decode(packet):
                    picture = Picture(frame)
                    self._check(picture, found)
                    yield picture
                    found += 1
                packet = length_prefixed(packet, self._stream)
                packet.time_base = time_base
                packet.pts = shown_at[number]
                packet.dts = number - self._selection.delay
                packet.duration = 1
                packet.stream = written
                out.mux(packet)
            for frame in self._stream.codec_context.decode(None):
                picture = Picture(frame)
                self._check(picture, found)
                yield picture
                found += 1
        if found != self._clip.num_frames:
            raise wrong_count(self._clip.path, self._clip.num_frames, found)

    def _check(self, picture: Picture, number: int) -> None:
        if picture.damaged or picture.size != self._size:
            raise damaged_frame(self._clip, picture, number)

    def _packets(self) -> Iterator[Packet]:
        if self._selection.packets is not None:
            yield from self._selection.packets
            return
        first, count = self._selection.first, len(self._selection.shown_at)
        for number, packet in enumerate(_packets_from(self._clip, self._container, self._stream)):
            if number >= first + count:
                return
            if number >= first:
                yield packet


def clip_copy(clip: VideoClip, container: InputContainer, stream: VideoStream) -> ClipCopy | None:
    """The clip's copy, or None where packets and frames of the clip are not the same thing: another codec or container, a
    clip that does not begin at a key frame or that needs frames outside of it, an edit list that cuts inside of it, or
    another number of frames than stated (decoding will say what is wrong).

    Args:
        container, stream: of clip.path, from `open_video`, not used before; they stay open while the copy is used.
    """
    if "mp4" not in container.format.name or stream.codec_context.codec.canonical_name not in COPIED_CODECS:
        return None
    selection = _select(clip, container, stream)
    return None if selection is None else ClipCopy(clip, container, stream, selection)


def _packets_from(clip: VideoClip, container: InputContainer, stream: VideoStream) -> Iterator[Packet]:
    """Packets in the order of decoding, from a key frame at or before the clip's start to the end of the file."""
    time_base = stream.time_base or Fraction(1, 1000)
    start = 0.0 if clip.from_time is None else clip.start_time
    container.seek(max(round(start / time_base), 0), stream=stream, backward=True, any_frame=False)
    # The demuxer ends with an empty flushing packet.
    return (packet for packet in container.demux(stream) if packet.size)


def _select(clip: VideoClip, container: InputContainer, stream: VideoStream) -> _Selection | None:
    times: list[int] = []
    keys: list[bool] = []
    held: list[Packet] | None = []
    held_bytes = 0
    time_base = stream.time_base or Fraction(1, 1000)
    until = None if clip.from_time is None else clip.start_time + (clip.num_frames + _REORDERED) / clip.fps
    for packet in _packets_from(clip, container, stream):
        if packet.pts is None or packet.is_discard or packet.is_corrupt:
            return None
        if until is not None and float(packet.pts * time_base) > until:
            break
        times.append(packet.pts)
        keys.append(packet.is_keyframe)
        held_bytes += packet.size
        if held is not None:
            held.append(packet)
            held = held if held_bytes <= _HELD_BYTES else None
    if not times:
        return None
    numbers = _frame_numbers(clip, np.asarray(times), time_base)
    if numbers is None:
        return None
    inside = np.flatnonzero((numbers >= 0) & (numbers < clip.num_frames))
    if len(inside) != clip.num_frames or inside[-1] - inside[0] + 1 != len(inside):
        return None
    first, shown_at = int(inside[0]), numbers[inside]
    if not keys[first] or shown_at[0] != 0 or len(np.unique(shown_at)) != len(shown_at):
        return None
    delay = int((np.arange(len(shown_at)) - shown_at).max())
    return _Selection(first, shown_at, delay, None if held is None else held[first : first + len(shown_at)])


def _frame_numbers(clip: VideoClip, times: np.ndarray, time_base: Fraction) -> np.ndarray | None:
    """(packets,) which frame of the clip each packet holds; numbers outside of 0..num_frames-1 belong to others."""
    if clip.from_time is None:
        if clip.file_frames is not None and len(times) != clip.file_frames:
            return None
        shown = np.empty(len(times), dtype=np.int64)
        shown[np.argsort(times, kind="stable")] = np.arange(len(times))
        return shown - clip.skip
    exact = (times * float(time_base) - clip.start_time) * clip.fps
    numbers = np.rint(exact).astype(np.int64)
    near = (numbers >= 0) & (numbers < clip.num_frames)
    return None if (np.abs(exact - numbers)[near] >= FRAME_TOLERANCE).any() else numbers
