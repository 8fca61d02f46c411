"""Splits by scene: a scene belongs to one split, drawn from its name, so that new scenes never move old ones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from fnmatch import fnmatchcase
from hashlib import sha256
from typing import Annotated, Any, Literal

from pydantic import Discriminator, Field, Tag, model_validator

from worldline_core.config.base import StrictModel
from worldline_core.data.curation.checks import EVALUATION_LAYOUTS
from worldline_core.data.episodes.episode import Episode, Split


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
