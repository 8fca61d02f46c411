"""Stage I and Stage II on clips from frames and from caches, in this process and in loader processes."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from pydantic import ValidationError
from safetensors.torch import load_file

from flows.pipeline import chain
from tasks.execution.chain import outline
from worldline_core.config import load_config
from worldline_core.errors import ConfigError, DataError
from worldline_core.model.checkpoint import load_checkpoint
from worldline_core.pipeline.pipeline_config import PipelineConfig
from worldline_core.store.artifact_files import read_json_lines
from worldline_core.training.clip_config import EncodeLatentsConfig
from worldline_core.training.encode_latents import encode_latents
from worldline_core.training.stage1 import train_stage1
from worldline_core.training.stage2 import train_stage2
from worldline_core.training.training_config import Stage1Config, Stage2Config, TeacherConfig
from worldline_core.training.video_teacher import train_teacher

TRAINER = {
    "steps": 4,
    "batch_size": 2,
    "precision": "fp32",
    "log_every": 1,
    "validation_batches": 1,
    "save_every_seconds": 1000.0,
    "save_every_steps": 1,
    "optimizer": {"learning_rate": 1e-3, "warmup_steps": 2},
}
FRAMES = {"kind": "frames", "image_size": [32, 32], "start_step": 4}


@pytest.fixture(scope="module")
def latents(world: Any, tokenizer: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("latents")
    config = EncodeLatentsConfig.model_validate({"image_size": [32, 32]})
    encode_latents(config, {"episodes": world.episodes, "tokenizer": tokenizer}, folder)
    return folder


def stage1(tiny_model: dict[str, object], **changes: Any) -> Stage1Config:
    clips = {"lengths": [9, 13], "view_weights": {"primary": 1}}
    return Stage1Config.model_validate({"model": tiny_model, "trainer": TRAINER, "clips": clips, **changes})


@pytest.fixture(scope="module")
def first_stage(
    world: Any, tokenizer: Path, tiny_model: dict[str, object], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    folder = tmp_path_factory.mktemp("stage1")
    train_stage1(stage1(tiny_model, input=FRAMES), {"episodes": world.episodes, "tokenizer": tokenizer}, folder)
    return folder


def losses(folder: Path) -> list[float]:
    return [row["loss"] for row in read_json_lines(folder / "metrics.jsonl") if "loss" in row]


def test_stage1_learns_the_same_from_frames_as_from_their_cached_latents(
    world: Any, latents: Path, first_stage: Path, tiny_model: dict[str, object], tmp_path: Path
) -> None:
    train_stage1(stage1(tiny_model), {"episodes": world.episodes, "latents": latents}, tmp_path)
    # The same clips in the same order: the losses differ by the rounding of half precision alone.
    assert losses(first_stage) == pytest.approx(losses(tmp_path), rel=1e-3)
    cached, online = (load_checkpoint(folder, towers="both")[1] for folder in (tmp_path, first_stage))
    assert "input" not in cached.metadata
    assert online.metadata["input"]["kind"] == "frames"
    assert online.metadata["input"]["decoder"].startswith("PyAV")
    assert online.metadata["tokenizer"] == cached.metadata["tokenizer"]


def test_held_out_recordings_shorter_than_the_longest_clips_validate_what_fits(
    world: Any, tokenizer: Path, tiny_model: dict[str, object], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Seventeen frames hold nine at stride 2, but not thirteen."""
    inputs = {"episodes": world.episodes, "tokenizer": tokenizer}
    trainer = TRAINER | {"steps": 1}
    for folder, lengths in (("some", [9, 13]), ("one", [9])):
        clips = {"lengths": lengths, "strides": [2], "view_weights": {"primary": 1}}
        train_stage1(stage1(tiny_model, trainer=trainer, clips=clips, input=FRAMES), inputs, tmp_path / folder)
        assert any(
            any(key.startswith("validation/") for key in row)
            for row in read_json_lines(tmp_path / folder / "metrics.jsonl")
        )
        warned = "the longest clips span 25: the validation loss is of the lengths and strides that fit" in caplog.text
        assert warned == (folder == "some")
        caplog.clear()


def stage2(**changes: Any) -> Stage2Config:
    values = {"trainer": TRAINER, "clips": {"lengths": [9, 13, 17]}, "action_multiplier": 3.0, "relational": None}
    return Stage2Config.model_validate(values | changes)


@pytest.fixture(scope="module")
def teacher(world: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("teacher")
    shape = {"image_size": [32, 32], "patch": 8, "hidden_size": 16, "num_layers": 4, "num_heads": 2}
    config = {"shape": shape, "trainer": {**TRAINER, "steps": 2}, "clip_frames": 9, "held_out_episodes": 1}
    train_teacher(TeacherConfig.model_validate(config), {"episodes": world.episodes}, folder)
    return folder


@pytest.mark.slow
@pytest.mark.usefixtures("forked_loaders")
def test_stage2_goes_on_with_the_same_bytes(
    world: Any, tokenizer: Path, first_stage: Path, teacher: Path, tmp_path: Path, killed_after: Callable[[int], Any]
) -> None:
    """Undisturbed in this process; killed twice and continued with a loader process: one checkpoint, to the byte."""
    inputs = {
        "episodes": world.episodes, "tokenizer": tokenizer, "tracks": world.tracks, "stage1": first_stage,
        "teacher": teacher,
    }  # fmt: skip
    trainer = {**TRAINER, "steps": 14, "log_every": 3, "save_every_steps": 4}
    config = stage2(input=FRAMES, trainer=trainer, relational={"ramp_steps": 5})
    train_stage2(config, inputs, tmp_path / "whole")
    ahead = config.model_copy(update={"input": config.input.model_copy(update={"workers": 1})})
    for steps in (7, 6):  # the second part begins at the state of step 4: it repeats three steps and their log lines
        with killed_after(steps):
            train_stage2(ahead, inputs, tmp_path / "parts")
    torch.rand(5)
    train_stage2(ahead, inputs, tmp_path / "parts")
    whole, parts = (load_file(tmp_path / name / "model.safetensors") for name in ("whole", "parts"))
    assert whole.keys() == parts.keys()
    assert all(torch.equal(whole[name], parts[name]) for name in whole)
    logs = [(tmp_path / name / "metrics.jsonl").read_bytes() for name in ("whole", "parts")]
    assert logs[0] == logs[1]
    rows = [row for row in read_json_lines(tmp_path / "parts" / "metrics.jsonl") if "loss" in row]
    assert [row["step"] for row in rows] == [3, 6, 9, 12, 14]
    assert all(row["relational_intra"] > 0 for row in rows)
    assert "skipped_clips" not in load_checkpoint(tmp_path / "parts", expect_kind="stage2")[1].metadata


def test_the_teacher_is_shown_the_frames_that_were_read(
    world: Any, tokenizer: Path, latents: Path, first_stage: Path, teacher: Path, tmp_path: Path
) -> None:
    given = {"episodes": world.episodes, "tracks": world.tracks, "stage1": first_stage, "teacher": teacher}
    found = []
    for name, values, source in (
        ("cached", {}, {"latents": latents}),
        ("online", {"input": FRAMES}, {"tokenizer": tokenizer}),
    ):
        train_stage2(stage2(relational={"ramp_steps": 2}, **values), given | source, tmp_path / name)
        rows = [row for row in read_json_lines(tmp_path / name / "metrics.jsonl") if "loss" in row]
        found.append([(row["relational_intra"], row["relational_cross"]) for row in rows])
    for cached, online in zip(*found, strict=True):
        assert online == pytest.approx(cached, rel=5e-3)


def test_resident_latents_train_the_same_bytes(world: Any, latents: Path, first_stage: Path, tmp_path: Path) -> None:
    inputs = {"episodes": world.episodes, "latents": latents, "tracks": world.tracks, "stage1": first_stage}
    for name, resident in (("read", False), ("resident", True)):
        train_stage2(stage2(input={"kind": "latents", "resident": resident}), inputs, tmp_path / name)
    read, resident = (load_file(tmp_path / name / "model.safetensors") for name in ("read", "resident"))
    assert all(torch.equal(read[name], resident[name]) for name in read)
    with pytest.raises(ValidationError, match="resident"):
        stage2(input={"kind": "latents", "resident": True, "workers": 1})


def test_a_damaged_recording_stops_the_run_or_is_counted_in_the_checkpoint(
    world: Any, tokenizer: Path, tiny_model: dict[str, object], tmp_path: Path
) -> None:
    shutil.copytree(world.episodes, tmp_path / "set")
    (video,) = (tmp_path / "set").rglob("*head*/**/*.mp4")
    content = bytearray(video.read_bytes())
    content[len(content) // 2 :] = bytes(len(content) - len(content) // 2)
    video.write_bytes(content)
    inputs = {"episodes": tmp_path / "set", "tokenizer": tokenizer}
    with pytest.raises(DataError, match="A clip cannot be read"):
        train_stage1(stage1(tiny_model, input=FRAMES), inputs, tmp_path / "strict")
    lenient = stage1(tiny_model, input={**FRAMES, "on_unreadable": "skip"})
    train_stage1(lenient, inputs, tmp_path / "lenient")
    _, info = load_checkpoint(tmp_path / "lenient", towers="both")
    lines = (tmp_path / "lenient" / "run" / "skipped_clips-0.jsonl").read_text().splitlines()
    assert info.metadata["skipped_clips"] == len(lines) > 0
    assert "view head" in json.loads(lines[0])["reason"]


def test_the_input_that_is_missing_is_named(world: Any, tiny_model: dict[str, object], tmp_path: Path) -> None:
    for values, name in (({}, "latents"), ({"input": FRAMES}, "tokenizer")):
        with pytest.raises(ConfigError, match=f"need the input {name}"):
            train_stage1(stage1(tiny_model, **values), {"episodes": world.episodes}, tmp_path / name)


def test_the_chain_gives_a_stage_what_it_reads(tmp_path: Path) -> None:
    config, strides = load_config(PipelineConfig, preset="cosmos3-nano"), {}
    calls = outline(chain, config)
    for name in ("train_stage1", "train_stage2"):
        assert calls[name].inputs["tokenizer"] == Path.cwd() / config.models.tokenizer
        assert "latents" not in calls[name].inputs
        clips = getattr(config, name).clips
        strides[name] = clips.strides
        assert clips.lengths[0] == 33
        assert clips.lengths[-1] == 129
    # Stage I spans longer motion, Stage II is denser (method.md section 1).
    assert min(strides["train_stage1"]) > max(strides["train_stage2"])
    tiny = outline(chain, load_config(PipelineConfig, preset="tiny"))
    for name in ("train_stage1", "train_stage2"):
        assert tiny[name].inputs["latents"] is tiny["encode_latents"]
