"""The first page: one sentence that says what happened, one video, four figures beside what they are compared with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from markupsafe import Markup

from worldline_core.pages.page import NARROW_SPACE, Table, duration, number, percent, render
from worldline_core.report.context import ReportContext, Section
from worldline_core.report.cost import constant_cost
from worldline_core.report.decisions import most_candidates
from worldline_core.report.video_scores import SPLIT_LABELS, TRUE_METHOD, Method, VideoScores, predicting
from worldline_core.report.videos import overview_video
from worldline_core.store.artifact_files import JsonObject, read_rows

ABOUT = {
    "videos": "Truth beside every model, in every view, with recordings to open in 3-D.",
    "quality": "Robot IoU, SSIM, PSNR, LPIPS: tables, paired differences, drift along time.",
    "policy": "Do outcomes judged from predicted videos agree with what was recorded?",
    "planning": "Does choosing among N candidates by their predicted videos succeed more often?",
    "cost": "Time per frame, and whether every block of a long rollout costs the same.",
    "data": "What was recorded: robots, scenes, tasks, licences, duplicates.",
    "filters": "What was kept and dropped, and why, with an example of each reason.",
    "actions": "Where the controls fall in each view, and the nine channels that the model sees.",
    "training": "Loss curves of every stage of this run.",
    "models": "The weights that were used, and their cards.",
    "provenance": "Digests, seeds, configurations, versions and times of every artifact.",
}
"""What each page shows, for the list of pages."""


@dataclass(frozen=True)
class Figure:
    """One number in plain words beside its reference.

    Attributes:
        bounds: 95 % interval of the difference to the reference; None where none was measured.
    """

    value: str
    what: Markup | str
    mean: float
    reference: float
    reference_text: str
    bounds: tuple[float, float] | None
    how: str

    @property
    def verdict(self) -> str:
        """`better` or `worse` where the interval leaves the reference out, else `unclear`: within chance."""
        if self.bounds is not None and self.bounds[0] > 0:
            return "better"
        return "worse" if self.bounds is not None and self.bounds[1] < 0 else "unclear"

    @property
    def comparison(self) -> str:
        order = "better than" if self.mean > self.reference else "worse than" if self.mean < self.reference else "as"
        doubt = ", within chance" if self.verdict == "unclear" else ""
        return f"{order} {self.reference_text}{doubt}"


@dataclass(frozen=True)
class HeadView:
    """The head-view robot IoU on the first group of held-out recordings: the main method and those beside it."""

    scores: VideoScores
    group: str
    primary: Method
    metric: str

    @classmethod
    def of(cls, context: ReportContext) -> HeadView | None:
        scores = context.video_scores
        group = scores.groups[0] if scores.groups else None
        primary = scores.primary(group, context.config.primary_method) if group else None
        metric = scores.iou_metric(group, primary.name) if group and primary else None
        return None if group is None or primary is None or metric is None else cls(scores, group, primary, metric)

    def method(self, kind: str, *groups: str) -> Method | None:
        """The first method of a kind with weights of one of some groups."""
        return next((m for m in self.scores.methods(self.group) if m.kind == kind and m.group in groups), None)

    def value(self, method: Method | None) -> JsonObject | None:
        return None if method is None else self.scores.value(self.group, method.name, f"{self.metric}@head")

    def difference(self, first: Method, second: Method | None) -> JsonObject | None:
        name = f"{self.metric}@head"
        return None if second is None else self.scores.difference(self.group, first.name, second.name, name)

    def beside_copy(self, method: Method | None, what: Markup | str, how: str = "") -> Figure | None:
        """A method's IoU beside that of copying the first frame."""
        copy = self.method("copy", "baseline")
        mean, reference = self.value(method), self.value(copy)
        if method is None or mean is None or reference is None:
            return None
        difference = self.difference(method, copy)
        bounds = (difference["low"], difference["high"]) if difference else None
        value, beside = told_apart(float(mean["mean"]), float(reference["mean"]))
        text = f"copying the first frame: {beside}"
        how = f"{how}{mean['count']} recordings{interval_words(bounds)}"
        return Figure(value, what, mean["mean"], reference["mean"], text, bounds, how)


def told_apart(mean: float, reference: float) -> tuple[str, str]:
    """Two numbers for readers, with a third digit where two show no difference."""
    digits = 2 if number(mean) != number(reference) else 3
    return number(mean, digits), number(reference, digits)


def interval_words(bounds: tuple[float, float] | None, *, points: bool = False) -> str:
    """The interval of a difference in words; `points` writes shares as percentage points."""
    if bounds is None:
        return ""
    low, high = (number(100 * v if points else float(v), 0 if points else 3, signed=True) for v in bounds)
    return f"; difference, 95{NARROW_SPACE}% interval: {low} to {high}{' points' if points else ''}"


def overview(context: ReportContext, sections: Sequence[Section]) -> Markup:
    """The first page."""
    view = HeadView.of(context)
    figures = {
        "controls": None if view is None else follows(view),
        "planning": planning_figure(context),
        "policy": policy_figure(context),
        "own": None if view is None else own_model(context, view),
    }
    return render(
        "report/overview.html",
        title=context.config.title,
        heading=context.config.title,
        subtitle=context.config.subtitle,
        section=None,
        sections=sections,
        next=None,
        sentence=sentence(context, view, figures),
        figures=[figure for figure in figures.values() if figure is not None],
        video=overview_video(context),
        about=ABOUT,
        further=Table(("Number", "What it is", "How it was measured"), further_numbers(context, view)),
        constant_cost=context.slot("efficiency_tile", cost, inline=True) if (cost := constant_cost(context)) else None,
    )


def follows(view: HeadView) -> Figure | None:
    """The main method beside a copy of the first frame."""
    what = "how well the predicted robot covers the recorded one (robot IoU; 1 is perfect)"
    where = SPLIT_LABELS.get(view.group, view.group)
    return view.beside_copy(view.primary, what, f"{view.primary.long_label}; {where}, head view, ")


def own_model(context: ReportContext, view: HeadView) -> Figure | None:
    """What this run trained for itself beside a copy of the first frame; None where it is the main method."""
    own = view.method(view.primary.kind, "run")
    if own is None or own.name == view.primary.name:
        return None
    what = Markup("the same for the {} that this run trained itself{}").format(own.label, training_time(context))
    return view.beside_copy(own, what)


def training_time(context: ReportContext) -> Markup:
    """` in 38 s`: what Stages I and II took in this run, filled in when the page opens; nothing where it is not known."""
    manifests = [context.manifest(step) for step in ("train_stage1", "train_stage2")]
    times = [m.get("wall_seconds") for m in manifests if not m.get("resumed")]
    known = [seconds for seconds in times if isinstance(seconds, (int, float))]
    content = f" in {duration(sum(known))}" if len(known) == len(manifests) else ""
    return context.slot("training_time", content, inline=True)


def planning_figure(context: ReportContext) -> Figure | None:
    """Success of the choice among the most candidates beside a blind choice."""
    for summary in context.summaries("evaluate_planning")[:1]:
        order = predicting(summary["methods"])
        if not order:
            return None
        values = summary["methods"][order[0].name]
        found, direct = most_candidates(values), float(summary["direct_execution"]["mean"])
        mean, budget = float(found["success"]["mean"]), max(values["budgets"], key=int)
        bounds = (float(found["gain"]["low"]), float(found["gain"]["high"]))
        what = f"of the plans chosen among {budget} by their predicted videos succeed"
        how = f"{order[0].long_label}; {len(summary['banks'])} banks{interval_words(bounds, points=True)}"
        if ceiling := summary["methods"].get(TRUE_METHOD):
            how += f"; by recorded videos {percent(most_candidates(ceiling)['success']['mean'])}"
        return Figure(percent(mean), what, mean, direct, f"a blind choice: {percent(direct)}", bounds, how)
    return None


def policy_figure(context: ReportContext) -> Figure | None:
    """Outcomes judged from predicted videos beside guessing: as many successes as failures are judged."""
    for summary in context.summaries("evaluate_policy")[:1]:
        methods = summary["methods"]
        order = predicting(methods)
        first = next((m for m in order if m.kind == "stage2"), order[0] if order else None)
        found = methods[first.name].get("all", {}).get("accuracy") if first else None
        if first is None or found is None:
            return None
        bounds = (float(found["low"]) - 0.5, float(found["high"]) - 0.5)
        how = f"{first.long_label}; {found['count']} recordings{interval_words(bounds, points=True)}"
        if ceiling := methods.get(TRUE_METHOD, {}).get("all", {}).get("accuracy"):
            how += f"; from recorded videos {percent(ceiling['mean'])}"
        mean = float(found["mean"])
        what = "of the outcomes judged from predicted videos are right"
        return Figure(percent(mean), what, mean, 0.5, f"guessing: {percent(0.5)}", bounds, how)
    return None


def sentence(context: ReportContext, view: HeadView | None, figures: dict[str, Figure | None]) -> Markup | str:
    """What happened, in one sentence, from the numbers alone."""
    controls, planning, own = figures["controls"], figures["planning"], figures["own"]
    clauses: list[tuple[bool, str]] = []
    if view is not None and controls is not None:
        clauses.append(controls_clause(view, controls))
    if planning is not None:
        doubt = "yet choose clearly" if planning.mean > planning.reference else "choose"
        verb = {"better": "chooses better", "worse": "chooses worse", "unclear": f"does not {doubt} better"}
        beside = f"than a blind choice ({planning.value} against {percent(planning.reference)})"
        clauses.append((planning.verdict == "better", f"{verb[planning.verdict]} {beside}"))
    if not clauses:
        counts = episode_counts(context)
        kept = f"{number(counts[1])} of {number(counts[0])} episodes were kept; no prediction" if counts else "Nothing"
        return f"{kept} was measured yet."
    text = "The shipped simulator" if view is None or view.primary.group == "shipped" else "This run's simulator"
    text += f" {clauses[0][1]}"
    for (before, _), (good, clause) in pairwise(clauses):
        text += f"{' and' if good == before else ' but'} {clause}"
    if own is None:
        return text + "."
    beats = "already beats" if own.verdict == "better" else "does not yet beat"
    return Markup("{}; the model that this run trained itself{} {} copying the first frame ({} against {}).").format(
        text, training_time(context), beats, *told_apart(own.mean, own.reference)
    )


def controls_clause(view: HeadView, found: Figure) -> tuple[bool, str]:
    """Whether the main method follows the controls: better than a copy, and than with the controls of another episode."""
    beside = "(robot IoU {} against {} for copying the first frame)".format(*told_apart(found.mean, found.reference))
    if found.verdict != "better":
        return False, f"does not yet predict better than a copy of the first frame {beside}"
    shuffled = view.difference(view.primary, view.method(f"{view.primary.kind}_shuffled", view.primary.group))
    if shuffled is not None and shuffled["low"] <= 0:
        return False, f"predicts no better with the right controls than with shuffled ones {beside}"
    return True, f"follows the controls {beside}"


def episode_counts(context: ReportContext) -> tuple[int, int] | None:
    """Episodes found and kept; None without a curated set."""
    curated, filtered = context.inputs.get("curate"), context.inputs.get("filter")
    if curated is None:
        return None
    rows, refused = read_rows(curated / "index.parquet"), read_rows(curated / "quarantine.parquet")
    kept = len(rows) if filtered is None else len({row["episode_id"] for row in read_rows(filtered / "index.parquet")})
    return len(rows) + len(refused), kept


def further_numbers(context: ReportContext, view: HeadView | None) -> list[list[object]]:
    """What the controls are worth, what the causal model keeps, and the episodes kept."""
    rows: list[list[object]] = []
    if view is not None:
        for kind, what in (
            (f"{view.primary.kind}_shuffled", "robot IoU over the same weights with shuffled actions"),
            ("copy", "robot IoU over copying the first frame"),
        ):
            found = view.difference(view.primary, view.method(kind, view.primary.group, "baseline"))
            if found is not None:
                low, high = (number(float(found[key]), signed=True) for key in ("low", "high"))
                how = f"{view.primary.long_label}, paired; 95{NARROW_SPACE}% interval {low} to {high}"
                rows.append([number(float(found["mean"]), signed=True), what, how])
        causal, main = view.value(view.method("causal", view.primary.group)), view.value(view.primary)
        if causal and main and main["mean"]:
            how = f"IoU {causal['mean']:.3f} against {view.primary.label}'s {main['mean']:.3f}"
            rows.append([percent(causal["mean"] / main["mean"]), "of its robot IoU kept by the causal model", how])
    counts = episode_counts(context)
    if counts is not None:
        how = "the rest is in quarantine, each with its reason"
        rows.append([number(counts[1]), f"of {number(counts[0])} episodes kept", how])
    return rows
