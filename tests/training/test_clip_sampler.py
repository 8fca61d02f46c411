from __future__ import annotations

import dataclasses
from collections import Counter
from typing import Any

import pytest
from pydantic import ValidationError

from worldline_core.errors import ConfigError, DataError
from worldline_core.training.clip_config import ClipSampling
from worldline_core.training.clip_sampler import ClipSampler
from worldline_core.training.latent_store import LatentStore
from worldline_core.training.processes import BatchPlan
from worldline_core.training.training_config import Stage1Config


@pytest.fixture
def store(world: Any) -> LatentStore:
    return LatentStore.open(world.latents)


def make(store: LatentStore, config: ClipSampling | None = None, **changes: Any) -> ClipSampler:
    values: dict[str, Any] = {"splits": ["train"], "batch_size": 4, "seed": 3}
    return ClipSampler(store, config or ClipSampling(lengths=(5, 9, 17)), **(values | changes))


def test_clips_are_a_pure_function_of_seed_and_step(store: LatentStore) -> None:
    forward = [make(store).clips(index) for index in range(20)]
    sampler = make(store)
    assert [sampler.clips(index) for index in reversed(range(20))] == forward[::-1]
    assert [make(store, seed=4).clips(index) for index in range(20)] != forward


def test_clips_fit_their_episodes_share_a_length_and_cover_all_starts(store: LatentStore) -> None:
    sampler = make(store)
    starts: Counter[tuple[int, int]] = Counter()
    for index in range(200):
        batch = sampler.clips(index)
        assert len({clip.num_frames for clip in batch.clips}) == 1
        for clip in batch.clips:
            assert store.row(clip.episode_id).split == "train"
            assert clip.start + (clip.num_frames - 1) * clip.stride < store.row(clip.episode_id).num_frames
            starts[clip.num_frames, clip.start] += 1
    assert {start for length, start in starts if length == 5} == {0, 4, 8, 12}
    assert {start for length, start in starts if length == 17} == {0}


def test_ranks_share_the_global_batch(store: LatentStore) -> None:
    whole = make(store, batch_size=4)
    parts = [make(store, batch_size=2, plan=BatchPlan(2, 2, rank, 2)) for rank in range(2)]
    for index in range(10):
        assert whole.clips(index).clips == parts[0].clips(index).clips + parts[1].clips(index).clips


@pytest.mark.parametrize(("together", "world_size"), [(2, 1), (1, 2), (4, 2), (2, 4)])
@pytest.mark.parametrize("order", ["weighted", "epochs"])
def test_another_number_of_processes_goes_on_with_the_same_clips(
    store: LatentStore, together: int, world_size: int, order: str
) -> None:
    config = ClipSampling.model_validate({"lengths": (5, 9), "order": order})
    before = [
        make(store, config, batch_size=2, plan=BatchPlan(4, together, rank, together)) for rank in range(together)
    ]
    after = [
        make(store, config, batch_size=2, plan=BatchPlan(4, together, rank, world_size)) for rank in range(world_size)
    ]
    for step in range(3):
        clips = [
            sorted(
                (clip.episode_id, clip.start, clip.num_frames)
                for sampler in samplers
                for part in range(sampler.plan.accumulation)
                for clip in sampler.clips(step * sampler.plan.accumulation + part).clips
            )
            for samplers in (before, after)
        ]
        assert clips[0] == clips[1]
        assert len(clips[0]) == 8


def test_sources_and_views_follow_their_weights(store: LatentStore) -> None:
    rows = [
        dataclasses.replace(row, source="rare" if number % 2 else "common") for number, row in enumerate(store.rows)
    ]
    config = ClipSampling(lengths=(5,), source_weights={"rare": 0.0}, view_weights={"primary": 3.0, "left_wrist": 1.0})
    sampler = make(store, config, rows=rows)
    sources = {row.episode_id: row.source for row in rows}
    batches = [sampler.clips(index) for index in range(400)]
    assert {sources[clip.episode_id] for batch in batches for clip in batch.clips} == {"common"}
    views = Counter(batch.view for batch in batches)
    assert 240 < views["primary"] < 360
    assert views["primary"] + views["left_wrist"] == 400


def test_single_view_steps_take_larger_batches(store: LatentStore) -> None:
    config = ClipSampling(lengths=(9,), view_weights={"joint": 0.5, "head": 0.5}, single_view_factor=3)
    whole = make(store, config, batch_size=4)
    parts = [make(store, config, batch_size=2, plan=BatchPlan(2, 2, rank, 2)) for rank in range(2)]
    sizes = Counter()
    for index in range(60):
        batch = whole.clips(index)
        sizes[batch.view, len(batch.clips)] += 1
        assert batch.clips == parts[0].clips(index).clips + parts[1].clips(index).clips
    assert set(sizes) == {(None, 4), ("head", 12)}


def test_impossible_requests_are_named(store: LatentStore) -> None:
    with pytest.raises(DataError, match="No episode is long enough"):
        make(store, ClipSampling(lengths=(33,)))
    with pytest.raises(ValidationError, match=r"lengths \[8, 15\]: a causal tokenizer codes clips of 4 k \+ 1"):
        ClipSampling(lengths=(5, 8, 15))
    with pytest.raises(ValidationError, match="needs one weight"):
        ClipSampling(lengths=(5, 9), length_weights=(1.0,))


def every_clip(store: LatentStore, lengths: tuple[int, ...], hop: int = 4) -> set[tuple[str, int, int]]:
    return {
        (row.episode_id, start, length)
        for row in store.rows
        if row.split == "train"
        for length in lengths
        for start in range(0, row.num_frames - length + 1, hop)
    }


@pytest.mark.parametrize(("world_size", "hop"), [(1, None), (2, None), (3, 8)])
def test_an_epoch_holds_every_clip_once_over_all_ranks(store: LatentStore, world_size: int, hop: int | None) -> None:
    # 6 episodes x (4 + 3 + 1) starts at every fourth frame: 24, 18 and 6 clips; 12, 12 and 6 at every eighth.
    config = ClipSampling(lengths=(5, 9, 17), order="epochs", hop=hop)
    expected = every_clip(store, (5, 9, 17), hop or 4)
    samplers = [
        make(store, config, batch_size=6 // world_size, plan=BatchPlan(world_size, world_size, rank, world_size))
        for rank in range(world_size)
    ]
    batches = len(expected) // 6
    for epoch in range(2):
        seen = Counter(
            (clip.episode_id, clip.start, clip.num_frames)
            for sampler in samplers
            for index in range(epoch * batches, (epoch + 1) * batches)
            for clip in sampler.clips(index).clips
        )
        assert set(seen) == expected
        assert set(seen.values()) == {1}
    assert samplers[0].clips_per_epoch == len(expected)
    assert samplers[0].epochs(batches) == 1.0
    assert make(store).epochs(batches) is None


def test_an_epoch_goes_on_in_its_middle(store: LatentStore) -> None:
    config = ClipSampling(lengths=(5, 9), order="epochs", view_weights={"primary": 1.0, "joint": 1.0})
    whole = [make(store, config).clips(index) for index in range(30)]
    later = make(store, config)
    assert [later.clips(index) for index in range(13, 30)] == whole[13:]
    assert {batch.view for batch in whole} == {"primary", None}
    for batch in whole:
        assert len({clip.num_frames for clip in batch.clips}) == 1


def test_a_replacement_is_another_clip_of_the_same_kind(store: LatentStore) -> None:
    for order in ("weighted", "epochs"):
        sampler = make(store, ClipSampling(lengths=(5, 9), order=order))
        drawn = [sampler.replacement(3, 1, attempt) for attempt in range(20)]
        assert drawn == [make(store, ClipSampling(lengths=(5, 9), order=order)).replacement(3, 1, a) for a in range(20)]
        assert {clip.num_frames for clip in drawn} == {sampler.clips(3).clips[1].num_frames}
        assert len(set(drawn)) > 8
        assert [sampler.replacement(3, 0, attempt) for attempt in range(20)] != drawn


def test_lengths_may_be_a_range() -> None:
    assert ClipSampling.model_validate({"lengths": {"from": 33, "to": 129}}).lengths == tuple(range(33, 130, 4))
    assert ClipSampling.model_validate({"lengths": {"from": 33, "to": 129, "step": 32}}).lengths == (33, 65, 97, 129)
    for value in ({"from": 33}, {"from": 33, "to": 129, "steps": 4}, {"from": 33, "to": "129"}):
        with pytest.raises(ValidationError, match="has the whole numbers"):
            ClipSampling.model_validate({"lengths": value})
    for value in ({"from": 33, "to": 17}, {"from": 33, "to": 129, "step": 6}):
        with pytest.raises(ValidationError, match="in steps of a multiple of 4"):
            ClipSampling.model_validate({"lengths": value})


def test_epochs_refuse_what_they_cannot_heed(store: LatentStore) -> None:
    for changes in ({"length_weights": (1.0, 2.0)}, {"source_weights": {"a": 2.0}}, {"single_view_factor": 2}):
        with pytest.raises(ValidationError, match="epochs take every clip once"):
            ClipSampling.model_validate({"lengths": (5, 9), "order": "epochs", **changes})
    with pytest.raises(ConfigError, match="cannot start at every hop"):
        make(store, ClipSampling(lengths=(5,), order="epochs", hop=6))
    with pytest.raises(ValidationError, match="only epochs have one"):
        ClipSampling(lengths=(5,), hop=8)


def test_configurations_from_before_epochs_keep_their_form() -> None:
    # Keys of artifacts and fingerprints of training states are made of these dumps.
    assert set(ClipSampling().model_dump(mode="json")) == {
        "lengths",
        "length_weights",
        "strides",
        "source_weights",
        "view_weights",
        "single_view_factor",
    }
    stated = ClipSampling(order="epochs", hop=8).model_dump(mode="json")
    assert (stated["order"], stated["hop"]) == ("epochs", 8)
    trainer = {"steps": 1}
    assert "input" not in Stage1Config.model_validate({"trainer": trainer}).model_dump(mode="json")
    changed = Stage1Config.model_validate({"trainer": trainer, "input": {"kind": "latents", "workers": 2}})
    assert changed.model_dump(mode="json")["input"]["workers"] == 2
