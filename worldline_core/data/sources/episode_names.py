"""Ids of episodes that are files: the label and the path, told apart where that is not enough."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Mapping


def unique_names(names: Mapping[str, str]) -> dict[str, str]:
    """Id -> file, from file -> wanted id.

    Files that would share an id (a-b/c and a/b-c both give a-b-c) get a digest of their path behind it.
    """
    count = Counter(names.values())
    return {
        name if count[name] == 1 else f"{name}-{hashlib.sha256(printable(file).encode()).hexdigest()[:8]}": file
        for file, name in names.items()
    }


def printable(name: str) -> str:
    """A path whose bytes are no UTF-8 as text that can be stored."""
    return name.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")
