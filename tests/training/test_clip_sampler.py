import dataclasses
from collections import Counter

import pytest
from pydantic import ValidationError

from worldline_core.errors import DataError
from worldline_core.training.clip_config import ClipSampling
from worldline_core.training.clip_sampler import ClipSampler
from worldline_core.training.clip_source import LatentStore
from worldline_core.training.processes import BatchPlan

VIEWS = ("head", "left_wrist", "right_wrist")


@pytest.fixture
def store(world):
    return LatentStore.open(world.latents)


def make(store, config=None, **changes):
    values = {"views": VIEWS, "splits": ["train"], "start_step": store.start_step, "batch_size": 4, "seed": 3}
    return ClipSampler(config=config or ClipSampling(lengths=(5, 9, 17)), **{"rows": store.rows, **values, **changes})


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
            assert store.row(clip.episode_id).split == "train"
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
    rows = [dataclasses.replace(row, source=("common", "rare")[number % 2]) for number, row in enumerate(store.rows)]
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


def test_a_replacement_is_another_clip_of_the_same_kind(store):
    sampler, again = (make(store, ClipSampling(lengths=(5, 9))) for _ in range(2))
    drawn = [sampler.replacement(3, 1, attempt) for attempt in range(20)]
    assert drawn == [again.replacement(3, 1, attempt) for attempt in range(20)]
    assert {clip.num_frames for clip in drawn} == {sampler.clips(3).clips[1].num_frames}
    assert len(set(drawn)) > 8
    assert [sampler.replacement(3, 0, attempt) for attempt in range(20)] != drawn


def test_lengths_may_be_a_range_and_fit_the_tokenizer_and_the_recordings(store):
    assert ClipSampling.model_validate({"lengths": {"from": 33, "to": 129}}).lengths == tuple(range(33, 130, 4))
    for value in ({"from": 33}, {"from": 33, "to": 129, "step": 4}, {"from": 33, "to": "129"}):
        with pytest.raises(ValidationError, match="`from` and `to`"):
            ClipSampling.model_validate({"lengths": value})
    with pytest.raises(ValidationError, match="at least 1 item"):
        ClipSampling.model_validate({"lengths": {"from": 33, "to": 17}})
    with pytest.raises(ValidationError, match=r"lengths \[8, 15\]: a causal tokenizer codes clips of 4 k \+ 1"):
        ClipSampling(lengths=(5, 8, 15))
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
