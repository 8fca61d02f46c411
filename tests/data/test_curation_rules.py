"""The rules over a whole set through `curate` itself: splits are drawn by scene, scenes under two names are found.

Fingerprints survive what copies go through; the search finds what comparing every pair would find, and keeps the first. Task
texts that mean the same become the same, and nothing is lost.
"""

from __future__ import annotations

import json
import time
from collections import Counter
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.data.conftest import make_sample
from tests.data.curating import record
from tools.labelled_clips import view_thumbnails
from worldline_core.config import validate
from worldline_core.data.curation.curate import curate
from worldline_core.data.curation.curate_config import CurateConfig, DrawnSplits, LeakageConfig
from worldline_core.data.curation.recorded_episode import described, drawn_split, with_primary_view, with_split
from worldline_core.data.curation.rules import (
    MIN_MOTION_OVERLAP,
    SceneView,
    decided_rows,
    drawn_episodes,
    find_near_duplicates,
    find_scene_leaks,
)
from worldline_core.data.curation.source_table import read_source_table, write_source_weights
from worldline_core.data.episodes.episode import (
    RAW_INSTRUCTION,
    Episode,
    mentions_outcome,
    normalised_text,
    one_annotation,
    with_instruction,
)
from worldline_core.data.episodes.episode_index import EpisodeRow
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.episodes.fingerprint import (
    MINHASHES,
    MOMENTS,
    Fingerprint,
    ViewPrint,
    fingerprint,
    motion_hashes,
)
from worldline_core.errors import ConfigError, DataError

SIZE = (64, 96)


def room(number: int, name: str, *, num_frames: int = 40, scene_seed: int = 0, **changes: Any) -> tuple:
    """An episode of two dots that follow its joints before a textured wall of its scene: (episode, frames)."""
    rng, time = np.random.default_rng(number), np.arange(num_frames) / 8
    state = np.stack([0.9 * np.sin(rng.uniform(0.5, 1.5) * time + rng.uniform(0, 6)) for _ in range(14)], 1)
    state[:, [6, 13]] = np.abs(state[:, [6, 13]])
    wall = np.random.default_rng(1000 + scene_seed).uniform(30, 170, (8, 12, 3)).astype(np.float32)
    pictures: list[np.ndarray] = []
    for row in state:
        picture = cv2.resize(wall, SIZE[::-1], interpolation=cv2.INTER_NEAREST)
        for x, y, colour in ((row[0], row[1], (250, 220, 220)), (row[7], row[8], (220, 220, 250))):
            cv2.circle(picture, (int(48 + 45 * x), int(32 + 30 * y)), 9, colour, -1)
        pictures.append(picture.astype(np.uint8))
    tracks = {"state": state.astype(np.float32), "action": state.astype(np.float32), "cameras": {}}
    values = {"episode_id": name, "scene": f"room {scene_seed}", "instruction": "lift the block", **tracks}
    return make_sample(num_frames=num_frames, views=(), **(values | changes))[0], {"head": np.stack(pictures)}


def config(*sources: Path | dict[str, Any], **changes: Any) -> CurateConfig:
    listed = [each if isinstance(each, dict) else {"kind": "episode_set", "path": str(each)} for each in sources]
    return validate(CurateConfig, {"sources": listed, **changes}, where="test")


def refused(root: Path) -> dict[str, tuple[str, dict[str, Any]]]:
    return {row.episode_id: (row.reason, row.numbers) for row in EpisodeSet.open(root).quarantine()}


@pytest.mark.slow
def test_a_copy_that_was_encoded_resized_and_cut_is_taken_out(tmp_path: Path) -> None:
    samples = [room(number, f"e{number}") for number in range(6)]
    episode, frames = room(2, "z-copy", split="train")
    small = np.stack([cv2.resize(f, (72, 48), interpolation=cv2.INTER_AREA) for f in frames["head"][2:-2]])
    bright = np.clip(small * 1.05 + 4, 0, 255).astype(np.uint8)
    copy = (replace(episode.cut(2, 38), episode_id="z-copy"), {"head": bright})
    raw = record(tmp_path / "raw", samples)
    other = record(tmp_path / "other", [copy, room(9, "z-new")], crf=26)
    counts = curate(config(raw, other), {}, tmp_path / "out")
    assert (counts["found"], counts["kept"], counts["reasons"]) == (8, 7, {"near_duplicate": 1})
    reason, numbers = refused(tmp_path / "out")["z-copy"]
    assert reason == "near_duplicate"
    assert numbers["duplicate_of"] == "e2"
    assert numbers["motion_overlap"] >= 0.5
    assert numbers["frame_distance_bits"] <= 12
    assert curate(config(raw, other, near_duplicates=False), {}, tmp_path / "all")["kept"] == 8


def test_the_first_listed_is_kept_and_a_copy_across_the_split_says_so(tmp_path: Path) -> None:
    episode, frames = room(0, "b", scene="hall", split="test")
    raw = record(tmp_path / "raw", [room(0, "c", scene="kitchen"), room(1, "d")])
    first = record(tmp_path / "first", [(replace(episode, action=episode.action + 0.5), frames)])
    curate(config(first, raw, leakage={"action": "off"}), {}, tmp_path / "out")
    reason, numbers = refused(tmp_path / "out")["c"]
    assert (reason, numbers["duplicate_of"]) == ("near_duplicate", "b")
    assert (numbers["split"], numbers["split_of_original"]) == ("train", "test")


@pytest.mark.parametrize("action", ["report", "quarantine"])
def test_a_scene_that_leaks_under_another_name(tmp_path: Path, action: str) -> None:
    samples = [room(n, f"train-{n}", scene_seed=n % 3, scene=f"room {n % 3}") for n in range(6)]
    # The same wall and the same start as episode train-1, another motion from there on.
    episode, frames = room(70, "test-1", scene_seed=1, scene="lab", split="test")
    start = room(1, "x", scene_seed=1)[1]["head"][:1]
    samples.append((episode, {"head": np.concatenate([start, frames["head"][1:]])}))
    raw, out = record(tmp_path / "raw", samples), tmp_path / "out"
    counts = curate(config(raw, leakage={"action": action}), {}, out)
    (leak,) = json.loads((out / "curation.json").read_text())["scene_leaks"]
    assert (leak["learning_scene"], leak["testing_scene"], leak["learning_episode"]) == ("room 1", "lab", "train-1")
    gone = {name: reason for name, (reason, _) in refused(out).items()}
    assert gone == ({} if action == "report" else {"train-1": "scene_leak", "train-4": "scene_leak"})
    assert counts["kept"] + counts["quarantined"] == counts["found"] == 7


def test_an_interrupted_decision_is_carried_on_by_the_same_rows(tmp_path: Path) -> None:
    parts = described_parts([room(0, "a"), room(0, "b"), room(1, "c")])
    first = decided_rows(config(tmp_path), parts, tmp_path)
    assert [row.episode_id for row in first] == ["b"]
    # After the kill the duplicate is gone already: the decision must not change with it.
    assert decided_rows(config(tmp_path), parts[:1] + parts[2:], tmp_path) == first
    assert json.loads((tmp_path / "curation.json").read_text())["reasons"] == {"duplicate": 1}


def described_parts(samples: list[tuple]) -> list[dict[str, Any]]:
    return [
        {
            "episode_id": episode.episode_id, "source": "made", "scene": episode.scene, "split": episode.split,
            "primary_view": "head",
            "fingerprint": fingerprint(episode, {v: view_thumbnails(f, 8.0) for v, f in frames.items()}),
        }
        for episode, frames in samples
    ]  # fmt: skip


def test_each_source_has_its_size_rate_and_licence(tmp_path: Path) -> None:
    first = record(tmp_path / "first", [room(0, "a"), room(1, "b")])
    second = record(tmp_path / "second", [room(2, "c", scene_seed=2)])
    third = record(tmp_path / "third", [room(3, "d", scene_seed=3)])
    sources = [
        {"kind": "episode_set", "path": str(first), "name": "one", "license": "CC-BY-4.0", "redistribution": "yes"},
        {"kind": "episode_set", "path": str(second), "name": "two", "image_size": [32, 48], "target_fps": 4},
        {"kind": "episode_set", "path": str(third), "name": "three", "stride": 4, "primary_view": "head"},
    ]
    curate(config(*sources, fps=8, image_size=(48, 72)), {}, tmp_path / "out")
    episodes = EpisodeSet.open(tmp_path / "out")
    shapes = {row.source: episodes.frames(i, "head").shape for i, row in enumerate(episodes.rows)}
    assert shapes == {"one": (40, 48, 72, 3), "two": (20, 32, 48, 3), "three": (10, 48, 72, 3)}
    assert {row.source: row.fps for row in episodes.rows} == {"one": 8.0, "two": 4.0, "three": 2.0}
    original = room(3, "d")[0].state[::4]
    assert np.array_equal(episodes.episode(episodes.position("d")).state, original)
    table = {facts.label: facts for facts in read_source_table(tmp_path / "out")}
    assert (table["one"].license, table["one"].redistribution) == ("CC-BY-4.0", "yes")
    assert (table["two"].license, table["two"].redistribution) == ("unknown", "unknown")
    assert [(t.found, t.kept, t.image_size, t.fps, t.stride) for t in table.values()] == [
        (2, 2, (48, 72), 8.0, None),
        (1, 1, (32, 48), 4.0, None),
        (1, 1, (48, 72), None, 4),
    ]


def test_two_rules_for_one_rate_are_refused() -> None:
    with pytest.raises(ConfigError, match="fps and stride both"):
        config(Path("x"), fps=8, stride=2)
    with pytest.raises(ConfigError, match="target_fps and stride both"):
        config({"kind": "episode_set", "path": "x", "target_fps": 8, "stride": 2})


def test_the_primary_view() -> None:
    episode, frames = room(0, "a")
    still = np.repeat(frames["head"][:1], 40, axis=0)
    thumbnails = {name: view_thumbnails(still, 8.0) for name in ("side", "head")}
    thumbnails["wrist"] = view_thumbnails(frames["head"], 8.0)
    side = replace(episode, primary_view="side")
    assert with_primary_view(episode, None, ("side", "wrist"), thumbnails).primary_view == "wrist"  # most motion
    assert with_primary_view(episode, "side", ("side", "wrist"), thumbnails).primary_view == "side"
    assert with_primary_view(side, None, ("side", "wrist"), thumbnails) is side
    assert with_primary_view(side, None, ("wrist", "head"), thumbnails).primary_view == "head"


def test_what_describes_an_episode_does_not_depend_on_its_outcome() -> None:
    episode, frames = room(0, "a", instruction="Lift the Block.")
    curated = config(Path("x"), splits={"by": "scene"})
    thumbnails = {view: view_thumbnails(images, 8.0) for view, images in frames.items()}
    told = [
        described(curated, replace(episode, outcome=outcome), ("head",), thumbnails)
        for outcome in ("success", "failure", "unknown")
    ]
    assert len({(e.instruction, e.split, e.primary_view, str(e.conventions)) for e in told}) == 1


def row(source: str, frames: int, split: str = "train") -> EpisodeRow:
    return EpisodeRow(
        episode_id=f"{source}-{frames}-{split}", dataset="d", episode_index=0, start=0, stop=frames, num_frames=frames,
        video_frames=frames, fps=10.0, source=source, embodiment="e", scene="s", task_family="lift", instruction="",
        outcome="unknown", split=split, views=("head",), bank=None, candidate=None, primary_view="head",
    )  # fmt: skip


def weights(folder: Path, rows: list[EpisodeRow], alpha: float) -> dict[str, float]:
    write_source_weights(folder, rows, alpha)
    table = json.loads((folder / "source_weights.json").read_text())
    return {source: entry["weight"] for source, entry in table.items()}


def test_weights_give_each_source_its_share(tmp_path: Path) -> None:
    rows = [row("large", 900), row("large", 800), row("small", 100), row("small", 999, "test")]
    for alpha, large in ((1.0, 17.0), (0.0, 1.0), (0.5, 17.0**0.5)):
        found = weights(tmp_path, rows, alpha)
        assert 2 * found["large"] / found["small"] == pytest.approx(large)
        assert (2 * found["large"] + found["small"]) / 3 == pytest.approx(1)
        table = json.loads((tmp_path / "source_weights.json").read_text())
        assert sum(entry["share"] for entry in table.values()) == pytest.approx(1)
        assert {source: entry["episodes"] for source, entry in table.items()} == {"large": 2, "small": 1}
    assert weights(tmp_path, [row("small", 9, "test")], 1.0) == {}


def test_one_scene_is_split_by_episode_or_refused(tmp_path: Path) -> None:
    raw = record(tmp_path / "raw", [room(n, f"e{n}", outcome=("success", "failure")[n % 2]) for n in range(12)])
    given: dict[str, Any] = {"image_size": None, "near_duplicates": False}
    with pytest.raises(
        DataError, match=r"(?s)holds nothing out.*got: 12 of 12 episodes in train, of 1 scene\n.*by: episode"
    ):
        curate(config(raw, splits={"by": "scene", "test": 0.2, "seed": 1}, **given), {}, tmp_path / "scene")
    counts = curate(config(raw, splits={"by": "episode", "test": 0.2}, **given), {}, tmp_path / "out")
    assert counts["splits"] == {"test": 2, "train": 9, "validation": 1}
    rows = EpisodeSet.open(tmp_path / "out").rows
    assert {row.outcome for row in rows if row.split == "test"} == {"success", "failure"}
    assert EpisodeSet.open(tmp_path / "out").episode(0).split == rows[0].split


def test_shares_are_met_and_new_scenes_move_no_old_one() -> None:
    splits = DrawnSplits(by="scene", test=0.2, validation=0.1, seed=3)
    scenes = [f"kitchen {i}" for i in range(5000)]
    drawn = {scene: drawn_split(scene, splits) for scene in scenes}
    shares = {name: sum(split == name for split in drawn.values()) / 5000 for name in ("test", "validation", "train")}
    assert shares["test"] == pytest.approx(0.2, abs=0.02)
    assert shares["validation"] == pytest.approx(0.1, abs=0.02)
    assert {scene: drawn_split(scene, splits) for scene in reversed(scenes)} == drawn
    other = DrawnSplits(by="scene", test=0.2, validation=0.1, seed=4)
    assert sum(drawn_split(scene, other) != drawn[scene] for scene in scenes) > 1000


def test_patterns_come_first_and_declared_splits_stay() -> None:
    episode = make_sample(0)[0]
    splits = DrawnSplits(by="scene", test=0, validation=0, patterns={"lab*": "test"})
    assert with_split(replace(episode, scene="laboratory", split="train"), splits).split == "test"
    assert with_split(replace(episode, split="test"), splits).split == "train"
    for kept in ("bank", "ood_test"):
        assert with_split(replace(episode, split=kept), splits).split == kept
    evaluation = replace(episode, split="test", conventions={"layout": "robotwin"})
    assert with_split(evaluation, splits).split == "test"
    assert with_split(replace(episode, scene="kit"), {"k*": "test", "*": "train"}).split == "test"


@pytest.mark.parametrize(
    ("splits", "message"),
    [
        ({"by": "scene", "validaton": 0.2}, r"splits\.drawn\.validaton: unknown key"),
        ({"by": "scene", "test": 0.6, "validation": 0.5}, "leave nothing to train on"),
        ({"kitchen*": "tset"}, "'train', 'validation', 'test', 'ood_test' or 'bank'"),
        ({"by": "room"}, "'scene' or 'episode'"),
    ],
)
def test_configurations_are_strict(splits: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        validate(CurateConfig, {"sources": [{"kind": "episode_set", "path": "x"}], "splits": splits}, where="test")


def test_one_scene_under_two_names_is_found() -> None:
    rng = np.random.default_rng(0)
    rooms = rng.integers(0, 2**63, (40, 4), dtype=np.uint64)
    views = [SceneView(f"train-{i}-{k}", f"room {i}", "train", rooms[i]) for i in range(40) for k in range(3)]
    # Up to 52 flipped bits are one scene.
    views += [SceneView(f"test-{i}", f"lab {i}", "test", flipped(rooms[i], 8, rng)) for i in range(10)]
    views.append(SceneView("same name", "lab 3", "validation", rooms[39]))
    leaks = find_scene_leaks(views, LeakageConfig())
    assert [(leak.learning_scene, leak.testing_scene, leak.distance) for leak in leaks] == [
        (f"room {i}", f"lab {i}", 32) for i in range(10)
    ]
    assert find_scene_leaks(views, LeakageConfig(max_distance=31)) == []
    assert find_scene_leaks(views, LeakageConfig(action="off")) == []
    # Scenes of one side and of one name are no leak.
    same = [SceneView(scene, scene, split, rooms[0]) for scene, split in (("room", "train"), ("lab", "validation"))]
    assert find_scene_leaks([*same, SceneView("hall", "hall", "bank", rooms[0])], LeakageConfig()) == []
    leaks = find_scene_leaks([*same, SceneView("d", "room", "test", rooms[0])], LeakageConfig())
    assert leaks[0].learning_scene == "lab"


def waiting(count: int, **changes: str) -> list[dict[str, object]]:
    return [
        {
            "episode_id": f"e{i:03d}", "scene": "desk", "split": "train", "conventions": {}, "task_family": "lift",
            "instruction": f"task {i % 4}", "outcome": "success" if i % 5 else "failure", **changes,
        }
        for i in range(count)
    ]  # fmt: skip


@pytest.mark.parametrize(("count", "test", "validation"), [(200, 40, 20), (20, 4, 2), (5, 1, 1), (3, 1, 1)])
def test_episodes_of_one_scene_are_drawn_evenly_over_tasks_and_outcomes(count: int, test: int, validation: int) -> None:
    splits, parts = DrawnSplits(by="episode", test=0.2, validation=0.1), waiting(count)
    drawn = drawn_episodes(splits, parts)
    assert Counter(drawn.values()) == {"train": count - test - validation, "test": test, "validation": validation}
    assert drawn_episodes(splits, parts[::-1]) == drawn
    # A killed run draws again, over what it has written already.
    assert drawn_episodes(splits, [part | {"split": drawn[str(part["episode_id"])]} for part in parts]) == drawn
    flip = {"success": "failure", "failure": "success"}
    assert drawn_episodes(splits, [part | {"outcome": flip[str(part["outcome"])]} for part in parts]) == drawn
    if count == 200:
        for key in ("instruction", "outcome"):
            found = Counter(part[key] for part in parts if drawn[str(part["episode_id"])] == "test")
            assert all(abs(found[name] - total * 0.2) <= 2 for name, total in Counter(p[key] for p in parts).items())


def test_what_patterns_and_sources_say_is_not_drawn_by_episode() -> None:
    splits = DrawnSplits(by="episode", patterns={"lab*": "train"})
    assert drawn_episodes(splits, waiting(9, scene="lab 1")) == {}
    assert drawn_episodes(splits, waiting(9, split="bank")) == {}
    with pytest.raises(DataError, match=r"(?s)Too few episodes.*expected: more than 2.*got: 2"):
        drawn_episodes(splits, waiting(2))


def moving(number: int, **changes: Any) -> tuple[Episode, np.ndarray]:
    episode, frames = room(number, f"e{number}", **changes)
    return episode, frames["head"]


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
    nothing = np.zeros((len(episode), 0), np.float32)
    assert motion_hashes(replace(episode, state=nothing, action=nothing, state_kind="none", state_names=None)) is None


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
        fingerprint(episode, {"head": view_thumbnails(frames, 8.0).cut(0, 0)})


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
    assert seconds(3_000) < 30 * max(seconds(300), 0.005)


@pytest.mark.parametrize(
    ("raw", "expected"),
    [
        ("Pick up the  Red\tblock.\n", "pick up the red block"),
        ("“Open the drawer”", "open the drawer"),
        ("[fold the towel]", "fold the towel"),
        ("Ｐｉｃｋ the ｃｕｐ", "pick the cup"),  # noqa: RUF001
        ("cafe\u0301 cup", "caf\u00e9 cup"),
        ("put\u200b it\u00a0down", "put it down"),
        ("Don\u2019t stop!!", "don't stop"),
        ("PICK UP THE CUP", "pick up the cup"),
        ("Plug the USB cable into the PC", "plug the USB cable into the PC"),
        ("把杯子放到桌子上", "把杯子放到桌子上"),
        ("Put the cup (red) on the tray", "put the cup (red) on the tray"),
        ("pour 1.5 l", "pour 1.5 l"),
        ("N/A", ""),
        (" None. ", ""),
        ('"unknown"', ""),
        ("---", ""),
        ("", ""),
    ],
)
def test_one_spelling(raw: str, expected: str) -> None:
    assert normalised_text(raw) == expected
    assert normalised_text(expected) == expected


def test_of_several_annotations_the_majority_counts() -> None:
    assert one_annotation(["n/a", "Lift the cup.", "raise the mug", "lift the cup", ""]) == "Lift the cup."
    assert one_annotation(["Raise it", "lift it"]) == "Raise it"
    assert one_annotation(["n/a", " "]) == one_annotation([]) == ""


def test_the_raw_text_is_kept_where_it_differs() -> None:
    changed = with_instruction(replace(make_sample(0)[0], instruction="Lift the block.", conventions={"layout": "x"}))
    assert changed.instruction == "lift the block"
    assert changed.conventions == {"layout": "x", RAW_INSTRUCTION: "Lift the block."}
    assert with_instruction(changed) is changed


def test_texts_that_tell_the_outcome_are_noticed() -> None:
    telling = "pick the cup (failed)", "successful grasp", "Failure: lift", "it succeeds", "unsuccessful lift"
    assert all(map(mentions_outcome, telling))
    assert not any(map(mentions_outcome, ("lift the successor", "failsafe switch on", "pick the cup")))
