"""Text that others wrote, made fit to be shown: no control characters, no end of screens of it, and no credentials."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from urllib.parse import quote

_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")
"""Characters that move a terminal's cursor or turn the direction of the text around them. Line breaks and tabs stay."""
_HALF_PAIR = re.compile("[\ud800-\udfff]")
_PARAMETERS = (
    r"signature|sig|token|credential|secret|password|passwd|api[-_]?key|access[-_]?key(?:[-_]?id)?|authorization"
)
_IN_URLS = (
    re.compile(r"(?<=://)[^/\s@:]*:[^/\s@]*(?=@)"),  # scheme://name:password@
    re.compile(r"(?<=http://)[^/\s@]+(?=@)|(?<=https://)[^/\s@]+(?=@)"),  # there a name alone is a token
    re.compile(rf"(?i)(?<=[?&;#])[\w-]*(?:{_PARAMETERS})=[^&\s'\"]+"),  # ?X-Amz-Signature=...
)
_CREDENTIALS = (
    *_IN_URLS,
    re.compile(r"(?i)\b(?:x-)?(?:api[-_]?key|authorization)['\"]?\s*[:=]\s*['\"]?(?:\w+\s+)?[^\s'\",}&]+"),
    re.compile(r"(?i)\bbearer\s+[\w.~+/=-]{6,}"),
    re.compile(r"\b(?:hf_|sk-|gh[oprsu]_|github_pat_|glpat-|xox[abprs]-|AIza|AKIA|ASIA)[\w-]{12,}"),
)
_SECRET_VARIABLE = re.compile(r"(?i)(?:token|key|secret|password)$")
_NUMBER = (int, float, type(None))
_SHORTEST_SECRET = 8
HIDDEN = "***"
LONGEST = 4000
"""Characters of one text of a message or a page."""


def visible(text: str) -> str:
    """Control characters, and those that change the direction of text, written as escapes (`\\x1b`, `\\u202e`)."""
    return _CONTROL.sub(lambda found: found[0].encode("unicode_escape").decode("ascii"), text)


def unusable_text(value: object) -> str | None:
    """The first text within nested mappings and sequences that no file or table can hold (half of a surrogate pair), as ASCII."""
    if isinstance(value, str):
        return None if value.isascii() or not _HALF_PAIR.search(value) else ascii(cut(value, 200))
    if isinstance(value, _NUMBER):  # most values; the checks below would tell them slowest
        return None
    if isinstance(value, Mapping):
        value = (*value, *value.values())
    if not isinstance(value, list | tuple | set | frozenset):
        return None
    return next((found for part in value if (found := unusable_text(part)) is not None), None)


def printable(text: str) -> str:
    """Text that can be stored: bytes of a file name that are no UTF-8, and halves of surrogate pairs, written as escapes."""

    def escape(found: re.Match[str]) -> str:
        code = ord(found[0])
        return f"\\x{code - 0xDC00:02x}" if 0xDC80 <= code <= 0xDCFF else f"\\u{code:04x}"

    return _HALF_PAIR.sub(escape, text)


def carries_credentials(url: str) -> bool:
    """Returns whether a URL contains a password, a token or a signature."""
    return any(pattern.search(url) for pattern in _IN_URLS)


def without_credentials(text: str) -> str:
    """Passwords and tokens in URLs, signatures of signed URLs, authorization headers, keys of known forms, and the values
    of this process's environment variables that are named as secrets (`HF_TOKEN`, `AWS_SECRET_ACCESS_KEY`), hidden."""
    for pattern in _CREDENTIALS:
        text = pattern.sub(HIDDEN, text)
    for name, value in os.environ.items():
        if len(value) >= _SHORTEST_SECRET and _SECRET_VARIABLE.search(name):
            text = text.replace(value, HIDDEN)
    return text


def without_secret(text: str, secret: str) -> str:
    """A text without a secret, in whatever form a server quotes it."""
    forms = json.dumps(secret)[1:-1], repr(secret)[1:-1], quote(secret), quote(secret, safe="")
    for form in {secret, *forms, forms[0].replace("/", "\\/")} - {""}:
        text = text.replace(form, HIDDEN)
    return text


def cut(text: str, length: int = LONGEST) -> str:
    """A text that is too long, ending in how long it was."""
    return text if len(text) <= length else f"{text[:length]}... ({len(text):,} characters)"


def shown(value: object) -> str:
    """A value as text for messages and logs: visible, without credentials, cut."""
    text = str(value)
    start = visible(without_credentials(text[: 2 * LONGEST]))
    if len(text) <= 2 * LONGEST:
        return cut(start)
    # What was not looked through is not shown, however short hiding has made the start.
    return f"{start[:LONGEST]}... ({len(text):,} characters)"
