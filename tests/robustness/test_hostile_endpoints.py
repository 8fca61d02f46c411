"""A judge's server that hangs, trickles, floods, breaks off, leads elsewhere, or repeats the key."""

from __future__ import annotations

import contextlib
import json
import re
import socket
import threading
import time
from collections.abc import Callable, Iterator
from urllib.parse import quote

import pytest

from worldline_core.errors import ConfigError, UnavailableError
from worldline_core.evaluation.evaluation_config import VLMConfig
from worldline_core.evaluation.policy.judge import GraspEvidence
from worldline_core.evaluation.vlm import OpenAICompatibleModel, Text, parse_answer
from worldline_core.evaluation.vlm import ask as ask_model

KEY = "key-of-the-judge"
OK = b"HTTP/1.1 200 OK\r\n"


class Endpoint:
    """A server that does with a connection what a test says."""

    def __init__(self, behave: Callable[[socket.socket], None]) -> None:
        self.requests: list[bytes] = []
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self._listening.getsockname()[1]}/v1"
        self._behave = behave
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                threading.Thread(target=self._answer, args=(self._listening.accept()[0],), daemon=True).start()

    def _answer(self, connection: socket.socket) -> None:
        with connection, contextlib.suppress(OSError):
            request = connection.recv(65536)
            # The body comes by itself. A connection that is closed with something unread is reset, its answer with it.
            if length := re.search(rb"(?i)\r\ncontent-length: (\d+)", request):
                while len(request.partition(b"\r\n\r\n")[2]) < int(length[1]) and (more := connection.recv(65536)):
                    request += more
            self.requests.append(request)
            self._behave(connection)

    def close(self) -> None:
        self._listening.close()


@pytest.fixture
def serve(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[Callable[[socket.socket], None]], Endpoint]]:
    monkeypatch.setenv("JUDGE", KEY)
    opened: list[Endpoint] = []

    def make(behave: Callable[[socket.socket], None]) -> Endpoint:
        opened.append(Endpoint(behave))
        return opened[-1]

    yield make
    for endpoint in opened:
        endpoint.close()


def ask(endpoint: Endpoint) -> str:
    """Return the error message, which comes within a few seconds."""
    config = VLMConfig(url=endpoint.url, timeout_s=0.3, attempts=1, api_key_variable="JUDGE")
    began = time.monotonic()
    with pytest.raises(UnavailableError) as caught:
        OpenAICompatibleModel(config, backoff_s=0.01).answer([Text("?")])
    assert time.monotonic() - began < 4
    return str(caught.value)


def answer(content: bytes) -> Callable[[socket.socket], None]:
    return lambda connection: connection.sendall(content)


def trickle(connection: socket.socket, start: bytes) -> None:
    connection.sendall(start)
    for _ in range(100):
        connection.sendall(b"x")
        time.sleep(0.1)


def flood(connection: socket.socket) -> None:
    connection.sendall(OK + b"\r\n" + b'{"a": "')
    for _ in range(1000):
        connection.sendall(b"x" * 65536)


def hang(connection: socket.socket) -> None:
    time.sleep(10)


def promise(connection: socket.socket) -> None:
    """Answers to come, for as long as somebody listens."""
    while True:
        connection.sendall(b"HTTP/1.1 100 Continue\r\n\r\n" * 1000)


@pytest.mark.parametrize(
    ("behave", "said"),
    [
        (hang, "no whole answer within 0.3 s"),
        *((lambda c, start=start: trickle(c, start), "no whole answer within 0.3 s") for start in (b"", OK + b"X: ", OK + b"\r\n")),
        (flood, "more than 1,048,576 bytes"),
        (promise, ""),
    ],
)  # fmt: skip
def test_an_answer_that_does_not_end_is_given_up_in_time(serve: Callable, behave: Callable, said: str) -> None:
    ended = threading.Event()

    def watched(connection: socket.socket) -> None:
        try:
            behave(connection)
        finally:
            ended.set()

    assert said in ask(serve(watched))
    # Given up and not closed, the connection would go on in a thread of its own.
    assert behave is hang or ended.wait(2)


@pytest.mark.parametrize(
    "content",
    [
        b"", b"\r\n\r\n", b"\xff\xfe nonsense\r\n\r\n", OK + b"Content-Length: 100\r\n\r\n{}",
        OK + b"Transfer-Encoding: chunked\r\n\r\nzz\r\n", OK + b"X: " + b"y" * 70_000 + b"\r\n\r\n",
        OK + b"Transfer-Encoding: chunked\r\n\r\n-1\r\n" + b"x" * 3_000_000,
        b"HTTP/1.1 302 Found\r\nLocation: http://[half\r\n\r\n", OK + b"Content-Encoding: gzip\r\n\r\nno gzip",
        OK + b"Content-Length: -1\r\n\r\n{}", OK + b"\r\n\xff\xfe\x00\xd8", OK + b"\r\n" + b"[1," * 50_000,
        OK + b"\r\n" + b"[" * 100_000, OK + b"\r\n\xff\xfe", OK + b"\r\n" + b"9" * 5000, OK + b"\r\n[]", OK + b"\r\nnull",
    ],
)  # fmt: skip
def test_answers_that_are_none_are_named(serve: Callable, content: bytes) -> None:
    endpoint = serve(answer(content))
    assert "The judge's server" in ask(endpoint)
    # And the verdict is null, and counted.
    config = VLMConfig(url=endpoint.url, timeout_s=0.3, attempts=1, api_key_variable="JUDGE")
    if content.startswith(OK + b"\r\n[1,"):
        assert ask_model(OpenAICompatibleModel(config), [Text("?")], GraspEvidence) == (GraspEvidence(), False)


@pytest.mark.parametrize("status", [301, 302, 303, 307, 308])
def test_the_key_goes_nowhere_else(serve: Callable, status: int) -> None:
    thief = serve(answer(OK + b"\r\n{}"))
    moved = f"HTTP/1.1 {status} Moved\r\nLocation: {thief.url}/x\r\n\r\n".encode()
    assert f"HTTP {status}" in ask(serve(answer(moved)))
    assert thief.requests == []


@pytest.mark.parametrize("key", [KEY, "key\\/of\\/thejudge's"])
@pytest.mark.parametrize("written", [str, repr, json.dumps, quote, lambda key: " " * 485 + key])
def test_a_key_is_hidden_in_whatever_form_it_is_repeated(
    serve: Callable, monkeypatch: pytest.MonkeyPatch, key: str, written: Callable[[str], str]
) -> None:
    monkeypatch.setenv("JUDGE", key)
    told = ask(serve(answer(b"HTTP/1.1 401 No\r\n\r\nwrong: " + written(key).encode() + b" here")))
    assert "HTTP 401" in told
    assert written(key).strip()[:8] not in told


@pytest.mark.parametrize("around", ["{}\r", " {}\r\n", "{}\n", "\t{}"])
def test_white_space_around_a_key_is_not_sent(serve: Callable, monkeypatch: pytest.MonkeyPatch, around: str) -> None:
    monkeypatch.setenv("JUDGE", around.format(KEY))
    endpoint = serve(answer(OK + b"\r\n[]"))
    ask(endpoint)
    assert f"bearer {KEY}\r\n".encode() in endpoint.requests[0].lower()


@pytest.mark.parametrize("key", ["two\rlines-of-a-key", "key\x7f-of-the-judge", "schl\u00fcssel", "two words"])
def test_a_key_that_no_request_carries_is_refused_unseen(monkeypatch: pytest.MonkeyPatch, key: str) -> None:
    monkeypatch.setenv("JUDGE", key)
    with pytest.raises(ConfigError, match="the environment variable JUDGE") as caught:
        OpenAICompatibleModel(VLMConfig(url="http://127.0.0.1:9", api_key_variable="JUDGE"))
    assert key[:3] not in str(caught.value).replace("The judge's key cannot be sent", "")


@pytest.mark.parametrize(
    "text",
    [
        "[1," * 50_000, '{"a":[1,' * 50_000, '{"a":' * 900 + "x", '{"a": "' * 5000, '{"a": ' * 3000, "{" * 100_000,
        '{"a": ' + "9" * 5000 + "}",
    ],
    ids=lambda text: text[:9],
)  # fmt: skip
def test_a_hostile_answer_is_no_evidence(text: str) -> None:
    began = time.monotonic()
    assert parse_answer(GraspEvidence, text) == (GraspEvidence(), False)
    assert time.monotonic() - began < 5
