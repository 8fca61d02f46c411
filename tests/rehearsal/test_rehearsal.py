"""The rehearsal of the full-size preset: what it changes, what it refuses, and (slow) the whole of it."""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from tasks.execution.command_line import add_task_arguments
from worldline_core import WorldLine
from worldline_core.config import load_config
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.errors import UnavailableError
from worldline_core.model.checkpoint import read_checkpoint_info
from worldline_core.pipeline.pipeline_config import PipelineConfig, check_weights
from worldline_core.processor import processor_has_bfloat16
from worldline_core.rehearsal.outside_models import OUTSIDE_MODELS, write_outside_models
from worldline_core.rehearsal.rehearsal import ABLATION_SIZES, changes_of, table
from worldline_core.report.ablation_table import load_variants
from worldline_core.serving.serve_config import ServeConfig
from worldline_core.serving.session_host import SessionHost
from worldline_core.store.artifact_files import finished_artifacts, read_manifest

PRESET = "cosmos3-nano"
SIZES = {"image_size", "device", "steps", "workers", "student_layer", "clips", "start_step", "seeds", "sources",
         "steps_at_once"}  # fmt: skip
if not processor_has_bfloat16():
    SIZES |= {"precision", "weights", "bfloat16"}
FOLDERS = ("Cosmos3-Nano/vae", "Cosmos3-Nano/text_tokenizer", "base", "vjepa2-vitg-fpc64-384", "lpips", "sam3",
           "Qwen3-VL-8B-Instruct")  # fmt: skip


def test_sizes_are_the_only_change_and_each_is_listed() -> None:
    changes = changes_of(PRESET, None, ())
    besides = changes_of(PRESET, None, [change.override for change in changes], ABLATION_SIZES)
    assert {change.key.rpartition(".")[2] for change in besides} == {"seeds", "num_frames"}
    assert {change.key.rpartition(".")[2] for change in changes} == SIZES
    before = load_config(PipelineConfig, preset=PRESET).model_dump(mode="json")
    after = load_config(PipelineConfig, preset=PRESET, overrides=[change.override for change in changes])
    values = after.model_dump(mode="json")
    for change in changes:
        *path, last = change.key.split(".")
        place, original = values, before
        for name in path:
            place, original = place[name], original[name]
        assert place[last] != original[last]
        place[last] = original[last]
        assert f"| {change.key} " in table(changes)
    assert values == before
    assert [source.path for source in after.curate.sources] == [Path("recordings"), Path("recordings_two_views")]
    causal = after.rollouts["causal"].config
    assert causal.num_frames == 129
    assert after.train_stage2.relational is not None


@pytest.mark.parametrize("name", FOLDERS)
def test_a_missing_folder_of_weights_is_named_before_the_first_step(name: str, tmp_path: Path) -> None:
    config = load_config(PipelineConfig, preset=PRESET)
    folders = {each: tmp_path / "weights" / each for each in FOLDERS}
    for folder in folders.values():
        folder.mkdir(parents=True)
        (folder / "config.json").write_text("{}")
    check_weights(config, tmp_path)
    (folders[name] / "config.json").unlink()
    with pytest.raises(UnavailableError, match=rf"weights/{name}"):  # empty
        check_weights(config, tmp_path)
    folders[name].rmdir()
    advice = "import_backbone" if name == "base" else "download"
    with pytest.raises(UnavailableError, match=rf"(?s)got: [^\n]*weights/{name}.*next step:.*{advice}"):
        check_weights(config, tmp_path)


def test_torchrun_hands_the_name_of_a_call_on() -> None:
    """It would take a `--node` for a short form of an option of its own."""
    from torch.distributed.run import parse_args

    given = ["--name", "train_stage2.head_only"]
    handed = parse_args(["--nproc-per-node", "2", "-m", "tasks.train_stage2", *given]).training_script_args
    parser = argparse.ArgumentParser()
    add_task_arguments(parser)
    assert parser.parse_args(handed).name == "train_stage2.head_only"


def rehearse(folder: Path, project_root: Path, *options: str) -> Path:
    """The folder of a whole rehearsal."""
    environment = {
        **os.environ,
        "PYTHONPATH": str(project_root),
        "OMP_NUM_THREADS": "1",
        "PREFECT_HOME": str(folder / "p"),
    }
    environment.pop("PREFECT_API_URL", None)
    command = [sys.executable, "-m", "flows.command_line", "rehearse", "--output", "rehearsal", *options]
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=1500, check=False
    )
    assert done.returncode == 0, (done.stdout + done.stderr)[-6000:]
    return folder / "rehearsal"


@pytest.mark.slow
def test_the_preset_of_one_card_runs_from_import_to_play(tmp_path: Path, project_root: Path) -> None:
    """About two minutes of one core."""
    folder = rehearse(tmp_path, project_root, "--preset", "edge-24gb", "--processes", "1", "--without-ablations")
    latest = folder / "artifacts" / "latest"
    assert read_manifest(latest / "train_stage2")["config"]["trainer"]["optimizer"]["moments"] == "8bit"
    assert read_checkpoint_info(latest / "distill").config.feed_forward == "squared_relu"
    world = WorldLine.from_pretrained(latest / "distill")
    host = SessionHost(world, ServeConfig(model=latest / "distill", episodes=latest / "filter"))
    simulation = host.simulate("ur5e_silver-test-s1-00001", [0])
    (frames,) = simulation.step(np.repeat(simulation.state[:, None], world.frames_per_unit, axis=1))
    host.shut_down()
    assert {view: video.shape for view, video in frames.items()} == dict.fromkeys(
        VIEWS, (world.frames_per_unit, 64, 96, 3)
    )


@pytest.mark.slow
@pytest.mark.timeout(1560)
def test_the_full_size_preset_runs_from_import_to_report(tmp_path: Path, project_root: Path) -> None:
    """About ten minutes of two cores."""
    folder = rehearse(tmp_path, project_root, "--preset", PRESET)
    assert "train_stage2.relational.student_layer" in (folder / "changes.md").read_text()
    assert (folder / "artifacts" / "report" / "latest" / "index.html").is_file()
    for name in OUTSIDE_MODELS:
        assert any((folder / "weights" / name).iterdir())
    manifests = {}
    for artifact in finished_artifacts(folder / "artifacts"):
        manifests.setdefault(artifact.parent.name, []).append(read_manifest(artifact))
    for step in ("train_stage1", "train_stage2"):
        assert any(manifest["environment"]["processes"] == 2 for manifest in manifests[step])
    assert all(manifest["environment"]["processes"] == 2 for manifest in manifests["distill"])
    assert any(manifest["metrics"].get("relational_intra", 0) > 0 for manifest in manifests["train_stage2"])
    assert [manifest["metrics"]["lpips"] for manifest in manifests["distill"]] == ["on"]
    (ablations,) = (folder / "artifacts" / "ablation_table").glob("*/table.parquet")
    rows = {cell["variant"] for cell in pq.read_table(ablations).to_pylist() if cell["mean"] is not None}
    variants = load_variants().keys()
    assert rows == variants
    assert len(manifests["train_stage2"]) == len(variants)
    whole = [rollout for rollout in manifests["rollout"] if rollout["config"]["num_frames"] == 129]
    assert {rollout["config"]["method"] for rollout in whole} == load_config(
        PipelineConfig, preset=PRESET
    ).rollouts.keys()
    assert len(manifests["rollout"]) == len(whole) + len(variants)
    videos = (folder / "artifacts" / "evaluate_video").glob("*/summary.json")
    (video,) = (path for path in videos if "backbone" in json.loads(path.read_text())["methods"])
    assert {"lpips", "robot_iou", "psnr"} <= set(json.dumps(json.loads(video.read_text())).replace('"', " ").split())
    assert manifests["evaluate_policy"][0]["config"]["judge"] == "qwen3_vl"
    for rollout in whole:  # two recordings of three views, two of two
        found, seeds = rollout["metrics"], len(rollout["config"]["seeds"])
        assert (found["episodes"], found["without_view"]) == (4, {"left_wrist": 2 * seeds})


@pytest.mark.slow
def test_the_same_small_models_every_time(tmp_path: Path) -> None:
    for name in "ab":
        write_outside_models(tmp_path / name)
    files = [path.relative_to(tmp_path / "a") for path in sorted((tmp_path / "a").rglob("*")) if path.is_file()]
    assert len([path for path in files if path.suffix == ".safetensors"]) >= 8
    for path in files:
        assert (tmp_path / "a" / path).read_bytes() == (tmp_path / "b" / path).read_bytes(), path
