"""A simulator behind GE-Sim 2.0's protocol: what it is sent, what is made of its answers, and what becomes of bad ones.

The server is the test's own, on sockets and PIL: it shares no code with the client.
"""

import io
import json
import re
import struct
import threading
import time
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pyarrow.parquet as pq
import pytest
from PIL import Image

from tests.rollout.conftest import SIZE, recorded, track, write_recordings
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.errors import DataError, UnavailableError
from worldline_core.rollout.baselines import tool_band
from worldline_core.rollout.rollout import rollout
from worldline_core.rollout.rollout_config import RolloutConfig
from worldline_core.rollout.rollout_set import RolloutSet

EPISODES = {"a": 33, "b": 9, "c": 9, "long": 61}
H, W = 64, 96


class Server:
    """Every frame is the observed one, a little brighter from action to action. ``spoil`` changes an answer of /step."""

    def __init__(self):
        self.calls, self.actions, self.bands, self.cameras = [], [], [], []
        self.spoil, self.frame = lambda answer: (200, answer), np.zeros(())
        outer = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self):
                outer.calls.append(self.path)
                self._answer(200, b'{"status": "ok"}')

            def do_POST(self):
                outer.calls.append(self.path)
                self._answer(*outer.answer(self.path, self.rfile.read(int(self.headers["Content-Length"]))))

            def _answer(self, status, answer):
                self.send_response(status)
                if status == 302:
                    self.send_header("Location", "http://127.0.0.1:1/elsewhere")
                self.send_header("Content-Length", str(len(answer)))
                self.end_headers()
                self.wfile.write(answer)

            def log_message(self, *args):
                pass

        self.http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.http.server_port}"
        threading.Thread(target=self.http.serve_forever, args=(0.01,), daemon=True).start()

    def answer(self, path, body):
        if path == "/init":
            return 200, b'{"success": true, "client_id": "me"}'
        sections = [body] if body.startswith(b"{") else _sections(body)
        meta = json.loads(sections[-1])
        assert meta["client_id"] == "me"
        if path == "/set_camera_params":
            self.cameras.append(meta)
        elif path == "/set_episode_data":
            assert meta["frame_shape"] == [3, 3, H, W]
            self.frame = np.asarray(Image.open(io.BytesIO(sections[0])))
            assert self.frame.shape == (H, 3 * W, 3)
        elif path == "/set_episode_traj":
            pictures, c2w = _sections(sections[0]), np.frombuffer(sections[1], "<f4").reshape(meta["c2w_shape"])
            assert meta["traj_shape"] == [3, 3, len(pictures), H, W]
            assert c2w.shape == (3, len(pictures), 4, 4)
            self.bands.append(len(pictures))
        elif path == "/step":
            actions = np.frombuffer(sections[0], "<f4").reshape(meta["action_shape"])
            self.actions.append(actions)
            facts = {"frame_shape": [len(actions), 3, 3, H, W], "state_shape": list(actions.shape)}
            pictures = [_jpeg(np.clip(self.frame.astype(int) + 2 * i, 0, 255)) for i in range(len(actions))]
            return self.spoil(_packed([json.dumps(facts).encode(), *pictures, actions.tobytes()]))
        return 200, b'{"success": true}'


def _sections(body):
    stream, found = io.BytesIO(body), []
    while head := stream.read(4):
        found.append(stream.read(*struct.unpack(">I", head)))
    return found


def _packed(sections):
    return b"".join(struct.pack(">I", len(section)) + section for section in sections)


def _jpeg(picture):
    memory = io.BytesIO()
    Image.fromarray(picture.astype(np.uint8)).save(memory, format="JPEG", quality=95)
    return memory.getvalue()


@pytest.fixture
def server():
    running = Server()
    yield running
    running.http.shutdown()
    running.http.server_close()


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    root = tmp_path_factory.mktemp("ge_sim")
    made = write_recordings(root, [(name, "test", count, VIEWS, VIEWS) for name, count in EPISODES.items()], 16)
    return {**made, "tokenizer": root}


def run(server, inputs, output, *, timeout_s=5.0, num_frames=9):
    url = server if isinstance(server, str) else server.url
    sampler = {"kind": "ge_sim", "url": url, "image_size": [H, W], "timeout_s": timeout_s}
    values = {"method": "theirs", "sampler": sampler, "num_frames": num_frames}
    return rollout(RolloutConfig.model_validate(values), inputs, output)


def quarantine(output):
    rows = pq.read_table(output / "quarantine.parquet").to_pylist()
    return {row["episode_id"]: (row["reason"], row["detail"]) for row in rows}


def test_a_server_s_frames_become_a_rollout_set(server, inputs, tmp_path):
    done = run(server, inputs, tmp_path, num_frames="whole")
    assert (done["episodes"], done["frames"], done.get("left_out")) == (4, sum(EPISODES.values()), {})
    found = RolloutSet.open(tmp_path)
    assert (found.method, found.fps, found.episode_ids) == ("theirs", 8.0, [*EPISODES])
    for seed, (name, count) in enumerate(EPISODES.items()):
        frames = found.frames(name, "right_wrist", 42)
        assert frames.shape == (count, *SIZE, 3)
        truth = recorded(seed, count)[0].astype(int)
        for k in (0, 1, 5):  # the observed frame, then brighter from action to action
            assert np.abs(frames[k].astype(int) - truth - 2 * max(0, k - 1)).mean() < 6, (name, k)
    # Nine frames are one step, thirty-three two, each with a band of its own; sixty-one have one band for all steps.
    begin, pair = ["/reset", "/set_task", "/set_camera_params", "/set_episode_data"], ["/set_episode_traj", "/step"]
    calls = [*begin, *pair] * 2 + [*begin, *pair, *pair] + [*begin, *pair, "/step", "/step"]
    assert server.calls == ["/healthz", "/init", *calls, "/close"]
    assert [len(actions) for actions in server.actions] == [8, 8, 25, 7, 25, 25, 10]
    assert server.bands == [8, 8, 25, 7, 60]
    # Frame 1 is drawn for the controls of frame 1; openings (1 in these tracks) are counted from open to closed.
    wanted = np.linspace(0, 1, 9)[1:, None].repeat(16, 1)  # of episode b, whose joints go from 0 to 1
    wanted[:, [7, 15]] = 0
    np.testing.assert_allclose(server.actions[0], wanted, atol=1e-6)
    K = np.array(server.cameras[0]["intrinsic"])
    np.testing.assert_allclose(K[0], [[2, 0, 0.5], [0, 2, 0.5], [0, 0, 1]], atol=1e-6)  # eye, at twice the size
    assert np.array(server.cameras[0]["extrinsic"]).shape == (3, 4, 4)


def _fewer(answer):
    meta, *pictures, state = _sections(answer)
    return _packed([meta, *pictures[:-1], state])


def _smaller(answer):
    meta, _, *others = _sections(answer)
    return _packed([meta, _jpeg(np.zeros((H, W, 3))), *others])


BAD_ANSWERS = {
    "frame_size": (lambda a: (200, _smaller(a)), rf"a frame of {H} x {W} pixels, not of {H} x {3 * W}"),
    "missing_section": (lambda a: (200, _fewer(a)), "7 frames for 8 actions"),
    "breaks_off": (lambda a: (200, a[:-9]), r"section 9 breaks off: 9 bytes are missing"),
    "no_sections": (lambda a: (200, _packed([b"\xff"])), "not enough values"),
    "no_jpeg": (lambda a: (200, a.replace(b"\xff\xd8\xff", b"\0\0\0")), "no known format"),
    "too_large": (lambda a: (200, a + bytes(1 << 20)), r"more than 951,\d{3} bytes"),
    "refused": (lambda a: (400, b'{"error": "no such robot"}'), "HTTP 400: .*no such robot"),
}


@pytest.mark.slow
def test_a_bad_answer_puts_its_episode_into_quarantine(server, tmp_path):
    """Every second episode gets a good one: three bad ones in a row would end the step."""
    names = [name for bad in sorted(BAD_ANSWERS) for name in (bad, f"{bad} good")]  # in the order of their names
    made = write_recordings(tmp_path, [(name, "test", 9, VIEWS, VIEWS) for name in names], 16)
    answers = iter([BAD_ANSWERS.get(name) for name in names])
    server.spoil = lambda answer: bad[0](answer) if (bad := next(answers)) else (200, answer)
    done = run(server, {**made, "tokenizer": tmp_path}, tmp_path / "out")
    assert (done["episodes"], done["left_out"]) == (len(BAD_ANSWERS), {"simulator_failed": len(BAD_ANSWERS)})
    found = quarantine(tmp_path / "out")
    assert found.keys() == BAD_ANSWERS.keys()
    for name, (_, message) in BAD_ANSWERS.items():
        assert found[name][0] == "simulator_failed"
        assert re.search(message, found[name][1]), found[name]


def test_a_server_out_of_order_ends_the_step_and_what_is_finished_is_kept(server, inputs, tmp_path):
    answers = iter([False, True, True, True])
    server.spoil = lambda answer: (500, b"out of memory") if next(answers) else (200, answer)
    with pytest.raises(UnavailableError, match=r"(?s)cannot be used.*3 refusals in a row.*out of memory"):
        run(server, inputs, tmp_path)
    server.spoil = lambda answer: (200, answer)
    server.actions.clear()
    assert run(server, inputs, tmp_path)["episodes"] == 4
    assert len(server.actions) == 3  # the first one was there


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda a: (302, b""), "HTTP 302"),
        (lambda a: (403, b'{"error": "unknown client_id"}'), "HTTP 403: .*unknown client_id"),
        (lambda a: (503, b""), "HTTP 503"),
        (lambda a: (time.sleep(0.8), (200, a))[1], r"no whole answer within 0\.3 s"),
    ],
)
def test_a_server_that_is_none_ends_the_step(spoil, message, server, inputs, tmp_path):
    server.spoil = spoil
    with pytest.raises(UnavailableError, match=rf"(?s){server.url}/step.*{message}.*next step: start it"):
        run(server, inputs, tmp_path, timeout_s=0.3 if "within" in message else 5.0)


def test_no_server_is_said_before_anything_is_predicted(inputs, tmp_path):
    with pytest.raises(UnavailableError, match=r"(?s)127\.0\.0\.1:9/healthz.*ConnectError"):
        run("http://127.0.0.1:9", inputs, tmp_path)


def test_other_robots_are_counted_and_none_left_is_an_error(server, tmp_path):
    made = write_recordings(tmp_path, [("a", "test", 9, VIEWS, VIEWS), ("b", "test", 9, ("head",), ("head",))])
    with pytest.raises(DataError, match=r"(?s)No episode could be predicted.*two arms of seven joints.*14 numbers"):
        run(server, {**made, "tokenizer": tmp_path}, tmp_path / "out")
    reasons = {name: reason for name, (reason, _) in quarantine(tmp_path / "out").items()}
    assert reasons == {"a": "unsupported_controls", "b": "missing_view"}


def test_the_tools_are_drawn_where_they_are():
    """A camera at the base's origin: the left tool half a metre before it, half open; the right one behind it."""
    poses = np.tile(np.eye(4, dtype=np.float32), (2, 2, 1, 1))
    poses[:, 0, :3, 3], poses[:, 1, :3, 3] = (0.1, 0, 0.5), (0, 0, -0.5)
    tracks = replace(track("a", 0, 2), T_base_tool=poses, gripper=np.full((2, 3, 2), 0.5, np.float32))
    K = np.tile(np.array([[100.0, 0, 200], [0, 100, 150], [0, 0, 1]]), (3, 1, 1))
    picture = tool_band(tracks, K, (300, 400))[1, 0]
    # The end link is 0.35 m in front of, and 0.1 m beside the camera.
    radius = int((1 - np.hypot(0.1, 0.35) - 0.07 / 0.73) * 100)
    x, y = 220, 150
    matplotlib = pytest.importorskip("matplotlib")
    green = np.array(matplotlib.colormaps["Greens"]((0.5 * 85 + 35) / 120)[:3]) * 255
    for px, py in ((x - radius + 1, y), (x, y - radius + 1), (x - 10, y - 10)):
        np.testing.assert_allclose(picture[py, px], green, atol=2)
    assert (picture[y, x - radius - 2] == 50).all()
    assert (picture[y, x + 10] == (0, 0, 255)).all()  # along x, to 0.1 m: 20 pixels
    assert (picture[y + 10, x] == (255, 255, 0)).all()  # along y, down
    # Nothing of the tool behind the camera: background, disc, three lines.
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) <= 5
