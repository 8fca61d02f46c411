"""A judge that asks a vision-language model.

Prompts P3, P4 and P5 of the paper's appendix "Policy Evaluation"; their content is kept as printed.
"""

from __future__ import annotations

import numpy as np

from worldline_core.evaluation.policy.evidence import SCHEMAS, Evidence, EvidenceFamily, MotionEvidence, Reconciliation
from worldline_core.evaluation.policy.judge import Extracted, Trajectory
from worldline_core.evaluation.vlm.message import (
    Image,
    Part,
    Text,
    Video,
    VisionLanguageModel,
    parse_answer,
    resized_to_height,
)

_P3 = """\
Task instruction: {instruction}

Chronological observations follow. At each time step, the labeled views are synchronized images of the same instant.

Extract observable facts only; do not decide success or failure. Track the target object across the synchronized \
views and compare its initial, intermediate, and final states. The hand_left and hand_right views are cameras mounted \
on the moving grippers: apparent target motion, growth, or centering in a hand-camera view may be caused only by \
camera motion and is not proof that the object moved. Verify object displacement in the wider head view or by clear \
separation from its support and surrounding landmarks. Require agreement between views when the head view is ambiguous.

Treat wording such as 'attempt to grasp X' as success only if X is actually grasped. For a grasp-only task, require \
the target to remain visibly enclosed by the gripper across at least two late observations; the target need not leave \
its support. For a lift or pick-up task, require visible controlled motion of the object with the gripper and \
separation from its support. Contact, gripper closure, or temporary occlusion alone is not sufficient. State the exact \
time-step transition that proves any claimed motion. For placement, insertion, folding, pouring, pressing, or turning, \
inspect whether the corresponding final state is visible. Use null for a fact that is genuinely hidden in every view. \
Do not infer facts from purposeful motion.

For press or click tasks:
A press or click is a momentary action: set required_final_state_visible true when the instructed arm or gripper \
visibly reaches and presses the correct button, bell top, or switch, even if it springs back or the surrounding object \
never moves. Mere approach without visible contact or pressing is insufficient.
"""

_P3_SCHEMAS: dict[EvidenceFamily, str] = {
    "grasp": """\
{"target_held_for_two_late_steps": true,
 "wrong_object_or_drop": false,
 "observations": "...",
 "confidence": 0}""",
    "lift": """\
{"head_view_confirms_target_displacement": true,
 "target_held_for_two_late_steps": true,
 "target_on_original_support_at_end": false,
 "wrong_object_or_drop": false,
 "observations": "...",
 "confidence": 0}""",
    "state_change": """\
{"required_final_state_visible": true,
 "wrong_object_or_drop": false,
 "observations": "...",
 "confidence": 0}""",
}

_P4 = """\
Check the logical consistency of already-extracted visual observations; do not infer anything that they do not \
explicitly state.
Task instruction: {instruction}
selected: {selected}
first pass: {first}
high-resolution verification: {verification}
Do these observations themselves directly establish that the instructed task was completed? A visibly completed \
momentary action such as pressing a button counts. Placement, insertion, scooping, pouring, or transfer requires an \
explicitly observed completed effect. Approach, contact, purposeful motion, an incomplete attempt, or a negated \
completion does not count. Reply only with
{{"observations_prove_completion": <true|false>, "reason": "<brief reason>"}}"""

_P5 = """\
Re-check the unsuccessful image-based judgment using the temporal motion in each camera sequence. The views cover the \
same trajectory. Track the exact instructed target, support, and destination. For lifting, require controlled target \
motion with the gripper and visible separation or changed height relative to the support. For placement or insertion, \
require the target to be released in the instructed destination; approach or temporary occlusion is not completion.
Task instruction: {instruction}
Earlier observation: {earlier}

Reply only with observable motion evidence:
{{"task_effect_completed": <true|false|null>,
 "observations": "<exact visible transition; at most 30 words>"}}"""


def evidence_prompt(instruction: str) -> str:
    """P3, the part before the images."""
    return _P3.format(instruction=instruction)


def evidence_schema_prompt(instruction: str, family: EvidenceFamily) -> str:
    """P3, the part after the images: the schema of the family and nothing else."""
    return (
        f"Return only the schema corresponding to the task family.\n\n{_P3_SCHEMAS[family]}\n\n"
        f"Task instruction: {instruction}\nDo not include a verdict."
    )


def reconciliation_prompt(instruction: str, selected: str, first: str, verification: str) -> str:
    """P4."""
    return _P4.format(instruction=instruction, selected=selected, first=first, verification=verification)


def motion_prompt(instruction: str, earlier: str) -> str:
    """P5."""
    return _P5.format(instruction=instruction, earlier=earlier)


_LABELS = {"head": "head", "left_wrist": "hand_left", "right_wrist": "hand_right"}  # the prompts' words


class VLMJudge:
    """P3..P5 to one model (Qwen3-VL locally, or any OpenAI-compatible server)."""

    def __init__(self, model: VisionLanguageModel) -> None:
        self.model = model

    @property
    def name(self) -> str:
        return self.model.name

    def extract(
        self, trajectory: Trajectory, family: EvidenceFamily, indices: tuple[int, ...], height_px: int
    ) -> Extracted[Evidence]:
        """P3. Grasps see the views of an instant side by side; lifts and state changes see them as separate images."""
        parts: list[Part] = [Text(evidence_prompt(trajectory.instruction))]
        for step, index in enumerate(indices):
            pictures = {
                _LABELS.get(view, view): resized_to_height(frames[index], height_px)
                for view, frames in trajectory.frames.items()
            }
            if family == "grasp":
                parts += [
                    Text(f"Time step {step + 1} of {len(indices)}, from left to right: {', '.join(pictures)}"),
                    Image(np.concatenate(list(pictures.values()), axis=1)),
                ]
            else:
                for label, picture in pictures.items():
                    parts += [Text(f"Time step {step + 1} of {len(indices)}, {label}"), Image(picture)]
        parts.append(Text(evidence_schema_prompt(trajectory.instruction, family)))
        return Extracted(*parse_answer(SCHEMAS[family], self.model.answer(parts)))

    def reconcile(
        self, trajectory: Trajectory, selected: str, first: str, verification: str
    ) -> Extracted[Reconciliation]:
        """P4: words only."""
        prompt = reconciliation_prompt(trajectory.instruction, selected, first, verification)
        return Extracted(*parse_answer(Reconciliation, self.model.answer([Text(prompt)])))

    def inspect_motion(
        self, trajectory: Trajectory, indices: tuple[int, ...], earlier: str
    ) -> Extracted[MotionEvidence]:
        """P5: one video per view."""
        parts: list[Part] = []
        for view, frames in trajectory.frames.items():
            parts += [
                Text(f"View {_LABELS.get(view, view)}"),
                Video(frames[list(indices)], indices, trajectory.fps, len(frames)),
            ]
        parts.append(Text(motion_prompt(trajectory.instruction, earlier)))
        return Extracted(*parse_answer(MotionEvidence, self.model.answer(parts)))
