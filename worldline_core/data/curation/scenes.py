"""Splits by scene, and scenes that leak across the split.

A scene belongs to one split, drawn from its name, so that new scenes never move old ones. A scene that is both learnt
from and tested on under two names is found by the first image of the primary view.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from hashlib import sha256
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Discriminator, Field, Tag, model_validator

from worldline_core.config import StrictModel
from worldline_core.data.episodes.episode import Episode, Split
from worldline_core.data.episodes.source import EVALUATION_LAYOUTS

LEARNING = ("train", "validation")
TESTING = ("test", "ood_test")
_KEPT_SPLITS = ("ood_test", "bank")
"""Splits that stay where a source declares them."""


class SceneSplits(StrictModel):
    """Scenes are drawn into test, validation and train by a hash of (seed, scene).

    Recordings for evaluation only keep the split that their source declares.
    """

    by: Literal["scene"]
    test: float = Field(default=0.1, ge=0, lt=1, description="share of the scenes that test")
    validation: float = Field(default=0.05, ge=0, lt=1, description="share of the scenes that validate")
    seed: int = 0
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


class LeakageConfig(StrictModel):
    """What to do when a scene that is learnt from looks like a scene that is tested on."""

    action: Literal["report", "quarantine", "refuse", "off"] = Field(
        default="report",
        description="report: write it down; quarantine: take the learning scene out (scene_leak); refuse: stop",
    )
    max_distance: int = Field(
        default=52, ge=0, le=256, description="most differing bits of 256 between first images of one scene"
    )


def with_split(episode: Episode, splits: Mapping[str, Split] | SceneSplits) -> Episode:
    """The episode in the split that the configuration gives its scene; without a rule its source's."""
    patterns = splits.patterns if isinstance(splits, SceneSplits) else splits
    named = next((split for pattern, split in patterns.items() if fnmatchcase(episode.scene, pattern)), None)
    if named is not None:
        return replace(episode, split=named)
    if not isinstance(splits, SceneSplits):
        return episode
    if episode.split in _KEPT_SPLITS or episode.conventions.get("layout") in EVALUATION_LAYOUTS:
        return episode
    return replace(episode, split=drawn_split(episode.scene, splits))


def drawn_split(scene: str, splits: SceneSplits) -> Split:
    """The split of a scene: a uniform number in [0, 1) from SHA-256 of "seed:scene", against the shares."""
    number = int.from_bytes(sha256(f"{splits.seed}:{scene}".encode()).digest()[:8]) / 2**64
    if number < splits.test:
        return "test"
    return "validation" if number < splits.test + splits.validation else "train"


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


def find_scene_leaks(seen: Sequence[SceneView], config: LeakageConfig) -> list[SceneLeak]:
    """Pairs of differently named scenes across the split whose first images differ in at most `max_distance` bits.

    Every tested episode is compared with every learnt one: 200,000 with 10,000 take some 20 seconds.
    """
    learning = [view for view in seen if view.split in LEARNING]
    if config.action == "off" or not learning:
        return []
    learnt = np.stack([view.first for view in learning], axis=1)
    best: dict[tuple[str, str], SceneLeak] = {}
    for tested in (view for view in seen if view.split in TESTING):
        distances = np.bitwise_count(learnt ^ tested.first[:, None]).sum(axis=0, dtype=np.uint16)
        for index in np.flatnonzero(distances <= config.max_distance).tolist():
            other = learning[index]
            if other.scene == tested.scene:
                continue
            leak = SceneLeak(other.scene, tested.scene, other.episode_id, tested.episode_id, int(distances[index]))
            known = best.setdefault((other.scene, tested.scene), leak)
            best[other.scene, tested.scene] = min(known, leak, key=_by_distance)
    return sorted(best.values(), key=lambda leak: (leak.testing_scene, leak.learning_scene))


def _by_distance(leak: SceneLeak) -> tuple[int, str, str]:
    return leak.distance, leak.learning_episode, leak.testing_episode
