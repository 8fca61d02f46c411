"""What the filters did, for `worldline inspect`: kept and dropped clips by reason, with the curves that decided."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path

import numpy as np

from worldline_core.config import validate
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.guards.source_paths import safe_stem
from worldline_core.data.video.frames import VideoFrames
from worldline_core.errors import DataError
from worldline_core.filters.filter import inspect
from worldline_core.filters.filter_config import FilterConfig
from worldline_core.filters.signals import measure
from worldline_core.filters.verdict import REASONS, Curve, Finding
from worldline_core.pages.page import render
from worldline_core.pictures import (
    KEPT_COLOUR,
    ClipStrip,
    Picture,
    clip_strip,
    evenly_spaced,
    jpeg_bytes,
    png_bytes,
    reason_colour,
    stacked,
)
from worldline_core.report.filters import KEPT, FilteredEpisode, numbers_text, read_outcomes
from worldline_core.store.artifact_files import read_json
from worldline_core.store.atomic import write_bytes_atomic

LOST_WITH_THEM = "lost_with_them"
MOMENTS = 8
CLIPS_PER_REASON = 4


class FilteredSet:
    """A filter step's artifact beside the EpisodeSet that it filtered."""

    def __init__(self, folder: Path, curated: Path) -> None:
        self.folder = folder
        self.episodes = EpisodeSet.open(curated)
        self.outcomes = read_outcomes(folder)

    @cached_property
    def config(self) -> FilterConfig:
        """The thresholds that the artifact was made with, as its manifest says; the defaults where there is none."""
        content = read_json(self.folder / "manifest.json").get("config")
        return FilterConfig() if content is None else validate(FilterConfig, content, where=self.folder)

    def segments(self, name: str) -> list[tuple[int, int]]:
        """(start, stop) frames of an episode that were kept."""
        first = self.episodes.rows[self.episodes.position(name)].start
        return [(row.start - first, row.stop - first) for row in self.outcomes[name].kept]

    def findings(self, episode_id: str) -> list[Finding]:
        """The detectors' verdicts with their curves, measured again.

        Raises: DataError when the episode's images cannot be read.
        """
        i = self.episodes.position(episode_id)
        row = self.episodes.rows[i]
        thumbnails = {view: self.episodes.thumbnails(i, view) for view in row.views}
        return inspect(self.config.for_source(row.source), measure(self.episodes.episode(i), thumbnails))

    def by_reason(self) -> dict[str, list[FilteredEpisode]]:
        """Episodes under each heading, the kept ones last, the most frequent reason first."""
        groups: dict[str, list[FilteredEpisode]] = {}
        for episode in self.outcomes.values():
            for reason in episode.reasons:
                groups.setdefault(reason, []).append(episode)
        order = sorted(groups, key=lambda reason: (reason == KEPT, -len(groups[reason]), reason))
        return {reason: groups[reason] for reason in order}

    def strip(self, episode: FilteredEpisode, reason: str) -> Picture:
        """An episode with what is kept and dropped along time, and the curve of the detector that gave the reason.

        Raises: DataError when the episode's images cannot be read.
        """
        i = self.episodes.position(episode.episode_id)
        row = self.episodes.rows[i]
        findings = self.findings(episode.episode_id)
        decisive = next((f for f in findings if f.verdict.reason == reason and not f.verdict.clean), None)
        view = decisive.view if decisive is not None and decisive.view in row.views else row.primary_view
        moments = chosen_moments(None if decisive is None else decisive.verdict.bad_frames, row.video_frames)
        curve = None
        if decisive is not None and decisive.verdict.curves:
            name, found = deciding_curve(decisive)
            curve = (name, found.values[: row.video_frames], found.threshold)
        return clip_strip(
            ClipStrip(
                title=f"{heading(episode, reason)}  ·  {episode.episode_id}  ·  {view.replace('_', ' ')}",
                note="" if decisive is None else numbers_text(decisive.verdict.numbers),
                frames=np.asarray(self.episodes.frames(i, view, moments)),
                moments=moments,
                count=row.video_frames,
                dropped=self.dropped_frames(episode.episode_id, findings),
                curve=curve,
            )
        )

    def dropped_frames(self, name: str, findings: Sequence[Finding]) -> dict[str, np.ndarray]:
        """By reason, bool (frames,): those that did not get into any kept segment."""
        lost = np.ones(self.episodes.rows[self.episodes.position(name)].video_frames, dtype=bool)
        for start, stop in self.segments(name):
            lost[start:stop] = False
        bands: dict[str, np.ndarray] = {}
        for finding in findings:
            bad, reason = finding.verdict.bad_frames, finding.verdict.reason
            if bad is not None and (bad & lost).any():
                bands[reason] = bands.get(reason, np.zeros_like(lost)) | (bad & lost)
        rest = lost & ~np.logical_or.reduce([*bands.values(), np.zeros_like(lost)])
        if rest.any():
            # Healthy frames that went with the dropped ones: of an episode that is dropped whole, or too few in a row.
            bands[LOST_WITH_THEM] = rest
        return bands


def heading(episode: FilteredEpisode, reason: str) -> str:
    """What happened to the episode, in words."""
    if reason == KEPT:
        return "kept whole"
    name = reason.replace("_", " ")
    if episode.dropped is not None:
        return f"{name}: dropped whole"
    if reason not in episode.cut_by:
        return f"{name}: kept for Stage I only"
    return f"{name}: {episode.cut_by[reason]} frames cut, {len(episode.kept)} segment(s) kept"


def deciding_curve(finding: Finding) -> tuple[str, Curve]:
    """Of a detector's curves the one whose threshold best separates the frames that it dropped from the others."""
    bad = finding.verdict.bad_frames

    def separation(name: str) -> float:
        curve = finding.verdict.curves[name]
        if bad is None or bad.all() or not bad.any():
            return 0.0
        above = curve.values > curve.threshold
        return abs(float(above[bad].mean() - above[~bad].mean()))

    name = max(finding.verdict.curves, key=separation)
    return name, finding.verdict.curves[name]


def chosen_moments(bad: np.ndarray | None, count: int) -> list[int]:
    """Evenly spaced; half of them among the dropped frames where those are few."""
    if bad is None or not bad.any() or bad.mean() > 0.3:
        return evenly_spaced(count, MOMENTS)
    inside, outside = np.flatnonzero(bad), np.flatnonzero(~bad)
    chosen = [int(inside[i]) for i in evenly_spaced(len(inside), MOMENTS // 2)]
    return sorted(chosen + [int(outside[i]) for i in evenly_spaced(len(outside), MOMENTS - len(chosen))])


def reason_sheet(filtered: FilteredSet, reason: str, episodes: Sequence[FilteredEpisode]) -> Picture | None:
    """A sheet of up to four episodes under one heading; unreadable ones are left out, None where all are."""
    strips: list[Picture] = []
    for episode in episodes:
        if len(strips) == CLIPS_PER_REASON:
            break
        try:
            strips.append(filtered.strip(episode, reason))
        except DataError:
            continue
    return stacked(strips) if strips else None


def write_filter_page(filtered: FilteredSet, output: Path) -> list[Path]:
    """`index.html` with a sheet for every reason, and the sheets as `<reason>.jpg`; returns the page and the sheets."""
    groups: list[dict[str, object]] = []
    written: list[Path] = []
    for reason, episodes in filtered.by_reason().items():
        picture = reason_sheet(filtered, reason, episodes)
        path = output / f"{safe_stem(reason)}.jpg"
        if picture is not None:
            write_bytes_atomic(path, jpeg_bytes(picture, quality=86))
            written.append(path)
        cut = sum(reason in e.cut_by for e in episodes)
        dropped = sum(e.dropped is not None for e in episodes)
        counts = {"dropped whole": dropped, "lost frames": cut, "kept for Stage I only": len(episodes) - dropped - cut}
        groups.append({
            "reason": reason,
            "colour": KEPT_COLOUR if reason == KEPT else reason_colour(reason),
            "text": REASONS.get(reason, ""),
            "counts": [f"{count} {what}" for what, count in counts.items() if count],
            "total": len(episodes),
            "picture": path.name if picture is not None else None,
            "size": None if picture is None else (picture.shape[1], picture.shape[0]),
        })  # fmt: skip
    total, dropped = len(filtered.outcomes), sum(e.dropped is not None for e in filtered.outcomes.values())
    segments = sum(len(episode.kept) for episode in filtered.outcomes.values())
    subtitle = (
        f"{total} episodes: {total - dropped} kept in {segments} segments, {dropped} dropped whole. Green is kept; each reason has"
        " its own colour; pale grey went with what was dropped (too few frames in a row, or dropped whole). The curve is what the"
        " detector measured, the dashed line its threshold."
    )
    page = render("report/clips.html", title="What the filters kept and dropped", subtitle=subtitle, groups=groups)
    write_bytes_atomic(output / "index.html", page.encode())
    return [output / "index.html", *written]


def write_episode(filtered: FilteredSet, episode_id: str, output: Path, *, rerun: bool) -> list[Path]:
    """What the filters did with one episode: `<episode>_filters.png`, and `<episode>_filters.rrd` where asked for.

    Raises: DataError when its images cannot be read.
    """
    episode = filtered.outcomes[episode_id]
    path = output / f"{safe_stem(episode_id)}_filters.png"
    write_bytes_atomic(path, png_bytes(stacked([filtered.strip(episode, reason) for reason in episode.reasons])))
    if not rerun:
        return [path]
    from worldline_core.exports.rerun_recording import write_filter_recording  # imports Rerun

    i = filtered.episodes.position(episode_id)
    row = filtered.episodes.rows[i]
    findings = filtered.findings(episode_id)
    recording = output / f"{safe_stem(episode_id)}_filters.rrd"
    frames = {view: VideoFrames(filtered.episodes.clip(i, view)) for view in row.views}
    dropped = filtered.dropped_frames(episode_id, findings)
    write_filter_recording(recording, frames, dropped, findings, row.fps, summary(episode, findings))
    return [path, recording]


def summary(episode: FilteredEpisode, findings: Sequence[Finding]) -> str:
    """The verdict on an episode in Markdown."""
    lines = [f"**{episode.episode_id}**", "", *[f"- {heading(episode, reason)}" for reason in episode.reasons], ""]
    lines += [
        f"- `{finding.detector}` {finding.view or ''}: {numbers_text(finding.verdict.numbers)}"
        for finding in findings
        if not finding.verdict.clean
    ]
    return "\n".join(lines)
