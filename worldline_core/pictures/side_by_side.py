"""Side-by-side videos: the same clip by several methods, in labelled columns that stay in step."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from worldline_core.data.video.encoder import encode_video
from worldline_core.data.video.frames import Frames, in_step
from worldline_core.pictures.labels import Upscale, jpeg_bytes, scale_frames, scaled_size, text_strip
from worldline_core.store.atomic import atomic_path, write_bytes_atomic

LABEL_HEIGHT_PX = 40
GAP_PX = 6
STRIP_PAPER = (24, 26, 31)
STRIP_INK = (240, 240, 238)


@dataclass(frozen=True)
class SideBySide:
    """What was written: the video, its poster picture, and the size in pixels and frames."""

    video: Path
    poster: Path
    width: int
    height: int
    num_frames: int


def side_by_side(
    columns: Mapping[str, Frames], *, tile_height: int = 256, upscale: Upscale = "lanczos", labels: bool = True
) -> Iterator[NDArray[np.uint8]]:
    """Pictures (H, W, 3) of labelled columns of frames `n h w 3`, one after the other.

    Methods may predict different numbers of frames: there are as many as the shortest column has, so that no
    column ever shows a frozen picture as if it were a prediction.

    Args:
        labels: draw the columns' names above them.

    Raises:
        ValueError: no columns, or an empty one.
    """
    if not columns or any(len(frames) == 0 for frames in columns.values()):
        raise ValueError("a side-by-side video needs at least one column, and frames in every column")
    first = next(iter(columns.values()))
    height, width = scaled_size(first.shape[1], first.shape[2], tile_height)
    gap = np.full((height + LABEL_HEIGHT_PX * labels, GAP_PX, 3), STRIP_PAPER, dtype=np.uint8)
    size_px = 26 if width >= 360 else 19 if width >= 260 else 15
    strips = {
        label: text_strip(
            label, width, LABEL_HEIGHT_PX, size_px=size_px, ink=STRIP_INK, paper=STRIP_PAPER, align="centre"
        )
        for label in columns
    }

    def picture(frames: Mapping[str, NDArray[np.uint8]]) -> NDArray[np.uint8]:
        pieces: list[NDArray[np.uint8]] = []
        for label, frame in frames.items():
            body = scale_frames(frame[None], (height, width), upscale)[0]
            pieces += [np.concatenate([strips[label], body], axis=0) if labels else body, gap]
        return np.concatenate(pieces[:-1], axis=1)

    return map(picture, in_step(columns))


def write_side_by_side(
    path: Path, columns: Mapping[str, Frames], fps: float, *, tile_height: int = 256, upscale: Upscale = "lanczos"
) -> SideBySide:
    """Write labelled columns as `path` (mp4) with a poster beside it."""
    count = min(map(len, columns.values()), default=0)
    return write_video(path, side_by_side(columns, tile_height=tile_height, upscale=upscale), count, fps)


def write_video(
    path: Path, frames: Iterable[NDArray[np.uint8]], count: int, fps: float, *, poster_at: float = 0.6
) -> SideBySide:
    """Write `count` pictures (H, W, 3) as `path` (mp4) and a poster JPEG beside it, taken at the fraction `poster_at` of the clip."""
    shown: list[NDArray[np.uint8]] = []

    def watched() -> Iterator[NDArray[np.uint8]]:
        for number, frame in enumerate(frames):
            if number == round(poster_at * (count - 1)):
                shown.append(frame)
            yield frame

    with atomic_path(path) as temporary:
        encode_video(temporary, watched(), fps, crf=20, preset="veryfast")
    poster = path.with_suffix(".jpg")
    write_bytes_atomic(poster, jpeg_bytes(shown[0]))
    return SideBySide(path, poster, width=shown[0].shape[1], height=shown[0].shape[0], num_frames=count)
