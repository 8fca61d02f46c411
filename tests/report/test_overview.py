"""The first page says in one sentence what the numbers say, no more and no less."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from worldline_core.report.context import ReportConfig, ReportContext
from worldline_core.report.summary import (
    Figure,
    HeadView,
    follows,
    overview,
    own_model,
    planning_figure,
    policy_figure,
    sentence,
)

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
        result = {"success": {"mean": success}, "gain": {"mean": 0.1, "low": gain[0], "high": gain[1]}}
        summaries["evaluate_planning"] = {
            "methods": {"banks_shipped_stage2": {"budgets": {"32": result}}},
            "banks": {"a": {}}, "direct_execution": {"mean": 0.64},
        }  # fmt: skip
    for name, summary in summaries.items():
        (folder / name).mkdir(parents=True)
        (folder / name / "summary.json").write_text(json.dumps(summary))
    return ReportContext(ReportConfig(), {name: folder / name for name in summaries}, folder / "out")


def said(context: ReportContext) -> str:
    view = HeadView.of(context)
    assert view is not None
    figures = {"controls": follows(view), "own": own_model(context, view), "planning": planning_figure(context)}
    text = sentence(context, view, {**figures, "policy": policy_figure(context)})
    return str(text).replace('<span data-run="training_time"></span>', str(context.run_parts.get("training_time", "")))


def test_it_says_what_is_reached_and_what_is_not(tmp_path: Path) -> None:
    assert said(context_of(tmp_path, success=0.76, own=0.45)) == (
        "The shipped simulator follows the controls (robot IoU 0.80 against 0.50 for copying the first frame) but does not"
        " yet choose clearly better than a blind choice (76\u202f% against 64\u202f%); the model that this run trained"
        " itself does not yet beat copying the first frame (0.45 against 0.50)."
    )


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"success": 0.9, "gain": (0.1, 0.4)},
            " and chooses better than a blind choice (90\u202f% against 64\u202f%).",
        ),
        ({"success": 0.5, "gain": (-0.3, -0.1)}, " but chooses worse than a blind choice"),
        ({"success": 0.6, "gain": (-0.3, 0.1)}, " but does not choose better than a blind choice"),
        ({"over_copy": (-0.1, 0.4)}, "does not yet predict better than a copy of the first frame"),
        ({"iou": 0.4, "over_copy": (-0.2, -0.1)}, "does not yet predict better than a copy of the first frame"),
        ({"over_shuffled": (-0.1, 0.1)}, "predicts no better with the right controls than with shuffled ones"),
        ({"own": 0.6}, "; the model that this run trained itself already beats copying the first frame"),
        ({"iou": 0.4, "over_copy": (-0.2, -0.1), "success": 0.6}, " and does not choose better than a blind choice"),
        ({"own": 0.496}, "does not yet beat copying the first frame (0.496 against 0.500)."),
    ],
)
def test_it_follows_the_numbers(tmp_path: Path, changes: dict, words: str) -> None:
    assert words in said(context_of(tmp_path, **changes))


@pytest.mark.parametrize(
    ("mean", "bounds", "verdict", "words"),
    [
        (0.7, (0.1, 0.3), "better", "better than chance: 0.5"),
        (0.6, (-0.1, 0.3), "unclear", "better than chance: 0.5, within chance"),
        (0.4, (-0.3, -0.05), "worse", "worse than chance: 0.5"),
        (0.4, (-0.3, 0.1), "unclear", "worse than chance: 0.5, within chance"),
        (0.5, (-0.1, 0.1), "unclear", "as chance: 0.5, within chance"),
        (0.7, None, "unclear", "better than chance: 0.5, within chance"),
    ],
)
def test_a_figure_is_coloured_by_its_reference(mean: float, bounds: tuple, verdict: str, words: str) -> None:
    figure = Figure(str(mean), "right", mean, 0.5, "chance: 0.5", bounds, "")
    assert (figure.verdict, figure.comparison) == (verdict, words)


def trained(context: ReportContext, seconds: float, *, resumed: bool = False) -> ReportContext:
    """The same run with manifests of its training."""
    folders = {step: context.output.parent / step for step in ("train_stage1", "train_stage2")}
    for folder in folders.values():
        folder.mkdir(exist_ok=True)
        (folder / "manifest.json").write_text(json.dumps({"wall_seconds": seconds, "resumed": resumed}))
    return replace(context, inputs={**context.inputs, **folders})


def test_the_time_of_training_is_the_measured_one(tmp_path: Path) -> None:
    context = context_of(tmp_path, own=0.45)
    assert "that this run trained itself in 38 s does not yet beat" in said(trained(context, 19.0))
    assert "that this run trained itself in 4.0 min does not yet beat" in said(trained(context, 120.0))
    # The wall time of a resumed step is that of its last piece alone.
    assert "that this run trained itself does not yet beat" in said(trained(context, 19.0, resumed=True))


def test_a_figure_within_chance_is_neutral_on_the_page(tmp_path: Path) -> None:
    page = overview(context_of(tmp_path, over_copy=(-0.1, 0.7), success=0.76, own=0.7), [])
    assert [page.count(f'class="tile {verdict}"') for verdict in ("better", "worse", "unclear")] == [1, 0, 2]
    assert page.count(", within chance") == 2
    assert not re.search(r"\.tile\.unclear[^{]*{[^}]*color: var\(--(good|bad)\)", page)


def test_the_page_shows_the_sentence_the_video_and_four_coloured_figures(full_report: Path) -> None:
    text = (full_report / "index.html").read_text()
    assert (
        "The shipped simulator follows the controls (robot IoU 0.62 against 0.36 for copying the first frame)" in text
    )
    assert 'src="media/overview.mp4"' in text
    assert [text.count(f'class="tile {verdict}"') for verdict in ("better", "worse", "unclear")] == [4, 0, 0]
    assert (full_report / "media" / "overview.mp4").is_file()


def test_curves_that_fall_with_the_number_of_candidates_are_explained(tmp_path: Path) -> None:
    from worldline_core.report.decisions import falling

    budgets = {n: {"success": {"mean": value}} for n, value in (("2", 0.84), ("32", 0.76))}
    assert falling({"methods": {"banks_shipped_stage2": {"budgets": budgets}}}) == [
        "Stage II (long-trained): 84\u202f% at N = 2, 76\u202f% at N = 32"
    ]
