"""Progress of a long loop: a bar on a terminal, a line a minute in a log, each line once."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from torch import nn

from worldline_core import progress
from worldline_core.progress import Progress, with_progress
from worldline_core.training.trainer import Objective, ParameterGroup, train
from worldline_core.training.training_config import TrainerConfig


@dataclass
class Batch:
    names: tuple[str, ...] = ("a", "b", "c")


class Fit(Objective[Batch]):
    def __init__(self) -> None:
        self.weight = nn.Parameter(torch.ones(1))

    def loss(self, batch: Batch, generator: torch.Generator, step: int) -> tuple[torch.Tensor, dict[str, float]]:
        return (self.weight**2).sum(), {}


@pytest.fixture
def messages(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> Callable[[], list[str]]:
    """Log lines of loops in which two seconds pass between two looks at the clock."""
    clock = count(0.0, 2.0)
    monkeypatch.setattr(progress, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    caplog.set_level("INFO", "worldline_core")
    # Other libraries' threads may log meanwhile.
    return lambda: [record.getMessage() for record in caplog.records if record.name.startswith("worldline_core")]


def test_a_training_writes_a_line_a_minute(tmp_path: Path, messages: Callable[[], list[str]]) -> None:
    fit = Fit()
    train(
        TrainerConfig(steps=100, ema_decay=0.5, log_every=10), groups=[ParameterGroup("fit", {"weight": fit.weight})],
        objective=fit, load=lambda _: Batch(), output=tmp_path, identity={}, title="stage II",
    )  # fmt: skip
    pattern = r"stage II: (\d+) of 100 steps, loss 0\.\d+, 1\.5 clips/s, (\d\d:\d\d) left"
    found = [re.fullmatch(pattern, message) for message in messages()]
    assert [match and match.groups() for match in found] == [("30", "02:20"), ("60", "01:20"), ("90", "00:20")]


def test_what_was_there_already_does_not_hurry_the_estimate(messages: Callable[[], list[str]]) -> None:
    with Progress("rollout causal", 1000, "clip", done=500) as shown:
        for _ in range(60):
            shown.advance(5, verdict="consistent")
    assert messages() == [
        "rollout causal: 650 of 1000 clips, verdict consistent, 2.5 clips/s, 02:20 left",
        "rollout causal: 800 of 1000 clips, verdict consistent, 2.5 clips/s, 01:20 left",
    ]


def test_other_processes_of_the_same_loop_are_silent(messages: Callable[[], list[str]]) -> None:
    with Progress("stage II", 100, "step", shown=False) as shown:
        for _ in range(100):
            shown.advance()
    assert list(with_progress("abc", "letters", "letter")) == ["a", "b", "c"]
    assert messages() == []
