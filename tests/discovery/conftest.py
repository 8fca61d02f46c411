from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

TESTS = Path(__file__).parents[1]
sys.path[:0] = [str(TESTS / "discovery"), str(TESTS / "data")]  # what writes the layouts


@pytest.fixture(scope="session")
def toy() -> ModuleType:
    """The ROS 2 robot of tests/mcap."""
    spec = importlib.util.spec_from_file_location("toy_robot", TESTS / "mcap/conftest.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["toy_robot"] = module
    spec.loader.exec_module(module)
    return module
