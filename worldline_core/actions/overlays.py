"""Overlays: action tracks drawn over frames, of one view or as a sheet of all views, with a legend.

Every picture of the project in which controls are drawn over a frame is drawn here: previews of `render_actions`, the report,
`worldline inspect`, Rerun layers and the pictures of `worldline calibrate check`.

What is drawn of an end-effector that is valid in a view (nothing is drawn of the others):

- heat, the first channel `h` of the action maps (paper, "Action rendering"), in the arm's colour;
- the tool's axes, 6 cm long, x red, y green, z blue, in perspective;
- a ring around the tool's centre, the wider the further the gripper is open.

Frames and tracks may differ in resolution: both are brought to the size of the picture. Pixel centres are at whole
numbers (`geometry.cameras`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from worldline_core.actions.action_maps import grid_sigma
from worldline_core.actions.actions_config import SIGMA_PX_REFERENCE
from worldline_core.actions.episode_tracks import EpisodeTracks
from worldline_core.actions.robot_masks import project_capsules
from worldline_core.errors import DataError
from worldline_core.geometry.cameras import Resize
from worldline_core.geometry.transforms import rotation_from_rot6d
from worldline_core.pages.page import words
from worldline_core.pictures import (
    INK,
    PAPER,
    Colour,
    Picture,
    SheetRow,
    contact_sheet,
    font,
    scale_frames,
    scaled_size,
    text_width_px,
)

ARM_COLOURS: dict[str, Colour] = {"left": (255, 150, 20), "right": (40, 150, 255)}
"""RGB. Orange and blue differ for every kind of colour vision."""
OTHER_ARM_COLOUR: Colour = (60, 200, 120)
AXIS_COLOURS: tuple[Colour, ...] = ((235, 50, 50), (50, 200, 70), (60, 100, 255))
AXIS_NAMES = ("x", "y", "z")
AXIS_LENGTH_M = 0.06
OUTLINE_COLOUR: Colour = (255, 255, 255)
SHADE: Colour = (20, 22, 26)
"""Under every line, so that it is seen on light and dark ground."""
TILE_HEIGHT = 256
LEGEND_HEIGHT_PX, LEGEND_TEXT_PX = 26, 13
_FRACTION_BITS = 4


@dataclass(frozen=True)
class OverlayStyle:
    """Choice of the drawn layers.

    Attributes:
        sigma_px_ref: of the heat, pixels on the 384 x 512 reference canvas.
        heat: opacity at the centre of the heat, 0 (none) .. 1.
        outline: also draw the outline of the robot's capsules, the arms as the kinematics place them.
    """

    sigma_px_ref: float = SIGMA_PX_REFERENCE
    heat: float = 0.6
    outline: bool = False


DEFAULT_STYLE = OverlayStyle()


def arm_colour(arms: Sequence[str], index: int) -> Colour:
    """Colour of an arm by its name: left orange, right blue, any other green."""
    return ARM_COLOURS.get(arms[index] if index < len(arms) else "", OTHER_ARM_COLOUR)


def gaussian(
    uv: NDArray[np.floating], height: int, width: int, sigma_px_ref: float = SIGMA_PX_REFERENCE
) -> NDArray[np.float32]:
    """`h(u) = exp(-|u - u_t|^2 / (2 sigma^2))` at `h w` pixel centres; sigma is given on the reference canvas.

    What `render_action_maps` puts into channel 0 on a grid of this size, for one arm and without torch.
    """
    sigma_v, sigma_u = grid_sigma((height, width), sigma_px_ref)
    rows = np.exp(-0.5 * ((np.arange(height) - float(uv[1])) / sigma_v) ** 2)
    columns = np.exp(-0.5 * ((np.arange(width) - float(uv[0])) / sigma_u) ** 2)
    return (rows[:, None] * columns[None, :]).astype(np.float32)


def draw_overlay(
    frame: Picture,
    tracks: EpisodeTracks,
    n: int,
    view: str,
    *,
    tile_height: int = TILE_HEIGHT,
    style: OverlayStyle = DEFAULT_STYLE,
) -> Picture:
    """Frame n of a view, enlarged (or reduced) for reading, with what the tracks say drawn over it.

    Args:
        frame: `h w 3` RGB of any resolution.
        tile_height: wanted height; small frames are enlarged by a whole factor to at most this.

    Raises:
        DataError: the tracks lack the view or the frame.
    """
    v = _view_index(tracks, n, view)
    size = scaled_size(frame.shape[0], frame.shape[1], tile_height)
    picture = scale_frames(frame[None], size)[0].copy()
    shown = [arm for arm in range(len(tracks.arms)) if tracks.valid[n, v, arm]]
    centres = {arm: picture_pixel(tracks.uv[n, v, arm], tracks.image_size, size) for arm in shown}
    for arm in shown if style.heat > 0 else ():
        heat = gaussian(centres[arm], *size, style.sigma_px_ref)[..., None] * style.heat
        picture = np.rint(picture * (1 - heat) + np.asarray(arm_colour(tracks.arms, arm)) * heat).astype(np.uint8)
    if style.outline:
        _draw_outline(picture, arm_mask(tracks, n, view, size))
    tips = axis_tips(tracks, n)[v]
    for arm in shown:
        _draw_axes(picture, centres[arm], tips[arm], tracks.image_size)
        _draw_ring(picture, centres[arm], float(tracks.gripper[n, v, arm]), arm_colour(tracks.arms, arm))
    return picture


def _view_index(tracks: EpisodeTracks, n: int, view: str) -> int:
    if view not in tracks.views or not 0 <= n < tracks.num_frames:
        raise DataError(
            "Nothing to draw: the tracks do not reach there",
            where=f"episode {tracks.episode_id}",
            expected=f"views {', '.join(tracks.views)}, frames 0..{tracks.num_frames - 1}",
            got=f"view {view}, frame {n}",
        )
    return tracks.views.index(view)


def picture_pixel(uv: NDArray[np.floating], image_size: tuple[int, int], size: tuple[int, int]) -> NDArray[np.float64]:
    """A pixel of an image of (height, width) in a picture of `size`."""
    affine = Resize(image_size, size).affine
    return np.asarray(uv, dtype=np.float64) * np.diagonal(affine)[:2] + affine[:2, 2]


def axis_tips(tracks: EpisodeTracks, n: int) -> NDArray[np.float64]:
    """Pixels (v, a, 3, 2) (of the tracks' image size) of the ends of all tools' axes; NaN for one that is behind the camera, and for
    tools that are not valid.
    """
    tips = np.full((*tracks.valid.shape[1:], 3, 2), np.nan)
    v, arm = np.nonzero(tracks.valid[n])
    K, uv = tracks.K[v].astype(np.float64), tracks.uv[n, v, arm].astype(np.float64)
    rays = np.linalg.solve(K, np.append(uv, np.ones((len(uv), 1)), axis=1)[..., None])[..., 0]
    origins = rays * tracks.depth[n, v, arm].astype(np.float64)[:, None]
    ends = origins[:, None] + AXIS_LENGTH_M * np.swapaxes(rotation_from_rot6d(tracks.rot6d[n, v, arm]), -1, -2)
    ahead = ends[..., 2:] > 1e-3
    pixels = (ends / np.where(ahead, ends[..., 2:], 1.0)) @ np.swapaxes(K, -1, -2)
    tips[v, arm] = np.where(ahead, pixels[..., :2], np.nan)
    return tips


def _fixed_point(point: NDArray[np.float64]) -> tuple[int, int]:
    """A point in OpenCV's fixed-point form; what is far outside of any picture is brought nearer."""
    u, v = np.clip(point, -1e4, 1e4) * (1 << _FRACTION_BITS)
    return round(float(u)), round(float(v))


def _line_widths(height: int) -> tuple[int, int]:
    """Widths [px] of a line that is readable in a picture of this height, and of the dark line under it."""
    width = max(1, round(height / 150))
    # In a small picture a wide shade would be all that is seen.
    return width, width + (2 if height >= 200 else 1)


def _draw_axes(
    picture: Picture,
    centre: NDArray[np.float64],
    tips: NDArray[np.float64],
    image_size: tuple[int, int],
) -> None:
    size = (picture.shape[0], picture.shape[1])
    width, shade = _line_widths(size[0])
    start = _fixed_point(centre)
    ends = [None if np.isnan(tip).any() else _fixed_point(picture_pixel(tip, image_size, size)) for tip in tips]
    for colours, thickness in (((SHADE,) * 3, shade), (AXIS_COLOURS, width)):
        for end, colour in zip(ends, colours, strict=True):
            if end is not None:
                cv2.line(picture, start, end, colour, thickness, cv2.LINE_AA, _FRACTION_BITS)


def _draw_ring(picture: Picture, centre: NDArray[np.float64], opening: float, colour: Colour) -> None:
    height = picture.shape[0]
    width, shade = _line_widths(height)
    radius = round(height * (0.018 + 0.032 * float(np.clip(opening, 0.0, 1.0))) * (1 << _FRACTION_BITS))
    dot = width << _FRACTION_BITS
    for size, drawn, thickness in (
        (radius, SHADE, shade),
        (radius, colour, width),
        (dot + (1 << _FRACTION_BITS), SHADE, -1),
        (dot, (255, 255, 255), -1),
    ):
        cv2.circle(picture, _fixed_point(centre), size, drawn, thickness, cv2.LINE_AA, _FRACTION_BITS)


def arm_mask(tracks: EpisodeTracks, n: int, view: str, size: tuple[int, int]) -> NDArray[np.bool_]:
    """Mask of the robot's capsules in a view: bool `h w` of `size`."""
    v = _view_index(tracks, n, view)
    covered = project_capsules(
        torch.from_numpy(tracks.capsules[None, [n]]),
        torch.from_numpy(tracks.capsule_radii[None]),
        torch.from_numpy(tracks.K[None, [v]]),
        torch.from_numpy(tracks.T_base_camera[None, [n]][:, :, [v]]),
        tracks.image_size,
        size,
    )
    return covered[0, 0, 0].numpy()


def _draw_outline(picture: Picture, mask: NDArray[np.bool_]) -> None:
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    width, shade = _line_widths(picture.shape[0])
    cv2.drawContours(picture, contours, -1, SHADE, shade, cv2.LINE_AA)
    cv2.drawContours(picture, contours, -1, OUTLINE_COLOUR, width, cv2.LINE_AA)


def heat_layer(
    tracks: EpisodeTracks, n: int, view: str, size: tuple[int, int], sigma_px_ref: float = SIGMA_PX_REFERENCE
) -> NDArray[np.uint8]:
    """Every valid arm's Gaussian as one RGBA picture `h w 4`, transparent where there is no heat."""
    v = _view_index(tracks, n, view)
    colour = np.zeros((*size, 3), dtype=np.float32)
    alpha = np.zeros((*size, 1), dtype=np.float32)
    for arm in range(len(tracks.arms)):
        if tracks.valid[n, v, arm]:
            centre = picture_pixel(tracks.uv[n, v, arm], tracks.image_size, size)
            heat = gaussian(centre, *size, sigma_px_ref)[..., None]
            colour += heat * np.asarray(arm_colour(tracks.arms, arm), dtype=np.float32)
            alpha += heat
    shown = np.concatenate([colour / np.maximum(alpha, 1e-6), 200.0 * np.minimum(alpha, 1.0)], axis=-1)
    return np.clip(shown, 0, 255).astype(np.uint8)


def legend_strip(arms: Sequence[str], width: int, *, outline: bool = False) -> Picture:
    """A strip that says what is drawn: arms, axes, ring, outline. Entries that do not fit the width are left out from the end."""
    strip = Image.new("RGB", (width, LEGEND_HEIGHT_PX), PAPER)
    draw = ImageDraw.Draw(strip)
    middle, x = LEGEND_HEIGHT_PX / 2, 8.0
    marks: list[tuple[str, int, Colour]] = []
    items = [(f"{arm} tool", arm_colour(arms, index), "dot") for index, arm in enumerate(arms)]
    items += [(name, colour, "line") for name, colour in zip(AXIS_NAMES, AXIS_COLOURS, strict=True)]
    items += [("wide ring: gripper open", INK, "ring")]
    items += [("where the arms should be", OUTLINE_COLOUR, "outline")] if outline else []
    for text, colour, mark in items:
        needed = 20 + text_width_px(text, LEGEND_TEXT_PX) + 14
        if x + needed > width - 8:
            break
        draw.text((x + 20, middle), text, font=font(LEGEND_TEXT_PX), fill=INK, anchor="lm")
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


def overlay_sheet(
    frames: Mapping[str, NDArray[np.uint8]],
    tracks: EpisodeTracks,
    moments: Sequence[int],
    *,
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
        shown = zip(frames[view], moments, strict=True)
        drawn = [draw_overlay(frame, tracks, n, view, style=style) for frame, n in shown]
        seen = int(tracks.valid[:, position].any(axis=-1).sum())
        text = f"{words(view)}  ·  a tool is in view in {seen} of {tracks.num_frames} frames"
        rows.append(SheetRow(text, np.stack(drawn)))
    if not rows:
        raise DataError("The episode has no view with a track", where=f"episode {tracks.episode_id}")
    sheet = contact_sheet(rows, tile_height=TILE_HEIGHT, title=title, column_titles=[f"frame {n}" for n in moments])
    return np.concatenate([sheet, legend_strip(tracks.arms, sheet.shape[1], outline=style.outline)], axis=0)
