"""What a calibration check found, as a table for the terminal and as JSON.

What a calibration check found, as a page with a picture of every episode.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from worldline_core.calibration.diagnosis import (
    CalibrationCheck,
    Diagnosis,
    Explanation,
    Finding,
    SetDiagnosis,
    SetFinding,
)
from worldline_core.report.markup import Child, Column, Html, element, figure, join, notice, table
from worldline_core.report.page import asset

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
RANKED_SHOWN = 6


def page(check: CalibrationCheck) -> str:
    """The page: conclusions first, then a table, then a picture of each episode, the worst first."""
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("meta", name="color-scheme", content="light dark"),
        element("title", "Calibration check"),
        element("style", Html(asset("style.css"))),
    )
    counted = Counter(finding.verdict for finding in check.findings)
    tiles = [
        element(
            "div",
            element("div", str(counted[name]), class_="figure"),
            element("div", name.replace("_", " "), class_="what"),
            element("div", MEANING[name], class_="how"),
            class_=f"tile {_tone(name)}".strip(),
        )
        for name in ORDER
        if counted[name]
    ]
    ordered = sorted(check.findings, key=lambda finding: (ORDER.index(finding.verdict), finding.episode_id))
    body = element(
        "body",
        element(
            "main",
            element(
                "header",
                element("h1", "Calibration check"),
                element("p", f"{len(check.findings)} episodes, judged by what they show.", class_="subtitle"),
                element("div", tiles, class_="tiles"),
            ),
            element("section", element("h2", "Conclusions"), _conclusions(check)),
            element("section", element("h2", "Episodes"), _episode_table(ordered)),
            element("section", element("h2", "Pictures"), [_card(finding) for finding in ordered]),
        ),
        element("footer", "Made by ", element("code", "worldline calibrate check"), "."),
    )
    return "<!doctype html>\n" + str(element("html", head, body, lang="en")) + "\n"


def _tone(verdict: str) -> str:
    return {"consistent": "good", "explained": "bad", "unexplained": "bad", "unreadable": "bad"}.get(verdict, "")


def _conclusions(check: CalibrationCheck) -> Html:
    parts: list[Child] = []
    for found in check.sets:
        parts.append(element("h3", set_headline(found.diagnosis)))
        parts.append(element("p", f"Single episodes say: {votes_text(found.diagnosis)}."))
        parts += [notice(caution) for caution in cautions(found.diagnosis)]
        parts += [element("p", note, class_="muted") for note in found.diagnosis.notes]
        if found.config_lines:
            parts.append(element("pre", "\n".join(found.config_lines)))
    return join(parts or element("p", "Too few episodes of one source to conclude anything over them together."))


def _episode_table(findings: Sequence[Finding]) -> Html:
    columns = [Column("Episode"), Column("Verdict"), Column("Best explanation"), Column("Score", numeric=True)]
    columns += [Column("As recorded", numeric=True), *(Column(name, numeric=True) for name in MEASURES)]
    rows: list[list[object]] = []
    for finding in findings:
        tag = element("span", finding.verdict.replace("_", " "), class_=f"tag {_tone(finding.verdict)}".strip())
        if (diagnosis := finding.diagnosis) is None:
            rows.append([finding.episode_id, tag, finding.reason, None, None, *([None] * len(MEASURES))])
            continue
        shown = measures_shown(diagnosis)
        link = element("a", finding.episode_id, href=f"#{finding.episode_id}")
        scores = [f"{diagnosis.best.score:.1f}", f"{diagnosis.none.score:.1f}"]
        rows.append([link, tag, diagnosis.best.mistake, *scores, *(shown[name] for name in MEASURES)])
    return table(columns, rows, caption="Log-likelihood scores: 0 is as a healthy recording, lower is worse.")


def _card(finding: Finding) -> Html:
    tag = element("span", finding.verdict.replace("_", " "), class_=f"tag {_tone(finding.verdict)}".strip())
    parts: list[Child] = [element("h3", finding.episode_id, " ", tag, id=finding.episode_id)]
    if finding.diagnosis is None:
        return join(*parts, notice(element("strong", f"{finding.reason}: "), finding.detail))
    if finding.config_lines:
        parts.append(element("pre", "\n".join(finding.config_lines)))
    parts += [element("p", note, class_="muted") for note in (*finding.diagnosis.notes, *finding.notes)]
    if finding.picture:
        repaired = finding.diagnosis.verdict == "explained"
        caption = "Left as recorded, right as repaired, the same frames." if repaired else "As recorded."
        image = element("img", src=finding.picture, alt=f"Overlay of {finding.episode_id}", loading="lazy")
        parts.append(figure(element("a", image, href=finding.picture), caption, class_="wide"))
    ranked = [
        [
            e.mistake,
            f"{e.score:.1f}",
            ", ".join(f"{name} {value:.1f}" for name, value in sorted(e.evidence.items(), key=lambda i: i[1])[:4]),
        ]
        for e in finding.diagnosis.ranked[:RANKED_SHOWN]
    ]
    columns = [Column("Reading"), Column("Score", numeric=True), Column("What costs it most")]
    parts.append(element("details", element("summary", "Readings that were tried"), table(columns, ranked)))
    return join(parts)
