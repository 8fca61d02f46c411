"""Prefect's temporary server: its settings, and its early start for a run that has no other server."""

from __future__ import annotations

import atexit
import functools
import os
import secrets
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_SETTINGS = {
    # On a busy machine the server takes its time.
    "PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS": "180",
    "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
    # Web pages read nothing of it (the default lets all of them).
    "PREFECT_SERVER_CORS_ALLOWED_ORIGINS": "",
    # The file in Prefect's home belongs to all runs of a user: they lock each other out of it, two that start together both
    # try to make its tables, and one that another version of Prefect left does not open.
    "PREFECT_API_DATABASE_CONNECTION_URL": "sqlite+aiosqlite:///:memory:",
    # Shards of a step that runs alone belong to no flow run.
    "PREFECT_LOGGING_TO_API_WHEN_MISSING_FLOW": "ignore",
    "PREFECT_API_BLOCKS_REGISTER_ON_START": "false",
    # They note events, some seconds late, for pages that this server does not show; the end of a short run would
    # interrupt them in a transaction.
    "PREFECT_SERVER_SERVICES_TASK_RUN_RECORDER_ENABLED": "false",
    "PREFECT_SERVER_SERVICES_EVENT_PERSISTER_ENABLED": "false",
    "PREFECT_SERVER_SERVICES_TRIGGERS_ENABLED": "false",
}


def set_up_temporary_server() -> None:
    """Choose the temporary server's settings where the environment does not; a server at PREFECT_API_URL has its own.

    Must happen before Prefect is imported, which reads them.
    """
    for name, value in _SETTINGS.items():
        os.environ.setdefault(name, value)


def prepare_prefect(artifacts: Path) -> None:
    """Prefect's cache records belong to the artifacts that they speak of. Must happen before Prefect is imported."""
    os.environ.setdefault("PREFECT_LOCAL_STORAGE_PATH", str((artifacts / "prefect").resolve()))
    set_up_temporary_server()


_started: tuple[subprocess.Popen[bytes], int] | None = None


def start_server_early() -> None:
    """Start the server while this process still imports: it takes ten seconds, and Prefect would start it afterwards.

    Does nothing if Prefect is already imported, or if a server may be configured. Call `prepare_prefect` first.
    """
    global _started
    home = Path(os.environ.get("PREFECT_HOME", "~/.prefect")).expanduser()
    if _started or "prefect" in sys.modules or "PREFECT_API_URL" in os.environ or (home / "profiles.toml").exists():
        return
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    own = {
        "PREFECT_UI_ENABLED": "0",
        "PREFECT__SERVER_EPHEMERAL": "1",
        "PREFECT__SERVER_FINAL": "1",
        "PREFECT_API_AUTH_STRING": _password(),
        "PREFECT_SERVER_API_AUTH_STRING": _password(),
    }
    app = ["uvicorn", "--factory", "prefect.server.api.server:create_app", "--log-level", "error", "--lifespan", "on"]
    process = subprocess.Popen(  # noqa: S603 - as Prefect starts it
        [sys.executable, "-m", *app, "--host", "127.0.0.1", "--port", str(port)], env=os.environ | own
    )
    atexit.register(_stop, process)
    _started = process, port


def _stop(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(timeout=5)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _use_started_server() -> None:
    """Hand the early server to Prefect's clients once it answers; if it has ended, Prefect starts its own."""
    global _started
    if _started is None:
        return
    (process, port), _started = _started, None
    import httpx
    from prefect.server.api.server import SubprocessASGIServer

    deadline = time.monotonic() + float(os.environ["PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS"])
    while process.poll() is None and time.monotonic() < deadline:
        try:
            if httpx.get(f"http://127.0.0.1:{port}/api/health").is_success:
                server = SubprocessASGIServer()
                server.port, server.server_process, server.running = port, process, True
                return
        except httpx.TransportError:
            pass
        time.sleep(0.1)
    _stop(process)


@functools.cache
def _password() -> str:
    """The password of this process's temporary server, which its task runs know as well."""
    return f"worldline:{secrets.token_urlsafe(24)}"


@contextmanager
def private_server() -> Iterator[None]:
    """Let a temporary server that starts within obey this run alone, not web pages or other users of the machine."""
    from prefect.settings import (
        PREFECT_API_AUTH_STRING,
        PREFECT_API_URL,
        PREFECT_SERVER_API_AUTH_STRING,
        temporary_settings,
    )

    if PREFECT_API_URL.value():
        if _started is not None:  # the server is named in a file that Prefect alone reads
            _stop(_started[0])
        yield
        return
    with temporary_settings({PREFECT_API_AUTH_STRING: _password(), PREFECT_SERVER_API_AUTH_STRING: _password()}):
        _use_started_server()
        yield
