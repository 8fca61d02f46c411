from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from worldline_core.store import remote

sys.path.insert(0, str(Path(__file__).parent))  # workers import the jobs of these tests by name


@pytest.fixture(scope="session")
def prefect_server(prefect_server: None) -> Iterator[None]:
    """The server of all tests; processes that are started here can import the jobs of these tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(Path(__file__).parent), prepend=os.pathsep)
        yield


@pytest.fixture(scope="session")
def store_server() -> Iterator[object]:
    pytest.importorskip("moto", reason="the dependency group `scale` is not installed")
    s3fs = pytest.importorskip("s3fs")
    from object_store import CREDENTIALS, ObjectStore

    server = ObjectStore()
    with pytest.MonkeyPatch.context() as patch:
        for name, value in (CREDENTIALS | {"AWS_ENDPOINT_URL": server.url}).items():
            patch.setenv(name, value)
        s3fs.S3FileSystem.clear_instance_cache()
        yield server
        server.close()
        s3fs.S3FileSystem.clear_instance_cache()


@pytest.fixture
def store(store_server: object) -> Iterator[object]:
    remote.process_cache.cache_clear()
    yield store_server
    store_server.misbehave = lambda method, path: None  # type: ignore[attr-defined]
