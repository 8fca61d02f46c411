"""Requests to untrusted servers, bounded in time and size and without redirects; snapshots of the Hugging Face hub."""

from __future__ import annotations

import asyncio
import functools
import os
import ssl
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx

from worldline_core.errors import UnavailableError

_trusted_authorities = functools.cache(ssl.create_default_context)
"""The system's certificates, which take 30 ms to read: longer than a small answer."""


class UnreachableError(Exception):
    """No server listens at the address."""


class IncompleteResponseError(Exception):
    """The server did not answer completely and in time."""


def exchange(
    url: str, body: bytes | None, *, headers: Mapping[str, str], timeout_s: float, max_bytes: int
) -> tuple[int, bytes]:
    """Status and body of the answer to a POST (without ``body``: a GET); reading stops soon after ``max_bytes``.

    Redirects are not followed, so that keys and pictures reach no other address than the trusted one. The deadline is
    that of the whole exchange, name resolution included.

    Raises: UnreachableError; IncompleteResponseError where the answer broke off or took too long.
    """

    async def answered() -> tuple[int, bytes]:
        answer = bytearray()
        async with (
            asyncio.timeout(timeout_s),
            httpx.AsyncClient(timeout=timeout_s, verify=_trusted_authorities()) as client,
            client.stream("GET" if body is None else "POST", url, headers=dict(headers), content=body) as response,
        ):
            async for piece in response.aiter_raw():
                answer += piece
                if len(answer) > max_bytes:
                    break
        return response.status_code, bytes(answer)

    try:
        urlsplit(url).port  # noqa: B018  (raises for a port above 65535)
        # Half a second to end by itself; only the resolution of a name cannot be cancelled.
        return within(timeout_s + 0.5, lambda: asyncio.run(answered()))
    except (httpx.ConnectError, httpx.UnsupportedProtocol, httpx.ProxyError, httpx.InvalidURL, ValueError) as error:
        raise UnreachableError(f"{type(error).__name__}: {error}") from error
    except (httpx.HTTPError, OSError) as error:
        detail = f"no whole answer within {timeout_s:g} s" if isinstance(error, TimeoutError) else error
        raise IncompleteResponseError(f"{type(error).__name__}: {detail}") from error


def within[T](seconds: float, call: Callable[[], T], *, discard: Callable[[T], object] = lambda late: None) -> T:
    """Returns the result of a call in a thread of its own, which is abandoned when the time is up; ``discard`` gets a late result.

    Raises: TimeoutError.
    """
    future: Future[T] = Future()

    def run() -> None:
        try:
            future.set_result(call())
        except BaseException as error:  # noqa: BLE001  (raised again where the result is waited for)
            future.set_exception(error)

    threading.Thread(target=run, name="bounded call", daemon=True).start()
    try:
        return future.result(seconds)
    except TimeoutError:
        future.add_done_callback(lambda late: late.exception() or discard(late.result()))
        raise


def hub_access() -> dict[str, Any]:
    """Address and token of the hub, from the environment alone."""
    # False: without a token the client would look for one that some other program stored.
    return {"endpoint": os.environ.get("HF_ENDPOINT"), "token": os.environ.get("HF_TOKEN") or False}


def hub_snapshot(repo_id: str, patterns: list[str], *, what: str, **options: Any) -> Path:
    """Folder with the files of a hub repository that fit ``patterns``; what was fetched before is not fetched again.

    Raises: UnavailableError: the hub does not give it.
    """
    from huggingface_hub import snapshot_download

    try:
        return Path(snapshot_download(repo_id, allow_patterns=patterns, **hub_access(), **options))
    except (httpx.HTTPError, OSError, ValueError) as error:  # which the client's own errors are
        raise UnavailableError(
            f"The hub does not give this {what}", where=repo_id,
            got=f"{type(error).__name__}: {next(iter(str(error).strip().splitlines()), '')}"[:300],
            expected="a folder of that name here, or the repository on the hub or in its local cache",
            next_step="check the name, the network and HF_TOKEN; offline, download it elsewhere and give its folder",
        ) from error  # fmt: skip
