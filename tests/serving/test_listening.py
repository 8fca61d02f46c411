"""What a server says before it serves."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest

from flows.command_line import main
from worldline_core import WorldLine
from worldline_core.serving.app import listening_socket
from worldline_core.serving.serve_config import ServeConfig
from worldline_core.serving.session_host import SessionHost


def test_a_port_that_is_taken_is_told_before_the_model_is_loaded(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with pytest.raises(SystemExit, match="1"):
            main(["serve", "--set", f"port={port}", "--set", "model=nowhere"])
    assert f"127.0.0.1:{port}" in (error := capsys.readouterr().err)
    assert "take another port" in error


def test_a_free_port_is_known_before_the_server_runs() -> None:
    with listening_socket(ServeConfig.model_validate({"port": 0, "host": "localhost"})) as bound:
        host, port = bound.getsockname()[:2]
        assert (host, port > 0) == ("127.0.0.1", True)
        with pytest.raises(ConnectionRefusedError, match=r".+"):  # nobody waits for a server that is not there yet
            socket.create_connection((host, port), timeout=5)


def test_what_no_model_has_seen_is_listed_last(shipped: Path, small_world: WorldLine) -> None:
    host = SessionHost(small_world, ServeConfig.model_validate({"episodes": shipped / "recordings"}))
    names = [row["id"] for row in host.metadata()["episodes"]]
    unseen = ["ood_test" in name for name in names]
    assert 0 < sum(unseen) < len(unseen)
    assert unseen == sorted(unseen)
