"""Work that is continued has as many threads as it began with: its bytes do not depend on where it was stopped."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
import torch

from tasks.execution.artifact_task import ArtifactTask
from worldline_core.config import StrictModel
from worldline_core.store.store import ArtifactStore

seen: list[int] = []


class SumConfig(StrictModel):
    pass


def work(config: SumConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    seen.append(torch.get_num_threads())
    if len(seen) == 1:
        raise KeyboardInterrupt
    (output / "content").write_text("made")
    return {}


def _load(address: str) -> Any:
    return {"work": work, "config": SumConfig}[address]


@pytest.fixture
def threads() -> Iterator[int]:
    before = torch.get_num_threads()
    yield before
    torch.set_num_threads(before)


def test_a_step_is_continued_on_the_threads_that_it_began_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, threads: int
) -> None:
    monkeypatch.setattr("tasks.execution.artifact_task.load_object", _load)
    task = ArtifactTask("sum", "", 1, "work", "config")
    seen.clear()
    torch.set_num_threads(3)
    with pytest.raises(KeyboardInterrupt):
        task.run(ArtifactStore(tmp_path), SumConfig(), {})
    torch.set_num_threads(1)
    artifact = task.run(ArtifactStore(tmp_path), SumConfig(), {})
    assert seen == [3, 3]
    assert torch.get_num_threads() == 1
    manifest = json.loads((artifact.path / "manifest.json").read_text())
    assert manifest["environment"]["threads"] == 3
