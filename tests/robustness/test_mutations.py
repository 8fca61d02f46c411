"""Blind damage to small real files of every layout: reading ends in episodes or in an error of this project."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from pydantic import TypeAdapter

pytest.importorskip("h5py", reason="the extra `hdf5` is not installed")

from tools.corrupted import mutations
from tools.corrupted.mutations import attack, read_everything
from tools.corrupted.one_of_each import write_one_of_each
from worldline_core.data.sources.open import SourceConfig

LAYOUTS = (
    "lerobot_v21",
    "lerobot_v3",
    "episode_set",
    "agibot_world",
    "agibot_gesim",
    "enerverse_ac",
    "droid_annotation",
    "mcap",
    "robotwin",
    "robomind",
    "unitree_h5",
    "video_folder",
)
CASES = 60
"""Of which the first fifteen are tried after every change, all with the slow tests."""


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> dict[str, SourceConfig]:
    written = write_one_of_each(tmp_path_factory.mktemp("layouts"))
    return {name: TypeAdapter(SourceConfig).validate_python(source) for name, source in written.items()}


@pytest.mark.parametrize("cases", [CASES // 4, pytest.param(CASES, marks=pytest.mark.slow)])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_damage_ends_in_a_named_error(sources: dict[str, SourceConfig], layout: str, cases: int) -> None:
    assert set(sources) == set(LAYOUTS)
    config = sources[layout]
    read_everything(config, config.path)
    unexpected = list(attack(config, config.path, cases, seed=1))
    assert not unexpected, unexpected
    read_everything(config, config.path)


def test_an_error_that_is_not_ours_is_found(sources: dict[str, SourceConfig], monkeypatch: pytest.MonkeyPatch) -> None:
    """The search itself: a reader that stumbles over a missing key is caught at it."""

    def careless(_limits: object, _read: object, _config: SourceConfig, root: Path) -> None:
        for path in root.rglob("*.json"):
            _ = json.loads(path.read_text())["fps"]

    monkeypatch.setattr(mutations, "read_limited", careless)
    config = sources["lerobot_v21"]
    found = list(attack(config, config.path, 60, seed=0))
    assert {error.error.split(":")[0] for error in found} & {"KeyError", "TypeError", "JSONDecodeError"}
