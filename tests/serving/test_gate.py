"""What all requests to the server hold together, while they arrive and until they are answered."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress

import httpx
import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from worldline_core.serving.client import SimulatorClient

EPISODE = "ur5e_silver-test-s1-00000"


def test_all_requests_together_hold_no_more_than_is_allowed(serving: Callable) -> None:
    with serving(max_message_bytes=1 << 20, max_held_bytes=1 << 20, idle_s=5.0) as url:
        web, half = url.replace("ws", "http"), b"0" * (700 << 10)
        with SimulatorClient(url) as client, connect(url + "/v1", proxy=None, max_size=None) as holder:
            holder.recv()
            stop, sent = threading.Event(), threading.Event()

            def parts() -> Iterator[bytes]:
                yield half
                sent.set()
                stop.wait(20)

            thread = threading.Thread(target=lambda: suppressed(lambda: holder.send(parts())))
            thread.start()
            assert sent.wait(5)
            time.sleep(0.3)  # what was sent is read
            refused = httpx.post(f"{web}/v1", content=half)
            assert (refused.status_code, refused.headers["retry-after"]) == (503, "1")
            with connect(url + "/v1", proxy=None, max_size=None) as other:
                other.recv()
                with pytest.raises(ConnectionClosed, match="1013"):
                    suppressed(lambda: other.send(half))
                    other.recv()
            simulation = client.start(EPISODE)  # a small request is always taken
            simulation.step(np.repeat(simulation.state[:, None], 4, axis=1))
            holder.socket.shutdown(socket.SHUT_RDWR)
            stop.set()
            thread.join(10)
        time.sleep(0.3)
        assert httpx.post(f"{web}/v1", content=half).status_code == 400  # there is room again; it is no request


def suppressed(work: Callable[[], object]) -> None:
    """Send to a server that may close the connection meanwhile."""
    with suppress(ConnectionClosed):
        work()
