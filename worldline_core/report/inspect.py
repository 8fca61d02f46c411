"""`worldline inspect`: counts of any artifact; for episodes, tracks and predictions a page with pictures of them.

The page shows a contact sheet, one episode with its controls drawn over it (or beside its prediction), and, for a filtered set,
dropped and cut clips by reason.
"""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from worldline_core.actions.actions_config import SIGMA_PX_REFERENCE
from worldline_core.actions.episode_tracks import ActionTracks
from worldline_core.actions.overlays import OverlayStyle, overlay_sheet
from worldline_core.data.episodes.episode_index import read_quarantine
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.guards.source_paths import safe_stem
from worldline_core.data.video.frames import VideoFrames
from worldline_core.errors import ArtifactError, ConfigError, DataError, WorldLineError
from worldline_core.evaluation.recordings import stride_of
from worldline_core.exports.export import shown_tracks
from worldline_core.pages.page import render, words
from worldline_core.pictures import Picture, SheetRow, contact_sheet, evenly_spaced, jpeg_bytes
from worldline_core.report.data import FINDINGS_FILE, MOMENTS, choose_rows, sheet_rows
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
SHEET_ROWS, CLIPS_PER_REASON = 8, 4


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
    folder: Path, output: Path | None = None, *, episodes: Path | None = None, episode_id: str | None = None
) -> Inspection:
    """Verify and describe an artifact, and write a page with pictures of it.

    Args:
        output: folder of `index.html` and its media; default: `run/inspect` of the artifact, which belongs to no digest.
        episodes: the EpisodeSet of tracks or predictions, or the one that was filtered; default: by the manifest.
        episode_id: the episode to show; default: the first one.

    Raises:
        ArtifactError: the folder is damaged, of no known kind, or its EpisodeSet is unknown.
        DataError: there is no such episode.
        ConfigError: an episode was asked for of a kind that has none.
    """
    verify_artifact(folder)
    kind = kind_of(folder)
    lines = describe(kind, folder)
    if kind not in PICTURED:
        if episode_id is not None:
            raise ConfigError("There are no pictures of this kind of artifact", expected=" | ".join(PICTURED), got=kind)
        return Inspection(kind, lines)
    linked = episodes or linked_folder(folder, "episodes")
    if linked is not None:
        verify_artifact(linked)
    page = _Page(folder, output or folder / "run" / "inspect")
    page.write(kind, linked, episode_id)
    title, names = f"{kind} {folder.resolve().name}", [path.name for path in page.written]
    text = render("report/inspect.html", title=title, lines=lines, notes=page.notes, names=names)
    write_bytes_atomic(page.output / "index.html", text.encode())
    return Inspection(kind, [*lines, *page.notes], [page.output / "index.html", *page.written])


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


@dataclass
class _Page:
    """Files written for an artifact with pictures, and notes on what cannot be shown."""

    folder: Path
    output: Path
    notes: list[str] = field(default_factory=list)
    written: list[Path] = field(default_factory=list)

    def picture(self, name: str, picture: Picture) -> None:
        self.written.append(self.output / f"{name}.jpg")
        write_bytes_atomic(self.written[-1], jpeg_bytes(picture))

    def write(self, kind: str, linked: Path | None, episode_id: str | None) -> None:
        own = dict.fromkeys(str(row["episode_id"]) for row in read_rows(self.folder / "index.parquet"))
        if kind == "EpisodeSet" and (self.folder / FINDINGS_FILE).is_file():
            if linked is None:
                self.notes.append("dropped clips are not shown: the unfiltered set is unknown (--episodes FOLDER)")
            elif self.write_refused(EpisodeSet.open(linked), episode_id) and episode_id not in {None, *own}:
                return  # dropped, or cut into segments with other names
        rollouts = RolloutSet.open(self.folder) if kind == "RolloutSet" else None
        folder = self.folder if kind == "EpisodeSet" else linked
        if folder is None and episode_id is None:
            self.notes.append("one episode is not shown: the EpisodeSet is unknown (--episodes FOLDER)")
            return
        if folder is None:
            raise ArtifactError(
                "The episodes that this artifact belongs to are unknown",
                where=self.folder,
                expected="a manifest that names a folder which is still there",
                next_step="name the EpisodeSet with --episodes FOLDER",
            )
        episodes = EpisodeSet.open(folder)
        if kind == "EpisodeSet":
            rows, unreadable = sheet_rows(episodes, choose_rows(episodes.rows, range(len(episodes)), SHEET_ROWS))
            self.notes += unreadable
            if rows:
                self.picture("contact_sheet", contact_sheet(rows))
        shown = episode_id or next((row.episode_id for row in episodes.rows if row.episode_id in own), None)
        if shown is None:
            raise DataError("The artifact shares no episode with this EpisodeSet", where=episodes.root)
        row = episodes.rows[episodes.position(shown)]
        title = f"{shown}  ·  {row.embodiment}  ·  {row.instruction}"
        if rollouts is None:
            self.write_controls(kind, episodes, shown, title)
        else:
            rows = compared_rows(rollouts, episodes, shown, rollouts.views(shown))
            self.picture(f"{safe_stem(shown)}_prediction", contact_sheet(rows, title=title))

    def write_controls(self, kind: str, episodes: EpisodeSet, episode_id: str, title: str) -> None:
        """Moments of one episode with its controls."""
        position = episodes.position(episode_id)
        row = episodes.rows[position]
        recorded = ActionTracks.open(self.folder) if kind == "ActionTracks" else None
        try:
            tracks = recorded.tracks(episode_id) if recorded else shown_tracks(episodes.episode(position))
        except WorldLineError as error:
            self.notes.append(f"no controls are shown: {error.what} ({error.where})")
            return
        style = OverlayStyle(SIGMA_PX_REFERENCE if recorded is None else recorded.sigma_px_ref)
        moments = evenly_spaced(min(tracks.num_frames, row.video_frames), 4)
        frames = {view: VideoFrames(episodes.clip(position, view))[moments] for view in row.views}
        sheet = overlay_sheet(frames, tracks, moments, style=style, title=f"{title}  ·  drawn: {tracks.controls_label}")
        self.picture(f"{safe_stem(episode_id)}_controls", sheet)

    def write_refused(self, curated: EpisodeSet, episode_id: str | None) -> bool:
        """Clips of up to four episodes of every reason, or of one episode; False where the filters refused nothing of it."""
        refused = [(row.reason, row.episode_id, row.detail) for row in read_quarantine(self.folder)]
        cut = [row for row in read_rows(self.folder / FINDINGS_FILE) if row["cut_frames"]]
        refused += [(row["detector"], row["episode_id"], f"{row['cut_frames']} frames cut") for row in cut]
        reasons: dict[str, dict[str, str]] = defaultdict(dict)
        for reason, name, detail in refused:
            if episode_id in (None, name):
                reasons[reason].setdefault(name, detail)
        for reason, clips in sorted(reasons.items()):
            rows = list[SheetRow]()
            for name, detail in list(clips.items())[:CLIPS_PER_REASON]:
                shown, unreadable = sheet_rows(curated, [curated.position(name)])
                self.notes += unreadable
                rows += [replace(row, title=f"{words(reason)}: {detail}") for row in shown]
            if rows:
                self.picture(f"reason_{safe_stem(reason)}", contact_sheet(rows, tile_height=96))
        return bool(reasons)


def compared_rows(rollout: RolloutSet, episodes: EpisodeSet, episode_id: str, views: Sequence[str]) -> list[SheetRow]:
    """Moments of an episode in some views, recorded above predicted, for a contact sheet.

    Raises: DataError when the set has no prediction of this episode.
    """
    if episode_id not in rollout.episode_ids:
        raise DataError("No prediction of this episode", where=rollout.root, got=episode_id)
    position, rows = episodes.position(episode_id), list[SheetRow]()
    stride = stride_of(rollout, episodes.rows[position])
    for view in views:
        predicted = VideoFrames(rollout.clip(episode_id, view))
        moments = evenly_spaced(len(predicted), MOMENTS)
        recorded = np.asarray(episodes.frames(position, view, [stride * moment for moment in moments]))
        rows.append(SheetRow(f"{words(view)}, recorded", recorded))
        rows.append(SheetRow(f"{words(view)}, predicted by {rollout.method}", predicted[moments]))
    return rows
