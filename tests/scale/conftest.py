"""An S3 server that can be told to misbehave, and the Prefect server for jobs of these tests."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest

from worldline_core.store import remote

sys.path.insert(0, str(Path(__file__).parent))  # workers import the jobs of these tests by name

BUCKET = "recordings"
FAULTS = {"busy": ("503 Service Unavailable", "SlowDown"), "broken": ("500 Internal Server Error", "InternalError")}
"""Status line and code of the error, by name."""
ENVIRONMENT = {
    "AWS_ACCESS_KEY_ID": "testing", "AWS_SECRET_ACCESS_KEY": "testing", "AWS_DEFAULT_REGION": "us-east-1",
    "AWS_EC2_METADATA_DISABLED": "true", "AWS_MAX_ATTEMPTS": "3",
}  # fmt: skip


class ObjectStore:
    """An S3 server on this machine, moto's over real HTTP, behind a gate.

    Attributes:
        misbehave: is asked before each request and may answer in its place.
        client: a file system of this server, once its address is known.
        requests: (method, path) of all requests so far.
    """

    def __init__(self) -> None:
        from moto.moto_server.werkzeug_app import DomainDispatcherApplication, create_backend_app
        from werkzeug.serving import make_server

        self._moto = DomainDispatcherApplication(create_backend_app)
        self._server = make_server("127.0.0.1", 0, self, threaded=True)
        self.url = f"http://127.0.0.1:{self._server.server_port}"
        self.requests: list[tuple[str, str]] = []
        self.client: Any = None
        self.misbehave: Callable[[str, str], str | None] = lambda method, path: None
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    def __call__(self, environ: dict[str, Any], start_response: Callable[..., Any]) -> Iterable[bytes]:
        method, path = environ["REQUEST_METHOD"], environ["PATH_INFO"]
        self.requests.append((method, path))
        fault = self.misbehave(method, path)
        if fault in FAULTS:
            status, code = FAULTS[fault]
            start_response(status, [("Content-Type", "application/xml")])
            return [f"<Error><Code>{code}</Code><Message>We encountered an error</Message></Error>".encode()]
        if fault == "hang up":
            environ["werkzeug.socket"].shutdown(2)
            return []
        return self._moto(environ, start_response)

    def upload(self, folder: Path, prefix: str) -> str:
        """Copy a folder into the bucket; returns its URL."""
        self.client.put(f"{folder}/", f"{BUCKET}/{prefix}/", recursive=True)
        return f"s3://{BUCKET}/{prefix}"

    def close(self) -> None:
        self._server.shutdown()
        self._thread.join()


@pytest.fixture(scope="session")
def prefect_server(prefect_server: None) -> Iterator[None]:
    """The server of all tests; processes that are started here can import the jobs of these tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(Path(__file__).parent), prepend=os.pathsep)
        yield


@pytest.fixture(scope="session")
def store_server() -> Iterator[ObjectStore]:
    pytest.importorskip("moto", reason="the dependency group `scale` is not installed")
    s3fs = pytest.importorskip("s3fs")
    server = ObjectStore()
    with pytest.MonkeyPatch.context() as patch:
        for name, value in (ENVIRONMENT | {"AWS_ENDPOINT_URL": server.url}).items():
            patch.setenv(name, value)
        s3fs.S3FileSystem.clear_instance_cache()
        server.client = s3fs.S3FileSystem()
        server.client.mkdir(BUCKET)
        yield server
        server.close()
        s3fs.S3FileSystem.clear_instance_cache()


@pytest.fixture
def store(store_server: ObjectStore) -> Iterator[ObjectStore]:
    remote.process_cache.cache_clear()
    yield store_server
    store_server.misbehave = lambda method, path: None
