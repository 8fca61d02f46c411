"""The step report: static pages from whatever artifacts are finished, with their media beside them; and its first page.

Pages and media are reproducible. Times, devices and versions are not: they go to `run/run.js` and into the pages when these are
opened.
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from markupsafe import Markup

from worldline_core.evaluation.metric_registry import Metric
from worldline_core.evaluation.scores import TRUE_METHOD
from worldline_core.pages.page import percent, render, words
from worldline_core.progress import with_progress
from worldline_core.report.context import (
    SPLIT_LABELS,
    TOOL_ERROR,
    Method,
    ReportConfig,
    ReportContext,
    Section,
    VideoScores,
    predicting,
    share_interval,
)
from worldline_core.report.data import data_section, dataset_facts
from worldline_core.report.results import (
    decisions_section,
    most_candidates,
    provenance_section,
    quality_section,
    training_section,
    videos_section,
)
from worldline_core.store.artifact_files import JsonObject
from worldline_core.store.atomic import remove_unfinished

__all__ = ["ReportConfig", "report"]

logger = logging.getLogger(__name__)

PAGES = {
    videos_section: "Truth beside every model, in every view.",
    quality_section: "Robot IoU, SSIM, PSNR, LPIPS, drift along time, and time per frame.",
    decisions_section: "Outcomes judged, and plans chosen, by predicted videos.",
    data_section: "Recorded robots, scenes and tasks; kept and dropped episodes with their reasons.",
    training_section: "Loss curves of every stage of this run.",
    provenance_section: "Weights, digests, seeds, configurations, versions and times.",
}
"""Every page behind the first one, and its line in the list of pages."""


def report(config: ReportConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """Write `output/index.html`, the pages behind it, and their media.

    Inputs: any finished artifacts by the name of their step (`curate`, `rollout.<method>`, `evaluate_video`, ...); a page whose
    artifacts are missing says so.

    Raises: WorldLineError: an artifact cannot be read.
    """
    # Remains of an earlier, killed call may not enter the digest.
    shutil.rmtree(output / "media", ignore_errors=True)
    remove_unfinished(output)
    context = ReportContext(config, dict(inputs), output)
    sections = [make(context) for make in with_progress([*PAGES], "report", "section")]
    context.write_pages(first_page(context, sections), sections)
    missing = [section.anchor for section in sections if section.missing]
    pages = len(sections) + 1 - len(missing)
    logger.info("report: %d pages, missing: %s", pages, ", ".join(missing) or "none")
    return {"sections": pages, "missing": missing, "media": len(list((output / "media").glob("*")))}


class Figure(NamedTuple):
    """One number of the first page beside a reference.

    Attributes:
        measured: mean, its 95 % interval and the count of `cases` that it rests on; a share where the unit is %.
        bounds: 95 % interval of the difference to the reference, positive where the figure is better; the verdict is its sign.
        where: the model and the recordings.
    """

    what: str
    measured: JsonObject
    cases: str
    beside: str
    reference: float
    bounds: tuple[float, float] | None
    where: str
    unit: str = "%"
    lower_is_better: bool = False

    @property
    def gain(self) -> float:
        return (self.measured["mean"] - self.reference) * (-1 if self.lower_is_better else 1)

    @property
    def verdict(self) -> str:
        """`better` or `worse` where the interval of the difference leaves out zero, else `unclear`."""
        low, high = self.bounds or (0, 0)
        return "better" if low > 0 else "worse" if high < 0 else "unclear"


class HeadView(NamedTuple):
    """The headline of the head view on the first group of held-out recordings, with the main method."""

    scores: VideoScores
    group: str
    primary: Method
    metric: Metric

    def method(self, kind: str, group: str) -> Method | None:
        """The first method of a kind with weights of this origin."""
        return next((m for m in self.scores.methods(self.group) if (m.kind, m.group) == (kind, group)), None)

    def over(self, second: Method | None) -> tuple[float, float] | None:
        """Interval of how much better the main method is than `second`, in paired recordings."""
        name = "" if second is None else second.name
        found = self.scores.difference(self.group, self.primary.name, name, f"{self.metric.name}@head")
        if found is None:
            return None
        return (-found["high"], -found["low"]) if self.metric.lower_is_better else (found["low"], found["high"])


def head_views(context: ReportContext) -> list[HeadView]:
    """Scores that may head the page, the most trustworthy first: of robot IoU and tool error those that were measured."""
    scores = context.video_scores
    group = scores.groups[0] if scores.groups else ""
    primary = scores.primary(group)
    metrics = [] if primary is None else scores.headlines(group, primary.name)
    return [HeadView(scores, group, primary, metric) for metric in metrics if primary]


def first_page(context: ReportContext, sections: Sequence[Section]) -> Markup:
    """The headline, one video, up to three figures beside their references, and the list of pages."""
    views, outcomes = head_views(context), [planning_figure(context), policy_figure(context)]
    if any(outcomes):
        views = views[:1]
    else:  # a robot of one's own: how its tools follow the controls comes first
        views.sort(key=lambda view: view.metric.name != TOOL_ERROR)
    controls = [video_figure(view) for view in views[:2]]
    return render(
        "report/overview.html",
        title="WorldLine: from robot recordings to an action-driven simulator",
        section=None,
        sections=sections,
        next=None,
        headline=headline(context, next(iter(views), None), next(iter(controls), None), outcomes[0]),
        figures=list(filter(None, (*controls, *outcomes))),
        card=context.first_card,
        entries=list(zip(sections, PAGES.values(), strict=False)),
    )


def video_figure(view: HeadView) -> Figure | None:
    """The main method beside a copy of the first frame."""
    tools = view.metric.name == TOOL_ERROR
    what = f"{'distance' if tools else 'overlap'} of the predicted {'tools' if tools else 'robot'}"
    what += " from the recorded ones" if tools else " with the recorded one (IoU)"
    copy = view.method("copy", "baseline")
    mean, reference = (
        m and view.scores.value(view.group, m.name, f"{view.metric.name}@head") for m in (view.primary, copy)
    )
    if mean is None or reference is None:
        return None
    where = f"{view.primary.long_label}; {SPLIT_LABELS[view.group]}, head view"
    return Figure(
        what, mean, "recordings", "copying the first frame", reference["mean"], view.over(copy), where,
        view.metric.unit, view.metric.lower_is_better,
    )  # fmt: skip


def planning_figure(context: ReportContext) -> Figure | None:
    """Success of the choice among the most candidates beside the best shortcut, which sees no video."""
    summary = context.summary("evaluate_planning")
    order = predicting(summary["methods"]) if summary else []
    if summary is None or not order:
        return None
    values = summary["methods"][order[0].name]
    found, most = most_candidates(values), max(values["budgets"], key=int)
    success = {"count": len(summary["banks"]), **found["success"]}
    what = f"of plans succeed, chosen among {most} by their predicted videos"
    ceiling = summary["methods"].get(TRUE_METHOD)
    where = order[0].long_label + by_recorded_videos(ceiling and most_candidates(ceiling)["success"])
    return beside_shortcut(what, success, "banks", found["over_shortcut"], summary["shortcuts"], most, where)


def policy_figure(context: ReportContext) -> Figure | None:
    """Outcomes judged from predicted videos beside the best shortcut, which sees no video."""
    summary = context.summary("evaluate_policy") or {}
    methods = summary.get("methods", {})
    order = predicting(methods)
    first = next((m for m in order if m.kind == "stage2"), order[0] if order else None)
    if first is None:
        return None
    found, ceiling = methods[first.name]["all"], methods.get(TRUE_METHOD)
    what = "of outcomes judged from predicted videos are right"
    where = first.long_label + by_recorded_videos(ceiling and share_interval(ceiling["all"]["accuracy"]))
    over, known = found["over_shortcut"], summary["shortcuts"]
    return beside_shortcut(what, found["accuracy"], "recordings", over, known, "all", where)


def beside_shortcut(
    what: str, share: JsonObject, of: str, over: JsonObject, shortcuts: JsonObject, column: str, where: str
) -> Figure:
    """A share of successes beside that of the best shortcut."""
    measured = share_interval(share)
    reference = float(shortcuts[over["shortcut"]][column]["mean"])
    # The bootstrap of the gain sees as little of what never failed as that of the share.
    bounds = over["gain"] if measured is share else {key: measured[key] - reference for key in ("low", "high")}
    beside = f"the best rule without video ({words(over['shortcut'])})"
    return Figure(what, measured, of, beside, reference, (bounds["low"], bounds["high"]), where)


def by_recorded_videos(measured: JsonObject | None) -> str:
    """The same from the recorded videos, the ceiling of what predicted ones can reach; nothing where it was not measured."""
    return "" if measured is None else f"; from recorded videos {percent(measured['mean'])}"


def headline(context: ReportContext, view: HeadView | None, controls: Figure | None, planning: Figure | None) -> str:
    """The result in one or two short sentences; its numbers are on the cards below."""
    clauses: list[str] = []
    if view is not None and controls is not None:
        shuffled = view.over(view.method(f"{view.primary.kind}_shuffled", view.primary.group))
        follows = "follows the controls" if shuffled is None or shuffled[0] > 0 else "does not yet follow the controls"
        clauses.append(follows if controls.verdict == "better" else "does not yet beat a copy of the first frame")
    if planning is not None:
        unclear = f"does not clearly plan better than a rule that sees no video on {planning.measured['count']} banks"
        better, worse = "plans better than any rule that sees no video", "plans worse than a rule that sees no video"
        clauses.append({"better": better, "worse": worse, "unclear": unclear}[planning.verdict])
    if not clauses:
        facts = dataset_facts(context)
        kept = f"{facts.num_episodes} of {facts.num_found} episodes were kept; no prediction" if facts else "Nothing"
        return f"{kept} was measured yet."
    subject = "The shipped simulator" if view is None or view.primary.group == "shipped" else "This run's simulator"
    return f"{subject} {'. It '.join(clauses)}."
