"""Splits by scene, and scenes that leak across the split.

A scene belongs to one split, drawn from its name, so that new scenes never move old ones. A scene that is both learnt
from and tested on under two names is found by the first image of the primary view.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from fnmatch import fnmatchcase
from hashlib import sha256
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Discriminator, Field, Tag, model_validator

from worldline_core.config import StrictModel
from worldline_core.data.episodes.episode import Episode, Split
from worldline_core.data.episodes.source import EVALUATION_LAYOUTS


class SceneSplits(StrictModel):
    """Scenes are drawn into test, validation and train by a hash of (seed, scene).

    Recordings for evaluation only keep the split that their source declares.
    """

    by: Literal["scene"]
    test: float = Field(default=0.1, ge=0, lt=1, description="share of the scenes that test")
    validation: float = Field(default=0.05, ge=0, lt=1, description="share of the scenes that validate")
    seed: int = 0
    sources: tuple[str, ...] | None = Field(
        default=None, description="names of the sources that state no split of their own; null: all"
    )
    keep: tuple[Split, ...] = Field(
        default=("ood_test", "bank"), description="splits that stay where a source declares them"
    )
    patterns: dict[str, Split] = Field(default={}, description="scene name pattern -> split, before the draw")

    @model_validator(mode="after")
    def _leaves_training(self) -> SceneSplits:
        if self.test + self.validation >= 1:
            raise ValueError(f"test + validation leave nothing to train on: {self.test} + {self.validation}")
        return self


def _kind(value: Any) -> str:
    return "scene" if isinstance(value, SceneSplits) or (isinstance(value, Mapping) and "by" in value) else "patterns"


Splits = Annotated[
    Annotated[dict[str, Split], Tag("patterns")] | Annotated[SceneSplits, Tag("scene")], Discriminator(_kind)
]
"""Scene name pattern -> split, or {by: scene, ...}. A pattern table cannot hold a scene that is named "by"."""


def with_split(episode: Episode, splits: Mapping[str, Split] | SceneSplits) -> Episode:
    """The episode in the split that the configuration gives its scene; without a rule its source's."""
    patterns = splits.patterns if isinstance(splits, SceneSplits) else splits
    named = next((split for pattern, split in patterns.items() if fnmatchcase(episode.scene, pattern)), None)
    if named is not None:
        return replace(episode, split=named)
    if not isinstance(splits, SceneSplits):
        return episode
    declared = episode.split in splits.keep or episode.conventions.get("layout") in EVALUATION_LAYOUTS
    if declared or (splits.sources is not None and episode.source not in splits.sources):
        return episode
    return replace(episode, split=drawn_split(episode.scene, splits))


def drawn_split(scene: str, splits: SceneSplits) -> Split:
    """The split of a scene: a uniform number in [0, 1) from SHA-256 of "seed:scene", against the shares."""
    number = int.from_bytes(sha256(f"{splits.seed}:{scene}".encode()).digest()[:8]) / 2**64
    if number < splits.test:
        return "test"
    return "validation" if number < splits.test + splits.validation else "train"


LEARNING = ("train", "validation")
TESTING = ("test", "ood_test")
_BANDS = 32


class LeakageConfig(StrictModel):
    """What to do when a scene that is learnt from looks like a scene that is tested on."""

    action: Literal["report", "quarantine", "refuse", "off"] = Field(
        default="report",
        description="report: write it down; quarantine: take the learning scene out (scene_leak); refuse: stop",
    )
    max_distance: int = Field(
        default=52, ge=0, le=256, description="most differing bits of 256 between first images of one scene"
    )


@dataclass(frozen=True)
class SceneView:
    """What the search sees of an episode. `first` is (4,) uint64, 256 bits of the primary view's first image."""

    episode_id: str
    scene: str
    split: str
    first: np.ndarray


@dataclass(frozen=True)
class SceneLeak:
    """A pair of scenes that look like one; the episodes are those that look most alike."""

    learning_scene: str
    testing_scene: str
    learning_episode: str
    testing_episode: str
    distance: int

    def as_json(self) -> dict[str, Any]:
        return asdict(self)


def find_scene_leaks(seen: Sequence[SceneView], config: LeakageConfig) -> list[SceneLeak]:
    """Pairs of differently named scenes across the split whose first images differ in at most `max_distance` bits.

    Candidates share one of 32 bands of 8 bits: every pair within 31 bits is found for certain, one of 52 bits with
    a probability of 0.997 (where flips are spread evenly).
    """
    learning = [view for view in seen if view.split in LEARNING]
    testing = [view for view in seen if view.split in TESTING]
    if config.action == "off" or not learning or not testing:
        return []
    learnt, tested = (np.stack([view.first for view in side]) for side in (learning, testing))
    best: dict[tuple[str, str], SceneLeak] = {}
    for band in range(_BANDS):
        buckets: dict[int, list[int]] = {}
        for place, key in enumerate(_band(tested, band).tolist()):
            buckets.setdefault(key, []).append(place)
        keys = _band(learnt, band)
        for key in np.intersect1d(keys, np.fromiter(buckets, keys.dtype)).tolist():
            places = np.flatnonzero(keys == key)
            for other in buckets[key]:
                distances = np.bitwise_count(learnt[places] ^ tested[other]).sum(axis=1)
                for index in np.flatnonzero(distances <= config.max_distance):
                    _note(best, learning[int(places[index])], testing[other], int(distances[index]))
    return sorted(best.values(), key=lambda leak: (leak.testing_scene, leak.learning_scene))


def _band(words: np.ndarray, band: int) -> np.ndarray:
    return (words[:, band // 8] >> np.uint64(8 * (band % 8))) & np.uint64(0xFF)


def _note(best: dict[tuple[str, str], SceneLeak], learning: SceneView, testing: SceneView, distance: int) -> None:
    if learning.scene == testing.scene:
        return
    leak = SceneLeak(learning.scene, testing.scene, learning.episode_id, testing.episode_id, distance)
    known = best.get((learning.scene, testing.scene))
    order = (leak.distance, leak.learning_episode, leak.testing_episode)
    if known is None or order < (known.distance, known.learning_episode, known.testing_episode):
        best[learning.scene, testing.scene] = leak
