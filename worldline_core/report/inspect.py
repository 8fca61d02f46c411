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
from worldline_core.actions.episode_tracks import ActionTracks, EpisodeTracks
from worldline_core.actions.overlays import OverlayStyle, write_overlay_video
from worldline_core.config import validate
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.guards.source_paths import safe_stem
from worldline_core.data.video.frames import VideoFrames
from worldline_core.errors import ArtifactError, ConfigError, DataError, WorldLineError
from worldline_core.exports.export import export_rollout, recording_content, shown_tracks
from worldline_core.exports.rerun_recording import write_filter_recording, write_rerun_recording
from worldline_core.filters.filter import inspect as find_defects
from worldline_core.filters.filter_config import FilterConfig
from worldline_core.filters.signals import measure
from worldline_core.filters.verdict import REASONS, Curve, Finding
from worldline_core.pages.page import render
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
from worldline_core.report.data import KEPT, FilteredEpisode, episode_of, episode_overlay, numbers_text, read_outcomes
from worldline_core.report.dataset_card import choose_rows, sheet_rows
from worldline_core.report.videos import compared_rows
from worldline_core.rollout.rollout_set import RolloutSet
from worldline_core.store.artifact_files import (
    JsonObject,
    kind_of,
    linked_folder,
    read_json,
    read_rows,
    verify_artifact,
)
from worldline_core.store.atomic import write_bytes_atomic

COUNTED = {
    "EpisodeSet": ("embodiment", "task_family", "outcome", "split", "source"),
    "ActionTracks": ("embodiment", "controls"),
    "Latents": ("embodiment", "controls"),
    "RolloutSet": ("method", "view", "seed"),
}
"""Columns of an index whose values are counted, by kind of artifact."""
PICTURED = ("EpisodeSet", "ActionTracks", "RolloutSet")
SHEET_ROWS, MOMENTS = 8, 6
STRIP_MOMENTS, CLIPS_PER_REASON = 8, 4
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
        rerun: also write Rerun recordings of the episode.

    Raises:
        ArtifactError: the folder is damaged, of no known kind, or its EpisodeSet is unknown.
        DataError: there is no such episode.
        ConfigError: an episode was asked for of a kind that has none.
    """
    verify_artifact(folder, "fast")
    kind = kind_of(folder)
    lines = describe(kind, folder)
    if kind not in PICTURED:
        if video or rerun or episode_id is not None:
            raise ConfigError("There are no pictures of this kind of artifact", expected=" | ".join(PICTURED), got=kind)
        return Inspection(kind, lines)
    subject = _Subject(kind, folder, episodes, output or folder / "run" / "inspect")
    subject.write(episode_id, video=video, rerun=rerun)
    page = render(
        "report/inspect.html",
        title=f"{kind} {folder.resolve().name}",
        lines=lines,
        subject=subject,
        names=[path.name for path in subject.written],
    )
    write_bytes_atomic(subject.output / "index.html", page.encode())
    return Inspection(kind, [*lines, *subject.notes], [subject.output / "index.html", *subject.written])


def describe(kind: str, folder: Path) -> list[str]:
    """Step and digest, and the contents of an artifact in a few lines."""
    manifest = read_json(folder / "manifest.json")
    step, version, digest, seconds = (manifest.get(key) for key in ("step", "version", "digest", "wall_seconds"))
    took = f", {seconds:.1f} s" if isinstance(seconds, (int, float)) else ""
    first = [f"step {step}, version {version}, digest {str(digest)[:16]}{took}"] if manifest else []
    if kind == "Scores":
        return [*first, *_score_lines(folder)]
    if kind == "Checkpoint":
        content = read_json(folder / "checkpoint.json")
        size = sum(path.stat().st_size for path in folder.glob("*.safetensors"))
        known = [key for key in ("action_contract", "metadata", "model") if key in content]
        facts = [f"{key}: {json.dumps(content[key], sort_keys=True)}" for key in known]
        return [*first, f"kind {content.get('kind')}, {size / 1e6:.1f} MB of tensors", *facts]
    if kind == "Report":
        return [*first, f"open {folder / 'index.html'} in a browser"]
    rows, refused = read_rows(folder / "index.parquet"), read_rows(folder / "quarantine.parquet")
    lines = [*first, *(_counts(rows, key) for key in COUNTED.get(kind, ()) if rows and key in rows[0])]
    quarantine = [f"quarantine: {len(refused)}", *([_counts(refused, "reason")] if refused else [])]
    episodes = len({row["episode_id"] for row in rows})
    if kind == "EpisodeSet":
        return [f"{len(rows)} episodes, {sum(row['num_frames'] for row in rows)} time steps", *lines, *quarantine]
    if kind == "RolloutSet":
        return [f"{len(rows)} predicted videos of {episodes} episodes", *lines]
    return quarantine if kind == "Quarantine" else [f"{episodes} episodes", *lines, *quarantine]


def _counts(rows: list[JsonObject], key: str) -> str:
    """`key: a 3, b 2`, the most frequent first."""
    found = sorted(Counter(str(row[key]) for row in rows).items(), key=lambda item: (-item[1], item[0]))
    return f"{key}: " + ", ".join(f"{name} {count}" for name, count in found)


def _score_lines(folder: Path) -> list[str]:
    rows = read_rows(folder / "scores.parquet")
    values: dict[tuple[str, str, str], list[float]] = {}
    for row in rows:
        values.setdefault((str(row["split"]), str(row["metric"]), str(row["method"])), []).append(row["value"])
    lines = [
        f"{split:10s} {metric:28s} {method:28s} mean {np.mean(v):9.4f}  n {len(v)}"
        for (split, metric, method), v in sorted(values.items())
    ]
    return [f"{len(rows)} scores of {len({row['episode_id'] for row in rows})} trajectories", *lines]


class _Subject:
    """An artifact with pictures, the artifacts that it belongs to, and what is written of it."""

    def __init__(self, kind: str, folder: Path, given: Path | None, output: Path) -> None:
        self.kind, self.folder, self.output = kind, folder, output
        linked = given or linked_folder(folder, "episodes")
        self.episodes_folder = folder if kind == "EpisodeSet" else linked
        self.filtered = None
        self.notes: list[str] = []
        self.written: list[Path] = []
        self.reasons: list[dict[str, object]] = []
        if kind == "EpisodeSet" and (folder / "findings.parquet").is_file():
            if linked is None:
                self.notes.append(
                    "dropped clips are not shown: the unfiltered EpisodeSet is unknown (--episodes FOLDER)"
                )
            else:
                verify_artifact(linked, "fast")
                self.filtered = FilteredSet(folder, linked)
        elif kind != "EpisodeSet" and linked is not None:
            verify_artifact(linked, "fast")

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

    @property
    def sigma_px_ref(self) -> float:
        return SIGMA_PX_REFERENCE if self.recorded_tracks is None else self.recorded_tracks.sigma_px_ref

    def tracks(self, episode_id: str) -> EpisodeTracks:
        """The artifact's tracks of an episode, else those of its recorded tool poses or commands."""
        if self.recorded_tracks is not None:
            return self.recorded_tracks.tracks(episode_id)
        return shown_tracks(self.episodes.episode(self.episodes.position(episode_id)))

    def picture(self, name: str, picture: Picture) -> None:
        self.written.append(self.output / f"{name}.jpg")
        write_bytes_atomic(self.written[-1], jpeg_bytes(picture))

    def write(self, episode_id: str | None, *, video: bool, rerun: bool) -> None:
        """Write everything that the page shows."""
        if self.filtered is not None:
            whole = None
            if episode_id is not None:  # a segment is shown with the episode that it was cut from
                whole = episode_id if episode_id in self.filtered.outcomes else episode_of(episode_id)
            self.write_filters(self.filtered, whole, rerun=rerun)
            known = {row.episode_id for row in self.episodes.rows}
            if whole in self.filtered.outcomes and episode_id not in known:
                return  # dropped, or cut into segments with other names
        if self.episodes_folder is None and episode_id is None and not (video or rerun):
            self.notes.append("one episode is not shown: the EpisodeSet is unknown (--episodes FOLDER)")
            if self.kind == "RolloutSet":
                self.picture("contact_sheet", contact_sheet(self.prediction_rows()))
            return
        if self.kind == "EpisodeSet":
            every = choose_rows(self.episodes.rows, range(len(self.episodes)), SHEET_ROWS)
            rows, unreadable = sheet_rows(self.episodes, every)
            self.notes += unreadable
        else:
            rows = self.prediction_rows() if self.kind == "RolloutSet" else []
        if rows:
            self.picture("contact_sheet", contact_sheet(rows))
        self.write_episode(self.first_episode if episode_id is None else episode_id, video=video, rerun=rerun)

    @property
    def first_episode(self) -> str:
        """The first episode that the artifact and its EpisodeSet share."""
        known = [row.episode_id for row in self.episodes.rows]
        if self.kind != "EpisodeSet":
            own = {str(row["episode_id"]) for row in read_rows(self.folder / "index.parquet")}
            known = [name for name in known if name in own]
        if not known:
            raise DataError("The artifact shares no episode with this EpisodeSet", where=self.episodes.root)
        return known[0]

    def prediction_rows(self) -> list[SheetRow]:
        """Moments of up to eight predictions, head view first."""
        index = read_rows(self.folder / "index.parquet")
        views = {str(row["episode_id"]): str(row["view"]) for row in reversed(index)}
        names = sorted(self.rollouts.episode_ids)
        rows = []
        for name in [names[i] for i in evenly_spaced(len(names), SHEET_ROWS)]:
            frames = VideoFrames(self.rollouts.clip(name, views[name]))
            shown = frames[evenly_spaced(len(frames), MOMENTS)]
            rows.append(SheetRow(f"{self.rollouts.method}  ·  {name}", shown, views[name]))
        return rows

    def write_episode(self, episode_id: str, *, video: bool, rerun: bool) -> None:
        """Moments of one episode, with its controls or beside its prediction; a video and a Rerun recording of the same."""
        stem, position = safe_stem(episode_id), self.episodes.position(episode_id)
        row = self.episodes.rows[position]
        tracks = None
        try:
            tracks = self.tracks(episode_id)
        except WorldLineError as error:
            self.notes.append(f"no controls are shown: {error.what} ({error.where})")
        title = f"{row.embodiment}  ·  {row.instruction}"
        if self.kind == "RolloutSet":
            rows = compared_rows(self.rollouts, self.episodes, episode_id, self.rollouts.views(episode_id))
            self.picture(f"{stem}_prediction", contact_sheet(rows, title=title))
            if video:
                predicted = {self.rollouts.method: self.rollouts}
                self.written += export_rollout(predicted, self.episodes, None, episode_id, self.output, ("mp4",))
        elif tracks is not None:
            sheet = episode_overlay(self.episodes, position, tracks, self.sigma_px_ref, f"{episode_id}  ·  {title}")
            self.picture(f"{stem}_controls", sheet)
            if video:
                frames = {view: VideoFrames(self.episodes.clip(position, view)) for view in row.views}
                self.written.append(self.output / f"{stem}.mp4")
                style = OverlayStyle(self.sigma_px_ref)
                write_overlay_video(self.written[-1], frames, tracks, row.fps, style=style, title=title)
        if rerun:
            rollouts = {self.rollouts.method: self.rollouts} if self.kind == "RolloutSet" else {}
            content = recording_content(rollouts, self.episodes, tracks, episode_id, sigma_px_ref=self.sigma_px_ref)
            self.written.append(self.output / f"{stem}.rrd")
            write_rerun_recording(self.written[-1], content)

    def write_filters(self, filtered: FilteredSet, episode_id: str | None, *, rerun: bool) -> None:
        """Strips of one episode, or of up to four episodes of every reason."""
        if episode_id is not None:
            if episode_id in filtered.outcomes:
                episode = filtered.outcomes[episode_id]
                strips = [filtered.strip(episode, reason) for reason in episode.reasons]
                self.picture(f"{safe_stem(episode_id)}_filters", stacked(strips))
                if rerun:
                    self.written.append(filtered.write_recording(episode, self.output))
            return
        for reason, episodes in filtered.by_reason().items():
            strips = filtered.some_strips(reason, episodes)
            name = f"reason_{safe_stem(reason)}"
            if strips:
                self.picture(name, stacked(strips))
            cut, dropped = (
                sum(map(bool, found))
                for found in zip(*((reason in e.cut_by, e.dropped) for e in episodes), strict=True)
            )
            counts = {
                "dropped whole": dropped, "lost frames": cut, "kept for Stage I only": len(episodes) - dropped - cut
            }  # fmt: skip
            self.reasons.append({
                "name": "kept whole" if reason == KEPT else reason,
                "colour": KEPT_COLOUR if reason == KEPT else reason_colour(reason),
                "text": "No detector found a defect." if reason == KEPT else REASONS.get(reason, ""),
                "counts": [f"{len(episodes)} episodes"] if reason == KEPT else [f"{n} {w}" for w, n in counts.items() if n],
                "picture": f"{name}.jpg" if strips else None,
            })  # fmt: skip


class FilteredSet:
    """A filter step's artifact beside the EpisodeSet that it filtered."""

    def __init__(self, folder: Path, curated: Path) -> None:
        self.folder = folder
        self.episodes = EpisodeSet.open(curated)
        self.outcomes = read_outcomes(folder)

    @cached_property
    def config(self) -> FilterConfig:
        """The thresholds of the artifact's manifest, or the defaults."""
        content = read_json(self.folder / "manifest.json").get("config")
        return FilterConfig() if content is None else validate(FilterConfig, content, where=self.folder)

    @property
    def summary(self) -> str:
        episodes = self.outcomes.values()
        dropped, segments = sum(e.dropped is not None for e in episodes), sum(len(e.kept) for e in episodes)
        return (
            f"{len(episodes)} episodes: {len(episodes) - dropped} kept in {segments} segments, {dropped} dropped whole. Green is kept;"
            " each reason has its own colour; pale grey went with the dropped frames (too few in a row, or dropped whole). The curve"
            " is the detector's measurement, the dashed line its threshold."
        )

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
        return find_defects(self.config.for_source(row.source), measure(self.episodes.episode(i), thumbnails))

    def by_reason(self) -> dict[str, list[FilteredEpisode]]:
        """Episodes by reason, the most frequent first, the kept ones last."""
        groups: dict[str, list[FilteredEpisode]] = {}
        for episode in self.outcomes.values():
            for reason in episode.reasons:
                groups.setdefault(reason, []).append(episode)
        order = sorted(groups, key=lambda reason: (reason == KEPT, -len(groups[reason]), reason))
        return {reason: groups[reason] for reason in order}

    def some_strips(self, reason: str, episodes: Sequence[FilteredEpisode]) -> list[Picture]:
        """Strips of up to four readable episodes of one reason."""
        strips: list[Picture] = []
        for episode in episodes:
            if len(strips) < CLIPS_PER_REASON:
                try:
                    strips.append(self.strip(episode, reason))
                except DataError:
                    continue
        return strips

    def strip(self, episode: FilteredEpisode, reason: str) -> Picture:
        """An episode with kept and dropped frames along time, and the curve of the detector that gave the reason.

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

    def write_recording(self, episode: FilteredEpisode, output: Path) -> Path:
        """A Rerun recording of one episode with its kept and dropped frames and every detector's curve."""
        i = self.episodes.position(episode.episode_id)
        row = self.episodes.rows[i]
        findings = self.findings(episode.episode_id)
        path = output / f"{safe_stem(episode.episode_id)}_filters.rrd"
        frames = {view: VideoFrames(self.episodes.clip(i, view)) for view in row.views}
        lines = [f"**{episode.episode_id}**", "", *[f"- {heading(episode, reason)}" for reason in episode.reasons], ""]
        lines += [
            f"- `{finding.detector}` {finding.view or ''}: {numbers_text(finding.verdict.numbers)}"
            for finding in findings
            if not finding.verdict.clean
        ]
        dropped = self.dropped_frames(episode.episode_id, findings)
        write_filter_recording(path, frames, dropped, findings, row.fps, "\n".join(lines))
        return path


def heading(episode: FilteredEpisode, reason: str) -> str:
    """The filters' decision on an episode, in words."""
    if reason == KEPT:
        return "kept whole"
    name = reason.replace("_", " ")
    if episode.dropped is not None:
        return f"{name}: dropped whole"
    if reason not in episode.cut_by:
        return f"{name}: kept for Stage I only"
    return f"{name}: {episode.cut_by[reason]} frames cut, {len(episode.kept)} segment(s) kept"


def deciding_curve(finding: Finding) -> tuple[str, Curve]:
    """The curve of a detector whose threshold best separates dropped frames from the others."""
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
    """Evenly spaced moments; half of them among the dropped frames where those are few."""
    if bad is None or not bad.any() or bad.mean() > 0.3:
        return evenly_spaced(count, STRIP_MOMENTS)
    inside, outside = np.flatnonzero(bad), np.flatnonzero(~bad)
    chosen = [int(inside[i]) for i in evenly_spaced(len(inside), STRIP_MOMENTS // 2)]
    return sorted(chosen + [int(outside[i]) for i in evenly_spaced(len(outside), STRIP_MOMENTS - len(chosen))])
