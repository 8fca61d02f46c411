"""A judge that asks a vision-language model by the prompts P3, P4 and P5 (`evaluation/prompts.toml`)."""

from __future__ import annotations

import cv2
import numpy as np

from worldline_core.evaluation.policy.evidence import SCHEMAS, Evidence, EvidenceFamily, MotionEvidence, Reconciliation
from worldline_core.evaluation.policy.judge import Extracted
from worldline_core.evaluation.recordings import Trajectory
from worldline_core.evaluation.vlm import PROMPTS, Image, Part, Text, Video, VisionLanguageModel, ask

_LABELS = {"head": "head", "left_wrist": "hand_left", "right_wrist": "hand_right"}  # the prompts' words


class VLMJudge:
    """P3..P5 to one model (Qwen3-VL locally, or any OpenAI-compatible server)."""

    def __init__(self, model: VisionLanguageModel) -> None:
        self.model = model
        self.name = model.name

    def extract(
        self, trajectory: Trajectory, family: EvidenceFamily, indices: tuple[int, ...], height_px: int
    ) -> Extracted[Evidence]:
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
        return Extracted(*ask(self.model, [*parts, Text(schema)], SCHEMAS[family]))

    def reconcile(
        self, trajectory: Trajectory, selected: str, first: str, verification: str
    ) -> Extracted[Reconciliation]:
        """P4: words only."""
        prompt = PROMPTS["reconciliation"].format(
            instruction=trajectory.instruction, selected=selected, first=first, verification=verification
        )
        return Extracted(*ask(self.model, [Text(prompt)], Reconciliation))

    def inspect_motion(
        self, trajectory: Trajectory, indices: tuple[int, ...], earlier: str
    ) -> Extracted[MotionEvidence]:
        """P5: one video per view."""
        parts: list[Part] = []
        for view, frames in trajectory.frames.items():
            video = Video(frames[list(indices)], indices, trajectory.fps, len(frames))
            parts += [Text(f"View {_LABELS[view]}"), video]
        prompt = PROMPTS["motion"].format(instruction=trajectory.instruction, earlier=earlier)
        return Extracted(*ask(self.model, [*parts, Text(prompt)], MotionEvidence))


def _resized(frame: np.ndarray, height_px: int) -> np.ndarray:
    """The frame (h, w, 3) at ``height_px``, its aspect ratio kept."""
    height, width = frame.shape[:2]
    if height == height_px:
        return frame
    size = (max(1, round(width * height_px / height)), height_px)
    return cv2.resize(frame, size, interpolation=cv2.INTER_AREA if height_px < height else cv2.INTER_CUBIC)
