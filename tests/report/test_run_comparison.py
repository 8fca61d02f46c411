"""`worldline compare`: paired differences of two runs, from folders of evaluations, reports and nights."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from flows.command_line import main
from tests.report.conftest import write_evaluation  # pyright: ignore[reportMissingImports]
from worldline_core.errors import ArtifactError, ConfigError
from worldline_core.evaluation.scores import SCORES_FILE, Score
from worldline_core.report.comparison import as_table, compare_runs, figures_of, record_night

NUMBER = 24


def evaluation(folder: Path, better_by: float, method: str = "model", first: int = 0) -> Path:
    """SSIM and tool error of recordings that are easier or harder for every run alike."""
    difficulty = np.random.default_rng(0).uniform(0.4, 0.9, 64)
    ssim = difficulty + better_by + np.random.default_rng(first + 1).normal(0, 0.01, 64)
    values = {"ssim": ssim, "end_effector_error_px": 10 * (1 - difficulty - better_by)}
    scores = []
    for number in range(first, first + NUMBER):
        robot, outcome = ("ur5e_pair", "viperx_pair")[number % 2], ("success", "failure")[number % 3 == 0]
        for metric, of_all in values.items():
            value = float(of_all[number])
            scores.append(Score(method, f"e{number}", robot, "test", "head", 1, metric, value, outcome=outcome))
    return write_evaluation(folder, scores)["evaluate_video"]


def test_differences_are_of_the_same_recordings_by_metric_and_group(tmp_path: Path) -> None:
    a, b = evaluation(tmp_path / "a", 0.05), evaluation(tmp_path / "b", 0.0, first=4)
    rows = {(row.group, row.metric): row for row in compare_runs(f"{a}", f"{b}")}
    assert set(rows) == {
        (group, metric + view)
        for group in ("test", "test/ur5e_pair", "test/viperx_pair", "test/success", "test/failure")
        for metric in ("ssim", "end_effector_error_px")
        for view in ("", "@head")
    }
    ssim, error = rows["test", "ssim@head"], rows["test", "end_effector_error_px@head"]
    assert ssim.recordings == NUMBER - 4
    assert ssim.difference == pytest.approx(0.05, abs=0.01)
    assert (
        ssim.low <= ssim.difference <= ssim.high < 0.07
    )  # difficulties differ by 0.5: unpaired, this would be hopeless
    assert error.difference == pytest.approx(-0.5)
    assert (ssim.better, error.better) == ("first", "first")
    back = {(row.group, row.metric): row for row in compare_runs(f"{b}", f"{a}")}["test", "ssim@head"]
    assert (back.difference, back.better) == (pytest.approx(-ssim.difference), "second")


def test_methods_of_other_names_are_paired(tmp_path: Path) -> None:
    a, b = evaluation(tmp_path / "a", 0.05, "mine"), evaluation(tmp_path / "b", 0.0, "theirs")
    with pytest.raises(ConfigError, match=r"no recording, method and metric in common[\s\S]*--methods"):
        compare_runs(f"{a}", f"{b}")
    (row,) = (r for r in compare_runs(f"{a}", f"{b}", ("mine", "theirs"), ["ssim@head"]) if r.group == "test")
    assert (row.method, row.better) == ("mine - theirs", "first")
    for arguments in (("mine", "mine"), ["ssim@head"]), (None, ["sim"]):
        with pytest.raises(ConfigError, match="in common"):
            compare_runs(f"{a}", f"{b if arguments[0] else a}", *arguments)


def test_reports_and_nights_are_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    a = evaluation(tmp_path / "store/evaluate_video/aa", 0.05)
    b = evaluation(tmp_path / "other", 0.0)
    report = tmp_path / "store/report/rr"
    report.mkdir(parents=True)
    (report / "manifest.json").write_text(json.dumps({"inputs": {"evaluate_video": {"path": "evaluate_video/aa"}}}))
    history = tmp_path / "nightly"
    record_night(history, "monday", {"evaluate_video": b})
    main(["compare", str(report), f"{history}:monday", "--json"])
    rows = {(row["group"], row["metric"]): row for row in json.loads(capsys.readouterr().out)}
    direct = {(row.group, row.metric): row for row in compare_runs(f"{a}", f"{b}")}
    assert rows["test", "ssim@head"]["difference"] == direct["test", "ssim@head"].difference
    main(["compare", str(report), str(b)])
    assert re.search(r"(?m)^ssim@head .* first$", capsys.readouterr().out)


def test_what_is_no_run_is_refused(tmp_path: Path) -> None:
    a = evaluation(tmp_path / "a", 0.0)
    with pytest.raises(ArtifactError, match="No such night"):
        compare_runs(f"{tmp_path}:friday", f"{a}")
    with pytest.raises(ArtifactError, match="Nothing to compare here"):
        compare_runs(f"{tmp_path}", f"{a}")
    for inputs in (None, [], {"evaluate_video": {"path": 5}}, {"evaluate_video": {"path": "x"}}):
        (tmp_path / "manifest.json").write_text(json.dumps({"inputs": inputs}))
        with pytest.raises(ArtifactError, match="Nothing to compare here"):
            compare_runs(f"{tmp_path}", f"{a}")


def first_value(value: float | None) -> Callable[[pa.Table], pa.Table]:
    return lambda table: table.set_column(7, "value", pa.array([value, *table["value"].to_pylist()[1:]]))


@pytest.mark.parametrize(
    ("change", "match"),
    [
        # One NaN made every test of the same run significant: "first" was better in all metrics.
        *((first_value(value), "values that are none") for value in (math.nan, -math.inf, None)),
        (lambda table: table.set_column(6, "metric", pa.nulls(len(table), pa.string())), "values that are none"),
        (lambda table: table.drop(["value"]), "Not a table of scores"),
        (lambda table: table.set_column(7, "value", pa.array(["a"] * len(table))), "Not a table of scores"),
        (lambda _: b"PAR1 and no more", "Parquet file is damaged"),
        (lambda _: b"", "Parquet file is damaged"),
    ],
)
def test_scores_that_are_none_are_refused(tmp_path: Path, change: Callable[[pa.Table], Any], match: str) -> None:
    a, b = evaluation(tmp_path / "a", 0.05), evaluation(tmp_path / "b", 0.0)
    record_night(tmp_path / "history", "monday", {"evaluate_video": b})
    kept = next((tmp_path / "history" / "scores").iterdir())
    for path, place in ((b / SCORES_FILE, f"{b}"), (kept, f"{tmp_path / 'history'}:monday")):
        changed = change(pq.read_table(path)) if path != kept else b"PAR1 and no more"
        path.write_bytes(changed) if isinstance(changed, bytes) else pq.write_table(changed, path)
        with pytest.raises(ArtifactError, match=match if path != kept else "Parquet file is damaged"):
            compare_runs(f"{a}", place)
        with pytest.raises(ArtifactError, match=match if path != kept else "Parquet file is damaged"):
            record_night(tmp_path / "history", "tuesday", {"evaluate_video": b if path != kept else a})


def test_odd_names_of_methods_stay_names(tmp_path: Path) -> None:
    a, b = evaluation(tmp_path / "a", 0.05, "a/b\x1b[2J"), evaluation(tmp_path / "b", 0.0, "a/b\x1b[2J")
    rows = compare_runs(f"{a}", f"{b}")
    assert {row.method for row in rows} == {"a|b\x1b[2J"}  # not the method "a" and a metric "b/ssim"
    assert "\x1b" not in as_table(rows)


@pytest.mark.parametrize(
    ("step", "figures"),
    [
        ("evaluate_video", ["robot_iou_exact@head", "robot_iou@head", "ssim@head", "psnr@head"]),
        ("evaluate_policy", ["accuracy"]),
        ("evaluate_planning", ["success"]),
    ],
)
def test_an_evaluation_prints_its_headline_figures(
    run_artifacts: dict[str, Path], step: str, figures: list[str]
) -> None:
    heading, *lines = figures_of(step, run_artifacts[step]).splitlines()
    assert heading.split() == ["group", "method", *figures]
    assert any(re.search(r"(shipped|banks)_.*\d\.\d{3} \[\d\.\d{3}, \d\.\d{3}\] n=\d+", line) for line in lines)
    assert not any(line.startswith(("lift", "N=2 ", "test/")) for line in lines)  # splits, and the most candidates
