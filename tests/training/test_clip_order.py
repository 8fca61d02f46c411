from __future__ import annotations

from collections import Counter
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from worldline_core.training.clip_sampler import EpochOrder, mixed_key, permuted


@given(count=st.integers(1, 700), key=st.integers(0, 2**64 - 1))
@settings(max_examples=60, deadline=None)
def test_the_permutation_takes_every_place_once(count: int, key: int) -> None:
    assert sorted(permuted(position, count, key) for position in range(count)) == list(range(count))


def test_the_permutation_mixes_and_depends_on_its_key() -> None:
    images = [[permuted(position, 5000, mixed_key(7, epoch)) for position in range(5000)] for epoch in range(2)]
    assert sum(a == b for a, b in zip(*images, strict=True)) < 15
    for image in images:
        # A random permutation is correlated with its argument by about 1 / sqrt(5000).
        assert abs(np.corrcoef(image, np.arange(5000))[0, 1]) < 0.05
        assert abs(np.corrcoef(image[1:], image[:-1])[0, 1]) < 0.05


def test_a_place_in_a_huge_corpus_costs_nothing() -> None:
    order = EpochOrder([3 * 10**9, 10**9 + 7], 64, seed=1)
    index = order.batches_before(2) + 12_345_678
    kind, clips = order.locate(index)
    assert order.epoch(index) == 2
    assert len(set(clips)) == 64
    assert all(0 <= clip < order.counts[kind] for clip in clips)


@given(
    counts=st.lists(st.integers(1, 60), min_size=1, max_size=4),
    batch=st.integers(1, 9),
    seed=st.integers(0, 2**32),
)
@settings(max_examples=60, deadline=None)
def test_every_clip_comes_once_an_epoch(counts: list[int], batch: int, seed: int) -> None:
    order = EpochOrder(counts, batch, seed)
    seen: list[Counter[int]] = [Counter() for _ in counts]
    index = 0
    for epoch in range(3):
        while index < order.batches_before(epoch + 1):
            kind, clips = order.locate(index)
            assert order.epoch(index) == epoch
            assert len(clips) == batch
            seen[kind].update(clips)
            index += 1
        for kind, count in enumerate(counts):
            drawn = (epoch + 1) * count // batch * batch
            # What does not fill a batch goes into the next epoch: nothing is lost, nothing comes more often than that.
            assert seen[kind].total() == drawn
            assert all(seen[kind][clip] in (epoch, epoch + 1) for clip in range(count)) or batch > count
            assert max(seen[kind].values(), default=0) <= epoch + 1


def test_epochs_differ_and_batches_of_kinds_are_mixed() -> None:
    order = EpochOrder([40, 40], 4, seed=3)
    first, second = ([order.locate(index) for index in range(20 * epoch, 20 * epoch + 20)] for epoch in range(2))
    assert first != second
    kinds = [kind for kind, _ in first]
    assert sum(a != b for a, b in pairwise(kinds)) >= 4
    assert EpochOrder([40, 40], 4, seed=4).locate(0) != order.locate(0)


@pytest.mark.parametrize("world_size", [1, 2, 5])
def test_parts_of_a_batch_belong_to_ranks(world_size: int) -> None:
    order = EpochOrder([30], 10, seed=0)
    clips = [clip for index in range(3) for clip in order.locate(index)[1]]
    size = 10 // world_size
    shares = [
        {clip for index in range(3) for clip in order.locate(index)[1][rank * size : (rank + 1) * size]}
        for rank in range(world_size)
    ]
    assert sorted(clips) == list(range(30))
    assert sum(len(share) for share in shares) == len(set().union(*shares)) == 30
