"""Reading a model's JSON answer: tolerant of what surrounds it, strict about what it says."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Annotated, Any, ClassVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, ValidationError


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
