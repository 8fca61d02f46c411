"""The drawer of overlays: what is drawn, where, in which colour; and that nothing is drawn of what is not valid."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from worldline_core.actions.action_maps import render_action_maps
from worldline_core.actions.episode_tracks import collate_tracks
from worldline_core.actions.overlays import (
    ARM_COLOURS,
    AXIS_COLOURS,
    LEGEND_HEIGHT_PX,
    OverlayStyle,
    arm_mask,
    axis_tips,
    draw_overlay,
    gaussian,
    heat_layer,
    legend_strip,
    overlay_clip,
    overlay_sheet,
    picture_pixel,
    write_overlay_video,
)
from worldline_core.data.video.clip import decode_video
from worldline_core.errors import DataError
from worldline_core.pictures import COLUMN_GAP_PX, LABEL_HEIGHT_PX, text_width_px

HEIGHT, WIDTH = 32, 48
"""As `conftest` makes tracks."""
GREY = 90
NO_HEAT = OverlayStyle(heat=0.0)


def grey(count: int | None = None) -> np.ndarray:
    shape = (HEIGHT, WIDTH, 3) if count is None else (count, HEIGHT, WIDTH, 3)
    return np.full(shape, GREY, dtype=np.uint8)


@pytest.fixture
def one_arm(hand_tracks):
    def make(u: float, v: float, gripper: float = 1.0, valid: bool = True):
        return hand_tracks(np.array([[[[u, v]]]]), np.array([[[valid]]]), gripper, views=("head",))

    return make


def changed(picture: np.ndarray) -> np.ndarray:
    return (picture != GREY).any(axis=-1)


def near(picture: np.ndarray, colour: tuple[int, int, int], tolerance: int = 40) -> np.ndarray:
    return np.all(np.abs(picture.astype(int) - colour) <= tolerance, axis=-1)


def test_heat_is_channel_zero_of_the_action_maps(hand_tracks) -> None:
    uv = np.array([[[[13.25, 9.5], [40.0, 30.5]]]])
    tracks = hand_tracks(uv, np.ones((1, 1, 2), bool), views=("head",))
    maps = render_action_maps(collate_tracks([tracks]), (HEIGHT, WIDTH), (HEIGHT, WIDTH), 20.0, dtype=torch.float64)
    both = sum(gaussian(uv[0, 0, arm], HEIGHT, WIDTH, 20.0) for arm in (0, 1))
    assert np.abs(maps[0, 0, 0, 0].numpy() - both).max() < 1e-6


def test_a_pixel_keeps_its_place_in_an_enlarged_picture() -> None:
    # The image's corners (half a pixel outside of the outermost centres) stay the picture's corners.
    assert np.allclose(picture_pixel(np.array([-0.5, -0.5]), (HEIGHT, WIDTH), (256, 384)), [-0.5, -0.5])
    corner = picture_pixel(np.array([WIDTH - 0.5, HEIGHT - 0.5]), (HEIGHT, WIDTH), (256, 384))
    assert np.allclose(corner, [383.5, 255.5])


def test_invalid_samples_leave_the_frame_untouched(one_arm) -> None:
    picture = draw_overlay(grey(), one_arm(20, 16, valid=False), 0, "head", tile_height=HEIGHT)
    assert np.array_equal(picture, grey())


def test_only_the_valid_arm_is_drawn(hand_tracks) -> None:
    tracks = hand_tracks(np.array([[[[10.0, 16.0], [40.0, 16.0]]]]), np.array([[[True, False]]]), views=("head",))
    drawn = changed(draw_overlay(grey(), tracks, 0, "head", tile_height=128))
    assert drawn[:, :80].any()
    assert not drawn[:, 120:].any()


@pytest.mark.parametrize(("arm", "name"), [(0, "left"), (1, "right")])
def test_rings_have_the_arm_s_colour_and_lie_around_the_tool(arm: int, name: str, hand_tracks) -> None:
    valid = np.zeros((1, 1, 2), bool)
    valid[0, 0, arm] = True
    tracks = hand_tracks(np.full((1, 1, 2, 2), 16.0), valid, gripper=0.0, views=("head",))
    picture = draw_overlay(grey(), tracks, 0, "head", tile_height=256, style=NO_HEAT)
    rows, columns = np.nonzero(near(picture, ARM_COLOURS[name]))
    centre = picture_pixel(np.array([16.0, 16.0]), (HEIGHT, WIDTH), (256, 384))
    assert len(rows) > 10
    assert np.hypot(columns - centre[0], rows - centre[1]).max() < 12
    other = ARM_COLOURS["right" if name == "left" else "left"]
    assert not near(picture, other, 20).any()


def test_an_open_gripper_has_a_wider_ring(one_arm) -> None:
    def radius(gripper: float) -> float:
        picture = draw_overlay(grey(), one_arm(24, 16, gripper), 0, "head", tile_height=256, style=NO_HEAT)
        rows, columns = np.nonzero(near(picture, ARM_COLOURS["right"]))
        centre = picture_pixel(np.array([24.0, 16.0]), (HEIGHT, WIDTH), (256, 384))
        return float(np.median(np.hypot(columns - centre[0], rows - centre[1])))

    assert radius(0.0) < radius(0.5) < radius(1.0)
    assert radius(7.0) == radius(1.0)


def test_axes_end_where_the_camera_puts_them(one_arm, camera_matrix) -> None:
    tracks = one_arm(24, 16)
    x, y, z = axis_tips(tracks, 0, 0, 0)
    origin = np.linalg.inv(camera_matrix) @ [24, 16, 1] * 0.8
    for tip, direction in ((x, [0.06, 0, 0]), (y, [0, 0.06, 0]), (z, [0, 0, 0.06])):
        expected = camera_matrix @ (origin + direction)
        assert tip is not None
        assert np.allclose(tip, expected[:2] / expected[2], atol=1e-4)
    picture = draw_overlay(grey(), tracks, 0, "head", tile_height=256, style=NO_HEAT)
    assert x is not None
    u, v = np.rint(picture_pixel(x, (HEIGHT, WIDTH), (256, 384))).astype(int)
    assert near(picture, AXIS_COLOURS[0])[v - 2 : v + 3, u - 4 : u + 1].any()


def test_an_axis_behind_the_camera_is_left_out(one_arm) -> None:
    tracks = one_arm(24, 16)
    tracks.rot6d[..., :3], tracks.rot6d[..., 3:] = (0, 0, -1), (0, 1, 0)  # x points at the camera
    tracks.depth[:] = 0.05
    x, y, z = axis_tips(tracks, 0, 0, 0)
    assert x is None
    assert y is not None
    assert z is not None
    assert changed(draw_overlay(grey(), tracks, 0, "head")).any()


def test_large_frames_are_reduced_and_small_ones_enlarged_by_a_whole_factor(one_arm) -> None:
    tracks = one_arm(24, 16)
    assert draw_overlay(grey(), tracks, 0, "head", tile_height=250).shape == (224, 336, 3)
    large = np.full((640, 960, 3), GREY, dtype=np.uint8)
    picture = draw_overlay(large, tracks, 0, "head", tile_height=256, style=NO_HEAT)
    assert picture.shape == (256, 384, 3)
    small = draw_overlay(grey(), tracks, 0, "head", tile_height=256, style=NO_HEAT)
    assert np.array_equal(changed(picture), changed(small))


def test_the_outline_encloses_the_capsule(one_arm) -> None:
    tracks = one_arm(24, 16, valid=False)
    mask = arm_mask(tracks, 0, "head", (256, 384))
    # The capsule spans -0.1..0.1 m at 0.8 m with radius 0.05: 8 by 40 * 0.3 / 0.8 = 15 pixels wide, times 8.
    rows, columns = np.nonzero(mask)
    assert np.ptp(columns) == pytest.approx(8 * 40 * 0.3 / 0.8, abs=3)
    assert np.ptp(rows) == pytest.approx(8 * 41 * 0.1 / 0.8, abs=3)
    plain = draw_overlay(grey(), tracks, 0, "head", style=OverlayStyle())
    assert not changed(plain).any()
    outlined = draw_overlay(grey(), tracks, 0, "head", style=OverlayStyle(outline=True))
    drawn = np.argwhere(near(outlined, (255, 255, 255), 20))
    assert abs(drawn[:, 1].min() - columns.min()) <= 3
    assert abs(drawn[:, 1].max() - columns.max()) <= 3


def test_the_heat_layer_is_transparent_where_nothing_is(hand_tracks) -> None:
    tracks = hand_tracks(np.array([[[[10.0, 10.0], [30.0, 20.0]]]]), np.array([[[True, False]]]), views=("head",))
    layer = heat_layer(tracks, 0, "head", (HEIGHT, WIDTH))
    assert layer[10, 10, 3] > 150
    assert tuple(layer[10, 10, :3]) == ARM_COLOURS["left"]
    assert layer[20, 30, 3] == 0


def test_a_view_or_frame_that_is_not_there_is_named(one_arm) -> None:
    tracks = one_arm(24, 16)
    with pytest.raises(DataError, match=r"(?s)do not reach there.*view left_wrist, frame 0"):
        draw_overlay(grey(), tracks, 0, "left_wrist")
    with pytest.raises(DataError, match=r"(?s)frames 0\.\.0.*frame 1"):
        draw_overlay(grey(), tracks, 1, "head")


@pytest.fixture
def four_frames(hand_tracks):
    """One arm that moves to the right in every view."""
    uv = np.full((4, 3, 1, 2), 16.0)
    uv[:, :, 0, 0] += np.arange(4)[:, None]
    return hand_tracks(uv, np.ones((4, 3, 1), bool))


def test_a_clip_shows_all_views_and_moves(four_frames) -> None:
    frames = {"head": grey(4), "right_wrist": grey(3)}
    clip = np.stack(list(overlay_clip(frames, four_frames, 8.0, tile_height=128, title="robot")))
    # As long as the shortest; two tiles of 128 x 192, a gap, a heading and a legend; even sides.
    height, width = 128 + LABEL_HEIGHT_PX + LEGEND_HEIGHT_PX, 2 * 192 + COLUMN_GAP_PX
    assert clip.shape == (3, height, width, 3)
    left, right = (
        clip[:, LABEL_HEIGHT_PX:-LEGEND_HEIGHT_PX, :192],
        clip[:, LABEL_HEIGHT_PX:-LEGEND_HEIGHT_PX, -192:],
    )
    assert np.array_equal(left, right)
    assert not np.array_equal(left[0], left[2])
    assert not np.array_equal(clip[0, -LEGEND_HEIGHT_PX:], clip[1, -LEGEND_HEIGHT_PX:])  # the frame number
    with pytest.raises(DataError, match=r"(?s)No view to draw.*top"):
        overlay_clip({"top": grey(3)}, four_frames, 8.0)


def test_the_video_plays_and_repeats_to_the_byte(tmp_path: Path, four_frames) -> None:
    frames = {"head": grey(4), "left_wrist": grey(4), "right_wrist": grey(4)}
    for name in ("a.mp4", "b.mp4"):
        write_overlay_video(tmp_path / name, frames, four_frames, 8.0, tile_height=64)
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()
    shown = decode_video(tmp_path / "a.mp4")
    assert shown.shape == (4, 64 + LABEL_HEIGHT_PX + LEGEND_HEIGHT_PX, 3 * 96 + 2 * COLUMN_GAP_PX, 3)
    assert near(shown[0], ARM_COLOURS["right"], 60).any()


def test_a_sheet_has_a_row_a_view_and_a_legend(four_frames) -> None:
    frames = {"head": grey(2), "left_wrist": grey(2)}
    sheet = overlay_sheet(frames, four_frames, [0, 3], tile_height=64)
    with_outline = overlay_sheet(frames, four_frames, [0, 3], tile_height=64, style=OverlayStyle(outline=True))
    assert sheet.shape == with_outline.shape
    assert sheet.shape[0] > 2 * 64 + LEGEND_HEIGHT_PX
    with pytest.raises(DataError, match="no view with a track"):
        overlay_sheet({"top": grey(2)}, four_frames, [0, 3])


def test_the_legend_never_loses_its_note() -> None:
    note = "frame 12"
    wide, narrow = (legend_strip(("left", "right"), width, note=note) for width in (900, 160))
    end = text_width_px(note, 13)
    assert wide.shape == (LEGEND_HEIGHT_PX, 900, 3)
    assert np.array_equal(wide[:, -end - 8 :], narrow[:, -end - 8 :])
    assert near(wide, ARM_COLOURS["left"], 5).any()
    assert near(wide, ARM_COLOURS["right"], 5).any()
    assert not near(narrow, ARM_COLOURS["right"], 5).any()
