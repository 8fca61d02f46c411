"""Trust in verdicts, and the ranking of policies beside the real one."""

import json

import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy import stats
from scipy.stats import mannwhitneyu

from tests.evaluation.conftest import POLICY
from tests.training.conftest import build_tracks
from worldline_core.errors import ConfigError, DataError
from worldline_core.evaluation.evaluation_config import TrustConfig
from worldline_core.evaluation.policy import trust as trusting
from worldline_core.evaluation.policy.evaluate_policy import evaluate_policy, mmrv, pearson, policy_agreement, spearman
from worldline_core.evaluation.policy.judge import confidence_of

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
def calibrated():
    rows, chances = verdicts()
    trusted, methods = trusting.trust_verdicts(rows, TrustConfig(), **OPTIONS)
    return trusted, methods["model"], chances


def test_trust_is_the_probability_that_is_known(calibrated):
    trusted, found, chances = calibrated
    trust = np.array([row["trust"] for row in trusted])
    assert np.abs(trust - chances).mean() < 0.03
    for name in ("calibration_error", "auroc"):
        assert found[name]["low"] < found[name]["value"] < found[name]["high"]
    assert found["calibration_error"]["value"] < 0.05
    assert sum(b["low"] <= b["trust"] <= b["high"] for b in found["reliability"]) >= 7
    assert sum(b["count"] for b in found["reliability"]) == len(trusted)
    # What detects errors is ranked as the literature does.
    right = np.array([row["predicted"] == row["outcome"] for row in trusted])
    u = mannwhitneyu(-trust[~right], -trust[right]).statistic
    assert found["auroc"]["value"] == pytest.approx(u / (right.sum() * (~right).sum()), abs=1e-5)
    assert found["error"]["value"] == pytest.approx(np.mean(~right))
    assert found["error_of_marked"]["low"] > found["error_of_others"]["high"]


def test_a_half_plays_no_part_in_its_own_calibration():
    rows, _ = verdicts(40)
    half = trusting.halves([row["start"] for row in rows], OPTIONS["seed"])
    before = trusting.trust_verdicts(rows, TrustConfig(), **OPTIONS)[0]
    changed = [{**row, "outcome": "success"} if half[i] == 0 else row for i, row in enumerate(rows)]
    after = trusting.trust_verdicts(changed, TrustConfig(), **OPTIONS)[0]
    same = np.array([a["trust"] == b["trust"] for a, b in zip(before, after, strict=True)])
    assert same[half == 0].all()
    assert not same[half == 1].any()


def test_more_doubt_is_never_more_trust():
    random = np.random.default_rng(0)
    doubt = random.normal(size=(400, 1))
    backwards = random.uniform(size=400) < 1 / (1 + np.exp(-2 * doubt[:, 0]))
    weights = trusting.fit_right(doubt, backwards)
    assert weights[1] == 0
    assert trusting.probability(weights, doubt) == pytest.approx(np.full(400, backwards.mean()), abs=1e-3)


@pytest.mark.parametrize("right", [True, False])
def test_verdicts_that_are_all_right_or_all_wrong_cannot_be_calibrated(right):
    rows, _ = verdicts(20, right=right)
    rows[0]["new_controls"] = 3.0
    trusted, methods = trusting.trust_verdicts(rows, TrustConfig(), **OPTIONS)
    assert not methods["model"]["available"] and "5 of each" in methods["model"]["reason"]
    assert {row["trust"] for row in trusted} == {None}
    assert trusted[0]["do_not_trust"] == "new controls"  # the mark needs no calibration


def test_signals_may_lack_or_be_infinite_but_are_numbers():
    rows, _ = verdicts(30)
    silent = [{**row, "confidence": None, "new_controls": None} for row in rows]
    assert "no signal is known" in trusting.trust_verdicts(silent, TrustConfig(), **OPTIONS)[1]["model"]["reason"]
    rows[0]["new_controls"] = float("inf")  # controls like none of the training
    trusted, _ = trusting.trust_verdicts(rows, TrustConfig(), **OPTIONS)
    assert trusted[0]["trust"] < 0.6 and "new controls" in trusted[0]["do_not_trust"]
    rows[7]["new_controls"] = float("nan")
    with pytest.raises(DataError, match="new_controls of 1-1"):
        trusting.trust_verdicts(rows, TrustConfig(), **OPTIONS)


@pytest.mark.parametrize(
    ("beside", "doubts"),
    [([], [0.1]), ([{"seed": 43, "confidence": 0.7}], [0.2] * 2), ([{"seed": 43, "predicted": "failure"}], [0.5] * 2)],
)
def test_seeds_that_disagree_make_doubt(beside, doubts):
    row = {**verdicts(1)[0][0], "confidence": 0.9, "predicted": "success"}
    rows, _ = trusting.trust_verdicts([row, *({**row, **other} for other in beside)], TrustConfig(), **OPTIONS)
    assert [found["doubt"] for found in rows] == pytest.approx(doubts)


def test_another_model_that_disagrees_tells_which_verdicts_are_wrong():
    rows, _ = verdicts(60)
    random = np.random.default_rng(2)
    # The other model is mostly right, and sure of what it says.
    other = {"method": "other", "confidence": 0.9}
    wiser = [row | other | ({"predicted": row["outcome"]} if random.uniform() < 0.9 else {}) for row in rows]
    config = TrustConfig(compare_with={"model": "other"})
    alone, compared = (trusting.trust_verdicts(rows + wiser, c, **OPTIONS)[1]["model"] for c in (TrustConfig(), config))
    assert compared["auroc"]["low"] > alone["auroc"]["high"]
    with pytest.raises(ConfigError, match="other"):
        trusting.trust_verdicts(rows, config, **OPTIONS)


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


def path(random, *, waits=0, arms=1, body="arm", camera=0.0, frames=33):
    """Tracks of a tool that moves 3 cm a frame or so along x, after it has waited."""
    poses = np.tile(np.eye(4), (frames, arms, 1, 1))
    poses[:, 0, 0, 3] = 0.03 * random.uniform(0.8, 1.2) * np.maximum(np.arange(frames) - waits, 0)
    cameras = np.tile(np.eye(4), (frames, 3, 1, 1))
    cameras[:, 0, 0, 3] = random.uniform(-0.1, 0.1) + camera
    moved = {"embodiment": body, "image_size": (64, 96), "T_base_tool": poses, "T_base_camera": cameras}
    return build_tracks("e", frames, arms, **moved)


def test_controls_that_wait_are_new_and_those_of_training_are_not():
    random = np.random.default_rng(0)
    known = trusting.KnownRecordings.of([trusting.control_vectors(path(random)) for _ in range(100)])

    def novelty(**changes):
        return known.novelty(*trusting.control_vectors(path(random, **changes)))

    assert np.mean([novelty() > 1 for _ in range(200)]) < 0.15
    assert novelty(waits=12) > 2
    assert novelty(waits=12, frames=9) > 2  # known as soon as the robot has not moved with the others
    assert novelty(arms=2) == float("inf")
    assert novelty(frames=65) < 3  # what lies after the end of nearly all training recordings is not compared


def test_a_new_body_or_place_of_the_head_camera_is_a_new_setup():
    random = np.random.default_rng(0)
    known = trusting.KnownRecordings.of([trusting.setup_vectors(path(random)) for _ in range(50)])
    assert known.novelty(*trusting.setup_vectors(path(random))) < 1
    assert known.novelty(*trusting.setup_vectors(path(random, camera=0.5))) > 5
    assert known.novelty(*trusting.setup_vectors(path(random, body="other"))) == float("inf")
    with pytest.raises(DataError, match="'1': 4"):
        trusting.KnownRecordings.of([trusting.control_vectors(path(random))] * 4)
    with pytest.raises(DataError, match="more than 4"):
        trusting.control_vectors(path(random, frames=4))


CONFIG = POLICY.model_copy(update={"balanced": False, "trust": TrustConfig()})
COMPARED = POLICY.model_copy(update={"balanced": False, "compare_policies": True})


def test_the_step_marks_what_begins_later_than_any_training_recording(trained, tmp_path):
    evaluate_policy(CONFIG, trained.inputs, tmp_path)
    rows = pq.read_table(tmp_path / "decisions.parquet").to_pylist()
    assert set(trusting.TRUST_COLUMNS) <= set(rows[0])
    marks = {(row["method"], row["episode_id"]): row["do_not_trust"] for row in rows}
    # A recorded video is not predicted.
    found = (marks["good", "late"], marks["good", "prompt"], marks["true", "late"])
    assert found == ("new controls", "", None)
    doubts = {row["method"]: row["doubt"] for row in rows if row["episode_id"] == "prompt"}
    assert 0 < doubts["good"] < 0.5
    found = json.loads((tmp_path / "summary.json").read_text())["trust"]
    assert found["training_recordings"] == 8
    assert "5 of each are needed" in found["methods"]["good"]["reason"]


@pytest.mark.slow
def test_trust_needs_tracks_and_training_recordings_and_a_comparison_sources(
    recordings, trained, tmp_path, monkeypatch
):
    with pytest.raises(ConfigError, match="input tracks"):
        evaluate_policy(CONFIG, {name: path for name, path in trained.inputs.items() if name != "tracks"}, tmp_path)
    with pytest.raises(DataError, match="Too few training recordings"):
        evaluate_policy(CONFIG, recordings.inputs, tmp_path)
    monkeypatch.setattr("worldline_core.evaluation.policy.evaluate_policy.judge_trajectory", None)
    with pytest.raises(DataError, match="at least three sources"):  # before anything is judged
        evaluate_policy(COMPARED, recordings.inputs, tmp_path)


DRAWS = {"resamples": 400, "seed": 1}


def attempts_of(rates, predicted=None, *, starts=60, method="model", task="lift", paired=True, seed=0):
    """Attempts of policies with these recorded success rates; predicted likewise (by default as recorded)."""
    random = np.random.default_rng(seed)
    rows = []
    for number, rate in enumerate(rates):
        for start in range(starts):
            ends = random.uniform() < rate
            says = ends if predicted is None else random.uniform() < predicted[number]
            rows.append({
                "method": method, "policy": f"policy_{number}", "task": task,
                "start": f"{start}" if paired else f"{number}-{start}", "episode_id": f"{number}-{start}",
                "outcome": "success" if ends else "failure", "predicted": "success" if says else "failure",
            })  # fmt: skip
    return rows


def test_the_statistics_are_those_of_the_literature():
    random = np.random.default_rng(3)
    for _ in range(20):
        recorded, predicted = random.integers(0, 6, (2, 9)) / 5
        assert pearson(recorded, predicted) == pytest.approx(stats.pearsonr(recorded, predicted).statistic)
        assert spearman(recorded, predicted) == pytest.approx(stats.spearmanr(recorded, predicted).statistic)
        gaps, ranks = (recorded[:, None] - recorded, predicted[:, None] > predicted)
        worst = np.where(ranks != (gaps > 0), np.abs(gaps), 0).max(axis=1)
        assert mmrv(recorded, predicted) == pytest.approx(worst.mean())


@pytest.mark.parametrize("paired", [True, False])
def test_policies_that_are_predicted_rightly_agree_and_reversed_ones_do_not(paired):
    rates = np.linspace(0.05, 0.95, 8)
    right = policy_agreement(attempts_of(rates, rates, paired=paired), **DRAWS)["model"]["all"]
    wrong = policy_agreement(attempts_of(rates, rates[::-1], paired=paired), **DRAWS)["model"]["all"]
    assert right["pearson"]["value"] > 0.9 > 0.1 > right["mmrv"]["value"]
    assert wrong["pearson"]["value"] < -0.9 and wrong["mmrv"]["value"] > 0.5
    for found in (right, wrong):
        for statistic in ("pearson", "spearman", "mmrv", "rate_error"):
            low, high = found[statistic]["over_starts_and_policies"]
            assert low - 0.05 <= found[statistic]["value"] <= high + 0.05


def test_nothing_but_chance_is_told_by_the_interval():
    """Few of 40 simulators that know nothing have an interval above zero."""
    random = np.random.default_rng(5)
    above = 0
    for seed in range(40):
        rows = attempts_of(*random.uniform(0.1, 0.9, (2, 8)), starts=30, seed=seed)
        found = policy_agreement(rows, resamples=100, seed=0)["model"]["all"]
        above += found["pearson"]["over_starts_and_policies"][0] > 0
    assert above <= 6
    found = policy_agreement(attempts_of((0.0, 0.0, 0.0)), **DRAWS)["model"]["all"]
    assert (found["pearson"]["value"], found["mmrv"]["value"]) == (None, 0.0)  # equal rates have no correlation


def test_predictions_under_several_seeds_are_averaged_and_tasks_stand_apart():
    rates = (0.1, 0.5, 0.9)
    twice = attempts_of(rates, starts=20) + attempts_of(rates, (0.0, 0.0, 0.0), starts=20)
    found = policy_agreement(twice + attempts_of(rates, rates, task="press"), **DRAWS)["model"]
    assert set(found) == {"all", "lift", "press"}
    best = found["lift"]["policies"]["policy_2"]
    assert best["attempts"] == 20 and 0.3 < best["predicted"] < 0.6 < best["recorded"]


@pytest.mark.slow
def test_the_step_compares_the_sources_of_its_episodes(policies, tmp_path):
    evaluate_policy(COMPARED, policies.inputs, tmp_path)
    found = json.loads((tmp_path / "summary.json").read_text())["policies"]
    recorded = [found["good"]["all"]["policies"][f"policy_{name}"]["recorded"] for name in "abc"]
    assert recorded == pytest.approx([1.0, 2 / 3, 0.0])
    assert found["good"]["lift"]["pearson"]["value"] == pytest.approx(1.0)
    # A simulator in which nothing moves predicts no success.
    assert found["copy"]["all"]["pearson"]["value"] is None
    assert found["copy"]["all"]["rate_error"]["value"] == pytest.approx(5 / 9)
