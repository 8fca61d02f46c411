"""Hierarchical selection among candidates (appendix "Hierarchical candidate selection").

Groups of four, two survive, until four are left: 32, 16, 8, 4 (24, 12, 6, 4). The finalists are scored 0..100 one by
one; the highest score wins, ties are compared once more. Candidates are shown under letters, in an order that a scene's
name and the seed decide.
"""

from __future__ import annotations

import hashlib
import string
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from worldline_core.errors import DataError
from worldline_core.evaluation.planning.selectors import CandidateVideo, Selector

GROUP_SIZE = 4
SURVIVORS = 2


@dataclass(frozen=True)
class Choice:
    """The chosen candidate number, and how it came about."""

    candidate: int
    scores: dict[int, float]
    rounds: list[list[int]]
    malformed_answers: int
    answers: int


def choose(
    selector: Selector,
    instruction: str,
    candidates: Sequence[int],
    load: Callable[[int], CandidateVideo],
    *,
    scene: str,
    seed: int,
) -> Choice:
    """Choose one of ``candidates`` (numbers in the bank).

    Args:
        load: gives a candidate's video.
        scene: names the scene and the run; with ``seed`` it decides the order of showing.

    Raises: DataError for no candidates or a number that occurs twice.
    """
    if not candidates or len(set(candidates)) != len(candidates):
        raise DataError("Candidates must be distinct and at least one", where=scene, got=list(candidates))
    well_formed: list[bool] = []

    def best_of(group: Sequence[int], count: int) -> list[int]:
        """``count`` of the group, in the order shown; a group no larger than that passes whole."""
        if len(group) <= count:
            return list(group)
        shown = dict(zip(string.ascii_uppercase, group, strict=False))
        answer = selector.compare(instruction, {letter: load(number) for letter, number in shown.items()}, count)
        labels = list(dict.fromkeys(label for label in answer.labels if label in shown))[:count]
        well_formed.append(answer.well_formed and len(labels) == count)
        # An answer that names too few is filled up in the order shown, which the shuffle made arbitrary; it is counted.
        labels += [letter for letter in shown if letter not in labels][: count - len(labels)]
        return [number for letter, number in shown.items() if letter in labels]

    survivors = shown_order(candidates, scene, seed)
    rounds = [survivors]
    while len(survivors) > GROUP_SIZE:
        groups = [survivors[start : start + GROUP_SIZE] for start in range(0, len(survivors), GROUP_SIZE)]
        survivors = [winner for group in groups for winner in best_of(group, SURVIVORS)]
        rounds.append(survivors)
    scores: dict[int, float] = {}
    for candidate in survivors:
        answer = selector.score(instruction, load(candidate))
        well_formed.append(answer.well_formed)
        scores[candidate] = answer.score
    best = max(scores.values())
    (winner,) = best_of([candidate for candidate in survivors if scores[candidate] == best], 1)
    return Choice(winner, scores, rounds, well_formed.count(False), len(well_formed))


def shown_order(candidates: Sequence[int], scene: str, seed: int) -> list[int]:
    """The candidates in an order that depends on nothing but the scene's name, the seed and their numbers."""
    digest = hashlib.sha256(f"{scene}\0{seed}".encode()).digest()
    generator = np.random.default_rng(np.frombuffer(digest, dtype=np.uint32))
    return [sorted(candidates)[index] for index in generator.permutation(len(candidates))]
