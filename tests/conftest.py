"""Fixtures that several test folders share."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

PROJECT_ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def project_root() -> Path:
    return PROJECT_ROOT


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Real samples that may not be copied into the project; they lie beside the checkout."""
    folder = Path(os.environ.get("WORLDLINE_SHARED", PROJECT_ROOT.parent / "shared")) / "data"
    if not folder.is_dir():
        pytest.skip(f"the real samples are not here (looked in {folder})")
    return folder
