import numpy as np
import pytest

from worldline_core.errors import DataError
from worldline_core.evaluation.scores import bootstrap_mean, paired_difference


def test_interval_covers_the_true_mean_about_as_often_as_it_says():
    generator = np.random.default_rng(0)
    hits = 0
    for trial in range(200):
        interval = bootstrap_mean(generator.normal(3.0, 2.0, size=40), resamples=300, seed=trial)
        hits += interval.low <= 3.0 <= interval.high
    assert 0.88 <= hits / 200 <= 0.99


def test_same_seed_same_interval_and_another_seed_another():
    values = np.random.default_rng(1).random(20)
    assert bootstrap_mean(values, seed=5) == bootstrap_mean(values, seed=5)
    assert bootstrap_mean(values, seed=5) != bootstrap_mean(values, seed=6)


def test_weights_make_the_mean_one_over_pairs():
    # Two trajectories: one with three views of 1.0, one with a single view of 0.0.
    assert bootstrap_mean([1.0, 0.0], weights=[3, 1]).mean == pytest.approx(0.75)


def test_values_that_are_not_finite_are_refused():
    with pytest.raises(DataError, match="finite"):
        bootstrap_mean([1.0, float("nan")])
    with pytest.raises(DataError, match="finite"):
        bootstrap_mean([])


def test_pairing_removes_what_is_hard_for_both():
    generator = np.random.default_rng(2)
    difficulty = {f"t{i}": float(generator.normal(0, 10)) for i in range(30)}
    better = {name: value + 1.0 for name, value in difficulty.items()}
    interval = paired_difference(better, difficulty)
    assert interval.mean == pytest.approx(1.0)
    assert interval.low > 0.9


def test_difference_uses_common_trajectories_only():
    interval = paired_difference({"a": 1.0, "b": 5.0}, {"a": 0.5, "c": 9.0})
    assert (interval.mean, interval.count) == (0.5, 1)
    assert paired_difference({"a": 1.0}, {"b": 1.0}) is None
