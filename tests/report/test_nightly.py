"""The nightly comparison: history, verdicts, and the page with trends."""

from __future__ import annotations

import json
import threading
import time
from pathlib import Path

import pytest

from worldline_core.errors import ArtifactError, RegressionError
from worldline_core.evaluation.scores import Interval
from worldline_core.report import comparison
from worldline_core.report.comparison import (
    Change,
    accept_night,
    compare_with_history,
    read_history,
    record_night,
    refuse_regressions,
)


def scores(folder: Path, mean: float) -> dict[str, Path]:
    folder.mkdir(parents=True, exist_ok=True)
    values = {"robot_iou@head": {"mean": mean, "low": mean - 0.02, "high": mean + 0.02, "count": 9}}
    error = 10 * (1 - mean)
    values["end_effector_error_px@head"] = {"mean": error, "low": error - 0.3, "high": error + 0.3, "count": 9}
    groups = {"test": {"shipped_stage2": values}, "test/ur5e_pair": {"shipped_stage2": values}}
    (folder / "summary.json").write_text(json.dumps({"metrics": groups}))
    return {"evaluate_video": folder}


@pytest.mark.parametrize(
    ("metric", "mean", "expected"),
    [
        ("ssim", 0.9, "better"),
        ("ssim", 0.45, "same"),
        ("ssim", 0.2, "worse"),
        ("lpips", 0.9, "worse"),
        ("lpips", 0.2, "better"),
    ],
)
def test_verdicts(metric: str, mean: float, expected: str) -> None:
    assert Change(metric, Interval(mean, mean, mean, 9), Interval(0.5, 0.4, 0.6, 9)).verdict == expected


IOU, ERROR = "video/test/shipped_stage2/robot_iou@head", "video/test/shipped_stage2/end_effector_error_px@head"


def test_a_regression_stays_one_until_it_is_repaired_or_accepted(tmp_path: Path) -> None:
    history = tmp_path / "history"
    first = record_night(history, "2026-11-19", scores(tmp_path / "first", 0.61))
    assert (first.previous, {change.verdict for change in first.changes}) == (None, {"new"})
    assert record_night(history, "2026-11-20", scores(tmp_path / "a", 0.6)).regressions == []
    for night in ("2026-11-21", "2026-11-22"):
        worse = record_night(history, night, scores(tmp_path / night, 0.5))
        assert (worse.previous, worse.regressions) == ("2026-11-20", [ERROR, IOU])
    accept_night(history, "2026-11-22")
    with pytest.raises(ArtifactError, match="No such night"):
        accept_night(history, "2")
    again = record_night(history, "2026-11-23", scores(tmp_path / "d", 0.5))
    assert (again.previous, again.regressions) == ("2026-11-22", [])


def test_a_second_run_of_a_day_is_compared_with_the_first(tmp_path: Path) -> None:
    history = tmp_path / "history"
    first = record_night(history, None, scores(tmp_path / "a", 0.6))
    assert record_night(history, None, scores(tmp_path / "a", 0.6)) == first  # the same scores: the same night
    second = record_night(history, None, scores(tmp_path / "b", 0.5))
    assert second.previous == first.night
    assert second.regressions == [ERROR, IOU]
    assert [night.night for night in read_history(history)] == [first.night, second.night]


def test_a_named_night_is_not_replaced(tmp_path: Path) -> None:
    record_night(tmp_path / "history", "release", scores(tmp_path / "a", 0.6))
    with pytest.raises(ArtifactError, match="recorded with other scores"):
        record_night(tmp_path / "history", "release", scores(tmp_path / "b", 0.5))


def test_nights_that_end_at_once_are_all_recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    history, meet = tmp_path / "history", threading.Barrier(4)
    read = comparison.read_history
    monkeypatch.setattr(comparison, "read_history", lambda folder: (read(folder), time.sleep(0.05))[0])

    def work(number: int) -> None:
        found = scores(tmp_path / str(number), 0.6)
        meet.wait()
        record_night(history, f"night {number}", found)

    threads = [threading.Thread(target=work, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(night.night for night in read(history)) == [f"night {number}" for number in range(4)]


def test_a_metric_that_is_gone_is_a_regression(tmp_path: Path) -> None:
    history = tmp_path / "history"
    record_night(history, "1", scores(tmp_path / "a", 0.6))
    found = scores(tmp_path / "b", 0.6)
    summary = json.loads((tmp_path / "b" / "summary.json").read_text())
    del summary["metrics"]["test"]["shipped_stage2"]["robot_iou@head"]
    (tmp_path / "b" / "summary.json").write_text(json.dumps(summary))
    worse = record_night(history, "2", found)
    assert worse.regressions == [IOU]
    with pytest.raises(RegressionError, match=f"(?s)1 of 2 metrics.*{IOU}.*worldline nightly --accept 2"):
        refuse_regressions(worse, history)


def test_page_shows_trends_and_regressions(tmp_path: Path, run_artifacts: dict[str, Path]) -> None:
    history = tmp_path / "history"
    record_night(history, "2026-11-20", scores(tmp_path / "a", 0.99))
    compare_with_history(
        {name: run_artifacts[name] for name in ("evaluate_video", "evaluate_policy", "evaluate_planning")},
        history,
        "2026-11-21",
    )
    page = (history / "index.html").read_text()
    assert "video/test/shipped_stage2/robot_iou@head" in page
    assert "became worse" in page
    comparison = json.loads((history / "comparison.json").read_text())
    assert "video/test/shipped_stage2/robot_iou@head" in comparison["regressions"]
    assert {c["metric"] for c in comparison["changes"]} >= {"policy/all/true/accuracy", "planning/N=32/true/success"}


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
    for use in (read_history, lambda folder: record_night(folder, "later", scores(tmp_path / "a", 0.6))):
        with pytest.raises(ArtifactError, match=rf"(?s){match}") as caught:
            use(tmp_path)
        assert "history.jsonl" in str(caught.value)
    assert (tmp_path / "history.jsonl").read_text() == line


def test_hostile_names_stay_text(tmp_path: Path, hostile_text: str) -> None:
    name = "<b onmouseover=alert(1)>"
    for number, mean in enumerate((0.6, 0.5)):
        found = scores(tmp_path / str(number), mean)
        summary = json.loads((tmp_path / str(number) / "summary.json").read_text())
        summary["metrics"]["test"][name] = summary["metrics"]["test"]["shipped_stage2"]
        (tmp_path / str(number) / "summary.json").write_text(json.dumps(summary))
        compare_with_history(found, tmp_path / "history", f"{number} {hostile_text}")
    text = (tmp_path / "history" / "index.html").read_text()
    assert "<script>alert" not in text
    assert name not in text
    assert "Night 1 &lt;script&gt;" in text
    assert "&lt;b onmouseover=alert(1)&gt;/robot_iou@head" in text
