"""A judge that asks a vision-language model, with the paper's prompts."""

from __future__ import annotations

import numpy as np

from worldline_core.evaluation.policy.evidence import (
    SCHEMAS,
    Evidence,
    EvidenceFamily,
    MotionEvidence,
    Reconciliation,
)
from worldline_core.evaluation.policy.judge import Extracted, Trajectory
from worldline_core.evaluation.policy.prompts import (
    evidence_prompt,
    evidence_schema_prompt,
    motion_prompt,
    reconciliation_prompt,
)
from worldline_core.evaluation.vlm.answers import parse_answer
from worldline_core.evaluation.vlm.content import Image, Part, Text, Video, VisionLanguageModel, resized_to_height

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
        """P5: one video a view."""
        parts: list[Part] = []
        for view, frames in trajectory.frames.items():
            parts += [
                Text(f"View {_LABELS.get(view, view)}"),
                Video(frames[list(indices)], indices, trajectory.fps, len(frames)),
            ]
        parts.append(Text(motion_prompt(trajectory.instruction, earlier)))
        return Extracted(*parse_answer(MotionEvidence, self.model.answer(parts)))
