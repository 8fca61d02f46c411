"""Hierarchical selection among candidates (appendix "Hierarchical candidate selection").

Groups of four, two survive, until four are left: 32, 16, 8, 4 (24, 12, 6, 4). The finalists are scored 0..100 one by
one; the highest score wins, ties are compared once more. Candidates are shown under letters, in an order that a scene's
name and the seed decide.
"""

from __future__ import annotations

import hashlib
import string
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from worldline_core.errors import DataError
from worldline_core.evaluation.planning.selectors import CandidateVideo, Selector

GROUP_SIZE = 4
SURVIVORS = 2

LoadCandidate = Callable[[int], CandidateVideo]


@dataclass(frozen=True)
class Choice:
    """The chosen candidate number, and how it came about."""

    candidate: int
    scores: dict[int, float]
    rounds: tuple[tuple[int, ...], ...]
    malformed_answers: int
    answers: int


@dataclass
class _Tally:
    answers: int = 0
    malformed: int = 0
    rounds: list[tuple[int, ...]] = field(default_factory=list)

    def count(self, well_formed: bool) -> None:
        self.answers += 1
        self.malformed += not well_formed


def choose(
    selector: Selector,
    instruction: str,
    candidates: Sequence[int],
    load: LoadCandidate,
    *,
    scene: str,
    seed: int,
) -> Choice:
    """Choose one of ``candidates`` (numbers in the bank).

    Args:
        load: gives a candidate's video; its label is replaced by a letter here.
        scene: names the scene and the run; with ``seed`` it decides the order of showing.

    Raises: DataError for no candidates or a number that occurs twice.
    """
    if not candidates or len(set(candidates)) != len(candidates):
        raise DataError("Candidates must be distinct and at least one", where=scene, got=list(candidates))
    tally = _Tally()
    survivors = shown_order(candidates, scene, seed)
    while len(survivors) > GROUP_SIZE:
        tally.rounds.append(tuple(survivors))
        survivors = [
            winner
            for start in range(0, len(survivors), GROUP_SIZE)
            for winner in _best_of(selector, instruction, survivors[start : start + GROUP_SIZE], SURVIVORS, load, tally)
        ]
    tally.rounds.append(tuple(survivors))
    scores: dict[int, float] = {}
    for candidate in survivors:
        answer = selector.score(instruction, replace(load(candidate), label=string.ascii_uppercase[0]))
        tally.count(answer.well_formed)
        scores[candidate] = answer.score
    best = max(scores.values())
    tied = [candidate for candidate in survivors if scores[candidate] == best]
    if len(tied) > 1:
        tied = _best_of(selector, instruction, tied, 1, load, tally)
    return Choice(tied[0], scores, tuple(tally.rounds), tally.malformed, tally.answers)


def shown_order(candidates: Sequence[int], scene: str, seed: int) -> list[int]:
    """The candidates in an order that depends on nothing but the scene's name, the seed and their numbers."""
    digest = hashlib.sha256(f"{scene}\0{seed}".encode()).digest()
    generator = np.random.default_rng(np.frombuffer(digest, dtype=np.uint32))
    return [sorted(candidates)[index] for index in generator.permutation(len(candidates))]


def _best_of(
    selector: Selector, instruction: str, group: Sequence[int], count: int, load: LoadCandidate, tally: _Tally
) -> list[int]:
    """``count`` of the group, in the order shown; a group no larger than that passes whole."""
    if len(group) <= count:
        return list(group)
    letters = string.ascii_uppercase[: len(group)]
    videos = [replace(load(candidate), label=letter) for letter, candidate in zip(letters, group, strict=True)]
    answer = selector.compare(instruction, videos, count)
    labels = list(dict.fromkeys(label for label in answer.labels if label in letters))[:count]
    tally.count(answer.well_formed and len(labels) == count)
    # An answer that names too few is filled up in the order shown, which the shuffle made arbitrary; it is counted.
    labels += [letter for letter in letters if letter not in labels][: count - len(labels)]
    return [candidate for letter, candidate in zip(letters, group, strict=True) if letter in labels]


def describe(choice: Choice) -> dict[str, Any]:
    """A choice as JSON."""
    return {
        "candidate": choice.candidate,
        "scores": {str(candidate): score for candidate, score in sorted(choice.scores.items())},
        "rounds": [list(members) for members in choice.rounds],
        "malformed_answers": choice.malformed_answers,
        "answers": choice.answers,
    }
