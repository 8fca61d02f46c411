"""The line that the doctor prints, put into a curate configuration, repairs the recordings and lets them through."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import yaml

from tools.corrupted.conventions import corrupt, corrupted_image_frames
from worldline_core.calibration.calibration_doctor import diagnose
from worldline_core.data.curation.curate import curate
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.episodes.conventions import RecordedConventions
from worldline_core.data.episodes.episode_set import EpisodeSet, EpisodeSetWriter
from worldline_core.filters.filter import filter_episodes
from worldline_core.filters.filter_config import FilterConfig
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics

NAME = "xarm7_white-test-s1-00001"


@pytest.fixture(scope="module")
def shipped(project_root: Path) -> EpisodeSet:
    return EpisodeSet.open(project_root / "artifacts" / "shipped" / "recordings")


def written(folder: Path, shipped: EpisodeSet, conventions: RecordedConventions) -> None:
    """A set of one shipped recording that these conventions spoil."""
    position = shipped.position(NAME)
    healthy = shipped.episode(position)
    frames = {
        view: shipped.frames(position, view)[corrupted_image_frames(healthy.num_frames, conventions, view)]
        for view in shipped.rows[position].views
    }
    with EpisodeSetWriter(folder, video_crf=6, pixel_format="yuv444p") as writer:
        writer.add(corrupt(healthy, conventions), frames)


@pytest.mark.slow
@pytest.mark.parametrize(
    "mistake", [{"extrinsics": "base_to_camera"}, {"image_lag_frames": 3}, {"gripper": "inverted"}], ids=str
)
def test_curate_with_the_printed_line(tmp_path: Path, shipped: EpisodeSet, mistake: dict[str, Any]) -> None:
    conventions = RecordedConventions(**mistake)
    written(tmp_path / "spoiled", shipped, conventions)
    spoiled = EpisodeSet.open(tmp_path / "spoiled")
    kinematics = ArmKinematics(load_embodiment("xarm7_white"))
    frames = {view: spoiled.frames(0, view) for view in spoiled.rows[0].views}
    lines = diagnose(spoiled.episode(0), frames, kinematics).best.conventions.config_lines()
    assert lines == conventions.config_lines()
    declared = {line.split(".")[-1].split(":")[0]: yaml.safe_load(line.split(": ", 1)[1]) for line in lines}

    # As written, the filter says the line and refuses it for Stage II; nothing is repaired in silence.
    refused = filter_episodes(FilterConfig(), {"episodes": tmp_path / "spoiled"}, tmp_path / "refused")
    reasons = {"extrinsics": {"calibration": 1}, "image_lag_frames": {"time_alignment": 1}, "gripper": {}}
    assert refused["stage2_reasons"] == reasons[next(iter(mistake))]  # fingers of one episode are a weak sign
    findings = pq.read_table(tmp_path / "refused" / "findings.parquet").to_pylist()
    evidence = [json.loads(f["numbers"]) for f in findings if f["detector"] == "doctor"]
    assert [numbers["config"] for numbers in evidence] == ["; ".join(lines)]
    assert all(numbers["score_repaired"] > numbers["score_as_recorded"] + 3 for numbers in evidence)
    assert np.array_equal(
        EpisodeSet.open(tmp_path / "refused").episode(0).cameras["head"].T_base_camera,
        spoiled.episode(0).cameras["head"].T_base_camera,
    )

    source = {"kind": "episode_set", "path": str(tmp_path / "spoiled"), "conventions": declared}
    counts = curate(CurateConfig.model_validate({"sources": [source]}), {}, tmp_path / "curated")
    assert counts["kept"] == 1
    curated = EpisodeSet.open(tmp_path / "curated")
    lag, position = conventions.image_lag_frames, shipped.position(NAME)
    repaired, healthy = curated.episode(0), shipped.episode(position)
    kept = slice(lag, healthy.num_frames - lag)
    assert np.allclose(repaired.state, healthy.state[kept], atol=1e-6)
    for view, camera in healthy.cameras.items():
        wanted = camera.T_base_camera[kept] if camera.moving else camera.T_base_camera
        assert np.allclose(repaired.cameras[view].T_base_camera, wanted, atol=1e-9)
        assert np.abs(curated.frames(0, view) - shipped.frames(position, view)[kept].astype(float)).mean() < 4.0
    assert repaired.conventions[f"declared_{next(iter(mistake))}"] == str(next(iter(mistake.values())))
    passed = filter_episodes(FilterConfig(), {"episodes": tmp_path / "curated"}, tmp_path / "passed")
    assert passed["stage2_ok"] == passed["found"] == 1


@pytest.mark.slow
def test_the_shipped_recordings_pass_and_their_injected_defects_are_named(tmp_path: Path, project_root: Path) -> None:
    root = project_root / "artifacts" / "shipped" / "recordings"
    defects = json.loads((root / "injected_defects.json").read_text())
    filter_episodes(FilterConfig(), {"episodes": root}, tmp_path / "out")
    filtered = EpisodeSet.open(tmp_path / "out")
    refused = {row.episode_id.split("@")[0]: row.stage2_reason for row in filtered.rows if row.stage2_reason}
    refused |= {row.episode_id: row.reason for row in filtered.quarantine()}
    assert set(refused) <= set(defects)
    findings = pq.read_table(tmp_path / "out" / "findings.parquet").to_pylist()
    doctor = {f["episode_id"]: json.loads(f["numbers"]) for f in findings if f["detector"] == "doctor"}
    expected = {
        "lagged_state": "camera_lag_frames+image_lag_frames",
        "inverted_extrinsics": "extrinsics",
        "intrinsics_of_other_size": "intrinsics_size",
    }
    for name, defect in defects.items():
        if defect in expected:
            assert doctor[name]["mistake"] == expected[defect]
            assert name in refused
    cut = {f["episode_id"] for f in findings if f["cut_frames"]}
    assert {name for name, defect in defects.items() if defect in ("static_lead_in", "reset_segment")} <= cut
    assert {n for n, d in defects.items() if d in ("frozen_camera", "corrupted_frames")} <= set(refused) | cut
