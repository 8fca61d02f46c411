"""What readers of foreign recordings share: ids, names of state columns, checks of lengths and rates."""

from __future__ import annotations

import hashlib
import re
from collections import Counter
from collections.abc import Mapping, Sequence

from worldline_core.data.guards.rejection import RejectedInputError

_DIGITS = re.compile(r"(\d+)")


def file_ids(label: str, files: Mapping[str, Sequence[str]]) -> dict[str, str]:
    """Id -> file, from file -> the parts of its path that name the episode.

    An id is the label and the parts, joined by "-". Files that would share one (a-b/c and a/b-c both give a-b-c) get a
    digest of their path behind it.
    """
    wanted = {file: "-".join([label, *map(printable, parts)]) for file, parts in files.items()}
    count = Counter(wanted.values())
    return {
        name if count[name] == 1 else f"{name}-{hashlib.sha256(printable(file).encode()).hexdigest()[:8]}": file
        for file, name in wanted.items()
    }


def printable(name: str) -> str:
    """A path whose bytes are no UTF-8 as text that can be stored."""
    return name.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")


def by_number(episode_id: str) -> list[int | str]:
    """Sorting key: episode2 before episode10."""
    return [int(text) if text.isdigit() else text for text in _DIGITS.split(episode_id)]


def joint_names(arms: Mapping[str, int], *, gripper: bool = True) -> tuple[str, ...]:
    """Names of state columns, from arm -> number of its joints: left/joint_1, ..., left/gripper, right/joint_1, ..."""
    last = ["gripper"] if gripper else []
    return tuple(
        f"{arm}/{name}" for arm, joints in arms.items() for name in (*(f"joint_{j + 1}" for j in range(joints)), *last)
    )


def check_length(what: str, where: object, *, states: int, unit: str, found: int) -> None:
    """Raises: RejectedInputError (length_mismatch) where there are not as many (images, rows, ...) as states."""
    if found != states:
        raise RejectedInputError(
            "length_mismatch",
            f"{what} and states differ in length",
            where=where,
            expected=f"{states} {unit}",
            got=f"{found} {unit}",
            evidence={"states": states, unit: found},
        )


def check_rate(rate: float, wanted: float, where: object, *, tolerance: float) -> None:
    """Raises: RejectedInputError (wrong_fps) where a video's rate is further than `tolerance` [fps] from the wanted one."""
    if not abs(rate - wanted) <= tolerance:
        raise RejectedInputError(
            "wrong_fps",
            "Video has another frame rate than its recording",
            where=where,
            expected=f"{wanted} fps",
            got=f"{rate} fps",
            evidence={"expected_fps": wanted, "found_fps": rate},
        )
