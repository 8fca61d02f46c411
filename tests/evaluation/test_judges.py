"""Rules of evidence, and the judges that give it: a server, and Qwen3-VL with transformers' own classes at a very small random size."""

import base64
import itertools
import json

import cv2
import numpy as np
import pytest
import torch

from worldline_core.data.episodes.episode import VIEWS
from worldline_core.errors import ConfigError, UnavailableError
from worldline_core.evaluation import vlm
from worldline_core.evaluation.evaluation_config import VLMConfig
from worldline_core.evaluation.policy import judge as judging
from worldline_core.evaluation.recordings import Trajectory
from worldline_core.rehearsal.outside_models import write_qwen3_vl

SUCCESS = {
    judging.GraspEvidence: {"target_held_for_two_late_steps": True, "wrong_object_or_drop": False},
    judging.LiftEvidence: {
        "head_view_confirms_target_displacement": True, "target_held_for_two_late_steps": True,
        "target_on_original_support_at_end": False, "wrong_object_or_drop": False,
    },
    judging.StateChangeEvidence: {"required_final_state_visible": True, "wrong_object_or_drop": False},
}  # fmt: skip


@pytest.mark.parametrize("schema", SUCCESS)
def test_only_the_facts_of_a_success_establish_it(schema):
    for values in itertools.product((True, False, None), repeat=len(SUCCESS[schema])):
        found = dict(zip(SUCCESS[schema], values, strict=True))
        assert judging.establishes_success(schema(**found)) == (found == SUCCESS[schema])
        if schema is judging.StateChangeEvidence:
            done, wrong = values
            assert judging.overturns(done, schema(**found)) == (done is True and wrong is not True)


ROUTES = {
    "lift": ["lift the red cube", "Pick up the cup", "grasp the bottle and lift it"],
    "grasp": ["attempt to grasp the bottle"],
    "state_change": [
        "pick up the cup and place it on the tray", "place the blue cube on the green pad", "push the yellow drawer closed",
        "press the bell", "folding the towel", "do something",
    ],
}  # fmt: skip


@pytest.mark.parametrize(("instruction", "family"), [(text, name) for name, texts in ROUTES.items() for text in texts])
def test_routing(instruction, family):
    assert judging.route(instruction) == family


WELL_FORMED = (
    '{"target_held_for_two_late_steps": true, "wrong_object_or_drop": false, "observations": "x", "confidence": 80}'
)


SURROUNDED = (
    WELL_FORMED, f"Here is the evidence:\n```json\n{WELL_FORMED}\n```\nThat is all.",
    f'{{"note": "first thoughts"}} {WELL_FORMED}', WELL_FORMED[:-1] + ', "verdict": "success"}',
    WELL_FORMED.replace("80", '"high"').replace('"x"', "null"),
)  # fmt: skip
MALFORMED = (
    "", "The object is held.", "{", '{"target_held_for_two_late_steps": "true", "wrong_object_or_drop": false}',
    '{"target_held_for_two_late_steps": 1, "wrong_object_or_drop": false}',
    '{"required_final_state_visible": true, "wrong_object_or_drop": false}',
    '["target_held_for_two_late_steps", true]', WELL_FORMED[:40], "{" * 5000,
)  # fmt: skip


@pytest.mark.parametrize("answer", SURROUNDED + MALFORMED)
def test_answers_are_found_in_what_surrounds_them_and_malformed_ones_become_null_evidence(answer):
    evidence, well_formed = vlm.parse_answer(judging.GraspEvidence, answer)
    assert well_formed == (answer in SURROUNDED)
    assert evidence.target_held_for_two_late_steps is True if well_formed else evidence == judging.GraspEvidence()


def test_first_pass_is_denser_towards_the_end():
    indices = judging.first_pass_indices(129)
    assert (len(indices), indices[0], indices[-1]) == (12, 0, 128)
    assert indices[1] == round(np.sqrt(1 / 11) * 128)
    assert np.all(np.diff(np.diff(indices)) <= 1)
    assert judging.frames_at(judging.VERIFICATION_POSITIONS, 101) == (0, 65, 78, 88, 95, 100)
    assert len(judging.frames_at(np.linspace(0.0, 1.0, judging.MOTION_COUNT), 129)) == 12
    assert judging.first_pass_indices(3) == (0, 1, 2)


class ScriptedJudge:
    """Gives prepared answers and remembers what it was asked."""

    name = "scripted"

    def __init__(self, extracts, reconciliation=None, motion=None):
        self.extracts, self.reconciliation, self.motion = list(extracts), reconciliation, motion
        self.asked = []

    def extract(self, trajectory, family, indices, height_px):
        self.asked.append(("extract", len(indices), height_px))
        return self.extracts.pop(0)

    def reconcile(self, trajectory, selected, first, verification):
        self.asked.append(("reconcile", selected, first, verification))
        return judging.Reconciliation(observations_prove_completion=self.reconciliation), True

    def inspect_motion(self, trajectory, indices, earlier):
        self.asked.append(("motion", len(indices), earlier))
        return judging.MotionEvidence(task_effect_completed=self.motion), True


def state(done, wrong=False, text=""):
    facts = {"required_final_state_visible": done, "wrong_object_or_drop": wrong, "observations": text}
    return judging.StateChangeEvidence(**facts), True


def judged(judge, instruction="press the bell", views=("head", "left_wrist")):
    frames = {view: np.zeros((129, 8, 8, 3), np.uint8) for view in views}
    return judging.judge_trajectory(judge, Trajectory(instruction, frames, 8.0))


def test_passes_ask_for_what_they_need_and_no_more():
    judge = ScriptedJudge([state(True)])
    assert (judged(judge).decided_by, judge.asked) == ("first_pass", [("extract", 12, 360)])
    judge = ScriptedJudge([state(False, text="one"), state(None, text="two")])
    assert not judged(judge).success
    assert judge.asked[1:] == [("extract", 6, 480), ("reconcile", "two", "one", "two"), ("motion", 12, "two")]


GRASP, NULL = (judging.GraspEvidence(), True), (judging.LiftEvidence(), False)
PASSES = ["first_pass", "verification", "reconciliation", "motion"]


@pytest.mark.parametrize(
    ("judge", "more", "passes", "success", "malformed"),
    [
        (ScriptedJudge([state(False), state(None)]), {}, PASSES, False, 0),
        (ScriptedJudge([state(None)] * 2, True), {}, PASSES[:3], True, 0),
        (ScriptedJudge([state(None)] * 2, None, True), {}, PASSES, True, 0),
        (ScriptedJudge([state(False, wrong=True)] * 2, True, True), {}, PASSES, False, 0),
        (ScriptedJudge([state(None)]), {"views": ("head",)}, [PASSES[0], *PASSES[2:]], False, 0),
        (ScriptedJudge([GRASP] * 2), {"instruction": "grasp the cup"}, PASSES[:2], False, 0),
        (ScriptedJudge([NULL] * 2), {"instruction": "lift the cup"}, [*PASSES[:2], PASSES[3]], False, 2),
    ],
    ids=["all", "reconciled", "motion", "a drop is never overturned", "one view", "grasp", "malformed"],
)
def test_each_pass_can_establish_success_until_the_last_one(judge, more, passes, success, malformed):
    result = judged(judge, **more)
    assert [statement["pass"] for statement in result.statements] == passes
    assert (result.success, result.malformed_answers, result.answers) == (success, malformed, len(passes))
    assert not success or result.decided_by == passes[-1]


class Server:
    """In place of `exchange`, whose sockets test_hostile_endpoints tests: prepared replies (status, body)."""

    def __init__(self):
        self.replies, self.requests = [], []

    def __call__(self, url, body, *, headers, **limits):
        self.requests.append((url, json.loads(body), headers))
        status, reply = self.replies.pop(0)
        return status, reply if isinstance(reply, bytes) else json.dumps(reply).encode()


@pytest.fixture
def server(monkeypatch):
    monkeypatch.setattr(vlm, "exchange", replies := Server())
    return replies


def _reply(text):
    return 200, {"choices": [{"message": {"content": text}}]}


def _model(**options):
    return vlm.OpenAICompatibleModel(VLMConfig(url="http://judge/v1", model="some-model", **options), backoff_s=0.01)


def test_sends_text_and_frames_and_reads_the_answer(server, monkeypatch):
    monkeypatch.setenv("JUDGE_KEY", "secret")
    server.replies = [_reply("fine")]
    picture = np.random.default_rng(0).integers(0, 256, (4, 6, 3), dtype=np.uint8)
    assert _model(api_key_variable="JUDGE_KEY").answer([vlm.Text("what?"), vlm.Image(picture)]) == "fine"
    url, body, headers = server.requests[0]
    assert (url, headers["Authorization"]) == ("http://judge/v1/chat/completions", "Bearer secret")
    assert (body["temperature"], body["max_tokens"], len(body["messages"])) == (0.0, 256, 1)
    text, image = body["messages"][0]["content"]
    assert text == {"type": "text", "text": "what?"}
    png = base64.b64decode(image["image_url"]["url"].removeprefix("data:image/png;base64,"))
    assert np.array_equal(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)[..., ::-1], picture)  # pyright: ignore[reportOptionalSubscript]


@pytest.mark.parametrize(
    ("replies", "error", "message"),
    [
        ([(503, {}), (429, {}), _reply("third time")], None, ""),
        ([(503, {})] * 3, UnavailableError, "HTTP 503"),
        # A refusal or a malformed reply is not asked for again.
        ([(401, {"error": "key"})], UnavailableError, "HTTP 401"),
        ([(200, {"choices": []})], vlm.UnansweredMessageError, "choices"),
        ([(200, b"<html>")], vlm.UnansweredMessageError, "JSON"),
    ],
)
def test_retries_what_fails_on_the_way_alone(server, replies, error, message):
    server.replies = [*replies]
    if error is None:
        assert _model().answer([vlm.Text("?")]) == "third time"
    else:
        with pytest.raises(error, match=message):
            _model().answer([vlm.Text("?")])
    assert len(server.requests) == len(replies)


def test_no_answer_is_null_evidence_and_counted_until_the_server_is_given_up(server):
    judge = judging.VLMJudge(_model(attempts=1))
    good = _reply('{"target_held_for_two_late_steps": true, "wrong_object_or_drop": false}')
    server.replies = [(400, {"error": "content"}), (500, {}), good]
    found = [judge.extract(TRAJECTORY, "grasp", (0, 19), HEIGHT_PX) for _ in range(3)]
    assert [well_formed for _, well_formed in found] == [False, False, True]
    assert found[0][0] == judging.GraspEvidence()
    server.replies = [(500, {})] * 3
    judge.reconcile(TRAJECTORY, "", "", "")
    judge.inspect_motion(TRAJECTORY, (0, 19), "")
    with pytest.raises(UnavailableError, match="no answer to the 2 messages before"):
        judge.reconcile(TRAJECTORY, "", "", "")


def test_nobody_there(tmp_path):
    model = vlm.OpenAICompatibleModel(VLMConfig(url="http://127.0.0.1:9/v1", timeout_s=1, attempts=2), backoff_s=0.01)
    with pytest.raises(UnavailableError, match="cannot be used"):
        model.answer([vlm.Text("?")])
    for kind, config, error, message in (
        ("openai", VLMConfig(), ConfigError, "No server configured"),
        ("openai", VLMConfig(url="file:///etc/passwd"), ConfigError, "Not the address"),
        ("qwen3_vl", VLMConfig(), ConfigError, "No Qwen3-VL weights"),
        ("qwen3_vl", VLMConfig(weights=tmp_path), UnavailableError, "weights not found"),
    ):
        with pytest.raises(error, match=message):
            vlm.open_vlm(kind, config)


FRAMES = np.random.default_rng(0).integers(0, 256, (20, 48, 64, 3), dtype=np.uint8)
TRAJECTORY = Trajectory("lift the red cube", dict.fromkeys(VIEWS, FRAMES), 8.0)
HEIGHT_PX = 64


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("qwen3-vl")
    torch.manual_seed(0)
    write_qwen3_vl(folder)
    return folder


class Calls:
    """The real `generate`, or an answer in its place (what weights would have to be trained for), and what it was given."""

    def __init__(self, model, tokenizer):
        self.inner, self.tokenizer = model.generate, tokenizer
        self.inputs, self.outputs, self.answer = [], [], None

    def __call__(self, **inputs):
        self.inputs.append(inputs)
        if self.answer is None:
            self.outputs.append(self.inner(**inputs))
        else:
            tokens = [*self.tokenizer(self.answer)["input_ids"], self.tokenizer.eos_token_id]
            self.outputs.append(torch.cat([inputs["input_ids"], torch.tensor([tokens])], dim=1))
        return self.outputs[-1]


@pytest.fixture(scope="module")
def loaded(folder):
    return vlm.open_vlm("qwen3_vl", VLMConfig(weights=folder))


@pytest.fixture
def opened(loaded, monkeypatch):
    calls = Calls(loaded.model, loaded.processor.tokenizer)
    monkeypatch.setattr(loaded.model, "generate", calls)
    return loaded, calls


def test_generation_is_greedy_bounded_and_sees_every_picture(opened, monkeypatch):
    model, calls = opened
    monkeypatch.setattr(vlm, "MAX_NEW_TOKENS", 12)
    picture = np.random.default_rng(0).integers(0, 256, (64, 96, 3), dtype=np.uint8)
    first, *parts = vlm.Image(picture), vlm.Text("and"), vlm.Image(picture[:32])
    answers = [model.answer([vlm.Text("what?"), image, *parts]) for image in (first, first, vlm.Image(255 - picture))]
    assert answers[0] == answers[1]
    first, _, changed = calls.inputs
    assert (first["do_sample"], first["max_new_tokens"]) == (False, 12)
    # Patches of 8 pixels: 8 x 12 and 4 x 12 of them, four of which become one token.
    assert first["image_grid_thw"].tolist() == [[1, 8, 12], [1, 4, 12]]
    assert int((first["input_ids"] == model.processor.image_token_id).sum()) == (8 * 12 + 4 * 12) // 4
    assert not torch.equal(first["pixel_values"], changed["pixel_values"])
    prompt = model.processor.tokenizer.decode(first["input_ids"][0])
    assert prompt.startswith("<|im_start|>user\nwhat?<|vision_start|><|image_pad|>")
    assert prompt.endswith("<|im_end|>\n<|im_start|>assistant\n")
    assert 1 <= calls.outputs[0].shape[1] - first["input_ids"].shape[1] <= 12


@pytest.mark.parametrize(("native", "dtype"), [(True, torch.bfloat16), (False, torch.float32)])
def test_weights_are_in_what_the_processor_computes_in(folder, monkeypatch, native, dtype):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr("worldline_core.processor.processor_has_bfloat16", lambda: native)
    assert vlm.open_vlm("qwen3_vl", VLMConfig(weights=folder)).model.dtype == dtype


def test_chosen_frames_of_a_video_are_shown_as_they_are_at_their_times(opened, monkeypatch):
    model, calls = opened
    chosen = (0, 5, 11, 19)
    monkeypatch.setattr(vlm, "MAX_NEW_TOKENS", 2)
    model.answer([vlm.Video(FRAMES[list(chosen), :32, :48], chosen, 8.0, 20), vlm.Text("what happens?")])
    inputs = calls.inputs[0]
    # Two frames make one temporal patch; sampling again would have left fewer of them.
    assert inputs["video_grid_thw"].tolist() == [[2, 4, 6]]
    prompt = model.processor.tokenizer.decode(inputs["input_ids"][0])
    # Mean time of frames 0 and 5, and of 11 and 19, at eight a second.
    assert [float(part.split(" seconds>")[0]) for part in prompt.split("<") if " seconds>" in part] == [0.3, 1.9]


def test_a_readable_answer_becomes_evidence(opened):
    model, calls = opened
    judge = judging.VLMJudge(model)
    facts = {"target_held_for_two_late_steps": True, "wrong_object_or_drop": False}
    calls.answer = f"```json\n{json.dumps(facts)}\n```"
    evidence, well_formed = judge.extract(TRAJECTORY, "grasp", (0, 10, 19), HEIGHT_PX)
    assert well_formed and judging.establishes_success(evidence)
    # A grasp's facts are no lift's evidence, and words instead of facts are none.
    assert not judge.extract(TRAJECTORY, "lift", (0, 19), HEIGHT_PX)[1]
    calls.answer = '{"target_held_for_two_late_steps": "true"}'
    assert judge.extract(TRAJECTORY, "grasp", (0, 19), HEIGHT_PX) == (judging.GraspEvidence(), False)
    calls.answer = '{"task_effect_completed": true, "observations": "it went up"}'
    motion, _ = judge.inspect_motion(TRAJECTORY, (0, 10, 19), "nothing earlier")
    assert motion == judging.MotionEvidence(task_effect_completed=True, observations="it went up")
    calls.answer = '{"observations_prove_completion": false, "reason": "held, not placed"}'
    assert judge.reconcile(TRAJECTORY, "grasp", "{}", "{}")[0].observations_prove_completion is False
    # One image a time step for grasps, one a view and time step for lifts, one video a view for motion.
    counts = [(len(inputs.get("image_grid_thw", ())), len(inputs.get("video_grid_thw", ()))) for inputs in calls.inputs]
    assert counts == [(3, 0), (6, 0), (2, 0), (0, 3), (0, 0)]


def test_a_folder_without_readable_weights_is_named(folder, tmp_path):
    (tmp_path / "config.json").write_text((folder / "config.json").read_text())
    with pytest.raises(UnavailableError, match="Qwen3-VL weights cannot be opened"):
        vlm.Qwen3VLModel.load(tmp_path)
