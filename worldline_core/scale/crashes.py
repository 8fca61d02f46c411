"""What is known about an episode whose processing ended in an unforeseen way, without this machine's paths."""

from __future__ import annotations

import re
import traceback
from pathlib import Path
from typing import Any

_ADDRESS = re.compile(r"0x[0-9a-fA-F]{4,}")
_ABSOLUTE = re.compile(r"(?<![\w.:/])/(?:[^\s'\":,;()]+/)+")
_FRAMES = 5
_PACKAGE_ROOT = Path(__file__).parents[2]


def crash_evidence(error: BaseException) -> dict[str, Any]:
    """{"type", "message", "trace"}: the trace is the innermost frames as `file:line function`, innermost last."""
    frames = traceback.extract_tb(error.__traceback__)[-_FRAMES:]
    return {
        "type": type(error).__name__,
        "message": portable_message(str(error)),
        "trace": [f"{_short(frame.filename)}:{frame.lineno} {frame.name}" for frame in frames],
    }


def portable_message(text: str) -> str:
    """A message without addresses in memory and without folders: it must not differ from run to run."""
    return _ABSOLUTE.sub("", _ADDRESS.sub("0x…", text))


def _short(filename: str) -> str:
    """A file within its package."""
    path = Path(filename)
    if path.is_relative_to(_PACKAGE_ROOT) and "site-packages" not in path.parts:
        return path.relative_to(_PACKAGE_ROOT).as_posix()
    parts = path.parts
    if "site-packages" in parts:
        return "/".join(parts[parts.index("site-packages") + 1 :])
    return path.name
