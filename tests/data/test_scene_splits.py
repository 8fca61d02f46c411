"""Splits are drawn by scene, once and for all; scenes under two names are found."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from worldline_core.config import validate
from worldline_core.data.curation.curate_config import CurateConfig, DrawnSplits, LeakageConfig
from worldline_core.data.curation.recorded_episode import drawn_split, with_split
from worldline_core.data.curation.rules import SceneView, drawn_episodes, find_scene_leaks
from worldline_core.errors import ConfigError, DataError

Make = Callable[..., tuple]
SOURCE = {"kind": "episode_set", "path": "recordings"}


def config(**values: object) -> CurateConfig:
    return validate(CurateConfig, {"sources": [SOURCE], **values}, where="test")


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


def test_patterns_come_first_and_declared_splits_stay(sample: Make) -> None:
    episode = sample(0)[0]
    splits = DrawnSplits(by="scene", test=0, validation=0, patterns={"lab*": "test"})
    assert with_split(replace(episode, scene="laboratory", split="train"), splits).split == "test"
    assert with_split(replace(episode, split="test"), splits).split == "train"
    for kept in ("bank", "ood_test"):
        assert with_split(replace(episode, split=kept), splits).split == kept
    evaluation = replace(episode, split="test", conventions={"layout": "robotwin"})
    assert with_split(evaluation, splits).split == "test"
    assert with_split(replace(episode, scene="kit"), {"k*": "test", "*": "train"}).split == "test"


def test_configurations_are_strict() -> None:
    assert config(splits={"kitchen*": "test"}).splits == {"kitchen*": "test"}
    assert isinstance(config(splits={"by": "scene", "test": 0.2}).splits, DrawnSplits)
    with pytest.raises(ConfigError, match=r"splits\.drawn\.validaton: unknown key"):
        config(splits={"by": "scene", "validaton": 0.2})
    with pytest.raises(ConfigError, match="leave nothing to train on"):
        config(splits={"by": "scene", "test": 0.6, "validation": 0.5})
    with pytest.raises(ConfigError, match="'train', 'validation', 'test', 'ood_test' or 'bank'"):
        config(splits={"kitchen*": "tset"})
    with pytest.raises(ConfigError, match="Input should be 'scene' or 'episode'"):
        config(splits={"by": "room"})
    with pytest.raises(ValidationError, match="frozen"):
        DrawnSplits(by="scene").test = 0.5  # type: ignore[misc]


def seen(name: str, split: str, scene: str, first: np.ndarray) -> SceneView:
    return SceneView(name, scene, split, first)


def flipped(words: np.ndarray, bits: int, rng: np.random.Generator) -> np.ndarray:
    result = words.copy()
    for bit in rng.choice(256, bits, replace=False):
        result[bit // 64] ^= np.uint64(1) << np.uint64(bit % 64)
    return result


def test_one_scene_under_two_names_is_found() -> None:
    rng = np.random.default_rng(0)
    rooms = rng.integers(0, 2**63, (40, 4), dtype=np.uint64)
    views = [seen(f"train-{i}-{k}", "train", f"room {i}", rooms[i]) for i in range(40) for k in range(3)]
    # Up to 52 flipped bits are one scene.
    views += [seen(f"test-{i}", "test", f"lab {i}", flipped(rooms[i], 31, rng)) for i in range(10)]
    views.append(seen("same name", "validation", "lab 3", rooms[39]))
    leaks = find_scene_leaks(views, LeakageConfig())
    assert [(leak.learning_scene, leak.testing_scene, leak.distance) for leak in leaks] == [
        (f"room {i}", f"lab {i}", 31) for i in range(10)
    ]
    assert find_scene_leaks(views, LeakageConfig(max_distance=30)) == []
    assert find_scene_leaks(views, LeakageConfig(action="off")) == []


def test_scenes_of_one_side_and_of_one_name_are_no_leak() -> None:
    first = np.arange(4, dtype=np.uint64)
    same = [seen("a", "train", "room", first), seen("b", "validation", "lab", first), seen("c", "bank", "hall", first)]
    assert find_scene_leaks(same, LeakageConfig()) == []
    assert find_scene_leaks([*same, seen("d", "test", "room", first)], LeakageConfig())[0].learning_scene == "lab"


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
