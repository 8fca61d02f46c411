"""The judge: whoever turns observations into evidence. Deciding is left to the rules."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from worldline_core.evaluation.policy.evidence import Evidence, EvidenceFamily, MotionEvidence, Reconciliation


@dataclass(frozen=True)
class Trajectory:
    """One video to be judged; nothing in it tells the recorded outcome.

    Attributes:
        frames: by view, uint8 (n, h, w, 3); the views are synchronised.
        points: (n, arms, 2) projected tool centres in the head view [px], to start a segmenter; or None.
    """

    instruction: str
    frames: Mapping[str, np.ndarray]
    fps: float
    points: np.ndarray | None = None

    @property
    def num_frames(self) -> int:
        return min(len(frames) for frames in self.frames.values())


@dataclass(frozen=True)
class Extracted[T]:
    """What a judge stated; ``well_formed`` is False when its answer could not be read (then every fact is null)."""

    evidence: T
    well_formed: bool = True


class Judge(Protocol):
    """Extracts evidence; three questions in the paper's order."""

    @property
    def name(self) -> str: ...

    def extract(
        self, trajectory: Trajectory, family: EvidenceFamily, indices: tuple[int, ...], height_px: int
    ) -> Extracted[Evidence]:
        """P3: facts visible at the given frames, resized to ``height_px``."""
        ...

    def reconcile(
        self, trajectory: Trajectory, selected: str, first: str, verification: str
    ) -> Extracted[Reconciliation]:
        """P4: whether the observations already made prove completion."""
        ...

    def inspect_motion(
        self, trajectory: Trajectory, indices: tuple[int, ...], earlier: str
    ) -> Extracted[MotionEvidence]:
        """P5: facts visible in the motion through the given frames of every view."""
        ...
