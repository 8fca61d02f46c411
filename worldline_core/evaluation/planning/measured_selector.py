"""The embedded default selector: ranks candidates by the measured judge's facts, softened."""

from __future__ import annotations

from collections.abc import Sequence

from worldline_core.evaluation.planning.selector import CandidateScore, CandidateVideo, Comparison
from worldline_core.evaluation.policy.measured.facts import UNSEEN_SCORE, score
from worldline_core.evaluation.policy.measured.tracker import facts, measure
from worldline_core.evaluation.policy.routing import route
from worldline_core.evaluation.policy.rules import establishes_success
from worldline_core.evaluation.segmenters.base import Segmenter


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
