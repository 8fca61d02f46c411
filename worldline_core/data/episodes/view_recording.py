"""One view of an episode is written into a set: in one pass over its pictures it gets its video, thumbnails and statistics.

Where no pixel changes the video is copied without encoding: its packets stay as they are and only their times are written
anew, on the exact grid of the clip's rate, so that frame i of the copy is at i / fps whatever the source's times were.
Otherwise its pictures are encoded. Either way few pictures are in memory at a time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from fractions import Fraction
from itertools import chain, islice
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from av.container import InputContainer
from av.packet import Packet
from av.video.stream import VideoStream

from worldline_core.data.episodes.lerobot_writer import EpisodeVideo, ImageSampler
from worldline_core.data.guards.plain_files import UPRIGHT, expect_layout
from worldline_core.data.guards.reader_process import still_reading
from worldline_core.data.guards.rejection import RejectedInputError, check_length
from worldline_core.data.video.clip import (
    FRAME_TOLERANCE,
    Picture,
    VideoClip,
    damaged_frame,
    open_video,
    read_clip,
    wrong_count,
)
from worldline_core.data.video.encoder import Encoding, VideoEncoder, frame_rate, length_prefixed, new_mp4
from worldline_core.data.video.thumbnails import ThumbnailMaker, ViewThumbnails, write_thumbnails
from worldline_core.geometry.cameras import Fit, ImageTransform

VideoMode = Literal["auto", "encode"]


@dataclass(frozen=True)
class VideoSettings(Encoding):
    """Storage of images. Mode "auto" copies an encoded video in which nothing changes, "encode" never does."""

    mode: VideoMode = "auto"


@dataclass(frozen=True)
class ViewImages:
    """The pictures of one view as they were recorded, and how they are stored.

    Attributes:
        images: uint8 (H, W, 3) RGB, one by one; each call starts from the first.
        num_frames: expected number of pictures.
        clip: the encoded video, where the pictures are exactly its frames.
        step: every `step`-th picture is kept.
        image_size: (height, width) they are brought to by `fit`; None keeps theirs.
        calibrated: whether the view has a camera: pictures of the clip that a display matrix turns are then refused.
    """

    images: Callable[[], Iterator[np.ndarray]]
    num_frames: int
    clip: VideoClip | None = None
    step: int = 1
    image_size: tuple[int, int] | None = None
    fit: Fit = "stretch"
    calibrated: bool = False


RECORDED_SIZE = "recorded_size."
"""Begins the note, in an episode's conventions, of the size (HEIGHTxWIDTH) that a view had before it was enlarged."""


def recorded_size(conventions: Mapping[str, object], view: str) -> tuple[int, int] | None:
    """(height, width) of a view before it was enlarged; None where it was not.

    Raises: RejectedInputError (unreadable) for a note that is no size.
    """
    noted = conventions.get(f"{RECORDED_SIZE}{view}")
    if noted is None:
        return None
    with expect_layout(f"conventions, {RECORDED_SIZE}{view}", "HEIGHTxWIDTH in pixels"):
        height, width = (int(side) for side in str(noted).split("x"))
        if min(height, width) < 1:
            raise ValueError(noted)
        return height, width


def store_view(
    recorded: ViewImages, path: Path, fps: float, video: VideoSettings, enlarged_from: tuple[int, int] | None = None
) -> tuple[EpisodeVideo, ViewThumbnails, tuple[int, int]]:
    """Write a view's video to `path`, beside it the thumbnails of a video that was copied.

    Args:
        fps: rate of the stored video: frame i is at i / fps.
        enlarged_from: (height, width) of the recording, where it was enlarged before.

    Returns:
        the video, its thumbnails, and the size at which its pictures would have the pixels of the recording: smaller than
        the stored one along a side that was enlarged.

    Raises: RejectedInputError (length_mismatch, truncated_video, and whatever else reading raises); DataError for
        pictures that cannot be encoded; ConfigError for a size that no recording can have as yuv420p.
    """
    small = ThumbnailMaker(fps, enlarged_from)
    sampler = ImageSampler(-(-recorded.num_frames // recorded.step))
    copied = _copied(recorded, path, fps, small, sampler) if video.mode == "auto" else None
    fitted, codec, pixel_format = copied or _encoded(recorded, path, fps, video, small, sampler)
    size, before = fitted.image_size, enlarged_from or fitted.source_size
    scales = np.diagonal(fitted.affine)[1::-1] * fitted.source_size / before
    height, width = (round(side / max(1.0, scale)) for side, scale in zip(size, scales, strict=True))
    thumbnails = small.thumbnails()
    stored = EpisodeVideo(path, size, codec, pixel_format, bool(copied), sampler.histogram)
    if copied:
        write_thumbnails(stored.thumbnails, path, thumbnails)
    return stored, thumbnails, (height, width)


type _Format = tuple[ImageTransform, str, str]
"""Way of pictures to their stored size, codec and pixel format of the video."""


def _copied(
    recorded: ViewImages, path: Path, fps: float, small: ThumbnailMaker, sampler: ImageSampler
) -> _Format | None:
    if recorded.clip is None or recorded.step != 1:
        return None
    with open_video(recorded.clip.path) as (container, stream):
        unchanged = ImageTransform.of((stream.height, stream.width))
        if unchanged.fitted(recorded.image_size, recorded.fit).steps:
            return None
        pictures = copy_clip(recorded.clip, container, stream, path, fps)
        if pictures is None:
            return None
        for number, picture in enumerate(pictures):
            still_reading()
            if number == 0 and picture.orientation != UPRIGHT:
                return None  # pictures are stored upright, without a matrix
            small.add(picture.luma, full_range=picture.full_range)
            if sampler.wants(number):
                sampler.add(picture.rgb)
        return unchanged, stream.codec_context.codec.canonical_name, stream.codec_context.pix_fmt or "unknown"


def _encoded(
    recorded: ViewImages, path: Path, fps: float, video: VideoSettings, small: ThumbnailMaker, sampler: ImageSampler
) -> _Format:
    encoder: VideoEncoder | None = None
    transform = None
    count = 0
    with ExitStack() as writing:
        for luma, full_range, rgb in _pictures(recorded):
            still_reading()
            if count % recorded.step == 0 and count < recorded.num_frames:
                small.add(luma, full_range=full_range)
                image = rgb()
                if encoder is None or transform is None:
                    transform = ImageTransform.of(image.shape[:2]).fitted(recorded.image_size, recorded.fit)
                    encoder = writing.enter_context(VideoEncoder(path, transform.image_size, fps, video))
                image = transform.frames(image[None])[0]
                if sampler.wants(encoder.count):
                    sampler.add(image)
                encoder.add(image)
            count += 1
    check_length("Video", path.stem, states=recorded.num_frames, unit="frames", found=count)
    if transform is None or encoder is None:
        raise RejectedInputError("truncated_video", "View has no pictures", where=path.stem)
    return transform, encoder.codec, video.pixel_format


def _pictures(recorded: ViewImages) -> Iterator[tuple[np.ndarray, bool, Callable[[], np.ndarray]]]:
    """Luma (H, W), whether it has the full range, and the picture in colour, which costs only when it is called."""
    if recorded.clip is not None:
        for number, picture in enumerate(read_clip(recorded.clip, calibrated=recorded.calibrated)):
            if picture.damaged:
                raise damaged_frame(recorded.clip, picture, number)
            yield picture.luma, picture.full_range, lambda picture=picture: picture.rgb
        return
    for image in recorded.images():
        yield cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY), True, lambda image=image: image


COPIED_CODECS = ("h264", "hevc", "av1", "vp9")
"""Codecs that mp4 holds and that the usual readers of datasets (torchcodec, PyAV, LeRobot) decode."""
# Codecs store a frame at most this many frames before or after the place where it is shown (H.264 and HEVC: 16).
_REORDERED = 32


def copy_clip(
    clip: VideoClip, container: InputContainer, stream: VideoStream, target: Path, fps: float | None = None
) -> Iterator[Picture] | None:
    """The clip's decoded frames in order; when they are exhausted, its copy at `target` is complete.

    None where packets and frames of the clip are not the same thing: another codec or container, a clip that does not
    begin at a key frame or that needs frames outside of it, an edit list that cuts inside of it, or another number of
    frames than stated (decoding will say what is wrong).

    Args:
        container, stream: of clip.path, from `open_video`, not used before; they stay open while the frames are read.
        fps: rate of the copy, by default the clip's.

    Raises, while it is iterated: RejectedInputError (truncated_video) when a frame cannot be decoded or only in part.
    """
    if "mp4" not in container.format.name or stream.codec_context.codec.canonical_name not in COPIED_CODECS:
        return None
    selection = _select(clip, container, stream)
    if selection is None:
        return None
    return _write_copy(clip, container, stream, *selection, target, frame_rate(fps or clip.fps))


def _write_copy(
    clip: VideoClip,
    container: InputContainer,
    stream: VideoStream,
    first: int,
    shown_at: np.ndarray,
    target: Path,
    rate: Fraction,
) -> Iterator[Picture]:
    # Frames by which decoding must run ahead of showing.
    delay = int((np.arange(clip.num_frames) - shown_at).max())
    packets = islice(_packets_from(clip, container, stream), first, first + clip.num_frames)
    size = stream.height, stream.width  # as the container says it: a damaged packet may change the stream's
    found = 0
    tick = 1 / rate
    with new_mp4(target) as out:
        written = out.add_stream_from_template(stream, opaque=True)
        written.time_base = tick
        for number, packet in enumerate(chain(packets, (None,))):  # None: what the decoder still holds
            for frame in stream.codec_context.decode(packet):
                picture = Picture(frame, clip.path)
                if picture.damaged or picture.stored_size != size:
                    raise damaged_frame(clip, picture, found)
                yield picture
                found += 1
            if packet is not None:
                packet = length_prefixed(packet, stream)
                packet.time_base = tick
                packet.pts = int(shown_at[number])
                packet.dts = number - delay
                packet.duration = 1
                packet.stream = written
                out.mux(packet)
    if found != clip.num_frames:
        raise wrong_count(clip.path, clip.num_frames, found)


def _packets_from(clip: VideoClip, container: InputContainer, stream: VideoStream) -> Iterator[Packet]:
    """Packets in the order of decoding, from a key frame at or before the clip's start to the end of the file."""
    time_base = stream.time_base or Fraction(1, 1000)
    start = 0.0 if clip.from_time is None else clip.start_time
    container.seek(max(round(start / time_base), 0), stream=stream, backward=True, any_frame=False)
    # The demuxer ends with an empty flushing packet.
    return (packet for packet in container.demux(stream) if packet.size)


def _select(clip: VideoClip, container: InputContainer, stream: VideoStream) -> tuple[int, np.ndarray] | None:
    """Packets of a file that make up a clip: the number of the first one, counted in the order of decoding from
    `start_time`'s key frame (the others follow without a gap), and for each its frame's place in the order of presentation.
    """
    times: list[int] = []
    keys: list[bool] = []
    time_base = stream.time_base or Fraction(1, 1000)
    seconds = float(time_base)
    until = math.inf if clip.from_time is None else clip.start_time + (clip.num_frames + _REORDERED) / clip.fps
    for packet in _packets_from(clip, container, stream):
        if packet.pts is None or packet.is_discard or packet.is_corrupt:
            return None
        if packet.pts * seconds > until:
            break
        times.append(packet.pts)
        keys.append(packet.is_keyframe)
    numbers = _frame_numbers(clip, np.asarray(times, dtype=np.int64), time_base)
    if numbers is None:
        return None
    inside = np.flatnonzero((numbers >= 0) & (numbers < clip.num_frames))
    if not len(inside) == clip.num_frames == inside[-1] - inside[0] + 1:
        return None
    first, shown_at = int(inside[0]), numbers[inside]
    if not keys[first] or shown_at[0] != 0 or len(np.unique(shown_at)) != len(shown_at):
        return None
    return first, shown_at


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
