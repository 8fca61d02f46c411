"""Coloured things in crisp pictures and in faded ones, as predicted videos show them."""

from __future__ import annotations

import numpy as np
import pytest

from tests.evaluation.conftest import make_film
from worldline_core.evaluation.policy.measured_judge import score
from worldline_core.evaluation.policy.measurements import (
    LATE_COUNT,
    ColouredThing,
    OwnColour,
    colour_share,
    likeness,
    measure_lift,
    named_things,
    own_colour,
)

CUBE = ColouredThing("red", "cube")


def faded(frames: np.ndarray, share: float) -> np.ndarray:
    """The first frame as it is, the others mixed with grey: ``share`` of the colour is left."""
    out = frames.astype(np.float32)
    out[1:] = share * out[1:] + (1 - share) * 110.0
    return out.round().astype(np.uint8)


def lift_score(success: bool, share: float) -> float:
    frames, masks, _ = make_film(success, seed=3)
    return score(measure_lift({view: faded(video, share) for view, video in frames.items()}, CUBE, masks[-LATE_COUNT:]))


@pytest.mark.parametrize("share", [1.0, 0.6, 0.45])
def test_a_lifted_cube_ranks_first_even_where_it_has_faded(share: float) -> None:
    assert lift_score(True, share) > lift_score(False, share) + 0.3


def test_what_has_faded_is_lost_to_the_colour_word_but_not_to_its_own_colour() -> None:
    frames, _, _ = make_film(False, seed=3)
    pale = faded(frames["head"], 0.45)
    own = own_colour(pale, "red")
    assert own is not None
    assert own.rgb == pytest.approx([220, 20, 20], abs=6)
    assert colour_share(pale, "red")[-1].sum() < 0.3 * colour_share(pale, "red")[0].sum()
    areas = likeness(pale, own).sum(axis=(1, 2))
    assert areas[-1] == pytest.approx(areas[0], rel=0.2)


@pytest.mark.parametrize("other", [(20, 20, 220), (20, 200, 20), (120, 120, 120), (230, 130, 20)])
def test_other_hues_and_grey_are_not_the_thing(other: tuple[int, int, int]) -> None:
    own = OwnColour(np.array([220, 20, 20], np.float32), 0.2)
    assert likeness(np.full((1, 4, 4, 3), other, np.uint8), own).max() == 0


def test_a_thing_that_is_not_seen_early_has_no_colour_of_its_own() -> None:
    frames, _, _ = make_film(True, seed=1)
    assert named_things("lift the green cube") == (ColouredThing("green", "cube"),)
    assert own_colour(frames["head"], "green") is None


def test_a_table_with_a_tint_of_the_hue_is_not_the_thing() -> None:
    frames = np.full((9, 48, 72, 3), (172, 140, 110), np.uint8)  # orange, but pale
    frames[:, 20:27, 30:37] = (235, 130, 20)
    own = own_colour(frames, "orange")
    assert own is not None
    share = likeness(frames, own)
    assert share[0].sum() == pytest.approx(49, rel=0.02)
