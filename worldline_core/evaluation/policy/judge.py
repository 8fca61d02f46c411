"""Judging one video: a judge states evidence, rules decide, and unsuccessful verdicts are verified.

Evidence schemas: prompts P3..P5 of the paper. A fact is true, false, or null (hidden in every view, or in an answer that cannot be parsed,
which is counted). Router and rules: appendix "Evidence-based trajectory evaluation"; the paper does not print its router, this one goes
by the verbs. A null is never taken for the favourable value, and a wrong object or a drop fails.

Sampled frames: appendix "Observation sampling". Passes after a first one without success: appendix "Verification of unsuccessful
predictions".
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, Protocol

import cv2
import numpy as np
from pydantic import BeforeValidator, StrictBool

from worldline_core.evaluation.recordings import Trajectory
from worldline_core.evaluation.vlm import (
    PROMPTS,
    Answer,
    AnswerText,
    Image,
    Part,
    Text,
    Video,
    VisionLanguageModel,
    ask,
)

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


class Judge(Protocol):
    """Extracts evidence; three questions in the paper's order.

    Each returns evidence and whether the answer could be read; if not, every fact is null.
    """

    @property
    def name(self) -> str: ...

    def extract(
        self, trajectory: Trajectory, family: EvidenceFamily, indices: tuple[int, ...], height_px: int
    ) -> tuple[Evidence, bool]:
        """P3: facts visible at the given frames, resized to ``height_px``."""
        ...

    def reconcile(
        self, trajectory: Trajectory, selected: str, first: str, verification: str
    ) -> tuple[Reconciliation, bool]:
        """P4: whether the observations already made prove completion."""
        ...

    def inspect_motion(
        self, trajectory: Trajectory, indices: tuple[int, ...], earlier: str
    ) -> tuple[MotionEvidence, bool]:
        """P5: facts visible in the motion through the given frames of every view."""
        ...


FIRST_PASS_COUNT = 12
FIRST_PASS_HEIGHT_PX = 360
VERIFICATION_POSITIONS = (0.0, 0.65, 0.78, 0.88, 0.95, 1.0)
VERIFICATION_HEIGHT_PX = 480
MOTION_COUNT = 12


def first_pass_indices(num_frames: int) -> tuple[int, ...]:
    """Twelve frames at sqrt(i / 11): more of them late, where success and failure differ."""
    return frames_at(np.sqrt(np.linspace(0.0, 1.0, FIRST_PASS_COUNT)), num_frames)


def frames_at(positions: np.ndarray | tuple[float, ...], num_frames: int) -> tuple[int, ...]:
    """Nearest frames of normalised positions, in order; a frame that two positions share is shown once."""
    return tuple(sorted({round(float(position) * (num_frames - 1)) for position in positions}))


def confidence_of(judgement: Mapping[str, Any]) -> float | None:
    """Confidence in a verdict (a `Judgement` as a dict): of the evidence that established success, else the least of all passes; None
    where none was stated."""
    stated = [float(s["confidence"]) for s in judgement["statements"] if s.get("confidence") is not None]
    if not stated:
        return None
    by_evidence = judgement["decided_by"] in ("first_pass", "verification")
    return min(1.0, max(0.0, stated[-1] if judgement["success"] and by_evidence else min(stated)))


Pass = Literal["first_pass", "verification", "reconciliation", "motion", "learned"]


@dataclass(frozen=True)
class Judgement:
    """The decision, the pass that made it (the last one for a failure), and what was stated in every pass.

    ``undecided``: the judge states no verdict, and ``success`` is only the side that is nearer.
    """

    success: bool
    family: EvidenceFamily
    decided_by: Pass
    malformed_answers: int
    answers: int
    statements: list[dict[str, Any]]
    undecided: bool = False


def judge_trajectory(judge: Judge, trajectory: Trajectory) -> Judgement:
    """Judge one video by the evidence of the family that its instruction belongs to."""
    family, count = route(trajectory.instruction), trajectory.num_frames
    passes: list[Pass] = []
    stated: list[tuple[Any, bool]] = []

    def take[T: Answer](name: Pass, answer: tuple[T, bool]) -> T:
        passes.append(name)
        stated.append(answer)
        return answer[0]

    def done(success: bool) -> Judgement:
        malformed = sum(not well_formed for _, well_formed in stated)
        facts = [{"pass": n, **evidence.model_dump()} for n, (evidence, _) in zip(passes, stated, strict=True)]
        return Judgement(success, family, passes[-1], malformed, len(stated), facts)

    first = take("first_pass", judge.extract(trajectory, family, first_pass_indices(count), FIRST_PASS_HEIGHT_PX))
    if establishes_success(first):
        return done(True)

    # What later passes argue about: the newest evidence that could be read.
    selected: Evidence = first
    verification = ""
    if len(trajectory.frames) > 1:
        indices = frames_at(VERIFICATION_POSITIONS, count)
        second = take("verification", judge.extract(trajectory, family, indices, VERIFICATION_HEIGHT_PX))
        verification = second.observations
        if establishes_success(second):
            return done(True)
        if stated[-1][1]:
            selected = second

    if family == "state_change":
        answer = judge.reconcile(trajectory, selected.observations, first.observations, verification)
        if overturns(take("reconciliation", answer).observations_prove_completion, selected):
            return done(True)

    if family in ("lift", "state_change"):
        indices = frames_at(np.linspace(0.0, 1.0, MOTION_COUNT), count)
        answer = judge.inspect_motion(trajectory, indices, selected.observations)
        return done(overturns(take("motion", answer).task_effect_completed, selected))
    return done(False)


_LABELS = {"head": "head", "left_wrist": "hand_left", "right_wrist": "hand_right"}  # the prompts' words


class VLMJudge:
    """P3..P5 to one model (Qwen3-VL locally, or any OpenAI-compatible server)."""

    def __init__(self, model: VisionLanguageModel) -> None:
        self.model = model
        self.name = model.name

    def extract(
        self, trajectory: Trajectory, family: EvidenceFamily, indices: tuple[int, ...], height_px: int
    ) -> tuple[Evidence, bool]:
        """P3. Grasps see the views of an instant side by side; lifts and state changes see them as separate images."""
        parts: list[Part] = [Text(PROMPTS["evidence"].format(instruction=trajectory.instruction))]
        shown = {_LABELS[view]: frames[list(indices)] for view, frames in trajectory.frames.items()}
        for step in range(len(indices)):
            instant = f"Time step {step + 1} of {len(indices)}"
            pictures = {label: _resized(frames[step], height_px) for label, frames in shown.items()}
            if family == "grasp":
                parts.append(Text(f"{instant}, from left to right: {', '.join(pictures)}"))
                parts.append(Image(np.concatenate(list(pictures.values()), axis=1)))
            else:
                for label, picture in pictures.items():
                    parts += [Text(f"{instant}, {label}"), Image(picture)]
        schema = PROMPTS["evidence_schema"].format(schema=PROMPTS[family], instruction=trajectory.instruction)
        return ask(self.model, [*parts, Text(schema)], SCHEMAS[family])

    def reconcile(
        self, trajectory: Trajectory, selected: str, first: str, verification: str
    ) -> tuple[Reconciliation, bool]:
        """P4: words only."""
        prompt = PROMPTS["reconciliation"].format(
            instruction=trajectory.instruction, selected=selected, first=first, verification=verification
        )
        return ask(self.model, [Text(prompt)], Reconciliation)

    def inspect_motion(
        self, trajectory: Trajectory, indices: tuple[int, ...], earlier: str
    ) -> tuple[MotionEvidence, bool]:
        """P5: one video per view."""
        parts: list[Part] = []
        for view, frames in trajectory.frames.items():
            video = Video(frames[list(indices)], indices, trajectory.fps, len(frames))
            parts += [Text(f"View {_LABELS[view]}"), video]
        prompt = PROMPTS["motion"].format(instruction=trajectory.instruction, earlier=earlier)
        return ask(self.model, [*parts, Text(prompt)], MotionEvidence)


def _resized(frame: np.ndarray, height_px: int) -> np.ndarray:
    """The frame (h, w, 3) at ``height_px``, its aspect ratio kept."""
    height, width = frame.shape[:2]
    if height == height_px:
        return frame
    size = (max(1, round(width * height_px / height)), height_px)
    return cv2.resize(frame, size, interpolation=cv2.INTER_AREA if height_px < height else cv2.INTER_CUBIC)
