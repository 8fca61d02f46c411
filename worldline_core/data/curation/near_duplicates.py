"""Near duplicates among many episodes: the same recording re-encoded, resized, brightened or trimmed at its ends.

Pairs are found by hashing (equal bands of MinHashes, equal halves of motion pictures), never by comparing all with all:
time grows with the number of episodes and of true candidates.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from worldline_core.data.episodes.fingerprint import MINHASHES, MOMENTS, Fingerprint

_BAND = 3
_HALF_BITS = np.uint64(0xFFFFFFFF)
_MIN_MOVING_BITS = 4


# With states, the motion decides and the images only confirm: two demonstrations of one task in one scene look alike and
# move differently. Without states the images alone decide, by stricter numbers.
MIN_MOTION_OVERLAP = 0.5
"""Least share of common state cells (estimated Jaccard index)."""
_MAX_FRAME_DISTANCE = 12.0
"""With equal motion: most differing bits of 64 of a moment's hash, mean."""
_MAX_FRAME_DISTANCE_WITHOUT_STATES = 4.0
_MAX_MOVING_DISTANCE = 0.15
"""Without states: most of the moved area (1 - Jaccard) that may differ."""
_MAX_LENGTH_DIFFERENCE_S = 1.0
"""Without states: largest difference in length."""


@dataclass(frozen=True)
class NearDuplicate:
    """Episode `position` repeats `original`, the first of its group.

    The numbers are those of the comparison with `compared_with` by which the episode (or the copies of it that were
    found before) came into the group.

    Attributes:
        motion_overlap: None where it could not be compared. frame_distance: bits of 64. moving_distance: 0 .. 1.
    """

    position: int
    original: int
    compared_with: int
    motion_overlap: float | None
    frame_distance: float
    moving_distance: float


def find_near_duplicates(prints: Sequence[Fingerprint]) -> list[NearDuplicate]:
    """Episodes that repeat an earlier one, ordered by position.

    Args:
        prints: in listed order: of each group of equal recordings the first is the original.
    """
    if len(prints) < 2:
        return []
    search = _Search(prints)
    for members in search.motion_groups():
        search.join(members, by_motion=True)
    for members in search.image_groups():
        search.join(members, by_motion=False)
    return search.found()


class _Search:
    """Arrays over all episodes, and the groups found so far.

    Axes: e episodes, v view names, m moments.
    """

    def __init__(self, prints: Sequence[Fingerprint]) -> None:
        views = sorted({view for seen in prints for view in seen.views})
        layouts = {layout: number for number, layout in enumerate(sorted({seen.layout for seen in prints}))}
        count = len(prints)
        self.seconds = np.array([seen.seconds for seen in prints])
        self.layout = np.array([-1 if seen.motion is None else layouts[seen.layout] for seen in prints])
        self.motion = np.zeros((count, MINHASHES), np.uint32)
        self.frames = np.zeros((count, len(views), MOMENTS), np.uint64)
        self.moving = np.zeros((count, len(views), MOMENTS), np.uint64)
        self.present = np.zeros((count, len(views)), bool)
        for number, seen in enumerate(prints):
            if seen.motion is not None:
                self.motion[number] = seen.motion
            for column, view in enumerate(views):
                if view in seen.views:
                    self.frames[number, column] = seen.views[view].frames
                    self.moving[number, column] = seen.views[view].moving
                    self.present[number, column] = True
        self.group = np.arange(count)
        self._joined: dict[int, tuple[int, float | None, float, float]] = {}

    def motion_groups(self) -> Iterator[np.ndarray]:
        """Episodes of one layout that agree in a band of MinHashes."""
        moved = np.flatnonzero(self.layout >= 0)
        for start in range(0, MINHASHES, _BAND):
            words = self.motion[moved, start : start + _BAND].astype(np.int64)
            yield from _equal_rows(moved, np.column_stack([self.layout[moved], words]))

    def image_groups(self) -> Iterator[np.ndarray]:
        """Episodes that moved in the same half of the picture at the same moment, where motion cannot be compared."""
        layouts = np.unique(self.layout)
        if len(layouts) == 1 and layouts[0] >= 0:
            return
        for column in range(self.moving.shape[1]):
            for moment in range(MOMENTS):
                for shift in (0, 32):
                    half = (self.moving[:, column, moment] >> np.uint64(shift)) & _HALF_BITS
                    telling = np.flatnonzero(np.bitwise_count(half) >= _MIN_MOVING_BITS)
                    yield from _equal_rows(telling, half[telling, None].astype(np.int64))

    def join(self, members: np.ndarray, *, by_motion: bool) -> None:
        """Compare candidates, each with the later ones that are not in its group yet."""
        if not by_motion:
            members = members[np.argsort(self.seconds[members], kind="stable")]
        for place, first in enumerate(members[:-1]):
            others = members[place + 1 :]
            if not by_motion:
                within = self.seconds[others] - self.seconds[first] <= _MAX_LENGTH_DIFFERENCE_S
                others = others[: np.count_nonzero(within)]
            others = others[self.group[others] != self.group[first]]
            if by_motion:
                overlap = (self.motion[others] == self.motion[first]).mean(axis=1)
                others = others[overlap >= MIN_MOTION_OVERLAP]
            else:
                unlike = (self.layout[others] != self.layout[first]) | (self.layout[first] < 0)
                others = others[unlike]
            if len(others):
                self._compare(int(first), others, by_motion=by_motion)

    def _compare(self, first: int, others: np.ndarray, *, by_motion: bool) -> None:
        shared = self.present[others] & self.present[first]
        frames, moving = self._image_distances(first, others, shared)
        if by_motion:
            equal = frames <= _MAX_FRAME_DISTANCE
        else:
            equal = (frames <= _MAX_FRAME_DISTANCE_WITHOUT_STATES) & (moving <= _MAX_MOVING_DISTANCE)
        equal &= shared.any(axis=1)
        for other, frame, moved in zip(others[equal], frames[equal], moving[equal], strict=True):
            overlap = float((self.motion[other] == self.motion[first]).mean()) if by_motion else None
            groups = {int(self.group[first]): first, int(self.group[other]): int(other)}
            low, high = min(groups), max(groups)
            if low != high:
                # Every episode but the first of its group heads a group until here, so each gets its record once.
                self._joined[high] = (groups[low], overlap, float(frame), float(moved))
                self.group[self.group == high] = low

    def _image_distances(self, first: int, others: np.ndarray, shared: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(len,) mean differing bits and (len,) 1 - Jaccard of moved cells, over shared views; each moment against the
        best of three neighbouring ones of `first`, because trimming shifts moments."""
        bits, apart, union = [], [], []
        for shift in (-1, 0, 1):
            moments = np.clip(np.arange(MOMENTS) + shift, 0, MOMENTS - 1)
            bits.append(np.bitwise_count(self.frames[first][:, moments] ^ self.frames[others]).astype(np.float64))
            a, b = self.moving[first][:, moments], self.moving[others]
            apart.append(np.bitwise_count(a ^ b).astype(np.int64))
            union.append(np.bitwise_count(a | b).astype(np.int64))
        best = np.argmin(np.stack(apart), axis=0)[None]
        least = np.take_along_axis(np.stack(apart), best, axis=0)[0].sum(axis=2)
        whole = np.take_along_axis(np.stack(union), best, axis=0)[0].sum(axis=2)
        by_view = np.stack([np.stack(bits).min(axis=0).mean(axis=2), least / np.maximum(whole, 1)])
        count = np.maximum(shared.sum(axis=1), 1)
        mean = np.where(shared, by_view, 0.0).sum(axis=2) / count
        return mean[0], mean[1]

    def found(self) -> list[NearDuplicate]:
        """Every episode that is not the first of its group."""
        result = []
        for position in np.flatnonzero(self.group != np.arange(len(self.group))):
            compared_with, overlap, frames, moving = self._joined[int(position)]
            result.append(
                NearDuplicate(int(position), int(self.group[position]), compared_with, overlap, frames, moving)
            )
        return result


def _equal_rows(members: np.ndarray, keys: np.ndarray) -> Iterator[np.ndarray]:
    """Groups of at least two members with equal rows of `keys` (int64), members in ascending order."""
    if len(members) < 2:
        return
    order = np.lexsort((members, *keys.T[::-1]))
    ordered = keys[order]
    starts = np.flatnonzero(np.concatenate([[True], (ordered[1:] != ordered[:-1]).any(axis=1)]))
    ends = np.append(starts[1:], len(order))
    for start, end in zip(starts[ends - starts > 1], ends[ends - starts > 1], strict=True):
        yield members[order[start:end]]
