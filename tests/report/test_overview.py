"""The first page, whose headline follows from the numbers, and the page of a run that is not finished."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tasks.execution.run_page import finished_step, write_finished_page, write_progress_page
from worldline_core.report.context import ReportConfig, ReportContext, VideoScores, in_order, method, share_interval
from worldline_core.report.report import Figure, first_page, head_views, headline, planning_figure, video_figure
from worldline_core.report.results import best_median_worst, choose_episodes

COPY, SHUFFLED = "copy_first_frame", "shipped_stage2_shuffled"


def context_of(
    folder: Path,
    *,
    iou: float = 0.8,
    copy: float = 0.5,
    over_copy: tuple[float, float] = (0.2, 0.4),
    over_shuffled: tuple[float, float] = (0.2, 0.4),
    success: float | None = None,
    gain: tuple[float, float] = (-0.1, 0.3),
) -> ReportContext:
    """A run whose evaluations say exactly this."""

    def interval(mean: float, low: float, high: float) -> dict[str, float]:
        return {"mean": mean, "low": low, "high": high}

    def measured(mean: float) -> dict[str, dict[str, float]]:
        return {"robot_iou@head": interval(mean, mean - 0.1, mean + 0.1) | {"count": 9}}

    def difference(second: str, bounds: tuple[float, float]) -> dict[str, object]:
        names = {"metric": "robot_iou@head", "first": "shipped_stage2", "second": second}
        return {**names, **interval(sum(bounds) / 2, *bounds)}

    methods = {"shipped_stage2": measured(iou), COPY: measured(copy), SHUFFLED: measured(0.4)}
    rows = [difference(COPY, over_copy), difference(SHUFFLED, over_shuffled)]
    summaries: dict[str, object] = {"evaluate_video": {"metrics": {"test": methods}, "differences": {"test": rows}}}
    if success is not None:
        result = {
            "success": interval(success, success - 0.1, min(1.0, success + 0.1)), "gain": interval(0.3, 0.2, 0.4),
            "over_shortcut": {"shortcut": "hand_rule", "gain": interval(0.1, *gain)},
        }  # fmt: skip
        summaries["evaluate_planning"] = {
            "methods": {"banks_shipped_stage2": {"budgets": {"32": result}}},
            "banks": {"a": {}}, "shortcuts": {"hand_rule": {"32": {"mean": 0.64}}},
        }  # fmt: skip
    for name, summary in summaries.items():
        (folder / name).mkdir(parents=True)
        (folder / name / "summary.json").write_text(json.dumps(summary))
    return ReportContext(ReportConfig(), {name: folder / name for name in summaries}, folder / "out")


def headline_of(context: ReportContext) -> str:
    view = head_views(context)[0]
    return headline(context, view, video_figure(view), planning_figure(context))


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, "follows the controls."),
        ({"success": 0.76}, "follows the controls. It does not clearly plan better"),
        ({"success": 0.9, "gain": (0.1, 0.4)}, "follows the controls. It plans better"),
        ({"success": 0.5, "gain": (-0.3, -0.1)}, "follows the controls. It plans worse"),
        ({"over_copy": (-0.1, 0.4)}, "does not yet beat a copy"),
        ({"iou": 0.4, "over_copy": (-0.2, -0.1)}, "does not yet beat a copy"),
        ({"over_shuffled": (-0.1, 0.1)}, "does not yet follow the controls."),
        ({"over_shuffled": (-0.1, 0.1), "success": 0.6}, "does not yet follow the controls. It does not clearly plan"),
    ],
)
def test_the_headline_follows_the_numbers(tmp_path: Path, changes: dict, expected: str) -> None:
    assert headline_of(context_of(tmp_path, **changes)).startswith(f"The shipped simulator {expected}")


TOOLS = {"iou": 1.5, "copy": 3.8, "over_copy": (-2.7, -1.8), "over_shuffled": (-1.3, -1.1)}
"""Distances of tools, in place of robot IoU."""


def of_tools(folder: Path) -> str:
    context_of(folder, **TOOLS)
    return (folder / "evaluate_video/summary.json").read_text().replace("robot_iou@head", "end_effector_error_px@head")


def test_the_tool_error_heads_the_page_of_a_robot_that_no_segmenter_knows(tmp_path: Path) -> None:
    context = context_of(tmp_path, **TOOLS)
    (tmp_path / "evaluate_video/summary.json").write_text(of_tools(tmp_path / "tools"))
    assert headline_of(context) == "The shipped simulator follows the controls."
    figure = video_figure(head_views(context)[0])
    assert figure is not None and figure.verdict == "better"
    assert "better than copying the first frame: 3.80\u202fpx" in first_page(context, [])


@pytest.mark.parametrize(("success", "first"), [(None, "follows the controls."), (0.9, "does not yet beat a copy")])
def test_the_tool_error_comes_first_where_no_outcomes_were_judged(
    tmp_path: Path, success: float | None, first: str
) -> None:
    """A robot of one's own: its segmenter was made from few recordings, and nothing is planned."""
    context, summary = (
        context_of(tmp_path, over_copy=(-0.1, 0.4), success=success),
        tmp_path / "evaluate_video/summary.json",
    )
    content, added = json.loads(summary.read_text()), json.loads(of_tools(tmp_path / "tools"))
    for name, values in content["metrics"]["test"].items():
        values |= added["metrics"]["test"][name]
    content["differences"]["test"] += added["differences"]["test"]
    summary.write_text(json.dumps(content))
    page = first_page(context, [])
    assert f"The shipped simulator {first}" in page
    places = [page.find(text) for text in ("distance of the predicted tools", "overlap of the predicted robot")]
    assert (places[0] > 0) == (success is None) and places[1] > places[0]


def test_a_perfect_score_of_few_cases_is_no_certainty(tmp_path: Path) -> None:
    """A bootstrap of five equal values has no spread: 100 % of five banks was shown without any doubt."""
    certain = {"mean": 1.0, "low": 1.0, "high": 1.0, "count": 5}
    wide = share_interval(certain)
    assert (round(wide["low"], 3), wide["high"]) == (0.478, 1.0)  # 0.025 ** (1 / 5), Clopper and Pearson
    assert round(share_interval({"mean": 0.0, "low": 0.0, "high": 0.0, "count": 10})["high"], 3) == 0.308
    spread = {"mean": 0.8, "low": 0.6, "high": 1.0, "count": 5}
    assert share_interval(spread) is spread
    context = context_of(tmp_path, success=1.0, gain=(0.46, 0.54))
    summary = tmp_path / "evaluate_planning" / "summary.json"
    content = json.loads(summary.read_text())
    content["methods"]["banks_shipped_stage2"]["budgets"]["32"]["success"] |= certain
    content["shortcuts"]["hand_rule"]["32"]["mean"] = 0.5
    summary.write_text(json.dumps(content))
    figure = planning_figure(context)
    assert figure is not None and round(figure.measured["low"], 3) == 0.478
    assert figure.verdict == "unclear"


def test_a_figure_within_chance_is_neutral_on_the_page(tmp_path: Path) -> None:
    page = first_page(context_of(tmp_path, over_copy=(-0.1, 0.7), success=0.76), [])
    assert "better than copying the first frame: 0.50, within chance" in page
    assert [page.count(f'class="tile {verdict}"') for verdict in ("better", "worse", "unclear")] == [0, 0, 2]
    assert Figure("right", {"mean": 0.7}, "recordings", "chance", 0.5, None, "").verdict == "unclear"
    page = first_page(context_of(tmp_path / "worse", iou=0.4, over_copy=(-0.2, -0.05)), [])
    assert page.count('class="tile worse"') == 1
    assert "worse than copying the first frame: 0.50" in page


def artifact(store: Path, step: str, key: str, seconds: float, finished: str = "2026-01-01", **metrics: object) -> Path:
    folder = store / step / key
    folder.mkdir(parents=True)
    content = {"wall_seconds": seconds, "finished_at": finished, "resumed": False, "metrics": metrics}
    (folder / "manifest.json").write_text(json.dumps(content))
    return folder


def test_the_page_says_what_is_done_running_and_coming(tmp_path: Path, hostile_text: str) -> None:
    curate = artifact(tmp_path, "curate", "k1", 20.0, found=145, kept=142, reasons={"blur": 3})
    tracks = artifact(tmp_path, "render_actions", "k2", 7.0)
    (tracks / "previews").mkdir()
    (tracks / "previews" / "a b.png").write_bytes(b"png")
    latest = tmp_path / "report" / "latest"
    steps = (("curate", curate, 21.6), ("render_actions", tracks, None))
    done = [finished_step(latest, *step) for step in steps]
    page = write_progress_page(latest, done, ["train_stage1"], ["distill", hostile_text], 30.0)
    text = page.read_text()
    assert page == latest / "index.html"
    assert "2 of 5 steps are done after 30 s" in text
    assert "found 145 · kept 142" in text
    assert "found in the store" in text
    assert 'http-equiv="refresh"' in text
    assert 'src="../../render_actions/k2/previews/a%20b.png"' in text
    assert (latest / "../../render_actions/k2/previews/a b.png").resolve().is_file()
    assert hostile_text not in text
    assert "&lt;script&gt;" in text
    assert list(latest.iterdir()) == [page]  # nothing half-written is left beside it


def test_a_run_that_failed_says_so_and_the_finished_report_takes_the_place_of_the_page(tmp_path: Path) -> None:
    report = artifact(tmp_path, "report", "0123", 1.0)
    (report / "index.html").write_text("the report")
    latest = tmp_path / "report" / "latest"
    text = write_progress_page(latest, [], ["curate"], ["filter"], 3.0, failed="no disk").read_text()
    assert "This run stopped" in text and "no disk" in text and "refresh" not in text
    text = write_finished_page(latest, report).read_text()
    assert 'content="0; url=../0123/index.html"' in text
    assert (latest / "../0123/index.html").resolve().read_text() == "the report"


def test_names_are_read_and_ordered_long_trained_first_baselines_last() -> None:
    labels = {
        "shipped_stage2": "Stage II", "shipped_causal": "causal", "shipped_stage2_shuffled": "Stage II, shuffled actions",
        "shipped_stage2_35_steps": "Stage II, 35 steps", "stage1_20_steps": "stage1 20 steps", "stage2": "Stage II",
        "cosmos_predict": "cosmos predict", "stage1": "Stage I, text, no actions", "copy_first_frame": "copy first frame",
    }  # fmt: skip
    assert {name: method(name).label for name in labels} == labels
    names = ["shipped_stage2", "shipped_causal", "shipped_stage2_shuffled", "stage2", "copy_first_frame"]
    assert [m.name for m in in_order(sorted(names))] == names


def test_the_median_best_and_worst_episodes_are_shown_or_without_scores_some_by_name() -> None:
    values = {"a": 0.9, "b": 0.1, "c": 0.5, "d": 0.4}
    assert best_median_worst(values) == [("median", "d", 0.4), ("best", "a", 0.9), ("worst", "b", 0.1)]
    assert best_median_worst({"a": 0.9, "b": 0.1}) == [("median", "b", 0.1), ("best", "a", 0.9)]
    assert best_median_worst({"only": 0.3}) == [("median", "only", 0.3)]
    assert best_median_worst({}) == []
    chosen = choose_episodes(VideoScores(None), ["c", "a", "b"])
    assert [item.episode_id for item in chosen] == ["a", "b", "c"]
    assert "no scores" in chosen[0].reason
