"""The server's addresses, and who may reach them: ``/healthz``, ``/v1`` (requests over a websocket), and ``/play``, the page
to drive the simulator by hand.

Over the websocket the server first sends its metadata; then each request is one message and has one reply. The next request
is read once the reply was taken, so a client cannot pile up work.
"""

from __future__ import annotations

import asyncio
import hmac
import os
import secrets
import socket
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager, suppress
from typing import TYPE_CHECKING
from urllib.parse import parse_qs, urlsplit

import uvicorn
from starlette.applications import Starlette
from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from worldline_core.errors import ConfigError, DataError, UnavailableError
from worldline_core.pages.page import render
from worldline_core.policies.openpi import pack, unpack
from worldline_core.rollout.worldline import WorldLine
from worldline_core.serving.play_session import PlaySession
from worldline_core.serving.serve_config import TOKEN_VARIABLE, ServeConfig, is_loopback
from worldline_core.serving.session_host import SessionHost, error_message

if TYPE_CHECKING:
    from asyncio import Transport

TAKE_S = 30.0
"""Seconds within which a client must take a reply, and send the head of a request."""
KEYS = {
    "q": "down", "w": "away", "e": "up", "a": "left", "s": "near", "d": "right", "j": "turn left", "i": "tilt up",
    "l": "turn right", "u": "roll left", "k": "tilt down", "o": "roll right", "z": "close", "x": "open",
}  # fmt: skip
"""Keys and buttons of the page, and how each moves the chosen arm while it is held."""
OPEN_PATHS = ("/healthz", "/play")
"""Paths without a token: they reveal nothing of sessions. The page connects with the token in its own address."""


def make_app(host: SessionHost, token: str | None) -> ASGIApp:
    """The server as an ASGI application."""
    config, connections = host.config, set[int]()

    async def health(_: Request) -> Response:
        return PlainTextResponse("OK\n")

    async def metadata(_: Request) -> Response:
        return JSONResponse(host.metadata())

    async def page(_: Request) -> Response:
        html = render("serving/play.html", title="Play", subtitle="", script="serving/play.js", keys=KEYS.items())
        # Inside a frame of another site, visitors could be led to click here without knowing.
        return HTMLResponse(html, headers={"X-Frame-Options": "DENY"})

    def serving(serve: Callable[[WebSocket], Awaitable[None]]) -> Callable[[WebSocket], Awaitable[None]]:
        async def connected(websocket: WebSocket) -> None:
            await websocket.accept()
            if len(connections) >= config.max_connections:
                await websocket.close(1013, "too many connections, try again later")
                return
            connections.add(id(websocket))
            try:
                await serve(websocket)
            except WebSocketDisconnect:
                pass
            except TimeoutError:
                with suppress(WebSocketDisconnect, RuntimeError):  # gone already
                    await websocket.close(1008, "idle, or replies were not taken")
            finally:
                connections.discard(id(websocket))
                host.leave(websocket)

        return connected

    async def receive(websocket: WebSocket) -> Message:
        async with asyncio.timeout(config.idle_s):
            event = await websocket.receive()
        if event["type"] == "websocket.disconnect":
            raise WebSocketDisconnect
        return event

    async def messages(websocket: WebSocket) -> None:
        await send_in_time(websocket, pack(host.metadata()))
        while True:
            try:
                message = unpack((await receive(websocket)).get("bytes") or b"", "request")
            except DataError as error:
                # After a message that is not understood, the ones behind it may be misread.
                await send_in_time(websocket, pack({"error": error_message(error)}))
                await websocket.close(1007, "a message was not understood")
                return
            await send_in_time(websocket, pack(await host.handle(websocket, message)))

    async def played(websocket: WebSocket) -> None:
        session = PlaySession(host, lambda content: send_in_time(websocket, content))
        try:
            await session.greet()
            while True:
                await session.receive((await receive(websocket)).get("text") or "")
        finally:
            await session.close()

    @asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        yield
        host.shut_down()

    routes = [
        Route("/healthz", health),
        Route("/v1", metadata),
        WebSocketRoute("/v1", serving(messages)),
        Route("/play", page),
        WebSocketRoute("/play/session", serving(played)),
    ]
    return Gate(Starlette(routes=routes, lifespan=lifespan), config, token)


async def send_in_time(websocket: WebSocket, content: str | bytes) -> None:
    """Send one message. Raises: TimeoutError when the client does not take it."""
    async with asyncio.timeout(TAKE_S):
        await (websocket.send_text(content) if isinstance(content, str) else websocket.send_bytes(content))


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
    """Uvicorn's HTTP protocol with bounds that it lacks, so that silent connections cannot keep others out.

    Args:
        most: connections at a time, websockets too; others are closed at once.
        patience_s: a connection that is neither answered nor sends the head of a request is closed after once to twice
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


class QuietWebSocket(WebSocketsSansIOProtocol):
    """Uvicorn's websocket, which logs a traceback for a text that is no UTF-8; the connection ends with code 1007 all the same."""

    def send_receive_event_to_app(self) -> None:
        try:
            b"".join(self.frames).decode() if self.curr_msg_data_type == "text" else None
        except UnicodeDecodeError:
            self.conn.send_close(1007)
            self.handle_parser_exception()
            return
        super().send_receive_event_to_app()


def server_token(config: ServeConfig) -> str | None:
    """The token that clients must show, from the environment.

    Raises: ConfigError when others can reach the server, and there is none.
    """
    token = os.environ.get(TOKEN_VARIABLE, "").strip() or None
    if token is None and not is_loopback(config.host):
        raise ConfigError(
            "A server that others can reach needs a token", where=f"host {config.host}",
            expected=f"the environment variable {TOKEN_VARIABLE}", got="none",
            next_step=f"{TOKEN_VARIABLE}={secrets.token_urlsafe(24)} worldline serve ..., or listen at 127.0.0.1",
        )  # fmt: skip
    return token


def listening_socket(config: ServeConfig) -> socket.socket:
    """A socket bound to the configured host and port, which refuses connections until a server runs on it.

    Raises: UnavailableError when the port is taken, or the host is not this machine's.
    """
    try:
        found = socket.getaddrinfo(config.host, config.port, type=socket.SOCK_STREAM)
        family, kind, protocol, _, address = min(found, key=lambda one: one[0] != socket.AF_INET)
        made = socket.socket(family, kind, protocol)
        made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        made.bind(address)
    except OSError as error:
        raise UnavailableError(
            "The server could not listen", where=f"{config.host}:{config.port}", got=error.strerror,
            next_step="end the program that listens there, or take another port: --set port=... (0 takes a free one)",
        ) from error  # fmt: skip
    return made


def make_server(world: WorldLine, config: ServeConfig, token: str | None) -> uvicorn.Server:
    """A uvicorn server, started by ``run()``, with the limits and timeouts of the configuration."""
    host = SessionHost(world, config)
    host.warm_up()
    settings = uvicorn.Config(
        make_app(host, token), config.host, config.port, http=patient_http(2 * config.max_connections, TAKE_S),
        ws=QuietWebSocket, ws_max_size=config.max_message_bytes, ws_per_message_deflate=False, ws_ping_interval=10.0,
        ws_ping_timeout=20.0, timeout_keep_alive=30, timeout_graceful_shutdown=3, access_log=False, log_level="warning",
        server_header=False,
    )  # fmt: skip
    return uvicorn.Server(settings)
