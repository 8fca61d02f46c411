"""Training on recordings that have different views: batches of one set of views, and a checkpoint that says what it saw."""

import dataclasses
from collections import Counter

import pytest
import torch

from tests.rollout.conftest import SIZE, mixed_views, small_model
from worldline_core.actions.episode_tracks import ActionTracks
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.errors import ConfigError
from worldline_core.model.checkpoint import load_checkpoint, read_checkpoint_info, save_checkpoint
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import TrainedClips, WorldModelConfig
from worldline_core.training.clip_config import ClipSampling
from worldline_core.training.clip_loader import ClipLoader
from worldline_core.training.clip_sampler import Clip, ClipBatch, ClipSampler
from worldline_core.training.clip_source import LatentStore
from worldline_core.training.stage2 import train_stage2
from worldline_core.training.training_config import Stage2Config

HEAD, RIGHT = ("head",), ("head", "right_wrist")


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """Recordings of three sets of views, their latents, and a base model of random weights."""
    root = tmp_path_factory.mktemp("optional")
    made, counts = mixed_views(root, {"three": "train", "two": "train", "one": "train"})
    assert (counts["kept"], counts["left_out"]) == (6, {})
    save_checkpoint(root / "base", small_model(vocab_size=16), kind="base", action_contract=None)
    return {**made, "stage1": root / "base"}


@pytest.fixture(scope="module")
def store(inputs):
    return LatentStore.open(inputs["latents"])


def stage2(**changes):
    values = {
        "trainer": {"steps": 12, "batch_size": 2, "log_every": 1, "ema_decay": 0.9}, "clips": {"lengths": [9, 17]},
        "relational": None,
    }  # fmt: skip
    return Stage2Config.model_validate(values | changes)


def sampler_of(rows, **clips):
    named = [dataclasses.replace(row, source=row.episode_id.split("-")[0]) for row in rows]
    config = ClipSampling(lengths=(9,), **clips)
    return ClipSampler(named, config, views=VIEWS, splits=["train"], start_step=4, batch_size=2, seed=3)


def test_batches_hold_clips_of_one_set_of_views(store):
    sampler, drawn = sampler_of(store.rows), Counter()
    for index in range(600):
        batch = sampler.clips(index)
        assert {store.row(clip.episode_id).views for clip in batch.clips} == {batch.views}
        assert sampler.replacement(index, 0, 0).episode_id[:3] == batch.clips[0].episode_id[:3]
        drawn.update(clip.episode_id for clip in batch.clips)
    # Grouping changes nothing of how often an episode is drawn.
    assert min(drawn.values()) > 0.7 * 1200 / 6
    assert set(sampler.view_sets(VIEWS)) == {VIEWS, RIGHT, HEAD}
    weighted = sampler_of(store.rows, source_weights={"three": 0.0})
    assert weighted.trained(VIEWS) == TrainedClips(view_sets=(HEAD, RIGHT), strides=(1,))
    assert sampler_of([row for row in store.rows if row.views == VIEWS]).trained(VIEWS) is None


def test_single_views_are_drawn_where_they_are(store):
    sampler = sampler_of(store.rows, view_weights={"joint": 0.4, "left_wrist": 0.6})
    batches = [sampler.clips(index) for index in range(200)]
    assert {batch.views for batch in batches} == {VIEWS, RIGHT, HEAD, ("left_wrist",)}
    assert all(set(b.views) <= set(store.row(clip.episode_id).views) for b in batches for clip in b.clips)
    for weights, shown in (({"joint": 0.4, "left_wrist": 0.6}, VIEWS), ({"head": 1.0, "joint": 0.0}, HEAD)):
        assert ClipSampling(view_weights=weights).shown_views(VIEWS) == shown
    assert ClipSampling().shown_views(VIEWS) == VIEWS


def test_subsets_are_drawn_for_a_share_of_the_steps_and_known_by_it(store):
    def sampler(share, views=VIEWS):
        rows = [row for row in store.rows if row.views == views]
        return sampler_of(rows, view_weights={"joint": 1 - share, "subset": share})

    drawn = Counter(sampler(0.3).clips(index).views for index in range(600))
    assert set(drawn) == {VIEWS, HEAD, RIGHT, ("head", "left_wrist")}
    assert all(0.06 < drawn[views] / 600 < 0.14 for views in drawn if views != VIEWS)
    assert set(sampler(0.3).trained(VIEWS).view_sets) == set(drawn)
    assert sampler(0.02).trained(VIEWS) is None  # a set that fewer than 1 % of the steps show is not known
    assert {sampler(0.3, HEAD).clips(index).views for index in range(20)} == {HEAD}


def test_a_clip_is_trained_in_a_batch_as_it_would_be_alone(inputs, store):
    loader = ClipLoader(store, views=VIEWS, tracks=ActionTracks.open(inputs["tracks"]))
    model = load_checkpoint(inputs["stage1"], towers="generation")[0].eval().requires_grad_(False)
    for parameter in model.parameters():  # what starts at zero would hide the controls
        parameter.add_(0.1 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(1)))

    def velocity(batch):
        level = torch.full((len(batch.clips),), 0.5)
        return model(batch.latents, level, action_maps=batch.action_maps, views=batch.views).velocity

    for name, views in (("three", VIEWS), ("two", RIGHT), ("one", HEAD)):
        clips = tuple(Clip(f"{name}-{number}", 4, 9, 1) for number in range(2))
        together = loader.load(ClipBatch(clips, views))
        for number, clip in enumerate(clips):
            alone = loader.load(ClipBatch((clip,), views))
            assert torch.equal(alone.latents[0], together.latents[number])
            assert torch.equal(alone.action_maps[0], together.action_maps[number])
            torch.testing.assert_close(velocity(alone)[0], velocity(together)[number], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("kind", ["latents", "frames"])
def test_stage2_trains_on_every_set_of_views(inputs, tmp_path, seen, kind):
    source = {"kind": kind} | ({"image_size": SIZE} if kind == "frames" else {})
    counts = train_stage2(stage2(input=source), inputs, tmp_path / "out")
    assert counts["steps"] == 12
    assert {batch.views for batch in seen} == {VIEWS, RIGHT, HEAD}
    for batch in seen:
        assert batch.latents.shape[1] == batch.action_maps.shape[1] == len(batch.views)
    assert read_checkpoint_info(tmp_path / "out").view_sets == (VIEWS, RIGHT, HEAD)


def test_a_model_of_the_head_alone_trains_on_any_recording(inputs, tmp_path):
    clips = {"lengths": [9, 17], "view_weights": {"head": 1.0}}
    train_stage2(stage2(clips=clips, input={"kind": "frames", "image_size": SIZE}), inputs, tmp_path / "model")
    assert read_checkpoint_info(tmp_path / "model").trained == TrainedClips(view_sets=(HEAD,), strides=(1,))
    model = WorldModel(WorldModelConfig(view_offsets=(0.0, 8.0), views=RIGHT))
    with pytest.raises(ConfigError, match="Unknown or repeated view"):
        model(torch.zeros(1, 1, 32, 2, 4, 6), torch.ones(1), views=("left_wrist",))
