"""One HTTP request to an untrusted server: bounded in time and size, without redirects."""

from __future__ import annotations

import asyncio
import functools
import ssl
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from urllib.parse import urlsplit

import httpx


class Unreachable(Exception):  # noqa: N818  (a cause, not the error that is shown)
    """No server listens at the address."""


class NoAnswer(Exception):  # noqa: N818
    """The server did not answer completely and in time."""


def exchange(
    url: str, body: bytes | None, *, headers: Mapping[str, str], timeout_s: float, max_bytes: int, proxies: bool = True
) -> tuple[int, bytes]:
    """Status and body of the answer to a POST (without ``body``: a GET); reading stops soon after ``max_bytes``.

    Redirects are not followed, so that keys and pictures reach no other address than the trusted one.

    Args:
        timeout_s: from the first byte sent to the last one read.
        proxies: use the proxies named by environment variables.

    Raises:
        Unreachable: nothing listens there.
        NoAnswer: the answer broke off or took too long.
    """

    async def answered() -> tuple[int, bytes]:
        answer = bytearray()
        client = httpx.AsyncClient(timeout=timeout_s, verify=_machine_certificates(), trust_env=proxies)
        method = "GET" if body is None else "POST"
        async with (
            asyncio.timeout(timeout_s),
            client,
            client.stream(method, url, headers=dict(headers), content=body) as response,
        ):
            async for piece in response.aiter_raw():
                answer += piece
                if len(answer) > max_bytes:
                    break
        return response.status_code, bytes(answer)

    try:
        urlsplit(url).port  # noqa: B018  (raises for a port above 65535)
    except ValueError as error:
        raise Unreachable(str(error)) from error
    try:
        # In a thread: the caller's may run an event loop of its own (a notebook).
        with ThreadPoolExecutor(1, "request") as thread:
            return thread.submit(asyncio.run, answered()).result()
    except (httpx.ConnectError, httpx.UnsupportedProtocol, httpx.ProxyError, httpx.InvalidURL) as error:
        raise Unreachable(f"{type(error).__name__}: {error}") from error
    except TimeoutError:
        raise NoAnswer(f"TimeoutError: no whole answer within {timeout_s:g} s") from None
    except (httpx.HTTPError, OSError, UnicodeError) as error:  # UnicodeError: a host name
        raise NoAnswer(f"{type(error).__name__}: {error}") from error


@functools.cache
def _machine_certificates() -> ssl.SSLContext:
    return ssl.create_default_context()
