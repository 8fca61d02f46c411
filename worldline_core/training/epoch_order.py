"""Every clip once per epoch, without a table: which clips a batch holds is a function of its number and the seed.

Clips are numbered within their kind, and the numbers of an epoch pass through a keyed permutation, so that a corpus of
10^8 clips needs no table. Batches hold clips of one kind and are always full: what does not fill a batch at the end of
an epoch (for each kind, fewer clips than a batch has) goes into the next epoch's. Nothing is lost, and no clip comes more
often than there are epochs.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from itertools import accumulate

_ROUNDS = 6
_MASK = (1 << 64) - 1


def permuted(position: int, count: int, key: int) -> int:
    """Image of ``position`` under a pseudo-random permutation of 0..count-1 chosen by ``key``.

    A Feistel network over the next even number of bits, walked until it falls below ``count`` (cycle walking; Black and
    Rogaway 2002, "Ciphers with arbitrary finite domains").
    """
    if count <= 1:
        return position
    half = max(1, ((count - 1).bit_length() + 1) // 2)
    low = (1 << half) - 1
    while True:
        left, right = position >> half, position & low
        for turn in range(_ROUNDS):
            left, right = right, left ^ (_mixed(right + (turn << 32) + key) & low)
        position = (left << half) | right
        if position < count:
            return position


def _mixed(value: int) -> int:
    """The finaliser of splitmix64 (Steele, Lea and Flood 2014)."""
    value = (value + 0x9E3779B97F4A7C15) & _MASK
    value = ((value ^ (value >> 30)) * 0xBF58476D1CE4E5B9) & _MASK
    value = ((value ^ (value >> 27)) * 0x94D049BB133111EB) & _MASK
    return value ^ (value >> 31)


def mixed_key(*parts: int) -> int:
    """One 64-bit key of several numbers."""
    key = 0
    for part in parts:
        key = _mixed(key ^ _mixed(part))
    return key


class EpochOrder:
    """Batches of clip numbers in which every clip comes once per epoch.

    Args:
        counts: number of clips of each kind.
        batch: clips per batch, all processes together.
    """

    def __init__(self, counts: Sequence[int], batch: int, seed: int) -> None:
        self.counts = list(counts)
        self.batch = batch
        self.seed = seed

    def batches_before(self, epoch: int) -> int:
        """Batches of all epochs before ``epoch``."""
        return sum(epoch * count // self.batch for count in self.counts)

    def epoch(self, index: int) -> int:
        """The epoch that batch ``index`` belongs to."""
        # An epoch lacks, for each kind, at most what does not fill a batch.
        most = (index + 1 + len(self.counts)) * self.batch // sum(self.counts) + 1
        return bisect_right(range(most + 1), index, key=self.batches_before) - 1

    def locate(self, index: int) -> tuple[int, list[int]]:
        """(kind, numbers of the batch's clips within the kind) of batch ``index``."""
        epoch = self.epoch(index)
        firsts = [epoch * count // self.batch for count in self.counts]
        sizes = [(epoch + 1) * count // self.batch - first for count, first in zip(self.counts, firsts, strict=True)]
        before = self.batches_before(epoch)
        place = permuted(index - before, sum(sizes), mixed_key(self.seed, epoch))
        ends = list(accumulate(sizes))
        kind = bisect_right(ends, place)
        number = firsts[kind] + place - (ends[kind] - sizes[kind])
        return kind, [self._clip(kind, item) for item in range(number * self.batch, (number + 1) * self.batch)]

    def _clip(self, kind: int, item: int) -> int:
        epoch, position = divmod(item, self.counts[kind])
        return permuted(position, self.counts[kind], mixed_key(self.seed, epoch, kind + 1))
