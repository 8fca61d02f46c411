import json

import numpy as np
import pytest
from scipy import stats

from worldline_core.errors import DataError
from worldline_core.evaluation.evaluation_config import PolicyEvaluationConfig
from worldline_core.evaluation.policy.evaluate_policy import evaluate_policy, mmrv, pearson, policy_agreement, spearman
from worldline_core.report.results import policy_ranking

OPTIONS = {"resamples": 400, "seed": 1}
COMPARED = PolicyEvaluationConfig(
    segmenter="colour", splits=("test",), balanced=False, compare_policies=True, resamples=100
)


def verdicts(rates, predicted=None, *, starts=60, method="model", task="lift", paired=True, seed=0):
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
        worst = [
            max(
                abs(recorded[i] - recorded[j])
                * ((predicted[i] > predicted[j]) != (recorded[i] > recorded[j]))
                for j in range(9)
            )
            for i in range(9)
        ]  # fmt: skip
        assert mmrv(recorded, predicted) == pytest.approx(sum(worst) / 9)


@pytest.mark.parametrize("paired", [True, False])
def test_policies_that_are_predicted_rightly_agree_and_reversed_ones_do_not(paired):
    rates = np.linspace(0.05, 0.95, 8)
    right = policy_agreement(verdicts(rates, rates, paired=paired), **OPTIONS)["model"]["all"]
    wrong = policy_agreement(verdicts(rates, rates[::-1], paired=paired), **OPTIONS)["model"]["all"]
    assert right["pearson"]["value"] > 0.9 > 0.1 > right["mmrv"]["value"]
    assert wrong["pearson"]["value"] < -0.9
    assert wrong["mmrv"]["value"] > 0.5
    for found in (right, wrong):
        for statistic in ("pearson", "spearman", "mmrv", "rate_error"):
            low, high = found[statistic]["over_starts_and_policies"]
            assert low - 0.05 <= found[statistic]["value"] <= high + 0.05


def test_nothing_but_chance_is_told_by_the_interval():
    """Of 40 simulators that know nothing, few have an interval above zero."""
    random = np.random.default_rng(5)
    above = 0
    for seed in range(40):
        rates, guesses = random.uniform(0.1, 0.9, (2, 8))
        found = policy_agreement(verdicts(rates, guesses, starts=30, seed=seed), resamples=200, seed=0)["model"]["all"]
        above += found["pearson"]["over_starts_and_policies"][0] > 0
    assert above <= 6


def test_predictions_under_several_seeds_are_averaged_and_tasks_stand_apart():
    rates = (0.1, 0.5, 0.9)
    twice = verdicts(rates, starts=20) + verdicts(rates, (0.0, 0.0, 0.0), starts=20)
    found = policy_agreement(twice + verdicts(rates, rates, task="press"), **OPTIONS)["model"]
    assert set(found) == {"all", "lift", "press"}
    best = found["lift"]["policies"]["policy_2"]
    assert best["attempts"] == 20
    assert 0.3 < best["predicted"] < 0.6 < best["recorded"]


def test_equal_rates_have_no_correlation():
    found = policy_agreement(verdicts((0.0, 0.0, 0.0)), **OPTIONS)["model"]["all"]
    assert found["pearson"]["value"] is None
    assert found["mmrv"]["value"] == 0.0


@pytest.mark.slow
def test_the_step_compares_the_sources_of_its_episodes(policies, tmp_path):
    evaluate_policy(COMPARED, policies.inputs, tmp_path)
    found = json.loads((tmp_path / "summary.json").read_text())["policies"]
    assert {name: p["recorded"] for name, p in found["good"]["all"]["policies"].items()} == pytest.approx(
        {"policy_a": 1.0, "policy_b": 2 / 3, "policy_c": 0.0}
    )
    assert found["good"]["lift"]["pearson"]["value"] == pytest.approx(1.0)
    # A simulator in which nothing moves predicts no success.
    assert found["copy"]["all"]["pearson"]["value"] is None
    assert found["copy"]["all"]["rate_error"]["value"] == pytest.approx(5 / 9)
    page = policy_ranking(found)
    assert page["names"][0] == "policy_a"
    first = page["rates"]["good"]["policy_a"]
    assert (first["attempts"], first["recorded"]) == (3, 1.0)


def test_one_source_is_refused_before_anything_is_judged(recordings, tmp_path, monkeypatch):
    monkeypatch.setattr("worldline_core.evaluation.policy.evaluate_policy.judge_trajectory", None)
    with pytest.raises(DataError, match="at least three sources"):
        evaluate_policy(COMPARED, recordings.inputs, tmp_path)
