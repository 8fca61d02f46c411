"""Times of a rollout."""

from __future__ import annotations

from worldline_core.rollout.speed import timed


def test_timed_returns_the_result_and_what_it_took() -> None:
    result, elapsed = timed(lambda: sum(range(300_000)), "cpu")
    assert result == sum(range(300_000))
    assert elapsed.wall > 0
    assert elapsed.processor > 0
