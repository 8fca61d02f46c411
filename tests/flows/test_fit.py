"""`worldline fit`: its options, where it stops, and a whole run from a LeRobot dataset to a model that can be driven."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import flows.fit_command
from flows.command_line import main
from flows.fit import with_cameras
from flows.fit_command import overrides_of
from worldline_core.calibration.estimate.estimate_config import EstimateConfig
from worldline_core.config import read_config
from worldline_core.data.episodes.conventions import RecordedConventions
from worldline_core.data.sources.open import open_source
from worldline_core.discovery.findings import write_config
from worldline_core.discovery.look import discover
from worldline_core.pipeline.pipeline_config import PipelineConfig
from worldline_core.rollout.worldline import WorldLine

sys.path.insert(0, str(Path(__file__).parents[1] / "discovery"))
from recorded_sets import SO_NAMES, motion, pictures, so101_states, write_lerobot, write_so101, write_video


@pytest.fixture
def here(tmp_path: Path, project_root: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder of a user, who has the project's assets."""
    (tmp_path / "artifacts").mkdir()
    (tmp_path / "artifacts" / "shipped").symlink_to(project_root / "artifacts" / "shipped")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def own(here: Path) -> Path:
    """The configuration that `worldline init` writes of a dataset of a user's."""
    write_so101(here / "raw")
    write_config(discover(here / "raw"), here / "my.yaml", "raw")
    return here / "my.yaml"


@pytest.mark.parametrize("preset", ["my_robot", "edge-24gb"])
def test_minutes_are_shared_out_and_a_gpu_does_all_of_the_work(own: Path, preset: str) -> None:
    own.write_text(own.read_text().replace("extends: my_robot", f"extends: {preset}"))
    config = PipelineConfig.load(None, own, overrides_of(8.0, "24GB", 500, read_config(None, own)))
    steps = config.distill
    stages: tuple[Any, ...] = (
        config.train_stage1, config.train_stage2, steps.teacher_forcing, steps.trajectory_regression, steps.distribution_matching,
    )  # fmt: skip
    trainers = [stage.trainer for stage in stages if stage is not None]
    assert sum(trainer.minutes or 0 for trainer in trainers) == pytest.approx(8.0)
    assert {trainer.device for trainer in trainers} == {config.encode_latents.device} == {"cuda"}
    assert config.train_stage2.action_following is not None
    assert config.train_stage2.action_following.stop_when_ignored == 500
    predicted = [run.config.device for run in config.rollouts.values() if run.config is not None and run.checkpoint]
    assert set(predicted) == {"cuda"}


def test_trainings_that_are_left_out_get_no_minutes(own: Path) -> None:
    own.write_text(own.read_text() + "\ndistill: {last_step: teacher_forcing}\n")
    changes = overrides_of(8.0, None, None, read_config(None, own))
    config = PipelineConfig.load(None, own, changes)
    stages = (config.train_stage1, config.train_stage2, config.distill.teacher_forcing)
    assert sum(stage.trainer.minutes or 0 for stage in stages if stage is not None) == pytest.approx(8.0)
    assert not any("trajectory_regression" in change or "distribution_matching" in change for change in changes)


def test_cameras_are_estimated_where_a_robot_is_known_and_no_file_is_named(own: Path, here: Path) -> None:
    config = PipelineConfig.load(None, own)
    assert EstimateConfig.of(config.curate, {}) is not None
    camera = {"width": 64, "height": 48, "K": [[60, 0, 31.5], [0, 60, 23.5], [0, 0, 1]], "T": np.eye(4).tolist()}
    (here / "cameras.json").write_text(json.dumps({"views": {"right_wrist": {}}}))
    (here / "estimate.json").write_text(json.dumps({"image_lags": {"head": -2, "right_wrist": -2}}))
    assert with_cameras(config, here / "cameras.json").train_segmenter is None
    views = {"head": camera | {"maps": "camera_to_base", "axes": "opencv"}}
    (here / "cameras.json").write_text(json.dumps({"views": views}))
    found = with_cameras(config, here / "cameras.json")
    assert found.render_actions is not None and config.render_actions is None
    sizes = [each.train_stage2.native_size for each in (config, found)]
    assert sizes == [6, 6]  # the wrist view has no camera
    (here / "both.json").write_text(json.dumps({"views": views | {"right_wrist": {}}}))
    assert with_cameras(config, here / "both.json").train_stage2.native_size is None
    assert found.curate.sources[0].conventions == RecordedConventions(image_lag_frames=-2)
    assert found.train_segmenter is not None and found.train_segmenter.labels == "kinematic"
    assert EstimateConfig.of(found.curate, {}) is None
    source = open_source(found.curate.sources[0], here / "raw")
    assert list(source.load(source.episode_ids()[0]).episode.cameras) == ["head"]
    assert here / "cameras.json" in found.curate.weights_read().values()  # its content counts in the cache key
    robotless = config.curate.sources[0].model_copy(update={"embodiment": "none"})
    assert EstimateConfig.of(config.curate.model_copy(update={"sources": (robotless,)}), {}) is None
    assert EstimateConfig.of(PipelineConfig.load("tiny").curate, {}) is None


def test_it_stops_where_a_person_must_decide_and_goes_on_with_the_answer(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ran: list[tuple[Any, ...]] = []

    def flow(_flow: Any, *arguments: Any) -> Any:
        ran.append(arguments)
        return type("Report", (), {"path": Path("report")})

    monkeypatch.setattr("tasks.execution.prefect_artifacts.run_flow", flow)
    monkeypatch.setattr(flows.fit_command, "prepare_prefect", lambda artifacts: None)
    states = [np.concatenate([motion(7, 60, seed), 0.1 + 0.5 * motion(1, 60, seed)], axis=1) for seed in range(3)]
    names = [f"motor_{number}" for number in range(8)]
    videos = {"observation.images.front": [pictures(state[:, :7], "still") for state in states]}
    write_lerobot(here / "raw", {"observation.state": (names, states)}, videos, robot=None)
    with pytest.raises(SystemExit, match="1"):
        main(["fit", "raw"])
    assert "todo.embodiment" in capsys.readouterr().err and not ran
    answers = ("embodiment=franka_panda", "right_gripper_closed=0", "right_gripper_open=1")
    written = (here / "my.yaml").read_bytes()
    main(["fit", "raw", *(part for answer in answers for part in ("--set", f"todo.{answer}"))])
    assert len(ran) == 1 and (here / "my.yaml").read_bytes() == written
    assert "worldline play --set model=" in capsys.readouterr().out


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    with pytest.raises(SystemExit, match="1"):
        main(["fit", *arguments])
    return capsys.readouterr().err


@pytest.mark.slow
def test_a_card_that_is_too_small_is_named_before_anything_runs(
    own: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("worldline_core.model.tokenizers.require_device", lambda device: None)
    assert "worldline plan --config my.yaml" in refused(capsys, "raw", "--gpu", "10MB")


def test_what_cannot_run_is_refused_at_once(own: Path, here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    if not torch.cuda.is_available():
        assert "cuda" in refused(capsys, "raw", "--gpu", "24GB")
    write_so101(here / "other")
    assert "of other recordings" in refused(capsys, "other")
    write_video(here / "videos" / "one.mp4", pictures(so101_states()[0][:, :5], "still"), 30)
    assert "video_folder" in refused(capsys, "videos", "--config", "videos.yaml")
    assert not (here / "artifacts" / "curate").exists()


@pytest.mark.slow
def test_a_dataset_without_cameras_becomes_a_model_that_can_be_driven(prefect_server: None, here: Path) -> None:
    """Seconds of training; that the model is good takes minutes."""
    write_so101(here / "raw")
    command = ["fit", "raw", "--minutes", "0.5", "--set", "distill.trajectory_regression.trajectories.clips=8"]
    main(command)
    latest = here / "artifacts" / "latest"
    assert "tool error" in (latest / "report" / "training.html").read_text().lower()
    verdict = (latest / "estimate_cameras" / "estimate.json").read_text()
    assert '"unsure"' in verdict and not (latest / "estimate_cameras" / "cameras.json").exists()
    world = WorldLine.from_pretrained(latest / "distill")
    rows = np.concatenate([np.deg2rad(so101_states()[0][:, :5]), so101_states()[0][:, 5:] / 100], axis=1)
    count = 1 + 2 * world.frames_per_unit
    images = {view: np.zeros((48, 64, 3), np.uint8) for view in ("head", "right_wrist")}
    videos = world.predict(images, rows[:count], {}, embodiment="so101")
    assert {len(video) for video in videos.values()} == {count}
    assert len(SO_NAMES) == rows.shape[1]
    main(command)  # all is there
