"""The selector: whoever compares candidate videos. It sees letters and pictures, never identities or outcomes."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

NUM_FRAMES = 16
_WHOLE, _LATE = 10, 6
_LATE_FROM = 0.6


@dataclass(frozen=True)
class ShownFrames:
    """The chosen frames by view, uint8 (n, h, w, 3). They are shown many times, under one letter or another."""

    by_view: Mapping[str, np.ndarray]

    @cached_property
    def digest(self) -> str:
        """Names what is seen, and nothing else."""
        digest = hashlib.sha256()
        for view in sorted(self.by_view):
            digest.update(view.encode())
            digest.update(self.by_view[view].tobytes())
        return digest.hexdigest()


@dataclass(frozen=True)
class CandidateVideo:
    """One candidate under a temporary letter.

    Attributes:
        shown: the chosen frames; indices: their numbers in the video.
        points: (n, arms, 2) projected tool centres at these frames in the head view [px], to start a segmenter.
    """

    label: str
    shown: ShownFrames
    indices: tuple[int, ...]
    fps: float
    total_frames: int
    points: np.ndarray | None = None

    @property
    def frames(self) -> Mapping[str, np.ndarray]:
        return self.shown.by_view


@dataclass(frozen=True)
class CandidateScore:
    """P2's answer; only the score ranks."""

    score: float
    task_completed: bool | None = None
    final_state: str = ""
    failure_reason: str = ""
    well_formed: bool = True


@dataclass(frozen=True)
class Comparison:
    """P1's answer: exactly as many labels as were asked for."""

    labels: tuple[str, ...]
    reason: str = ""
    well_formed: bool = True


class Selector(Protocol):
    """Ranks candidates of one scene."""

    @property
    def name(self) -> str: ...

    def compare(self, instruction: str, candidates: Sequence[CandidateVideo], select_count: int) -> Comparison:
        """P1: the ``select_count`` candidates most likely to complete the task."""
        ...

    def score(self, instruction: str, candidate: CandidateVideo) -> CandidateScore:
        """P2: 0..100, how likely this candidate completes the task."""
        ...


def planning_indices(num_frames: int) -> tuple[int, ...]:
    """Sixteen frames: ten over the whole video, six more inside its last 40 % (fewer where the video is shorter)."""
    whole = np.linspace(0.0, 1.0, _WHOLE)
    late = _LATE_FROM + (1.0 - _LATE_FROM) * (np.arange(_LATE) + 0.5) / _LATE
    chosen = {round(float(p) * (num_frames - 1)) for p in whole}
    for position in late * (num_frames - 1):
        free = [index for index in range(int(_LATE_FROM * (num_frames - 1)), num_frames) if index not in chosen]
        if free:
            chosen.add(min(free, key=lambda index: (abs(index - position), index)))
    return tuple(sorted(chosen))
