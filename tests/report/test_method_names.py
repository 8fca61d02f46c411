"""Names of methods: what stands under which label."""

from __future__ import annotations

from worldline_core.report.methods import method


def test_another_number_of_steps_is_not_shown_as_the_usual_method() -> None:
    assert method("shipped_stage2").label == "Stage II"
    assert method("shipped_stage2_35_steps").label == "Stage II, 35 steps"
