"""Vision-language models behind one small protocol: what they are shown, and how their answers are read.

A model is shown one user message of text, images and videos. Reading its JSON answer is tolerant of what surrounds the
object and strict about what it says.
"""

from __future__ import annotations

import json
import logging
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Protocol

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, ValidationError

from worldline_core.errors import UnavailableError
from worldline_core.untrusted_text import visible

logger = logging.getLogger(__name__)

MAX_NEW_TOKENS = 256
MAX_ANSWER_CHARACTERS = 20_000
"""What of an answer is looked through: 256 tokens take some kilobytes."""
PROMPTS: dict[str, str] = tomllib.loads(Path(__file__).with_name("prompts.toml").read_text(encoding="utf-8"))
"""The paper's prompts by name, to be filled by `str.format`."""


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


class Answer(BaseModel):
    """Base of answer schemas. Unlike configuration, keys that a model adds (a forbidden "verdict") carry no weight."""

    model_config = ConfigDict(frozen=True, extra="ignore")
    REQUIRED: ClassVar[tuple[str, ...]] = ()


def _text(value: Any) -> Any:
    # Half characters can be neither stored as UTF-8 nor shown to a tokenizer again.
    return visible(value) if isinstance(value, str) else "" if value is None else value


AnswerText = Annotated[str, BeforeValidator(_text)]


class UnansweredMessageError(UnavailableError):
    """A model gave no answer to this one message; it may answer the next."""


def ask[T: Answer](model: VisionLanguageModel, parts: Sequence[Part], schema: type[T]) -> tuple[T, bool]:
    """What a model says, read by `parse_answer`. No answer is as good as one that cannot be read: null, and counted.

    Raises: UnavailableError when the model cannot be used at all.
    """
    try:
        answer = model.answer(parts)
    except UnansweredMessageError as error:
        logger.warning("counted as no evidence: %s", error)
        return schema(), False
    return parse_answer(schema, answer)


def parse_answer[T: Answer](schema: type[T], answer: str) -> tuple[T, bool]:
    """The first JSON object in ``answer`` that fits ``schema``, and whether there was one.

    Prose and code fences around the object are tolerated. Wrong types are not ("true" in quotes is no fact), nor is an
    object that lacks one of the schema's REQUIRED keys.

    Returns:
        (parsed, True), or (the schema's defaults, False) when no object fits.
    """
    for candidate in _objects(answer[:MAX_ANSWER_CHARACTERS]):
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
        except RecursionError:
            return
        except ValueError:  # no JSON, or a number of thousands of digits
            start = text.find("{", start + 1)
            continue
        yield value
        start = text.find("{", end)
