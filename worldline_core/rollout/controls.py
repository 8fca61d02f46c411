"""Whose controls drive a prediction: the episode's own, none, or those of another episode."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

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
