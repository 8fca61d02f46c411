"""What a calibration check found, as a page with a picture of every episode."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from worldline_core.calibration.check_report import MEASURES, ORDER, cautions, measures_shown, set_headline, votes_text
from worldline_core.calibration.findings import CalibrationCheck, Finding
from worldline_core.report.markup import Child, Column, Html, element, figure, join, notice, table
from worldline_core.report.page import asset

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
