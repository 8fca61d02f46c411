"""Deterministic rules from evidence to a decision (appendix "Evidence-based trajectory evaluation").

Only facts that are stated decide: a null is never taken for the favourable value, and a wrong object or a drop fails.
"""

from __future__ import annotations

from worldline_core.evaluation.policy.evidence import (
    Evidence,
    GraspEvidence,
    LiftEvidence,
    MotionEvidence,
    Reconciliation,
)


def establishes_success(evidence: Evidence) -> bool:
    """Whether the evidence establishes that the task was completed."""
    if evidence.wrong_object_or_drop is not False:
        return False
    if isinstance(evidence, GraspEvidence):
        return evidence.target_held_for_two_late_steps is True
    if isinstance(evidence, LiftEvidence):
        return (
            evidence.target_held_for_two_late_steps is True
            and evidence.head_view_confirms_target_displacement is True
            and evidence.target_on_original_support_at_end is False
        )
    return evidence.required_final_state_visible is True


def reconciliation_establishes_success(reconciliation: Reconciliation, evidence: Evidence) -> bool:
    """P4 may turn an unsuccessful state change, but not against a wrong object or a drop that was seen."""
    return reconciliation.observations_prove_completion is True and evidence.wrong_object_or_drop is not True


def motion_establishes_success(motion: MotionEvidence, evidence: Evidence) -> bool:
    """P5 may turn an unsuccessful lift or state change, but not against a wrong object or a drop that was seen."""
    return motion.task_effect_completed is True and evidence.wrong_object_or_drop is not True
