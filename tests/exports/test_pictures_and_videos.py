"""Scaling, labels, sheets and side-by-side videos."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from worldline_core.data.video.clip import decode_video
from worldline_core.pictures import (
    COLUMN_GAP_PX,
    LABEL_HEIGHT_PX,
    SheetRow,
    contact_sheet,
    evenly_spaced,
    fit_text,
    scaled_size,
    side_by_side,
    text_strip,
    text_width_px,
    write_side_by_side,
)


def clip(count: int, value: int, size: tuple[int, int] = (64, 96)) -> np.ndarray:
    return np.full((count, *size, 3), value, dtype=np.uint8)


@pytest.mark.parametrize(
    ("size", "target", "expected"),
    [
        ((64, 96), 256, (256, 384)),
        ((128, 192), 256, (256, 384)),
        ((480, 640), 256, (256, 342)),
        ((63, 95), 64, (64, 96)),
        ((300, 301), 256, (256, 258)),
    ],
)
def test_display_sizes_are_even_and_fit(size: tuple[int, int], target: int, expected: tuple[int, int]) -> None:
    assert scaled_size(*size, target) == expected


def test_long_labels_are_cut_to_their_strip() -> None:
    text = "a very long name of a method that nobody could fit into a column"
    shown = fit_text(text, 120, 15)
    assert shown.endswith("...")
    assert text_width_px(shown, 15) <= 120
    assert fit_text("short", 120, 15) == "short"
    assert text_strip(text, 120, 24).shape == (24, 120, 3)


def test_evenly_spaced_holds_both_ends() -> None:
    assert evenly_spaced(33, 5) == [0, 8, 16, 24, 32]
    assert evenly_spaced(2, 5) == [0, 1]
    assert evenly_spaced(0, 5) == []


def test_contact_sheet_holds_every_picture() -> None:
    rows = [SheetRow("first", clip(3, 200), "note"), SheetRow("second", clip(2, 90, (32, 32)))]
    sheet = contact_sheet(rows, tile_height=64, title="sheet", column_titles=["a", "b", "c"])
    assert (sheet == 200).all(axis=-1).sum() == 3 * 64 * 96
    assert (sheet == 90).all(axis=-1).sum() == 2 * 64 * 64
    assert np.array_equal(sheet, contact_sheet(rows, tile_height=64, title="sheet", column_titles=["a", "b", "c"]))
    with pytest.raises(ValueError, match="at least one row"):
        contact_sheet([])


def test_columns_stay_in_step_and_end_with_the_shortest() -> None:
    columns = {"true": clip(9, 10), "Stage II": clip(5, 20), "causal": clip(7, 30, (32, 48))}
    frames = np.stack(list(side_by_side(columns, tile_height=64)))
    assert frames.shape == (5, 64 + LABEL_HEIGHT_PX, 3 * 96 + 2 * COLUMN_GAP_PX, 3)
    body = frames[:, LABEL_HEIGHT_PX:]
    starts = (0, 96 + COLUMN_GAP_PX, 2 * (96 + COLUMN_GAP_PX))
    assert [int(body[:, :, start : start + 96].mean()) for start in starts] == [10, 20, 30]
    with pytest.raises(ValueError, match="at least one column"):
        side_by_side({})


def test_side_by_side_video_and_poster(tmp_path: Path) -> None:
    columns = {"true": clip(6, 60), "causal": clip(6, 180)}
    made = write_side_by_side(tmp_path / "video.mp4", columns, 8.0, tile_height=64)
    frames = decode_video(made.video)
    assert frames.shape == (made.num_frames, made.height, made.width, 3)
    assert abs(int(frames[3, 60, 40].mean()) - 60) <= 3
    assert abs(int(frames[3, 60, 150].mean()) - 180) <= 3
    poster = cv2.imread(str(made.poster))
    assert poster.shape == frames[0].shape
    again = write_side_by_side(tmp_path / "again.mp4", columns, 8.0, tile_height=64)
    assert again.video.read_bytes() == made.video.read_bytes()
