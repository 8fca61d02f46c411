"""The search finds what comparing every pair would find, and keeps the first of each group."""

from __future__ import annotations

import time
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from worldline_core.data.curation.near_duplicates import MIN_MOTION_OVERLAP, find_near_duplicates
from worldline_core.data.episodes.fingerprint import MINHASHES, MOMENTS, Fingerprint, ViewPrint

VIEWS = ("head", "left_wrist")


def random_print(rng: np.random.Generator, *, layout: str = "joints/14", states: bool = True) -> Fingerprint:
    motion = rng.integers(0, 2**32, MINHASHES, dtype=np.uint32) if states else None
    views = {
        view: ViewPrint(
            rng.integers(0, 2**63, MOMENTS, dtype=np.uint64),
            rng.integers(0, 2**63, MOMENTS, dtype=np.uint64) & rng.integers(0, 2**63, MOMENTS, dtype=np.uint64),
            rng.integers(0, 2**63, 4, dtype=np.uint64),
        )
        for view in VIEWS
    }
    return Fingerprint(str(rng.random()), float(rng.uniform(5, 20)), layout, motion, views)


def flipped(words: np.ndarray, bits: int, rng: np.random.Generator) -> np.ndarray:
    result = words.copy()
    for place in range(len(result)):
        for bit in rng.choice(64, bits, replace=False):
            result[place] ^= np.uint64(1) << np.uint64(bit)
    return result


def copied(seen: Fingerprint, rng: np.random.Generator, *, changed: float = 0.2, bits: int = 1) -> Fingerprint:
    motion = None
    if seen.motion is not None:
        motion = np.where(rng.random(MINHASHES) < changed, seen.motion ^ np.uint32(1), seen.motion)
    views = {
        view: ViewPrint(flipped(v.frames, bits, rng), flipped(v.moving, bits, rng), v.first)
        for view, v in seen.views.items()
    }
    return replace(seen, digest=str(rng.random()), motion=motion, views=views)


@pytest.mark.parametrize("states", [True, False])
def test_copies_are_found_and_nothing_else(states: bool) -> None:
    rng = np.random.default_rng(0)
    prints = [random_print(rng, states=states) for _ in range(300)]
    prints += [copied(prints[i], rng) for i in range(0, 300, 10)]
    found = find_near_duplicates(prints)
    assert [(f.position, f.original) for f in found] == [(300 + k, 10 * k) for k in range(30)]
    assert all((f.motion_overlap is not None) == states for f in found)
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


def test_different_motion_before_the_same_wall_is_no_duplicate() -> None:
    rng = np.random.default_rng(3)
    first = random_print(rng)
    second = replace(copied(first, rng, bits=0), motion=random_print(rng).motion)
    assert find_near_duplicates([first, second]) == []


def test_equal_motion_in_another_room_is_no_duplicate() -> None:
    rng = np.random.default_rng(4)
    first, other = random_print(rng), random_print(rng)
    assert find_near_duplicates([first, replace(other, motion=first.motion)]) == []


def test_without_states_length_counts_and_layouts_are_bridged_by_images() -> None:
    rng = np.random.default_rng(5)
    video = random_print(rng, states=False)
    longer = replace(copied(video, rng), seconds=video.seconds + 3)
    assert find_near_duplicates([video, longer]) == []
    assert len(find_near_duplicates([video, replace(longer, seconds=video.seconds + 0.5)])) == 1
    joints = random_print(rng)
    poses = replace(copied(joints, rng), layout="ee_pose/8", motion=random_print(rng).motion)
    (found,) = find_near_duplicates([joints, poses])
    assert found.motion_overlap is None


def test_episodes_without_a_common_view_are_not_compared() -> None:
    rng = np.random.default_rng(6)
    first = random_print(rng)
    renamed = replace(first, views={f"other_{view}": seen for view, seen in first.views.items()})
    assert find_near_duplicates([first, renamed]) == []


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
