"""Faults that pass: those of a network or of a busy store, not of the data. Only they are retried."""

from __future__ import annotations

import errno
import logging
import time
from collections.abc import Callable, Iterator

from worldline_core.errors import UnavailableError

logger = logging.getLogger(__name__)

ATTEMPTS = 5
FIRST_PAUSE_SECONDS = 0.2

_PASSING = frozenset(
    getattr(errno, name)
    for name in (
        "EIO", "EREMOTEIO", "ESTALE", "EAGAIN", "EBUSY", "ETIMEDOUT", "ENETDOWN", "ENETUNREACH", "ENETRESET",
        "EHOSTDOWN", "EHOSTUNREACH",
    )
    if hasattr(errno, name)
)  # fmt: skip
"""What a network file system or s3fs (its translation of 5xx answers) reports when it should be asked again."""
_PASSING_CLASSES = frozenset(
    {
        ("botocore.exceptions", "HTTPClientError"),  # connections refused, closed, timed out
        ("botocore.exceptions", "ResponseStreamingError"),
        ("botocore.exceptions", "IncompleteReadError"),
        ("botocore.parsers", "ResponseParserError"),  # an answer cut short
        ("aiohttp.client_exceptions", "ClientConnectionError"),
        ("aiohttp.client_exceptions", "ClientPayloadError"),
        ("http.client", "IncompleteRead"),
    }
)
"""By name, so that nobody has to install the libraries of a store that is not used."""


class UnreachableInputError(UnavailableError):
    """A store did not answer although it was asked several times; what lies there may well be good, so it is not quarantined."""


def is_transient(error: BaseException | None) -> bool:
    """Whether asking again may help: the error, or one that caused it, comes from a network or a busy store."""
    seen: set[int] = set()
    while error is not None and id(error) not in seen:
        seen.add(id(error))
        if isinstance(error, ConnectionError | TimeoutError | UnreachableInputError):
            return True
        if isinstance(error, OSError) and error.errno in _PASSING:
            return True
        if _busy_answer(error) or any((c.__module__, c.__name__) in _PASSING_CLASSES for c in type(error).__mro__):
            return True
        error = error.__cause__ or error.__context__
    return False


def _busy_answer(error: BaseException) -> bool:
    """botocore's ClientError and aiohttp's ClientResponseError with a status of 5xx or 429."""
    response = getattr(error, "response", None)
    status = getattr(error, "status", None)
    if isinstance(response, dict):
        status = response.get("ResponseMetadata", {}).get("HTTPStatusCode")
    return isinstance(status, int) and (status >= 500 or status == 429)


def pauses(attempts: int = ATTEMPTS, first_seconds: float = FIRST_PAUSE_SECONDS) -> Iterator[float]:
    """Seconds to wait before each further attempt, doubling."""
    yield from (first_seconds * 2**number for number in range(attempts - 1))


def with_retries[T](action: Callable[[], T], what: str) -> T:
    """The result of `action`, tried again with growing pauses while it fails for a transient reason.

    Raises: UnreachableInputError after the last attempt; every other error at once.
    """
    waiting = pauses()
    while True:
        try:
            return action()
        except Exception as error:
            if not is_transient(error):
                raise
            pause = next(waiting, None)
            if pause is None:
                raise UnreachableInputError(
                    "A store could not be reached",
                    where=what,
                    expected=f"an answer within {ATTEMPTS} attempts",
                    got=f"{type(error).__name__}: {error}",
                    next_step="run the same command again when the store answers; finished work is kept",
                ) from error
            logger.warning("%s: %s: %s; trying again in %.1f s", what, type(error).__name__, error, pause)
            time.sleep(pause)
