"""What turns a night red, and what does not: on tables of scores, simulated and written."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import ttest_rel

from worldline_core.errors import RegressionError
from worldline_core.evaluation.paired import Series, differences, paired_tests, read_scores
from worldline_core.evaluation.scores import Score, summarise, write_scores
from worldline_core.report.comparison import (
    REFERENCE_NIGHTS,
    compare_with_history,
    night_tests,
    record_night,
    refuse_regressions,
    verdict_of,
)

METRICS = ("robot_iou", "robot_iou_exact", "ssim", "hsd", "psnr", "end_effector_error_px")
METHODS = ("shipped_stage2", "shipped_causal", "copy_first_frame")
IOU = "video/test/shipped_stage2/robot_iou@head"
SCALE = {"psnr": 20.0, "end_effector_error_px": 5.0}


class World:
    """Recordings of different difficulty; a night measures them with noise that the metrics of a recording share in part."""

    def __init__(self, seed: int, recordings: int = 40, noise: float = 0.02) -> None:
        self.random = np.random.default_rng(seed)
        self.noise = noise
        self.names = [f"ep-{number:03d}" for number in range(recordings)]
        self.truth = {
            (method, metric): SCALE.get(metric, 1.0) * self.random.uniform(0.5, 0.9, recordings)
            for method in METHODS
            for metric in METRICS
        }

    def night(self, loss: float = 0.0) -> dict[tuple[str, str], np.ndarray]:
        """Values by method and metric; ``loss`` is taken from the robot IoU of the first method."""
        shared = self.random.normal(size=len(self.names))
        found = {}
        for (method, metric), truth in self.truth.items():
            own = self.random.standard_t(4, len(self.names))
            found[method, metric] = truth + SCALE.get(metric, 1.0) * self.noise * (0.6 * shared + 0.6 * own)
        found[METHODS[0], "robot_iou"] = found[METHODS[0], "robot_iou"] - loss
        return found

    def series(self, loss: float = 0.0) -> Series:
        return {
            f"video/test/{method}/{metric}@head": dict(zip(self.names, values.tolist(), strict=True))
            for (method, metric), values in self.night(loss).items()
        }

    def write(self, folder: Path, loss: float = 0.0) -> dict[str, Path]:
        """The files of an evaluation."""
        folder.mkdir(parents=True)
        scores = [
            Score(method, name, "ur5e_pair", "test", "head", 42, metric, float(value))
            for (method, metric), values in self.night(loss).items()
            for name, value in zip(self.names, values, strict=True)
        ]
        write_scores(folder, scores)
        found = summarise(scores, comparisons=(), resamples=100, seed=0, by_view=True)
        (folder / "summary.json").write_text(json.dumps(found))
        return {"evaluate_video": folder}


def verdicts(present: Series, good: list[Series]) -> dict[str, str]:
    return {name: verdict_of(name, test) for name, test in night_tests(present, good).items()}


def test_a_loss_of_three_points_of_iou_turns_the_night_red_and_is_named(tmp_path: Path) -> None:
    world, history = World(1), tmp_path / "history"
    for number in range(3):
        compared = record_night(history, f"{number}", world.write(tmp_path / f"{number}"))
        assert compared.regressions == []
    worse = record_night(history, "bad", world.write(tmp_path / "bad", loss=0.03))
    # The mean over all views is of the same values here: only the head was measured.
    assert worse.regressions == [IOU.removesuffix("@head"), IOU]
    with pytest.raises(RegressionError) as raised:
        refuse_regressions(worse, history)
    message = str(raised.value)
    assert IOU in message
    assert "on 40 recordings, most on ep-" in message
    assert "worldline nightly --accept bad" in message
    # It stays red until it is repaired.
    assert record_night(history, "still", world.write(tmp_path / "still", loss=0.03)).previous == "2"
    assert record_night(history, "good again", world.write(tmp_path / "again")).regressions == []


@pytest.mark.slow
def test_false_alarms_are_rare_over_two_hundred_nights_of_pure_noise() -> None:
    alarms, nights = 0, 0
    for seed, recordings in ((3, 16), (4, 40)):
        world = World(seed, recordings)
        good = [world.series()]
        for _ in range(100):
            present = world.series()
            nights += 1
            if "worse" in verdicts(present, good).values():
                alarms += 1
            else:
                good.append(present)
    assert nights == 200
    assert alarms <= 10  # 5 %


def test_losses_are_found_almost_always() -> None:
    world = World(5)
    good = [world.series() for _ in range(REFERENCE_NIGHTS)]
    assert sum(verdicts(world.series(loss=0.03), good)[IOU] == "worse" for _ in range(20)) >= 19


def test_a_slow_drift_is_found_before_it_is_three_points() -> None:
    world = World(6, noise=0.01)
    good = [world.series() for _ in range(REFERENCE_NIGHTS)]
    for number in range(1, 11):
        present = world.series(loss=0.003 * number)
        if verdicts(present, good)[IOU] == "worse":
            break
        good.append(present)
    else:
        pytest.fail("a drift of 0.003 a night was not found in ten nights")


def test_the_same_scores_and_rounding_are_no_change() -> None:
    night = World(7).series()

    def changed(by: float) -> Series:
        return {name: {r: value + by for r, value in values.items()} for name, values in night.items()}

    for by in (0.0, -1e-6):
        assert "worse" not in verdicts(changed(by), [night] * REFERENCE_NIGHTS).values()
    # A loss that is the same on every recording has no spread, and is no chance.
    assert verdicts(changed(-0.03), [night])[IOU] == "worse"
    higher = verdicts(changed(0.3), [night])
    assert higher[IOU] == "better"
    assert higher[IOU.replace("robot_iou", "end_effector_error_px")] == "worse"  # of an error more is worse


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


def test_the_page_shows_pictures_and_the_history(run_artifacts: dict[str, Path], tmp_path: Path) -> None:
    scores = {"evaluate_video": run_artifacts["evaluate_video"]}
    artifacts = {name: path for name, path in run_artifacts.items() if name == "filter" or name.startswith("rollout.")}
    first = compare_with_history(scores, tmp_path, "first", artifacts)
    assert first.pictures
    second = compare_with_history(scores, tmp_path, "second", artifacts)
    for file in second.pictures.values():
        assert (tmp_path / file).read_bytes().startswith(b"\xff\xd8")
    assert len(list((tmp_path / "pictures").iterdir())) == len(second.pictures)  # those of the first night are gone
    page = (tmp_path / "index.html").read_text()
    assert "A look at this night" in page
    assert "second good, first good" in page
    assert all(file in page for file in second.pictures.values())
