"""Evidence schemas of the task families, the router from instructions to families, and the rules that decide from evidence.

Schemas: prompts P3..P5 of the paper. A fact is true, false, or null (hidden in every view); an answer that cannot be parsed becomes
evidence in which every fact is null, and is counted. Router and rules: appendix "Evidence-based trajectory evaluation". The paper does
not print its router; this one goes by the verbs. A null is never taken for the favourable value, and a wrong object or a drop fails.
"""

from __future__ import annotations

import re
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BeforeValidator, StrictBool

from worldline_core.evaluation.vlm import Answer, AnswerText

EvidenceFamily = Literal["grasp", "lift", "state_change"]
Fact = StrictBool | None


def _number(value: Any) -> Any:
    # Confidence decides nothing, so an odd one does not spoil the facts beside it.
    known = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e9  # NaN is not
    return value if known else 0.0


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


_STATE_CHANGE = (
    "place", "put", "set", "insert", "stack", "drop", "pour", "fold",
    "open", "close", "press", "push", "pull", "click", "turn", "rotate",
    "switch", "slide", "move", "hang", "scoop", "transfer", "sweep", "wipe",
    "plug", "screw", "hand", "give", "pass", "arrange", "sort",
)  # fmt: skip
_LIFT = ("lift", "pick", "raise", "hold up", "take")
_GRASP = ("grasp", "grab", "grip", "seize", "hold")


def route(instruction: str) -> EvidenceFamily:
    """The family whose evidence decides the instruction.

    The last demand wins: "pick up the cup and place it" is a state change, "grasp and lift" is a lift. An instruction
    with none of the known verbs is a state change, the family that asks for the whole instructed effect.
    """
    text = instruction.lower()
    if _contains(text, _STATE_CHANGE):
        return "state_change"
    if _contains(text, _LIFT):
        return "lift"
    return "grasp" if _contains(text, _GRASP) else "state_change"


def _contains(text: str, words: tuple[str, ...]) -> bool:
    endings = r"(?:s|es|ed|ing|ping|ting|ding)?"
    return any(re.search(rf"\b{re.escape(word.rstrip('e'))}e?{endings}\b", text) for word in words)


def establishes_success(evidence: Evidence) -> bool:
    """Returns True if the evidence establishes that the task was completed."""
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


def overturns(done: Fact, evidence: Evidence) -> bool:
    """P4 or P5 turns an unsuccessful verdict, but not against a wrong object or a drop that was seen."""
    return done is True and evidence.wrong_object_or_drop is not True
