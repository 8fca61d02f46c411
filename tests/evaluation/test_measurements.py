"""Coloured things in crisp pictures and in faded ones, as predicted videos show them."""

from __future__ import annotations

import numpy as np
import pytest

from tests.evaluation.conftest import make_film  # pyright: ignore[reportMissingImports]
from worldline_core.evaluation.policy.evidence import establishes_success, route
from worldline_core.evaluation.policy.measured_judge import (
    LATE_COUNT,
    PressMeasurement,
    facts,
    measure,
    measure_lift,
    measure_press,
    measure_push,
)
from worldline_core.evaluation.segmenters.coloured_things import (
    ColouredThing,
    OwnColour,
    colour_share,
    likeness,
    named_things,
    own_colour,
)
from worldline_core.evaluation.segmenters.segmenter import ColourSegmenter

CUBE = ColouredThing("red", "cube")


def faded(frames: np.ndarray, share: float) -> np.ndarray:
    """The first frame as it is, the others mixed with grey: ``share`` of the colour is left."""
    out = frames.astype(np.float32)
    out[1:] = share * out[1:] + (1 - share) * 110.0
    return out.round().astype(np.uint8)


def lift_score(success: bool, share: float) -> float:
    frames, masks, _ = make_film(success, seed=3)
    shown = {view: faded(video, share) for view, video in frames.items()}
    return measure_lift(shown, CUBE, masks[-LATE_COUNT:]).score()


@pytest.mark.parametrize("share", [1.0, 0.6, 0.45])
def test_a_lifted_cube_ranks_first_even_where_it_has_faded(share: float) -> None:
    assert lift_score(True, share) > lift_score(False, share) + 0.3


def test_what_has_faded_is_lost_to_the_colour_word_but_not_to_its_own_colour() -> None:
    frames, _, _ = make_film(False, seed=3)
    pale = faded(frames["head"], 0.45)
    own = own_colour(pale, "red")
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


def painted(*boxes: tuple[slice, slice]) -> np.ndarray:
    """A frame of a grey table with red boxes."""
    frame = np.full((48, 72, 3), 120, np.uint8)
    for box in boxes:
        frame[box] = (220, 20, 20)
    return frame


def test_a_button_that_lights_up_is_pressed_though_something_hides_a_part_of_it() -> None:
    cap, plate = (slice(20, 27), slice(30, 37)), (slice(18, 30), slice(27, 40))
    pressed = np.stack([painted(cap)] * 5 + [painted(plate)] * 3)
    pressed[-2, 18:24] = 120
    left = np.stack([painted(cap)] * 8)
    instruction = "press the red button"
    for frames, growth, done in ((pressed, 156 / 49, True), (left, 1.0, False)):
        measured = measure(ColourSegmenter(), instruction, route(instruction), {"head": frames}, None)
        assert isinstance(measured, PressMeasurement)
        assert measured.growth == pytest.approx(growth, rel=0.02)
        assert establishes_success(facts(measured, instruction, "state_change")) is done
        assert (measured.score() > 0.5) is done


def test_a_button_that_is_never_seen_proves_nothing() -> None:
    measured = measure_press({"head": np.stack([painted()] * 8)}, ColouredThing("red", "button"))
    assert measured == PressMeasurement(None)
    assert not establishes_success(facts(measured, "press the red button", "state_change"))


@pytest.mark.parametrize("towards_the_camera", [True, False])
def test_a_drawer_closes_away_from_the_camera_or_towards_it(towards_the_camera: bool) -> None:
    rows = (slice(28, 30), slice(10, 30)) if towards_the_camera else (slice(10, 12), slice(10, 30))
    columns = slice(30, 45)
    frames = np.stack([painted((rows[1], columns))] * 5 + [painted((rows[0], columns))] * 3)
    measured = measure_push({"head": frames}, ColouredThing("red", "drawer"), np.zeros((3, 48, 72), bool))
    assert measured.remaining == pytest.approx(0.1, abs=0.02)
    assert measured.retreat is not None
    assert measured.retreat > 0.8


def test_a_wide_thing_rises_in_units_of_its_height() -> None:
    low, high = (slice(34, 38), slice(10, 60)), (slice(24, 28), slice(10, 60))
    frames = np.stack([painted(low)] * 5 + [painted(high)] * 3)
    measured = measure_lift({"head": frames}, ColouredThing("red", "tray"), np.zeros((3, 48, 72), bool))
    assert measured.rise == pytest.approx(10 / 4, rel=0.35)
