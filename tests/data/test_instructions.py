"""Task texts that mean the same become the same, and nothing is lost."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.data.conftest import make_sample
from worldline_core.data.episodes.instructions import (
    RAW_INSTRUCTION,
    mentions_outcome,
    normalised_text,
    one_annotation,
    with_instruction,
)


@pytest.mark.parametrize(
    ("raw", "expected"),
    [
        ("Pick up the  Red\tblock.\n", "pick up the red block"),
        ("“Open the drawer”", "open the drawer"),
        ("[fold the towel]", "fold the towel"),
        ("Ｐｉｃｋ the ｃｕｐ", "pick the cup"),  # noqa: RUF001
        ("cafe\u0301 cup", "caf\u00e9 cup"),
        ("put\u200b it\u00a0down", "put it down"),
        ("Don\u2019t stop!!", "don't stop"),
        ("PICK UP THE CUP", "pick up the cup"),
        ("Plug the USB cable into the PC", "plug the USB cable into the PC"),
        ("把杯子放到桌子上", "把杯子放到桌子上"),
        ("Put the cup (red) on the tray", "put the cup (red) on the tray"),
        ("pour 1.5 l", "pour 1.5 l"),
        ("N/A", ""),
        (" None. ", ""),
        ('"unknown"', ""),
        ("---", ""),
        ("", ""),
    ],
)
def test_one_spelling(raw: str, expected: str) -> None:
    assert normalised_text(raw) == expected
    assert normalised_text(expected) == expected


def test_of_several_annotations_the_majority_counts() -> None:
    assert one_annotation(["n/a", "Lift the cup.", "raise the mug", "lift the cup", ""]) == "Lift the cup."
    assert one_annotation(["Raise it", "lift it"]) == "Raise it"
    assert one_annotation(["n/a", " "]) == one_annotation([]) == ""


def test_the_raw_text_is_kept_where_it_differs() -> None:
    changed = with_instruction(replace(make_sample(0)[0], instruction="Lift the block.", conventions={"layout": "x"}))
    assert changed.instruction == "lift the block"
    assert changed.conventions == {"layout": "x", RAW_INSTRUCTION: "Lift the block."}
    assert with_instruction(changed) is changed


def test_texts_that_tell_the_outcome_are_noticed() -> None:
    telling = "pick the cup (failed)", "successful grasp", "Failure: lift", "it succeeds", "unsuccessful lift"
    assert all(map(mentions_outcome, telling))
    assert not any(map(mentions_outcome, ("lift the successor", "failsafe switch on", "pick the cup")))
