"""Contact sheets, rows of labelled pictures on one page; and strips: moments of a clip, what the filters keep and drop along
time, and what a detector measured. For the report and for `worldline inspect`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from worldline_core.pictures.labels import (
    INK,
    MUTED,
    PAPER,
    Picture,
    Upscale,
    font,
    scale_frames,
    scaled_size,
    text_strip,
)

GAP_PX, MARGIN_PX = 4, 12


@dataclass(frozen=True)
class SheetRow:
    """One row of a sheet: a title, an optional second line in grey, and pictures of one size."""

    title: str
    frames: NDArray[np.uint8]
    """`n h w 3`"""
    note: str = ""


def evenly_spaced(count: int, wanted: int) -> list[int]:
    """Indices of `wanted` frames spread over a clip, the first and the last among them."""
    if count <= 0:
        return []
    return [round(i) for i in np.linspace(0, count - 1, min(wanted, count))]


def contact_sheet(
    rows: Sequence[SheetRow],
    *,
    tile_height: int = 128,
    title: str | None = None,
    column_titles: Sequence[str] = (),
    upscale: Upscale = "lanczos",
    min_width: int = 0,
) -> Picture:
    """Composes labelled rows into one picture.

    Args:
        rows: at least one row; rows may differ in length and in picture size.
        tile_height: height of a tile; small frames are enlarged by a whole factor to at most this.
        title: a heading over the sheet.
        column_titles: headings over the columns.
        min_width: of the sheet, for titles that few tiles have no room for.

    Raises:
        ValueError: no rows, or a row without pictures.
    """
    if not rows or any(row.frames.shape[0] == 0 for row in rows):
        raise ValueError("a contact sheet needs at least one row, and at least one picture in every row")
    tiles = [
        scale_frames(row.frames, scaled_size(row.frames.shape[1], row.frames.shape[2], tile_height), upscale)
        for row in rows
    ]
    width = max(tile.shape[0] * (tile.shape[2] + GAP_PX) - GAP_PX for tile in tiles) + 2 * MARGIN_PX
    width = max(width, min_width)
    blocks: list[Picture] = [blank(MARGIN_PX, width)]
    if title:
        blocks.append(text_strip(title, width, 30, size_px=19))
    if column_titles:
        tile_width = tiles[0].shape[2]
        strips = np.stack([text_strip(t, tile_width, 24, size_px=14, align="centre") for t in column_titles])
        blocks.append(pad(joined(strips, GAP_PX), MARGIN_PX, width))
    for row, tile in zip(rows, tiles, strict=True):
        for text, height, size_px, ink in ((row.title, 22, 15, INK), (row.note, 18, 12, MUTED)):
            if text:
                strip = text_strip(text, width - 2 * MARGIN_PX + 12, height, size_px=size_px, ink=ink)
                blocks.append(pad(strip, MARGIN_PX - 6, width))
        blocks += [pad(joined(tile, GAP_PX), MARGIN_PX, width), blank(10, width)]
    return np.concatenate(blocks, axis=0)


def joined(tiles: NDArray[np.uint8], gap_px: int) -> Picture:
    """Tiles `n h w 3` side by side with a gap of paper between them."""
    gap = np.full((tiles.shape[1], gap_px, 3), PAPER, dtype=np.uint8)
    pieces = [piece for tile in tiles for piece in (tile, gap)]
    return np.concatenate(pieces[:-1], axis=1)


def blank(height: int, width: int) -> Picture:
    """Empty paper."""
    return np.full((height, width, 3), PAPER, dtype=np.uint8)


def pad(picture: Picture, left: int, width: int) -> Picture:
    """The picture on paper of a given width, `left` pixels from the edge."""
    page = blank(picture.shape[0], width)
    shown = picture[:, : width - left]
    page[:, left : left + shown.shape[1]] = shown
    return page


Colour = tuple[int, int, int]

KEPT_COLOUR: Colour = (46, 150, 92)
REASON_COLOURS: dict[str, Colour] = {
    "static": (120, 126, 138),
    "reset": (31, 95, 191),
    "corrupted": (179, 55, 47),
    "base_motion": (217, 102, 11),
    "too_dark": (40, 42, 52),
    "overexposed": (214, 176, 30),
    "blur": (15, 139, 160),
    "joint_jump": (160, 60, 140),
    "joint_speed": (110, 70, 190),
    "lost_with_them": (202, 204, 210),
}
OTHER_COLOUR: Colour = (141, 111, 0)
"""Of reasons that concern a whole episode and of those that other people add."""
_MARGIN, _GAP, _BAND, _CURVE, _LABEL = 12, 4, 12, 76, 18


def reason_colour(reason: str) -> Colour:
    """The colour of a reason in strips and recordings."""
    return REASON_COLOURS.get(reason, OTHER_COLOUR)


@dataclass(frozen=True)
class ClipStrip:
    """What is drawn.

    Attributes:
        frames: (m, H, W, 3) moments, at frame numbers `moments` of `count`.
        dropped: by reason, bool (count,) frames.
        curve: (count,) values of a detector with its name and threshold; None for none.
    """

    title: str
    note: str
    frames: NDArray[np.uint8]
    moments: Sequence[int]
    count: int
    dropped: dict[str, NDArray[np.bool_]] = field(default_factory=dict)
    curve: tuple[str, NDArray[np.floating], float] | None = None
    fps: float = 1.0


def clip_strip(strip: ClipStrip, *, tile_height: int = 96) -> Picture:
    """Composes one strip; each moment is framed in the colour of what became of it."""
    tiles = scale_frames(
        strip.frames, scaled_size(strip.frames.shape[1], strip.frames.shape[2], tile_height), "lanczos"
    ).copy()
    for tile, moment in zip(tiles, strip.moments, strict=True):
        colour = next((reason_colour(r) for r, flags in strip.dropped.items() if flags[moment]), KEPT_COLOUR)
        tile[:4], tile[-4:], tile[:, :4], tile[:, -4:] = colour, colour, colour, colour
    row = joined(tiles, _GAP)
    width = row.shape[1] + 2 * _MARGIN
    blocks = [text_strip(strip.title, width, 24, size_px=15)]
    if strip.note:
        blocks.append(text_strip(strip.note, width, 18, size_px=12, ink=MUTED))
    blocks += [pad(row, _MARGIN, width), blank(3, width), pad(_bands(strip, row.shape[1]), _MARGIN, width)]
    if strip.curve is not None:
        blocks += [blank(3, width), pad(_curve(strip.curve, strip.count, row.shape[1]), _MARGIN, width)]
    return np.concatenate([*blocks, blank(12, width)], axis=0)


def stacked(pictures: Sequence[Picture]) -> Picture:
    """Pictures below each other, the narrower ones on paper."""
    width = max(picture.shape[1] for picture in pictures)
    return np.concatenate([pad(picture, 0, width) for picture in pictures], axis=0)


def _bands(strip: ClipStrip, width: int) -> Picture:
    """Along time: green where kept, a band of its own colour for each reason where dropped."""
    reasons = [reason for reason, flags in strip.dropped.items() if flags.any()]
    height = _BAND + max(0, len(reasons) - 1) * (_BAND // 2)
    canvas = Image.new("RGB", (width, height), PAPER)
    draw = ImageDraw.Draw(canvas)
    draw.rectangle((0, 0, width, _BAND - 1), fill=KEPT_COLOUR)
    for number, reason in enumerate(reasons):
        top = _BAND + (number - 1) * (_BAND // 2) + 1
        for i in np.flatnonzero(strip.dropped[reason]):
            left, right = i * width / strip.count, (i + 1) * width / strip.count - 1
            draw.rectangle((left, 0, right, _BAND - 1), fill=reason_colour(reason))
            if number:
                draw.rectangle((left, top, right, top + _BAND // 2 - 2), fill=reason_colour(reason))
    for moment in strip.moments:
        x = (moment + 0.5) * width / strip.count
        draw.line((x, _BAND - 4, x, _BAND - 1), fill=(255, 255, 255), width=2)
    return np.asarray(canvas, dtype=np.uint8)


def _curve(curve: tuple[str, NDArray[np.floating], float], count: int, width: int) -> Picture:
    """The measured values along time with the threshold as a dashed line."""
    name, values, threshold = curve
    low, high = min(0.0, float(values.min())), max(float(values.max()), 1.15 * threshold)
    high = min(high, 6 * threshold) if threshold > 0 else high
    span = max(high - low, 1e-9)
    canvas = Image.new("RGB", (width, _CURVE), (255, 255, 255))
    draw = ImageDraw.Draw(canvas)

    def y(value: float) -> float:
        return _CURVE - 4 - (min(value, high) - low) / span * (_CURVE - _LABEL - 8)

    points = [((i + 0.5) * width / count, y(float(value))) for i, value in enumerate(values)]
    for x in range(0, width, 12):
        draw.line((x, y(threshold), x + 6, y(threshold)), fill=(179, 55, 47), width=1)
    if len(points) > 1:
        draw.line(points, fill=INK, width=2, joint="curve")
    draw.text((6, 3), f"{name.replace('_', ' ')}; dashed: threshold {threshold:.3g}", font=font(12), fill=MUTED)
    draw.rectangle((0, 0, width - 1, _CURVE - 1), outline=(220, 217, 208))
    return np.asarray(canvas, dtype=np.uint8)
