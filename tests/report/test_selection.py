"""Names of methods and the choice of episodes."""

from __future__ import annotations

import pytest

from worldline_core.report.context import VideoScores, in_order, method
from worldline_core.report.videos import best_median_worst, choose_episodes


@pytest.mark.parametrize(
    ("name", "kind", "group", "label"),
    [
        ("shipped_stage2", "stage2", "shipped", "Stage II"),
        ("shipped_stage2_no_action", "stage2_zero", "shipped", "Stage II, no actions"),
        ("stage2_shuffled", "stage2_shuffled", "run", "Stage II, shuffled actions"),
        ("stage1", "stage1", "baseline", "Stage I, text, no actions"),
        ("backbone", "backbone", "baseline", "backbone, text, no actions"),
        ("stage1_20_steps", "other", "run", "stage1 20 steps"),
        ("banks_shipped_causal", "causal", "shipped", "causal"),
        ("copy_first_frame", "copy", "baseline", "copy first frame"),
        ("cosmos_predict", "other", "run", "cosmos predict"),
    ],
)
def test_names_are_read(name: str, kind: str, group: str, label: str) -> None:
    found = method(name)
    assert (found.kind, found.group, found.label) == (kind, group, label)


def test_order_is_long_trained_first_baselines_last() -> None:
    names = ["copy_first_frame", "causal", "shipped_causal", "stage2", "shipped_stage2_shuffled", "shipped_stage2"]
    assert [m.name for m in in_order(names)] == [
        "shipped_stage2", "shipped_causal", "shipped_stage2_shuffled", "stage2", "causal", "copy_first_frame",
    ]  # fmt: skip


def test_median_best_and_worst() -> None:
    values = {"a": 0.9, "b": 0.1, "c": 0.5, "d": 0.4}
    assert best_median_worst(values) == [("median", "d", 0.4), ("best", "a", 0.9), ("worst", "b", 0.1)]
    assert best_median_worst({"a": 0.9, "b": 0.1}) == [("median", "b", 0.1), ("best", "a", 0.9)]
    assert best_median_worst({"only": 0.3}) == [("median", "only", 0.3)]
    assert best_median_worst({}) == []


def test_without_scores_episodes_are_taken_by_name() -> None:
    chosen = choose_episodes(VideoScores([], [], []), ["c", "a", "b"])
    assert [item.episode_id for item in chosen] == ["a", "b", "c"]
    assert "no scores" in chosen[0].reason


def test_another_number_of_steps_is_not_shown_as_the_usual_method() -> None:
    assert method("shipped_stage2").label == "Stage II"
    assert method("shipped_stage2_35_steps").label == "Stage II, 35 steps"
