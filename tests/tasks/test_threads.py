"""Work that is continued has as many threads as it began with: its bytes do not depend on where it was stopped."""

from __future__ import annotations

import json
import os
import subprocess
import sys
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


FREED = """
import sys
from worldline_core.scale.process import keep_freed_memory

kept = keep_freed_memory()
block = b"x" * (256 << 20)
del block
resident = next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmRSS"))
print(kept, resident > 256 << 10)
"""


@pytest.mark.skipif("glibc" not in str(os.confstr("CS_GNU_LIBC_VERSION")), reason="glibc's malloc")
@pytest.mark.parametrize(("environment", "said"), [({}, "True True"), ({"MALLOC_ARENA_MAX": "2"}, "False False")])
def test_freed_memory_is_kept_unless_the_environment_says_otherwise(
    project_root: Path, environment: dict[str, str], said: str
) -> None:
    chosen = {"GLIBC_TUNABLES", "LD_PRELOAD", *(name for name in os.environ if name.startswith("MALLOC_"))}
    others = {name: value for name, value in os.environ.items() if name not in chosen}
    done = subprocess.run(
        [sys.executable, "-c", FREED],
        capture_output=True,
        text=True,
        cwd=project_root,
        env=others | environment,
        check=True,
    )
    assert done.stdout.strip() == said
