"""Fingerprints survive what copies go through; the search finds what comparing every pair would find, and keeps the first."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from itertools import combinations

import cv2
import numpy as np
import pytest

from tools.labelled_clips import view_thumbnails
from worldline_core.data.curation.rules import MIN_MOTION_OVERLAP, find_near_duplicates
from worldline_core.data.episodes.episode import Episode
from worldline_core.data.episodes.fingerprint import (
    MINHASHES,
    MOMENTS,
    Fingerprint,
    ViewPrint,
    fingerprint,
    motion_hashes,
)
from worldline_core.errors import DataError


def moving(number: int, num_frames: int = 60, size: tuple[int, int] = (96, 128)) -> tuple[Episode, np.ndarray]:
    """An episode of a dot that follows its states over a textured table that all numbers share."""
    rng = np.random.default_rng(number)
    time = np.arange(num_frames) / 10
    state = np.stack([np.sin(rng.uniform(0.4, 1.2) * time + rng.uniform(0, 6)) for _ in range(7)], 1)
    table = np.random.default_rng(99).uniform(40, 200, (6, 8)).astype(np.float32)
    frames = []
    for row in state:
        picture = cv2.resize(table, size[::-1], interpolation=cv2.INTER_NEAREST)
        place = (int((0.5 + 0.4 * row[0]) * size[1]), int((0.5 + 0.4 * row[1]) * size[0]))
        cv2.circle(picture, place, size[0] // 6, 250.0, -1)
        frames.append(np.repeat(picture[..., None], 3, 2).astype(np.uint8))
    episode = Episode(
        episode_id=f"e{number}", source="s", embodiment="arm", scene="room", task_family="lift", instruction="lift",
        outcome="success", split="train", fps=10.0, state=state.astype(np.float32), action=state.astype(np.float32),
        timestamps=time,
    )  # fmt: skip
    return episode, np.stack(frames)


def printed(episode: Episode, frames: np.ndarray, view: str = "head") -> Fingerprint:
    return Fingerprint.from_json(fingerprint(episode, {view: view_thumbnails(frames, episode.fps)}))


def test_the_digest_tells_every_value_and_json_keeps_it() -> None:
    episode, frames = moving(0)
    first = printed(episode, frames)
    assert printed(episode, frames).digest == first.digest
    state, action, images = episode.state.copy(), episode.action.copy(), frames.copy()
    state[5, 2] += 1e-6
    action[7, 1] += 1e-6
    images[3, :8, :8] ^= 8
    changed = [
        (replace(episode, state=state), frames), (replace(episode, action=action), frames),
        (episode, images), (episode, frames[:-1]),
    ]  # fmt: skip
    assert len({first.digest, *(printed(*other).digest for other in changed)}) == 5
    text = json.dumps(first.as_json())
    assert Fingerprint.from_json(json.loads(text)).as_json() == first.as_json()
    assert len(text) < 1500


def test_motion_overlap_estimates_the_share_of_common_cells() -> None:
    """Against the exact Jaccard index of the sets of rounded states."""
    episode, _ = moving(3, num_frames=200)
    cells = [tuple(row) for row in np.rint(episode.state.astype(np.float64) / 0.05).astype(int)]
    whole = motion_hashes(episode)
    assert whole is not None
    for stop in (190, 150, 100):
        exact = len(set(cells[:stop])) / len(set(cells))
        part = motion_hashes(episode.cut(0, stop))
        assert part is not None
        # Four standard deviations of a mean of 30 draws.
        assert (part == whole).mean() == pytest.approx(exact, abs=4 * np.sqrt(exact * (1 - exact) / MINHASHES) + 1e-9)


def test_motion_of_a_resting_arm_and_of_no_arm_says_nothing() -> None:
    episode, _ = moving(0)
    resting = replace(episode, state=np.zeros_like(episode.state))
    assert motion_hashes(resting) is None
    broken = episode.state.copy()
    broken[4] = np.nan
    without = motion_hashes(replace(episode, state=broken))
    assert without is not None
    assert (without == motion_hashes(episode)).mean() > 0.8
    nothing = np.zeros((60, 0), np.float32)
    assert motion_hashes(replace(episode, state=nothing, action=nothing, state_kind="none")) is None


def test_looks_survive_light_size_and_noise_but_not_another_episode() -> None:
    episode, frames = moving(0)
    first = printed(episode, frames).views["head"]
    other = printed(*moving(1)).views["head"]
    noise = np.random.default_rng(0).normal(0, 3, frames.shape)
    for copy in (
        np.clip(frames * 1.1 + 5, 0, 255),
        np.stack([cv2.resize(f, (96, 72), interpolation=cv2.INTER_AREA) for f in frames]),
        np.clip(frames + noise, 0, 255),
    ):
        seen = printed(episode, copy.astype(np.uint8)).views["head"]
        assert np.bitwise_count(seen.frames ^ first.frames).mean() < 4
        assert np.bitwise_count(seen.first ^ first.first).sum() < 24
    assert np.bitwise_count(other.frames ^ first.frames).mean() > 8


def test_a_view_without_images_is_an_error() -> None:
    episode, frames = moving(0)
    with pytest.raises(DataError, match="no images"):
        fingerprint(episode, {"head": view_thumbnails(frames, 10.0).cut(0, 0)})


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
        if np.equal(prints[a].motion, prints[b].motion).mean() >= MIN_MOTION_OVERLAP:  # type: ignore[arg-type]
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
    assert seconds(5_000) < 30 * max(seconds(500), 0.005)
