"""Reading video with PyAV, which carries its own FFmpeg: a machine without system codecs still decodes.

Axis legend: frames are `uint8 (N, H, W, 3)`, RGB, first frame first.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from fractions import Fraction

import numpy as np

from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.guards.source_paths import AnyPath
from worldline_core.data.video.clip import FRAME_TOLERANCE, open_video, seek_before, wrong_count
from worldline_core.errors import DataError


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
