"""Servers of a small random model and the shipped recordings."""

import threading
import time
from contextlib import contextmanager

import pytest

pytest.importorskip("msgpack")
pytest.importorskip("uvicorn")

from tests.rollout.conftest import shipped, small_world  # noqa: F401
from worldline_core.serving.app import make_server
from worldline_core.serving.serve_config import ServeConfig


@pytest.fixture(scope="session")
def serving(small_world, shipped):  # noqa: F811
    """``with serving(token=None, **settings) as url:`` a server on a free port, in a thread."""

    @contextmanager
    def serve(token=None, world=small_world, **settings):
        config = ServeConfig.model_validate({"port": 0, "episodes": shipped / "recordings", **settings})
        server = make_server(world, config, token)
        thread = threading.Thread(target=server.run)
        thread.start()
        deadline = time.monotonic() + 20
        while not server.started and thread.is_alive() and time.monotonic() < deadline:
            time.sleep(0.01)
        assert server.started
        try:
            yield f"ws://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
        finally:
            server.should_exit = True
            thread.join(20)
        assert not thread.is_alive()

    return serve
