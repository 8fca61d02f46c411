"""Damage of every kind: all of it accounted for by its true reason, and blind damage ends in errors of this project."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from pydantic import TypeAdapter

pytest.importorskip("h5py", reason="the extra `hdf5` is not installed")

import tools.corrupted.__main__ as command
from tools.corrupted import mutations
from tools.corrupted.attacks import ATTACKS
from tools.corrupted.corpus import outcomes, write_corpus
from tools.corrupted.mutations import attack, read_everything
from worldline_core.data.curation.curate import curate
from worldline_core.data.episodes.episode_index import read_quarantine
from worldline_core.data.guards.rejection import REASONS
from worldline_core.data.sources.open import SourceConfig
from worldline_core.filters.filter import filter_episodes
from worldline_core.filters.filter_config import FilterConfig


@pytest.mark.slow
def test_every_damaged_recording_is_accounted_for_by_its_true_reason(tmp_path: Path) -> None:
    labels, config = write_corpus(tmp_path, healthy=2, each=1, seed=3)
    assert len({label.kind for label in labels}) >= 36

    counts = curate(config, {}, tmp_path / "curated")
    assert counts["found"] == len(labels) == counts["kept"] + counts["quarantined"]
    filtered = filter_episodes(FilterConfig(), {"episodes": tmp_path / "curated"}, tmp_path / "filtered")
    assert filtered["found"] == counts["kept"] == filtered["kept"] + filtered["quarantined"]

    found = outcomes(tmp_path / "curated", tmp_path / "filtered")
    assert set(found) == {label.episode_id for label in labels}
    assert [(label, found[label.episode_id]) for label in labels if found[label.episode_id] not in label.endings] == []

    rows = read_quarantine(tmp_path / "curated")
    assert {row.reason for row in rows} <= set(REASONS)
    assert not any(str(tmp_path) in row.detail + row.evidence for row in rows), (
        "a set must not name this machine's folders"
    )
    assert all(row.detail.strip() for row in rows)


def test_the_table_of_attacks_names_a_wrong_ending(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    playlist = next(attack for attack in ATTACKS if attack.name == "a playlist")
    sound = replace(playlist, name="nothing", change=lambda _: None, endings=("read",))
    for attacks, right in (((playlist, sound), True), ((replace(playlist, endings=("read",)), sound), False)):
        monkeypatch.setattr(command, "ATTACKS", attacks)
        assert command.report_attacks(tmp_path / str(right)) is right
        rows = capsys.readouterr().out.splitlines()[2:]
        assert [row.split(" | ")[2] for row in rows] == ["unreadable", "read"]
        assert [row.split(" | ")[4] for row in rows] == [f"{right} |", "True |"]


@pytest.mark.slow
def test_the_command_names_every_damage(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        command.main(["damage", "--each", "1", "--seed", "5"])
    printed = capsys.readouterr().out
    assert ended.value.code == 0, printed
    assert "WRONG" not in printed and len(printed.splitlines()) >= 38


LAYOUTS = (
    "lerobot_v21", "lerobot_v3", "episode_set", "agibot_world", "agibot_gesim", "enerverse_ac", "droid_annotation", "mcap",
    "robotwin", "robomind", "unitree_h5", "video_folder",
)  # fmt: skip
CASES = 60
"""The fast tests try the first five of them, the slow tests all."""


@pytest.fixture(scope="module")
def sources(layouts: dict[str, dict[str, Any]]) -> dict[str, SourceConfig]:
    return {name: TypeAdapter(SourceConfig).validate_python(source) for name, source in layouts.items()}


@pytest.mark.parametrize("cases", [CASES // 12, pytest.param(CASES, marks=pytest.mark.slow)])
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
    assert {error.split()[0] for error in found} & {"KeyError", "TypeError", "JSONDecodeError"}
