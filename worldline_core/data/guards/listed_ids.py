"""The ids that sources list, made unique and storable: they come from file names and metadata that nobody has checked."""

from __future__ import annotations

from worldline_core.data.guards.rejection import RejectedInputError

MAX_LENGTH = 512


def storable(episode_id: str) -> str:
    """The id as text that every table and terminal can hold; one that already is stays as it is.

    Bytes that are no UTF-8 and control characters are written as escapes, and the middle of a very long id is left out.
    """
    text = episode_id.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")
    text = "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)
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
        raise RejectedInputError(
            "invalid_id",
            "Episode id cannot be stored",
            where=source,
            expected=f"1 to {MAX_LENGTH} printable characters of valid UTF-8",
            got=ascii(episode_id[:200]),
            next_step="rename the file or folder, or correct the metadata",
            evidence={"characters": len(episode_id)},
        )
