"""Selectors compare candidate videos. They see letters and pictures, never identities or outcomes.

`MeasuredSelector` (default) ranks by the measured judge's facts with soft thresholds; `VLMSelector` asks a
vision-language model by the prompts P1 and P2 of the paper's appendix "Embodied Planning", kept as printed.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Protocol

import numpy as np
from pydantic import StrictBool, StrictInt

from worldline_core.evaluation.policy.evidence import establishes_success, route
from worldline_core.evaluation.policy.measured_judge import UNSEEN_SCORE, facts, measure, score
from worldline_core.evaluation.segmenters.segmenter import Segmenter
from worldline_core.evaluation.vlm.message import (
    Answer,
    AnswerText,
    Part,
    Text,
    Video,
    VisionLanguageModel,
    parse_answer,
)

NUM_FRAMES = 16
_WHOLE, _LATE = 10, 6
_LATE_FROM = 0.6


@dataclass(frozen=True)
class ShownFrames:
    """The chosen frames by view, uint8 (n, h, w, 3). They are shown many times, under one letter or another."""

    by_view: Mapping[str, np.ndarray]

    @cached_property
    def digest(self) -> str:
        """Names what is seen, and nothing else."""
        digest = hashlib.sha256()
        for view in sorted(self.by_view):
            digest.update(view.encode())
            digest.update(self.by_view[view].tobytes())
        return digest.hexdigest()


@dataclass(frozen=True)
class CandidateVideo:
    """One candidate under a temporary letter.

    Attributes:
        shown: the chosen frames; indices: their numbers in the video.
        points: (n, arms, 2) projected tool centres at these frames in the head view [px], to start a segmenter.
    """

    label: str
    shown: ShownFrames
    indices: tuple[int, ...]
    fps: float
    total_frames: int
    points: np.ndarray | None = None

    @property
    def frames(self) -> Mapping[str, np.ndarray]:
        return self.shown.by_view


@dataclass(frozen=True)
class CandidateScore:
    """P2's answer; only the score ranks."""

    score: float
    task_completed: bool | None = None
    final_state: str = ""
    failure_reason: str = ""
    well_formed: bool = True


@dataclass(frozen=True)
class Comparison:
    """P1's answer: exactly as many labels as were asked for."""

    labels: tuple[str, ...]
    reason: str = ""
    well_formed: bool = True


class Selector(Protocol):
    """Ranks candidates of one scene."""

    @property
    def name(self) -> str: ...

    def compare(self, instruction: str, candidates: Sequence[CandidateVideo], select_count: int) -> Comparison:
        """P1: the ``select_count`` candidates most likely to complete the task."""
        ...

    def score(self, instruction: str, candidate: CandidateVideo) -> CandidateScore:
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


class MeasuredSelector:
    """Scores each video by itself; a comparison takes the best scores."""

    name = "measured"

    def __init__(self, segmenter: Segmenter) -> None:
        self.segmenter = segmenter
        # Smaller budgets show the same videos again; the key is what was shown, so identities stay hidden.
        self._seen: dict[tuple[str, str], CandidateScore] = {}

    def compare(self, instruction: str, candidates: Sequence[CandidateVideo], select_count: int) -> Comparison:
        """The highest scores; of equals, those shown first."""
        ranked = sorted(candidates, key=lambda candidate: -self.score(instruction, candidate).score)
        return Comparison(tuple(candidate.label for candidate in ranked[:select_count]))

    def score(self, instruction: str, candidate: CandidateVideo) -> CandidateScore:
        """0..100."""
        key = (instruction, candidate.shown.digest)
        if key not in self._seen:
            family = route(instruction)
            measured = measure(self.segmenter, instruction, family, candidate.frames, candidate.points)
            evidence = facts(measured, instruction, family)
            value = UNSEEN_SCORE if measured is None else score(measured)
            self._seen[key] = CandidateScore(
                score=round(100.0 * value, 3),
                task_completed=establishes_success(evidence),
                final_state=evidence.observations,
            )
        return self._seen[key]


_COMPARE = """\
Compare these candidates and select the {select_count} most likely to actually complete the task. Prioritize correct \
final object state, then valid grasp/contact and placement. Reject partial progress, drops, and physical \
inconsistencies. Ignore visual quality unless it prevents judging. You must return exactly {select_count} candidate \
label(s), even if every candidate appears to fail; in that case choose the least unsuccessful. Reply only as JSON using \
the displayed letter labels:
{{"selected_labels": ["A"], "reason": "<brief comparative reason>"}}"""

_SCORE = """\
Judge this candidate independently. Determine whether the predicted trajectory ends with the task actually completed. \
Check the initial and final object state, valid grasp/contact, correct placement, drops, and physical inconsistencies. \
Mere contact or partial progress is not completion. Ignore visual quality unless it prevents judging. Give a 0-100 \
task-success score. Reply only as JSON:
{"task_completed": <true or false>, "score": <integer>,
 "final_state": "<brief description>", "failure_reason": "<brief reason or empty>"}"""


def compare_prompt(select_count: int) -> str:
    """P1, the part after the videos."""
    return _COMPARE.format(select_count=select_count)


def score_prompt() -> str:
    """P2, the part after the video."""
    return _SCORE


class _ComparisonAnswer(Answer):
    REQUIRED: ClassVar[tuple[str, ...]] = ("selected_labels",)
    selected_labels: tuple[str, ...] = ()
    reason: AnswerText = ""


class _ScoreAnswer(Answer):
    REQUIRED: ClassVar[tuple[str, ...]] = ("score",)
    task_completed: StrictBool | None = None
    score: StrictInt = 0
    final_state: AnswerText = ""
    failure_reason: AnswerText = ""


class VLMSelector:
    """P1 and P2 to one model."""

    def __init__(self, model: VisionLanguageModel) -> None:
        self.model = model

    @property
    def name(self) -> str:
        return self.model.name

    def compare(self, instruction: str, candidates: Sequence[CandidateVideo], select_count: int) -> Comparison:
        """P1. A malformed answer names nobody."""
        parts: list[Part] = [Text(f"Task instruction: {instruction}")]
        for candidate in candidates:
            parts += [Text(f"Candidate {candidate.label}:"), _video(candidate)]
        parts.append(Text(compare_prompt(select_count)))
        answer, well_formed = parse_answer(_ComparisonAnswer, self.model.answer(parts))
        labels = tuple(label.strip().upper() for label in answer.selected_labels)
        return Comparison(labels, answer.reason, well_formed)

    def score(self, instruction: str, candidate: CandidateVideo) -> CandidateScore:
        """P2. A malformed answer, or a score outside of 0..100, scores 0."""
        parts = [
            Text(f"Task instruction: {instruction}\nCandidate video:"),
            _video(candidate),
            Text(score_prompt()),
        ]
        answer, well_formed = parse_answer(_ScoreAnswer, self.model.answer(parts))
        if not 0 <= answer.score <= 100:
            return CandidateScore(0.0, well_formed=False)
        return CandidateScore(
            float(answer.score), answer.task_completed, answer.final_state, answer.failure_reason, well_formed
        )


def _video(candidate: CandidateVideo) -> Video:
    """One video; several views stand side by side."""
    side_by_side = np.concatenate(list(candidate.frames.values()), axis=2)
    return Video(side_by_side, candidate.indices, candidate.fps, candidate.total_frames)
