"""A websocket on which every request is one message and has one reply within a deadline."""

from __future__ import annotations

from collections.abc import Mapping
from types import TracebackType
from typing import Any, Self

from worldline_core.errors import ConfigError, DataError, UnavailableError
from worldline_core.policies.array_messages import MAX_MESSAGE_BYTES, pack, unpack
from worldline_core.untrusted_text import without_secret


class MessageSocket:
    """A connection to a server of array messages, for one thread at a time.

    After a deadline or a broken message the connection is closed: a late reply would be taken for that of the next request.

    Args:
        url: ``ws://host:port/path`` or ``wss://...``; reached directly, without a proxy.
        headers: sent with the connection request; the last word of each is a secret, hidden where the server repeats it.
        deadline_s: for connecting, and for each reply where :meth:`request` names no other.
        max_bytes: of one reply.

    Raises:
        ConfigError: a header cannot be sent.
        UnavailableError: no server answers, or it refuses the request.
    """

    def __init__(
        self,
        url: str,
        *,
        headers: Mapping[str, str] | None = None,
        deadline_s: float = 30.0,
        max_bytes: int = MAX_MESSAGE_BYTES,
    ) -> None:
        from websockets.exceptions import InvalidHandshake, InvalidStatus, InvalidURI
        from websockets.sync.client import connect

        self.url, self.deadline_s, self.max_bytes = url, deadline_s, max_bytes
        given = {name: value.strip() for name, value in (headers or {}).items()}
        if wrong := [name for name, value in given.items() if not (value.isascii() and value.isprintable())]:
            raise ConfigError(
                f"The header {wrong[0]} cannot be sent", where=url,
                expected="a key or token of letters, digits and signs of ASCII on one line",
            )  # fmt: skip
        self._secrets = [value.split()[-1] for value in given.values() if value]
        try:
            self._connection = connect(
                url, additional_headers=given, compression=None, max_size=max_bytes, open_timeout=deadline_s,
                close_timeout=1.0, proxy=None,
            )  # fmt: skip
        except InvalidStatus as error:
            status = error.response.status_code
            raise UnavailableError(
                "The server refuses the connection", where=url, expected="status 101", got=status,
                next_step="give its API key or token" if status in (401, 403) else None,
            ) from error  # fmt: skip
        except (
            OSError,
            InvalidHandshake,
            InvalidURI,
            EOFError,
            ValueError,
        ) as error:  # ValueError: a malformed address
            raise UnavailableError(
                "No server answers", where=url, got=f"{type(error).__name__}: {error}",
                next_step="start it, or correct the address (ws://HOST:PORT)",
            ) from error  # fmt: skip

    def request(self, message: object, *, deadline_s: float | None = None) -> dict[str, Any]:
        """Send one message and return the reply, a map.

        Raises:
            UnavailableError: the server is gone, reports an error (a text frame), or does not answer in time.
            DataError: the request cannot be packed, or the reply is no message or too large.
        """
        from websockets.exceptions import ConnectionClosed

        content = pack(message)
        try:
            self._connection.send(content)
        except ConnectionClosed as error:
            raise self._closed(error) from error
        return self.receive(deadline_s=deadline_s)

    def receive(self, *, deadline_s: float | None = None) -> dict[str, Any]:
        """The next message of the server; raises as :meth:`request`."""
        from websockets.exceptions import ConnectionClosed

        deadline = self.deadline_s if deadline_s is None else deadline_s
        try:
            reply = self._connection.recv(timeout=deadline)
        except TimeoutError as error:
            self.close()
            raise UnavailableError(
                "The server did not answer in time", where=self.url, expected=f"a reply within {deadline:g} s",
                next_step="connect again; allow more time where the server needs it",
            ) from error  # fmt: skip
        except ConnectionClosed as error:
            if error.sent is not None and error.sent.code == 1009 and not error.rcvd_then_sent:
                raise DataError(
                    "A reply is too large", where=self.url, expected=f"at most {self.max_bytes:,} bytes"
                ) from error
            raise self._closed(error) from error
        if isinstance(reply, str):
            self.close()
            for secret in self._secrets:
                reply = without_secret(reply, secret)
            raise UnavailableError("The server reports an error", where=self.url, got=reply)
        try:
            found = unpack(reply, self.url)
            if not isinstance(found, dict):
                raise DataError("A message is no map", where=self.url, expected="a map", got=type(found).__name__)
        except DataError:
            self.close()
            raise
        return found

    def _closed(self, error: Exception) -> UnavailableError:
        return UnavailableError(
            "The server closed the connection", where=self.url, got=str(error), next_step="connect again"
        )

    def close(self) -> None:
        """End the connection."""
        self._connection.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
