"""What a calibration check found: a table for the terminal, JSON, and a page with a picture of every episode."""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
from markupsafe import Markup

from worldline_core.calibration.diagnosis import CalibrationCheck, Diagnosis, Finding, SetDiagnosis
from worldline_core.calibration.residual import bounds_lines, consistent_text, off_text
from worldline_core.pages.page import Table, render, words

MEANINGS = {
    "unexplained": "the recording disagrees with its calibration, and under no usual mistake it agrees",
    "explained": "one usual mistake explains what is wrong; the line repairs it",
    "off": "a camera is off: which one, in what and by how much is said beside it",
    "unreadable": "the episode cannot be read or judged",
    "too_little_evidence": "too little moves, or too little is calibrated, to judge",
    "consistent": "the recording agrees with its calibration, within what is said beside it",
}
"""By verdict, the worst first."""
TONES = {
    **dict.fromkeys(("unexplained", "explained", "off", "unreadable"), "bad"),
    "too_little_evidence": "",
    "consistent": "good",
}
MEASURES = ("hand-eye", "camera lag", "image lag", "in view", "flow")
DETAIL_LETTERS = 160
"""Of what is wrong with an episode, in its line of the table; the page and diagnoses.json have all of it."""
_READINGS_SHOWN, _GROUPS_SHOWN = 6, 12


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


def verdict_text(diagnosis: Diagnosis) -> str:
    """The verdict, with the camera that is off, or how far a camera could be turned unseen."""
    if diagnosis.verdict == "off":
        return f"off: {off_text(diagnosis.off[0])}"
    if diagnosis.verdict != "consistent":
        return words(diagnosis.verdict)
    return consistent_text(diagnosis.residuals)


def table_text(check: CalibrationCheck) -> str:
    """The table of episodes, the conclusion over each source, and the lines that repair it."""
    header = ["episode", "verdict", "best explanation", "score", "as recorded", *MEASURES]
    rows = [header, *(_table_row(finding) for finding in check.findings)]
    widths = [max(len(cell) for cell in column) for column in zip(*rows, strict=True)]
    lines = []
    for finding, row in zip((None, *check.findings), rows, strict=True):
        cells = [cell.ljust(w) if i < 3 else cell.rjust(w) for i, (cell, w) in enumerate(zip(row, widths, strict=True))]
        if finding is not None and finding.diagnosis is None:
            # The reason of an episode that cannot be read takes the place of all that was not measured.
            cells[2:] = [textwrap.shorten(f"{finding.reason}: {finding.detail}", DETAIL_LETTERS, placeholder=" ...")]
        lines.append("  ".join(cells).rstrip())
    lines.insert(1, "  ".join("-" * width for width in widths))
    return "\n".join([*lines, "", *conclusion_lines(check)])


def _table_row(finding: Finding) -> list[str]:
    diagnosis = finding.diagnosis
    if diagnosis is None:
        return [finding.episode_id, finding.verdict, *[""] * (3 + len(MEASURES))]
    scores = [f"{diagnosis.best.score:.1f}", f"{diagnosis.none.score:.1f}"]
    shown = measures_shown(diagnosis)
    return [
        finding.episode_id,
        verdict_text(diagnosis),
        diagnosis.best.mistake,
        *scores,
        *(shown[name] for name in MEASURES),
    ]


def conclusion_lines(check: CalibrationCheck) -> list[str]:
    """What all episodes say together."""
    counted = Counter(finding.verdict for finding in check.findings)
    parts = [f"{counted[name]} {words(name)}" for name in MEANINGS if counted[name]]
    lines = [f"{len(check.findings)} episodes: {', '.join(parts)}"]
    for found in check.sets:
        lines += ["", set_headline(found), f"  single episodes say: {votes_text(found)}"]
        lines += [f"  {caution}" for caution in cautions(found)]
        lines += [f"  {off_text(residual)}" for residual in found.off]
        lines += [f"  {line}" for line in bounds_lines(found.residuals)]
        own = [note for finding in check.findings if finding.source == found.source for note in finding.notes]
        lines += [f"  note: {note}" for note in dict.fromkeys((*found.notes, *own))]
        lines += [f"  near: {near}" for near in found.nearest]
        if found.config_lines:
            lines += ["  what repairs it, in the configuration of this source:"]
            lines += [f"    {line}" for line in found.config_lines]
    lines += _single_episodes(check)
    return [*lines, "", f"pictures: {check.output / 'index.html'}"]


def _single_episodes(check: CalibrationCheck) -> list[str]:
    """Episodes that no conclusion over their source speaks for: what repairs them, or what comes nearest."""
    together = {found.source: found for found in check.sets}
    groups: dict[tuple[str, ...], list[str]] = {}
    for finding in check.findings:
        found, diagnosis = together.get(finding.source), finding.diagnosis
        if diagnosis is None or diagnosis.verdict not in ("explained", "unexplained"):
            continue
        if found is not None and found.verdict == diagnosis.verdict and found.config_lines == finding.config_lines:
            continue
        notes = (*diagnosis.notes, *finding.notes) if found is None else ()  # else printed with the source
        said = [f"note: {note}" for note in notes] + [f"near: {near}" for near in diagnosis.nearest]
        groups.setdefault((*said, *finding.config_lines), []).append(finding.episode_id)
    lines = ["", "single episodes (give those that differ a source of their own, by `include`):"] if groups else []
    for group, names in list(groups.items())[:_GROUPS_SHOWN]:
        lines.append(f"  {', '.join(names[:4])}{f' and {len(names) - 4} more' if len(names) > 4 else ''}:")
        lines += [f"    {line}" for line in group]
    if len(groups) > _GROUPS_SHOWN:
        lines.append(f"  and more, all in {check.output / 'diagnoses.json'}")
    return lines


def set_headline(found: SetDiagnosis) -> str:
    """The conclusion over a source in one line."""
    as_recorded = next(e.score for e in found.ranked if e.mistake == "none")
    start = f"source {found.source}, {found.num_episodes} episodes together: {words(found.verdict)}"
    if found.verdict == "explained":
        named = found.best.mistake if found.best.other is None else found.best.text
        return f"{start} by {named} (score {found.best.score:.1f}, as recorded {as_recorded:.1f})"
    if found.verdict == "mixed":
        return f"{start}: its episodes were not written the same way, no line is right for all of them"
    if found.verdict == "consistent":
        start = start.replace("consistent", consistent_text(found.residuals))
    return f"{start} (score as recorded {as_recorded:.1f})"


def votes_text(found: SetDiagnosis) -> str:
    """What the episodes say one by one, the most frequent first."""
    ordered = sorted(found.votes.items(), key=lambda item: (-item[1], item[0]))
    return ", ".join(f"{words(name)} {count}" for name, count in ordered) or "nothing"


def cautions(found: SetDiagnosis) -> list[str]:
    """What to mind before a whole source is changed for what only some of its episodes say by themselves."""
    mistakes = set(found.best.departures)
    agreeing = sum(count for name, count in found.votes.items() if mistakes <= set(name.split("+")))
    if found.verdict != "explained" or 2 * agreeing >= found.num_episodes:
        return []
    return [
        f"mind: only {agreeing} of {found.num_episodes} episodes say so by themselves; look at their pictures before"
        " you change the source, and give those that differ a source of their own"
    ]


def as_json(check: CalibrationCheck) -> dict[str, Any]:
    """Everything, in plain values."""
    return plain(
        {
            "consistent": check.consistent,
            "episodes": [_finding_json(finding) for finding in check.findings],
            "sources": [
                {
                    "source": found.source,
                    "episodes": found.num_episodes,
                    "verdict": found.verdict,
                    "mistake": found.best.mistake,
                    "score": found.best.score,
                    "ranked": [{"mistake": e.mistake, "score": e.score, "reading": e.text} for e in found.ranked],
                    "votes": found.votes,
                    "notes": found.notes,
                    "nearest": found.nearest,
                    "config_lines": found.config_lines,
                    "residuals": _residuals_json(found),
                }
                for found in check.sets
            ],
        }
    )


def _finding_json(finding: Finding) -> dict[str, Any]:
    content: dict[str, Any] = {
        "episode_id": finding.episode_id,
        "source": finding.source,
        "verdict": finding.verdict,
        "config_lines": finding.config_lines,
        "picture": finding.picture,
        "notes": finding.notes,
    }
    diagnosis = finding.diagnosis
    if diagnosis is None:
        return content | {"reason": finding.reason, "detail": finding.detail}
    return content | {
        "mistake": diagnosis.best.mistake,
        "score": diagnosis.best.score,
        "score_as_recorded": diagnosis.none.score,
        "ranked": [
            {
                "mistake": e.mistake,
                "score": e.score,
                "evidence": e.evidence,
                "conventions": {name: getattr(e.conventions, name) for name in e.conventions.departures},
                "reading": e.text,
            }
            for e in diagnosis.ranked
        ],
        "measures": [asdict(measures) for measures in diagnosis.measures],
        "notes": (*diagnosis.notes, *finding.notes),
        "nearest": diagnosis.nearest,
        "residuals": _residuals_json(diagnosis),
    }


def _residuals_json(found: Diagnosis | SetDiagnosis) -> list[dict[str, Any]]:
    return [
        {
            "view": r.view,
            "kind": r.kind,
            "unit": r.unit,
            "estimate": list(r.estimate),
            "size": r.size,
            "error_95": r.error,
            "within_95": r.within,
            "off": r in found.off,
        }
        for r in found.residuals
    ]


def plain(value: Any) -> Any:
    """A value as JSON knows it: NumPy numbers become plain ones, what is not finite becomes null."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


def page(check: CalibrationCheck) -> str:
    """The page: conclusions first, then a table, then a picture of each episode, the worst first."""
    order = list(MEANINGS)
    counted = Counter(finding.verdict for finding in check.findings)
    findings = sorted(check.findings, key=lambda finding: (order.index(finding.verdict), finding.episode_id))
    return render(
        "calibration/check_page.html",
        title="Calibration check",
        subtitle=f"{len(check.findings)} episodes, judged by what they show.",
        check=check,
        findings=findings,
        counted={name: counted[name] for name in order if counted[name]},
        meanings=MEANINGS,
        tones=TONES,
        headline=set_headline,
        votes=votes_text,
        cautions=cautions,
        readings=_readings,
        residuals=_residuals,
        episodes=Table(
            ("Episode", "Verdict", "Best explanation", "Score", "As recorded", *MEASURES),
            [_page_row(finding) for finding in findings],
            numeric=range(3, 5 + len(MEASURES)),
            caption="Log-likelihood scores: 0 is as a healthy recording, lower is worse.",
        ),
    )


def _page_row(finding: Finding) -> list[object]:
    said = words(finding.verdict) if finding.diagnosis is None else verdict_text(finding.diagnosis)
    tag = Markup('<span class="tag {}">{}</span>').format(TONES[finding.verdict], said)
    if finding.diagnosis is None:
        return [finding.episode_id, tag, finding.reason, *[None] * (2 + len(MEASURES))]
    link = Markup('<a href="#{0}">{0}</a>').format(finding.episode_id)
    return [link, tag, *_table_row(finding)[2:]]


def _residuals(found: Diagnosis | SetDiagnosis) -> Table:
    """Each camera's estimated errors, each as if it were the only one."""
    rows = []
    for r in found.residuals:
        mark = "off" if r in found.off else ""
        values = ", ".join(f"{value:+.1f}" for value in r.estimate)
        rows.append([r.view, r.kind, f"{values} {r.unit}", f"{r.size:.1f} +- {r.error:.1f}", f"{r.within:.1f}", mark])
    return Table(("View", "Error", "Estimate", "Size", "Unseen up to", ""), rows, numeric=range(3, 5))


def _readings(diagnosis: Diagnosis) -> Table:
    """The best readings that were tried, with the terms that cost each the most."""
    rows = []
    for explanation in diagnosis.ranked[:_READINGS_SHOWN]:
        worst = sorted(explanation.evidence.items(), key=lambda item: item[1])[:4]
        costs = ", ".join(f"{name} {value:.1f}" for name, value in worst)
        rows.append([explanation.text, f"{explanation.score:.1f}", costs])
    return Table(("Reading", "Score", "What costs it most"), rows, numeric=[1])
