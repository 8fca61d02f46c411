"""No two modules need each other, and no two folders import each other."""

from __future__ import annotations

import re
from collections import defaultdict
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import grimp
import pytest

PACKAGES = ("worldline_core", "tasks", "flows")


@pytest.fixture(scope="module")
def imports() -> dict[str, set[str]]:
    """The modules and libraries that each module imports, also inside of functions."""
    graph = grimp.build_graph(*PACKAGES, include_external_packages=True)
    return {module: set(graph.find_modules_directly_imported_by(module)) for module in graph.modules}


def test_no_import_circles(imports: dict[str, set[str]]) -> None:
    assert len(imports) > 100
    try:
        TopologicalSorter(imports).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))


def test_no_two_folders_import_each_other(imports: dict[str, set[str]], project_root: Path) -> None:
    folders: dict[str, set[str]] = defaultdict(set)
    for module, imported in imports.items():
        for other in imported:
            here, there = (_folder(name, project_root) for name in (module, other))
            # A package's public names may come from inside of it.
            if here != there and not here.startswith(f"{there}/") and not there.startswith(f"{here}/"):
                folders[here].add(there)
    mutual = {(a, b) for a, others in folders.items() for b in others if a in folders.get(b, ()) and a < b}
    assert not mutual


def _folder(module: str, project_root: Path) -> str:
    path = module.replace(".", "/")
    return path if (project_root / path).is_dir() else path.rpartition("/")[0]


def test_the_core_needs_neither_prefect_nor_what_is_above_it(imports: dict[str, set[str]]) -> None:
    above = {"prefect", "tasks", "flows"}
    assert any("prefect" in libraries for libraries in imports.values())
    found = {module: {name for name in imported if name.split(".")[0] in above} for module, imported in imports.items()}
    assert {module: names for module, names in found.items() if names and module.startswith("worldline_core")} == {}


def test_a_public_class_has_a_name_of_its_own(project_root: Path) -> None:
    places: dict[str, list[str]] = defaultdict(list)
    for package in PACKAGES:
        for path in (project_root / package).rglob("*.py"):
            for name in re.findall(r"^class ([A-Z]\w*)", path.read_text(), re.MULTILINE):
                places[name].append(str(path))
    assert {name: files for name, files in places.items() if len(files) > 1} == {}
