import json
from types import SimpleNamespace

import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy.stats import mannwhitneyu

from worldline_core.errors import ConfigError, DataError
from worldline_core.evaluation.evaluation_config import PolicyEvaluationConfig, TrustConfig
from worldline_core.evaluation.policy.evaluate_policy import evaluate_policy
from worldline_core.evaluation.policy.judge import confidence_of
from worldline_core.evaluation.policy.trust import (
    TRUST_COLUMNS,
    KnownRecordings,
    control_vectors,
    fit_right,
    halves,
    probability,
    setup_vectors,
    trust_verdicts,
)

OPTIONS = {"resamples": 200, "seed": 3}


def verdicts(starts=150, policies=6, *, seed=0, right=None):
    """Verdicts whose probability to be right is known: less for doubtful ones and for new controls; (rows, probability)."""
    random = np.random.default_rng(seed)
    rows, chances = [], []
    for start in range(starts):
        for policy in range(policies):
            doubt, news = random.uniform(), np.exp(random.normal(-0.5, 0.6))
            chance = 1 / (1 + np.exp(-(1.5 - 0.9 * np.log((doubt + 0.02) / (1.02 - doubt)) - 1.2 * np.log(news))))
            ends = "success" if random.uniform() < (policy + 1) / (policies + 1) else "failure"
            is_right = random.uniform() < chance if right is None else right
            rows.append({
                "method": "model", "episode_id": f"{policy}-{start}", "seed": 42, "start": f"{start}", "policy": f"p{policy}",
                "task": "lift", "outcome": ends, "confidence": 1 - doubt, "new_controls": news, "new_setup": None,
                "predicted": ends if is_right else {"success": "failure", "failure": "success"}[ends],
            })  # fmt: skip
            chances.append(chance)
    return rows, np.array(chances)


@pytest.fixture(scope="module")
def known():
    rows, chances = verdicts()
    trusted, methods = trust_verdicts(rows, TrustConfig(), **OPTIONS)
    return trusted, methods["model"], chances


def test_trust_is_the_probability_that_is_known(known):
    trusted, found, chances = known
    trust = np.array([row["trust"] for row in trusted])
    assert np.abs(trust - chances).mean() < 0.03
    assert found["calibration_error"]["value"] < 0.05
    assert found["calibration_error"]["low"] < found["calibration_error"]["high"]
    inside = [b["low"] <= b["trust"] <= b["high"] for b in found["reliability"]]
    assert sum(inside) >= 7
    assert sum(b["count"] for b in found["reliability"]) == len(trusted)


def test_what_detects_errors_is_ranked_as_the_literature_does(known):
    trusted, found, _ = known
    trust = np.array([row["trust"] for row in trusted])
    right = np.array([row["predicted"] == row["outcome"] for row in trusted])
    u = mannwhitneyu(-trust[~right], -trust[right]).statistic
    assert found["auroc"]["value"] == pytest.approx(u / (right.sum() * (~right).sum()), abs=1e-5)
    assert found["auroc"]["low"] < found["auroc"]["value"] < found["auroc"]["high"]
    assert found["error"]["value"] == pytest.approx(np.mean(~right))
    assert found["error_of_marked"]["low"] > found["error_of_others"]["high"]


def test_a_half_plays_no_part_in_its_own_calibration():
    rows, _ = verdicts(40)
    half = halves([row["start"] for row in rows], OPTIONS["seed"])
    before = trust_verdicts(rows, TrustConfig(), **OPTIONS)[0]
    changed = [{**row, "outcome": "success"} if half[i] == 0 else row for i, row in enumerate(rows)]
    after = trust_verdicts(changed, TrustConfig(), **OPTIONS)[0]
    same = np.array([a["trust"] == b["trust"] for a, b in zip(before, after, strict=True)])
    assert same[half == 0].all()
    assert not same[half == 1].any()


def test_more_doubt_is_never_more_trust():
    random = np.random.default_rng(0)
    doubt = random.normal(size=(400, 1))
    backwards = random.uniform(size=400) < 1 / (1 + np.exp(-2 * doubt[:, 0]))
    weights = fit_right(doubt, backwards)
    assert weights[1] == 0
    assert probability(weights, doubt) == pytest.approx(np.full(400, backwards.mean()), abs=1e-3)


@pytest.mark.parametrize("right", [True, False])
def test_verdicts_that_are_all_right_or_all_wrong_cannot_be_calibrated(right):
    rows, _ = verdicts(20, right=right)
    rows[0]["new_controls"] = 3.0
    trusted, methods = trust_verdicts(rows, TrustConfig(), **OPTIONS)
    assert not methods["model"]["available"]
    assert "5 of each are needed" in methods["model"]["reason"]
    assert {row["trust"] for row in trusted} == {None}
    assert trusted[0]["do_not_trust"] == "new controls"  # the mark needs no calibration


def test_without_any_signal_there_is_a_reason():
    rows = [{**row, "confidence": None, "new_controls": None} for row in verdicts(20)[0]]
    assert "no signal is known" in trust_verdicts(rows, TrustConfig(), **OPTIONS)[1]["model"]["reason"]


def test_a_signal_that_is_no_number_is_refused():
    rows, _ = verdicts(5)
    rows[7]["new_controls"] = float("nan")
    with pytest.raises(DataError, match="new_controls of 1-1"):
        trust_verdicts(rows, TrustConfig(), **OPTIONS)


def test_controls_like_none_of_the_training_are_new_beyond_measure():
    rows, _ = verdicts(30)
    rows[0]["new_controls"] = float("inf")
    trusted, _ = trust_verdicts(rows, TrustConfig(), **OPTIONS)
    assert trusted[0]["trust"] < 0.6
    assert "new controls" in trusted[0]["do_not_trust"]


def test_seeds_that_disagree_make_doubt():
    row = {**verdicts(1)[0][0], "confidence": 0.9, "predicted": "success"}
    alone = trust_verdicts([row], TrustConfig(), **OPTIONS)[0]
    agreeing = trust_verdicts([row, {**row, "seed": 43, "confidence": 0.7}], TrustConfig(), **OPTIONS)[0]
    other = trust_verdicts([row, {**row, "seed": 43, "predicted": "failure"}], TrustConfig(), **OPTIONS)[0]
    assert alone[0]["doubt"] == pytest.approx(0.1)
    assert [r["doubt"] for r in agreeing] == pytest.approx([0.2, 0.2])
    assert [r["doubt"] for r in other] == pytest.approx([0.5, 0.5])


def test_another_model_that_disagrees_tells_which_verdicts_are_wrong():
    rows, _ = verdicts(60)
    random = np.random.default_rng(2)
    # The other model is mostly right, and sure of what it says.
    wiser = [
        {
            **row,
            "method": "other",
            "confidence": 0.9,
            "predicted": row["outcome"] if random.uniform() < 0.9 else row["predicted"],
        }
        for row in rows
    ]
    alone = trust_verdicts(rows + wiser, TrustConfig(), **OPTIONS)[1]["model"]
    compared = trust_verdicts(rows + wiser, TrustConfig(compare_with={"model": "other"}), **OPTIONS)[1]
    assert compared["model"]["auroc"]["low"] > alone["auroc"]["high"]
    with pytest.raises(ConfigError, match="other"):
        trust_verdicts(rows, TrustConfig(compare_with={"model": "other"}), **OPTIONS)


@pytest.mark.parametrize(
    ("success", "decided_by", "confidences", "expected"),
    [
        (True, "first_pass", [0.8], 0.8),
        (True, "verification", [0.9, 0.7], 0.7),
        (True, "motion", [0.9, 0.6, None], 0.6),
        (False, "motion", [0.9, 0.6, None], 0.6),
        (False, "first_pass", [7.0], 1.0),
        (False, "motion", [None], None),
    ],
)
def test_the_confidence_in_a_verdict_is_that_of_its_evidence(success, decided_by, confidences, expected):
    statements = [{} if c is None else {"confidence": c} for c in confidences]
    assert confidence_of({"success": success, "decided_by": decided_by, "statements": statements}) == expected


def path(random: np.random.Generator, *, waits=0, arms=1, body="arm", camera=0.0, frames=33):
    """Tracks of a tool that moves 3 cm a frame or so along x, after it has waited."""
    poses = np.tile(np.eye(4), (frames, arms, 1, 1))
    speed = 0.03 * random.uniform(0.8, 1.2)
    poses[:, 0, 0, 3] = speed * np.maximum(np.arange(frames) - waits, 0)
    cameras = np.tile(np.eye(4), (frames, 3, 1, 1))
    cameras[:, 0, 0, 3] = random.uniform(-0.1, 0.1) + camera
    return SimpleNamespace(
        episode_id="e", embodiment=body, arms=("left", "right")[:arms], views=("head", "left_wrist", "right_wrist"), num_frames=frames,
        T_base_tool=poses, gripper=np.ones((frames, 3, arms)), T_base_camera=cameras, K=np.tile(np.eye(3), (3, 1, 1)),
        image_size=(64, 96), camera_motion=("static",) * 3,
    )  # fmt: skip


def test_controls_that_wait_are_new_and_those_of_training_are_not():
    random = np.random.default_rng(0)
    known = KnownRecordings.of([control_vectors(path(random)) for _ in range(100)])
    usual = [known.novelty(*control_vectors(path(random))) for _ in range(200)]
    assert np.mean(np.array(usual) > 1) < 0.15
    assert known.novelty(*control_vectors(path(random, waits=12))) > 2
    # It is known as soon as the robot has not moved with the others.
    assert known.novelty(*control_vectors(path(random, waits=12, frames=9))) > 2
    assert known.novelty(*control_vectors(path(random, arms=2))) == float("inf")
    # What lies after the end of nearly all training recordings is not compared.
    assert known.novelty(*control_vectors(path(random, frames=65))) < 3


def test_a_new_body_or_place_of_the_head_camera_is_a_new_setup():
    random = np.random.default_rng(0)
    known = KnownRecordings.of([setup_vectors(path(random)) for _ in range(50)])
    assert known.novelty(*setup_vectors(path(random))) < 1
    assert known.novelty(*setup_vectors(path(random, camera=0.5))) > 5
    assert known.novelty(*setup_vectors(path(random, body="other"))) == float("inf")


def test_too_few_training_recordings_or_frames_are_refused():
    random = np.random.default_rng(0)
    with pytest.raises(DataError, match="'1': 4"):
        KnownRecordings.of([control_vectors(path(random))] * 4)
    with pytest.raises(DataError, match="more than 4"):
        control_vectors(path(random, frames=4))


CONFIG = PolicyEvaluationConfig(
    segmenter="colour", splits=("test",), balanced=False, resamples=100, trust=TrustConfig()
)


def test_the_step_marks_what_begins_later_than_any_training_recording(trained, tmp_path):
    evaluate_policy(CONFIG, trained.inputs, tmp_path)
    rows = pq.read_table(tmp_path / "decisions.parquet").to_pylist()
    assert set(TRUST_COLUMNS) <= set(rows[0])
    marks = {(row["method"], row["episode_id"]): row["do_not_trust"] for row in rows}
    assert marks["good", "late"] == "new controls"
    assert marks["good", "prompt"] == ""
    assert marks["true", "late"] is None  # a recorded video is not predicted
    doubts = {row["method"]: row["doubt"] for row in rows if row["episode_id"] == "prompt"}
    assert 0 < doubts["good"] < 0.5
    found = json.loads((tmp_path / "summary.json").read_text())["trust"]
    assert found["training_recordings"] == 20
    assert "5 of each are needed" in found["methods"]["good"]["reason"]


def test_trust_needs_tracks_and_training_recordings(recordings, trained, tmp_path):
    inputs = {name: path for name, path in trained.inputs.items() if name != "tracks"}
    with pytest.raises(ConfigError, match="input tracks"):
        evaluate_policy(CONFIG, inputs, tmp_path)
    with pytest.raises(DataError, match="Too few training recordings"):
        evaluate_policy(CONFIG, recordings.inputs, tmp_path)
