"""The sheet of a preset: cards by name, planned times, and what is proposed for a card."""

from __future__ import annotations

import pytest

from worldline_core.errors import ConfigError
from worldline_core.pipeline.cards import CARDS, UTILISATION, find_card
from worldline_core.pipeline.memory_estimate import Estimate
from worldline_core.pipeline.pipeline_config import PipelineConfig
from worldline_core.pipeline.size_sheet import SizeSheet


@pytest.mark.parametrize(
    ("given", "card"),
    [("RTX 4090", "RTX 4090"), ("NVIDIA GeForce RTX 4090", "RTX 4090"), ("4090", "RTX 4090"), ("a6000", "RTX A6000"),
     ("rtxpro6000", "RTX PRO 6000"), ("h100", "H100")],
)  # fmt: skip
def test_a_card_is_found_by_its_usual_names(given, card):
    assert find_card(given) == card


@pytest.mark.parametrize("given", ["6000", "RTX 6090", "", "0"])
def test_unknown_cards_and_names_of_several_are_refused(given):
    with pytest.raises(ConfigError, match=r"RTX 3090, RTX 4090"):
        find_card(given)


def test_seconds_and_hours_are_planned_from_operations():
    sheet = SizeSheet.model_validate({"config": PipelineConfig.load("smoke"), "project": ".", "card": "l40s"})
    second = UTILISATION * CARDS["L40S"].operations
    stages = [
        Estimate("stage II", 7, {"weights": 4e9}, operations=second / 2, steps=7200),
        Estimate("short", 7, {"weights": 4e9}, operations=second, minutes=30),
        Estimate("fp32", 7, {"weights": 4e9}, steps=3),
    ]
    text = sheet.as_text([(stage, "") for stage in stages])
    assert "48.0 GB" in text
    assert "planned, not measured" in text
    for row in (
        "weights 4.0 | 0.5 | 1 | yes",
        "weights 4.0 | 1 | 0.5 | yes",
        "weights 4.0 |  |  | yes",
        "In all 1.5 hours",
    ):
        assert row in text
