"""Clips are a pure function of seed and step, come in batches of one set of views, and a checkpoint names what it saw."""

import dataclasses
from collections import Counter

import pytest
import torch
from pydantic import ValidationError

from tests.rollout.conftest import SIZE, mixed_views, small_model
from worldline_core.actions.episode_tracks import ActionTracks
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.errors import ConfigError, DataError
from worldline_core.model.checkpoint import load_checkpoint, read_checkpoint_info, save_checkpoint
from worldline_core.model.networks import build_world_model
from worldline_core.model.world_model_config import MixtureConfig, TrainedClips
from worldline_core.training.clip_config import ClipSampling
from worldline_core.training.clip_loader import ClipLoader
from worldline_core.training.clip_sampler import Clip, ClipBatch, ClipSampler
from worldline_core.training.clip_source import LatentStore
from worldline_core.training.processes import BatchPlan
from worldline_core.training.stage2 import train_stage2
from worldline_core.training.training_config import Stage2Config


@pytest.fixture
def store(world):
    return LatentStore.open(world.latents)


def make(store, config=None, **changes):
    values = {"views": VIEWS, "start_step": store.start_step, "batch_size": 4, "seed": 3}
    return ClipSampler(
        config=config or ClipSampling(lengths=(5, 9, 17)),
        **{"rows": [row for row in store.rows if row.split == "train"], **values, **changes},
    )


def test_clips_are_a_pure_function_of_seed_and_step(store):
    forward = [make(store).clips(index) for index in range(20)]
    sampler = make(store)
    assert [sampler.clips(index) for index in reversed(range(20))] == forward[::-1]
    assert [make(store, seed=4).clips(index) for index in range(20)] != forward


def test_clips_fit_their_episodes_share_a_length_and_cover_all_starts(store):
    sampler = make(store)
    starts = Counter()
    for index in range(200):
        batch = sampler.clips(index)
        assert len({clip.num_frames for clip in batch.clips}) == 1
        for clip in batch.clips:
            assert clip.start + (clip.num_frames - 1) * clip.stride < store.row(clip.episode_id).num_frames
            starts[clip.num_frames, clip.start] += 1
    assert {start for length, start in starts if length == 5} == {0, 4, 8, 12}
    assert {start for length, start in starts if length == 17} == {0}


@pytest.mark.parametrize(("together", "world_size"), [(2, 1), (1, 2), (4, 2), (2, 4)])
def test_another_number_of_processes_goes_on_with_the_same_clips(store, together, world_size):
    config = ClipSampling(lengths=(5, 9))

    def clips(step, number):
        for rank in range(number):
            sampler = make(store, config, batch_size=2, plan=BatchPlan(4, together, rank, number))
            for part in range(sampler.plan.accumulation):
                yield from sampler.clips(step * sampler.plan.accumulation + part).clips

    for step in range(3):
        before, after = (sorted(map(str, clips(step, number))) for number in (together, world_size))
        assert before == after and len(before) == 8


def test_sources_and_views_follow_their_weights(store):
    rows = [
        dataclasses.replace(row, source=("common", "rare")[number % 2]) for number, row in enumerate(store.rows[2:])
    ]
    config = ClipSampling(lengths=(5,), source_weights={"rare": 0.0}, view_weights={"primary": 3.0, "left_wrist": 1.0})
    sampler = make(store, config, rows=rows)
    batches = [sampler.clips(index) for index in range(400)]
    assert {int(clip.episode_id[-3:]) % 2 for batch in batches for clip in batch.clips} == {0}
    views = Counter((batch.views, batch.primary) for batch in batches)
    assert 240 < views[("head",), True] < 360
    assert views[("head",), True] + views[("left_wrist",), False] == 400


def test_single_view_steps_take_larger_batches(store):
    config = ClipSampling(lengths=(9,), view_weights={"joint": 0.5, "head": 0.5}, single_view_factor=3)
    whole = make(store, config, batch_size=4)
    parts = [make(store, config, batch_size=2, plan=BatchPlan(2, 2, rank, 2)) for rank in range(2)]
    batches = [whole.clips(index) for index in range(60)]
    for index, batch in enumerate(batches):
        assert batch.clips == parts[0].clips(index).clips + parts[1].clips(index).clips
    assert {(batch.views, len(batch.clips)) for batch in batches} == {(VIEWS, 4), (("head",), 12)}


def test_lengths_may_be_a_range_and_fit_the_tokenizer_and_the_recordings(store):
    assert ClipSampling.model_validate({"lengths": {"from": 33, "to": 129}}).lengths == tuple(range(33, 130, 4))
    for lengths, message in (
        ({"from": 33}, "`from` and `to`"), ({"from": 33, "to": 129, "step": 4}, "`from` and `to`"),
        ({"from": 33, "to": "129"}, "`from` and `to`"), ({"from": 33, "to": 17}, "at least 1 item"),
        ((5, 8, 15), r"(?s)8 frames: a causal tokenizer codes clips of 4 k \+ 1.*15 frames"),
    ):  # fmt: skip
        with pytest.raises(ValidationError, match=message):
            ClipSampling.model_validate({"lengths": lengths})
    with pytest.raises(DataError, match="No episode is long enough"):
        make(store, ClipSampling(lengths=(33,)))


def test_the_draws_of_a_seed_stay_what_they_are(store):
    """Checkpoints name a seed; the clips that it draws are fixed here."""
    config = ClipSampling(lengths=(5, 9), view_weights={"joint": 1.0, "head": 1.0}, single_view_factor=2)
    batches = [make(store, config, batch_size=2).clips(index) for index in range(3)]
    assert [batch.views for batch in batches] == [("head",), VIEWS, VIEWS]
    drawn = [(int(clip.episode_id[-1]), clip.start) for batch in batches for clip in batch.clips]
    assert drawn == [(4, 8), (6, 4), (2, 4), (3, 4), (6, 0), (4, 0), (4, 4), (4, 8)]
    assert {clip.num_frames for batch in batches for clip in batch.clips} == {9}


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
def latents(inputs):
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
    return ClipSampler(named, config, views=VIEWS, start_step=4, batch_size=2, seed=3)


def test_batches_hold_clips_of_one_set_of_views(latents):
    sampler, drawn = sampler_of(latents.rows), Counter()
    for index in range(600):
        batch = sampler.clips(index)
        assert {latents.row(clip.episode_id).views for clip in batch.clips} == {batch.views}
        drawn.update(clip.episode_id for clip in batch.clips)
    # Grouping changes nothing of how often an episode is drawn.
    assert min(drawn.values()) > 0.7 * 1200 / 6
    assert set(sampler.view_sets(VIEWS)) == {VIEWS, RIGHT, HEAD}
    weighted = sampler_of(latents.rows, source_weights={"three": 0.0})
    assert weighted.trained(VIEWS) == TrainedClips(view_sets=(HEAD, RIGHT), strides=(1,))
    assert sampler_of([row for row in latents.rows if row.views == VIEWS]).trained(VIEWS) is None


def test_single_views_are_drawn_where_they_are(latents):
    sampler = sampler_of(latents.rows, view_weights={"joint": 0.4, "left_wrist": 0.6})
    batches = [sampler.clips(index) for index in range(200)]
    assert {batch.views for batch in batches} == {VIEWS, RIGHT, HEAD, ("left_wrist",)}
    assert all(set(b.views) <= set(latents.row(clip.episode_id).views) for b in batches for clip in b.clips)
    for weights, shown in (({"joint": 0.4, "left_wrist": 0.6}, VIEWS), ({"head": 1.0, "joint": 0.0}, HEAD)):
        assert ClipSampling(view_weights=weights).shown_views(VIEWS) == shown
    assert ClipSampling().shown_views(VIEWS) == VIEWS


def test_subsets_are_drawn_for_a_share_of_the_steps_and_known_by_it(latents):
    def sampler(share, views=VIEWS):
        rows = [row for row in latents.rows if row.views == views]
        return sampler_of(rows, view_weights={"joint": 1 - share, "subset": share})

    drawn = Counter(sampler(0.3).clips(index).views for index in range(600))
    assert set(drawn) == {VIEWS, HEAD, RIGHT, ("head", "left_wrist")}
    assert all(0.06 < drawn[views] / 600 < 0.14 for views in drawn if views != VIEWS)
    assert set(sampler(0.3).trained(VIEWS).view_sets) == set(drawn)
    assert sampler(0.02).trained(VIEWS) is None  # a set that fewer than 1 % of the steps show is not known
    assert {sampler(0.3, HEAD).clips(index).views for index in range(20)} == {HEAD}


def test_a_clip_is_trained_in_a_batch_as_it_would_be_alone(inputs, latents):
    loader = ClipLoader(latents, views=VIEWS, tracks=ActionTracks.open(inputs["tracks"]))
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


def test_stage2_trains_on_every_set_of_views(inputs, tmp_path, seen):
    counts = train_stage2(stage2(), inputs, tmp_path / "out")
    assert counts["steps"] == 12
    assert {batch.views for batch in seen} == {VIEWS, RIGHT, HEAD}
    for batch in seen:
        assert batch.latents.shape[1] == batch.action_maps.shape[1] == len(batch.views)
    assert read_checkpoint_info(tmp_path / "out").view_sets == (VIEWS, RIGHT, HEAD)


def test_a_model_of_the_head_alone_trains_on_any_recording(inputs, tmp_path):
    clips = {"lengths": [9, 17], "view_weights": {"head": 1.0}}
    train_stage2(stage2(clips=clips, input={"kind": "frames", "image_size": SIZE}), inputs, tmp_path / "model")
    assert read_checkpoint_info(tmp_path / "model").trained == TrainedClips(view_sets=(HEAD,), strides=(1,))
    model = build_world_model(MixtureConfig(view_offsets=(0.0, 8.0), views=RIGHT))
    with pytest.raises(ConfigError, match="Unknown or repeated view"):
        model(torch.zeros(1, 1, 32, 2, 4, 6), torch.ones(1), views=("left_wrist",))
