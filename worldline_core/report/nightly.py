"""Comparison with earlier nights: a history of summaries, and a flag on what became worse than chance explains.

The history is one JSON object a line: `{"night": "2026-11-21", "metrics": {name: {mean, low, high, count}}}`. Metrics
are named `<what>/<where>/<method>/<metric>`: `video/test/shipped_stage2/ssim@head`, `planning/N=32/true/success`.
"""

from __future__ import annotations

import json
import logging
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from worldline_core.errors import ArtifactError
from worldline_core.store.artifact_files import read_json, read_json_lines
from worldline_core.store.atomic import write_bytes_atomic, write_json_atomic

logger = logging.getLogger(__name__)

HISTORY_FILE = "history.jsonl"
EVALUATIONS = ("evaluate_video", "evaluate_policy", "evaluate_planning")
LOWER_IS_BETTER = ("lpips", "error", "seconds", "malformed")
Verdict = Literal["better", "worse", "same", "new"]


@dataclass(frozen=True)
class Measured:
    """A mean with its 95 % interval over trajectories."""

    mean: float
    low: float
    high: float
    count: int = 0


@dataclass(frozen=True)
class Night:
    """What one night measured."""

    night: str
    metrics: Mapping[str, Measured]


@dataclass(frozen=True)
class Change:
    """One metric beside the night before."""

    metric: str
    present: Measured
    previous: Measured | None
    verdict: Verdict


@dataclass(frozen=True)
class NightlyComparison:
    """The present night against the one before it."""

    night: str
    previous: str | None
    changes: Sequence[Change] = field(default_factory=tuple)

    @property
    def regressions(self) -> list[Change]:
        """What became worse beyond the interval."""
        return [change for change in self.changes if change.verdict == "worse"]


def compare_with_history(scores: Mapping[str, Path], history: Path, night: str | None = None) -> Path:
    """Records a night, writes `comparison.json` and a page with trends into the history's folder, and returns it.

    Args:
        scores: finished Scores by step name.
        history: folder of the history.
        night: name of the night (default: today's date, UTC).

    Raises:
        ArtifactError: nothing was measured, or the history is damaged.
    """
    from worldline_core.report.config import ReportConfig
    from worldline_core.report.context import ReportContext, ReportInputs
    from worldline_core.report.page import render_page, run_script
    from worldline_core.report.sections.planning import planning_section
    from worldline_core.report.sections.policy import policy_section
    from worldline_core.report.sections.trend import trend_section
    from worldline_core.report.sections.video import video_section

    compared = record_night(history, night or time.strftime("%Y-%m-%d", time.gmtime()), scores)
    for change in compared.regressions:
        was = change.previous
        if was is not None:
            logger.warning("worse than %s: %s %.4f, was %.4f [%.4f, %.4f]", compared.previous, change.metric,
                           change.present.mean, was.mean, was.low, was.high)  # fmt: skip
    write_json_atomic(
        history / "comparison.json", asdict(compared) | {"regressions": [c.metric for c in compared.regressions]}
    )
    context = ReportContext(ReportConfig(), ReportInputs({**scores, "history": history}), history)
    sections = [maker(context) for maker in (trend_section, video_section, policy_section, planning_section)]
    title = "WorldLine nightly evaluation"
    subtitle = f"Night {compared.night}: {len(compared.regressions)} of {len(compared.changes)} metrics became worse."
    write_bytes_atomic(history / "run" / "run.js", run_script(context.run_parts).encode())
    write_bytes_atomic(history / "index.html", render_page(title, subtitle, None, sections).encode())
    return history


def record_night(history: Path, night: str, inputs: Mapping[str, Path]) -> NightlyComparison:
    """Appends a night's scores to the history and compares them with the night before.

    Args:
        history: folder of `history.jsonl`; made when absent. The same night is replaced, not repeated.
        night: name of the night, sortable (an ISO date).
        inputs: finished Scores by step name (`evaluate_video`, `evaluate_policy`, `evaluate_planning`, variants with a dot).

    Raises:
        ArtifactError: nothing was measured, or the history is damaged.
    """
    metrics = collect_metrics(inputs)
    if not metrics:
        raise ArtifactError(
            "A night without scores",
            where=night,
            expected=f"inputs named {', '.join(EVALUATIONS)}",
            got=", ".join(sorted(inputs)) or "none",
        )
    nights = sorted(
        [*(n for n in read_history(history) if n.night != night), Night(night, metrics)], key=lambda n: n.night
    )
    lines = [json.dumps(asdict(item), sort_keys=True, allow_nan=False) for item in nights]
    write_bytes_atomic(history / HISTORY_FILE, ("\n".join(lines) + "\n").encode())
    return compare_nights([n for n in nights if n.night <= night])


def read_history(history: Path) -> list[Night]:
    """The nights of a history folder, oldest first; no file means no nights.

    Raises:
        ArtifactError: a line is not a night.
    """
    path = history / HISTORY_FILE
    if not path.is_file():
        return []
    nights: list[Night] = []
    for row in read_json_lines(path):
        try:
            metrics = {name: Measured(**value) for name, value in row["metrics"].items()}
            nights.append(Night(str(row["night"]), metrics))
        except (KeyError, TypeError, AttributeError) as error:
            raise ArtifactError(
                "A line of the history is not a night",
                where=path,
                expected="night, metrics of mean, low, high, count",
                got=str(error),
            ) from error
    return sorted(nights, key=lambda n: n.night)


def collect_metrics(inputs: Mapping[str, Path]) -> dict[str, Measured]:
    """The intervals that are watched, by name: `<what>/<where>/<method>/<metric>`.

    Watched are whole splits and every number of candidates; embodiments and families apart would make a false alarm
    likely on any night.
    """
    found: dict[str, Measured] = {}
    for name, folder in sorted(inputs.items()):
        step, _, variant = name.partition(".")
        summary = read_json(folder / "summary.json") if step in EVALUATIONS else {}
        what = ".".join(part for part in (step.removeprefix("evaluate_"), variant) if part)
        for where, method, metric, value in intervals(step, summary):
            measured = read_interval(value)
            if measured is not None:
                found[f"{what}/{where}/{method}/{metric}"] = measured
    return found


def intervals(step: str, summary: Mapping[str, Any]) -> Iterator[tuple[str, str, str, Any]]:
    """(where, method, metric, interval) of an evaluation's summary."""
    if step == "evaluate_video":
        for split, methods in summary.get("metrics", {}).items():
            for method, metrics in methods.items() if "/" not in split else ():
                yield from ((split, method, metric, value) for metric, value in metrics.items())
    elif step == "evaluate_policy":
        for method, groups in summary.get("methods", {}).items():
            yield from (
                (group, method, "accuracy", value.get("accuracy"))
                for group, value in groups.items()
                if "/" not in group
            )
    elif step == "evaluate_planning":
        for method, values in summary.get("methods", {}).items():
            for budget, value in values.get("budgets", {}).items():
                yield f"N={budget}", method, "success", value.get("success")


def read_interval(value: Any) -> Measured | None:
    """An object with finite mean, low and high; None for anything else."""
    numbers = [value.get(key) for key in ("mean", "low", "high")] if isinstance(value, dict) else []
    if not numbers or not all(isinstance(n, (int, float)) and math.isfinite(n) for n in numbers):
        return None
    mean, low, high = (float(n) for n in numbers if n is not None)
    return Measured(mean, low, high, int(value.get("count", 0)))


def compare_nights(nights: Sequence[Night]) -> NightlyComparison:
    """The last of several nights against the one before it."""
    present = nights[-1]
    previous = nights[-2] if len(nights) > 1 else None
    changes = [
        Change(name, value, before, verdict(name, value, before))
        for name, value in sorted(present.metrics.items())
        for before in [previous.metrics.get(name) if previous else None]
    ]
    return NightlyComparison(present.night, previous.night if previous else None, changes)


def verdict(metric: str, present: Measured, previous: Measured | None) -> Verdict:
    """Better or worse only where the mean left the previous night's interval."""
    if previous is None:
        return "new"
    sign = -1.0 if any(word in metric for word in LOWER_IS_BETTER) else 1.0
    low, high = sorted((sign * previous.low, sign * previous.high))
    mean = sign * present.mean
    return "worse" if mean < low else "better" if mean > high else "same"
