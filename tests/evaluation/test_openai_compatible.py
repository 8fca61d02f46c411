import base64
import json
import threading
from http.server import BaseHTTPRequestHandler, HTTPServer

import cv2
import numpy as np
import pytest

from worldline_core.errors import ConfigError, UnavailableError
from worldline_core.evaluation.evaluation_config import VLMConfig
from worldline_core.evaluation.policy.judge import VLMJudge
from worldline_core.evaluation.recordings import Trajectory
from worldline_core.evaluation.vlm import Image, OpenAICompatibleModel, Text, UnansweredMessageError, open_vlm


class Server:
    """A chat server with prepared replies: (status, body)."""

    def __init__(self):
        self.replies, self.requests, self.headers = [], [], []
        outer = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self):
                body = self.rfile.read(int(self.headers["Content-Length"]))
                outer.requests.append((self.path, json.loads(body)))
                outer.headers.append(dict(self.headers))
                status, reply = outer.replies.pop(0)
                self.send_response(status)
                self.end_headers()
                self.wfile.write(reply if isinstance(reply, bytes) else json.dumps(reply).encode())

            def log_message(self, *args):  # pyright: ignore[reportIncompatibleMethodOverride]
                pass

        self.server = HTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_port}/v1"
        self.thread = threading.Thread(target=self.server.serve_forever, daemon=True)
        self.thread.start()


@pytest.fixture
def server():
    running = Server()
    yield running
    running.server.shutdown()
    running.server.server_close()


def _reply(text):
    return 200, {"choices": [{"message": {"content": text}}]}


def _model(server, **options):
    return OpenAICompatibleModel(VLMConfig(url=server.url, model="some-model", timeout_s=5, **options), backoff_s=0.01)


def test_sends_text_and_frames_and_reads_the_answer(server, monkeypatch):
    monkeypatch.setenv("JUDGE_KEY", "secret")
    server.replies = [_reply("fine")]
    picture = np.random.default_rng(0).integers(0, 256, (4, 6, 3), dtype=np.uint8)
    assert _model(server, api_key_variable="JUDGE_KEY").answer([Text("what?"), Image(picture)]) == "fine"
    path, body = server.requests[0]
    assert path == "/v1/chat/completions"
    assert (body["temperature"], body["max_tokens"], len(body["messages"])) == (0.0, 256, 1)
    text, image = body["messages"][0]["content"]
    assert text == {"type": "text", "text": "what?"}
    png = base64.b64decode(image["image_url"]["url"].removeprefix("data:image/png;base64,"))
    assert np.array_equal(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)[..., ::-1], picture)  # pyright: ignore[reportOptionalSubscript]
    assert server.headers[0]["Authorization"] == "Bearer secret"


def test_retries_what_fails_on_the_way(server):
    server.replies = [(503, {}), (429, {}), _reply("third time")]
    assert _model(server).answer([Text("?")]) == "third time"
    server.replies = [(503, {})] * 3
    with pytest.raises(UnavailableError, match="HTTP 503"):
        _model(server).answer([Text("?")])
    assert len(server.requests) == 6


def test_does_not_retry_a_refusal_or_a_malformed_reply(server):
    server.replies = [(401, {"error": "key"})]
    with pytest.raises(UnavailableError, match="HTTP 401"):
        _model(server).answer([Text("?")])
    server.replies = [(200, {"choices": []})]
    with pytest.raises(UnansweredMessageError, match="choices"):
        _model(server).answer([Text("?")])
    server.replies = [(200, b"<html>")]
    with pytest.raises(UnansweredMessageError, match="JSON"):
        _model(server).answer([Text("?")])
    assert len(server.requests) == 3


def test_no_answer_is_null_evidence_and_counted_until_the_server_is_given_up(server):
    judge = VLMJudge(_model(server, attempts=1))
    good = _reply('{"target_held_for_two_late_steps": true, "wrong_object_or_drop": false}')
    server.replies = [(400, {"error": "content"}), (500, {}), good]
    found = [judge.extract(_trajectory(), "grasp", (0, 19), 360) for _ in range(3)]
    assert [answer.well_formed for answer in found] == [False, False, True]
    assert found[0].evidence.target_held_for_two_late_steps is None  # pyright: ignore[reportAttributeAccessIssue]
    server.replies = [(500, {})] * 3
    judge.reconcile(_trajectory(), "", "", "")
    judge.inspect_motion(_trajectory(), (0, 19), "")
    with pytest.raises(UnavailableError, match="no answer to the 2 messages before"):
        judge.reconcile(_trajectory(), "", "", "")


def test_nobody_there():
    model = OpenAICompatibleModel(VLMConfig(url="http://127.0.0.1:9/v1", timeout_s=1, attempts=2), backoff_s=0.01)
    with pytest.raises(UnavailableError, match="cannot be used"):
        model.answer([Text("?")])


def test_configuration_names_what_is_missing(tmp_path):
    with pytest.raises(ConfigError, match="No server configured"):
        open_vlm("openai", VLMConfig())
    with pytest.raises(ConfigError, match="Not the address"):
        open_vlm("openai", VLMConfig(url="file:///etc/passwd"))
    with pytest.raises(ConfigError, match="No Qwen3-VL weights"):
        open_vlm("qwen3_vl", VLMConfig())
    with pytest.raises(UnavailableError, match="weights not found"):
        open_vlm("qwen3_vl", VLMConfig(weights=tmp_path))


def _trajectory():
    frames = {view: np.zeros((20, 8, 12, 3), np.uint8) for view in ("head", "left_wrist", "right_wrist")}
    return Trajectory("lift the red cube", frames, 8.0)  # pyright: ignore[reportArgumentType]
