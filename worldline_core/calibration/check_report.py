"""Results of a calibration check: a table for the terminal, JSON, and a page with a picture of every episode."""

from __future__ import annotations

import json
import textwrap
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from pydantic import ConfigDict, TypeAdapter

from worldline_core.calibration.diagnosis import Conclusion, Diagnosis, SourceDiagnosis
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
COLUMNS = ("Episode", "Verdict", "Best explanation", "Score", "As recorded")
DETAIL_LETTERS = 160
"""Length of an error in its line of the table; the page and diagnoses.json have all of it."""
_READINGS_SHOWN, _GROUPS_SHOWN = 6, 12


@dataclass(frozen=True)
class EpisodeCheck:
    """Result for one episode: a diagnosis, or why there is none.

    Attributes:
        reason: quarantine reason code of an episode that cannot be read, with `detail`; None for one that can.
        config_lines: what the source's configuration must say, in place of what it says now.
        picture: path relative to the output folder.
        notes: of the check itself, beside the diagnosis' own.
    """

    episode_id: str
    source: str
    diagnosis: Diagnosis | None
    reason: str | None = None
    detail: str = ""
    config_lines: tuple[str, ...] = ()
    picture: str | None = None
    notes: tuple[str, ...] = ()

    @property
    def verdict(self) -> str:
        return "unreadable" if self.diagnosis is None else self.diagnosis.verdict

    @property
    def row(self) -> tuple[str, ...]:
        """Cells of COLUMNS."""
        found = self.diagnosis
        if found is None:
            return (self.episode_id, self.verdict, str(self.reason), "", "")
        scores = f"{found.best.score:.1f}", f"{found.as_recorded.score:.1f}"
        return (self.episode_id, verdict_text(found), found.best.mistake, *scores)


@dataclass(frozen=True)
class CalibrationCheck:
    """All results, and the folder that they were written to."""

    episodes: tuple[EpisodeCheck, ...]
    sources: tuple[SourceDiagnosis, ...]
    output: Path

    @property
    def consistent(self) -> bool:
        """Whether some episode is consistent, and nothing is wrong with any other."""
        verdicts = {episode.verdict for episode in self.episodes}
        sound = not verdicts & {"off", "explained", "unexplained", "unreadable"}
        return sound and "consistent" in verdicts and all(s.verdict not in ("off", "explained") for s in self.sources)

    @property
    def counted(self) -> dict[str, int]:
        """Episodes by verdict, the worst first."""
        counts = Counter(episode.verdict for episode in self.episodes)
        return {name: counts[name] for name in MEANINGS if counts[name]}


def verdict_text(found: Conclusion) -> str:
    """The verdict, with the camera that is off, or the largest turn of a camera that could have gone unseen."""
    if found.verdict == "off":
        return f"off: {found.off[0]}"
    return found.consistent_within if found.verdict == "consistent" else words(found.verdict)


def table_text(check: CalibrationCheck) -> str:
    """The table of episodes, the conclusion over each source, and the lines that repair it."""
    rows = [tuple(name.lower() for name in COLUMNS), *(episode.row for episode in check.episodes)]
    widths = [max(len(cell) for cell in column) for column in zip(*rows, strict=True)]
    lines = []
    for episode, row in zip((None, *check.episodes), rows, strict=True):
        cells = [cell.ljust(w) if i < 3 else cell.rjust(w) for i, (cell, w) in enumerate(zip(row, widths, strict=True))]
        if episode is not None and episode.diagnosis is None:
            # The reason of an unreadable episode takes the place of its scores.
            cells[2:] = [textwrap.shorten(f"{episode.reason}: {episode.detail}", DETAIL_LETTERS, placeholder=" ...")]
        lines.append("  ".join(cells).rstrip())
    lines.insert(1, "  ".join("-" * width for width in widths))
    return "\n".join([*lines, "", *conclusion_lines(check)])


def conclusion_lines(check: CalibrationCheck) -> list[str]:
    """What all episodes say together."""
    parts = [f"{count} {words(name)}" for name, count in check.counted.items()]
    lines = [f"{len(check.episodes)} episodes: {', '.join(parts)}"]
    for found in check.sources:
        lines += ["", source_headline(found), f"  single episodes say: {votes_text(found)}"]
        lines += [f"  {caution}" for caution in cautions(found)]
        lines += [f"  {error}" for error in found.off]
        for view in dict.fromkeys(error.view for error in found.camera_errors):
            bounds = [f"{e.kind} {e.bound:.1f} {e.unit}" for e in found.camera_errors if e.view == view]
            lines.append(f"  {view} within: {', '.join(bounds)}")
        own = [note for episode in check.episodes if episode.source == found.source for note in episode.notes]
        lines += [f"  note: {note}" for note in dict.fromkeys((*found.notes, *own))]
        lines += [f"  near: {near}" for near in found.nearest]
        if found.config_lines:
            lines += ["  what repairs it, in the configuration of this source:"]
            lines += [f"    {line}" for line in found.config_lines]
    lines += _single_episodes(check)
    return [*lines, "", f"pictures: {check.output / 'index.html'}"]


def _single_episodes(check: CalibrationCheck) -> list[str]:
    """Episodes that the conclusion over their source does not cover: what repairs them, or what comes nearest."""
    together = {found.source: found for found in check.sources}
    groups: dict[tuple[str, ...], list[str]] = {}
    for episode in check.episodes:
        found, diagnosis = together.get(episode.source), episode.diagnosis
        if diagnosis is None or diagnosis.verdict not in ("explained", "unexplained"):
            continue
        if found is not None and (found.verdict, found.config_lines) == (diagnosis.verdict, episode.config_lines):
            continue
        notes = (*diagnosis.notes, *episode.notes) if found is None else ()  # else printed with the source
        said = [f"note: {note}" for note in notes] + [f"near: {near}" for near in diagnosis.nearest]
        groups.setdefault((*said, *episode.config_lines), []).append(episode.episode_id)
    lines = ["", "single episodes (give those that differ a source of their own, by `include`):"] if groups else []
    for group, names in list(groups.items())[:_GROUPS_SHOWN]:
        lines.append(f"  {', '.join(names[:4])}{f' and {len(names) - 4} more' if len(names) > 4 else ''}:")
        lines += [f"    {line}" for line in group]
    if len(groups) > _GROUPS_SHOWN:
        lines.append(f"  and more, all in {check.output / 'diagnoses.json'}")
    return lines


def source_headline(found: SourceDiagnosis) -> str:
    """The conclusion over a source in one line."""
    score = f"score as recorded {found.as_recorded.score:.1f}"
    said = verdict_text(found) if found.verdict == "consistent" else words(found.verdict)
    if found.verdict == "mixed":
        said += ": its episodes were not written the same way, no line is right for all of them"
    elif found.verdict == "explained":
        said += f" by {found.best.mistake if found.best.other is None else found.best.text}"
        score = f"score {found.best.score:.1f}, as recorded {found.as_recorded.score:.1f}"
    return f"source {found.source}, {found.num_episodes} episodes together: {said} ({score})"


def votes_text(found: SourceDiagnosis) -> str:
    """What the episodes say one by one, the most frequent first."""
    ordered = sorted(found.votes.items(), key=lambda item: (-item[1], item[0]))
    return ", ".join(f"{words(name)} {count}" for name, count in ordered) or "nothing"


def cautions(found: SourceDiagnosis) -> list[str]:
    """A warning where a whole source would be changed for a minority of its episodes."""
    mistakes = set(found.best.departures)
    agreeing = sum(count for name, count in found.votes.items() if mistakes <= set(name.split("+")))
    if found.verdict != "explained" or 2 * agreeing >= found.num_episodes:
        return []
    return [
        f"mind: only {agreeing} of {found.num_episodes} episodes say so by themselves; look at their pictures before"
        " you change the source, and give those that differ a source of their own"
    ]


def as_json(check: CalibrationCheck) -> dict[str, Any]:
    """Everything in plain values; numbers that are not finite become null."""
    episodes = []
    for each in check.episodes:
        names = ("episode_id", "source", "verdict", "config_lines", "picture", "notes")
        content: dict[str, Any] = {name: getattr(each, name) for name in names}
        if each.diagnosis is None:
            content |= {"reason": each.reason, "detail": each.detail}
        else:
            content |= _conclusion_json(each.diagnosis) | {"measures": each.diagnosis.measures}
            content["notes"] = (*each.diagnosis.notes, *each.notes)
        episodes.append(content)
    names = ("source", "votes", "config_lines")
    sources = [
        {name: getattr(found, name) for name in names} | {"episodes": found.num_episodes} | _conclusion_json(found)
        for found in check.sources
    ]
    content = {"consistent": check.consistent, "episodes": episodes, "sources": sources}
    numbers = TypeAdapter(Any, config=ConfigDict(ser_json_inf_nan="null"))
    return json.loads(numbers.dump_json(content, fallback=lambda value: np.asarray(value).tolist()))


def _conclusion_json(found: Conclusion) -> dict[str, Any]:
    return {
        "verdict": found.verdict,
        "mistake": found.best.mistake,
        "score": found.best.score,
        "score_as_recorded": found.as_recorded.score,
        "ranked": [
            {"mistake": e.mistake, "reading": e.text, "score": e.score, "evidence": e.evidence} for e in found.ranked
        ],
        "notes": found.notes,
        "nearest": found.nearest,
        "camera_errors": [
            {
                "view": e.view,
                "kind": e.kind,
                "unit": e.unit,
                "estimate": e.estimate,
                "size": e.size,
                "half_interval_95": e.half_interval,
                "bound_95": e.bound,
                "off": e in found.off,
            }
            for e in found.camera_errors
        ],
    }


def page(check: CalibrationCheck) -> str:
    """The page: conclusions first, then a table, then a picture of each episode, the worst first."""
    order = list(MEANINGS)
    episodes = sorted(check.episodes, key=lambda episode: (order.index(episode.verdict), episode.episode_id))
    return render(
        "calibration/check_page.html",
        title="Calibration check",
        subtitle=f"{len(episodes)} episodes, judged by what they show.",
        check=check,
        episodes=episodes,
        meanings=MEANINGS,
        tones=TONES,
        headline=source_headline,
        votes=votes_text,
        cautions=cautions,
        readings=_readings,
        camera_errors=_camera_errors,
        table=Table(
            COLUMNS,
            [_page_row(episode) for episode in episodes],
            numeric=(3, 4),
            caption="Log-likelihood scores: 0 is as a healthy recording, lower is worse.",
        ),
    )


def _page_row(episode: EpisodeCheck) -> list[object]:
    name, verdict, *rest = episode.row
    tag = Markup('<span class="tag {}">{}</span>').format(TONES[episode.verdict], verdict)
    return [name if episode.diagnosis is None else Markup('<a href="#{0}">{0}</a>').format(name), tag, *rest]


def _camera_errors(found: Conclusion) -> Table:
    """Each camera's estimated errors, each as if it were the only one."""
    rows = []
    for e in found.camera_errors:
        values = ", ".join(f"{value:+.1f}" for value in e.estimate)
        size = f"{e.size:.1f} +- {e.half_interval:.1f}"
        rows.append([e.view, e.kind, f"{values} {e.unit}", size, f"{e.bound:.1f}", "off" if e in found.off else ""])
    return Table(("View", "Error", "Estimate", "Size", "Unseen up to", ""), rows, numeric=range(3, 5))


def _readings(diagnosis: Diagnosis) -> Table:
    """The best readings, with the terms that cost each the most."""
    rows = []
    for explanation in diagnosis.ranked[:_READINGS_SHOWN]:
        worst = sorted(explanation.evidence.items(), key=lambda item: item[1])[:4]
        costs = ", ".join(f"{name} {value:.1f}" for name, value in worst)
        rows.append([explanation.text, f"{explanation.score:.1f}", costs])
    return Table(("Reading", "Score", "What costs it most"), rows, numeric=[1])
