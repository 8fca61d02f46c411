"""Near duplicates among many episodes: the same recording re-encoded, resized, brightened or trimmed at its ends.

The motion decides and the images confirm: two demonstrations of one task in one scene look alike and move differently.
Pairs are found by hashing (equal bands of MinHashes), never by comparing all with all.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from worldline_core.data.episodes.fingerprint import MINHASHES, MOMENTS, Fingerprint

_BAND = 3
MIN_MOTION_OVERLAP = 0.5
"""Least share of common state cells (estimated Jaccard index)."""
_MAX_FRAME_DISTANCE = 12.0
"""Most differing bits of 64 of a moment's hash, mean."""


@dataclass(frozen=True)
class NearDuplicate:
    """Episode `position` repeats `original`, the first of its group.

    The numbers are those of the comparison with `compared_with` by which the episode (or the copies of it that were
    found before) came into the group; `frame_distance` is in bits of 64.
    """

    position: int
    original: int
    compared_with: int
    motion_overlap: float
    frame_distance: float


def find_near_duplicates(prints: Sequence[Fingerprint]) -> list[NearDuplicate]:
    """Episodes that repeat an earlier one, ordered by position; those whose robot hardly moves are not compared.

    Args:
        prints: in listed order: of each group of equal recordings the first is the original.
    """
    moved = [position for position, seen in enumerate(prints) if seen.motion is not None]
    if len(moved) < 2:
        return []
    layouts = {layout: number for number, layout in enumerate(sorted({seen.layout for seen in prints}))}
    layout = np.array([layouts[prints[position].layout] for position in moved])
    motion = np.array([prints[position].motion for position in moved], np.int64)
    views = sorted({view for seen in prints for view in seen.views})
    frames = np.zeros((len(moved), len(views), MOMENTS), np.uint64)
    present = np.zeros((len(moved), len(views)), bool)
    for number, position in enumerate(moved):
        for column, view in enumerate(views):
            if view in prints[position].views:
                frames[number, column] = prints[position].views[view].frames
                present[number, column] = True
    group = np.arange(len(moved))
    found: dict[int, NearDuplicate] = {}
    for start in range(0, MINHASHES, _BAND):
        for members in _equal_rows(np.column_stack([layout, motion[:, start : start + _BAND]])):
            for place, first in enumerate(members[:-1].tolist()):
                others = members[place + 1 :]
                others = others[group[others] != group[first]]
                overlap = (motion[others] == motion[first]).mean(axis=1)
                others, overlap = others[overlap >= MIN_MOTION_OVERLAP], overlap[overlap >= MIN_MOTION_OVERLAP]
                shared = present[others] & present[first]
                distance = _frame_distance(frames[first], frames[others], shared)
                alike = shared.any(axis=1) & (distance <= _MAX_FRAME_DISTANCE)
                for other, share, bits in zip(others[alike].tolist(), overlap[alike], distance[alike], strict=True):
                    heads = {int(group[first]): first, int(group[other]): other}
                    low, high = min(heads), max(heads)
                    if low != high:
                        # Every episode but the first of its group heads a group until here: each gets one record.
                        compared = moved[heads[low]]
                        found[high] = NearDuplicate(moved[high], -1, compared, float(share), float(bits))
                        group[group == high] = low
    return [
        NearDuplicate(seen.position, moved[group[number]], seen.compared_with, seen.motion_overlap, seen.frame_distance)
        for number, seen in sorted(found.items())
    ]


def _frame_distance(first: np.ndarray, others: np.ndarray, shared: np.ndarray) -> np.ndarray:
    """(n,) mean differing bits over shared views, of hashes (v, m) and (n, v, m).

    Each moment counts against the best of three neighbouring ones of `first`, because trimming shifts moments.
    """
    moments = (np.clip(np.arange(MOMENTS) + shift, 0, MOMENTS - 1) for shift in (-1, 0, 1))
    bits = [np.bitwise_count(first[:, chosen] ^ others).astype(np.float64) for chosen in moments]
    by_view = np.stack(bits).min(axis=0).mean(axis=2)
    return np.where(shared, by_view, 0.0).sum(axis=1) / np.maximum(shared.sum(axis=1), 1)


def _equal_rows(keys: np.ndarray) -> Iterator[np.ndarray]:
    """Groups of the indices of equal rows, in ascending order."""
    _, row, counts = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    repeated = np.flatnonzero(counts[row] > 1)
    order = repeated[np.argsort(row[repeated], kind="stable")]
    yield from np.split(order, np.flatnonzero(np.diff(row[order])) + 1)
