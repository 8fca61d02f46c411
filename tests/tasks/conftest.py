"""Tasks that the tests declare: they write a text, and fail when it says so."""

from __future__ import annotations

import errno
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from tasks.execution.artifact_task import ArtifactTask
from worldline_core.config import StrictModel
from worldline_core.errors import DataError


class WriteConfig(StrictModel):
    text: str = "a"


def write(config: WriteConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    if config.text == "broken":
        raise DataError("This task cannot work")
    if config.text == "full":
        raise OSError(errno.ENOSPC, "No space left on device")
    before = "".join((folder / "text").read_text() for folder in inputs.values())
    (output / "text").write_text(before + config.text)
    return {"written": len(before) + 1}


@pytest.fixture
def declare(monkeypatch: pytest.MonkeyPatch) -> Callable[..., ArtifactTask]:
    """Declares a task of a name, as its file in `tasks` would. Its config is a text."""

    def make(name: str, *inputs: str, function: Any = write) -> ArtifactTask:
        module = ModuleType(f"tasks.{name}")
        task = ArtifactTask(name, 1, f"tasks.{name}:work", f"tasks.{name}:Config", inputs)
        vars(module).update({name: task, "work": function, "Config": WriteConfig})
        monkeypatch.setitem(sys.modules, module.__name__, module)
        return task

    return make
