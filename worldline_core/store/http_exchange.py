"""One request to a server that nobody vouches for: bounded in time and in size, and never sent on to another address."""

from __future__ import annotations

import asyncio
import functools
import ssl
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from urllib.parse import urlsplit

import httpx


class Unreachable(Exception):  # noqa: N818  (a cause, not the error that is shown)
    """There is no server at the address."""


class NoAnswer(Exception):  # noqa: N818
    """The server did not answer whole and in time."""


def exchange(
    url: str, body: bytes | None, *, headers: Mapping[str, str], timeout_s: float, max_bytes: int, proxies: bool = True
) -> tuple[int, bytes]:
    """Status and body of the answer to a POST (without ``body``: a GET), of which little more than ``max_bytes`` is read.

    Redirects are not followed: another address would be sent what this one was trusted with (keys, pictures).

    Args:
        timeout_s: from the first byte sent to the last one read.
        proxies: through those that environment variables name.

    Raises:
        Unreachable: nothing listens there.
        NoAnswer: the answer broke off, or took longer.
    """

    async def answered() -> tuple[int, bytes]:
        answer = bytearray()
        async with (
            asyncio.timeout(timeout_s),
            httpx.AsyncClient(
                timeout=timeout_s, verify=_trusted(), follow_redirects=False, trust_env=proxies
            ) as client,
            client.stream("GET" if body is None else "POST", url, headers=dict(headers), content=body) as response,
        ):
            async for piece in response.aiter_raw():
                answer += piece
                if len(answer) > max_bytes:
                    break
        return response.status_code, bytes(answer)

    try:
        urlsplit(url).port  # noqa: B018  # a number beyond those of ports raises
    except ValueError as error:
        raise Unreachable(str(error)) from error
    try:
        # In a thread: the caller's may have an event loop of its own (a notebook).
        with ThreadPoolExecutor(1, "request") as thread:
            return thread.submit(asyncio.run, answered()).result()
    except (httpx.ConnectError, httpx.UnsupportedProtocol, httpx.ProxyError) as error:
        raise Unreachable(f"{type(error).__name__}: {error}") from error
    except TimeoutError:
        raise NoAnswer(f"TimeoutError: no whole answer within {timeout_s:g} s") from None
    except (httpx.HTTPError, httpx.InvalidURL, OSError, UnicodeError) as error:  # UnicodeError: of a host's name
        raise NoAnswer(f"{type(error).__name__}: {error}") from error


@functools.cache
def _trusted() -> ssl.SSLContext:
    """The certificates of this machine."""
    return ssl.create_default_context()
