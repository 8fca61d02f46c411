"""Action following while a model trains: a predictor that follows, one that ignores its controls, and a whole run."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from worldline_core.actions.episode_tracks import ActionTracks
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import CheckpointError, ConfigError, TrainingError
from worldline_core.model.checkpoint import read_checkpoint_info
from worldline_core.model.tokenizers import load_tokenizer
from worldline_core.model.world_model import WorldModel
from worldline_core.store.artifact_files import read_json_lines
from worldline_core.training.action_following import ActionFollowing
from worldline_core.training.clip_config import FrameInput
from worldline_core.training.clip_loader import ClipLoader
from worldline_core.training.clip_source import FrameSource
from worldline_core.training.stage1 import train_stage1
from worldline_core.training.stage2 import train_stage2
from worldline_core.training.training_config import ActionFollowingConfig, Stage1Config, Stage2Config, TrainerConfig

VIEWS = ("head", "left_wrist", "right_wrist")
TRAINER = {"steps": 2, "batch_size": 2, "precision": "fp32", "save_every_seconds": 1e6, "save_every_steps": 1}
FRAMES = {"kind": "frames", "image_size": [32, 32], "start_step": 4}


class Recorded:
    """Predicts what was recorded: under its own controls a clip's own pictures, under others' those of their clip."""

    def __init__(self, follows: bool) -> None:
        self.follows, self.shown = follows, list[Any]()

    def predict(self, batch: Any, action_maps: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        rolled = not torch.equal(action_maps, batch.action_maps)
        clips = [*batch.clips[-1:], *batch.clips[:-1]] if rolled and self.follows else batch.clips
        self.shown = [(clip.episode_id, clip.start if self.follows else None) for clip in clips]
        return batch.latents


def make_probe(
    world: Any, tokenizer: Path, predictor: Recorded, *, tracks: bool, held_out: int | None = None, **config: Any
) -> ActionFollowing:
    episodes = EpisodeSet.open(world.episodes)
    source = FrameSource(episodes, tokenizer, FrameInput.model_validate(FRAMES | {"start_step": 1}))
    loader = ClipLoader(
        source,
        views=VIEWS,
        tracks=ActionTracks.open(world.tracks, episodes),
        frame_rates={row.episode_id: row.fps for row in episodes.rows},
    )
    opened = ActionFollowing(
        ActionFollowingConfig(clips=8, **config),
        predictor,
        loader if tracks else without_places(loader),
        source.rows[:held_out],
        episodes,
        tokenizer,
        view_sets=[VIEWS],
        frames_per_unit=4,
        trainer=TrainerConfig(steps=1, precision="fp32", batch_size=4),
    )

    def decode(latents: torch.Tensor, reference: torch.Tensor) -> torch.Tensor:
        videos = []
        for (name, start), first in zip(predictor.shown, reference, strict=True):
            if start is None:
                videos.append(first[:, None].expand(-1, 9, -1, -1))
            else:
                frames = episodes.frames(episodes.position(name), "head", range(start, start + 9))
                videos.append(torch.from_numpy(frames).permute(3, 0, 1, 2) / 127.5 - 1)
        return torch.stack(videos)

    opened.tokenizer = SimpleNamespace(decode=decode)  # pyright: ignore[reportAttributeAccessIssue]
    return opened


def without_places(loader: ClipLoader) -> ClipLoader:
    """The loader of recordings without a camera: no tool has a place in a picture."""
    tracks = loader.tracks
    assert tracks is not None
    read = tracks.tracks

    def unseen(name: str) -> Any:
        found = read(name)
        found.valid[:] = False
        return found

    tracks.tracks = unseen  # pyright: ignore[reportAttributeAccessIssue]
    numbers = torch.arange(99.0).reshape(-1, 1, 1, 1, 1, 1)
    loader.action_maps = lambda clips, views: numbers[: len(clips)].expand(-1, 3, 1, 3, 1, 1)  # pyright: ignore[reportAttributeAccessIssue]
    return loader


@pytest.mark.parametrize("tracks", [True, False], ids=["projected tools", "moving parts"])
def test_a_model_that_follows_is_told_from_one_that_does_not(world: Any, tokenizer: Path, tracks: bool):
    following = make_probe(world, tokenizer, Recorded(follows=True), tracks=tracks).measure(1)
    ignoring = make_probe(world, tokenizer, Recorded(follows=False), tracks=tracks).measure(1)
    assert following["clips"] == ignoring["clips"] >= 6
    assert following["tool_error_px"] == 0 and following["hand_psnr"] == pytest.approx(10 * np.log10(255**2 * 12))
    assert following["tool_error_px_shuffled"] > 2 and following["shuffled_gap_low_px"] > 1
    assert ignoring["tool_error_px"] == ignoring["tool_error_px_copy"] == ignoring["tool_error_px_shuffled"] > 2
    assert ignoring["hand_psnr"] < ignoring["frame_psnr"]


def test_one_held_out_episode_is_enough(world: Any, tokenizer: Path):
    found = make_probe(world, tokenizer, Recorded(follows=True), tracks=True, held_out=1).measure(1)
    assert found["clips"] > 4 and found["tool_error_px"] < found["tool_error_px_copy"]


def test_a_model_that_ignores_its_controls_is_stopped_from_the_given_step_on(world: Any, tokenizer: Path):
    probe = make_probe(world, tokenizer, Recorded(follows=False), tracks=True, stop_when_ignored=100)
    assert probe.measure(99)
    with pytest.raises(TrainingError, match=r"follow.*(?s:.)*units"):
        probe.measure(100)
    make_probe(world, tokenizer, Recorded(follows=True), tracks=True, stop_when_ignored=100).measure(100)


def test_measuring_takes_its_share_of_the_time(world: Any, tokenizer: Path):
    probe = make_probe(world, tokenizer, Recorded(follows=True), tracks=True, share=0.1)
    assert not probe.due(29) and probe.due(31)  # an assumed cost of 3 s
    probe.measure(1)
    cost = probe.spent
    assert not probe.due(19 * cost) and probe.due(21 * cost)


@pytest.fixture(scope="module")
def base(world: Any, tokenizer: Path, tiny_model: dict[str, object], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("base")
    config = {"kind": "base", "model": tiny_model, "trainer": TRAINER, "input": FRAMES, "clips": {"lengths": [9]}}
    train_stage1(Stage1Config.model_validate(config), {**world.inputs, "tokenizer": tokenizer}, folder)
    return folder


def stage2(**changes: Any) -> Stage2Config:
    values = {
        "trainer": TRAINER,
        "input": FRAMES,
        "clips": {"lengths": [9]},
        "relational": None,
        "action_following": {},
    }
    return Stage2Config.model_validate(values | changes)


def test_a_run_logs_what_its_averaged_weights_do_and_resumes_with_the_same_bytes(
    world: Any, tokenizer: Path, base: Path, tmp_path: Path, killed_after: Any
):
    inputs = {**world.inputs, "tokenizer": tokenizer, "stage1": base}
    train_stage2(stage2(), inputs, tmp_path / "whole")
    with killed_after(1):
        train_stage2(stage2(), inputs, tmp_path / "killed")
    train_stage2(stage2(), inputs, tmp_path / "killed")
    whole, resumed = ((tmp_path / name / "model.safetensors").read_bytes() for name in ("whole", "killed"))
    assert whole == resumed
    logged = read_json_lines(tmp_path / "whole" / "run" / "action_following.jsonl")
    assert logged[-1]["step"] == 2 and logged[-1]["clips"] >= 4
    metrics = read_checkpoint_info(tmp_path / "whole").metadata["metrics"]
    assert metrics["tool_error_px"] == logged[-1]["tool_error_px"]
    assert metrics == read_checkpoint_info(tmp_path / "killed").metadata["metrics"]


def test_a_run_without_its_tokenizer_is_refused_before_it_trains(
    world: Any, tokenizer: Path, base: Path, tmp_path: Path
):
    cached = {"latents": world.latents, **world.inputs, "stage1": base}
    with pytest.raises(ConfigError, match="tokenizer"):
        train_stage2(stage2(input={"kind": "latents"}), cached, tmp_path / "without")
    assert load_tokenizer(tokenizer)
    with pytest.raises(CheckpointError, match="synthetic"):
        train_stage2(stage2(input={"kind": "latents"}), {**cached, "tokenizer": tokenizer}, tmp_path / "other")


def test_the_objective_predicts_from_the_observed_frame(world: Any, tiny_model: dict[str, object]):
    from worldline_core.training.clip_loader import Batch
    from worldline_core.training.flow_matching import FlowMatchingObjective
    from worldline_core.training.training_config import LossWeighting, SigmaSampling

    model = WorldModel(Stage1Config.model_validate({"model": tiny_model, "trainer": TRAINER}).model)
    objective = FlowMatchingObjective(model, sigma=SigmaSampling(), weighting=LossWeighting(), sampler_steps=2)
    latents, noise = torch.randn(2, 3, 4, 3, 4, 4), torch.randn(2, 3, 4, 3, 4, 4)
    with torch.no_grad():
        found = objective.predict(Batch((), VIEWS, latents), None, noise)  # pyright: ignore[reportArgumentType]
    assert torch.equal(found[:, :, :, 0], latents[:, :, :, 0]) and not torch.equal(found[:, :, :, 1], noise[:, :, :, 1])
