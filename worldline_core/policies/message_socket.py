"""A websocket on which every request is one message and has one reply, each with a deadline for the whole exchange."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from types import TracebackType
from typing import Any, Self

from worldline_core.errors import ConfigError, DataError, UnavailableError
from worldline_core.http_exchange import within
from worldline_core.policies.array_messages import MAX_MESSAGE_BYTES, pack, unpack
from worldline_core.untrusted_text import without_secret


class MessageSocket:
    """A connection to a server of array messages, for one thread at a time.

    Deadlines are of the whole exchange, name resolution included. After a deadline or a broken message the connection is closed: a late
    reply would be taken for that of the next request.

    Args:
        url: ``ws://host:port/path`` or ``wss://...``; reached directly, without a proxy.
        headers: sent with the connection request; the last word of each is a secret, hidden where the server repeats it.
        deadline_s: for connecting, and for each exchange where it names no other.
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

        self.url = url
        self.deadline_s = deadline_s
        self.max_bytes = max_bytes
        given = {name: value.strip() for name, value in (headers or {}).items()}
        if wrong := [name for name, value in given.items() if not (value.isascii() and value.isprintable())]:
            raise ConfigError(
                f"The header {wrong[0]} cannot be sent", where=url,
                expected="a key or token of letters, digits and signs of ASCII on one line",
            )  # fmt: skip
        self._secrets = [value.split()[-1] for value in given.values() if value]
        try:
            self._connection = within(
                deadline_s,
                lambda: connect(
                    url, additional_headers=given, compression=None, max_size=max_bytes, open_timeout=deadline_s,
                    close_timeout=1.0, proxy=None,
                ),
                discard=lambda late: late.close(),
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
            DataError: the request cannot be packed, the reply is no message or too large, or an unexpected message
                arrived before, which would be taken for the reply.
        """
        from websockets.exceptions import ConnectionClosed

        content = pack(message)
        with suppress(TimeoutError, ConnectionClosed):
            self._connection.recv(timeout=0)
            self.close()
            raise DataError("The server sent an unexpected message", where=self.url, next_step="connect again")
        return self._exchange(lambda: self._connection.send(content), deadline_s)

    def receive(self, *, deadline_s: float | None = None) -> dict[str, Any]:
        """A message that the server sends unasked; raises as :meth:`request`."""
        return self._exchange(lambda: None, deadline_s)

    def _exchange(self, send: Callable[[], None], deadline_s: float | None) -> dict[str, Any]:
        from websockets.exceptions import ConnectionClosed

        deadline = self.deadline_s if deadline_s is None else deadline_s
        late = threading.Event()

        def give_up() -> None:
            late.set()
            with suppress(OSError):  # closed meanwhile
                self._connection.socket.shutdown(socket.SHUT_RDWR)

        watch = threading.Timer(deadline, give_up)
        watch.daemon = True
        watch.start()
        try:
            send()
            reply = self._connection.recv()
        except ConnectionClosed as error:
            if late.is_set():
                raise UnavailableError(
                    "The server did not answer in time", where=self.url, expected=f"a reply within {deadline:g} s",
                    next_step="connect again; allow more time where the server needs it",
                ) from error  # fmt: skip
            if error.sent is not None and error.sent.code == 1009 and not error.rcvd_then_sent:
                raise DataError(
                    "A reply is too large", where=self.url, expected=f"at most {self.max_bytes:,} bytes"
                ) from error
            raise UnavailableError(
                "The server closed the connection", where=self.url, got=str(error), next_step="connect again"
            ) from error
        finally:
            watch.cancel()
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

    def close(self) -> None:
        """End the connection."""
        self._connection.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
