"""Configuration of the rollout step.

Whose controls drive a prediction: the episode's own, none, or those of another episode.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, Self

import numpy as np
from pydantic import Field, model_validator

from worldline_core.config import StrictModel
from worldline_core.errors import DataError

Controls = Literal["true", "zero", "shuffled"]


def shuffled_partners(
    episodes: Sequence[str], embodiment_of: Mapping[str, str], pool: Sequence[str], seed: int
) -> dict[str, str]:
    """For every episode another of the same embodiment, no one its own, as far as possible no two the same.

    Episodes of an embodiment are arranged in a random circle (a function of ``seed`` and the ids only) and each takes
    its successor's controls. An embodiment with a single chosen episode draws its partner from ``pool``.

    Raises:
        DataError: an episode has no other of its embodiment.
    """
    partners: dict[str, str] = {}
    for embodiment in sorted({embodiment_of[episode] for episode in episodes}):
        members = sorted(episode for episode in episodes if embodiment_of[episode] == embodiment)
        generator = np.random.default_rng([seed, *embodiment.encode()])
        if len(members) == 1:
            others = sorted(e for e in pool if embodiment_of.get(e) == embodiment and e not in members)
            if not others:
                raise DataError(
                    "No other episode of this embodiment to take controls from",
                    where=members[0],
                    expected="at least two episodes with tracks",
                    got=embodiment,
                )
            partners[members[0]] = others[int(generator.integers(len(others)))]
            continue
        circle = [members[int(i)] for i in generator.permutation(len(members))]
        partners.update(zip(circle, [*circle[1:], circle[0]], strict=True))
    return partners


class RolloutConfig(StrictModel):
    """Which episodes are predicted, and how."""

    method: str = Field(default="worldline", min_length=1)
    """Name the predictions carry in scores and reports."""
    sampler: Literal["full_clip", "block_causal", "copy_first_frame"] = "block_causal"
    steps: int | None = Field(default=None, ge=1)
    """Euler steps: 35 for a whole clip, 4 a block, unless given."""
    actions: Controls = "true"
    seeds: tuple[int, ...] = Field(default=(42,), min_length=1)
    splits: tuple[str, ...] = ("test",)
    banks: tuple[str, ...] | None = None
    """Only episodes of these candidate banks."""
    embodiments: tuple[str, ...] | None = None
    max_episodes_per_embodiment: int | None = Field(default=None, ge=1)
    num_frames: int = Field(default=33, ge=5)
    """Longest prediction; shorter episodes are predicted as far as whole blocks (or groups) go."""
    batch_size: int = Field(default=8, ge=1)
    sink_blocks: int = Field(default=1, ge=1)
    recent_blocks: int | None = Field(default=None, ge=0)
    """Recent blocks in the cache; by default 3, or fewer where the model was trained on shorter clips."""
    crf: int = Field(default=8, ge=0, le=51)
    bfloat16: bool = True
    device: str = "cpu"
    timed_blocks: int = Field(default=0, ge=0)
    """Blocks of one long block-causal rollout made to measure what each costs; it changes no prediction."""

    @model_validator(mode="after")
    def _distinct_seeds(self) -> Self:
        if len(set(self.seeds)) != len(self.seeds):
            raise ValueError(f"seeds repeat: {self.seeds}")
        return self

    @model_validator(mode="after")
    def _blocks_to_time(self) -> Self:
        if self.timed_blocks and self.sampler != "block_causal":
            raise ValueError(f"timed_blocks needs the sampler block_causal, not {self.sampler}")
        return self


@dataclass(frozen=True)
class Job:
    """One prediction: an episode, whose controls drive it, a seed, and how many frames it gets."""

    position: int
    episode_id: str
    controls_of: str
    seed: int
    frames: int
