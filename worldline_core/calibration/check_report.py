"""What a calibration check found: a table for the terminal, JSON, and a page with a picture of every episode."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from markupsafe import Markup

from worldline_core.calibration.diagnosis import (
    CalibrationCheck,
    Diagnosis,
    Explanation,
    Finding,
    SetDiagnosis,
    SetFinding,
)
from worldline_core.pages.page import Table, render, words

ORDER = ("unexplained", "explained", "unreadable", "too_little_evidence", "consistent")
MEASURES = ("hand-eye", "camera lag", "image lag", "in view", "flow")


def measures_shown(diagnosis: Diagnosis) -> dict[str, str]:
    """The worst of each key measure over the views, as text; a dash where nothing was measured."""

    def worst(values: Iterable[float | None], pick: Callable[[list[float]], float], shown: str) -> str:
        known = [value for value in values if value is not None]
        return shown.format(pick(known)) if known else "-"

    def largest(values: list[float]) -> float:
        return max(values, key=abs)

    views = diagnosis.measures
    metres = worst((None if m.hand_eye_m is None else 1e3 * m.hand_eye_m for m in views), max, "{:.1f} mm")
    degrees = worst((m.hand_eye_deg for m in views), max, " {:.1f} deg")
    return {
        "hand-eye": metres + degrees if metres != "-" else metres,
        "camera lag": worst((m.camera_lag_frames for m in views), largest, "{:+.1f}"),
        "image lag": worst((m.image_lag_frames for m in views), largest, "{:+.1f}"),
        "in view": worst((m.in_view_share for m in views), min, "{:.0%}"),
        "flow": worst((m.flow_agreement for m in views), min, "{:.2f}"),
    }


def table_text(check: CalibrationCheck) -> str:
    """The table of episodes, the conclusion over each source, and the lines that repair it."""
    header = ["episode", "verdict", "best explanation", "score", "as recorded"]
    rows = [[*header, *MEASURES]]
    for finding in check.findings:
        diagnosis = finding.diagnosis
        if diagnosis is None:
            rows.append([finding.episode_id, "unreadable", f"{finding.reason}: {finding.detail}"])
            continue
        shown = measures_shown(diagnosis)
        scores = [f"{diagnosis.best.score:.1f}", f"{diagnosis.none.score:.1f}"]
        verdict = diagnosis.verdict.replace("_", " ")
        rows.append([finding.episode_id, verdict, diagnosis.best.mistake, *scores, *(shown[name] for name in MEASURES)])
    widths = [max(len(row[i]) for row in rows if len(row) == len(rows[0])) for i in range(len(rows[0]))]
    widths[0] = max(len(row[0]) for row in rows)
    widths[1] = max(len(row[1]) for row in rows)
    lines = []
    for row in rows:
        cells = [
            text.ljust(w) if i < 3 else text.rjust(w) for i, (text, w) in enumerate(zip(row, widths, strict=False))
        ]
        lines.append("  ".join(cells).rstrip())
    lines.insert(1, "  ".join("-" * width for width in widths))
    return "\n".join([*lines, "", *conclusion_lines(check)])


def conclusion_lines(check: CalibrationCheck) -> list[str]:
    """What all episodes say together."""
    counted = Counter(finding.verdict for finding in check.findings)
    parts = [f"{counted[name]} {name.replace('_', ' ')}" for name in ORDER if counted[name]]
    lines = [f"{len(check.findings)} episodes: {', '.join(parts)}"]
    for found in check.sets:
        lines += ["", set_headline(found.diagnosis), f"  single episodes say: {votes_text(found.diagnosis)}"]
        lines += [f"  {caution}" for caution in cautions(found.diagnosis)]
        lines += [f"  note: {note}" for note in found.diagnosis.notes]
        if found.config_lines:
            lines += ["  what repairs it, in the configuration of this source:"]
            lines += [f"    {line}" for line in found.config_lines]
    together = {found.config_lines for found in check.sets}
    groups: dict[tuple[str, ...], list[str]] = {}
    for finding in check.findings:
        if finding.config_lines and finding.config_lines not in together:
            groups.setdefault(finding.config_lines, []).append(finding.episode_id)
    if groups:
        lines += ["", "what repairs single episodes (give them a source of their own, by `include`):"]
    for group, names in groups.items():
        lines.append(f"  {', '.join(names[:4])}{f' and {len(names) - 4} more' if len(names) > 4 else ''}:")
        lines += [f"    {line}" for line in group]
    return [*lines, "", f"pictures: {check.output / 'index.html'}"]


def set_headline(found: SetDiagnosis) -> str:
    """The conclusion over a source in one line."""
    asis = next(e.score for e in found.ranked if e.mistake == "none")
    start = f"source {found.source}, {found.num_episodes} episodes together: {found.verdict.replace('_', ' ')}"
    if found.verdict == "explained":
        return f"{start} by {found.best.mistake} (score {found.best.score:.1f}, as recorded {asis:.1f})"
    return f"{start} (score as recorded {asis:.1f})"


def votes_text(found: SetDiagnosis) -> str:
    """What the episodes say one by one, the most frequent first."""
    ordered = sorted(found.votes.items(), key=lambda item: (-item[1], item[0]))
    return ", ".join(f"{name.replace('_', ' ')} {count}" for name, count in ordered) or "nothing"


def cautions(found: SetDiagnosis) -> list[str]:
    """What to mind before a whole source is changed for what only some of its episodes say by themselves."""
    agreeing = sum(count for name, count in found.votes.items() if found.best.mistake in name.split("+"))
    if found.verdict != "explained" or 2 * agreeing >= found.num_episodes:
        return []
    return [
        f"mind: only {agreeing} of {found.num_episodes} episodes say so by themselves; look at their pictures before"
        " you change the source, and give those that differ a source of their own"
    ]


def as_json(check: CalibrationCheck) -> dict[str, Any]:
    """Everything, in plain values."""
    return {
        "consistent": check.consistent,
        "episodes": [_finding_json(finding) for finding in check.findings],
        "sources": [_set_json(found) for found in check.sets],
    }


def _finding_json(finding: Finding) -> dict[str, Any]:
    content: dict[str, Any] = {
        "episode_id": finding.episode_id,
        "source": finding.source,
        "verdict": finding.verdict,
        "config_lines": finding.config_lines,
        "picture": finding.picture,
        "notes": finding.notes,
    }
    if finding.diagnosis is None:
        return plain(content | {"reason": finding.reason, "detail": finding.detail})
    diagnosis = finding.diagnosis
    content |= {
        "mistake": diagnosis.best.mistake,
        "score": diagnosis.best.score,
        "score_as_recorded": diagnosis.none.score,
        "ranked": [_explanation_json(explanation) for explanation in diagnosis.ranked],
        "measures": [asdict(measures) for measures in diagnosis.measures],
        "notes": (*diagnosis.notes, *finding.notes),
    }
    return plain(content)


def _explanation_json(explanation: Explanation) -> dict[str, Any]:
    return {
        "mistake": explanation.mistake,
        "score": explanation.score,
        "evidence": dict(explanation.evidence),
        "conventions": {name: getattr(explanation.conventions, name) for name in explanation.conventions.departures},
    }


def _set_json(found: SetFinding) -> dict[str, Any]:
    diagnosis = found.diagnosis
    return plain(
        {
            "source": diagnosis.source,
            "episodes": diagnosis.num_episodes,
            "verdict": diagnosis.verdict,
            "mistake": diagnosis.best.mistake,
            "score": diagnosis.best.score,
            "ranked": [{"mistake": e.mistake, "score": e.score} for e in diagnosis.ranked],
            "votes": dict(diagnosis.votes),
            "notes": diagnosis.notes,
            "config_lines": found.config_lines,
        }
    )


def plain(value: Any) -> Any:
    """A value as JSON knows it: NumPy numbers become plain ones, what is not finite becomes null."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


MEANING = {
    "consistent": "the recording agrees with its calibration",
    "explained": "one usual mistake explains what is wrong; the line repairs it",
    "unexplained": "the recording disagrees with its calibration, and no usual mistake explains how",
    "too_little_evidence": "too little moves, or too little is calibrated, to judge",
    "unreadable": "the episode cannot be read",
}
TONES = {"consistent": "good", "explained": "bad", "unexplained": "bad", "unreadable": "bad"}
RANKED_SHOWN = 6


def page(check: CalibrationCheck) -> str:
    """The page: conclusions first, then a table, then a picture of each episode, the worst first."""
    counted = Counter(finding.verdict for finding in check.findings)
    ordered = sorted(check.findings, key=lambda finding: (ORDER.index(finding.verdict), finding.episode_id))
    return render(
        "calibration/check_page.html",
        title="Calibration check",
        subtitle=f"{len(check.findings)} episodes, judged by what they show.",
        tiles=[(counted[name], name, MEANING[name]) for name in ORDER if counted[name]],
        tones=TONES,
        conclusions=[
            (set_headline(found.diagnosis), votes_text(found.diagnosis), cautions(found.diagnosis), found)
            for found in check.sets
        ],
        episodes=_episode_table(ordered),
        findings=[(finding, _ranked(finding)) for finding in ordered],
    )


def _tag(verdict: str) -> Markup:
    return Markup('<span class="tag {}">{}</span>').format(TONES.get(verdict, ""), words(verdict))


def _episode_table(findings: Sequence[Finding]) -> Table:
    rows: list[list[object]] = []
    for finding in findings:
        tag = _tag(finding.verdict)
        if (diagnosis := finding.diagnosis) is None:
            rows.append([finding.episode_id, tag, finding.reason, None, None, *([None] * len(MEASURES))])
            continue
        shown = measures_shown(diagnosis)
        link = Markup('<a href="#{0}">{0}</a>').format(finding.episode_id)
        scores = [f"{diagnosis.best.score:.1f}", f"{diagnosis.none.score:.1f}"]
        rows.append([link, tag, diagnosis.best.mistake, *scores, *(shown[name] for name in MEASURES)])
    headings = ("Episode", "Verdict", "Best explanation", "Score", "As recorded", *MEASURES)
    caption = "Log-likelihood scores: 0 is as a healthy recording, lower is worse."
    return Table(headings, rows, range(3, len(headings)), caption)


def _ranked(finding: Finding) -> Table | None:
    """Readings that were tried, the likeliest first, with what speaks most against each."""
    if finding.diagnosis is None:
        return None
    rows = [
        [
            e.mistake,
            f"{e.score:.1f}",
            ", ".join(f"{name} {value:.1f}" for name, value in sorted(e.evidence.items(), key=lambda i: i[1])[:4]),
        ]
        for e in finding.diagnosis.ranked[:RANKED_SHOWN]
    ]
    return Table(("Reading", "Score", "What costs it most"), rows, [1])
