from __future__ import annotations

import dataclasses
from collections import Counter
from typing import Any

import pytest

from worldline_core.errors import ConfigError, DataError
from worldline_core.training.clip_sampler import ClipSampler, ClipSampling
from worldline_core.training.latent_store import LatentStore


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
    parts = [make(store, batch_size=2, rank=rank, world_size=2) for rank in range(2)]
    for index in range(10):
        assert whole.clips(index).clips == parts[0].clips(index).clips + parts[1].clips(index).clips


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
    parts = [make(store, config, batch_size=2, rank=rank, world_size=2) for rank in range(2)]
    sizes = Counter()
    for index in range(60):
        batch = whole.clips(index)
        sizes[batch.view, len(batch.clips)] += 1
        assert batch.clips == parts[0].clips(index).clips + parts[1].clips(index).clips
    assert set(sizes) == {(None, 4), ("head", 12)}


def test_impossible_requests_are_named(store: LatentStore) -> None:
    with pytest.raises(DataError, match="No episode is long enough"):
        make(store, ClipSampling(lengths=(33,)))
    with pytest.raises(ConfigError, match="needs one weight"):
        make(store, ClipSampling(lengths=(5, 9), length_weights=(1.0,)))
