"""What a vision-language model is shown (one user message of text, images and videos), and how its answer is read.

Reading a JSON answer is tolerant of what surrounds it and strict about what it says.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Protocol

import cv2
import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, ValidationError

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
    """Chosen frames (n, h, w, 3) of a clip; ``indices`` are their numbers in it, recorded at ``fps`` [1/s]."""

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


class Answer(BaseModel):
    """Base of answer schemas. Unlike configuration, keys that a model adds (a forbidden "verdict") carry no weight."""

    model_config = ConfigDict(frozen=True, extra="ignore")
    REQUIRED: ClassVar[tuple[str, ...]] = ()


def _text(value: Any) -> Any:
    return "" if value is None else value


AnswerText = Annotated[str, BeforeValidator(_text)]


def parse_answer[T: Answer](schema: type[T], answer: str) -> tuple[T, bool]:
    """The first JSON object in ``answer`` that fits ``schema``, and whether there was one.

    Prose and code fences around the object are tolerated. Wrong types are not ("true" in quotes is no fact), nor is an
    object that lacks one of the schema's REQUIRED keys.

    Returns:
        (parsed, True), or (the schema's defaults, False) when no object fits.
    """
    for candidate in _objects(answer):
        if all(name in candidate for name in schema.REQUIRED):
            try:
                return schema.model_validate(candidate), True
            except ValidationError:
                continue
    return schema(), False


def _objects(text: str) -> Iterator[dict[str, Any]]:
    """Every JSON object that starts somewhere in ``text``, outermost first."""
    decoder = json.JSONDecoder()
    start = text.find("{")
    while start >= 0:
        try:
            value, end = decoder.raw_decode(text, start)
        except (json.JSONDecodeError, RecursionError):
            start = text.find("{", start + 1)
            continue
        yield value
        start = text.find("{", end)
