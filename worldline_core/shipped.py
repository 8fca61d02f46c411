"""Folders of the recordings, candidate banks, robots and models that come with the project."""

from __future__ import annotations

import importlib.util
from pathlib import Path

SHIPPED = Path("artifacts", "shipped")
"""Their place in a checkout, and how presets name it."""


def shipped_folder() -> Path:
    """The shipped files: a checkout's ``artifacts/shipped``, or those of the installed package ``worldline_assets``.

    Without either the path is that of the working folder; whatever is opened there then says that it is missing.
    """
    checkout = Path(__file__).resolve().parents[1] / SHIPPED
    if checkout.is_dir():
        return checkout
    package = importlib.util.find_spec("worldline_assets")
    if package is not None and package.submodule_search_locations:
        return Path(package.submodule_search_locations[0]) / "shipped"
    return Path.cwd() / SHIPPED


def project_path(project: Path, path: Path) -> Path:
    """A folder that a preset names: relative ones are in ``project``; ``artifacts/shipped`` comes with the project where
    ``project`` has none."""
    here = project / path
    if here.exists() or path.is_absolute() or path.parts[: len(SHIPPED.parts)] != SHIPPED.parts:
        return here
    return shipped_folder() / path.relative_to(SHIPPED)
