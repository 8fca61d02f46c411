"""The protocol of a robot segmenter, and how one is opened by name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import numpy as np

from worldline_core.errors import ArtifactError, UnavailableError
from worldline_core.evaluation.evaluation_config import SegmenterName

MaskStream = Callable[[np.ndarray, np.ndarray | None], np.ndarray]
"""Masks of the next frames of one video; arguments and result as of `Segmenter.segment`."""


class Segmenter(Protocol):
    """Masks the robot in one video, without knowing of any other video."""

    @property
    def name(self) -> str: ...

    @property
    def description(self) -> str: ...

    @property
    def follows(self) -> bool:
        """Whether it tracks the robot from the first frame on (rather than masking each frame by itself)."""
        ...

    def segment(self, video: np.ndarray, points: np.ndarray | None) -> np.ndarray:
        """Mask the robot in every frame.

        Args:
            video: uint8 (n, h, w, 3) RGB.
            points: (n, p, 2) projected tool centres u, v [px], NaN where invalid; they may only *start* a
                segmentation (the first frame's), never tell where the robot is later. None: no points known.

        Returns:
            bool (n, h, w).
        """
        ...

    def stream(self) -> MaskStream:
        """As :meth:`segment`, but for a video that comes piece by piece."""
        ...


def open_segmenter(name: SegmenterName, *, learned: Path | None, sam3: Path | None) -> Segmenter:
    """A segmenter by name; ``learned`` and ``sam3`` are the folders of their weights.

    Raises:
        ArtifactError: the learned one has no folder.
        UnavailableError: SAM 3 has no local weights.
    """
    if name == "colour":
        from worldline_core.evaluation.segmenters.colour import ColourSegmenter

        return ColourSegmenter()
    if name == "sam3":
        from worldline_core.evaluation.segmenters.sam3 import Sam3Segmenter

        if sam3 is None:
            raise UnavailableError(
                "SAM 3 needs local weights", next_step="set sam3_weights to a downloaded facebook/sam3 folder"
            )
        return Sam3Segmenter.load(sam3)
    from worldline_core.evaluation.segmenters.learned import LearnedSegmenter

    if learned is None:
        raise ArtifactError(
            "The learned segmenter has no weights",
            expected="an input named segmenter",
            next_step="give artifacts/shipped/models/segmenter, run train_segmenter, or choose segmenters: [colour]",
        )
    return LearnedSegmenter.load(learned)
