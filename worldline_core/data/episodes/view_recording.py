"""One view of an episode is written into a set: in one pass over its pictures it gets its video, thumbnails and statistics.

Where no pixel changes the video is copied without encoding; otherwise its pictures are encoded. Either way one picture is in
memory at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.lerobot.statistics import ImageSampler
from worldline_core.data.video.clip import VideoClip, damaged_frame, open_video, read_clip
from worldline_core.data.video.copy import clip_copy
from worldline_core.data.video.encoder import KEY_FRAME_INTERVAL, PixelFormat, VideoEncoder
from worldline_core.data.video.thumbnails import ThumbnailMaker, ViewThumbnails
from worldline_core.geometry.cameras import Fit, ImageTransform

VideoMode = Literal["auto", "encode"]


@dataclass(frozen=True)
class VideoSettings:
    """How images are stored. mode "auto" copies an encoded video in which nothing changes, "encode" never does."""

    crf: int = 18
    preset: str = "slow"
    pixel_format: PixelFormat = "yuv420p"
    mode: VideoMode = "auto"
    key_frame_interval: int = KEY_FRAME_INTERVAL


@dataclass(frozen=True)
class RecordedView:
    """The pictures of one view as they were recorded, and how they are stored.

    Attributes:
        images: uint8 (H, W, 3) RGB, one by one; each call starts from the first.
        num_frames: expected number of pictures.
        clip: the encoded video, where the pictures are exactly its frames.
        step: every `step`-th picture is kept.
        image_size: (height, width) they are brought to by `fit`; None keeps theirs.
    """

    images: Callable[[], Iterator[np.ndarray]]
    num_frames: int
    clip: VideoClip | None = None
    step: int = 1
    image_size: tuple[int, int] | None = None
    fit: Fit = "stretch"

    @classmethod
    def of(cls, frames: np.ndarray) -> RecordedView:
        """Of pictures in memory, uint8 (N, H, W, 3), kept as they are."""
        return cls(lambda: iter(frames), len(frames))


@dataclass(frozen=True)
class StoredView:
    """A view's video in a set, and what was measured while it was written.

    Attributes:
        size: (height, width).
        codec, pixel_format: as FFmpeg names them.
        copied: whether its packets are those of the recording.
        histogram: (3, 256) counts of sampled pixels.
        thumbnails: of the kept pictures, at the size they were recorded in.
    """

    path: Path
    size: tuple[int, int]
    codec: str
    pixel_format: str
    copied: bool
    histogram: np.ndarray
    thumbnails: ViewThumbnails


def store_view(recorded: RecordedView, path: Path, fps: float, video: VideoSettings) -> StoredView:
    """Write a view's video to `path`.

    Args:
        fps: rate of the stored video: frame i lies at i / fps.

    Raises: RejectedInputError (length_mismatch, truncated_video, and whatever else reading raises); DataError for
        pictures that cannot be encoded.
    """
    return (_copied(recorded, path, fps) if video.mode == "auto" else None) or _encoded(recorded, path, fps, video)


def _copied(recorded: RecordedView, path: Path, fps: float) -> StoredView | None:
    if recorded.clip is None or recorded.step != 1:
        return None
    with open_video(recorded.clip.path) as (container, stream):
        size = stream.height, stream.width
        if ImageTransform.of(size).fitted(recorded.image_size, recorded.fit).steps:
            return None
        copy = clip_copy(recorded.clip, container, stream)
        if copy is None:
            return None
        small = ThumbnailMaker(fps)
        sampler = ImageSampler(recorded.num_frames)
        for number, picture in enumerate(copy.pictures(path, fps)):
            small.add(picture.luma, full_range=picture.full_range)
            if sampler.wants(number):
                sampler.add(picture.rgb)
        context = stream.codec_context
        pixel_format = context.pix_fmt or "unknown"
        codec = context.codec.canonical_name
    return StoredView(path, size, codec, pixel_format, True, sampler.histogram, small.thumbnails())


def _encoded(recorded: RecordedView, path: Path, fps: float, video: VideoSettings) -> StoredView:
    small = ThumbnailMaker(fps)
    sampler = ImageSampler(-(-recorded.num_frames // recorded.step))
    encoder: VideoEncoder | None = None
    transform = None
    count = 0
    try:
        for luma, full_range, rgb in _pictures(recorded):
            if count % recorded.step == 0 and count < recorded.num_frames:
                small.add(luma, full_range=full_range)
                image = rgb()
                if encoder is None or transform is None:
                    transform = ImageTransform.of(image.shape[:2]).fitted(recorded.image_size, recorded.fit)
                    encoder = VideoEncoder(
                        path,
                        transform.image_size,
                        fps,
                        crf=video.crf,
                        preset=video.preset,
                        pixel_format=video.pixel_format,
                        key_frame_interval=video.key_frame_interval,
                    )
                image = transform.frames(image[None])[0]
                if sampler.wants(encoder.count):
                    sampler.add(image)
                encoder.add(image)
            count += 1
    finally:
        if encoder is not None:
            encoder.close()
    if count != recorded.num_frames or encoder is None:
        raise RejectedInputError(
            "length_mismatch",
            "Video and states differ in length",
            where=path.stem,
            expected=f"{recorded.num_frames} frames",
            got=f"{count} frames",
            evidence={"states": recorded.num_frames, "frames": count},
        )
    return StoredView(path, encoder.size, "h264", video.pixel_format, False, sampler.histogram, small.thumbnails())


def _pictures(recorded: RecordedView) -> Iterator[tuple[np.ndarray, bool, Callable[[], np.ndarray]]]:
    """Luma (H, W), whether it has the full range, and the picture in colour, which costs only when it is called."""
    if recorded.clip is not None:
        for number, picture in enumerate(read_clip(recorded.clip)):
            if picture.damaged:
                raise damaged_frame(recorded.clip, picture, number)
            yield picture.luma, picture.full_range, lambda picture=picture: picture.rgb
        return
    for image in recorded.images():
        yield cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY), True, lambda image=image: image
