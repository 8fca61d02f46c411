"""Who may reach the server: checks of host, origin and token before anything else is done with a request."""

from __future__ import annotations

import hmac
from typing import TYPE_CHECKING
from urllib.parse import parse_qs, urlsplit

from starlette.datastructures import Headers
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from worldline_core.serving.serve_config import ServeConfig, is_loopback

if TYPE_CHECKING:
    from asyncio import Transport

OPEN_PATHS = ("/healthz", "/play")
"""Need no token: they say nothing of sessions. The page connects with the token that its own address carries."""


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
