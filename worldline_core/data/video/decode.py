"""Reading video with PyAV, which carries its own FFmpeg: a machine without system codecs still decodes.

Axis legend: frames are `uint8 (N, H, W, 3)`, RGB, first frame first.

When the frames of a video are shown, from its packets: nothing is decoded.

Images and masks at another size.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from fractions import Fraction
from typing import Literal

import numpy as np

from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.guards.source_paths import AnyPath
from worldline_core.data.video.clip import FRAME_TOLERANCE, open_video, seek_before, undecodable, wrong_count
from worldline_core.errors import DataError
from worldline_core.geometry.cameras import ImageTransform


def iterate_frames(path: AnyPath, start_time: float = 0.0) -> Iterator[tuple[float, np.ndarray]]:
    """Yield (presentation time in seconds, uint8 (H, W, 3) RGB) from the key frame at or before start_time.

    Raises: RejectedInputError when the file is missing, has no readable video or breaks off.
    """
    with open_video(path) as (container, stream):
        time_base = stream.time_base or Fraction(1, 1000)
        for frame in seek_before(container, stream, start_time):
            if frame.pts is not None:
                yield float(frame.pts * time_base), frame.to_ndarray(format="rgb24")


def decode_video(path: AnyPath, expected_frames: int | None = None) -> np.ndarray:
    """All frames of a video, uint8 (N, H, W, 3).

    Raises: DataError naming the file and the frame counts when it is truncated, undecodable or of another length.
    """
    frames: list[np.ndarray] = []
    try:
        frames.extend(image for _, image in iterate_frames(path))
    except RejectedInputError as error:
        if error.reason != "truncated_video":
            raise
        raise wrong_count(path, expected_frames, len(frames), str(error.got)) from error
    if not frames or (expected_frames is not None and len(frames) != expected_frames):
        raise wrong_count(path, expected_frames, len(frames))
    return np.stack(frames)


def decode_segment(
    path: AnyPath, from_time: float, count: int, fps: float, indices: Sequence[int] | None = None
) -> np.ndarray:
    """Exact frames of one clip inside a joined video, uint8 (len, H, W, 3).

    Args:
        from_time: presentation time [s] of the clip's frame 0.
        count: number of frames of the clip.
        indices: frame numbers inside the clip, each 0 <= i < count, any order; None for all.

    Raises: DataError when a wanted frame cannot be decoded or an index lies outside the clip.
    """
    wanted = list(range(count)) if indices is None else [int(i) for i in indices]
    if any(i < 0 or i >= count for i in wanted):
        raise DataError(
            "Frame index outside of the clip",
            where=str(path),
            expected=f"0 <= index < {count}",
            got=str(wanted),
        )
    if not wanted:
        raise DataError("No frames were asked for", where=str(path), expected="at least one index", got="none")
    needed, last = set(wanted), max(wanted)
    found: dict[int, np.ndarray] = {}
    broken: str | None = None
    try:
        with open_video(path) as (container, stream):
            time_base = stream.time_base or Fraction(1, 1000)
            for frame in seek_before(container, stream, from_time + min(wanted) / fps):
                if frame.pts is None:
                    continue
                number = (float(frame.pts * time_base) - from_time) * fps
                index = round(number)
                if index in needed and abs(number - index) < FRAME_TOLERANCE:
                    found[index] = frame.to_ndarray(format="rgb24")
                if index >= last:
                    break
    except RejectedInputError as error:
        if error.reason != "truncated_video":
            raise
        broken = str(error.got)
    if len(found) != len(needed):
        raise wrong_count(path, len(needed), len(found), broken)
    return np.stack([found[i] for i in wanted])


def video_size(path: AnyPath) -> tuple[int, int, float]:
    """(height, width, frames per second) from the container, without decoding.

    Raises: DataError when the file is missing or not a video.
    """
    with open_video(path) as (_, stream):
        rate = stream.average_rate or stream.base_rate or Fraction(0)
        return stream.height, stream.width, float(rate)


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
            where=str(path),
            expected=f"{len(ticks)} frames with a time",
            got=f"{len(timed)}",
        )
    ordered = np.sort(np.asarray(timed, dtype=np.int64))
    return (ordered - ordered[0]) * float(base)


Fit = Literal["stretch", "letterbox", "crop"]


def fitted(from_size: tuple[int, ...], size: tuple[int, int] | None, fit: Fit) -> ImageTransform:
    """From (height, width) to a wanted one: stretched, whole with black bars, or filled with the rest cut away."""
    transform = ImageTransform.of((from_size[0], from_size[1]))
    if size is None:
        return transform
    match fit:
        case "stretch":
            return transform.resize(size)
        case "letterbox":
            return transform.letterbox(size)
        case "crop":
            return transform.centre_crop(size)


def resize_frames(frames: np.ndarray, size: tuple[int, int] | None) -> np.ndarray:
    """uint8 (N, H, W, 3) at (height, width): area averages when shrinking, linear when enlarging."""
    return frames if size is None else _resized(frames, size).frames(frames)


def resize_masks(masks: np.ndarray, size: tuple[int, int] | None) -> np.ndarray:
    """bool (N, H, W) at (height, width): True where at least half of a pixel's area was."""
    return masks if size is None else _resized(masks, size).masks(masks)


def _resized(images: np.ndarray, size: tuple[int, int]) -> ImageTransform:
    return fitted((images.shape[1], images.shape[2]), size, "stretch")
