"""The nightly comparison: what turns a night red and what does not, history, and the page with trends."""

from __future__ import annotations

import json
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import ttest_rel

from tests.report.conftest import write_evaluation  # pyright: ignore[reportMissingImports]
from worldline_core.errors import ArtifactError, RegressionError
from worldline_core.evaluation.paired import Series, differences, paired_tests, read_scores
from worldline_core.evaluation.scores import Interval, Score, write_scores
from worldline_core.report import comparison

METRICS = ("robot_iou", "robot_iou_exact", "ssim", "hsd", "psnr", "end_effector_error_px")
METHODS = ("shipped_stage2", "shipped_causal", "copy_first_frame")
IOU = "video/test/shipped_stage2/robot_iou@head"
ERROR = IOU.replace("robot_iou", "end_effector_error_px")
SCALE = {"psnr": 20.0, "end_effector_error_px": 5.0}


def scores(
    folder: Path, mean: float, metrics: tuple[str, ...] = ("robot_iou", "end_effector_error_px")
) -> dict[str, Path]:
    folder.mkdir(parents=True, exist_ok=True)
    means = {"robot_iou": (mean, 0.02), "end_effector_error_px": (10 * (1 - mean), 0.3)}
    values = {
        f"{name}@head": {"mean": m, "low": m - margin, "high": m + margin, "count": 9}
        for name, (m, margin) in means.items()
        if name in metrics
    }
    groups = {"test": {"shipped_stage2": values}, "test/ur5e_pair": {"shipped_stage2": values}}
    (folder / "summary.json").write_text(json.dumps({"metrics": groups}))
    return {"evaluate_video": folder}


@pytest.mark.parametrize(
    ("metric", "mean", "expected"),
    [("ssim", 0.9, "better"), ("ssim", 0.45, "same"), ("ssim", 0.2, "worse"), ("lpips", 0.9, "worse"), ("lpips", 0.2, "better")],
)  # fmt: skip
def test_verdicts(metric: str, mean: float, expected: str) -> None:
    assert (
        comparison.MetricChange(metric, Interval(mean, mean, mean, 9), Interval(0.5, 0.4, 0.6, 9)).verdict == expected
    )


def test_a_regression_stays_one_until_it_is_repaired_or_accepted(tmp_path: Path) -> None:
    history = tmp_path / "history"
    first = comparison.record_night(history, "2026-11-19", scores(tmp_path / "first", 0.61))
    assert (first.previous, {change.verdict for change in first.changes}) == (None, {"new"})
    assert comparison.record_night(history, "2026-11-20", scores(tmp_path / "a", 0.6)).regressions == []
    for night in ("2026-11-21", "2026-11-22"):
        worse = comparison.record_night(history, night, scores(tmp_path / night, 0.5))
        assert (worse.previous, worse.regressions) == ("2026-11-20", [ERROR, IOU])
    comparison.accept_night(history, "2026-11-22")
    with pytest.raises(ArtifactError, match="No such night"):
        comparison.accept_night(history, "2")
    again = comparison.record_night(history, "2026-11-23", scores(tmp_path / "d", 0.5))
    assert (again.previous, again.regressions) == ("2026-11-22", [])


def test_a_second_run_of_a_day_is_compared_with_the_first(tmp_path: Path) -> None:
    history = tmp_path / "history"
    first = comparison.record_night(history, None, scores(tmp_path / "a", 0.6))
    assert (
        comparison.record_night(history, None, scores(tmp_path / "a", 0.6)) == first
    )  # the same scores: the same night
    second = comparison.record_night(history, None, scores(tmp_path / "b", 0.5))
    assert (second.previous, len(second.regressions)) == (first.night, 2)
    assert [night.night for night in comparison.read_history(history)] == [first.night, second.night]
    with pytest.raises(ArtifactError, match="recorded with other scores"):
        comparison.record_night(history, first.night, scores(tmp_path / "b", 0.5))


def test_the_page_shows_trends_regressions_and_the_history(tmp_path: Path, run_artifacts: dict[str, Path]) -> None:
    comparison.record_night(tmp_path, "first", scores(tmp_path / "a", 0.99))
    evaluations = ("evaluate_video", "evaluate_policy", "evaluate_planning")
    comparison.compare_with_history({name: run_artifacts[name] for name in evaluations}, tmp_path, "second")
    page = (tmp_path / "index.html").read_text()
    assert all(text in page for text in (IOU, "became worse", "second red, first good"))
    written = json.loads((tmp_path / "comparison.json").read_text())
    assert IOU in written["regressions"]
    assert {c["metric"] for c in written["changes"]} >= {"policy/all/true/accuracy", "planning/N=32/true/success"}


def test_nights_that_end_at_once_are_all_recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    history, meet = tmp_path / "history", threading.Barrier(4)
    read = comparison.read_history
    monkeypatch.setattr(comparison, "read_history", lambda folder: (read(folder), time.sleep(0.05))[0])

    def work(number: int) -> None:
        found = scores(tmp_path / str(number), 0.6)
        meet.wait()
        comparison.record_night(history, f"night {number}", found)

    with ThreadPoolExecutor(4) as threads:
        list(threads.map(work, range(4)))
    assert sorted(night.night for night in read(history)) == [f"night {number}" for number in range(4)]


def test_a_metric_that_is_gone_is_a_regression(tmp_path: Path) -> None:
    history = tmp_path / "history"
    comparison.record_night(history, "1", scores(tmp_path / "a", 0.6))
    worse = comparison.record_night(history, "2", scores(tmp_path / "b", 0.6, ("end_effector_error_px",)))
    assert worse.regressions == [IOU]
    with pytest.raises(RegressionError, match=f"(?s)1 of 2 metrics.*{IOU}.*worldline nightly --accept 2"):
        comparison.refuse_regressions(worse, history)


NIGHT = '{"good": true, "metrics": {"x": {"count": 9, "high": 0.6, "low": 0.4, "mean": 0.5}}, "night": "2026-11-20"}\n'


@pytest.mark.parametrize(
    ("line", "match"),
    [
        ('{"night": "2026-11-20"}\n', "not a night"),
        (NIGHT + NIGHT, "a second time"),
        # The file is written as a whole: what is cut is damage, and would be lost with the next night.
        (NIGHT + NIGHT[:40], "Invalid JSON"),
        *((NIGHT.replace("0.5", value), "not a night") for value in ("NaN", "1e999", '"0.5"', "null", "true")),
        (NIGHT.replace("true", '"false"'), "not a night"),
    ],
)
def test_a_damaged_history_is_named(tmp_path: Path, line: str, match: str) -> None:
    (tmp_path / "history.jsonl").write_text(line)
    for use in (
        comparison.read_history,
        lambda folder: comparison.record_night(folder, "later", scores(tmp_path / "a", 0.6)),
    ):
        with pytest.raises(ArtifactError, match=rf"(?s)(?=.*history\.jsonl).*{match}"):
            use(tmp_path)
    assert (tmp_path / "history.jsonl").read_text() == line


class World:
    """Recordings of different difficulty; a night measures them with noise that the metrics of a recording share in part."""

    def __init__(
        self, seed: int, recordings: int = 40, noise: float = 0.02, methods: tuple[str, ...] = METHODS
    ) -> None:
        self.random, self.noise = np.random.default_rng(seed), noise
        self.names = [f"ep-{number:03d}" for number in range(recordings)]
        self.truth = {
            (method, metric): SCALE.get(metric, 1.0) * self.random.uniform(0.5, 0.9, recordings)
            for method in methods
            for metric in METRICS
        }

    def night(self, loss: float = 0.0) -> dict[tuple[str, str], dict[str, float]]:
        """Values of recordings by method and metric; ``loss`` is taken from the robot IoU of the first method."""
        shared, found = self.random.normal(size=len(self.names)), {}
        for (method, metric), truth in self.truth.items():
            own = self.random.standard_t(4, len(self.names))
            values = truth + SCALE.get(metric, 1.0) * self.noise * (0.6 * shared + 0.6 * own)
            values -= loss * ((method, metric) == (METHODS[0], "robot_iou"))
            found[method, metric] = dict(zip(self.names, values.tolist(), strict=True))
        return found

    def series(self, loss: float = 0.0) -> Series:
        return {f"video/test/{method}/{metric}@head": values for (method, metric), values in self.night(loss).items()}

    def write(self, folder: Path, loss: float = 0.0) -> dict[str, Path]:
        """The files of an evaluation."""
        scores = [
            Score(method, name, "ur5e_pair", "test", "head", 42, metric, value)
            for (method, metric), values in self.night(loss).items()
            for name, value in values.items()
        ]
        return write_evaluation(folder, scores)


def verdicts(present: Series, good: list[Series]) -> dict[str, str]:
    return {name: comparison.verdict_of(name, test) for name, test in comparison.night_tests(present, good).items()}


def test_a_loss_of_three_points_of_iou_turns_the_night_red_and_is_named(tmp_path: Path) -> None:
    world, history = World(1, methods=METHODS[:1]), tmp_path / "history"
    for number in "012":
        assert comparison.record_night(history, number, world.write(tmp_path / number)).regressions == []
    worse = comparison.record_night(history, "bad", world.write(tmp_path / "bad", loss=0.03))
    # The mean over all views is of the same values here: only the head was measured.
    assert worse.regressions == [IOU.removesuffix("@head"), IOU]
    with pytest.raises(RegressionError, match=rf"(?s)(?=.*{IOU})(?=.*40 recordings, most on ep-).*--accept bad"):
        comparison.refuse_regressions(worse, history)
    # It stays red until it is repaired.
    assert comparison.record_night(history, "still", world.write(tmp_path / "still", loss=0.03)).previous == "2"
    assert comparison.record_night(history, "good again", world.write(tmp_path / "again")).regressions == []


@pytest.mark.slow
def test_false_alarms_are_rare_over_two_hundred_nights_of_pure_noise() -> None:
    alarms = 0
    for world in (World(3, 16), World(4, 40)):
        good = [world.series()]
        for _ in range(100):
            present = world.series()
            if "worse" in verdicts(present, good).values():
                alarms += 1
            else:
                good.append(present)
    assert alarms <= 10  # 5 %


def test_losses_are_found_almost_always() -> None:
    world = World(5)
    good = [world.series() for _ in range(comparison.REFERENCE_NIGHTS)]
    assert sum(verdicts(world.series(loss=0.03), good)[IOU] == "worse" for _ in range(20)) >= 19
    world = World(6, noise=0.01)
    good = [world.series() for _ in range(comparison.REFERENCE_NIGHTS)]
    for number in range(1, 11):  # a slow drift, before it is three points
        present = world.series(loss=0.003 * number)
        if verdicts(present, good)[IOU] == "worse":
            return
        good.append(present)
    pytest.fail("a drift of 0.003 a night was not found in ten nights")


def test_the_same_scores_and_rounding_are_no_change() -> None:
    night = World(7).series()

    def changed(by: float) -> dict[str, str]:
        present = {name: {r: value + by for r, value in values.items()} for name, values in night.items()}
        return verdicts(present, [night] * comparison.REFERENCE_NIGHTS)

    for by in (0.0, -1e-6):
        assert "worse" not in changed(by).values()
    # A loss that is the same on every recording has no spread, and is no chance.
    assert changed(-0.03)[IOU] == "worse"
    assert changed(0.3)[IOU] == "better"
    assert changed(0.3)[ERROR] == "worse"  # of an error more is worse


def test_only_recordings_of_both_nights_count() -> None:
    first = {IOU: {f"e{n}": 0.5 for n in range(20)}}
    second = {IOU: {f"e{n}": 0.5 if n < 20 else 0.0 for n in range(10, 40)}}
    assert sorted(differences(second, first)[IOU]) == [f"e{n}" for n in range(10, 20)]
    assert verdicts(second, [first])[IOU] == "same"
    assert verdicts({IOU: {"other": 0.1}}, [first]) == {}


def test_p_values_agree_with_a_paired_t_test() -> None:
    random = np.random.default_rng(0)
    a, b = random.normal(0.5, 0.1, 60), random.normal(0.53, 0.1, 60)
    found = {"video/test/a/ssim@head": {f"{n}": float(x - y) for n, (x, y) in enumerate(zip(a, b, strict=True))}}
    (test,) = paired_tests(found).values()
    assert test.p_worse == pytest.approx(ttest_rel(a, b, alternative="less").pvalue, abs=0.02)
    assert test.p_better == pytest.approx(ttest_rel(a, b, alternative="greater").pvalue, abs=0.02)
    assert test.low < test.mean < test.high
    # Among many series a difference that one alone would have is expected.
    others = {f"video/test/{k}/ssim@head": dict(enumerate(random.normal(0, 0.1, 60))) for k in range(50)}
    many = paired_tests(found | {n: {str(r): float(x) for r, x in v.items()} for n, v in others.items()})
    assert many["video/test/a/ssim@head"].p_worse > 3 * test.p_worse


def test_scores_of_every_evaluation_are_read_under_the_names_of_the_summaries(
    run_artifacts: dict[str, Path], tmp_path: Path
) -> None:
    series = read_scores(run_artifacts["evaluate_video"])
    summary = json.loads((run_artifacts["evaluate_video"] / "summary.json").read_text())
    for method in ("shipped_stage2", "copy_first_frame"):
        for metric in ("robot_iou@head", "ssim@head"):
            mean = summary["metrics"]["test"][method][metric]["mean"]
            assert np.mean(list(series[f"video/test/{method}/{metric}"].values())) == pytest.approx(mean)
    rows = [Score("a", f"e{n}", "ur5e", "test", "", 0, "correct", float(n % 2), task_family="lift") for n in range(4)]
    rows += [Score("a", "bank", "ur5e", "bank", "", run, "success@8", float(run)) for run in range(2)]
    write_scores(tmp_path, rows)
    found = read_scores(tmp_path, subgroups=True)
    assert found["policy/all/a/accuracy"] == found["policy/lift/a/accuracy"] == {"e0": 0, "e1": 1, "e2": 0, "e3": 1}
    assert found["planning/N=8/a/success"] == found["planning/N=8|ur5e/a/success"] == {"bank": 0.5}
