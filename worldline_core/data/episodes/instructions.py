"""Task texts, made equal where they mean the same: one spelling an instruction, placeholders empty, the raw text kept."""

from __future__ import annotations

import re
import unicodedata
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

from worldline_core.data.episodes.episode import Episode

RAW_INSTRUCTION = "raw_instruction"
_INVISIBLE = ("Cf", "Cc")
_OUTCOME_WORDS = re.compile(
    r"\b((un)?success(ful|fully)?|succeed(s|ed|ing)?|fail(s|ed|ing|ure|ures)?)\b", re.IGNORECASE
)
_QUOTES = dict.fromkeys(map(ord, "\u2018\u2019\u201a\u201b\u2032"), "'") | dict.fromkeys(
    map(ord, "\u201c\u201d\u201e\u201f\u2033"), '"'
)
_TRAILING = ".!,;: "
_PAIRS = {'"': '"', "'": "'", "(": ")", "[": "]", "<": ">"}
_PLACEHOLDERS = (
    "n/a", "na", "none", "null", "nan", "unknown", "todo", "tbd", "test", "task", "instruction", "no instruction",
    "no language", "no description", "default", "default task", "dummy", "placeholder", "untitled", "-", "?", "...",
)  # fmt: skip


def normalised_text(text: str) -> str:
    """One spelling: Unicode NFKC, plain quotes, single spaces, no enclosing quotes or brackets, no end punctuation, one case.

    A text of placeholders or of punctuation alone gives "".
    """
    text = unicodedata.normalize("NFKC", text).translate(_QUOTES)
    # Line breaks and tabs are control characters too, and part words.
    text = "".join(" " if c.isspace() else c for c in text if c.isspace() or unicodedata.category(c) not in _INVISIBLE)
    text = re.sub(r" +", " ", text).strip()
    while len(text) > 1 and _PAIRS.get(text[0]) == text[-1] and text[0] not in text[1:-1]:
        text = text[1:-1].strip()
    if text.lower() in _PLACEHOLDERS:
        return ""
    stripped = text.rstrip(_TRAILING)
    if stripped.lower() in _PLACEHOLDERS or not any(c.isalnum() for c in stripped):
        return ""
    return _lowered(stripped)


def _lowered(text: str) -> str:
    """Lower case, but for abbreviations; a text that is all in capitals is shouted, not abbreviated."""
    if text.isupper():
        return text.lower()
    return " ".join(
        word if re.fullmatch(r"[A-Z0-9]{2,4}[.,;:!?]?", word) and any(c.isalpha() for c in word) else word.lower()
        for word in text.split(" ")
    )


def one_annotation(annotations: Sequence[str]) -> str:
    """The annotation of an episode that most annotators gave, as it was written; of equally frequent ones the first. Annotations count as equal when their normalised texts are; "" where none says anything."""
    texts = [(text, raw) for raw in annotations if (text := normalised_text(raw))]
    if not texts:
        return ""
    counts = Counter(text for text, _ in texts)
    return max(texts, key=lambda pair: counts[pair[0]])[1]  # max keeps the first of equals


def with_instruction(episode: Episode) -> Episode:
    """The episode with its instruction normalised; the raw text stays in its conventions where it differs."""
    text = normalised_text(episode.instruction)
    if text == episode.instruction:
        return episode
    conventions = {RAW_INSTRUCTION: episode.instruction} | dict(episode.conventions)
    return replace(episode, instruction=text, conventions=conventions)


def mentions_outcome(instruction: str) -> bool:
    """True if a task text speaks of how the attempt ended: such a text would tell a model what it is to predict."""
    return _OUTCOME_WORDS.search(instruction) is not None
