"""A selector that asks a vision-language model, with the paper's prompts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from pydantic import StrictBool, StrictInt

from worldline_core.evaluation.planning.prompts import compare_prompt, score_prompt
from worldline_core.evaluation.planning.selector import CandidateScore, CandidateVideo, Comparison
from worldline_core.evaluation.vlm.answers import Answer, AnswerText, parse_answer
from worldline_core.evaluation.vlm.content import Part, Text, Video, VisionLanguageModel


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
