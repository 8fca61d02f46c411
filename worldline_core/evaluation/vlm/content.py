"""What is shown to a vision-language model: one user message of text, images and videos."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np

MAX_NEW_TOKENS = 256


@dataclass(frozen=True)
class Text:
    """Words."""

    text: str


@dataclass(frozen=True)
class Image:
    """One picture, uint8 (h, w, 3) RGB."""

    pixels: np.ndarray


@dataclass(frozen=True)
class Video:
    """Chosen frames (n, h, w, 3) of a clip; ``indices`` are their numbers in it, at ``fps`` frames a second."""

    frames: np.ndarray
    indices: tuple[int, ...]
    fps: float
    total_frames: int


Part = Text | Image | Video


class VisionLanguageModel(Protocol):
    """Answers one message, deterministically, with at most MAX_NEW_TOKENS tokens."""

    @property
    def name(self) -> str: ...

    def answer(self, parts: Sequence[Part]) -> str: ...


def resized_to_height(frame: np.ndarray, height_px: int) -> np.ndarray:
    """The frame (h, w, 3) at ``height_px``, its aspect ratio kept."""
    height, width = frame.shape[:2]
    if height == height_px:
        return frame
    size = (max(1, round(width * height_px / height)), height_px)
    interpolation = cv2.INTER_AREA if height_px < height else cv2.INTER_CUBIC
    return cv2.resize(frame, size, interpolation=interpolation)
