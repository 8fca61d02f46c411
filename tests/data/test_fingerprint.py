"""Fingerprints survive what copies go through, and differ where recordings do."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest

from tools.thumbnails import view_thumbnails
from worldline_core.data.episodes.episode import Episode
from worldline_core.data.episodes.fingerprint import MINHASHES, Fingerprint, fingerprint, motion_hashes
from worldline_core.errors import DataError

Make = Callable[..., tuple]


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


def overlap(a: Fingerprint, b: Fingerprint) -> float:
    assert a.motion is not None
    assert b.motion is not None
    return float((a.motion == b.motion).mean())


def test_the_digest_tells_every_value(sample: Make) -> None:
    episode, frames = moving(0)
    first = printed(episode, frames)
    assert printed(episode, frames).digest == first.digest
    state, action, images = episode.state.copy(), episode.action.copy(), frames.copy()
    state[5, 2] += 1e-6
    action[7, 1] += 1e-6
    images[3, :8, :8] ^= 8
    changed = [
        printed(replace(episode, state=state), frames),
        printed(replace(episode, action=action), frames),
        printed(episode, images),
        printed(episode, frames[:-1]),
    ]
    assert len({first.digest, *(other.digest for other in changed)}) == 5


def test_json_and_back_is_the_same() -> None:
    stored = fingerprint(moving(0)[0], {"head": view_thumbnails(moving(0)[1], 10.0)})
    again = Fingerprint.from_json(json.loads(json.dumps(stored)))
    assert again.as_json() == stored
    assert len(json.dumps(stored)) < 1500


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
    video = replace(
        episode, state=np.zeros((60, 0), np.float32), action=np.zeros((60, 0), np.float32), state_kind="none"
    )
    assert motion_hashes(video) is None


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
    thumbnails = view_thumbnails(frames, 10.0)
    with pytest.raises(DataError, match="no images"):
        fingerprint(episode, {"head": thumbnails.cut(0, 0)})
