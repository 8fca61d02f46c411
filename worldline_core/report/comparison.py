"""Paired comparisons of evaluations: two runs, or a night with the good nights before it; and the page of the nights.

A night is compared with each recording's median over the last REFERENCE_NIGHTS good nights. All metrics are tested together
(`evaluation.paired`); FALSE_ALARM is the probability that any turns red on a night without a change. A red night is not good:
later nights are compared with the same reference until the loss is repaired or accepted.
"""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import ValidationError

from worldline_core.config import StrictModel
from worldline_core.errors import ArtifactError, ConfigError, RegressionError
from worldline_core.evaluation.paired import (
    EVALUATIONS,
    PairedTest,
    Series,
    collect_metrics,
    differences,
    margin_of,
    paired_tests,
    read_scores,
    read_series,
    sign_of,
    write_series,
)
from worldline_core.evaluation.recordings import ROLLOUT_PREFIX
from worldline_core.evaluation.scores import SCORES_FILE, Interval
from worldline_core.pages.page import render
from worldline_core.report.context import headline_metrics
from worldline_core.store.artifact_files import MANIFEST_NAME, digest_value, linked_folder, read_json, verify_artifact
from worldline_core.store.atomic import write_bytes_atomic, write_json_atomic
from worldline_core.store.store import exclusive_lock
from worldline_core.untrusted_text import visible

FALSE_ALARM = 0.02
REFERENCE_NIGHTS = 7
HISTORY_FILE = "history.jsonl"
"""A `Night` a line, oldest first; its scores by recording are in `scores/`."""
HEADLINES = ("robot_iou_exact@head", "robot_iou@head", "ssim@head", "psnr@head", "accuracy", "success")

Verdict = Literal["better", "worse", "same", "new", "missing"]


# Two runs


@dataclass(frozen=True)
class Difference:
    """A metric of a method in a group, in both runs, over the recordings that both have.

    Attributes:
        difference, low, high: first minus second and its 95 % paired bootstrap interval.
        better: ``first`` or ``second`` where chance does not explain the difference (all rows together at 5 %, eight recordings at
            least), else "".
    """

    what: str
    group: str
    method: str
    metric: str
    first: float
    second: float
    difference: float
    low: float
    high: float
    recordings: int
    better: str


def read_run(place: str) -> Series:
    """The series of a run: the folder of an evaluation or of a report, or ``HISTORY:NIGHT``.

    Raises: ArtifactError for a place without scores, or one that is damaged.
    """
    folder, _, night = place.rpartition(":")
    if folder and not Path(place).exists():
        _require_night(read_history(Path(folder)), night)
        return read_series(scores_file(Path(folder), night))
    found = evaluations_of(place)
    return {name: values for path in found for name, values in read_scores(path, subgroups=True).items()}


def evaluations_of(place: str) -> list[Path]:
    """Verified folders of an evaluation, or of those that a report shows.

    Raises: ArtifactError for a place without scores, or one that is damaged.
    """
    path = Path(place)
    verify_artifact(path)
    if (path / SCORES_FILE).is_file():
        return [path]
    names = [n for n in read_json(path / MANIFEST_NAME).get("inputs") or () if n.partition(".")[0] in EVALUATIONS]
    folders = [folder for name in names if (folder := linked_folder(path, name)) is not None]
    if not folders or len(folders) < len(names):
        raise ArtifactError(
            "Nothing to compare here", where=place,
            got=f"{len(folders)} of the evaluations {names}" if names else "neither scores nor a report's manifest",
            expected="the folder of an evaluation, of a report, or HISTORY:NIGHT (artifacts/nightly:2026-11-21)",
        )  # fmt: skip
    for folder in folders:
        verify_artifact(folder)
    return folders


def compare_runs(
    first: str, second: str, methods: tuple[str, str] | None = None, metrics: Sequence[str] = ()
) -> list[Difference]:
    """Differences of all series that both runs have.

    Args:
        methods: compare this method of the first run with that one of the second.
        metrics: only these (``ssim@head``); none means all.

    Raises: ConfigError: the runs share no recording, method and metric. ArtifactError: as `read_run`.
    """
    runs = read_run(first), read_run(second)
    named = [sorted({name.split("/")[2] for name in run}) for run in runs]
    if methods is not None:
        runs = tuple(
            {name.replace(f"/{method}/", "/*/", 1): v for name, v in run.items() if name.split("/")[2] == method}
            for run, method in zip(runs, methods, strict=True)
        )
    found = {n: v for n, v in differences(*runs).items() if not metrics or n.split("/", 3)[3] in metrics}
    if not found:
        raise ConfigError(
            "The runs have no recording, method and metric in common", where=f"{first} and {second}",
            got=f"methods {named[0]} and {named[1]}",
            next_step="compare runs over the same recordings; --methods A B pairs methods of other names",
        )  # fmt: skip
    rows, together = [], paired_tests(found)
    for name, test in paired_tests(found, least=1).items():
        what, group, method, metric = name.split("/", 3)
        means = [sum(run[name][r] for r in found[name]) / test.count for run in runs]
        low, high = sorted((sign_of(name) * test.low, sign_of(name) * test.high))
        joint = together.get(name)
        better = "first" if joint and joint.p_better <= 0.05 else "second" if joint and joint.p_worse <= 0.05 else ""
        label = method if methods is None else f"{methods[0]} - {methods[1]}"
        values = means[0], means[1], means[0] - means[1], low, high
        rows.append(Difference(what, group.replace("|", "/"), label, metric, *values, test.count, better))
    return rows


def drawn_and_not(place: str) -> list[tuple[str, str]]:
    """Methods of a run that are rollouts of one checkpoint with the same settings, through the cameras and by control vectors alone.

    Raises: ArtifactError for a place without scores, or without such a pair.
    """
    found: dict[str, dict[bool, str]] = {}
    for folder in evaluations_of(place):
        for name in read_json(folder / MANIFEST_NAME).get("inputs") or ():
            rollouts = linked_folder(folder, name) if name.startswith(ROLLOUT_PREFIX) else None
            manifest = {} if rollouts is None else read_json(rollouts / MANIFEST_NAME)
            checkpoint = manifest.get("inputs", {}).get("checkpoint", {}).get("digest")
            if checkpoint is not None:
                config = dict(manifest["config"])
                cameras = config.pop("cameras", True)
                config.pop("method")
                found.setdefault(digest_value([checkpoint, config]), {})[cameras] = name.removeprefix(ROLLOUT_PREFIX)
    pairs = sorted({(both[True], both[False]) for both in found.values() if len(both) == 2})
    if not pairs:
        raise ArtifactError(
            "No checkpoint was rolled out both with cameras and without", where=place,
            expected="two rollouts that differ in `cameras` alone, of a model that also takes control vectors",
            next_step="add a rollout with `cameras: false` (docs/rollout.md), or name a second run to compare with",
        )  # fmt: skip
    return pairs


def as_table(rows: Sequence[Difference]) -> str:
    """Rows as aligned text."""
    lines = [("metric", "group", "method", "first", "second", "difference", "95 %", "n", "better")]
    for r in rows:
        values = f"{r.first:.3f}", f"{r.second:.3f}", f"{r.difference:+.3f}", f"[{r.low:+.3f}, {r.high:+.3f}]"
        lines.append((r.metric, f"{r.what} {r.group}", r.method, *values, f"{r.recordings}", r.better))
    return aligned(lines)


def aligned(lines: Sequence[Sequence[str]]) -> str:
    """Lines of texts in columns of equal width, without control characters."""
    shown = [[visible(text) for text in line] for line in lines]
    widths = [max(map(len, column)) for column in zip(*shown, strict=True)]
    return "\n".join("  ".join(text.ljust(w) for text, w in zip(line, widths, strict=True)).rstrip() for line in shown)


def figures_of(step: str, folder: Path) -> str:
    """The headline metrics of a finished evaluation with 95 % intervals, a line for each split and method; else nothing."""
    rows: dict[tuple[str, str], dict[str, str]] = defaultdict(dict)
    for _, group, method, metric, value in headline_metrics(step, folder):
        rows[group, method][metric] = f"{value.mean:.3f} [{value.low:.3f}, {value.high:.3f}] n={value.count}"
    measured = {metric for values in rows.values() for metric in values}
    # A set without a head view has the means over its views alone.
    columns = [m for name in HEADLINES if (m := name if name in measured else name.removesuffix("@head")) in measured]
    lines = [(*key, *(values.get(column, "") for column in columns)) for key, values in rows.items()]
    return aligned([("group", "method", *columns), *lines]) if columns else ""


# A night and the nights before it


class Night(StrictModel):
    """Means of one night with 95 % intervals over trajectories, by metric; only good nights are compared with later ones."""

    night: str
    metrics: dict[str, Interval]
    good: bool = True


@dataclass(frozen=True)
class MetricChange:
    """One metric beside the last good night; None where one of the two did not measure it.

    ``test`` is None for metrics of too few recordings; their mean is compared with the interval of the good night.
    """

    metric: str
    present: Interval | None
    previous: Interval | None
    test: PairedTest | None = None

    @property
    def verdict(self) -> Verdict:
        if self.previous is None or self.present is None:
            return "new" if self.previous is None else "missing"
        if self.test is not None:
            return verdict_of(self.metric, self.test)
        if self.previous.low <= self.present.mean <= self.previous.high:
            return "same"
        return "better" if (self.present.mean > self.previous.high) == (sign_of(self.metric) > 0) else "worse"

    @property
    def worst(self) -> str:
        """The recordings that lost most, where the metric became worse."""
        lost = self.test.worst if self.test and self.verdict == "worse" else ()
        return ", ".join(f"{recording} ({value:+.3f})" for recording, value in lost)

    def __str__(self) -> str:
        if not (test := self.test) or self.verdict != "worse":
            return f"{self.metric} ({self.verdict})"
        bounds = f"{test.mean:+.3f} [{test.low:+.3f}, {test.high:+.3f}]"
        return f"{self.metric}: {bounds} on {test.count} recordings, most on {self.worst}"


def verdict_of(metric: str, test: PairedTest) -> Verdict:
    """The verdict on a tested metric: a change counts where it is larger than the margin and than chance explains."""
    if abs(test.mean) <= margin_of(metric) or min(test.p_worse, test.p_better) > FALSE_ALARM:
        return "same"
    return "worse" if test.mean < 0 else "better"


def night_tests(present: Series, good: Sequence[Series]) -> dict[str, PairedTest]:
    """Tests of a night's differences to the median of each recording over the good nights before it, oldest first."""
    nights, medians = good[-REFERENCE_NIGHTS:], Series()
    for name, recordings in nights[-1].items() if nights else ():
        earlier = {r: [night[name][r] for night in nights if r in night.get(name, ())] for r in recordings}
        medians[name] = {recording: float(np.median(values)) for recording, values in earlier.items()}
    return paired_tests(differences(present, medians))


@dataclass(frozen=True)
class NightlyComparison:
    """A night against the last good one before it."""

    night: str
    previous: str | None
    changes: Sequence[MetricChange]

    @property
    def worse(self) -> list[MetricChange]:
        """Metrics that became worse or are no longer measured."""
        return [change for change in self.changes if change.verdict in ("worse", "missing")]

    @property
    def regressions(self) -> list[str]:
        return [change.metric for change in self.worse]

    @property
    def verdicts(self) -> dict[str, str]:
        """Every metric's verdict, those that became worse first."""
        return {change.metric: change.verdict for change in [*self.worse, *self.changes]}


def record_night(history: Path, night: str | None, inputs: Mapping[str, Path]) -> NightlyComparison:
    """Append a night's scores to the history and compare them with the good nights before.

    Args:
        night: its name; default: today's date (UTC), with the time if today has other scores already. The same scores under the
            same name are the same night, measured again.
        inputs: finished evaluations by step name.

    Raises: ArtifactError: nothing was measured, the night is recorded with other scores, or the history is damaged.
    """
    metrics = collect_metrics(inputs)
    if not metrics:
        raise ArtifactError("A night without scores", where=night, expected=EVALUATIONS, got=sorted(inputs))
    folders = [inputs[step] for step in EVALUATIONS if step in inputs and (inputs[step] / SCORES_FILE).is_file()]
    series = {name: values for folder in folders for name, values in read_scores(folder).items()}
    with exclusive_lock(history / ".lock"):
        nights = read_history(history)
        known = {found.night: index for index, found in enumerate(nights)}
        name = night or time.strftime("%Y-%m-%d", time.gmtime())
        if name in known and nights[known[name]].metrics == metrics:
            return _compare(nights[known[name]], nights[: known[name]], history)
        if name in known and night is not None:
            raise ArtifactError(
                "This night is recorded with other scores", where=history / HISTORY_FILE, got=name,
                next_step="give another name with --night, or none",
            )  # fmt: skip
        if name in known:
            name = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime())
        write_series(scores_file(history, name), series)
        compared = _compare(Night(night=name, metrics=metrics), nights, history)
        _write_history(history, [*nights, Night(night=name, metrics=metrics, good=not compared.regressions)])
        return compared


def _compare(present: Night, earlier: Sequence[Night], history: Path) -> NightlyComparison:
    good = [night for night in earlier if night.good]
    before = good[-1].metrics if good else {}
    series = [read_series(scores_file(history, night.night)) for night in [*good[-REFERENCE_NIGHTS:], present]]
    tests = night_tests(series[-1], series[:-1])
    names = sorted({*present.metrics, *before})
    changes = [MetricChange(name, present.metrics.get(name), before.get(name), tests.get(name)) for name in names]
    return NightlyComparison(present.night, good[-1].night if good else None, changes)


def accept_night(history: Path, night: str) -> None:
    """Mark a night as good: later ones are compared with it.

    Raises: ArtifactError: there is no such night, or the history is damaged.
    """
    with exclusive_lock(history / ".lock"):
        nights = read_history(history)
        _require_night(nights, night)
        accepted = [found.model_copy(update={"good": found.good or found.night == night}) for found in nights]
        _write_history(history, accepted)


def _require_night(nights: Sequence[Night], night: str) -> None:
    if night not in (names := [found.night for found in nights]):
        raise ArtifactError("No such night", expected=", ".join(names) or "a history", got=night)


def scores_file(history: Path, night: str) -> Path:
    """The file of a night's scores by recording."""
    return history / "scores" / f"{digest_value(night)[:16]}.parquet"


def _write_history(history: Path, nights: Sequence[Night]) -> None:
    write_bytes_atomic(history / HISTORY_FILE, "".join(f"{night.model_dump_json()}\n" for night in nights).encode())


def read_history(history: Path) -> list[Night]:
    """The nights of a history folder, oldest first; no file means no nights.

    Raises: ArtifactError: a line is not a night.
    """
    path = history / HISTORY_FILE
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines() if path.is_file() else []
    try:
        nights = [Night.model_validate_json(line, strict=True) for line in lines]
        if twice := [name for name, count in Counter(night.night for night in nights).items() if count > 1]:
            raise ValueError(f"a second time: {twice}")
    except ValueError as error:
        got = error.errors(include_url=False)[0]["msg"] if isinstance(error, ValidationError) else error
        raise ArtifactError("A line of the history is not a night", where=path, got=got) from error
    return nights


# The page of the nights


def compare_with_history(scores: Mapping[str, Path], history: Path, night: str | None = None) -> NightlyComparison:
    """`record_night`, and write `comparison.json` and the page of the nights into the history's folder."""
    compared = record_night(history, night, scores)
    changes = [asdict(change) | {"verdict": change.verdict} for change in compared.changes]
    content = asdict(compared) | {"changes": changes, "regressions": compared.regressions}
    write_json_atomic(history / "comparison.json", content)
    title, nights = "WorldLine nightly evaluation", read_history(history)
    page = render("report/nights.html", title=title, compared=compared, nights=nights)
    write_bytes_atomic(history / "index.html", page.encode())
    return compared


def refuse_regressions(compared: NightlyComparison, history: Path) -> None:
    """Raises RegressionError, which names the metrics, for a night that became worse."""
    if compared.regressions:
        raise RegressionError(
            f"{len(compared.regressions)} of {len(compared.changes)} metrics became worse than in {compared.previous}",
            where=history / "index.html",
            got="; ".join(str(change) for change in compared.worse),
            next_step=f"find the cause; if this is the new normal: worldline nightly --accept {compared.night}",
        )
