"""Side-by-side videos: the same clip by several methods, in labelled columns that stay in step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from worldline_core.data.video.encoder import encode_video
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


def compose_side_by_side(
    columns: Mapping[str, NDArray[np.uint8]],
    *,
    tile_height: int = 256,
    upscale: Upscale = "lanczos",
    labels: bool = True,
) -> NDArray[np.uint8]:
    """Composes labelled columns of `n h w 3` frames into `n H W 3`.

    Methods may predict different numbers of frames: the result is as long as the shortest column, so that no
    column ever shows a frozen picture as if it were a prediction.

    Args:
        labels: draw the columns' names above them.

    Raises:
        ValueError: no columns, or an empty one.
    """
    if not columns or any(frames.shape[0] == 0 for frames in columns.values()):
        raise ValueError("a side-by-side video needs at least one column, and frames in every column")
    count = min(frames.shape[0] for frames in columns.values())
    first = next(iter(columns.values()))
    height, width = scaled_size(first.shape[1], first.shape[2], tile_height)
    pieces: list[NDArray[np.uint8]] = []
    gap = np.full((count, height + LABEL_HEIGHT_PX * labels, GAP_PX, 3), STRIP_PAPER, dtype=np.uint8)
    size_px = 26 if width >= 360 else 19 if width >= 260 else 15
    for label, frames in columns.items():
        body = scale_frames(frames[:count], (height, width), upscale)
        if labels:
            strip = text_strip(
                label, width, LABEL_HEIGHT_PX, size_px=size_px, ink=STRIP_INK, paper=STRIP_PAPER, align="centre"
            )
            body = np.concatenate([np.broadcast_to(strip, (count, *strip.shape)), body], axis=1)
        pieces += [body, gap]
    return np.concatenate(pieces[:-1], axis=2)


def write_side_by_side(
    path: Path,
    columns: Mapping[str, NDArray[np.uint8]],
    fps: float,
    *,
    tile_height: int = 256,
    upscale: Upscale = "lanczos",
) -> SideBySide:
    """Write labelled columns as `path` (mp4) with a poster beside it."""
    return write_video(path, compose_side_by_side(columns, tile_height=tile_height, upscale=upscale), fps)


def write_video(path: Path, frames: NDArray[np.uint8], fps: float, *, poster_at: float = 0.6) -> SideBySide:
    """Write `n h w 3` frames as `path` (mp4) and a poster JPEG beside it, taken at the fraction `poster_at` of the clip."""
    with atomic_path(path) as temporary:
        encode_video(temporary, frames, fps, crf=20, preset="veryfast")
    poster = path.with_suffix(".jpg")
    write_bytes_atomic(poster, jpeg_bytes(frames[round(poster_at * (len(frames) - 1))]))
    return SideBySide(path, poster, width=frames.shape[2], height=frames.shape[1], num_frames=len(frames))
