"""Inspection tells what an artifact is and shows it."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from PIL import Image

from worldline_core.errors import ArtifactError
from worldline_core.report.inspect import inspect


@pytest.mark.parametrize(
    ("name", "kind", "says", "pictures"),
    [
        ("curate", "EpisodeSet", "quarantine: 1", True),
        ("render_actions", "ActionTracks", "6 episodes", True),
        ("rollout.shipped_causal", "RolloutSet", "method: shipped_causal 12", True),
        ("evaluate_video", "Scores", "robot_iou_exact", False),
    ],
)
def test_kinds(run_artifacts: dict[str, Path], tmp_path: Path, name: str, kind: str, says: str, pictures: bool) -> None:
    found = inspect(run_artifacts[name], tmp_path, episodes=run_artifacts["curate"])
    assert found.kind == kind
    assert says in str(found)
    assert (tmp_path / "contact_sheet.png").is_file() == pictures
    if pictures:
        with Image.open(tmp_path / "contact_sheet.png") as picture:
            assert picture.width > 300


def test_report_is_recognised(full_report: Path, tmp_path: Path) -> None:
    assert inspect(full_report, tmp_path).kind == "Report"


def test_pictures_go_to_run_by_default(run_artifacts: dict[str, Path], tmp_path: Path) -> None:
    folder = tmp_path / "set"
    shutil.copytree(run_artifacts["curate"], folder)
    found = inspect(folder, rerun=True)
    assert [path.relative_to(folder).parts[0] for path in found.written] == ["run", "run"]
    assert found.written[1].suffix == ".rrd"


def test_unknown_folders_are_named(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("nothing")
    with pytest.raises(ArtifactError, match=r"(?s)known kind.*notes\.txt"):
        inspect(tmp_path)
    with pytest.raises(ArtifactError, match="No such artifact"):
        inspect(tmp_path / "absent")
