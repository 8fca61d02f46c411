"""Contact sheets: rows of labelled pictures on one page, for the report and for `worldline inspect`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from worldline_core.pictures.labels import INK, MUTED, PAPER, Picture, Upscale, scale_frames, scaled_size, text_strip

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
