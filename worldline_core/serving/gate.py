"""Who may reach the server, and with how much: checks of host, origin and token before anything else is done with a request,
and bounds on connections and on what they hold."""

from __future__ import annotations

import hmac
from typing import TYPE_CHECKING
from urllib.parse import parse_qs, urlsplit

from starlette.datastructures import Headers
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from worldline_core.serving.serve_config import ServeConfig, is_loopback

if TYPE_CHECKING:
    from asyncio import Transport

    from uvicorn._types import ASGIReceiveEvent

OPEN_PATHS = ("/healthz", "/play")
"""Need no token: they say nothing of sessions. The page connects with the token that its own address carries."""

SMALL_BYTES = 1 << 16
"""A request of so many bytes, as those of a step are, is taken whatever the others hold."""


class HeldBytes:
    """What all requests that are being received or answered hold together, at most `most` bytes and what small ones hold."""

    def __init__(self, most: int) -> None:
        self.most, self.held = most, 0

    def take(self, before: int, size: int) -> bool:
        """Whether a request that holds so many bytes already may hold so many more; if so they are counted."""
        if self.held + size > self.most and before + size > SMALL_BYTES:
            return False
        self.held += size
        return True

    def free(self, size: int) -> None:
        """A request is answered, or given up."""
        self.held -= size


class Gate:
    """Refuses requests, before their bodies are read:

    - under a foreign host name, where no token protects the server: a web page whose name was bound anew to this machine;
    - from pages of other servers (header Origin): a page that a user of this machine happens to visit could drive it;
    - without the token, where one is set. Tokens are compared in constant time.
    """

    def __init__(self, app: ASGIApp, config: ServeConfig, token: str | None) -> None:
        self._app = app
        self._origins = {origin.rstrip("/").lower() for origin in config.origins}
        self._token = token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        refused = None if scope["type"] == "lifespan" else self._refused(scope)
        if refused is None:
            await self._app(scope, receive, send)
        elif scope["type"] == "websocket":
            await send(
                {"type": "websocket.close", "code": 1008, "reason": refused[1]}
            )  # the handshake ends with status 403
        else:
            await PlainTextResponse(f"{refused[1]}\n", refused[0])(scope, receive, send)

    def _refused(self, scope: Scope) -> tuple[int, str] | None:
        headers = Headers(scope=scope)
        host, origin = headers.get("host", "").lower(), headers.get("origin")
        try:
            named = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            named = ""
        if self._token is None and not is_loopback(named):
            return 403, "this host name is not served: connect to 127.0.0.1 or localhost"
        if origin is not None and origin.lower() not in {f"http://{host}", f"https://{host}", *self._origins}:
            return 403, "pages of other servers may not connect: add theirs to `origins`"
        if self._token is None or scope["path"] in OPEN_PATHS:
            return None
        given = headers.get("authorization", "").removeprefix("Bearer ")
        given = given or parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0]
        if not hmac.compare_digest(given.encode(), self._token.encode()):
            return 401, "a token is needed: Authorization: Bearer ..."
        return None


def patient_http(most: int, patience_s: float) -> type[H11Protocol]:
    """Uvicorn's HTTP protocol with bounds that it lacks, so that nobody takes all of the process's sockets.

    Args:
        most: connections at a time, websockets too; others are closed at once.
        patience_s: a connection that is neither answered nor sends the head of a request is closed after this to twice
            this time.
    """

    class PatientHttp(H11Protocol):
        def connection_made(self, transport: Transport) -> None:  # type: ignore[override]
            super().connection_made(transport)
            if len(self.connections) > most:
                transport.abort()
            else:
                self.loop.call_later(patience_s, self._give_up, self.cycle)

        def _give_up(self, before: object) -> None:
            if self.transport.is_closing() or self.transport.get_protocol() is not self:
                return  # gone, or a websocket by now
            if self.cycle is before and (before is None or self.cycle.response_complete):
                self.transport.close()
            else:
                self.loop.call_later(patience_s, self._give_up, self.cycle)

    return PatientHttp


def bounded_websocket(held: HeldBytes) -> type[WebSocketsSansIOProtocol]:
    """Uvicorn's websocket protocol; a connection whose message is more than all may hold together is closed (1013)."""

    class BoundedWebSocket(WebSocketsSansIOProtocol):
        _coming = _given = 0
        """Bytes of the message that arrives, and of the one that the application has not answered yet."""

        def data_received(self, data: bytes) -> None:
            if held.take(self._coming + self._given, len(data)):
                self._coming += len(data)
                super().data_received(data)
            elif not self.close_sent:
                self.conn.fail(1013, "too much is being received, try again later")
                self.handle_parser_exception()

        async def receive(self) -> ASGIReceiveEvent:
            self._free_given()
            event = await super().receive()
            # Nothing more is read until the application asks again, so all that came belongs to this message.
            self._given, self._coming = self._given + self._coming, 0
            return event

        def connection_lost(self, exc: Exception | None) -> None:
            held.free(self._coming)
            self._coming = 0
            self._free_given()
            super().connection_lost(exc)

        def _free_given(self) -> None:
            held.free(self._given)
            self._given = 0

    return BoundedWebSocket
