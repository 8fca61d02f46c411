"""The embedded default judge: the same evidence schemas, filled by measuring instead of by a language model.

It follows things that the instruction names by colour. What it cannot see is null, like for any other judge.
"""

from __future__ import annotations

from worldline_core.evaluation.policy.evidence import Evidence, EvidenceFamily, MotionEvidence, Reconciliation
from worldline_core.evaluation.policy.judge import Extracted, Trajectory
from worldline_core.evaluation.policy.measured.tracker import facts, measure
from worldline_core.evaluation.policy.routing import route
from worldline_core.evaluation.policy.rules import establishes_success
from worldline_core.evaluation.segmenters.base import Segmenter


class MeasuredEvidenceJudge:
    """Colour tracking in the head view, agreement of the wrist views, robot mask by a segmenter."""

    name = "measured"

    def __init__(self, segmenter: Segmenter) -> None:
        self.segmenter = segmenter

    def extract(
        self, trajectory: Trajectory, family: EvidenceFamily, indices: tuple[int, ...], height_px: int
    ) -> Extracted[Evidence]:
        """Facts at the given frames, measured at the recording's own resolution (``height_px`` adds nothing here)."""
        return Extracted(self._facts(trajectory, family, indices))

    def reconcile(
        self, trajectory: Trajectory, selected: str, first: str, verification: str
    ) -> Extracted[Reconciliation]:
        """Words prove nothing to a measuring judge: null."""
        return Extracted(Reconciliation(reason="measurements are not reconciled by words"))

    def inspect_motion(
        self, trajectory: Trajectory, indices: tuple[int, ...], earlier: str
    ) -> Extracted[MotionEvidence]:
        """The same facts from frames spread evenly over the video; true only where they establish success."""
        evidence = self._facts(trajectory, route(trajectory.instruction), indices)
        done = True if establishes_success(evidence) else None
        return Extracted(MotionEvidence(task_effect_completed=done, observations=evidence.observations))

    def _facts(self, trajectory: Trajectory, family: EvidenceFamily, indices: tuple[int, ...]) -> Evidence:
        chosen = list(indices)
        frames = {view: video[chosen] for view, video in trajectory.frames.items()}
        points = None if trajectory.points is None else trajectory.points[chosen]
        measured = measure(self.segmenter, trajectory.instruction, family, frames, points)
        return facts(measured, trajectory.instruction, family)
