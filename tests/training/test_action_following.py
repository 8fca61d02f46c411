"""Action following while a model trains: a predictor that follows, one that ignores its controls, and a whole run."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from tests.training import conftest
from tests.training.conftest import FRAME_INPUT, TINY_MODEL, VIEWS
from worldline_core.actions.episode_tracks import ActionTracks
from worldline_core.actions.tool_error import moving_part
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import CheckpointError, ConfigError, TrainingError
from worldline_core.model.checkpoint import read_checkpoint_info
from worldline_core.model.networks import build_world_model
from worldline_core.model.world_model_config import MixtureConfig
from worldline_core.store.artifact_files import read_json_lines
from worldline_core.training.action_following import ActionFollowing, Place, _error
from worldline_core.training.clip_config import FrameInput
from worldline_core.training.clip_loader import Batch, ClipLoader
from worldline_core.training.clip_sampler import Clip
from worldline_core.training.clip_source import FrameSource
from worldline_core.training.flow_matching import FlowMatchingObjective
from worldline_core.training.stage2 import train_stage2
from worldline_core.training.training_config import ActionFollowingConfig, LossWeighting, SigmaSampling, TrainerConfig

TRAINER = {"steps": 2, "batch_size": 2, "precision": "fp32", "save_every_seconds": 1e6, "save_every_steps": 1}


class Recorded:
    """Predicts what was recorded: under its own controls a clip's own pictures, under others' those of their clip."""

    def __init__(self, follows):
        self.follows, self.shown = follows, []

    def predict(self, batch, action_maps, noise):
        rolled = not torch.equal(action_maps, batch.action_maps)
        clips = [*batch.clips[-1:], *batch.clips[:-1]] if rolled and self.follows else batch.clips
        self.shown = [(clip.episode_id, clip.start if self.follows else None) for clip in clips]
        return batch.latents


def make_probe(world, tokenizer, *, follows=True, tracks=True, held_out=None, **config):
    predictor, episodes = Recorded(follows), EpisodeSet.open(world.episodes)
    source = FrameSource(episodes, tokenizer, FrameInput.model_validate(FRAME_INPUT | {"start_step": 1}))
    opened = ActionTracks.open(world.tracks, episodes)
    loader = ClipLoader(
        source, views=VIEWS, tracks=opened, frame_rates={row.episode_id: row.fps for row in episodes.rows}
    )
    if not tracks:
        hide_places(loader)
    probe = ActionFollowing(
        ActionFollowingConfig(clips=8, **config), predictor, loader, source.rows[:held_out], episodes, tokenizer, view_sets=[VIEWS],
        frames_per_unit=4, trainer=TrainerConfig(steps=1, precision="fp32", batch_size=4),
    )  # fmt: skip

    def decode(latents, reference):
        videos = []
        for (name, start), first in zip(predictor.shown, reference, strict=True):
            if start is None:
                videos.append(first[:, None].expand(-1, 9, -1, -1))
            else:
                frames = episodes.frames(episodes.position(name), "head", range(start, start + 9))
                videos.append(torch.from_numpy(frames).permute(3, 0, 1, 2) / 127.5 - 1)
        return torch.stack(videos)

    probe.tokenizer = SimpleNamespace(decode=decode)
    return probe


def hide_places(loader):
    """As for recordings without a camera: no tool has a place in a picture."""
    read, numbers = loader.tracks.tracks, torch.arange(99.0).reshape(-1, 1, 1, 1, 1, 1)

    def unseen(name):
        found = read(name)
        found.valid[:] = False
        return found

    loader.tracks.tracks = unseen
    loader.action_maps = lambda clips, views: numbers[: len(clips)].expand(-1, 3, 1, 3, 1, 1)


@pytest.mark.parametrize("tracks", [True, False], ids=["projected tools", "moving parts"])
def test_a_model_that_follows_is_told_from_one_that_does_not(world, tokenizer, tracks):
    following, ignoring = (
        make_probe(world, tokenizer, follows=follows, tracks=tracks).measure(1) for follows in (True, False)
    )
    assert following["clips"] == ignoring["clips"] >= 6
    assert following["tool_error_px"] == 0 and following["hand_psnr"] == pytest.approx(10 * np.log10(255**2 * 12))
    assert following["tool_error_px_shuffled"] > 2 and following["shuffled_gap_low_px"] > 1
    assert following["copy_gap_px"] >= following["copy_gap_low_px"] > 1 and ignoring["copy_gap_px"] == 0
    assert ignoring["tool_error_px"] == ignoring["tool_error_px_copy"] == ignoring["tool_error_px_shuffled"] > 2
    assert ignoring["hand_psnr"] < ignoring["frame_psnr"]
    if tracks:  # one held-out episode is enough
        found = make_probe(world, tokenizer, held_out=1).measure(1)
        assert found["clips"] > 4 and found["tool_error_px"] < found["tool_error_px_copy"]


def test_still_edges_around_a_small_robot_do_not_hide_that_it_moved():
    behind = np.zeros((64, 96, 3), np.float32)
    behind[32:, 40:56] = 250  # a still thing
    first, later = behind.astype(np.uint8), behind.astype(np.uint8)
    for picture, u in ((first, 36), (later, 46)):
        picture[24:32, u : u + 6] = (110, 90, 0)
        picture[26:30, u + 2 : u + 4] = 10
    points = moving_part(first, later, behind)
    assert np.abs(points[0] - (48.5, 27.5)).max() <= 3
    place = Place(Clip("a", 0, 9, 1), points, behind)
    assert (_error(later, later, place), _error(later, first, place)) == (0.0, 10.0)
    assert _error(later, first, Place(place.clip, points)) == 0.0, "still things fit best where they are"


def test_a_model_that_ignores_its_controls_is_stopped_from_the_given_step_on(world, tokenizer):
    probe = make_probe(world, tokenizer, follows=False, stop_when_ignored=100)
    assert probe.measure(99)
    with pytest.raises(TrainingError, match=r"follow.*(?s:.)*units"):
        probe.measure(100)
    following = make_probe(world, tokenizer, stop_when_ignored=100, share=0.1)
    assert not following.due(29) and following.due(31)  # an assumed cost of 3 s
    following.measure(100)
    assert not following.due(19 * following.spent) and following.due(21 * following.spent)  # its share of the time


@pytest.fixture
def inputs(world, tokenizer, base):
    return {**world.inputs, "tokenizer": tokenizer, "stage1": base}


def stage2(**changes):
    values = {"trainer": TRAINER, "input": FRAME_INPUT, "clips": {"lengths": [9]}, "action_following": {}}
    return conftest.stage2(2, **values | changes)


@pytest.mark.slow
def test_a_run_logs_what_its_averaged_weights_do_and_resumes_with_the_same_bytes(inputs, tmp_path, killed_after):
    train_stage2(stage2(), inputs, tmp_path / "whole")
    with killed_after(1):
        train_stage2(stage2(), inputs, tmp_path / "killed")
    train_stage2(stage2(), inputs, tmp_path / "killed")
    whole, resumed = ((tmp_path / name / "model.safetensors").read_bytes() for name in ("whole", "killed"))
    assert whole == resumed
    logged = read_json_lines(tmp_path / "whole" / "run" / "action_following.jsonl")[-1]
    assert logged["step"] == 2 and logged["clips"] >= 4
    whole, resumed = (read_checkpoint_info(tmp_path / name).metadata["metrics"] for name in ("whole", "killed"))
    assert whole == resumed and whole["tool_error_px"] == logged["tool_error_px"]


def test_a_run_without_its_tokenizer_is_refused_before_it_trains(inputs, tmp_path):
    cached = {name: folder for name, folder in inputs.items() if name != "tokenizer"}
    for given, error, message in ((cached, ConfigError, "tokenizer"), (inputs, CheckpointError, "synthetic")):
        with pytest.raises(error, match=message):
            train_stage2(stage2(input={"kind": "latents"}), given, tmp_path / message)


def test_the_objective_predicts_from_the_observed_frame():
    model = build_world_model(MixtureConfig.model_validate(TINY_MODEL))
    objective = FlowMatchingObjective(model, sigma=SigmaSampling(), weighting=LossWeighting(), sampler_steps=2)
    latents, noise = torch.randn(2, 2, 3, 4, 3, 4, 4)
    with torch.no_grad():
        found = objective.predict(Batch((), VIEWS, latents), None, noise)
    assert torch.equal(found[:, :, :, 0], latents[:, :, :, 0]) and not torch.equal(found[:, :, :, 1], noise[:, :, :, 1])
