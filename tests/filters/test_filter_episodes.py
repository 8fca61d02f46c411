"""The whole step on a recording whose tool poses are recorded, with one defect an episode."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from benchmarks.calibration import as_tool_poses
from tools.labelled_clips import Clip, at_frames
from worldline_core.data.episodes.episode import VIEWS, Episode
from worldline_core.data.episodes.episode_index import read_quarantine
from worldline_core.data.episodes.episode_set import EpisodeSet, EpisodeSetWriter
from worldline_core.data.episodes.episode_set_writer import part_name
from worldline_core.errors import ArtifactError, ConfigError, DataError
from worldline_core.filters.filter import filter_episodes
from worldline_core.filters.filter_config import FilterConfig
from worldline_core.filters.signals import tool_poses
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.geometry.transforms import rigid_inverse


def spoiled(recording: Clip, number: int) -> tuple[Episode, dict[str, np.ndarray]]:
    """The recording as tool poses of a robot that nobody describes, at half its size, with a defect."""
    if number == 7:  # nothing happens
        recording = at_frames(recording, np.zeros(recording.episode.num_frames, int))
    robot = ArmKinematics(load_embodiment(recording.episode.embodiment))
    names = {"episode_id": f"e{number:02d}", "source": "judged" if number == 3 else "tests", "scene": f"s{number}"}
    episode = replace(as_tool_poses(recording.episode, robot), embodiment="points", **names)
    frames = {view: images[:, ::2, ::2].copy() for view, images in recording.frames.items()}
    cameras = {view: camera.resized(96, 64) for view, camera in episode.cameras.items()}
    if number == 1:  # frozen
        frames["head"][6:] = frames["head"][6]
    elif number == 2:  # a few black frames at the end
        frames["head"][28:31] = 0
    elif number == 3:
        wrist = cameras["left_wrist"]
        cameras["left_wrist"] = replace(wrist, T_base_camera=rigid_inverse(wrist.T_base_camera))
    elif number == 4:  # states four frames late
        late = np.maximum(np.arange(episode.num_frames) - 4, 0)
        episode = replace(episode, T_base_ee=episode.T_base_ee[late], state=episode.state[late])  # type: ignore[index]
    elif number == 5:
        aside = np.eye(4)
        aside[:2, 3] = 0.3, 0.25
        cameras["head"] = replace(cameras["head"], T_base_camera=cameras["head"].T_base_camera @ aside)
    elif number == 6:
        del frames["right_wrist"], cameras["right_wrist"]
    return replace(episode, cameras=cameras), frames


# At one frame in two seconds there is too little to search the calibration for mistakes: one episode is enough for that.
FEW = {"doctor": {"rate_hz": 0.5}}
CONFIG = FilterConfig.model_validate({"required_views": VIEWS, "sources": {"tests": FEW}})
Filtered = tuple[Path, Path, dict[str, Any]]


@pytest.fixture(scope="module")
def filtered(recording: Clip, tmp_path_factory: pytest.TempPathFactory) -> Filtered:
    root = tmp_path_factory.mktemp("filter")
    with EpisodeSetWriter(root / "curated", video_crf=6, pixel_format="yuv444p") as writer:
        for number in range(8):
            writer.add(*spoiled(recording, number))
    counts = filter_episodes(CONFIG, {"episodes": root / "curated"}, root / "filtered")
    return root / "curated", root / "filtered", counts


def test_every_defect_is_found_and_healthy_episodes_pass(filtered: Filtered) -> None:
    _, output, counts = filtered
    passed = EpisodeSet.open(output)
    assert {row.episode_id: row.reason for row in passed.quarantine()} == {"e01": "corrupted", "e07": "static"}
    assert {row.episode_id: row.stage2_reason for row in passed.rows} == {
        "e00": None, "e02": None, "e03": "calibration", "e04": "time_alignment", "e05": "projection",
        "e06": "missing_view",
    }  # fmt: skip
    assert all(row.stage1_ok and row.stage2_ok == (row.stage2_reason is None) for row in passed.rows)
    assert counts["found"] == counts["kept"] + counts["quarantined"] == 8
    assert counts["reasons"] == {"corrupted": 1, "static": 1}
    assert counts["stage2_reasons"] == {"calibration": 1, "missing_view": 1, "projection": 1, "time_alignment": 1}


def test_kept_rows_point_into_the_curated_set(filtered: Filtered) -> None:
    curated_path, output, counts = filtered
    curated, passed = EpisodeSet.open(curated_path), EpisodeSet.open(output)
    row = passed.rows[1]
    assert (row.episode_id, row.start, row.stop, row.num_frames) == ("e02", 0, 28, 28)
    assert row.dataset == "../curated/datasets/points"
    assert np.array_equal(passed.frames(1, "head"), curated.frames(2, "head")[:28])
    assert counts["cut_frames"] == 5
    assert not list(output.rglob("*.mp4"))
    rows = pq.read_table(output / "findings.parquet").to_pylist()
    findings = {(row["episode_id"], row["detector"]): row for row in reversed(rows)}  # of the first view
    assert findings["e02", "too_dark"]["cut_frames"] == 3
    dark, late = (json.loads(findings[key]["numbers"]) for key in (("e02", "too_dark"), ("e04", "pose_lag")))
    assert (dark["cut"], dark["thresholds"], abs(late["pose_lag_s"])) == ([[28, 31]], "tests", pytest.approx(0.5))
    mistake = json.loads(findings["e03", "doctor"]["numbers"])
    assert (mistake["verdict"], mistake["thresholds"]) == ("explained", "default")


def test_a_restart_gives_the_same_bytes(filtered: Filtered, tmp_path: Path) -> None:
    curated, output, counts = filtered
    again = output.parent / "again"
    verdicts = again / "run" / "verdicts"
    verdicts.mkdir(parents=True)
    # All but one that the calibration was examined of and two that were dropped before.
    for path in sorted((output / "run" / "verdicts").iterdir()):
        if path.stem not in map(part_name, ("e00", "e01", "e07")):
            (verdicts / path.name).write_bytes(path.read_bytes())
    assert len(list(verdicts.iterdir())) == 5
    assert filter_episodes(CONFIG, {"episodes": curated}, again) == counts
    for name in ("index.parquet", "quarantine.parquet", "findings.parquet"):
        assert (again / name).read_bytes() == (output / name).read_bytes()


def test_nothing_left_is_an_error(filtered: Filtered, tmp_path: Path) -> None:
    curated, _, _ = filtered
    with pytest.raises(DataError, match=r"(?s)No episode passed.*out/quarantine\.parquet.*too_short.*the first, "):
        filter_episodes(FilterConfig(min_segment_frames=200), {"episodes": curated}, tmp_path / "out")
    assert "too_short" in {row.reason for row in read_quarantine(tmp_path / "out")}


def test_a_source_has_its_own_thresholds(filtered: Filtered, tmp_path: Path) -> None:
    curated, _, _ = filtered
    overrides = {"tests": FEW | {"static": {"min_run_s": 60}}, "judged": FEW, "elsewhere": {"min_segment_frames": 200}}
    config = FilterConfig.model_validate({"sources": overrides})
    assert config.for_source("tests").static == config.static.model_copy(update={"min_run_s": 60})
    assert config.for_source("other") == config
    counts = filter_episodes(config, {"episodes": curated}, tmp_path / "out")
    assert "static" not in counts["reasons"]  # the still episode is shorter than a minute
    findings = pq.read_table(tmp_path / "out" / "findings.parquet").to_pylist()
    assert {json.loads(finding["numbers"])["thresholds"] for finding in findings} == {"tests", "judged"}


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        ({"static": {"min_run": 2}}, r"(?s)filter\.sources\.agibot_world.*static\.min_run: unknown key.*min_run_s"),
        ({"blurr": {}}, r"(?s)filter\.sources\.agibot_world.*blurr: unknown key.*'blur'"),
        ({"static": {"min_run_s": -1}}, r"(?s)filter\.sources\.agibot_world.*static\.min_run_s"),
        ({"static": 3}, r"(?s)filter\.sources\.agibot_world.*static"),
        ({"sources": {}}, r"cannot be nested"),
    ],
)
def test_a_wrong_override_is_named(overrides: dict[str, Any], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        FilterConfig.model_validate({"sources": {"agibot_world": overrides}})


def test_a_robot_whose_description_is_not_here_is_left_out_not_fatal(recording, monkeypatch):
    monkeypatch.delenv("WORLDLINE_DESCRIPTION_AGIBOT_G1", raising=False)
    state = np.zeros((recording.episode.num_frames, 16), np.float32)
    undescribed = replace(recording.episode, embodiment="agibot_g1", state=state, action=state, state_names=None)
    assert tool_poses(undescribed) == (None, ())


@pytest.mark.parametrize("damage", [Path.unlink, lambda path: path.write_bytes(path.read_bytes()[:3000])])
@pytest.mark.parametrize("pattern", ["*.mp4", "cameras.parquet"])
def test_damaged_data_is_no_verdict_on_an_episode(filtered, tmp_path, pattern, damage):
    shutil.copytree(filtered[0], tmp_path / "set", ignore=shutil.ignore_patterns("thumbnails"))
    damage(sorted((tmp_path / "set").rglob(pattern))[0])
    with pytest.raises(ArtifactError, match="An input of this step is missing or damaged"):
        filter_episodes(FilterConfig(), {"episodes": tmp_path / "set"}, tmp_path / "out")
    assert not (tmp_path / "out" / "quarantine.parquet").exists()
