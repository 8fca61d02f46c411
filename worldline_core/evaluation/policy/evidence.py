"""Evidence schemas of the task families (prompts P3..P5 of the paper).

A fact is true, false, or null (hidden in every view). An answer that cannot be parsed becomes evidence in which every
fact is null: it is counted, and rules never take null for success.
"""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from pydantic import BeforeValidator, StrictBool

from worldline_core.evaluation.vlm.answers import Answer, AnswerText

EvidenceFamily = Literal["grasp", "lift", "state_change"]
Fact = StrictBool | None


def _number(value: Any) -> Any:
    # Confidence decides nothing, so an odd one does not spoil the facts beside it.
    return value if isinstance(value, int | float) and not isinstance(value, bool) else 0.0


class _Evidence(Answer):
    wrong_object_or_drop: Fact = None
    observations: AnswerText = ""
    confidence: Annotated[float, BeforeValidator(_number)] = 0.0


class GraspEvidence(_Evidence):
    """P3, grasp: the target must remain held across at least two late observations."""

    REQUIRED: ClassVar[tuple[str, ...]] = ("target_held_for_two_late_steps",)
    target_held_for_two_late_steps: Fact = None


class LiftEvidence(_Evidence):
    """P3, lift: held, visibly displaced in the head view, and off its original support."""

    REQUIRED: ClassVar[tuple[str, ...]] = (
        "head_view_confirms_target_displacement",
        "target_held_for_two_late_steps",
        "target_on_original_support_at_end",
    )
    head_view_confirms_target_displacement: Fact = None
    target_held_for_two_late_steps: Fact = None
    target_on_original_support_at_end: Fact = None


class StateChangeEvidence(_Evidence):
    """P3, state change (placing, inserting, opening, pressing, ...): the instructed final state is visible."""

    REQUIRED: ClassVar[tuple[str, ...]] = ("required_final_state_visible",)
    required_final_state_visible: Fact = None


class Reconciliation(Answer):
    """P4: whether observations already made establish completion."""

    REQUIRED: ClassVar[tuple[str, ...]] = ("observations_prove_completion",)
    observations_prove_completion: Fact = None
    reason: AnswerText = ""


class MotionEvidence(Answer):
    """P5: whether the motion in the whole video shows the task's effect."""

    REQUIRED: ClassVar[tuple[str, ...]] = ("task_effect_completed",)
    task_effect_completed: Fact = None
    observations: AnswerText = ""


Evidence = GraspEvidence | LiftEvidence | StateChangeEvidence
SCHEMAS: dict[EvidenceFamily, type[GraspEvidence] | type[LiftEvidence] | type[StateChangeEvidence]] = {
    "grasp": GraspEvidence,
    "lift": LiftEvidence,
    "state_change": StateChangeEvidence,
}
