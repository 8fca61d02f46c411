from __future__ import annotations

import dataclasses
from collections import Counter
from typing import Any

import pytest
from pydantic import ValidationError

from worldline_core.errors import DataError
from worldline_core.training.clip_config import ClipSampling
from worldline_core.training.clip_sampler import ClipSampler
from worldline_core.training.clip_source import LatentStore
from worldline_core.training.processes import BatchPlan

VIEWS = ("head", "left_wrist", "right_wrist")


@pytest.fixture
def store(world: Any) -> LatentStore:
    return LatentStore.open(world.latents)


def make(store: LatentStore, config: ClipSampling | None = None, **changes: Any) -> ClipSampler:
    values: dict[str, Any] = {
        "views": VIEWS,
        "splits": ["train"],
        "start_step": store.start_step,
        "batch_size": 4,
        "seed": 3,
    }
    rows = changes.pop("rows", store.rows)
    return ClipSampler(rows, config or ClipSampling(lengths=(5, 9, 17)), **(values | changes))


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


@pytest.mark.parametrize(("together", "world_size"), [(2, 1), (1, 2), (4, 2), (2, 4)])
def test_another_number_of_processes_goes_on_with_the_same_clips(
    store: LatentStore, together: int, world_size: int
) -> None:
    config = ClipSampling(lengths=(5, 9))
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
    views = Counter((batch.views, batch.primary) for batch in batches)
    assert 240 < views[("head",), True] < 360
    assert views[("head",), True] + views[("left_wrist",), False] == 400


def test_single_view_steps_take_larger_batches(store: LatentStore) -> None:
    config = ClipSampling(lengths=(9,), view_weights={"joint": 0.5, "head": 0.5}, single_view_factor=3)
    whole = make(store, config, batch_size=4)
    parts = [make(store, config, batch_size=2, plan=BatchPlan(2, 2, rank, 2)) for rank in range(2)]
    sizes = Counter()
    for index in range(60):
        batch = whole.clips(index)
        sizes[batch.views, len(batch.clips)] += 1
        assert batch.clips == parts[0].clips(index).clips + parts[1].clips(index).clips
    assert set(sizes) == {(VIEWS, 4), (("head",), 12)}


def test_impossible_requests_are_named(store: LatentStore) -> None:
    with pytest.raises(DataError, match="No episode is long enough"):
        make(store, ClipSampling(lengths=(33,)))
    with pytest.raises(ValidationError, match=r"lengths \[8, 15\]: a causal tokenizer codes clips of 4 k \+ 1"):
        ClipSampling(lengths=(5, 8, 15))


def test_a_replacement_is_another_clip_of_the_same_kind(store: LatentStore) -> None:
    sampler, again = (make(store, ClipSampling(lengths=(5, 9))) for _ in range(2))
    drawn = [sampler.replacement(3, 1, attempt) for attempt in range(20)]
    assert drawn == [again.replacement(3, 1, attempt) for attempt in range(20)]
    assert {clip.num_frames for clip in drawn} == {sampler.clips(3).clips[1].num_frames}
    assert len(set(drawn)) > 8
    assert [sampler.replacement(3, 0, attempt) for attempt in range(20)] != drawn


def test_lengths_may_be_a_range() -> None:
    assert ClipSampling.model_validate({"lengths": {"from": 33, "to": 129}}).lengths == tuple(range(33, 130, 4))
    for value in ({"from": 33}, {"from": 33, "to": 129, "step": 4}, {"from": 33, "to": "129"}):
        with pytest.raises(ValidationError, match="`from` and `to`"):
            ClipSampling.model_validate({"lengths": value})
    with pytest.raises(ValidationError, match="at least 1 item"):
        ClipSampling.model_validate({"lengths": {"from": 33, "to": 17}})


def test_the_draws_of_a_seed_stay_what_they_are(store: LatentStore) -> None:
    """Checkpoints name a seed; the clips that it draws are fixed here."""
    config = ClipSampling(lengths=(5, 9), view_weights={"joint": 1.0, "head": 1.0}, single_view_factor=2)
    batches = [make(store, config, batch_size=2).clips(index) for index in range(3)]
    assert [batch.views for batch in batches] == [("head",), VIEWS, VIEWS]
    drawn = [(int(clip.episode_id[-1]), clip.start) for batch in batches for clip in batch.clips]
    assert drawn == [(4, 8), (6, 4), (2, 4), (3, 4), (6, 0), (4, 0), (4, 4), (4, 8)]
    assert {clip.num_frames for batch in batches for clip in batch.clips} == {9}
