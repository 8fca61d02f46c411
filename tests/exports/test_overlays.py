"""Drawings: overlays, their places and colours; sheets and side-by-side videos."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from tests.exports.conftest import CAMERA_MATRIX, HEIGHT, WIDTH, tracks_of  # pyright: ignore[reportMissingImports]
from worldline_core.actions.action_maps import render_action_maps
from worldline_core.actions.episode_tracks import EpisodeTracks, collate_tracks
from worldline_core.actions.overlays import (
    ARM_COLOURS,
    AXIS_COLOURS,
    LEGEND_HEIGHT_PX,
    OverlayStyle,
    arm_mask,
    axis_tips,
    draw_overlay,
    gaussian,
    legend_strip,
    overlay_sheet,
    picture_pixel,
)
from worldline_core.data.video.clip import decode_video
from worldline_core.errors import DataError
from worldline_core.pictures import (
    COLUMN_GAP_PX,
    LABEL_HEIGHT_PX,
    SheetRow,
    contact_sheet,
    evenly_spaced,
    scaled_size,
    side_by_side,
    write_side_by_side,
)

GREY = 90
NO_HEAT = OverlayStyle(heat=0.0)


def grey(count: int) -> np.ndarray:
    return np.full((count, HEIGHT, WIDTH, 3), GREY, dtype=np.uint8)


FRAME = grey(1)[0]


def one_arm(u: float = 24, v: float = 16, gripper: float = 1.0, valid: bool = True) -> EpisodeTracks:
    return tracks_of(np.array([[[[u, v]]]]), np.array([[[valid]]]), gripper, views=("head",))


def two_arms(
    left: tuple[float, float], right: tuple[float, float], valid: tuple[bool, bool], **more: float
) -> EpisodeTracks:
    return tracks_of(np.array([[[left, right]]]), np.array([[valid]]), views=("head",), **more)


def changed(picture: np.ndarray) -> np.ndarray:
    return (picture != GREY).any(axis=-1)


def near(picture: np.ndarray, colour: tuple[int, int, int], tolerance: int = 40) -> np.ndarray:
    return np.all(np.abs(picture.astype(int) - colour) <= tolerance, axis=-1)


def test_heat_is_channel_zero_of_the_action_maps() -> None:
    tracks = two_arms((13.25, 9.5), (40.0, 30.5), (True, True))
    maps = render_action_maps(collate_tracks([tracks]), (HEIGHT, WIDTH), (HEIGHT, WIDTH), 20.0, dtype=torch.float64)
    both = sum(gaussian(tracks.uv[0, 0, arm], HEIGHT, WIDTH, 20.0) for arm in (0, 1))
    assert np.abs(maps[0, 0, 0, 0].numpy() - both).max() < 1e-6


def test_a_pixel_keeps_its_place_in_an_enlarged_picture() -> None:
    # The image's corners (half a pixel outside of the outermost centres) stay the picture's corners.
    assert np.allclose(picture_pixel(np.array([-0.5, -0.5]), (HEIGHT, WIDTH), (256, 384)), [-0.5, -0.5])
    corner = picture_pixel(np.array([WIDTH - 0.5, HEIGHT - 0.5]), (HEIGHT, WIDTH), (256, 384))
    assert np.allclose(corner, [383.5, 255.5])


def test_what_is_not_valid_is_not_drawn() -> None:
    assert np.array_equal(draw_overlay(FRAME, one_arm(valid=False), 0, "head", tile_height=HEIGHT), FRAME)
    tracks = two_arms((10.0, 16.0), (40.0, 16.0), (True, False))
    drawn = changed(draw_overlay(FRAME, tracks, 0, "head", tile_height=128))
    assert drawn[:, :80].any()
    assert not drawn[:, 120:].any()
    with pytest.raises(DataError, match=r"(?s)do not reach there.*view left_wrist, frame 0"):
        draw_overlay(FRAME, tracks, 0, "left_wrist")
    with pytest.raises(DataError, match=r"(?s)frames 0\.\.0.*frame 1"):
        draw_overlay(FRAME, tracks, 1, "head")


@pytest.mark.parametrize(("arm", "other"), [("left", "right"), ("right", "left")])
def test_rings_have_the_arm_s_colour_and_lie_around_the_tool(arm: str, other: str) -> None:
    def radii(gripper: float) -> np.ndarray:
        """Distances of the ring's pixels from the tool."""
        tracks = two_arms((16.0, 16.0), (16.0, 16.0), (arm == "left", arm == "right"), gripper=gripper)
        picture = draw_overlay(FRAME, tracks, 0, "head", tile_height=256, style=NO_HEAT)
        assert not near(picture, ARM_COLOURS[other], 20).any()
        rows, columns = np.nonzero(near(picture, ARM_COLOURS[arm]))
        u, v = picture_pixel(np.array([16.0, 16.0]), (HEIGHT, WIDTH), (256, 384))
        return np.hypot(columns - u, rows - v)

    closed, half, wide = (radii(gripper) for gripper in (0.0, 0.5, 1.0))
    assert len(closed) > 10
    assert closed.max() < 12
    assert np.median(closed) < np.median(half) < np.median(wide)
    assert np.array_equal(radii(7.0), wide)


def test_axes_end_where_the_camera_puts_them() -> None:
    tracks = one_arm()
    tips = axis_tips(tracks, 0)[0, 0]
    origin = np.linalg.inv(CAMERA_MATRIX) @ [24, 16, 1] * 0.8
    for tip, direction in zip(tips, 0.06 * np.eye(3), strict=True):
        expected = CAMERA_MATRIX @ (origin + direction)
        assert np.allclose(tip, expected[:2] / expected[2], atol=1e-4)
    picture = draw_overlay(FRAME, tracks, 0, "head", tile_height=256, style=NO_HEAT)
    u, v = np.rint(picture_pixel(np.array(tips[0]), (HEIGHT, WIDTH), (256, 384))).astype(int)
    assert near(picture, AXIS_COLOURS[0])[v - 2 : v + 3, u - 4 : u + 1].any()
    tracks.rot6d[..., :3], tracks.rot6d[..., 3:] = (0, 0, -1), (0, 1, 0)  # x points at the camera and ends behind it
    tracks.depth[:] = 0.05
    assert np.isnan(axis_tips(tracks, 0)[0, 0]).any(axis=-1).tolist() == [True, False, False]
    assert changed(draw_overlay(FRAME, tracks, 0, "head")).any()


def test_large_frames_are_reduced_and_small_ones_enlarged_by_a_whole_factor() -> None:
    tracks = one_arm()
    assert draw_overlay(FRAME, tracks, 0, "head", tile_height=250).shape == (224, 336, 3)
    frames = (FRAME, np.full((640, 960, 3), GREY, dtype=np.uint8))
    small, large = (draw_overlay(f, tracks, 0, "head", tile_height=256, style=NO_HEAT) for f in frames)
    assert large.shape == (256, 384, 3)
    assert np.array_equal(changed(large), changed(small))


def test_the_outline_encloses_the_capsule() -> None:
    tracks = one_arm(valid=False)
    # The capsule spans -0.1..0.1 m at 0.8 m with radius 0.05: 8 by 40 * 0.3 / 0.8 = 15 pixels wide, times 8.
    rows, columns = np.nonzero(arm_mask(tracks, 0, "head", (256, 384)))
    assert np.ptp(columns) == pytest.approx(8 * 40 * 0.3 / 0.8, abs=3)
    assert np.ptp(rows) == pytest.approx(8 * 41 * 0.1 / 0.8, abs=3)
    assert not changed(draw_overlay(FRAME, tracks, 0, "head", style=OverlayStyle())).any()
    outlined = draw_overlay(FRAME, tracks, 0, "head", style=OverlayStyle(outline=True))
    drawn = np.nonzero(near(outlined, (255, 255, 255), 20))[1]
    assert abs(drawn.min() - columns.min()) <= 3
    assert abs(drawn.max() - columns.max()) <= 3


MOVING = tracks_of(np.full((4, 3, 1, 2), 16.0) + np.arange(4).reshape(4, 1, 1, 1) * (1, 0), np.ones((4, 3, 1), bool))
"""One arm that moves to the right in every view."""


def test_a_sheet_has_a_row_for_each_view() -> None:
    frames = dict.fromkeys(("head", "right_wrist"), grey(2))
    plain, outlined = (overlay_sheet(frames, MOVING, [0, 3], style=OverlayStyle(outline=outline)) for outline in (False, True))  # fmt: skip
    assert plain.shape == outlined.shape
    assert plain.shape[0] > 2 * 256 + LEGEND_HEIGHT_PX
    with pytest.raises(DataError, match="no view with a track"):
        overlay_sheet({"top": grey(2)}, MOVING, [0, 3])


def test_the_legend_names_every_arm_that_fits() -> None:
    wide, narrow = (legend_strip(("left", "right"), width) for width in (900, 100))
    assert wide.shape == (LEGEND_HEIGHT_PX, 900, 3)
    for strip, shown in ((wide, True), (narrow, False)):
        assert near(strip, ARM_COLOURS["left"], 5).any()
        assert near(strip, ARM_COLOURS["right"], 5).any() == shown


def clip(count: int, value: int, size: tuple[int, int] = (64, 96)) -> np.ndarray:
    return np.full((count, *size, 3), value, dtype=np.uint8)


def test_display_sizes_are_even_and_fit_and_spaced_frames_hold_both_ends() -> None:
    for size, expected in (((64, 96), (256, 384)), ((480, 640), (256, 342)), ((300, 301), (256, 258))):
        assert scaled_size(*size, 256) == expected
    assert scaled_size(63, 95, 64) == (64, 96)
    for count, spaced in ((33, [0, 8, 16, 24, 32]), (2, [0, 1]), (0, [])):
        assert evenly_spaced(count, 5) == spaced


def test_contact_sheet_holds_every_picture() -> None:
    rows = [SheetRow("first", clip(3, 200), "note"), SheetRow("second", clip(2, 90, (32, 32)))]
    sheet = contact_sheet(rows, tile_height=64, title="sheet", column_titles=["a", "b", "c"])
    assert (sheet == 200).all(axis=-1).sum() == 3 * 64 * 96
    assert (sheet == 90).all(axis=-1).sum() == 2 * 64 * 64
    assert np.array_equal(sheet, contact_sheet(rows, tile_height=64, title="sheet", column_titles=["a", "b", "c"]))
    with pytest.raises(ValueError, match="at least one row"):
        contact_sheet([])


def test_columns_stay_in_step_and_end_with_the_shortest(tmp_path: Path) -> None:
    columns = {"true": clip(9, 10), "Stage II": clip(5, 20), "causal": clip(7, 30, (32, 48))}
    frames = np.stack(list(side_by_side(columns, tile_height=64)))
    assert frames.shape == (5, 64 + LABEL_HEIGHT_PX, 3 * 96 + 2 * COLUMN_GAP_PX, 3)
    body = frames[:, LABEL_HEIGHT_PX:]
    starts = (0, 96 + COLUMN_GAP_PX, 2 * (96 + COLUMN_GAP_PX))
    assert [int(body[:, :, start : start + 96].mean()) for start in starts] == [10, 20, 30]
    one, two = (write_side_by_side(tmp_path / name, columns, 8.0, tile_height=64) for name in ("a.mp4", "b.mp4"))
    assert one.video.read_bytes() == two.video.read_bytes()
    assert np.abs(decode_video(one.video).astype(int) - frames).mean() < 3
    assert cv2.imread(str(one.poster)).shape == frames[0].shape
    with pytest.raises(ValueError, match="at least one column"):
        side_by_side({})
