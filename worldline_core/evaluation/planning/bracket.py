"""Hierarchical selection among candidate videos (appendix "Hierarchical candidate selection").

Groups of four, two survive, until four are left: 32, 16, 8, 4 (24, 12, 6, 4). The finalists are scored 0..100 one by one; the highest
score wins, ties are compared once more. Candidates are shown under letters, in an order that a scene's name and the seed decide; a
selector sees letters and pictures, never identities or outcomes.
"""

from __future__ import annotations

import hashlib
import string
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import StrictBool, StrictInt

from worldline_core.errors import DataError
from worldline_core.evaluation.policy.judge import route
from worldline_core.evaluation.policy.learned_judge import LearnedJudge
from worldline_core.evaluation.policy.measured_judge import UNSEEN_SCORE, measure
from worldline_core.evaluation.recordings import Trajectory
from worldline_core.evaluation.segmenters.segmenter import Segmenter
from worldline_core.evaluation.vlm import PROMPTS, Answer, AnswerText, Part, Text, Video, VisionLanguageModel, ask

GROUP_SIZE = 4
SURVIVORS = 2
_WHOLE, _LATE = 10, 6
_LATE_FROM = 0.6

Letters = tuple[str, ...]


@dataclass(frozen=True)
class CandidateVideo:
    """Frames of one candidate as a selector sees them.

    Attributes:
        frames: the chosen frames by view, uint8 (n, h, w, 3); indices: their numbers in the video.
        points: (n, arms, 2) projected tool centres at these frames in the head view [px], to start a segmenter.
    """

    frames: Mapping[str, NDArray[np.uint8]]
    indices: tuple[int, ...]
    fps: float
    total_frames: int
    points: NDArray[np.floating] | None = None

    @cached_property
    def digest(self) -> str:
        digest = hashlib.sha256()
        for view, frames in sorted(self.frames.items()):
            digest.update(view.encode())
            digest.update(frames.tobytes())
        return digest.hexdigest()


Candidates = Mapping[str, CandidateVideo]
"""By letter."""


class Selector(Protocol):
    """Ranks candidates of one scene; every answer comes with whether it could be read."""

    @property
    def name(self) -> str: ...

    def compare(self, instruction: str, candidates: Candidates, select_count: int) -> tuple[Letters, bool]:
        """P1: letters of the ``select_count`` candidates most likely to complete the task."""
        ...

    def score(self, instruction: str, candidate: CandidateVideo) -> tuple[float, bool]:
        """P2: 0..100, how likely this candidate completes the task."""
        ...


def planning_indices(num_frames: int) -> tuple[int, ...]:
    """Sixteen frames: ten over the whole video, six more inside its last 40 % (fewer where the video is shorter)."""
    whole = np.linspace(0.0, 1.0, _WHOLE)
    late = _LATE_FROM + (1.0 - _LATE_FROM) * (np.arange(_LATE) + 0.5) / _LATE
    chosen = {round(float(p) * (num_frames - 1)) for p in whole}
    for position in late * (num_frames - 1):
        free = [index for index in range(int(_LATE_FROM * (num_frames - 1)), num_frames) if index not in chosen]
        if free:
            chosen.add(min(free, key=lambda index: (abs(index - position), index)))
    return tuple(sorted(chosen))


def shown_video(video: Trajectory) -> CandidateVideo:
    """The sixteen frames of a whole video that a selector sees."""
    indices = planning_indices(video.num_frames)
    frames, points = video.at(indices)
    return CandidateVideo(frames, indices, video.fps, video.num_frames, points)


class ScoringSelector:
    """Scores each video by its own likelihood to complete the task, 0..1; a comparison takes the best scores."""

    def __init__(self, name: str, likelihood: Callable[[str, CandidateVideo], float]) -> None:
        self.name, self.likelihood = name, likelihood
        # Smaller budgets show the same videos again.
        self._scores: dict[tuple[str, str], float] = {}

    def compare(self, instruction: str, candidates: Candidates, select_count: int) -> tuple[Letters, bool]:
        """The highest scores; of equals, those shown first."""
        ranked = sorted(candidates, key=lambda letter: -self.score(instruction, candidates[letter])[0])
        return tuple(ranked[:select_count]), True

    def score(self, instruction: str, candidate: CandidateVideo) -> tuple[float, bool]:
        key = (instruction, candidate.digest)
        if key not in self._scores:
            self._scores[key] = round(100.0 * self.likelihood(instruction, candidate), 3)
        return self._scores[key], True


def measured_selector(segmenter: Segmenter) -> ScoringSelector:
    """Likelihood by the measured judge's facts with soft thresholds; `UNSEEN_SCORE` where nothing can be measured."""

    def likelihood(instruction: str, candidate: CandidateVideo) -> float:
        measured = measure(segmenter, instruction, route(instruction), candidate.frames, candidate.points)
        return UNSEEN_SCORE if measured is None else measured.score()

    return ScoringSelector("measured", likelihood)


def learned_selector(judge: LearnedJudge) -> ScoringSelector:
    """Likelihood by the learned judge; a task that it does not know raises DataError."""
    return ScoringSelector(
        "learned", lambda text, video: judge.probability(text, video.frames, video.indices, video.total_frames)
    )


class _ComparisonAnswer(Answer):
    REQUIRED: ClassVar[tuple[str, ...]] = ("selected_labels",)
    selected_labels: tuple[str, ...] = ()
    reason: AnswerText = ""


class _ScoreAnswer(Answer):
    """Only the score ranks; the other keys are those that the prompt prints."""

    REQUIRED: ClassVar[tuple[str, ...]] = ("score",)
    task_completed: StrictBool | None = None
    score: StrictInt = 0
    final_state: AnswerText = ""
    failure_reason: AnswerText = ""


class VLMSelector:
    """P1 and P2 (`evaluation/prompts.toml`) to one vision-language model."""

    def __init__(self, model: VisionLanguageModel) -> None:
        self.model = model
        self.name = model.name

    def compare(self, instruction: str, candidates: Candidates, select_count: int) -> tuple[Letters, bool]:
        """P1. A malformed answer has no labels."""
        parts: list[Part] = [Text(f"Task instruction: {instruction}")]
        for letter, candidate in candidates.items():
            parts += [Text(f"Candidate {letter}:"), _side_by_side(candidate)]
        parts.append(Text(PROMPTS["compare"].format(select_count=select_count)))
        answer, well_formed = ask(self.model, parts, _ComparisonAnswer)
        return tuple(label.strip().upper() for label in answer.selected_labels), well_formed

    def score(self, instruction: str, candidate: CandidateVideo) -> tuple[float, bool]:
        """P2. A malformed answer, or a score outside of 0..100, scores 0."""
        question = Text(f"Task instruction: {instruction}\nCandidate video:")
        parts = [question, _side_by_side(candidate), Text(PROMPTS["score"].format())]
        answer, well_formed = ask(self.model, parts, _ScoreAnswer)
        return (float(answer.score), well_formed) if 0 <= answer.score <= 100 else (0.0, False)


def _side_by_side(candidate: CandidateVideo) -> Video:
    frames = np.concatenate(list(candidate.frames.values()), axis=2)
    return Video(frames, candidate.indices, candidate.fps, candidate.total_frames)


@dataclass(frozen=True)
class Choice:
    """The chosen candidate number, scores of the finalists, survivors of every round, and answers that could not be read."""

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
    """Choose one of ``candidates`` (numbers in the bank, each once); ``scene`` (and run) and ``seed`` decide the order of showing.

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
        videos = {letter: load(number) for letter, number in shown.items()}
        letters, readable = selector.compare(instruction, videos, count)
        labels = list(dict.fromkeys(letter for letter in letters if letter in shown))[:count]
        well_formed.append(readable and len(labels) == count)
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
        scores[candidate], readable = selector.score(instruction, load(candidate))
        well_formed.append(readable)
    best = max(scores.values())
    (winner,) = best_of([candidate for candidate in survivors if scores[candidate] == best], 1)
    return Choice(winner, scores, rounds, well_formed.count(False), len(well_formed))


def shown_order(candidates: Sequence[int], scene: str, seed: int) -> list[int]:
    """The candidates in an order that depends on nothing but the scene's name, the seed and their numbers."""
    digest = hashlib.sha256(f"{scene}\0{seed}".encode()).digest()
    generator = np.random.default_rng(np.frombuffer(digest, dtype=np.uint32))
    return [sorted(candidates)[index] for index in generator.permutation(len(candidates))]
