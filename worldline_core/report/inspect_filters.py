"""What the filters did, for `worldline inspect`: kept and dropped clips by reason, with the curves that decided."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from worldline_core.data.guards.source_paths import safe_stem
from worldline_core.errors import DataError
from worldline_core.filters.verdict import REASONS
from worldline_core.pages.page import render
from worldline_core.pictures.clip_strip import KEPT_COLOUR, ClipStrip, clip_strip, reason_colour, stacked
from worldline_core.pictures.contact_sheet import evenly_spaced
from worldline_core.pictures.labels import Picture, jpeg_bytes, png_bytes
from worldline_core.store.artifact_files import read_json, read_rows
from worldline_core.store.atomic import write_bytes_atomic

if TYPE_CHECKING:
    from worldline_core.data.episodes.episode_set import EpisodeSet
    from worldline_core.filters.filter_config import FilterConfig
    from worldline_core.filters.verdict import Curve, Finding

KEPT = "kept"
LOST_WITH_THEM = "lost_with_them"
MOMENTS = 8
CLIPS_PER_REASON = 4
NUMBERS_SHOWN = 6


@dataclass(frozen=True)
class FilteredClip:
    """One curated episode and what became of it.

    Attributes:
        segments: (start, stop) frames that were kept. reason: why the whole episode was dropped, None for a kept one.
        stage2_reason: why a kept one is barred from Stage II.
        findings: rows of findings.parquet, their numbers parsed.
    """

    episode_id: str
    segments: tuple[tuple[int, int], ...]
    reason: str | None
    stage2_reason: str | None
    findings: tuple[dict[str, Any], ...]

    @property
    def cut_by(self) -> dict[str, int]:
        """Reasons that cut frames out of a kept episode, and how many."""
        if self.reason is not None:
            return {}
        counts: Counter[str] = Counter()
        for finding in self.findings:
            if finding["cut_frames"]:
                counts[finding["detector"]] += finding["cut_frames"]
        return dict(counts)

    @property
    def reasons(self) -> list[str]:
        """Every heading of the page that the clip is shown under."""
        named = [self.reason] if self.reason else [*self.cut_by, *([self.stage2_reason] if self.stage2_reason else [])]
        return named or [KEPT]


class FilteredSet:
    """A filter step's artifact beside the EpisodeSet that it filtered."""

    def __init__(self, folder: Path, curated: Path) -> None:
        self.folder, self.curated = folder, curated

    @cached_property
    def episodes(self) -> EpisodeSet:
        from worldline_core.data.episodes.episode_set import EpisodeSet

        return EpisodeSet.open(self.curated)

    @cached_property
    def config(self) -> FilterConfig:
        """The thresholds that the artifact was made with, as its manifest says; the defaults where there is none."""
        from worldline_core.config import validate
        from worldline_core.filters.filter_config import FilterConfig

        content = read_json(self.folder / "manifest.json").get("config")
        return FilterConfig() if content is None else validate(FilterConfig, content, where=self.folder)

    @cached_property
    def clips(self) -> dict[str, FilteredClip]:
        """Every curated episode by id."""
        findings: dict[str, list[dict[str, Any]]] = {}
        for row in read_rows(self.folder / "findings.parquet"):
            numbers = json.loads(row["numbers"])
            findings.setdefault(row["episode_id"], []).append({**row, "numbers": numbers})
        dropped = {row["episode_id"]: row["reason"] for row in read_rows(self.folder / "quarantine.parquet")}
        kept: dict[tuple[str, int], list[dict[str, Any]]] = {}
        for row in read_rows(self.folder / "index.parquet"):
            kept.setdefault((Path(row["dataset"]).name, row["episode_index"]), []).append(row)
        clips = {}
        for row in self.episodes.rows:
            rows = kept.get((Path(row.dataset).name, row.episode_index), [])
            rows = [r for r in rows if row.start <= r["start"] and r["stop"] <= row.stop and r["source"] == row.source]
            clips[row.episode_id] = FilteredClip(
                row.episode_id,
                tuple((r["start"] - row.start, r["stop"] - row.start) for r in rows),
                dropped.get(row.episode_id),
                next((r["stage2_reason"] for r in rows if r["stage2_reason"]), None),
                tuple(findings.get(row.episode_id, ())),
            )
        return clips

    def findings(self, episode_id: str) -> list[Finding]:
        """The detectors' verdicts with their curves, measured again.

        Raises: DataError when the episode's images cannot be read.
        """
        from worldline_core.filters.filter import inspect
        from worldline_core.filters.signals import measure

        i = self.episodes.position(episode_id)
        row = self.episodes.rows[i]
        thumbnails = {view: self.episodes.thumbnails(i, view) for view in row.views}
        return inspect(self.config.for_source(row.source), measure(self.episodes.episode(i), thumbnails))

    def by_reason(self) -> dict[str, list[FilteredClip]]:
        """Clips under each heading, the kept ones last, the most frequent reason first."""
        groups: dict[str, list[FilteredClip]] = {}
        for clip in self.clips.values():
            for reason in clip.reasons:
                groups.setdefault(reason, []).append(clip)
        order = sorted(groups, key=lambda reason: (reason == KEPT, -len(groups[reason]), reason))
        return {reason: groups[reason] for reason in order}

    def strip(self, clip: FilteredClip, reason: str) -> Picture:
        """The clip with what is kept and dropped along time, and the curve of the detector that gave the reason.

        Raises: DataError when the episode's images cannot be read.
        """
        i = self.episodes.position(clip.episode_id)
        row = self.episodes.rows[i]
        findings = self.findings(clip.episode_id)
        count = row.video_frames
        decisive = next((f for f in findings if f.verdict.reason == reason and not f.verdict.clean), None)
        view = row.primary_view
        if decisive is not None and decisive.view in row.views:
            view = decisive.view
        moments = chosen_moments(None if decisive is None else decisive.verdict.bad_frames, count)
        frames = np.asarray(self.episodes.frames(i, view, moments))
        curve = None
        if decisive is not None and decisive.verdict.curves:
            name, found = deciding_curve(decisive)
            curve = (name, found.values[:count], found.threshold)
        return clip_strip(
            ClipStrip(
                f"{heading(clip, reason)}  ·  {clip.episode_id}  ·  {view.replace('_', ' ')}",
                "" if decisive is None else numbers_line(decisive.verdict.numbers),
                frames,
                moments,
                count,
                dropped_frames(clip, findings, count),
                curve,
            )
        )


def heading(clip: FilteredClip, reason: str) -> str:
    """What happened to the clip, in words."""
    if reason == KEPT:
        return "kept whole"
    name = reason.replace("_", " ")
    if clip.reason is not None:
        return f"{name}: dropped whole"
    if reason == clip.stage2_reason and reason not in clip.cut_by:
        return f"{name}: kept for Stage I only"
    return f"{name}: {clip.cut_by.get(reason, 0)} frames cut, {len(clip.segments)} segment(s) kept"


def dropped_frames(clip: FilteredClip, findings: Sequence[Finding], count: int) -> dict[str, np.ndarray]:
    """By reason, bool (count,): frames that did not get into any kept segment."""
    lost = np.ones(count, dtype=bool)
    for start, stop in clip.segments:
        lost[start:stop] = False
    bands: dict[str, np.ndarray] = {}
    for finding in findings:
        bad, reason = finding.verdict.bad_frames, finding.verdict.reason
        if bad is not None and (bad & lost).any():
            bands[reason] = bands.get(reason, np.zeros(count, dtype=bool)) | (bad & lost)
    rest = lost & ~np.logical_or.reduce([*bands.values(), np.zeros(count, dtype=bool)])
    if rest.any():
        # Healthy frames that went with the dropped ones: of an episode that is dropped whole, or too few in a row.
        bands[LOST_WITH_THEM] = rest
    return bands


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


def numbers_line(numbers: Any) -> str:
    """Measured values in one line."""
    shown = [(k, v) for k, v in numbers.items() if v is not None and not isinstance(v, list)][:NUMBERS_SHOWN]
    return "   ".join(
        f"{k.replace('_', ' ')} {v:.3g}" if isinstance(v, float) else f"{k.replace('_', ' ')} {v}" for k, v in shown
    )


def reason_sheet(filtered: FilteredSet, reason: str, clips: Sequence[FilteredClip]) -> Picture | None:
    """A sheet of up to four clips under one heading; unreadable ones are left out, None where all are."""
    strips: list[Picture] = []
    for clip in clips:
        if len(strips) == CLIPS_PER_REASON:
            break
        try:
            strips.append(filtered.strip(clip, reason))
        except DataError:
            continue
    return stacked(strips) if strips else None


def write_filter_page(filtered: FilteredSet, output: Path) -> list[Path]:
    """`index.html` with a sheet for every reason, and the sheets as `<reason>.jpg`; returns the page and the sheets."""
    groups: list[dict[str, object]] = []
    written: list[Path] = []
    for reason, clips in filtered.by_reason().items():
        picture = reason_sheet(filtered, reason, clips)
        path = output / f"{safe_stem(reason)}.jpg"
        if picture is not None:
            write_bytes_atomic(path, jpeg_bytes(picture, quality=86))
            written.append(path)
        counts = {
            "dropped whole": sum(c.reason == reason for c in clips),
            "lost frames": sum(reason in c.cut_by for c in clips),
            "kept for Stage I only": sum(
                c.reason is None and c.stage2_reason == reason and reason not in c.cut_by for c in clips
            ),
        }
        groups.append(
            {
                "reason": reason, "name": "kept whole" if reason == KEPT else reason,
                "colour": KEPT_COLOUR if reason == KEPT else reason_colour(reason),
                "text": "No detector found anything." if reason == KEPT else REASONS.get(reason, ""),
                "counts": [f"{len(clips)} episodes"] if reason == KEPT else [f"{n} {what}" for what, n in counts.items() if n],
                "total": len(clips), "picture": None if picture is None else path.name,
                "size": None if picture is None else (picture.shape[1], picture.shape[0]),
            }
        )  # fmt: skip
    total, dropped = len(filtered.clips), sum(clip.reason is not None for clip in filtered.clips.values())
    segments = sum(len(clip.segments) for clip in filtered.clips.values())
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
    clip = filtered.clips[episode_id]
    path = output / f"{safe_stem(episode_id)}_filters.png"
    write_bytes_atomic(path, png_bytes(stacked([filtered.strip(clip, reason) for reason in clip.reasons])))
    if not rerun:
        return [path]
    from worldline_core.exports.filter_recording import write_filter_recording

    i = filtered.episodes.position(episode_id)
    row = filtered.episodes.rows[i]
    findings = filtered.findings(episode_id)
    recording = output / f"{safe_stem(episode_id)}_filters.rrd"
    frames = {view: np.asarray(filtered.episodes.frames(i, view)) for view in row.views}
    dropped = dropped_frames(clip, findings, row.video_frames)
    write_filter_recording(recording, frames, dropped, findings, row.fps, summary(clip, findings))
    return [path, recording]


def summary(clip: FilteredClip, findings: Sequence[Finding]) -> str:
    """The verdict on a clip in Markdown."""
    lines = [f"**{clip.episode_id}**", "", *[f"- {heading(clip, reason)}" for reason in clip.reasons], ""]
    lines += [
        f"- `{finding.detector}` {finding.view or ''}: {numbers_line(finding.verdict.numbers)}"
        for finding in findings
        if not finding.verdict.clean
    ]
    return "\n".join(lines)
