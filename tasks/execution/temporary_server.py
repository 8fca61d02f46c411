"""Prefect's temporary server, which a run without a server starts for itself: how it is set up."""

from __future__ import annotations

import functools
import os
import secrets
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
        yield
        return
    with temporary_settings({PREFECT_API_AUTH_STRING: _password(), PREFECT_SERVER_API_AUTH_STRING: _password()}):
        yield
