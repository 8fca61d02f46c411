"""`worldline inspect`: counts of any artifact; for episodes, tracks and predictions a page with pictures of them.

The page shows a contact sheet, one episode with its controls drawn over it (or beside its prediction), and, for a filtered set,
kept and dropped clips by reason.
"""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from worldline_core.actions.actions_config import SIGMA_PX_REFERENCE
from worldline_core.actions.episode_tracks import ActionTracks
from worldline_core.actions.overlays import OverlayStyle, overlay_sheet, write_overlay_video
from worldline_core.data.episodes.episode_index import EpisodeRow, read_index, read_quarantine
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.guards.source_paths import safe_stem
from worldline_core.data.video.frames import VideoFrames
from worldline_core.errors import ArtifactError, ConfigError, DataError, WorldLineError
from worldline_core.exports.export import export_rollout, shown_tracks
from worldline_core.filters.verdict import REASONS
from worldline_core.pages.page import render, words
from worldline_core.pictures import Picture, SheetRow, contact_sheet, evenly_spaced, jpeg_bytes
from worldline_core.report.data import FINDINGS_FILE, choose_rows, sheet_rows
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
KEPT_COLOUR, LOST_COLOUR = (46, 150, 92), (179, 55, 47)


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
) -> Inspection:
    """Verify and describe an artifact, and write a page with pictures of it.

    Args:
        output: folder of `index.html` and its media; default: `run/inspect` of the artifact, which belongs to no digest.
        episodes: the EpisodeSet of tracks or predictions, or the one that was filtered; default: by the manifest.
        episode_id: the episode to show; default: the first one.
        video: also write a video of the episode, with its controls drawn over all views or its prediction beside the truth.

    Raises:
        ArtifactError: the folder is damaged, of no known kind, or its EpisodeSet is unknown.
        DataError: there is no such episode.
        ConfigError: an episode was asked for of a kind that has none.
    """
    verify_artifact(folder)
    kind = kind_of(folder)
    lines = describe(kind, folder)
    if kind not in PICTURED:
        if video or episode_id is not None:
            raise ConfigError("There are no pictures of this kind of artifact", expected=" | ".join(PICTURED), got=kind)
        return Inspection(kind, lines)
    subject = _Subject(kind, folder, episodes, output or folder / "run" / "inspect")
    subject.write(episode_id, video=video)
    names = [path.name for path in subject.written]
    title = f"{kind} {folder.resolve().name}"
    kept = None if subject.curated is None else (len(read_index(folder)), len(subject.curated))
    page = render("report/inspect.html", title=title, lines=lines, subject=subject, names=names, kept=kept)
    write_bytes_atomic(subject.output / "index.html", page.encode())
    return Inspection(kind, [*lines, *subject.notes], [subject.output / "index.html", *subject.written])


def describe(kind: str, folder: Path) -> list[str]:
    """Step and digest, and the contents of an artifact in a few lines."""
    manifest = read_json(folder / "manifest.json")
    step, version, digest = (manifest.get(key) for key in ("step", "version", "digest"))
    first = [f"step {step}, version {version}, digest {str(digest)[:16]}"] if manifest else []
    if kind == "Scores":
        values: dict[str, list[float]] = defaultdict(list)
        for row in read_rows(folder / "scores.parquet"):
            values[f"{row['split']:10} {row['metric']:28} {row['method']:28}"].append(row["value"])
        return [*first, *(f"{name} mean {np.mean(v):9.4f}  n {len(v)}" for name, v in sorted(values.items()))]
    if kind == "Checkpoint":
        content = read_json(folder / "checkpoint.json")
        return [*first, *(f"{key}: {json.dumps(value, sort_keys=True)}" for key, value in sorted(content.items()))]
    if kind == "Report":
        return [*first, f"open {folder / 'index.html'} in a browser"]
    rows, refused = read_rows(folder / "index.parquet"), read_rows(folder / "quarantine.parquet")
    counted = [(rows, key) for key in COUNTED.get(kind, ()) if rows and key in rows[0]]
    counts = []
    for values, key in [*counted, *([(refused, "reason")] if refused else [])]:
        found = Counter(sorted(str(row[key]) for row in values)).most_common()
        counts.append(f"{key}: " + ", ".join(f"{name} {count}" for name, count in found))
    episodes = len({row["episode_id"] for row in rows})
    return [*first, f"{episodes} episodes, {len(rows)} rows", f"quarantine: {len(refused)}", *counts]


class _Subject:
    """An artifact with pictures, the episodes that it belongs to, and what is written of it."""

    def __init__(self, kind: str, folder: Path, given: Path | None, output: Path) -> None:
        self.kind, self.folder, self.output = kind, folder, output
        linked = given or linked_folder(folder, "episodes")
        if linked is not None:
            verify_artifact(linked)
        self.episodes_folder = folder if kind == "EpisodeSet" else linked
        self.curated = None
        self.notes: list[str] = []
        self.written: list[Path] = []
        self.reasons: list[tuple[object, ...]] = []
        if kind == "EpisodeSet" and (folder / FINDINGS_FILE).is_file():
            if linked is None:
                self.notes.append("dropped clips are not shown: the unfiltered set is unknown (--episodes FOLDER)")
            else:
                self.curated = EpisodeSet.open(linked)

    def picture(self, name: str, picture: Picture) -> str:
        self.written.append(self.output / f"{name}.jpg")
        write_bytes_atomic(self.written[-1], jpeg_bytes(picture))
        return self.written[-1].name

    def write(self, episode_id: str | None, *, video: bool) -> None:
        """Write everything that the page shows."""
        own = dict.fromkeys(str(row["episode_id"]) for row in read_rows(self.folder / "index.parquet"))
        if self.curated is not None and self.write_filters(self.curated, episode_id) and episode_id not in own:
            return  # dropped, or cut into segments with other names
        rollouts = RolloutSet.open(self.folder) if self.kind == "RolloutSet" else None
        if rollouts is not None:
            self.picture("contact_sheet", contact_sheet(prediction_rows(rollouts)))
        if self.episodes_folder is None and episode_id is None and not video:
            self.notes.append("one episode is not shown: the EpisodeSet is unknown (--episodes FOLDER)")
            return
        if self.episodes_folder is None:
            raise ArtifactError(
                "The episodes that this artifact belongs to are unknown",
                where=self.folder,
                expected="a manifest that names a folder which is still there",
                next_step="name the EpisodeSet with --episodes FOLDER",
            )
        episodes = EpisodeSet.open(self.episodes_folder)
        if self.kind == "EpisodeSet":
            rows, unreadable = sheet_rows(episodes, choose_rows(episodes.rows, range(len(episodes)), SHEET_ROWS))
            self.notes += unreadable
            if rows:
                self.picture("contact_sheet", contact_sheet(rows))
        shown = episode_id or next((row.episode_id for row in episodes.rows if row.episode_id in own), None)
        if shown is None:
            raise DataError("The artifact shares no episode with this EpisodeSet", where=episodes.root)
        if rollouts is None:
            self.write_controls(episodes, shown, video=video)
        else:
            row = episodes.rows[episodes.position(shown)]
            rows = compared_rows(rollouts, episodes, shown, rollouts.views(shown))
            sheet = contact_sheet(rows, title=f"{shown}  ·  {row.embodiment}  ·  {row.instruction}")
            self.picture(f"{safe_stem(shown)}_prediction", sheet)
            if video:
                self.written += export_rollout(
                    {rollouts.method: rollouts}, episodes, None, shown, self.output, ("mp4",)
                )

    def write_controls(self, episodes: EpisodeSet, episode_id: str, *, video: bool) -> None:
        """Moments of one episode with its controls, and a video of the same."""
        stem, position = safe_stem(episode_id), episodes.position(episode_id)
        row = episodes.rows[position]
        recorded = ActionTracks.open(self.folder) if self.kind == "ActionTracks" else None
        try:
            tracks = recorded.tracks(episode_id) if recorded else shown_tracks(episodes.episode(position))
        except WorldLineError as error:
            self.notes.append(f"no controls are shown: {error.what} ({error.where})")
            return
        style = OverlayStyle(SIGMA_PX_REFERENCE if recorded is None else recorded.sigma_px_ref)
        title = f"{episode_id}  ·  {row.embodiment}  ·  {row.instruction}  ·  drawn: {tracks.controls_label}"
        clips = {view: VideoFrames(episodes.clip(position, view)) for view in row.views}
        moments = evenly_spaced(min(tracks.num_frames, row.video_frames), 4)
        frames = {view: clip[moments] for view, clip in clips.items()}
        self.picture(f"{stem}_controls", overlay_sheet(frames, tracks, moments, style=style, title=title))
        if video:
            self.written.append(self.output / f"{stem}.mp4")
            write_overlay_video(self.written[-1], clips, tracks, row.fps, style=style, title=title)

    def write_filters(self, curated: EpisodeSet, episode_id: str | None) -> bool:
        """Clips of up to four episodes of every reason, or of one episode; False where the filters judged no such episode."""
        clips = clips_by_reason(self.folder)
        judged = {name for found in clips.values() for name in found}
        whole = episode_id if episode_id is None or episode_id in judged else episode_of(episode_id)
        for reason, found in clips.items():
            names = [name for name in found if whole in (None, name)][:CLIPS_PER_REASON]
            rows = list[SheetRow]()
            for name in names:
                position, clip = curated.position(name), found[name]
                row, (shown, unreadable) = curated.rows[position], sheet_rows(curated, [position])
                self.notes += unreadable
                colours = np.full((row.video_frames, 3), LOST_COLOUR, dtype=np.uint8)
                for segment in clip.kept:
                    colours[segment.start - row.start : segment.stop - row.start] = KEPT_COLOUR
                title = f"{words(reason)}: {clip.decision}"
                rows += [SheetRow(f"{title}  ·  {s.note}", s.frames, clip.numbers, colours) for s in shown]
            name = safe_stem(reason) if whole is None else f"{safe_stem(whole)}_{safe_stem(reason)}"
            if names:
                picture = self.picture(f"reason_{name}", contact_sheet(rows, tile_height=96)) if rows else None
                dropped = sum(not clip.kept for clip in found.values())
                self.reasons.append((reason, REASONS.get(reason, ""), len(found), dropped, picture))
        return episode_id in judged


def prediction_rows(rollouts: RolloutSet) -> list[SheetRow]:
    """Moments of up to eight predictions, head view first."""
    names, rows = sorted(rollouts.episode_ids), list[SheetRow]()
    for name in [names[i] for i in evenly_spaced(len(names), SHEET_ROWS)]:
        view = rollouts.views(name)[0]
        frames = VideoFrames(rollouts.clip(name, view))
        rows.append(SheetRow(f"{rollouts.method}  ·  {name}", frames[evenly_spaced(len(frames), MOMENTS)], view))
    return rows


# Filtered sets


class FilteredClip(NamedTuple):
    """A curated episode as an example of a reason: what the filters did, the numbers behind it, and the segments kept."""

    decision: str
    numbers: str
    kept: Sequence[EpisodeRow]


def clips_by_reason(folder: Path) -> dict[str, dict[str, FilteredClip]]:
    """By reason and episode, everything that a filter step judged: the most frequent reason first, `kept` last.

    Raises: DataError, ArtifactError: a table of the step is missing or damaged.
    """
    kept: dict[str, list[EpisodeRow]] = defaultdict(list)
    for row in read_index(folder):
        kept[episode_of(row.episode_id)].append(row)
    clips: dict[str, dict[str, FilteredClip]] = defaultdict(dict)
    for row in read_quarantine(folder):
        clips[row.reason][row.episode_id] = FilteredClip("dropped whole", row.detail, ())
    cut = set[str]()
    for row in read_rows(folder / FINDINGS_FILE):
        if row["cut_frames"] and (name := row["episode_id"]) in kept:
            cut.add(name)
            measured = {k: v for k, v in json.loads(row["numbers"]).items() if isinstance(v, float)}
            numbers = "  ·  ".join(f"{words(key)} {value:.3g}" for key, value in measured.items())
            decision = f"{row['cut_frames']} frames cut"
            clips[row["detector"]].setdefault(name, FilteredClip(decision, numbers, kept[name]))
    for name, rows in sorted(kept.items()):
        barred = {row.stage2_reason or "unfit for Stage II" for row in rows if not row.stage2_ok}
        for reason in sorted(barred) or ([] if name in cut else [KEPT]):
            decision = "kept whole" if reason == KEPT else "kept for Stage I only"
            clips[reason].setdefault(name, FilteredClip(decision, "", rows))
    return dict(sorted(clips.items(), key=lambda item: (item[0] == KEPT, -len(item[1]), item[0])))


def episode_of(name: str) -> str:
    """The episode that a kept row was cut from: `episode@00120` is a segment of `episode`."""
    episode, _, start = name.rpartition("@")
    return episode if episode and len(start) == 5 and start.isdigit() else name
