"""An installation without extras and groups has what the project needs: no more, no less."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterable, Iterator
from importlib.metadata import PackageNotFoundError, distribution, packages_distributions
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from worldline_core.doctor import third_party_licences

PACKAGES = ("worldline_core", "tasks", "flows")
NOT_IMPORTED = {"fastapi": "a bound for Prefect's server", "torchvision": "imported by transformers' video processors"}


def canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


@pytest.fixture(scope="module")
def project(project_root: Path) -> dict:
    return tomllib.loads((project_root / "pyproject.toml").read_text())["project"]


def test_licences_of_packages_bundled_libraries_and_shipped_files_are_listed(project_root: Path) -> None:
    lines = {line.partition(":")[0]: line for line in third_party_licences(project_root)}
    av = next(line for name, line in lines.items() if name.startswith("av "))
    assert re.search(r"BSD-3-Clause; in its wheel: .*libdav1d.* \(libx264 and libx265: GPL-2.0-or-later\)", av)
    assert next(line for name, line in lines.items() if name.startswith("pyarrow ")).count("Apache") == 1
    for path in sorted((project_root / "artifacts/shipped/robots").glob("*/LICENSE")):
        assert "License" in lines[str(path)]


def names(requirements: Iterable[str]) -> set[str]:
    return {canonical(Requirement(text).name) for text in requirements}


def closure(requirements: Iterable[str]) -> set[str]:
    """Installed packages that these requirements bring."""
    found: set[str] = set()
    seen: set[tuple[str, str]] = set()
    waiting = [(wanted, extra) for wanted in map(Requirement, requirements) for extra in ("", *wanted.extras)]
    while waiting:
        wanted, extra = waiting.pop()
        name = canonical(wanted.name)
        if (name, extra) in seen:
            continue
        seen.add((name, extra))
        try:
            needed = [Requirement(text) for text in distribution(name).requires or ()]
        except PackageNotFoundError:
            continue
        found.add(name)
        for further in needed:
            if further.marker is None or further.marker.evaluate({"extra": extra}):
                waiting += [(further, wish) for wish in ("", *further.extras)]
    return found


def modules(package: str) -> set[str]:
    """Return the names that an installed package is imported by; `packages_distributions` reads the file lists of all of them."""
    try:
        found = distribution(package)
    except PackageNotFoundError:
        return set()
    named = (found.read_text("top_level.txt") or "").split()
    files = (found.read_text("RECORD") or "").splitlines()  # parsed by `found.files`, which takes a second
    return set(named) or {re.split("[/,]", file)[0].removesuffix(".py") for file in files}


def statements(node: ast.AST) -> Iterator[ast.AST]:
    """All statements below this one; expressions hold no imports, and are most of a file."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.stmt | ast.excepthandler | ast.match_case):
            yield child
            yield from statements(child)


def imported(project_root: Path) -> dict[str, set[str]]:
    """Third-party module -> files of the project that import it."""
    own = {*sys.stdlib_module_names, *PACKAGES, "worldline_assets"}
    found: dict[str, set[str]] = {}
    files = [file for package in PACKAGES for file in (project_root / package).rglob("*.py")]
    assert len(files) > 100
    for file in files:
        for node in statements(ast.parse(file.read_text())):
            modules = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.level == 0:
                modules = [str(node.module)]
            for module in {name.split(".")[0] for name in modules} - own:
                found.setdefault(module, set()).add(str(file.relative_to(project_root)))
    return found


@pytest.mark.slow
def test_every_import_is_declared_and_every_dependency_imported(project_root: Path, project: dict) -> None:
    declared = names(project["dependencies"])
    extras = project["optional-dependencies"]
    optional = {*extras, *names(text for extra in extras.values() for text in extra)}  # dask comes by the extra `dask`
    distributions: dict[str, set[str]] = {}
    for name in declared | optional:
        for module in modules(name):
            distributions.setdefault(module, set()).add(name)
    used: set[str] = set()
    for module, files in imported(project_root).items():
        owners = distributions.get(module) or {canonical(module)}  # of an extra that is not installed
        assert owners & (declared | optional), f"{module} of {sorted(files)} is not declared"
        used |= owners
    assert declared - used == set(NOT_IMPORTED)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_default_installation_is_enough(project_root: Path, project: dict) -> None:
    """Everything that the extras and the groups bring is hidden; two packages alone are for one extra each."""
    kept = closure(project["dependencies"])
    hidden = sorted(
        module
        for module, owners in packages_distributions().items()
        if not {canonical(name) for name in owners} & kept and module not in {*PACKAGES, "worldline_assets"}
    )
    assert {"lerobot", "skimage", "datasets", "pandas", "mujoco", "h5py", "pytest"} <= set(hidden)
    code = f"""
import importlib, pkgutil, sys
for module in {hidden}:
    sys.modules[module] = None
for package in {PACKAGES}:
    for found in pkgutil.walk_packages(importlib.import_module(package).__path__, package + "."):
        try:
            importlib.import_module(found.name)
        except ImportError as error:
            needs = dict(recorder="mujoco", environment="gymnasium").get(found.name.split(".")[1], "nothing else")
            assert needs in str(error), (found.name, error)
from flows.command_line import main
for arguments in (["--help"], ["doctor"]):
    try:
        main(arguments)
    except SystemExit as ended:
        assert not ended.code, (arguments, ended.code)
print("enough")
"""
    result = subprocess.run([sys.executable, "-c", code], cwd=project_root, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert result.stdout.endswith("enough\n")
    assert "extra hdf5" in result.stdout
