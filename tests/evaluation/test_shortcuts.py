"""Shortcuts choose by commands and the first picture alone; trees learn from other banks alone."""

from __future__ import annotations

import numpy as np
import pytest

from worldline_core.evaluation.planning.shortcuts import (
    FEATURES,
    BankFacts,
    Reach,
    hand_rule,
    medoid,
    nearest_hand,
    tree_scores,
)

THING, PLACE = np.array([0.4, 0.1, 0.0]), np.array([0.4, -0.1, 0.0])
FRAMES, CLOSED = 17, 8


def facts(
    instruction: str, targets: np.ndarray, ends: np.ndarray, *things: np.ndarray, opens: int = FRAMES
) -> BankFacts:
    """Candidates whose tool goes to its target from above in 8 frames, closes there, and goes on to its end; it opens at ``opens``."""
    way = (
        np.minimum(np.arange(FRAMES) / CLOSED, 1.0)[None, :, None],
        np.maximum(np.arange(FRAMES) / CLOSED - 1.0, 0.0)[None, :, None],
    )
    start = targets + np.array([0.0, 0.0, 0.2])
    paths = start[:, None] + way[0] * (targets - start)[:, None] + way[1] * (ends - targets)[:, None]
    gripper = np.ones((len(targets), FRAMES, 1))
    gripper[:, CLOSED:opens] = 0.0
    return BankFacts(instruction, paths, Reach(paths[:, :, None], gripper, things or (THING,)))


def near(*offsets: tuple[float, float, float], place: np.ndarray = THING) -> np.ndarray:
    return place + np.array(offsets)


RISEN = near((0, 0, 0.2))


def test_the_medoid_is_the_sequence_most_like_the_others_shown() -> None:
    targets = near((0.3, 0, 0), (0, 0, 0), (0.02, 0, 0), (-0.02, 0, 0), (-0.4, 0, 0))
    choose = medoid(facts("lift the red cube", targets, targets + np.array([0, 0, 0.2])))
    assert choose(range(5)) == 1
    assert choose([0, 1, 2]) == 2


@pytest.mark.parametrize(
    ("bank", "best"),
    [
        (facts("lift the red cube", near((0.2, 0, 0), (0.01, 0, 0), (0, 0.1, 0)), np.repeat(RISEN, 3, axis=0)), 1),
        (facts("lift the red cube", near((0, 0, 0), (0.01, 0, 0)), near((0, 0, 0.01), (0.01, 0, 0.2))), 1),
        (
            facts(
                "place the red cube on the blue pad", near(*[(0, 0, 0)] * 3), near((0.1, 0, 0), (0, 0, 0), (0, 0, 0.1), place=PLACE),
                THING, PLACE, opens=16,
            ),
            1,
        ),
        (facts("push the red drawer closed", near(*[(0, 0, 0)] * 4), near((0.05, 0, 0), (0.15, 0, 0), (0.14, 0, 0), (0.12, 0.12, 0))), 1),
        (facts("press the red button", near((0, 0, 0.05), (0.05, 0, 0), (0, 0, 0)), np.repeat(RISEN, 3, axis=0)), 2),
    ],
    ids=["grasp at the thing", "rise with it", "let go at the destination", "push far and straight", "come down on it"],
)  # fmt: skip
def test_the_rule_written_by_hand(bank: BankFacts, best: int) -> None:
    assert int(np.argmax(np.asarray(hand_rule(bank)))) == best


def test_without_tracks_or_a_named_thing_only_commands_choose() -> None:
    blind = BankFacts("lift it", facts("lift it", near((0, 0, 0)), RISEN).commands, None)
    assert nearest_hand(blind) is None
    assert hand_rule(blind) is None
    assert [name for name, make in FEATURES.items() if make(blind) is not None] == [
        "trees_commands",
        "trees_commands_less_mean",
    ]


def test_trees_learn_from_other_banks_alone() -> None:
    generator = np.random.default_rng(3)
    features = {f"bank_{n:02d}": generator.normal(size=(24, 6)) for n in range(12)}
    outcomes = {name: own[:, 0] > 0 for name, own in features.items()}
    scores = tree_scores(features, outcomes)
    assert np.mean([outcomes[name][int(np.argmax(own))] for name, own in scores.items()]) == 1.0
    flipped = tree_scores(features, outcomes | {"bank_03": ~outcomes["bank_03"]})
    assert np.array_equal(flipped["bank_03"], scores["bank_03"])
    assert not np.array_equal(flipped["bank_04"], scores["bank_04"])
    assert tree_scores({"alone": features["bank_00"]}, outcomes | {"alone": outcomes["bank_00"]}) == {}
