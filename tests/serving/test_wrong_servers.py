"""The Python client ends with one clear error, whatever answers."""

import socket
import struct
import threading
import time
from contextlib import contextmanager

import numpy as np
import pytest

msgpack = pytest.importorskip("msgpack")

from websockets.sync.server import serve

from worldline_core.errors import DataError, UnavailableError
from worldline_core.policies.openpi import pack
from worldline_core.serving.client import SimulatorClient

UPGRADE = b"HTTP/1.1 101 S\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
METADATA = {"protocol": 1}
STATE = {"num_frames": 1, "states": np.zeros((1, 1, 14)), "commands": np.zeros((1, 1, 14)), "tool_poses": np.zeros((1, 2, 4, 4), "f4")}  # fmt: skip
OPENED = STATE | {
    "session": "a", "frames_per_step": 4, "embodiment": "x", "state_names": ["a"], "pictures": {"head": np.zeros((1, 4, 6, 3), np.uint8)},
}  # fmt: skip
STEPPED = STATE | {"frames": {"head": np.zeros((1, 4, 4, 6, 3), np.uint8)}, "seconds": 0.1}


@pytest.mark.parametrize(
    "answer",
    [
        b"", b"220 ready\r\n", b"\x00\xff" * 500, b"HTTP/1.1 200 OK\r\nContent-Length: 2\r\n\r\nhi", b"HTTP/1.1 abc\r\n\r\n",
        b"HTTP/1.1 302 Found\r\nLocation: ws://127.0.0.1:9/x\r\nContent-Length: 0\r\n\r\n", b"HTTP/1.1 101 \xff\r\n\xff: \xff\r\n\r\n",
        UPGRADE + b"Sec-WebSocket-Accept: AAAA\r\n\r\n", UPGRADE + b"X: y\r\n" * 10_000, UPGRADE + b"X: " + b"y" * 100_000,
    ],
)  # fmt: skip
@pytest.mark.parametrize("hears", [True, False])
def test_servers_of_something_else(answer, hears, caplog):
    with socket.create_server(("127.0.0.1", 0)) as listening:

        def once():
            with listening.accept()[0] as connection:
                if hears:
                    connection.recv(4096)
                connection.sendall(answer)

        thread = threading.Thread(target=once)
        thread.start()
        with pytest.raises(UnavailableError, match=r"No server answers|refuses the connection"):
            SimulatorClient(f"ws://127.0.0.1:{listening.getsockname()[1]}", deadline_s=5)
        thread.join(5)
    # Other tests' tasks may end here with a word of asyncio's.
    assert not [record for record in caplog.records if record.name.startswith(("worldline_core", "websockets"))]


def changed(reply, **changes):
    return pack({name: value for name, value in (reply | changes).items() if value is not None})


@pytest.mark.parametrize(
    "replies",
    [
        *([changed({}, protocol=odd)] for odd in (None, 2, [1], "1")), [pack([1])], [pack({b"\xff": 1})],
        *([pack(METADATA), pack(odd)] for odd in ({}, [1], {"error": "no"}, {"error": {"kind": [1], "what": {"a": 1}}})),
        *([pack(METADATA), changed(OPENED, **{name: odd})] for name, odd in (
            ("session", 3), ("states", [1, 2]), ("states", np.zeros(3)), ("states", np.zeros((0, 1, 14))), ("frames_per_step", -1),
            ("pictures", {}), ("pictures", []), ("pictures", {"head": np.zeros((1, 4, 6, 3))}), ("state_names", "abc"),
            ("pictures", {"head": np.zeros((2, 4, 6, 3), np.uint8)}), ("num_frames", None),
        )),
        *([pack(METADATA), pack(OPENED), changed(STEPPED, **{name: odd})] for name, odd in (
            ("frames", None), ("frames", {}), ("frames", {"head": 3}), ("frames", {"head": np.zeros((1, 4, 6, 3), np.uint8)}),
            ("frames", {"head": np.zeros((2, 4, 4, 6, 3), np.uint8)}), ("frames", {"head": np.zeros((1, 3, 4, 6, 3), np.uint8)}),
            ("seconds", "x"), ("states", np.full((1, 4, 14), np.nan)), ("states", None),
        )),
        [pack(METADATA), pack(OPENED)],
    ],
)  # fmt: skip
def test_servers_that_answer_otherwise(replies):
    def handle(connection):
        for number, reply in enumerate(replies):
            if number:
                connection.recv()
            connection.send(reply)

    with answering(handle) as url, pytest.raises((UnavailableError, DataError), match=r"^[A-Z][^\n]+\n"):
        drive(url)


@pytest.mark.parametrize(
    "frame",  # a text, one that is no UTF-8, an unknown operation, reserved bits, a message of 2^62 bytes
    [b"\x81\x02hi", b"\x81\x02\xff\xfe", b"\x85\x00", b"\xc2\x01\x80", b"\x82\x7f" + struct.pack("!Q", 1 << 62)],
)
def test_frames_that_are_no_messages(frame):
    refused = pytest.raises((UnavailableError, DataError), match=r"reports an error|closed the connection|too large")
    with answering(lambda connection: connection.socket.sendall(frame)) as url, refused:
        drive(url)


def test_a_server_that_takes_nothing_is_given_up(monkeypatch):
    stop = threading.Event()
    monkeypatch.setattr("worldline_core.policies.openpi.CLOSE_S", 0.2)

    def handle(connection):
        connection.send(pack(METADATA))
        with connection.protocol_mutex:  # without it nothing is read
            stop.wait(10)

    with answering(handle) as url:
        client, begin = SimulatorClient(url, deadline_s=0.3), time.monotonic()
        with pytest.raises(UnavailableError, match="did not answer in time"):
            client.request({"x": np.zeros(30_000_000, np.uint8)})
        assert time.monotonic() - begin < 2
        stop.set()


@contextmanager
def answering(handle):
    with serve(handle, "127.0.0.1", 0, compression=None, max_size=None) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
        server.shutdown()


def drive(url):
    with SimulatorClient(url, deadline_s=5) as client:
        client.start("x").step(np.zeros((1, 4, 14)))
