import numpy as np
import pytest

from worldline_core.actions.tool_error import end_effector_error
from worldline_core.errors import DataError
from worldline_core.evaluation.metrics import frame_iou

EMPTY = np.zeros((4, 6), dtype=bool)
LEFT = EMPTY.copy()
LEFT[:, :2] = True
MIDDLE = EMPTY.copy()
MIDDLE[:, 1:3] = True


def test_overlap_over_union():
    assert frame_iou(LEFT[None], MIDDLE[None])[0] == pytest.approx(1 / 3)
    assert frame_iou(LEFT[None], LEFT[None])[0] == 1.0


def test_frame_with_both_masks_empty_is_left_out():
    true, predicted = np.stack([LEFT, EMPTY]), np.stack([MIDDLE, EMPTY])
    assert np.isnan(frame_iou(true, predicted)[1])


def test_frame_with_one_mask_empty_counts_zero():
    assert frame_iou(np.stack([LEFT, LEFT]), np.stack([LEFT, EMPTY])).tolist() == [1.0, 0.0]
    assert frame_iou(np.stack([LEFT, EMPTY]), np.stack([LEFT, LEFT])).tolist() == [1.0, 0.0]


def test_masks_of_other_shape_or_type_are_refused():
    with pytest.raises(DataError, match="do not fit"):
        frame_iou(LEFT[None], MIDDLE[None, :2])
    with pytest.raises(DataError, match="do not fit"):
        frame_iou(LEFT[None].astype(np.uint8), MIDDLE[None])


def _video_with_patch(column: int) -> np.ndarray:
    video = np.full((1, 64, 96, 3), 90, dtype=np.uint8)
    texture = np.random.default_rng(0).integers(0, 256, (19, 19, 3), dtype=np.uint8)
    video[0, 21:40, column - 3 : column + 16] = texture
    return video


def test_end_effector_error_is_the_displacement_of_the_gripper():
    points = np.array([[[46.0, 30.0], [np.nan, np.nan]]])
    true = _video_with_patch(40)
    assert end_effector_error(true, true, points)[0, 0] == 0.0
    assert end_effector_error(true, _video_with_patch(47), points)[0, 0] == 7.0
    assert np.isnan(end_effector_error(true, true, points)[0, 1])


def test_end_effector_that_is_nowhere_counts_with_the_search_radius():
    points = np.array([[[46.0, 30.0]]])
    noise = np.random.default_rng(1).integers(0, 256, (1, 64, 96, 3), dtype=np.uint8)
    assert end_effector_error(_video_with_patch(40), noise, points)[0, 0] == 16.0
