"""`worldline inspect`: counts of any artifact; for episodes, tracks and predictions a page with pictures of them.

The page shows a contact sheet, one episode with its controls drawn over it (or beside its prediction), and, for a filtered set,
kept and dropped clips by reason with the curves that decided.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from worldline_core.actions.actions_config import SIGMA_PX_REFERENCE
from worldline_core.actions.episode_tracks import ActionTracks
from worldline_core.actions.overlays import OverlayStyle, write_overlay_video
from worldline_core.config import validate
from worldline_core.data.episodes.episode_index import EpisodeRow, read_index, read_quarantine
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.guards.source_paths import safe_stem
from worldline_core.data.video.frames import VideoFrames
from worldline_core.errors import ArtifactError, ConfigError, DataError, WorldLineError
from worldline_core.exports.export import export_rollout, recording_content, shown_tracks
from worldline_core.exports.rerun_recording import write_rerun_recording
from worldline_core.filters.filter import inspect as find_defects
from worldline_core.filters.filter_config import FilterConfig
from worldline_core.filters.signals import measure
from worldline_core.filters.verdict import REASONS, Curve, Finding
from worldline_core.pages.page import render, words
from worldline_core.pictures import (
    KEPT_COLOUR,
    ClipStrip,
    Picture,
    SheetRow,
    clip_strip,
    contact_sheet,
    evenly_spaced,
    jpeg_bytes,
    reason_colour,
    stacked,
)
from worldline_core.report.data import FINDINGS_FILE, choose_rows, episode_overlay, most_frequent, sheet_rows
from worldline_core.report.videos import compared_rows
from worldline_core.rollout.rollout_set import RolloutSet
from worldline_core.store.artifact_files import kind_of, linked_folder, read_json, read_rows, verify_artifact
from worldline_core.store.atomic import write_bytes_atomic

COUNTED = {
    "EpisodeSet": ("embodiment", "task_family", "outcome", "split", "source"),
    "ActionTracks": ("embodiment", "controls"),
    "Latents": ("embodiment", "controls"),
    "RolloutSet": ("method", "view", "seed"),
}
"""Columns of an index whose values are counted, by kind of artifact."""
PICTURED = ("EpisodeSet", "ActionTracks", "RolloutSet")
SHEET_ROWS, MOMENTS, CLIPS_PER_REASON = 8, 6, 4
KEPT = "kept"
LOST_WITH_THEM = "lost_with_them"


@dataclass(frozen=True)
class Inspection:
    """The kind of an artifact, lines to print, and files that were written."""

    kind: str
    lines: list[str]
    written: list[Path] = field(default_factory=list)

    def __str__(self) -> str:
        written = [f"wrote {path}" for path in self.written]
        return "\n".join([self.kind, *(f"  {line}" for line in self.lines), *written])


def inspect(
    folder: Path,
    output: Path | None = None,
    *,
    episodes: Path | None = None,
    episode_id: str | None = None,
    video: bool = False,
    rerun: bool = False,
) -> Inspection:
    """Verify and describe an artifact, and write a page with pictures of it.

    Args:
        output: folder of `index.html` and its media; default: `run/inspect` of the artifact, which belongs to no digest.
        episodes: the EpisodeSet of tracks or predictions, or the one that was filtered; default: by the manifest.
        episode_id: the episode to show; default: the first one.
        video: also write a video of the episode, with its controls drawn over all views or its prediction beside the truth.
        rerun: also write a Rerun recording of the episode.

    Raises:
        ArtifactError: the folder is damaged, of no known kind, or its EpisodeSet is unknown.
        DataError: there is no such episode.
        ConfigError: an episode was asked for of a kind that has none.
    """
    verify_artifact(folder)
    kind = kind_of(folder)
    lines = describe(kind, folder)
    if kind not in PICTURED:
        if video or rerun or episode_id is not None:
            raise ConfigError("There are no pictures of this kind of artifact", expected=" | ".join(PICTURED), got=kind)
        return Inspection(kind, lines)
    subject = _Subject(kind, folder, episodes, output or folder / "run" / "inspect")
    subject.write(episode_id, video=video, rerun=rerun)
    names = [path.name for path in subject.written]
    title = f"{kind} {folder.resolve().name}"
    page = render("report/inspect.html", title=title, lines=lines, subject=subject, names=names)
    write_bytes_atomic(subject.output / "index.html", page.encode())
    return Inspection(kind, [*lines, *subject.notes], [subject.output / "index.html", *subject.written])


def describe(kind: str, folder: Path) -> list[str]:
    """Step and digest, and the contents of an artifact in a few lines."""
    manifest = read_json(folder / "manifest.json")
    step, version, digest = (manifest.get(key) for key in ("step", "version", "digest"))
    first = [f"step {step}, version {version}, digest {str(digest)[:16]}"] if manifest else []
    if kind == "Scores":
        values: dict[str, list[float]] = {}
        for row in read_rows(folder / "scores.parquet"):
            values.setdefault(f"{row['split']:10} {row['metric']:28} {row['method']:28}", []).append(row["value"])
        return [*first, *(f"{name} mean {np.mean(v):9.4f}  n {len(v)}" for name, v in sorted(values.items()))]
    if kind == "Checkpoint":
        content = read_json(folder / "checkpoint.json")
        return [*first, *(f"{key}: {json.dumps(value, sort_keys=True)}" for key, value in sorted(content.items()))]
    if kind == "Report":
        return [*first, f"open {folder / 'index.html'} in a browser"]
    rows, refused = read_rows(folder / "index.parquet"), read_rows(folder / "quarantine.parquet")
    counted = [(rows, key) for key in COUNTED.get(kind, ()) if rows and key in rows[0]]
    counts = [
        f"{key}: " + ", ".join(f"{name} {count}" for name, count in most_frequent(str(row[key]) for row in values))
        for values, key in [*counted, *([(refused, "reason")] if refused else [])]
    ]
    episodes = len({row["episode_id"] for row in rows})
    return [*first, f"{episodes} episodes, {len(rows)} rows", f"quarantine: {len(refused)}", *counts]


class _Subject:
    """An artifact with pictures, the artifacts that it belongs to, and what is written of it."""

    def __init__(self, kind: str, folder: Path, given: Path | None, output: Path) -> None:
        self.kind, self.folder, self.output = kind, folder, output
        linked = given or linked_folder(folder, "episodes")
        if linked is not None:
            verify_artifact(linked)
        self.episodes_folder = folder if kind == "EpisodeSet" else linked
        self.filtered = None
        self.notes: list[str] = []
        self.written: list[Path] = []
        self.reasons: list[dict[str, object]] = []
        if kind == "EpisodeSet" and (folder / FINDINGS_FILE).is_file():
            if linked is None:
                self.notes.append("dropped clips are not shown: the unfiltered set is unknown (--episodes FOLDER)")
            else:
                self.filtered = FilteredSet(folder, linked)

    @cached_property
    def episodes(self) -> EpisodeSet:
        if self.episodes_folder is None:
            raise ArtifactError(
                "The episodes that this artifact belongs to are unknown",
                where=self.folder,
                expected="a manifest that names a folder which is still there",
                next_step="name the EpisodeSet with --episodes FOLDER",
            )
        return EpisodeSet.open(self.episodes_folder)

    @cached_property
    def rollouts(self) -> RolloutSet:
        return RolloutSet.open(self.folder)

    @cached_property
    def recorded_tracks(self) -> ActionTracks | None:
        folder = self.folder if self.kind == "ActionTracks" else linked_folder(self.folder, "tracks")
        return None if folder is None else ActionTracks.open(folder)

    def picture(self, name: str, picture: Picture) -> None:
        self.written.append(self.output / f"{name}.jpg")
        write_bytes_atomic(self.written[-1], jpeg_bytes(picture))

    def write(self, episode_id: str | None, *, video: bool, rerun: bool) -> None:
        """Write everything that the page shows."""
        if self.filtered is not None:
            whole = None
            if episode_id is not None:  # a segment is shown with the episode that it was cut from
                whole = episode_id if episode_id in self.filtered.outcomes else episode_of(episode_id)
            self.write_filters(self.filtered, whole)
            if whole in self.filtered.outcomes and episode_id not in {row.episode_id for row in self.episodes.rows}:
                return  # dropped, or cut into segments with other names
        if self.kind == "EpisodeSet":
            every = choose_rows(self.episodes.rows, range(len(self.episodes)), SHEET_ROWS)
            rows, unreadable = sheet_rows(self.episodes, every)
            self.notes += unreadable
        else:
            rows = self.prediction_rows() if self.kind == "RolloutSet" else []
        if rows:
            self.picture("contact_sheet", contact_sheet(rows))
        if self.episodes_folder is None and episode_id is None and not (video or rerun):
            self.notes.append("one episode is not shown: the EpisodeSet is unknown (--episodes FOLDER)")
        else:
            self.write_episode(self.first_episode if episode_id is None else episode_id, video=video, rerun=rerun)

    @property
    def first_episode(self) -> str:
        """The first episode that the artifact and its EpisodeSet share."""
        own = {str(row["episode_id"]) for row in read_rows(self.folder / "index.parquet")}
        known = [row.episode_id for row in self.episodes.rows if row.episode_id in own]
        if not known:
            raise DataError("The artifact shares no episode with this EpisodeSet", where=self.episodes.root)
        return known[0]

    def prediction_rows(self) -> list[SheetRow]:
        """Moments of up to eight predictions, head view first."""
        index = read_rows(self.folder / "index.parquet")
        views = {str(row["episode_id"]): str(row["view"]) for row in reversed(index)}
        names, rows = sorted(self.rollouts.episode_ids), list[SheetRow]()
        for name in [names[i] for i in evenly_spaced(len(names), SHEET_ROWS)]:
            frames = VideoFrames(self.rollouts.clip(name, views[name]))
            shown = frames[evenly_spaced(len(frames), MOMENTS)]
            rows.append(SheetRow(f"{self.rollouts.method}  ·  {name}", shown, views[name]))
        return rows

    def write_episode(self, episode_id: str, *, video: bool, rerun: bool) -> None:
        """Moments of one episode, with its controls or beside its prediction; a video and a Rerun recording of the same."""
        stem, position = safe_stem(episode_id), self.episodes.position(episode_id)
        row, tracks = self.episodes.rows[position], None
        sigma = SIGMA_PX_REFERENCE if self.recorded_tracks is None else self.recorded_tracks.sigma_px_ref
        try:
            if self.recorded_tracks is not None:
                tracks = self.recorded_tracks.tracks(episode_id)
            else:
                tracks = shown_tracks(self.episodes.episode(position))
        except WorldLineError as error:
            self.notes.append(f"no controls are shown: {error.what} ({error.where})")
        title = f"{row.embodiment}  ·  {row.instruction}"
        rollouts = {self.rollouts.method: self.rollouts} if self.kind == "RolloutSet" else {}
        if rollouts:
            rows = compared_rows(self.rollouts, self.episodes, episode_id, self.rollouts.views(episode_id))
            self.picture(f"{stem}_prediction", contact_sheet(rows, title=title))
            if video:
                self.written += export_rollout(rollouts, self.episodes, None, episode_id, self.output, ("mp4",))
        elif tracks is not None:
            sheet = episode_overlay(self.episodes, position, tracks, sigma, f"{episode_id}  ·  {title}")
            self.picture(f"{stem}_controls", sheet)
            if video:
                frames = {view: VideoFrames(self.episodes.clip(position, view)) for view in row.views}
                self.written.append(self.output / f"{stem}.mp4")
                write_overlay_video(self.written[-1], frames, tracks, row.fps, style=OverlayStyle(sigma), title=title)
        if rerun:
            content = recording_content(rollouts, self.episodes, tracks, episode_id, sigma_px_ref=sigma)
            self.written.append(self.output / f"{stem}.rrd")
            write_rerun_recording(self.written[-1], content)

    def write_filters(self, filtered: FilteredSet, episode_id: str | None) -> None:
        """Strips of one episode, or of up to four episodes of every reason."""
        if episode_id in filtered.outcomes:
            episode = filtered.outcomes[episode_id]
            strips = [filtered.strip(episode, reason) for reason in episode.reasons]
            self.picture(f"{safe_stem(episode_id)}_filters", stacked(strips))
        for reason, episodes in filtered.by_reason().items() if episode_id is None else ():
            strips, name = list[Picture](), f"reason_{safe_stem(reason)}"
            for episode in episodes[:CLIPS_PER_REASON]:
                try:
                    strips.append(filtered.strip(episode, reason))
                except DataError as error:
                    self.notes.append(f"No picture of {episode.episode_id}: {error.what}")
            if strips:
                self.picture(name, stacked(strips))
            self.reasons.append({
                "name": "kept whole" if reason == KEPT else reason,
                "colour": KEPT_COLOUR if reason == KEPT else reason_colour(reason),
                "text": "No detector found a defect." if reason == KEPT else REASONS.get(reason, ""),
                "count": len(episodes),
                "dropped": sum(episode.dropped == reason for episode in episodes),
                "picture": f"{name}.jpg" if strips else None,
            })  # fmt: skip


# Filtered sets


@dataclass(frozen=True)
class FilteredEpisode:
    """One curated episode after the filters.

    Attributes:
        dropped: the reason why it was dropped whole; None for a kept one.
        kept: its segments in the filtered set.
        cut: frames cut out of a kept episode, by reason.
    """

    episode_id: str
    dropped: str | None
    kept: Sequence[EpisodeRow]
    cut: Counter[str]

    @property
    def reasons(self) -> list[str]:
        """Every reason that it is an example of; `kept` for one without any."""
        if self.dropped is not None:
            return [self.dropped]
        barred = [row.stage2_reason or "unfit for Stage II" for row in self.kept if not row.stage2_ok]
        return list(dict.fromkeys([*self.cut, *barred])) or [KEPT]

    def decision(self, reason: str) -> str:
        """The filters' decision, in words."""
        if reason == KEPT:
            return "kept whole"
        cut = f"{self.cut[reason]} frames cut" if reason in self.cut else "kept for Stage I only"
        return f"{words(reason)}: {cut if self.dropped is None else 'dropped whole'}"


def read_outcomes(folder: Path) -> dict[str, FilteredEpisode]:
    """Every episode that a filter step has judged, by id.

    Raises: DataError, ArtifactError: a table of the step is missing or damaged.
    """
    dropped = {row.episode_id: row.reason for row in read_quarantine(folder)}
    kept: dict[str, list[EpisodeRow]] = {}
    for row in read_index(folder):
        kept.setdefault(episode_of(row.episode_id), []).append(row)
    cut: dict[str, Counter[str]] = {name: Counter() for name in sorted({*dropped, *kept})}
    for row in read_rows(folder / FINDINGS_FILE):
        if row["cut_frames"] and row["episode_id"] not in dropped:
            cut[row["episode_id"]][row["detector"]] += row["cut_frames"]
    return {name: FilteredEpisode(name, dropped.get(name), kept.get(name, ()), counts) for name, counts in cut.items()}


def episode_of(name: str) -> str:
    """The episode that a kept row was cut from: `episode@00120` is a segment of `episode`."""
    episode, _, start = name.rpartition("@")
    return episode if episode and len(start) == 5 and start.isdigit() else name


class FilteredSet:
    """A filter step's artifact beside the EpisodeSet that it filtered."""

    def __init__(self, folder: Path, curated: Path) -> None:
        self.episodes = EpisodeSet.open(curated)
        self.outcomes = read_outcomes(folder)
        config = read_json(folder / "manifest.json").get("config")
        self.config = FilterConfig() if config is None else validate(FilterConfig, config, where=folder)

    @property
    def summary(self) -> str:
        episodes = self.outcomes.values()
        dropped, segments = sum(e.dropped is not None for e in episodes), sum(len(e.kept) for e in episodes)
        return (
            f"{len(episodes)} episodes: {len(episodes) - dropped} kept in {segments} segments, {dropped} dropped whole."
        )

    def by_reason(self) -> dict[str, list[FilteredEpisode]]:
        """Episodes by reason, the most frequent first, the kept ones last."""
        groups: dict[str, list[FilteredEpisode]] = {}
        for episode in self.outcomes.values():
            for reason in episode.reasons:
                groups.setdefault(reason, []).append(episode)
        return dict(sorted(groups.items(), key=lambda item: (item[0] == KEPT, -len(item[1]), item[0])))

    def strip(self, episode: FilteredEpisode, reason: str) -> Picture:
        """An episode with kept and dropped frames along time, and the curve of the detector that gave the reason.

        Raises: DataError when the episode's images cannot be read.
        """
        i = self.episodes.position(episode.episode_id)
        row = self.episodes.rows[i]
        thumbnails = {view: self.episodes.thumbnails(i, view) for view in row.views}
        findings = find_defects(self.config.for_source(row.source), measure(self.episodes.episode(i), thumbnails))
        decisive = next((f for f in findings if f.verdict.reason == reason and not f.verdict.clean), None)
        view, curve, note = row.primary_view, None, ""
        moments = {*evenly_spaced(row.video_frames, MOMENTS)}
        if decisive is not None:
            view = decisive.view if decisive.view in row.views else view
            note = "  ·  ".join(
                f"{words(k)} {v:.3g}" for k, v in decisive.verdict.numbers.items() if isinstance(v, float)
            )
            if decisive.verdict.bad_frames is not None:
                bad = np.flatnonzero(decisive.verdict.bad_frames[: row.video_frames])
                moments |= {int(bad[n]) for n in evenly_spaced(len(bad), 2)}
            if decisive.verdict.curves:
                name, found = deciding_curve(decisive)
                curve = (name, found.values[: row.video_frames], found.threshold)
        return clip_strip(
            ClipStrip(
                title=f"{episode.decision(reason)}  ·  {episode.episode_id}  ·  {words(view)}",
                note=note,
                frames=np.asarray(self.episodes.frames(i, view, sorted(moments))),
                moments=sorted(moments),
                count=row.video_frames,
                dropped=dropped_frames(row, episode.kept, findings),
                curve=curve,
            )
        )


def dropped_frames(row: EpisodeRow, kept: Sequence[EpisodeRow], findings: Sequence[Finding]) -> dict[str, np.ndarray]:
    """By reason, bool (frames,): those that did not get into any kept segment."""
    lost = np.ones(row.video_frames, dtype=bool)
    for segment in kept:
        lost[segment.start - row.start : segment.stop - row.start] = False
    bands: dict[str, np.ndarray] = {}
    for finding in findings:
        bad, reason = finding.verdict.bad_frames, finding.verdict.reason
        if bad is not None and (bad & lost).any():
            bands[reason] = bands.get(reason, np.zeros_like(lost)) | (bad & lost)
    rest = lost & ~np.logical_or.reduce([*bands.values(), np.zeros_like(lost)])
    # Healthy frames that went with the dropped ones: of an episode that is dropped whole, or too few in a row.
    return bands | ({LOST_WITH_THEM: rest} if rest.any() else {})


def deciding_curve(finding: Finding) -> tuple[str, Curve]:
    """The curve of a detector whose threshold best separates dropped frames from the others."""
    bad = finding.verdict.bad_frames

    def separation(item: tuple[str, Curve]) -> float:
        above = item[1].values > item[1].threshold
        return 0.0 if bad is None or bad.all() or not bad.any() else abs(float(above[bad].mean() - above[~bad].mean()))

    return max(finding.verdict.curves.items(), key=separation)
