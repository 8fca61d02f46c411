"""Selectors compare candidate videos. They see letters and pictures, never identities or outcomes.

`MeasuredSelector` (default) ranks by the measured judge's facts with soft thresholds; `VLMSelector` asks a
vision-language model by the prompts P1 and P2 (`evaluation/prompts.toml`).
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Protocol

import numpy as np
from pydantic import StrictBool, StrictInt

from worldline_core.evaluation.policy.evidence import route
from worldline_core.evaluation.policy.measured_judge import UNSEEN_SCORE, measure, score
from worldline_core.evaluation.recordings import Trajectory
from worldline_core.evaluation.segmenters.segmenter import Segmenter
from worldline_core.evaluation.vlm import PROMPTS, Answer, AnswerText, Part, Text, Video, VisionLanguageModel, ask

_WHOLE, _LATE = 10, 6
_LATE_FROM = 0.6


@dataclass(frozen=True)
class CandidateVideo:
    """What is shown of one candidate.

    Attributes:
        frames: the chosen frames by view, uint8 (n, h, w, 3); indices: their numbers in the video.
        points: (n, arms, 2) projected tool centres at these frames in the head view [px], to start a segmenter.
    """

    frames: Mapping[str, np.ndarray]
    indices: tuple[int, ...]
    fps: float
    total_frames: int
    points: np.ndarray | None = None

    @cached_property
    def digest(self) -> str:
        """Names what is seen, and nothing else."""
        digest = hashlib.sha256()
        for view, frames in sorted(self.frames.items()):
            digest.update(view.encode())
            digest.update(frames.tobytes())
        return digest.hexdigest()


@dataclass(frozen=True)
class CandidateScore:
    """P2's answer, 0..100."""

    score: float
    well_formed: bool = True


@dataclass(frozen=True)
class Comparison:
    """P1's answer: letters, as many as were asked for."""

    labels: tuple[str, ...]
    well_formed: bool = True


class Selector(Protocol):
    """Ranks candidates of one scene."""

    @property
    def name(self) -> str: ...

    def compare(self, instruction: str, candidates: Mapping[str, CandidateVideo], select_count: int) -> Comparison:
        """P1: letters of the ``select_count`` candidates most likely to complete the task, of candidates by letter."""
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


def shown_video(video: Trajectory) -> CandidateVideo:
    """What a selector is shown of a whole video."""
    indices = planning_indices(video.num_frames)
    frames = {view: shown[list(indices)] for view, shown in video.frames.items()}
    points = None if video.points is None else video.points[list(indices)]
    return CandidateVideo(frames, indices, video.fps, video.num_frames, points)


class MeasuredSelector:
    """Scores each video by itself; a comparison takes the best scores."""

    name = "measured"

    def __init__(self, segmenter: Segmenter) -> None:
        self.segmenter = segmenter
        # Smaller budgets show the same videos again; the key is what was shown, so identities stay hidden.
        self._seen: dict[tuple[str, str], CandidateScore] = {}

    def compare(self, instruction: str, candidates: Mapping[str, CandidateVideo], select_count: int) -> Comparison:
        """The highest scores; of equals, those shown first."""
        ranked = sorted(candidates, key=lambda letter: -self.score(instruction, candidates[letter]).score)
        return Comparison(tuple(ranked[:select_count]))

    def score(self, instruction: str, candidate: CandidateVideo) -> CandidateScore:
        """0..100."""
        key = (instruction, candidate.digest)
        if key not in self._seen:
            measured = measure(self.segmenter, instruction, route(instruction), candidate.frames, candidate.points)
            value = UNSEEN_SCORE if measured is None else score(measured)
            self._seen[key] = CandidateScore(round(100.0 * value, 3))
        return self._seen[key]


class _ComparisonAnswer(Answer):
    REQUIRED: ClassVar[tuple[str, ...]] = ("selected_labels",)
    selected_labels: tuple[str, ...] = ()
    reason: AnswerText = ""


class _ScoreAnswer(Answer):
    """Only the score ranks; the rest is asked for as printed, and an answer with another form is malformed."""

    REQUIRED: ClassVar[tuple[str, ...]] = ("score",)
    task_completed: StrictBool | None = None
    score: StrictInt = 0
    final_state: AnswerText = ""
    failure_reason: AnswerText = ""


class VLMSelector:
    """P1 and P2 to one model."""

    def __init__(self, model: VisionLanguageModel) -> None:
        self.model = model
        self.name = model.name

    def compare(self, instruction: str, candidates: Mapping[str, CandidateVideo], select_count: int) -> Comparison:
        """P1. A malformed answer names nobody."""
        parts: list[Part] = [Text(f"Task instruction: {instruction}")]
        for letter, candidate in candidates.items():
            parts += [Text(f"Candidate {letter}:"), _video(candidate)]
        parts.append(Text(PROMPTS["compare"].format(select_count=select_count)))
        answer, well_formed = ask(self.model, parts, _ComparisonAnswer)
        return Comparison(tuple(label.strip().upper() for label in answer.selected_labels), well_formed)

    def score(self, instruction: str, candidate: CandidateVideo) -> CandidateScore:
        """P2. A malformed answer, or a score outside of 0..100, scores 0."""
        question = Text(f"Task instruction: {instruction}\nCandidate video:")
        parts = [question, _video(candidate), Text(PROMPTS["score"].format())]
        answer, well_formed = ask(self.model, parts, _ScoreAnswer)
        if not 0 <= answer.score <= 100:
            return CandidateScore(0.0, well_formed=False)
        return CandidateScore(float(answer.score), well_formed)


def _video(candidate: CandidateVideo) -> Video:
    """One video; several views stand side by side."""
    side_by_side = np.concatenate(list(candidate.frames.values()), axis=2)
    return Video(side_by_side, candidate.indices, candidate.fps, candidate.total_frames)
