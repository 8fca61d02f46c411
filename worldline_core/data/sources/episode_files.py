"""Common parts of foreign sources: episodes that are files below a folder, under ids that are unique and storable,
and what the configuration declares of them."""

from __future__ import annotations

import hashlib
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import PurePosixPath
from typing import Any

import numpy as np

from worldline_core.data.episodes.episode import REPEATS_STATE, Episode
from worldline_core.data.episodes.source import ForeignSourceConfig
from worldline_core.data.guards.rejection import RejectedInputError, check_rate
from worldline_core.data.guards.source_paths import AnyPath, inside, relative_name
from worldline_core.data.video.clip import video_size
from worldline_core.untrusted_text import printable

MAX_LENGTH = 512
_DIGITS = re.compile(r"(\d+)")


class EpisodeFiles[C: ForeignSourceConfig]:
    """A source whose episodes are files or folders below its own.

    An id is the label and the parts of the path that name the episode, joined by "-". Files that would share one (a-b/c and
    a/b-c both give a-b-c) get a digest of their path behind it.

    Args:
        parts_of: the parts of a path that name the episode; by default all, without the suffix.
    """

    def __init__(
        self,
        config: C,
        root: AnyPath,
        found: Iterable[AnyPath],
        parts_of: Callable[[PurePosixPath], Sequence[str]] = lambda file: file.with_suffix("").parts,
    ) -> None:
        self.config = config
        self.root = root
        names = [relative_name(file, root) for file in found]
        wanted = {file: "-".join([config.label, *map(printable, parts_of(file))]) for file in names}
        self.files = {identity: file for file, identity in unique_names(wanted).items()}

    def episode_ids(self) -> list[str]:
        return sorted(self.files, key=by_number)

    def path(self, episode_id: str) -> AnyPath:
        """File of an episode.

        Raises: RejectedInputError (path_traversal) for a link that leads out of the source's folder.
        """
        return inside(self.root, str(self.files[episode_id]))

    def episode(
        self,
        episode_id: str,
        scene: str,
        *,
        layout: str,
        state: np.ndarray,
        action: np.ndarray | None = None,
        overshoot: int = 0,
        conventions: Mapping[str, Any] | None = None,
        **fields: Any,
    ) -> Episode:
        """An episode of what a recording holds and the configuration declares; see `Episode` for the fields.

        Args:
            scene: where the configuration names none.
            action: None: no commands are recorded, the action repeats the state.
            overshoot: how many gripper readings were clipped.
        """
        notes: dict[str, Any] = {"layout": layout, "gripper_overshoot": overshoot}
        if action is None:
            action, notes["action"] = state, REPEATS_STATE
        for name in ("embodiment", "fps", "outcome"):
            if name not in fields:
                fields[name] = getattr(self.config, name)
        fields = {"instruction": "", **self.config.declared(scene), **fields}
        fields.setdefault("timestamps", np.arange(len(state)) / fields["fps"])
        with np.errstate(over="ignore"):  # what is no float32 becomes infinite, and is refused as such
            state, action = state.astype(np.float32), action.astype(np.float32)
        return Episode(
            episode_id=episode_id, state=state, action=action, conventions=notes | dict(conventions or {}), **fields
        )


def unique_names(wanted: Mapping[PurePosixPath, str]) -> dict[PurePosixPath, str]:
    """A name for each file, no two alike: the wanted one, and where several files want it, with digits of the digest of
    the path's bytes behind it; all 64 where a name was chosen to meet 8."""
    names, digits = dict(wanted), dict.fromkeys(wanted, 0)
    while len(set(names.values())) < len(names):
        count = Counter(names.values())
        for file in [file for file, name in names.items() if count[name] > 1]:
            digits[file] = 64 if digits[file] else 8
            digest = hashlib.sha256(os.fsencode(file)).hexdigest()
            names[file] = f"{wanted[file]}-{digest[: digits[file]]}"
    return names


def timed_video_size(path: AnyPath, fps: float) -> tuple[int, int]:
    """(height, width) of a video.

    Raises: RejectedInputError: wrong_fps, and as `video_size`.
    """
    height, width, rate = video_size(path)
    check_rate(rate, fps, path, tolerance=0.02)
    return height, width


def by_number(episode_id: str) -> list[int | str]:
    """Sorting key: episode2 before episode10."""
    return [int(text) if text.isdigit() else text for text in _DIGITS.split(episode_id)]


def storable(episode_id: str) -> str:
    """The id as text that every table and terminal can hold; one that already is stays as it is.

    Bytes that are no UTF-8 and control characters are written as escapes, and the middle of a very long id is left out.
    """
    text = "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in printable(episode_id))
    half = MAX_LENGTH // 2 - 2
    return text if len(text) <= MAX_LENGTH else f"{text[:half]}...{text[-half:]}"


def unique_identity(episode_id: str, source: int, taken: set[str]) -> str:
    """A storable id that is not taken yet: a repeated one gets the number of its source, and of its repetition there."""
    plain = identity = storable(episode_id) or f"unnamed#source.{source}"
    count = 0
    while identity in taken:
        count += 1
        identity = f"{plain}#source.{source}" + (f".{count}" if count > 1 else "")
    return identity


def check_id(episode_id: str, source: str) -> None:
    """Raises: RejectedInputError (invalid_id) for an id that cannot be stored as it is."""
    if storable(episode_id) != episode_id or not episode_id:
        expected = f"1 to {MAX_LENGTH} printable characters of valid UTF-8"
        raise RejectedInputError(
            "invalid_id", "Episode id cannot be stored", where=source, expected=expected, got=ascii(episode_id[:200])
        )
