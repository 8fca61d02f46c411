"""`worldline serve`: sessions, their independence, and refused requests."""

import hashlib
import re
import socket
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import httpx
import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from flows.command_line import main
from worldline_core.errors import ConfigError, DataError, UnavailableError
from worldline_core.policies.openpi import unpack
from worldline_core.rollout.recorded_starts import RecordedStarts
from worldline_core.serving import app
from worldline_core.serving.app import listening_socket, server_token
from worldline_core.serving.client import SimulatorClient
from worldline_core.serving.serve_config import TOKEN_VARIABLE, ServeConfig
from worldline_core.serving.session_host import SessionHost

TOKEN, EPISODE = "correct horse", "ur5e_silver-test-s1-00000"


@pytest.fixture(scope="module")
def url(serving):
    with serving() as address:
        yield address


def drive(simulation, steps, seed):
    """Digest of all frames and states of a closed loop whose controls depend on what was seen."""
    generator, digest = np.random.default_rng(seed), hashlib.sha256()
    for _ in range(steps):
        seen = np.array([[picture.mean() for picture in clip.values()] for clip in simulation.pictures]).mean()
        state = simulation.state
        rows = state[:, None] + generator.normal(0, 0.02, (len(state), simulation.frames_per_step, state.shape[1]))
        for clip in simulation.step(rows + 1e-4 * seen):
            digest.update(b"".join(video.tobytes() for video in clip.values()))
        digest.update(simulation.states.tobytes())
    return digest.hexdigest()


def test_a_session_is_the_simulation_of_one_process(url, small_world, shipped):
    host = SessionHost(small_world, ServeConfig.model_validate({"episodes": shipped / "recordings"}))
    unseen = ["ood_test" in row["id"] for row in host.metadata()["episodes"]]
    assert 0 < sum(unseen) < len(unseen)
    assert unseen == sorted(unseen)  # what no model has seen is listed last
    here = host.simulate(EPISODE, [3])
    with SimulatorClient(url) as client:
        assert httpx.get(url.replace("ws", "http") + "/healthz").text == "OK\n"
        assert httpx.get(url.replace("ws", "http") + "/v1").json() == client.metadata
        assert (client.metadata["views"], client.metadata["fps"]) == (list(small_world.views), 8)
        assert EPISODE in {row["id"] for row in client.metadata["episodes"]}
        there = client.start(EPISODE, seeds=[3])
        assert there.frames_per_step == here.frames_per_step == 4
        for step in range(3):
            controls = np.repeat(here.state[:, None], 4, axis=1) + 0.02 * step
            frames, expected = there.step(controls), here.step(controls)
            for view in here.views:
                assert np.array_equal(frames[0][view], expected[0][view]), view
                assert np.array_equal(there.pictures[0][view], here.pictures[0][view])
            for name in ("states", "commands", "tool_poses"):
                assert np.array_equal(getattr(there, name), getattr(here, name)), name
        assert there.num_frames == here.num_frames == 13
        controls = np.repeat(here.state[:, None], 4, axis=1)
        for seeds, same in ((None, True), ([3], False)):  # the clip's own seed, begun anew
            branch, onward = there.fork(1, seeds), there.fork(1)
            assert np.array_equal(branch.step(controls)[0]["head"], onward.step(controls)[0]["head"]) is same
        branches = there.fork(2)
        both, one = branches.step(np.concatenate((controls, controls + 0.1))), there.step(controls)
        assert all(np.array_equal(both[0][view], one[0][view]) for view in here.views)
        assert not np.array_equal(both[1]["head"], one[0]["head"])
        there.reset()
        assert there.num_frames == 1
        first = drive(there, 2, 0)
        there.reset()
        assert drive(there, 2, 0) == first
        there.close()
        with pytest.raises(DataError, match="no such session"):
            there.step(controls)


def test_a_session_starts_at_an_observation_of_the_client(url, small_world, shipped):
    start = RecordedStarts(shipped / "recordings", view_sets=small_world.view_sets, fps=8).at(EPISODE)
    given = {
        "images": start.images, "cameras": start.cameras, "embodiment": "ur5e_silver", "state": start.state,
    }  # fmt: skip

    def posed(**values):
        """The cameras with other values of the head's."""
        return {"cameras": start.cameras | {"head": replace(start.cameras["head"], **values)}}

    refused = [
        ({"embodiment": "/etc/passwd"}, "Unknown embodiment"),
        ({"embodiment": "../ur5e.yaml"}, "Unknown embodiment"),
        ({"images": {"head": start.images["head"].astype(np.float32)}}, r"(?s)images.head.*uint8.*float32"),
        *(({"state": state}, "wrong length") for state in (np.zeros(3), np.array(0.0))),
        ({"state": np.full(14, np.nan)}, "not finite"),
        ({"state": np.array(["a"] * 14)}, r"(?s)state.*array of numbers"),
        (posed(T_base_camera=np.array([["a"] * 4] * 4)), r"(?s)T_base_camera.*array of numbers"),
        (posed(T_base_camera=np.diag([1.0, 1.0, -1.0, 1.0])), r"(?s)not a rigid transform.*T_base_camera"),
        (posed(T_base_camera=np.full((4, 4), np.nan)), "not a rigid transform"),
        (posed(K=np.full((3, 3), np.nan)), "camera matrix is not usable"),
        (posed(K=np.diag([-80.0, 80.0, 1.0])), "camera matrix is not usable"),
        ({"episode": EPISODE}, r"(?s)starts at a recording, or at an observation.*got: images, cameras"),
        ({"state": None}, "starts at a recording, or at an observation"),
        ({"cameras": None}, "No camera of the view head, left_wrist, right_wrist"),
        ({"seeds": [-1]}, r"(?s)seeds.0.*greater than or equal to 0"),
        ({"seeds": []}, "not understood"),
        ({"seeds": [0] * 10_000}, "Too many clips"),
    ]
    with SimulatorClient(url) as client:
        recorded, sent = client.start(EPISODE, seeds=[1, 2]), client.start(**given, seeds=[1, 2])
        assert drive(recorded, 2, 0) == drive(sent, 2, 0)
        for change, match in refused:
            with pytest.raises(DataError, match=match):
                client.start(**(given | change))
        with pytest.raises(DataError, match="No recording of this name"):
            client.start("nobody")
        with pytest.raises(DataError, match=r"(?s)Controls of a step have another shape.*\(2, 4, 14\)"):
            sent.step(np.zeros((1, 4, 14)))
        with pytest.raises(DataError, match="No such clips"):
            sent.select([7])
        assert len(sent.step(np.repeat(sent.state[:, None], 4, axis=1))) == 2  # as it was before the errors
        step = {"op": "step", "session": sent.session}
        requests = (
            (step | {"controls": np.full((2, 4, 14), "a")}, r"(?s)controls.*array of numbers"),
            ([1], "not understood"), ({"op": "eval"}, "eval"), ({"op": ["step"]}, "not understood"),
            ({"op": "step", "session": "x"}, "not understood"),
        )  # fmt: skip
        for request, match in requests:
            with pytest.raises(DataError, match=match):
                client.call(request)
    with SimulatorClient(url) as other, pytest.raises(DataError, match="no such session"):
        other.call(step | {"controls": np.zeros((2, 4, 14))})


@pytest.mark.slow
def test_many_sessions_at_once_are_neither_lost_nor_mixed_up(serving):
    """The short version of `benchmarks/serving.py`; one client in four vanishes in the middle."""
    with serving() as url:
        with SimulatorClient(url) as client:
            other = min(row["id"] for row in client.metadata["episodes"] if "viperx" in row["id"])

            def alone(client, number):
                return drive(client.start((EPISODE, other)[number % 2], seeds=[number]), 2, number)

            expected = [alone(client, number) for number in range(8)]
        assert len(set(expected)) == 8

        def work(number):
            with SimulatorClient(url) as client:
                if number % 4 == 3:
                    drive(client.start(EPISODE, seeds=[99]), 1, 0)
                    client._connection.socket.shutdown(socket.SHUT_RDWR)
                    return None
                return alone(client, number)

        with ThreadPoolExecutor(8) as threads:
            found = list(threads.map(work, range(8)))
        assert found == [None if number % 4 == 3 else digest for number, digest in enumerate(expected)]


@pytest.mark.slow
def test_limits_refuse_and_free_again(serving):
    with serving(max_sessions_per_connection=2) as url, SimulatorClient(url) as client, SimulatorClient(url) as other:
        first = client.start(EPISODE)
        first.fork(1)
        for begin in (lambda: client.start(EPISODE), lambda: first.fork(1)):
            with pytest.raises(UnavailableError, match=r"(?s)A connection has as many sessions.*at most 2"):
                begin()
        other.start(EPISODE)
        first.close()
        client.start(EPISODE)
    with serving(max_sessions=2, max_clips=3, max_connections=2, max_message_bytes=1 << 20, idle_s=0.6) as url:
        with SimulatorClient(url) as client:
            client.start(EPISODE)
            pair = client.start(EPISODE, seeds=[1, 2])
            for begin in (lambda: client.start(EPISODE), lambda: pair.fork(1)):
                with pytest.raises(UnavailableError, match=r"(?s)no room for another session.*2 sessions with 3 clips"):
                    begin()
            with SimulatorClient(url), pytest.raises(UnavailableError, match=r"(?s)closed the connection.*1013"):
                SimulatorClient(url)
            with pytest.raises(UnavailableError, match="closed the connection"):
                client.request({"op": "x" * (2 << 20)})  # larger than a message may be
        with SimulatorClient(url) as client:
            again = client.start(EPISODE, seeds=[1, 2])  # the sessions of the closed connection are gone
            controls = np.repeat(again.state[:, None], 4, axis=1)
            again.step(controls)
            time.sleep(1.2)
            with pytest.raises(UnavailableError, match="closed the connection"):  # idle
                again.step(controls)


def test_who_may_connect(serving, monkeypatch):
    def status(url, **headers):
        given = {name.title(): value for name, value in headers.items()}
        code = httpx.get(url.replace("ws", "http") + "/v1", headers=given).status_code
        if "host" not in headers:
            try:
                with connect(url + "/v1", additional_headers=given, proxy=None):
                    assert code == 200
            except InvalidStatus:  # a refused websocket is always 403
                assert code in (401, 403)
        return code

    with serving(origins=["http://friend:1"]) as url:
        assert status(url) == 200
        for origin, expected in {
            url.replace("ws", "http"): 200,
            "http://friend:1": 200,
            "http://evil.example": 403,
            "null": 403,
        }.items():
            assert status(url, origin=origin) == expected, origin
        assert status(url, host="evil.example") == 403  # a name bound anew to this machine
        assert status(url, host="localhost:1") == 200
    with serving(token=TOKEN) as url:
        assert status(url) == 401
        for word, expected in {"wrong": 401, "correct hors": 401, TOKEN: 200}.items():
            assert status(url, authorization=f"Bearer {word}") == expected, word
        assert status(url, authorization=f"Bearer {TOKEN}", origin="http://evil.example") == 403
        assert httpx.get(url.replace("ws", "http") + "/healthz").text == "OK\n"
        with pytest.raises(UnavailableError, match=r"(?s)403.*token"):
            SimulatorClient(url)
        with SimulatorClient(url, token=TOKEN) as client:
            assert client.metadata["protocol"] == 1
        with connect(url + "/v1?token=correct%20horse", proxy=None) as page:
            page.recv()
            page.send("no bytes")
            told = page.recv()
            assert "not understood" in unpack(told, "server")["error"]["what"]
            with pytest.raises(ConnectionClosed, match="1007"):
                page.recv()

    def token(**settings):
        return server_token(ServeConfig.model_validate(settings))

    monkeypatch.delenv(TOKEN_VARIABLE, raising=False)
    assert token() is token(host="::1") is None
    with pytest.raises(ConfigError, match=r"(?s)needs a token.*0\.0\.0\.0.*WORLDLINE_TOKEN="):
        token(host="0.0.0.0")  # noqa: S104
    monkeypatch.setenv(TOKEN_VARIABLE, "abc\r\n")  # no header can carry the end of a line
    assert token(host="0.0.0.0") == "abc"  # noqa: S104


def test_connections_that_say_nothing_are_closed_and_bounded(serving, monkeypatch):
    monkeypatch.setattr(app, "TAKE_S", 0.6)
    with serving(max_connections=4) as url:
        host, _, port = url.removeprefix("ws://").partition(":")
        slow = [socket.create_connection((host, int(port))) for _ in range(7)]
        for connection in slow:
            connection.sendall(b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\nX: ")
        with SimulatorClient(url) as client:  # the eighth
            with pytest.raises(httpx.TransportError):  # as many as there may be
                httpx.get(url.replace("ws", "http") + "/healthz")
            begin = time.monotonic()
            for connection in slow:
                connection.settimeout(5)
                assert connection.recv(100) == b""
            assert time.monotonic() - begin < 2
            assert httpx.get(url.replace("ws", "http") + "/healthz").is_success
            client.start(EPISODE)  # a websocket stays


@pytest.mark.parametrize("path", ["/v1", "/play/session"])
def test_a_text_that_is_no_utf8_ends_its_connection_alone(url, path, caplog):
    with connect(url + path, proxy=None) as page:
        page.recv()
        page.socket.sendall(b"\x81\x82" + bytes(4) + b"\xff\xfe")
        with pytest.raises(ConnectionClosed, match="1007"):
            page.recv()
    assert not [record for record in caplog.records if record.exc_info]
    with SimulatorClient(url) as client:
        client.start(EPISODE)


def test_a_port_is_known_or_refused_before_the_model_is_loaded(capsys):
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with pytest.raises(SystemExit, match="1"):
            main(["serve", "--set", f"port={port}", "--set", "model=nowhere"])
    assert re.search(rf"(?s)127\.0\.0\.1:{port}.*take another port", capsys.readouterr().err)
    with listening_socket(ServeConfig.model_validate({"port": 0, "host": "localhost"})) as bound:
        host, port = bound.getsockname()[:2]
        assert (host, port > 0) == ("127.0.0.1", True)
        with pytest.raises(ConnectionRefusedError, match=r".+"):  # nobody waits for a server that is not there yet
            socket.create_connection((host, port), timeout=5)
