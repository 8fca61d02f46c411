"""Whether the files of a recording stayed what they were while it was read.

A recording that is written, replaced or cut while it is read would come out half old and half new. Every reader opens its
files through `source_paths.local_file`, which notes them here; when the episode is done their size, time of change
and identity are compared with what they were when this process first opened them.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

from worldline_core.data.guards.rejection import RejectedInputError

type FileState = tuple[int, int, int, int]
_REMEMBERED = 100_000
"""Of files shared by many episodes (joined videos, tables) the state before the first episode counts."""

_run = ""
_first_seen: OrderedDict[Path, FileState] = OrderedDict()
_opened: ContextVar[set[Path] | None] = ContextVar("opened", default=None)


def watch_run(run: str) -> None:
    """Begin anew for another run: between two runs files may change as they like."""
    global _run
    if run != _run:
        _first_seen.clear()
        _run = run


def note_file(path: object) -> None:
    """Remember a file that is about to be read, or whose content read earlier is about to be used.

    Only files of this machine: an object store replaces a file as a whole.
    """
    if not isinstance(path, Path):
        return
    opened = _opened.get()
    if opened is not None:
        if path in opened:
            return
        opened.add(path)
    state = _state(path)
    if state is not None and path not in _first_seen:
        _first_seen[path] = state
        if len(_first_seen) > _REMEMBERED:
            _first_seen.popitem(last=False)


@contextmanager
def unchanged_files(episode_id: str) -> Iterator[None]:
    """Around everything that reads one episode; the block's own errors are replaced where a file changed meanwhile.

    Raises: RejectedInputError (changed_while_reading) naming the files.
    """
    token = _opened.set(set())
    try:
        yield
    except Exception as error:
        _check(episode_id, error)
        raise
    else:
        _check(episode_id, None)
    finally:
        _opened.reset(token)


def _check(episode_id: str, error: Exception | None) -> None:
    changed = []
    for path in sorted(_opened.get() or ()):
        before = _first_seen.get(path)
        if before is not None and _state(path) != before:
            changed.append(path)
            _first_seen.move_to_end(path)
    if changed:
        raise RejectedInputError(
            "changed_while_reading",
            "Files changed while the recording was read",
            where=f"episode {episode_id}",
            expected="files that nobody writes",
            got=", ".join(str(path) for path in changed[:5]) + (" ..." if len(changed) > 5 else ""),
            next_step="wait until the recording is complete, then curate again",
            evidence={"files": len(changed), "other_finding": getattr(error, "reason", None)},
        ) from error


def _state(path: Path) -> FileState | None:
    try:
        found = path.stat()
    except (OSError, ValueError):
        return None
    return found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns
