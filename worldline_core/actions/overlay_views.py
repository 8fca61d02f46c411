"""Overlays of all views together: a clip, a video and a sheet, with view names, frame numbers and a legend."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from worldline_core.actions.episode_tracks import EpisodeTracks
from worldline_core.actions.overlays import (
    AXIS_COLOURS,
    AXIS_NAMES,
    DEFAULT_STYLE,
    OUTLINE_COLOUR,
    SHADE,
    TILE_HEIGHT,
    Colour,
    OverlayStyle,
    arm_colour,
    draw_overlay,
)  # fmt: skip
from worldline_core.data.video.encoder import encode_video
from worldline_core.data.video.frames import Frames, in_step
from worldline_core.errors import DataError
from worldline_core.pictures import (
    COLUMN_GAP_PX,
    INK,
    PAPER,
    STRIP_INK,
    STRIP_PAPER,
    Picture,
    SheetRow,
    contact_sheet,
    font,
    text_strip,
    text_width_px,
)
from worldline_core.store.atomic import atomic_path

HEADING_HEIGHT_PX = 28
LEGEND_HEIGHT_PX = 26


def view_name(view: str) -> str:
    """A view as people read it: "left wrist"."""
    return view.replace("_", " ")


def legend_strip(
    arms: Sequence[str],
    width: int,
    *,
    note: str = "",
    outline: bool = False,
    ink: Colour = INK,
    paper: Colour = PAPER,
    size_px: int = 13,
) -> Picture:
    """A strip that says what is drawn: arms, axes, ring, outline; and a note (a frame number) at its right end.

    What does not fit the width is left out from the end, the note never.
    """
    strip = Image.new("RGB", (width, LEGEND_HEIGHT_PX), paper)
    draw = ImageDraw.Draw(strip)
    middle, x = LEGEND_HEIGHT_PX / 2, 8.0
    end = width - 8 - (text_width_px(note, size_px) if note else 0)
    if note:
        draw.text((end, middle), note, font=font(size_px), fill=ink, anchor="lm")
    marks: list[tuple[str, int, Colour]] = []
    items = [(f"{arm} tool", arm_colour(arms, index), "dot") for index, arm in enumerate(arms)]
    items += [(name, colour, "line") for name, colour in zip(AXIS_NAMES, AXIS_COLOURS, strict=True)]
    items += [("wide ring: gripper open", ink, "ring")]
    items += [("where the arms should lie", OUTLINE_COLOUR, "outline")] if outline else []
    for text, colour, mark in items:
        needed = 20 + text_width_px(text, size_px) + 14
        if x + needed > end:
            break
        draw.text((x + 20, middle), text, font=font(size_px), fill=ink, anchor="lm")
        marks.append((mark, round(x), colour))
        x += needed
    picture = np.array(strip, dtype=np.uint8)
    centre = LEGEND_HEIGHT_PX // 2
    for mark, left, colour in marks:
        if mark == "outline":
            cv2.line(picture, (left, centre), (left + 14, centre), SHADE, 5, cv2.LINE_AA)
        if mark in ("line", "outline"):
            cv2.line(picture, (left, centre), (left + 14, centre), colour, 3, cv2.LINE_AA)
        else:
            cv2.circle(picture, (left + 7, centre), 6, colour, -1 if mark == "dot" else 2, cv2.LINE_AA)
    return picture


def overlay_clip(
    frames: Mapping[str, Frames],
    tracks: EpisodeTracks,
    fps: float,
    *,
    tile_height: int = TILE_HEIGHT,
    style: OverlayStyle = DEFAULT_STYLE,
    title: str = "",
) -> Iterator[Picture]:
    """All views side by side, from the first frame on, as long as every view and the tracks have frames.

    Args:
        frames: by view, `n h w 3` RGB; views that are missing are left out.
        title: shown with the name of the first view.

    Returns: pictures (H, W, 3) one after the other, H and W even.

    Raises:
        DataError: the tracks have none of these views.
    """
    shown = {view: frames[view] for view in tracks.views if view in frames}
    if not shown:
        raise DataError(
            "No view to draw",
            where=f"episode {tracks.episode_id}",
            expected=", ".join(tracks.views),
            got=", ".join(frames) or "no frames",
        )
    headings: dict[str, Picture] = {}

    def picture(n: int, pictures: Mapping[str, Picture]) -> Picture:
        tiles = {
            view: draw_overlay(frame, tracks, n, view, tile_height=tile_height, style=style)
            for view, frame in pictures.items()
        }
        height = HEADING_HEIGHT_PX + max(tile.shape[0] for tile in tiles.values())
        columns: list[Picture] = []
        for view, tile in tiles.items():
            if view not in headings:
                name = view_name(view) + (f"  ·  {title}" if title and not headings else "")
                headings[view] = text_strip(name, tile.shape[1], HEADING_HEIGHT_PX, ink=STRIP_INK, paper=STRIP_PAPER)
            below = _blank(height - HEADING_HEIGHT_PX - tile.shape[0], tile.shape[1])
            columns += [np.concatenate([headings[view], tile, below], axis=0), _blank(height, COLUMN_GAP_PX)]
        row = np.concatenate(columns[:-1], axis=1)
        legend = legend_strip(
            tracks.arms,
            row.shape[1],
            note=f"frame {n}  ·  {n / fps:.2f} s",
            outline=style.outline,
            ink=STRIP_INK,
            paper=STRIP_PAPER,
        )
        whole = np.concatenate([row, legend], axis=0)
        return np.ascontiguousarray(whole[: whole.shape[0] // 2 * 2, : whole.shape[1] // 2 * 2])

    return map(picture, range(tracks.num_frames), in_step(shown))


def _blank(height: int, width: int) -> Picture:
    return np.full((height, width, 3), STRIP_PAPER, dtype=np.uint8)


def write_overlay_video(
    path: Path,
    frames: Mapping[str, Frames],
    tracks: EpisodeTracks,
    fps: float,
    *,
    tile_height: int = TILE_HEIGHT,
    style: OverlayStyle = DEFAULT_STYLE,
    title: str = "",
) -> None:
    """Writes `overlay_clip` as an mp4 that browsers play, atomically; the bytes depend on the arguments alone."""
    clip = overlay_clip(frames, tracks, fps, tile_height=tile_height, style=style, title=title)
    with atomic_path(path) as temporary:
        encode_video(temporary, clip, fps, crf=20, preset="veryfast")


def overlay_sheet(
    frames: Mapping[str, NDArray[np.uint8]],
    tracks: EpisodeTracks,
    moments: Sequence[int],
    *,
    tile_height: int = TILE_HEIGHT,
    style: OverlayStyle = DEFAULT_STYLE,
    title: str | None = None,
) -> Picture:
    """A sheet with a row per view, a column per moment, and a legend.

    Args:
        frames: by view, `m h w 3` RGB, the frames at the moments.
        moments: m frame numbers of the tracks.

    Raises:
        DataError: the tracks have none of these views.
    """
    rows: list[SheetRow] = []
    for position, view in enumerate(tracks.views):
        if view not in frames:
            continue
        drawn = [
            draw_overlay(frame, tracks, n, view, tile_height=tile_height, style=style)
            for frame, n in zip(frames[view], moments, strict=True)
        ]
        seen = int(tracks.valid[:, position].any(axis=-1).sum())
        text = f"{view_name(view)}  ·  a tool is in view in {seen} of {tracks.num_frames} frames"
        rows.append(SheetRow(text, np.stack(drawn)))
    if not rows:
        raise DataError("The episode has no view with a track", where=f"episode {tracks.episode_id}")
    sheet = contact_sheet(rows, tile_height=tile_height, title=title, column_titles=[f"frame {n}" for n in moments])
    return np.concatenate([sheet, legend_strip(tracks.arms, sheet.shape[1], outline=style.outline)], axis=0)
