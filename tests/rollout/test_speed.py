"""Times of a rollout: written beside it, in no digest, continued by a resumed call."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from worldline_core.rollout.speed import BatchTime, SpeedLog, summarise, timed


def row(trajectories: int, seconds: float, blocks: tuple[float, ...] = (), *, first: bool = False) -> BatchTime:
    return BatchTime(trajectories, trajectories * 10, seconds, blocks, first)


def test_blocks_are_averaged_over_trajectories_without_the_warm_up() -> None:
    times = [
        row(4, 90.0, (50.0, 9.0), first=True),
        row(4, 8.0, (2.0, 4.0)),
        row(1, 2.0, (1.0, 1.0)),
        row(2, 2.0, (9.0,)),
    ]
    summary = summarise(times)
    # (2 + 1) and (4 + 1) seconds for five trajectories; the two shorter ones have no second block.
    assert summary["block_seconds"] == pytest.approx([0.6, 1.0])
    assert (summary["frames"], summary["trajectories"]) == (70, 7)
    assert summary["seconds_per_frame"] == pytest.approx(12.0 / 70)
    assert summarise(times[:1])["seconds_per_frame"] == pytest.approx(90.0 / 40)
    assert summarise([]) == {
        "frames": 0, "trajectories": 0, "seconds": 0, "seconds_per_frame": None, "block_seconds": [],
    }  # fmt: skip


def test_a_resumed_call_keeps_the_times_before_it(tmp_path: Path) -> None:
    log = SpeedLog(tmp_path)
    log.add(row(1, 5.0, first=True))
    log.add(row(1, 2.0, (1.0,)))
    with (tmp_path / "batches.jsonl").open("a") as stream:
        stream.write('{"trajectories": 1, "fra')  # a kill in the middle of a line
    again = SpeedLog(tmp_path)
    again.add(row(1, 4.0, (3.0,)))
    again.close({"steps": 4})
    speed = json.loads((tmp_path / "speed.json").read_text())
    assert (speed["steps"], speed["seconds"], speed["block_seconds"]) == (4, 6.0, [2.0])
    assert len((tmp_path / "batches.jsonl").read_text().splitlines()) == 3


def test_timed_returns_the_result_and_what_it_took() -> None:
    result, elapsed = timed(lambda: sum(range(300_000)), "cpu")
    assert result == sum(range(300_000))
    assert elapsed.wall > 0
    assert elapsed.processor > 0
