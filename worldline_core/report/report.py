"""The step report: static pages from whatever artifacts are finished, with their media beside them; and its first page.

Pages and media are reproducible. Times, devices and versions are not: they go to `run/run.js` and into the pages when these are
opened.
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from markupsafe import Markup

from worldline_core.evaluation.scores import TRUE_METHOD
from worldline_core.pages.page import NARROW_SPACE, number, percent, render
from worldline_core.progress import with_progress
from worldline_core.report.context import (
    SPLIT_LABELS,
    Method,
    ReportConfig,
    ReportContext,
    Section,
    VideoScores,
    predicting,
)
from worldline_core.report.data import data_section
from worldline_core.report.results import decisions_section, most_candidates, quality_section
from worldline_core.report.training import provenance_section, training_section
from worldline_core.report.videos import overview_video, videos_section
from worldline_core.store.artifact_files import JsonObject, read_rows
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

    Raises:
        WorldLineError: an artifact cannot be read.
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


@dataclass(frozen=True)
class Figure:
    """One number of the first page beside its reference; `bounds` is the 95 % interval of their difference."""

    value: str
    what: str
    mean: float
    reference: float
    reference_text: str
    bounds: tuple[float, float] | None
    how: str

    @property
    def verdict(self) -> str:
        """`better` or `worse` where the interval leaves the reference out, else `unclear`."""
        if self.bounds is not None and self.bounds[0] > 0:
            return "better"
        return "worse" if self.bounds is not None and self.bounds[1] < 0 else "unclear"

    @property
    def comparison(self) -> str:
        order = "better than" if self.mean > self.reference else "worse than" if self.mean < self.reference else "as"
        doubt = ", within chance" if self.verdict == "unclear" else ""
        return f"{order} {self.reference_text}{doubt}"


class HeadView(NamedTuple):
    """The head-view robot IoU on the first group of held-out recordings, with the main method."""

    scores: VideoScores
    group: str
    primary: Method
    metric: str

    def method(self, kind: str, *groups: str) -> Method | None:
        """The first method of a kind with weights of one of some groups."""
        return next((m for m in self.scores.methods(self.group) if m.kind == kind and m.group in groups), None)

    def value(self, method: Method | None) -> JsonObject | None:
        return None if method is None else self.scores.value(self.group, method.name, f"{self.metric}@head")

    def difference(self, second: Method | None, first: Method | None = None) -> JsonObject | None:
        first = first or self.primary
        name = f"{self.metric}@head"
        return None if second is None else self.scores.difference(self.group, first.name, second.name, name)

    def beside_copy(self, method: Method | None, what: str, how: str = "") -> Figure | None:
        """A method's IoU beside that of copying the first frame."""
        copy = self.method("copy", "baseline")
        mean, reference = self.value(method), self.value(copy)
        if method is None or mean is None or reference is None:
            return None
        difference = self.difference(copy, method)
        bounds = (difference["low"], difference["high"]) if difference else None
        digits = 2 if number(mean["mean"]) != number(reference["mean"]) else 3
        text = f"copying the first frame: {number(reference['mean'], digits)}"
        how = f"{how}{mean['count']} recordings{interval_words(bounds)}"
        return Figure(number(mean["mean"], digits), what, mean["mean"], reference["mean"], text, bounds, how)


def head_view(context: ReportContext) -> HeadView | None:
    """The scores that head the page; None where no robot IoU was measured."""
    scores = context.video_scores
    group = scores.groups[0] if scores.groups else None
    primary = scores.primary(group) if group else None
    metric = scores.iou_metric(group, primary.name) if group and primary else None
    return None if group is None or primary is None or metric is None else HeadView(scores, group, primary, metric)


def interval_words(bounds: tuple[float, float] | None, *, points: bool = False) -> str:
    """The interval of a difference in words; `points` writes shares as percentage points."""
    if bounds is None:
        return ""
    low, high = (number(100 * v if points else float(v), 0 if points else 3, signed=True) for v in bounds)
    return f"; difference, 95{NARROW_SPACE}% interval: {low} to {high}{' points' if points else ''}"


def first_page(context: ReportContext, sections: Sequence[Section]) -> Markup:
    """The headline, one video, up to four figures beside their references, and the list of pages."""
    view = head_view(context)
    controls, own = (None, None) if view is None else video_figures(view)
    planning = planning_figure(context)
    figures = [controls, planning, policy_figure(context), own]
    entries = zip(sections, PAGES.values(), strict=False)
    return render(
        "report/overview.html",
        title="WorldLine: from robot recordings to an action-driven simulator",
        section=None,
        sections=sections,
        next=None,
        headline=headline(context, view, controls, planning),
        figures=[figure for figure in figures if figure is not None],
        video=overview_video(context),
        entries=[(section, f"Missing: {section.missing}" if section.missing else what) for section, what in entries],
    )


def video_figures(view: HeadView) -> tuple[Figure | None, Figure | None]:
    """The main method, and this run's own method of the same kind, beside a copy of the first frame."""
    what = "how well the predicted robot covers the recorded one (robot IoU; 1 is perfect)"
    where = SPLIT_LABELS.get(view.group, view.group)
    main = view.beside_copy(view.primary, what, f"{view.primary.long_label}; {where}, head view, ")
    own = view.method(view.primary.kind, "run")
    if own is None or own.name == view.primary.name:
        return main, None
    return main, view.beside_copy(own, f"the same for the {own.label} that this run trained itself")


def planning_figure(context: ReportContext) -> Figure | None:
    """Success of the choice among the most candidates beside a blind choice."""
    summary = next(iter(context.summaries("evaluate_planning")), None)
    order = predicting(summary["methods"]) if summary else []
    if summary is None or not order:
        return None
    values = summary["methods"][order[0].name]
    found, direct = most_candidates(values), float(summary["direct_execution"]["mean"])
    mean, bounds = float(found["success"]["mean"]), (float(found["gain"]["low"]), float(found["gain"]["high"]))
    what = f"of the plans chosen among {max(values['budgets'], key=int)} by their predicted videos succeed"
    how = f"{order[0].long_label}; {len(summary['banks'])} banks{interval_words(bounds, points=True)}"
    if ceiling := summary["methods"].get(TRUE_METHOD):
        how += f"; by recorded videos {percent(most_candidates(ceiling)['success']['mean'])}"
    return Figure(percent(mean), what, mean, direct, f"a blind choice: {percent(direct)}", bounds, how)


def policy_figure(context: ReportContext) -> Figure | None:
    """Outcomes judged from predicted videos beside guessing, which is right in half of the cases."""
    summary = next(iter(context.summaries("evaluate_policy")), None)
    methods = summary["methods"] if summary else {}
    order = predicting(methods)
    first = next((m for m in order if m.kind == "stage2"), order[0] if order else None)
    found = methods[first.name].get("all", {}).get("accuracy") if first else None
    if first is None or found is None:
        return None
    mean, bounds = float(found["mean"]), (float(found["low"]) - 0.5, float(found["high"]) - 0.5)
    how = f"{first.long_label}; {found['count']} recordings{interval_words(bounds, points=True)}"
    if ceiling := methods.get(TRUE_METHOD, {}).get("all", {}).get("accuracy"):
        how += f"; from recorded videos {percent(ceiling['mean'])}"
    what = "of the outcomes judged from predicted videos are right"
    return Figure(percent(mean), what, mean, 0.5, f"guessing: {percent(0.5)}", bounds, how)


def headline(context: ReportContext, view: HeadView | None, controls: Figure | None, planning: Figure | None) -> str:
    """The result in one short sentence; its numbers are on the cards below."""
    clauses: list[tuple[bool, str]] = []
    if view is not None and controls is not None:
        shuffled = view.difference(view.method(f"{view.primary.kind}_shuffled", view.primary.group))
        follows = shuffled is None or shuffled["low"] > 0
        if controls.verdict != "better":
            clauses.append((False, "does not yet beat a copy of the first frame"))
        else:
            clauses.append((follows, "follows the controls" if follows else "does not yet follow the controls"))
    if planning is not None:
        results = {"better": "plans better than chance", "worse": "plans worse than chance"}
        clauses.append(
            (planning.verdict == "better", results.get(planning.verdict, "does not clearly plan better than chance"))
        )
    if not clauses:
        counts = episode_counts(context)
        kept = f"{number(counts[1])} of {number(counts[0])} episodes were kept; no prediction" if counts else "Nothing"
        return f"{kept} was measured yet."
    subject = "The shipped simulator" if view is None or view.primary.group == "shipped" else "This run's simulator"
    if len(clauses) == 1:
        return f"{subject} {clauses[0][1]}."
    (good, first), (also, second) = clauses
    return f"{subject} {first} {'and' if good == also else 'but'} {second}."


def episode_counts(context: ReportContext) -> tuple[int, int] | None:
    """Episodes found and kept; None without a curated set."""
    curated, filtered = context.inputs.get("curate"), context.inputs.get("filter")
    if curated is None:
        return None
    rows, refused = read_rows(curated / "index.parquet"), read_rows(curated / "quarantine.parquet")
    kept = len(rows) if filtered is None else len({row["episode_id"] for row in read_rows(filtered / "index.parquet")})
    return len(rows) + len(refused), kept
