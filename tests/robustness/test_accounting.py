"""A small corpus with every kind of damage: all accounted for, each by the reason that is true."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("h5py", reason="the extra `hdf5` is not installed")

import tools.corrupted.__main__ as command
from tools.corrupted.attacks import ATTACKS
from tools.corrupted.corpus import confusion, is_right, outcomes, write_corpus
from worldline_core.data.curation.curate import curate
from worldline_core.data.episodes.episode_index import read_quarantine
from worldline_core.data.guards.rejection import REASONS
from worldline_core.filters.filter import filter_episodes
from worldline_core.filters.filter_config import FilterConfig


@pytest.mark.slow
def test_every_damaged_recording_is_accounted_for_by_its_true_reason(tmp_path: Path) -> None:
    labels, config = write_corpus(tmp_path, healthy=2, each=1, seed=3)
    assert len({label.kind for label in labels}) >= 40

    counts = curate(config, {}, tmp_path / "curated")
    assert counts["found"] == len(labels) == counts["kept"] + counts["quarantined"]
    filtered = filter_episodes(FilterConfig(), {"episodes": tmp_path / "curated"}, tmp_path / "filtered")
    assert filtered["found"] == counts["kept"] == filtered["kept"] + filtered["quarantined"]

    found = outcomes(tmp_path / "curated", tmp_path / "filtered")
    assert set(found) == {label.episode_id for label in labels}
    wrong = {label.kind for label in labels if not is_right(label, found[label.episode_id])}
    assert not wrong, {key: dict(ended) for key, ended in confusion(labels, found).items() if key[1] in wrong}

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
def test_the_command_runs_all_damage_and_all_attacks(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        command.main(["damage", "attacks", "mutations", "--each", "1", "--cases", "2", "--seed", "5"])
    printed = capsys.readouterr().out
    assert ended.value.code == 0, printed
    assert printed.count("100%") >= 50
    assert all(f"| {attack.layout} | {attack.name} |" in printed for attack in ATTACKS)
    assert printed.count("2 cases, 0 unexpected errors") >= 10
