"""docs/architecture.md names files and functions that are there."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path


def test_the_page_names_what_is_there(project_root: Path) -> None:
    core = project_root / "worldline_core"
    everything = _defined(path for folder in (core, project_root / "flows") for path in folder.rglob("*.py"))
    lines = (project_root / "docs/architecture.md").read_text().splitlines()
    rows = [line.strip("| ").split(" | ") for line in lines if line.startswith("| ") and line.count(" | ") == 2]
    steps = [row for row in rows if ".py`" in row[1]]
    assert len(steps) >= 40
    wrong: list[str] = []
    for _, place, what in steps:
        named = re.findall(r"`([\w/]+\.py)`", place)
        folder = named[0].rpartition("/")[0] if named else ""
        tried = {name: [core / folder / name, core / name, project_root / name] for name in named}
        files = {name: next((path for path in paths if path.is_file()), None) for name, paths in tried.items()}
        wrong += [f"no {name}" for name, path in files.items() if path is None]
        here = _defined(path for path in files.values() if path is not None)
        for number, name in enumerate(re.findall(r"`([A-Za-z_][\w.]*\w)`", what)):
            known = here if number == 0 and named else everything
            if not name.endswith(".py") and not known.issuperset(name.split(".")):
                wrong.append(f"{name} in {place}")
    assert not wrong


def _defined(paths: Iterable[Path]) -> set[str]:
    """Functions, classes, and names that are assigned or declared."""
    found = (re.findall(r"\b(?:def|class) (\w+)|^ *(\w+) *[:=]", path.read_text(), re.MULTILINE) for path in paths)
    return {name for pairs in found for pair in pairs for name in pair if name}
