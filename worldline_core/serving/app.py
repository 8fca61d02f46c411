"""The server's addresses: ``/healthz``, ``/v1`` (requests over a websocket or HTTP), and ``/play``, the page to drive it by hand.

Over the websocket the server first sends its metadata; then each request is one message and has one reply. The next request
is read when the reply was taken, so a client cannot pile up work.
"""

from __future__ import annotations

import asyncio
import os
import secrets
import socket
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager, suppress

import uvicorn
from starlette.applications import Starlette
from starlette.requests import ClientDisconnect, Request
from starlette.responses import HTMLResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp
from starlette.websockets import WebSocket, WebSocketDisconnect

from worldline_core.errors import ConfigError, DataError, UnavailableError
from worldline_core.pages.page import render
from worldline_core.policies.array_messages import pack, unpack
from worldline_core.rollout.worldline import WorldLine
from worldline_core.serving.gate import Gate, HeldBytes, bounded_websocket, patient_http
from worldline_core.serving.play_session import PlaySession
from worldline_core.serving.serve_config import TOKEN_VARIABLE, ServeConfig
from worldline_core.serving.session_host import SessionHost, error_message

MEDIA_TYPE = "application/msgpack"
TAKE_S = 30.0
"""Seconds within which a client must take a reply, and send a body."""
_STATUS = {"BusyError": 503}


def make_app(host: SessionHost, token: str | None, held: HeldBytes) -> ASGIApp:
    """The server as an ASGI application; what its requests hold is counted in `held`."""
    config, connections = host.config, set[int]()
    over_http = object()  # owns the sessions that were started over HTTP

    async def health(_: Request) -> Response:
        return PlainTextResponse("OK\n")

    async def metadata(_: Request) -> Response:
        return JSONResponse(host.metadata())

    async def request(http: Request) -> Response:
        body = bytearray()
        try:
            return await answered(http, body)
        finally:
            held.free(len(body))

    async def answered(http: Request, body: bytearray) -> Response:
        try:
            async with asyncio.timeout(TAKE_S):
                async for part in http.stream():
                    if not held.take(len(body), len(part)):
                        late = "too much is being received, try again later\n"
                        return PlainTextResponse(late, 503, {"connection": "close", "retry-after": "1"})
                    body += part
                    if len(body) > config.max_message_bytes:
                        return PlainTextResponse("the request is too large\n", 413, {"connection": "close"})
        except (TimeoutError, ClientDisconnect):
            return PlainTextResponse("the request did not come in time\n", 408, {"connection": "close"})
        try:
            reply = await host.handle(over_http, unpack(bytes(body), "request"))
        except DataError as error:
            reply = {"error": error_message(error)}
        status = _STATUS.get(reply["error"]["kind"], 400) if "error" in reply else 200
        return Response(pack(reply), status, media_type=MEDIA_TYPE)

    async def connected(websocket: WebSocket, serve: Callable[[WebSocket], Awaitable[None]]) -> None:
        """Serve a connection until it ends, from either side."""
        if len(connections) >= config.max_connections:
            await websocket.accept()
            await websocket.close(1013, "too many connections, try again later")
            return
        connections.add(id(websocket))
        try:
            await websocket.accept()
            await serve(websocket)
        except WebSocketDisconnect:
            pass
        except TimeoutError:
            with suppress(WebSocketDisconnect, RuntimeError):  # gone already
                await websocket.close(1008, "idle, or replies were not taken")
        finally:
            connections.discard(id(websocket))
            host.leave(websocket)

    async def messages(websocket: WebSocket) -> None:
        await send_in_time(websocket, pack(host.metadata()))
        while True:
            async with asyncio.timeout(config.idle_s):
                found = await websocket.receive()
            if found["type"] == "websocket.disconnect":
                return
            try:
                message = unpack(found.get("bytes") or b"", "request")
            except DataError as error:
                # After a message that is not understood, the ones behind it may be misread.
                await send_in_time(websocket, pack({"error": error_message(error)}))
                await websocket.close(1007, "a message was not understood")
                return
            await send_in_time(websocket, pack(await host.handle(websocket, message)))

    async def page(_: Request) -> Response:
        html = render("serving/play.html", title="Play", subtitle="", script="serving/play.js")
        # Inside a frame of another site, visitors could be led to click here without knowing.
        return HTMLResponse(html, headers={"X-Frame-Options": "DENY"})

    async def played(websocket: WebSocket) -> None:
        async def send(content: str | bytes) -> None:
            async with asyncio.timeout(TAKE_S):
                await (websocket.send_text(content) if isinstance(content, str) else websocket.send_bytes(content))

        session = PlaySession(host, send)
        try:
            await session.greet()
            while True:
                async with asyncio.timeout(config.idle_s):
                    found = await websocket.receive()
                if found["type"] == "websocket.disconnect":
                    return
                await session.receive(found.get("text") or "")
        finally:
            await session.close()

    async def play(websocket: WebSocket) -> None:
        await connected(websocket, played)

    async def api(websocket: WebSocket) -> None:
        await connected(websocket, messages)

    @asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        reaper = asyncio.create_task(host.close_idle())
        yield
        reaper.cancel()
        host.shut_down()

    routes = [
        Route("/healthz", health),
        Route("/v1", metadata, methods=["GET"]),
        Route("/v1", request, methods=["POST"]),
        WebSocketRoute("/v1", api),
        Route("/play", page),
        WebSocketRoute("/play/session", play),
    ]
    return Gate(Starlette(routes=routes, lifespan=lifespan), config, token)


async def send_in_time(websocket: WebSocket, content: bytes) -> None:
    """Send to a client that reads.

    Raises: TimeoutError for one that does not.
    """
    async with asyncio.timeout(TAKE_S):
        await websocket.send_bytes(content)


def server_token(config: ServeConfig) -> str | None:
    """The token that clients must show, from the environment.

    Raises: ConfigError when others can reach the server, and there is none.
    """
    token = os.environ.get(TOKEN_VARIABLE, "").strip() or None
    if token is None and not config.on_loopback:
        raise ConfigError(
            "A server that others can reach needs a token", where=f"host {config.host}",
            expected=f"the environment variable {TOKEN_VARIABLE}", got="none",
            next_step=f"{TOKEN_VARIABLE}={secrets.token_urlsafe(24)} worldline serve ..., or listen at 127.0.0.1",
        )  # fmt: skip
    return token


def listening_socket(config: ServeConfig) -> socket.socket:
    """Bound to the configured host and port; nobody is answered before a server runs on it.

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
    """A server that ``run()`` starts; its limits and timeouts are those of the configuration."""
    host, held = SessionHost(world, config), HeldBytes(config.max_held_bytes)
    host.warm_up()
    settings = uvicorn.Config(
        make_app(host, token, held), config.host, config.port, http=patient_http(2 * config.max_connections, TAKE_S),
        ws=bounded_websocket(held), ws_max_size=config.max_message_bytes, ws_per_message_deflate=False, ws_ping_interval=10.0, ws_ping_timeout=20.0,
        timeout_keep_alive=30, timeout_graceful_shutdown=3, access_log=False, log_level="warning", server_header=False,
    )  # fmt: skip
    return uvicorn.Server(settings)
