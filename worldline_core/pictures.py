"""Drawing for every room: text on pictures, contact sheets, side-by-side videos.

Text uses Pillow's embedded font, so the same call gives the same bytes on every machine.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from worldline_core.data.video.encoder import encode_video
from worldline_core.data.video.frames import Frames, in_step
from worldline_core.store.atomic import atomic_path, write_bytes_atomic
from worldline_core.untrusted_text import visible

Picture = NDArray[np.uint8]
"""One RGB picture, `h w 3`."""
Colour = tuple[int, int, int]

INK: Colour = (24, 26, 31)
PAPER: Colour = (250, 249, 246)
MUTED: Colour = (110, 114, 122)


# Text, scaling, encoding


@lru_cache(maxsize=16)
def font(size_px: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """The embedded font at a pixel size."""
    return ImageFont.load_default(size_px)


def text_width_px(text: str, size_px: int) -> int:
    """Width of a line of text in pixels."""
    return int(np.ceil(font(size_px).getlength(text)))


def fit_text(text: str, width_px: int, size_px: int) -> str:
    """The line, cut with an ellipsis where it is wider than `width_px`."""
    text = " ".join(visible(text[:width_px]).splitlines())[: width_px // 2]  # no letter is narrower than two pixels
    if text_width_px(text, size_px) <= width_px:
        return text
    shortened = (text[:end].rstrip() + "..." for end in range(len(text) - 1, 0, -1))
    return next((found for found in shortened if text_width_px(found, size_px) <= width_px), "")


def text_strip(
    text: str,
    width_px: int,
    height_px: int,
    *,
    size_px: int = 15,
    ink: Colour = INK,
    paper: Colour = PAPER,
    align: Literal["left", "centre"] = "left",
) -> Picture:
    """A strip of paper with one line of text, vertically centred, cut to the width."""
    strip = Image.new("RGB", (width_px, height_px), paper)
    margin_px = 6
    shown = fit_text(text, width_px - 2 * margin_px, size_px)
    x, anchor = (width_px / 2, "mm") if align == "centre" else (margin_px, "lm")
    ImageDraw.Draw(strip).text((x, height_px / 2), shown, font=font(size_px), fill=ink, anchor=anchor)
    return np.asarray(strip, dtype=np.uint8)


def draw_tag(picture: Picture, text: str, *, size_px: int = 13) -> Picture:
    """A copy of the picture with white text on a small dark tag in its lower left corner."""
    height, width = picture.shape[:2]
    shown = fit_text(text, width - 10, size_px)
    tag_width, tag_height = text_width_px(shown, size_px) + 10, size_px + 7
    top = height - tag_height
    canvas = Image.fromarray(picture)
    draw = ImageDraw.Draw(canvas, "RGBA")
    draw.rectangle((0, top, tag_width, top + tag_height), fill=(16, 18, 22, 190))
    draw.text((5, top + tag_height / 2), shown, font=font(size_px), fill=(255, 255, 255, 255), anchor="lm")
    return np.asarray(canvas, dtype=np.uint8)


def scaled_size(height: int, width: int, target_height: int) -> tuple[int, int]:
    """Display size (h, w), both even: a whole multiple for small frames, so that pixels stay equal; else a reduction."""
    if height <= target_height:
        factor = max(1, target_height // height)
        scaled = (height * factor, width * factor)
    else:
        scaled = (target_height, round(width * target_height / height))
    return scaled[0] + scaled[0] % 2, scaled[1] + scaled[1] % 2


def scale_frames(frames: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """Frames `n h w 3` at size (h, w): enlarged by Lanczos' filter, reduced by area averages."""
    height, width = size
    if frames.shape[1:3] == (height, width):
        return frames
    interpolation = cv2.INTER_LANCZOS4 if height >= frames.shape[1] else cv2.INTER_AREA
    return np.stack([cv2.resize(frame, (width, height), interpolation=interpolation) for frame in frames])


def png_bytes(picture: Picture) -> bytes:
    """The picture as PNG, at a fifth of the time of the strongest compression and 4 % more bytes."""
    buffer = BytesIO()
    Image.fromarray(picture).save(buffer, format="PNG", optimize=False, compress_level=6)
    return buffer.getvalue()


def jpeg_bytes(picture: Picture, quality: int = 88) -> bytes:
    """The picture as JPEG without chroma subsampling, which would blur small coloured objects."""
    buffer = BytesIO()
    Image.fromarray(picture).save(buffer, format="JPEG", quality=quality, subsampling=0, optimize=True)
    return buffer.getvalue()


# Contact sheets

GAP_PX, MARGIN_PX = 4, 12


@dataclass(frozen=True)
class SheetRow:
    """One row of a sheet: a title, pictures `n h w 3` of one size, and an optional second line in grey."""

    title: str
    frames: NDArray[np.uint8]
    note: str = ""


def evenly_spaced(count: int, wanted: int) -> list[int]:
    """Indices of `wanted` of `count` items, the first and the last among them."""
    return [round(i) for i in np.linspace(0, count - 1, min(wanted, count))] if count > 0 else []


def contact_sheet(
    rows: Sequence[SheetRow],
    *,
    tile_height: int = 128,
    title: str | None = None,
    column_titles: Sequence[str] = (),
    min_width: int = 0,
) -> Picture:
    """Labelled rows in one picture; rows may differ in length and in picture size.

    Args:
        tile_height: small frames are enlarged by a whole factor to at most this.
        min_width: room for titles where tiles are few.

    Raises: ValueError: no rows, or a row without pictures.
    """
    if not rows or any(row.frames.shape[0] == 0 for row in rows):
        raise ValueError("a contact sheet needs at least one row, and at least one picture in every row")
    tiles = [
        scale_frames(row.frames, scaled_size(row.frames.shape[1], row.frames.shape[2], tile_height)) for row in rows
    ]
    width = max(tile.shape[0] * (tile.shape[2] + GAP_PX) - GAP_PX for tile in tiles) + 2 * MARGIN_PX
    width = max(width, min_width)
    blocks: list[Picture] = [blank(MARGIN_PX, width)]
    if title:
        blocks.append(text_strip(title, width, 30, size_px=19))
    if column_titles:
        tile_width = tiles[0].shape[2]
        strips = np.stack([text_strip(t, tile_width, 24, size_px=14, align="centre") for t in column_titles])
        blocks.append(pad(joined(strips), MARGIN_PX, width))
    for row, tile in zip(rows, tiles, strict=True):
        for text, height, size_px, ink in ((row.title, 22, 15, INK), (row.note, 18, 12, MUTED)):
            if text:
                strip = text_strip(text, width - 2 * MARGIN_PX + 12, height, size_px=size_px, ink=ink)
                blocks.append(pad(strip, MARGIN_PX - 6, width))
        blocks += [pad(joined(tile), MARGIN_PX, width), blank(10, width)]
    return np.concatenate(blocks, axis=0)


def joined(tiles: NDArray[np.uint8]) -> Picture:
    """Tiles `n h w 3` side by side with gaps of paper between them."""
    gap = np.full((tiles.shape[1], GAP_PX, 3), PAPER, dtype=np.uint8)
    pieces = [piece for tile in tiles for piece in (tile, gap)]
    return np.concatenate(pieces[:-1], axis=1)


def blank(height: int, width: int) -> Picture:
    """Empty paper."""
    return np.full((height, width, 3), PAPER, dtype=np.uint8)


def pad(picture: Picture, left: int, width: int) -> Picture:
    """The picture on paper of a given width, `left` pixels from the edge."""
    page = blank(picture.shape[0], width)
    page[:, left : left + picture.shape[1]] = picture[:, : width - left]
    return page


# Side-by-side videos: one clip by several methods, in step

LABEL_HEIGHT_PX = 40
COLUMN_GAP_PX = 6
STRIP_PAPER: Colour = (24, 26, 31)
STRIP_INK: Colour = (240, 240, 238)


@dataclass(frozen=True)
class WrittenVideo:
    """A video with its poster picture, and its size in pixels and frames."""

    video: Path
    poster: Path
    width: int
    height: int
    num_frames: int


def side_by_side(
    columns: Mapping[str, Frames], *, tile_height: int = 256, most: int | None = None
) -> Iterator[Picture]:
    """Pictures of labelled columns of frames `n h w 3`, one after the other.

    They end with the shortest column, so that no frozen picture looks like a prediction. ``most`` columns are in one line (default: all).

    Raises: ValueError: no columns, or an empty one.
    """
    if not columns or any(len(frames) == 0 for frames in columns.values()):
        raise ValueError("a side-by-side video needs at least one column, and frames in every column")
    first = next(iter(columns.values()))
    height, width = scaled_size(first.shape[1], first.shape[2], tile_height)
    size_px = 26 if width >= 360 else 19 if width >= 260 else 15
    ink = {"size_px": size_px, "ink": STRIP_INK, "paper": STRIP_PAPER}
    strips = {label: text_strip(label, width, LABEL_HEIGHT_PX, align="centre", **ink) for label in columns}
    line_length = min(most or len(columns), len(columns))
    tile = height + LABEL_HEIGHT_PX
    step = width + COLUMN_GAP_PX
    size = tile * -(-len(columns) // line_length), step * line_length - COLUMN_GAP_PX, 3

    def picture(frames: Mapping[str, Picture]) -> Picture:
        page = np.full(size, STRIP_PAPER, dtype=np.uint8)
        for place, (label, frame) in enumerate(frames.items()):
            top, left = tile * (place // line_length), step * (place % line_length)
            body = scale_frames(frame[None], (height, width))[0]
            page[top + tile - height : top + tile, left : left + width] = body
            page[top : top + LABEL_HEIGHT_PX, left : left + width] = strips[label]
        return page

    return map(picture, in_step(columns))


def write_side_by_side(
    path: Path, columns: Mapping[str, Frames], fps: float, *, tile_height: int = 256, most: int | None = None
) -> WrittenVideo:
    """Write labelled columns as `path` (mp4), and a poster JPEG of a moment after its middle beside it."""
    count, shown = min(map(len, columns.values()), default=0), list[Picture]()

    def watched() -> Iterator[Picture]:
        for number, frame in enumerate(side_by_side(columns, tile_height=tile_height, most=most)):
            if number == round(0.6 * (count - 1)):
                shown.append(frame)
            yield frame

    with atomic_path(path) as temporary:
        encode_video(temporary, watched(), fps, crf=20)
    poster = path.with_suffix(".jpg")
    write_bytes_atomic(poster, jpeg_bytes(shown[0]))
    return WrittenVideo(path, poster, width=shown[0].shape[1], height=shown[0].shape[0], num_frames=count)
