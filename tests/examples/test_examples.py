"""Every example runs as its docstring says, on the shipped recordings, in small."""

import json
import runpy
import shutil
import subprocess
import sys

import numpy as np
import pytest

from flows.pipeline import chain
from tasks.execution.chain import outline, ready_inputs
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.video.clip import decode_video
from worldline_core.data.video.encoder import encode_video
from worldline_core.pipeline.pipeline_config import PipelineConfig
from worldline_core.store.store import ArtifactStore

pytestmark = pytest.mark.slow


def _run(project_root, name, *arguments, cwd=None):
    result = subprocess.run(
        [sys.executable, project_root / "examples" / name, *map(str, arguments)],
        cwd=cwd or project_root, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


def test_predict_a_video(project_root, tmp_path):
    printed = _run(project_root, "predict_video.py", "--frames", 17, "--output", tmp_path / "prediction.mp4")
    assert "17 frames" in printed
    assert decode_video(tmp_path / "prediction.mp4", expected_frames=17).shape == (17, 64, 2 * 96, 3)


def test_check_calibration(project_root, tmp_path):
    printed = _run(project_root, "check_calibration.py", "--episodes", 2, "--output", tmp_path)
    assert "2 episodes: 2 consistent" in printed
    assert (tmp_path / "index.html").is_file()


def test_evaluate_videos_of_another_simulator(project_root, tmp_path):
    calls = outline(chain, PipelineConfig.load("smoke"))
    store = ArtifactStore(tmp_path / "artifacts")
    for call in (calls["curate"], calls["filter"]):
        kept = call.task.run(store, call.config, ready_inputs(call, calls, store)).path
    episodes = EpisodeSet.open(kept)
    number, row = next((i, row) for i, row in enumerate(episodes.rows) if row.split == "test")
    # A simulator that predicts that nothing moves.
    frames = episodes.frames(number, "head")
    (tmp_path / "videos").mkdir()
    encode_video(tmp_path / "videos" / f"{row.episode_id}_head.mp4", frames[:1].repeat(len(frames), axis=0), row.fps)
    printed = _run(project_root, "evaluate_videos.py", tmp_path / "videos", kept, "--artifacts", tmp_path / "artifacts")
    assert all(word in printed for word in ("1 episodes", "robot_iou", "psnr@head"))


def test_plan_over_a_bank(project_root, tmp_path):
    printed = _run(project_root, "plan_over_bank.py", "--candidates", 2, "--artifacts", tmp_path)
    assert "true" in printed
    assert "N =  2: success" in printed


def test_train_on_a_lerobot_dataset(project_root, tmp_path):
    dataset = tmp_path / "dataset"
    shutil.copytree(project_root / "artifacts/shipped/recordings/datasets/viperx_pearl", dataset)
    shutil.rmtree(dataset / "meta" / "worldline")  # what a foreign dataset does not have
    short = [f"train_stage2.trainer.{value}" for value in ("minutes=null", "steps=2", "validation_batches=0")]
    options = [text for each in short for text in ("--set", each)]
    printed = _run(project_root, "train_on_lerobot.py", dataset, *options, cwd=tmp_path)
    assert "angle_unit: " in printed
    (trained,) = (tmp_path / "artifacts/train_stage2").glob("*/manifest.json")
    assert json.loads(trained.read_text())["metrics"]["steps"] == 2


def test_practise_a_controller_inside(project_root, tmp_path):
    pytest.importorskip("mujoco")
    recordings = tmp_path / "biased"
    config = "configs/recording/biased_controllers.yaml"
    record = [sys.executable, "-m", "flows.command_line", "record", "--config", config]
    changes = ("starts.families=[close]", "starts.count=4", "workers=1")
    options = [text for change in changes for text in ("--set", change)]
    subprocess.run([*record, *options, "--output", recordings], cwd=project_root, check=True, capture_output=True)
    search = ("--task", "close", "--starts", 1, "--rounds", 1, "--population", 4, "--batch", 4)
    printed = _run(project_root, "practice_inside.py", "--recordings", recordings, *search)
    found = json.loads(printed.splitlines()[-1])
    assert found["before"] == 0.0
    assert [found[world]["episodes"] for world in ("inside", "mujoco")] == [[4], [4]]
    # The right shift, the opposite of the bias, closes every drawer in MuJoCo: the tools went where they were to go.
    example = runpy.run_path(str(project_root / "examples" / "practice_inside.py"))
    controller = example["ShiftedController"](recordings, "biased", "close", "ur5e_silver")
    successes = example["physics"](recordings, "ur5e_silver")
    right = np.array([0.05, -0.03, 0.0])
    assert successes([(start, controller.shifted(start, right)) for start in controller.commands]) == [1.0] * 4
