"""The openpi client against a server that is written here from the protocol's description, with its own array code."""

import math
import socket
import struct
import threading
import time
from contextlib import contextmanager

import numpy as np
import pytest

msgpack = pytest.importorskip("msgpack")

from websockets.sync.server import serve

from worldline_core.errors import ConfigError, DataError, UnavailableError
from worldline_core.http_exchange import IncompleteResponseError, exchange
from worldline_core.policies.openpi import OpenpiPolicy, pack, unpack
from worldline_core.serving.client import SimulatorClient


def encode(value):
    """Arrays as openpi's protocol describes them, independently of the project's code."""
    if isinstance(value, dict):
        return {name: encode(each) for name, each in value.items()}
    if isinstance(value, np.ndarray):
        shape = list(value.shape)
        return {b"__ndarray__": True, b"data": value.tobytes("C"), b"dtype": value.dtype.str, b"shape": shape}
    return value


def decode(value):
    if isinstance(value, dict) and value.get(b"__ndarray__"):
        return np.ndarray(value[b"shape"], np.dtype(value[b"dtype"]), value[b"data"])
    if isinstance(value, dict):
        return {name: decode(each) for name, each in value.items()}
    return value


@contextmanager
def policy_server(answer, *, metadata=None, key=None):
    """An openpi policy server: metadata first, a reply for every observation, errors as a text and code 1011."""

    def handle(connection):
        connection.send(msgpack.packb({"name": "scripted"} if metadata is None else metadata))
        for message in connection:
            begin = time.monotonic()
            try:
                found = answer(decode(msgpack.unpackb(message)))
            except RuntimeError as error:
                connection.send(f"Traceback: RuntimeError: {error}")
                connection.close(1011, "Internal server error. Traceback included in previous frame.")
                return
            if found is None:
                connection.socket.shutdown(socket.SHUT_RDWR)  # vanished
                return
            if isinstance(found, dict):
                timing = {"infer_ms": 1e3 * (time.monotonic() - begin)}
                found = msgpack.packb(encode({**found, "server_timing": timing}))
            for each in found if isinstance(found, list) else [found]:
                connection.send(each)

    def check(connection, request):
        if key is not None and request.headers.get("Authorization") != f"Api-Key {key}":
            return connection.respond(401, "no\n")
        return None

    with serve(handle, "127.0.0.1", 0, compression=None, max_size=None, process_request=check) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
        server.shutdown()
    thread.join(5)


def test_many_chunks():
    seen = []

    def answer(observation):
        seen.append(observation)
        return {"actions": observation["state"][None] + np.arange(8, dtype=np.float32)[:, None]}

    with policy_server(answer, key="abc") as url:
        with OpenpiPolicy(url, api_key="abc") as policy:
            assert policy.metadata == {"name": "scripted"}
            state = np.zeros(14, np.float32)
            for chunk in range(20):
                picture = np.full((4, 6, 3), chunk, np.uint8)
                reply = policy.infer({"state": state, "images": {"head": picture}, "prompt": "lift it"})
                assert (reply["actions"].shape, reply["actions"].dtype) == ((8, 14), np.float64)
                assert reply["server_timing"]["infer_ms"] >= 0
                state = reply["actions"][-1].astype(np.float32)
        assert state[0] == 140
        assert [found["images"]["head"].mean() for found in seen] == list(range(20))
        assert seen[3]["prompt"] == "lift it"
        with pytest.raises(UnavailableError, match=r"(?s)refuses the connection.*401.*API key"):
            OpenpiPolicy(url)
    with pytest.raises(UnavailableError, match=r"(?s)No server answers.*start it"):
        OpenpiPolicy(url, deadline_s=2)


def fails(_):
    raise RuntimeError("no such camera: cam_high; wrong key abc")


def actions(array):
    return lambda _: {"actions": array}


@pytest.mark.parametrize(
    ("answer", "error", "match"),
    [
        (fails, UnavailableError, r"(?s)reports an error.*no such camera: cam_high"),
        (lambda _: None, UnavailableError, r"(?s)closed the connection.*connect again"),
        (lambda _: b"\xc1\xff", DataError, "not understood"),
        (lambda _: msgpack.packb([1, 2]), DataError, r"(?s)message is no map.*list"),
        (lambda _: {}, DataError, r"(?s)actions are no chunk.*NoneType"),
        (actions(np.zeros(8)), DataError, r"(?s)actions are no chunk.*float64 \(8,\)"),
        (actions(np.zeros((0, 14))), DataError, "actions are no chunk"),
        (actions(np.zeros((1025, 14))), DataError, r"(?s)no chunk.*1 to 1024.*\(1025, 14\)"),
        (actions(np.zeros((2, 0))), DataError, "actions are no chunk"),
        (actions(np.array([["a"]])), DataError, r"(?s)actions are no chunk.*<U1"),
        (actions(np.array([[0.0, np.nan]])), DataError, r"not finite\n.*step 0, column 1"),
        (actions(np.zeros((1 << 16, 14))), DataError, r"(?s)too large.*1,000,000 bytes"),
    ],
)
def test_bad_servers_are_named(answer, error, match):
    given = policy_server(answer)
    with given as url, OpenpiPolicy(url, max_bytes=1_000_000) as policy, pytest.raises(error, match=match):
        policy.infer({"state": np.zeros(3)})


def test_a_deadline_is_for_the_whole_exchange():
    stop = threading.Event()

    def trickle(_):
        """One reply in fragments that never ends."""
        while not stop.wait(0.05):
            yield b"\x00"

    with policy_server(trickle) as url, OpenpiPolicy(url) as policy:
        policy.deadline_s, begin = 0.3, time.monotonic()
        with pytest.raises(UnavailableError, match=r"(?s)did not answer in time.*within 0.3 s"):
            policy.infer({})
        assert time.monotonic() - begin < 2
        stop.set()
        with pytest.raises(UnavailableError, match="closed the connection"):
            policy.infer({})
    with policy_server(lambda _: {}, metadata=[1]) as url, pytest.raises(DataError, match="message is no map"):
        OpenpiPolicy(url)


@pytest.mark.parametrize("client", ["policy", "simulator", "judge"])
def test_a_deadline_begins_before_names_are_resolved(client, monkeypatch):
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: stop.wait(10))
    stop, begin = threading.Event(), time.monotonic()
    with pytest.raises((UnavailableError, IncompleteResponseError), match=r"within 0\.3 s"):
        if client == "judge":
            exchange("http://judge.example/v1", None, headers={}, timeout_s=0.3, max_bytes=100)
        else:
            (OpenpiPolicy if client == "policy" else SimulatorClient)("ws://far.example:1", deadline_s=0.3)
    assert time.monotonic() - begin < 2
    stop.set()


@pytest.mark.parametrize("key", ["abc\r\nX-Evil: 1", "\0", "schl\u00fcssel"])
def test_a_key_that_no_header_can_carry_is_refused_unseen(key):
    with pytest.raises(ConfigError, match="The header Authorization cannot be sent") as caught:
        OpenpiPolicy("ws://127.0.0.1:9", api_key=key)
    assert key[:3] not in str(caught.value)


def test_a_key_is_sent_without_white_space_and_never_shown(caplog):
    refused = pytest.raises(UnavailableError, match=r"wrong key \*\*\*")
    with policy_server(fails, key="abc") as url, OpenpiPolicy(url, api_key="abc\r") as policy, refused as caught:
        policy.infer({})
    assert "abc" not in str(caught.value) + caplog.text


@pytest.mark.parametrize("url", ["ws://[half", "ws://127.0.0.1:99999", f"ws://{'a' * 70}", "ws://\ud800", "ws://"])
def test_an_address_that_is_none_is_named(url):
    with pytest.raises(UnavailableError, match="No server answers"):
        OpenpiPolicy(url, deadline_s=2)


@pytest.mark.parametrize("dtype", ["?", "u1", "<i8", ">i4", "<f2", "<f4", "<f8", "S3", "<U5"])
def test_arrays_come_back_as_they_were(dtype):
    values = np.arange(12).reshape(3, 4).astype(dtype)
    given = {"a": values, "t": values.T, "empty": values[:0], "one": values[0, 0], "zero": np.array(values[0, 0])}
    found = unpack(pack(given), "here")
    for name, array in given.items():
        assert np.array_equal(found[name], array), name
        assert np.asarray(found[name]).dtype == np.asarray(array).dtype, name
    assert np.array_equal(decode(msgpack.unpackb(pack({"a": values})))["a"], values)
    found["a"][0, 0] = found["a"][1, 1]  # a copy, not the message's own bytes


def _described(dtype="<f4", shape=(2,), data=b"\0" * 8):
    return msgpack.packb({"x": {b"__ndarray__": True, b"data": data, b"dtype": dtype, b"shape": shape}})


@pytest.mark.parametrize(
    "content",
    [
        _described("|O"), _described("|V8"), _described("<c8"), _described("f4,f4"), _described("O,f4"), _described(3),
        _described("<M8[s]"), _described("no such"), _described("U0", (1 << 40,), b""), _described(shape=(3,)),
        _described(shape=(-1, -2)), _described(shape=(1 << 62, 4)), _described(shape=(0, 1 << 63), data=b""),
        _described(shape=(1,) * 70, data=b"\0" * 4), _described(shape="2"), _described(shape=(2.0,)), _described(data="text"),
        msgpack.packb({b"__ndarray__": True}), msgpack.packb({b"__npgeneric__": True, b"dtype": "|O", b"data": 1}),
        msgpack.packb({b"__npgeneric__": True, b"dtype": "u1", b"data": 300}),
        # A number in the place of a text is its length: four gigabytes in 40 bytes.
        msgpack.packb({b"__npgeneric__": True, b"dtype": "S5", b"data": 1 << 32}),
        msgpack.packb({b"__npgeneric__": True, b"dtype": "<f8", b"data": None}),
        _described("(1f4,f4"), _described("(,)f4"), _described("01f4,f4"), _described("(99999999,)f4"), _described("g"),
        b"", b"\xc1", b"\xdf\xff\xff\xff\xff", b"\x91" * 3000, b"\x93\x01", b"\x01\x02", msgpack.packb(msgpack.ExtType(4, b"x")),
        msgpack.packb([[]] * 65_537), msgpack.packb([{str(n): 1 for n in range(60_000)}, *[[0] * 65_000] * 16]), b"\xdc\xff\xff" + b"\xdc\xff\xff" * 9, b"\x81\xa1a\xa2\xff\xfe",
        struct.pack(">BI", 0xC6, 1 << 31),
    ],
)  # fmt: skip
def test_hostile_messages_are_refused(content):
    with pytest.raises(DataError, match="A message is not understood"):
        unpack(content, "somebody")


def test_what_cannot_be_sent_is_named():
    for wrong in (np.array([object()]), np.zeros(2, "V4"), np.complex64(1), {1, 2}, math, 1 << 70):
        with pytest.raises(DataError, match="cannot be sent"):
            pack({"x": wrong})
