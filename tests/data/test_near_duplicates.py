"""The search finds what comparing every pair would find, and keeps the first of each group."""

from __future__ import annotations

import time
from dataclasses import replace
from itertools import combinations

import numpy as np

from worldline_core.data.curation.rules import MIN_MOTION_OVERLAP, find_near_duplicates
from worldline_core.data.episodes.fingerprint import MINHASHES, MOMENTS, Fingerprint, ViewPrint

VIEWS = ("head", "left_wrist")


def random_print(rng: np.random.Generator) -> Fingerprint:
    motion = rng.integers(0, 2**32, MINHASHES, dtype=np.uint32)
    views = {
        view: ViewPrint(rng.integers(0, 2**63, MOMENTS, dtype=np.uint64), rng.integers(0, 2**63, 4, dtype=np.uint64))
        for view in VIEWS
    }
    return Fingerprint(str(rng.random()), "joints/14", motion, views)


def flipped(words: np.ndarray, bits: int, rng: np.random.Generator) -> np.ndarray:
    result = words.copy()
    for place in range(len(result)):
        for bit in rng.choice(64, bits, replace=False):
            result[place] ^= np.uint64(1) << np.uint64(bit)
    return result


def copied(seen: Fingerprint, rng: np.random.Generator, *, changed: float = 0.2, bits: int = 1) -> Fingerprint:
    assert seen.motion is not None
    motion = np.where(rng.random(MINHASHES) < changed, seen.motion ^ np.uint32(1), seen.motion)
    views = {view: ViewPrint(flipped(v.frames, bits, rng), v.first) for view, v in seen.views.items()}
    return replace(seen, digest=str(rng.random()), motion=motion, views=views)


def test_copies_are_found_and_nothing_else() -> None:
    rng = np.random.default_rng(0)
    prints = [random_print(rng) for _ in range(300)]
    prints += [copied(prints[i], rng) for i in range(0, 300, 10)]
    found = find_near_duplicates(prints)
    assert [(f.position, f.original) for f in found] == [(300 + k, 10 * k) for k in range(30)]
    assert all(0 < f.frame_distance < 2 for f in found)


def test_the_search_agrees_with_comparing_every_pair() -> None:
    """Overlaps from 0 to 1: the pairs that a full comparison accepts, against those whose group the search joined."""
    rng = np.random.default_rng(1)
    prints = [random_print(rng) for _ in range(60)]
    for i in range(60):
        prints.append(copied(prints[i], rng, changed=i / 60))
    wanted = set()
    for a, b in combinations(range(len(prints)), 2):
        first, second = prints[a].motion, prints[b].motion
        assert first is not None
        assert second is not None
        if (first == second).mean() >= MIN_MOTION_OVERLAP:
            wanted.add((a, b))
    found = {(f.original, f.position) for f in find_near_duplicates(prints)}
    assert found <= wanted
    # A band of three equal MinHashes of ten: 1 - (1 - 0.5 ** 3) ** 10 = 0.74 at the threshold, more above it.
    assert len(found) >= 0.9 * len(wanted)


def test_groups_keep_their_first_and_chains_are_followed() -> None:
    rng = np.random.default_rng(2)
    prints = [random_print(rng) for _ in range(6)]
    far = copied(prints[1], rng, changed=0.3)
    prints += [far, copied(far, rng, changed=0.3), copied(prints[4], rng)]
    found = {f.position: f for f in find_near_duplicates(prints)}
    assert {position: f.original for position, f in found.items()} == {6: 1, 7: 1, 8: 4}
    assert found[7].compared_with in (1, 6)


def test_other_motion_room_layout_views_or_none_at_all_is_no_duplicate() -> None:
    rng = np.random.default_rng(3)
    first, other = random_print(rng), random_print(rng)
    copy = copied(first, rng, bits=0)
    for changed in (
        replace(copy, motion=other.motion),
        replace(copy, motion=None),
        replace(copy, layout="ee_pose/8"),
        replace(copy, views=other.views),
        replace(copy, views={f"other_{view}": seen for view, seen in first.views.items()}),
    ):
        assert find_near_duplicates([first, changed]) == []
    assert len(find_near_duplicates([first, copy])) == 1


def test_time_grows_with_the_number_of_episodes() -> None:
    def seconds(count: int) -> float:
        rng = np.random.default_rng(7)
        prints = [random_print(rng) for _ in range(count)]
        clock = time.process_time()
        assert find_near_duplicates(prints) == []
        return time.process_time() - clock

    seconds(200)
    # Comparing all pairs would take a hundred times as long.
    assert seconds(10_000) < 30 * max(seconds(1_000), 0.01)
