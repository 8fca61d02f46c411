"""The first page: its headline follows from the numbers, its figures from their intervals."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from worldline_core.report.context import ReportConfig, ReportContext, share_interval
from worldline_core.report.report import Figure, first_page, head_view, headline, planning_figure, video_figures

COPY, SHUFFLED = "copy_first_frame", "shipped_stage2_shuffled"


def context_of(
    folder: Path,
    *,
    iou: float = 0.8,
    copy: float = 0.5,
    over_copy: tuple[float, float] = (0.2, 0.4),
    over_shuffled: tuple[float, float] = (0.2, 0.4),
    own: float | None = None,
    success: float | None = None,
    gain: tuple[float, float] = (-0.1, 0.3),
) -> ReportContext:
    """A run whose evaluations say exactly this."""

    def measured(mean: float) -> dict[str, dict[str, float]]:
        return {"robot_iou@head": {"mean": mean, "low": mean - 0.1, "high": mean + 0.1, "count": 9}}

    def difference(second: str, bounds: tuple[float, float], first: str = "shipped_stage2") -> dict[str, object]:
        middle = sum(bounds) / 2
        return {
            "metric": "robot_iou@head",
            "first": first,
            "second": second,
            "mean": middle,
            "low": bounds[0],
            "high": bounds[1],
        }

    methods = {"shipped_stage2": measured(iou), COPY: measured(copy), SHUFFLED: measured(0.4)}
    rows = [difference(COPY, over_copy), difference(SHUFFLED, over_shuffled)]
    if own is not None:
        methods["stage2"] = measured(own)
        rows.append(difference(COPY, (own - copy - 0.01, own - copy + 0.01), "stage2"))
    summaries: dict[str, object] = {"evaluate_video": {"metrics": {"test": methods}, "differences": {"test": rows}}}
    if success is not None:
        result = {
            "success": {"mean": success, "low": success - 0.1, "high": min(1.0, success + 0.1)},
            "gain": {"mean": 0.3, "low": 0.2, "high": 0.4},
            "over_shortcut": {"shortcut": "hand_rule", "gain": {"mean": 0.1, "low": gain[0], "high": gain[1]}},
        }
        summaries["evaluate_planning"] = {
            "methods": {"banks_shipped_stage2": {"budgets": {"32": result}}},
            "banks": {"a": {}}, "shortcuts": {"hand_rule": {"32": {"mean": 0.64}}},
        }  # fmt: skip
    for name, summary in summaries.items():
        (folder / name).mkdir(parents=True)
        (folder / name / "summary.json").write_text(json.dumps(summary))
    return ReportContext(ReportConfig(), {name: folder / name for name in summaries}, folder / "out")


UNCLEAR = "does not clearly plan better than a rule that sees no video on 1 banks."


def headline_of(context: ReportContext) -> str:
    view = head_view(context)
    assert view is not None
    return headline(context, view, video_figures(view)[0], planning_figure(context))


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, "follows the controls."),
        ({"success": 0.76}, f"follows the controls but {UNCLEAR}"),
        (
            {"success": 0.9, "gain": (0.1, 0.4)},
            "follows the controls and plans better than any rule that sees no video.",
        ),
        (
            {"success": 0.5, "gain": (-0.3, -0.1)},
            "follows the controls but plans worse than a rule that sees no video.",
        ),
        ({"over_copy": (-0.1, 0.4)}, "does not yet beat a copy of the first frame."),
        ({"iou": 0.4, "over_copy": (-0.2, -0.1)}, "does not yet beat a copy of the first frame."),
        ({"over_shuffled": (-0.1, 0.1)}, "does not yet follow the controls."),
        (
            {"over_shuffled": (-0.1, 0.1), "success": 0.6},
            f"does not yet follow the controls and {UNCLEAR}",
        ),
    ],
)
def test_the_headline_follows_the_numbers(tmp_path: Path, changes: dict, expected: str) -> None:
    found = headline_of(context_of(tmp_path, **changes))
    assert found == f"The shipped simulator {expected}"
    assert len(found.split()) <= 25


def test_this_run_s_own_model_stands_beside_the_copy(tmp_path: Path) -> None:
    view = head_view(context_of(tmp_path, own=0.496))
    assert view is not None
    own = video_figures(view)[1]
    assert (own.shown(own.measured["mean"]), own.comparison) == (
        "0.496", "worse than copying the first frame: 0.500, within chance",
    )  # fmt: skip  # two digits show no difference


def test_the_tool_error_heads_the_page_of_a_robot_that_no_segmenter_knows(tmp_path: Path) -> None:
    context = context_of(tmp_path, iou=1.5, copy=3.8, over_copy=(-2.7, -1.8), over_shuffled=(-1.3, -1.1))
    summary = tmp_path / "evaluate_video" / "summary.json"
    summary.write_text(summary.read_text().replace("robot_iou@head", "end_effector_error_px@head"))
    assert headline_of(context) == "The shipped simulator follows the controls."
    figure = video_figures(head_view(context))[0]
    assert (figure.verdict, figure.comparison) == ("better", "better than copying the first frame: 3.80\u202fpx")


def test_a_perfect_score_of_few_cases_is_no_certainty(tmp_path: Path) -> None:
    """A bootstrap of five equal values has no spread: 100 % of five banks was shown without any doubt."""
    certain = {"mean": 1.0, "low": 1.0, "high": 1.0, "count": 5}
    wide = share_interval(certain)
    assert (round(wide["low"], 3), wide["high"]) == (0.478, 1.0)  # 0.025 ** (1 / 5), Clopper and Pearson
    failed = share_interval({"mean": 0.0, "low": 0.0, "high": 0.0, "count": 10})
    assert round(failed["high"], 3) == 0.308
    spread = {"mean": 0.8, "low": 0.6, "high": 1.0, "count": 5}
    assert share_interval(spread) is spread
    assert share_interval(None) is None
    context = context_of(tmp_path, success=1.0, gain=(0.46, 0.54))
    summary = tmp_path / "evaluate_planning" / "summary.json"
    content = json.loads(summary.read_text())
    content["methods"]["banks_shipped_stage2"]["budgets"]["32"]["success"] |= certain
    content["shortcuts"]["hand_rule"]["32"]["mean"] = 0.5
    summary.write_text(json.dumps(content))
    figure = planning_figure(context)
    assert (figure.rests_on, figure.verdict) == ("95\u202f%: 48\u202f% to 100\u202f%, 5 banks", "unclear")


@pytest.mark.parametrize(
    ("mean", "bounds", "verdict", "words"),
    [
        (0.7, (0.1, 0.3), "better", "better than chance: 0.50"),
        (0.6, (-0.1, 0.3), "unclear", "better than chance: 0.50, within chance"),
        (0.4, (-0.3, -0.05), "worse", "worse than chance: 0.50"),
        (0.4, (-0.3, 0.1), "unclear", "worse than chance: 0.50, within chance"),
        (0.5, (-0.1, 0.1), "unclear", "as chance: 0.500, within chance"),
        (0.7, None, "unclear", "better than chance: 0.50, within chance"),
    ],
)
def test_a_figure_is_coloured_by_its_reference(mean: float, bounds: tuple, verdict: str, words: str) -> None:
    measured = {"mean": mean, "low": mean - 0.1, "high": mean + 0.1, "count": 9}
    figure = Figure("right", measured, "recordings", "chance", 0.5, bounds, "")
    assert (figure.verdict, figure.comparison) == (verdict, words)


def test_a_figure_within_chance_is_neutral_on_the_page(tmp_path: Path) -> None:
    page = first_page(context_of(tmp_path, over_copy=(-0.1, 0.7), success=0.76, own=0.7), [])
    assert [page.count(f'class="tile {verdict}"') for verdict in ("better", "worse", "unclear")] == [1, 0, 2]
    assert page.count(", within chance") == 2
    assert not re.search(r"\.tile\.unclear[^{]*{[^}]*color: var\(--(good|bad)\)", page)


def test_the_page_shows_the_headline_the_video_and_four_coloured_figures(full_report: Path) -> None:
    text = (full_report / "index.html").read_text()
    assert (
        "<h1>The shipped simulator follows the controls and plans better than any rule that sees no video.</h1>" in text
    )
    assert 'src="media/overview.mp4"' in text
    assert [text.count(f'class="tile {verdict}"') for verdict in ("better", "worse", "unclear")] == [4, 0, 0]
    assert (full_report / "media" / "overview.mp4").is_file()
