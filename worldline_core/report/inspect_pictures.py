"""Pictures of an artifact for `worldline inspect`: a sheet, an overlay video, and a Rerun recording of one episode."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from worldline_core.actions.actions_config import SIGMA_PX_REFERENCE
from worldline_core.actions.episode_tracks import ActionTracks, EpisodeTracks
from worldline_core.actions.overlay_views import write_overlay_video
from worldline_core.actions.overlays import OverlayStyle
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.guards.source_paths import safe_stem
from worldline_core.data.video.frames import VideoFrames
from worldline_core.errors import ArtifactError, DataError, WorldLineError
from worldline_core.exports.export import export_rollout, recording_content, shown_tracks
from worldline_core.pages.page import render, words
from worldline_core.pictures import Picture, SheetRow, contact_sheet, evenly_spaced, png_bytes
from worldline_core.progress import with_progress
from worldline_core.report.episode_sheet import MOMENTS, episode_overlay, episode_rows, one_of_each
from worldline_core.report.filters import episode_of
from worldline_core.report.inspect_filters import FilteredSet, write_episode, write_filter_page
from worldline_core.rollout.rollout_set import RolloutSet
from worldline_core.store.artifact_files import linked_folder, read_rows
from worldline_core.store.atomic import write_bytes_atomic

PICTURED = ("EpisodeSet", "ActionTracks", "RolloutSet")
SHEET_ROWS = 8


def write_pictures(
    kind: str,
    folder: Path,
    output: Path,
    episodes: Path | None,
    episode_id: str | None,
    *,
    video: bool,
    rerun: bool,
    page: int | None,
) -> tuple[list[Path], list[str]]:
    """Writes what `worldline inspect` was asked for; returns the files, and notes on what could not be shown.

    Raises:
        ArtifactError: the EpisodeSet that the artifact belongs to is not known.
        DataError: there is no such episode, or its controls cannot be projected.
    """
    subject = Subject(kind, folder, episodes)
    moving = video or rerun or page is not None
    if subject.episodes_folder is None and (kind == "ActionTracks" or moving):
        if not moving and episode_id is None:
            return [], ["no pictures: the episodes of these tracks are not known (--episodes FOLDER names them)"]
        raise ArtifactError(
            "The episodes that this artifact belongs to are not known",
            where=folder,
            expected="a manifest that names a folder which is still there",
            next_step="name the EpisodeSet with --episodes FOLDER",
        )
    written = subject.write_filters(output, episode_id, rerun=rerun)
    if written and episode_id is not None and episode_id not in {row.episode_id for row in subject.episodes.rows}:
        if video:
            raise DataError(
                "There is no such kept episode to make a video of",
                where=folder,
                got=episode_id,
                next_step="name one of its segments, or inspect the EpisodeSet that was filtered",
            )
        return written, subject.notes
    picture = subject.sheet(episode_id)
    if picture is not None:
        written.append(output / "contact_sheet.png")
        write_bytes_atomic(written[-1], png_bytes(picture))
    if video:
        written += subject.write_video(output, episode_id or subject.first_episode)
    if rerun:
        written.append(subject.write_recording(output, episode_id or subject.first_episode))
    if page is not None:
        written.append(subject.write_page(output / "page", page))
    return written, subject.notes


@dataclass(frozen=True)
class Subject:
    """An artifact with pictures, the artifacts that it belongs to, and notes on what could not be shown."""

    kind: str
    folder: Path
    given_episodes: Path | None
    notes: list[str] = field(default_factory=list)

    @cached_property
    def episodes_folder(self) -> Path | None:
        if self.kind == "EpisodeSet":
            return self.folder
        return self.given_episodes or linked_folder(self.folder, "episodes")

    @cached_property
    def episodes(self) -> EpisodeSet:
        if self.episodes_folder is None:
            raise ArtifactError("The episodes that this artifact belongs to are not known", where=self.folder)
        return EpisodeSet.open(self.episodes_folder)

    def write_filters(self, output: Path, episode_id: str | None, *, rerun: bool) -> list[Path]:
        """What the filters did, where the artifact is a filter step's: a page with a sheet for every reason, or one
        episode's strip and recording."""
        if self.kind != "EpisodeSet" or not (self.folder / "findings.parquet").is_file():
            return []
        curated = self.given_episodes or linked_folder(self.folder, "episodes")
        if curated is None:
            self.notes.append(
                "dropped clips are not shown: the EpisodeSet that was filtered is not known (--episodes FOLDER)"
            )
            return []
        filtered = FilteredSet(self.folder, curated)
        if episode_id is None:
            return write_filter_page(filtered, output / "filters")
        # A segment is shown with the episode that it was cut from.
        whole = episode_id if episode_id in filtered.outcomes else episode_of(episode_id)
        return write_episode(filtered, whole, output, rerun=rerun) if whole in filtered.outcomes else []

    @cached_property
    def tracks_folder(self) -> Path | None:
        return self.folder if self.kind == "ActionTracks" else linked_folder(self.folder, "tracks")

    @cached_property
    def rollouts(self) -> RolloutSet:
        return RolloutSet.open(self.folder)

    @cached_property
    def sigma_px_ref(self) -> float:
        """Of the heat, as the tracks' own previews were drawn with."""
        folder = self.tracks_folder
        return SIGMA_PX_REFERENCE if folder is None else ActionTracks.open(folder).sigma_px_ref

    @property
    def first_episode(self) -> str:
        """The first episode that the artifact and its EpisodeSet share."""
        known = [row.episode_id for row in self.episodes.rows]
        if self.kind == "RolloutSet":
            known = [name for name in known if name in set(self.rollouts.episode_ids)]
        elif self.kind == "ActionTracks":
            having = {str(row["episode_id"]) for row in read_rows(self.folder / "index.parquet")}
            known = [name for name in known if name in having]
        if not known:
            raise DataError("The artifact shares no episode with this EpisodeSet", where=self.episodes.root)
        return known[0]

    def tracks(self, episode_id: str) -> EpisodeTracks:
        """Tracks of an episode: those of the artifact, else its recorded tool poses, else computed from its commands.

        Raises:
            DataError, ConfigError, UnavailableError: they cannot be computed.
        """
        if self.tracks_folder is not None:
            return ActionTracks.open(self.tracks_folder).tracks(episode_id)
        return shown_tracks(self.episodes.episode(self.episodes.position(episode_id)))

    def sheet(self, episode_id: str | None) -> Picture | None:
        """Moments of one episode with its controls, or of several episodes (of one, for ActionTracks)."""
        if episode_id is None and self.kind == "EpisodeSet":
            rows, _ = episode_rows(self.episodes, one_of_each(self.episodes.rows, SHEET_ROWS))
            return contact_sheet(rows) if rows else None
        if self.kind == "RolloutSet":
            return rollout_sheet(self.rollouts, episode_id)
        chosen = episode_id or self.first_episode
        position = self.episodes.position(chosen)
        row = self.episodes.rows[position]
        try:
            tracks = self.tracks(chosen)
        except WorldLineError as error:
            if self.kind == "ActionTracks":
                raise
            self.notes.append(f"no controls are drawn: {error.what}")
            moments = evenly_spaced(row.video_frames, MOMENTS)
            rows = [SheetRow(view, np.asarray(self.episodes.frames(position, view, moments))) for view in row.views]
            return contact_sheet(rows, title=f"{row.embodiment}  ·  {row.instruction}")
        title = f"{row.episode_id}  ·  {row.embodiment}  ·  {row.instruction}"
        return episode_overlay(self.episodes, position, tracks, self.sigma_px_ref, title)

    def write_video(self, output: Path, episode_id: str) -> list[Path]:
        """All views side by side with the controls drawn over them, `<episode>.mp4`; truth beside a prediction."""
        if self.kind == "RolloutSet":
            return export_rollout(
                {self.rollouts.method: self.rollouts}, self.episodes, None, episode_id, output, ("mp4",)
            )
        path = output / f"{safe_stem(episode_id)}.mp4"
        self._write_overlay(path, self.episodes.position(episode_id), self.tracks(episode_id))
        return [path]

    def write_page(self, output: Path, count: int) -> Path:
        """`index.html` and an overlay video of each of `count` episodes (0: all), spread over robots and tasks.

        An episode that cannot be shown stays on the page, with the reason.
        """
        rows = self.episodes.rows
        chosen = sorted(one_of_each(rows, count)) if count else list(range(len(rows)))
        cards: list[dict[str, object]] = []
        for position in with_progress(chosen, "page", "episode"):
            row = rows[position]
            path = output / "videos" / f"{safe_stem(row.episode_id)}.mp4"
            problem = ""
            try:
                if not path.is_file():
                    self._write_overlay(path, position, self.tracks(row.episode_id))
            except WorldLineError as error:
                problem = f"{error.what} ({error.where})"
            facts = [row.embodiment, row.task_family, row.scene, words(row.split), row.source]
            facts = [row.episode_id, *facts, f"{row.num_frames} frames, {row.fps:g} Hz"]
            found = " ".join([row.instruction, row.outcome, *facts]).lower()
            video = None if problem else f"videos/{path.name}"
            cards.append({"row": row, "facts": facts, "words": found, "video": video, "problem": problem})
        title = f"{len(cards)} of {len(rows)} episodes"
        subtitle = "Recorded frames with the commanded tools, projected by the recorded calibration."
        page = render("report/browse.html", title=title, subtitle=subtitle, cards=cards)
        write_bytes_atomic(output / "index.html", page.encode())
        return output / "index.html"

    def _write_overlay(self, path: Path, position: int, tracks: EpisodeTracks) -> None:
        row = self.episodes.rows[position]
        frames = {view: VideoFrames(self.episodes.clip(position, view)) for view in row.views}
        title = f"{row.embodiment}  ·  {row.instruction}"
        write_overlay_video(path, frames, tracks, row.fps, style=OverlayStyle(self.sigma_px_ref), title=title)

    def write_recording(self, output: Path, episode_id: str) -> Path:
        """A Rerun recording: frames, controls, cameras, signals, and predictions where the artifact has them."""
        from worldline_core.exports.rerun_recording import write_rerun_recording  # imports Rerun

        tracks = None
        try:
            tracks = self.tracks(episode_id)
        except WorldLineError as error:
            self.notes.append(f"the recording has no controls in 3-D: {error.what}")
        rollouts = {self.rollouts.method: self.rollouts} if self.kind == "RolloutSet" else {}
        path = output / f"{safe_stem(episode_id)}.rrd"
        content = recording_content(rollouts, self.episodes, tracks, episode_id, sigma_px_ref=self.sigma_px_ref)
        write_rerun_recording(path, content)
        return path


def rollout_sheet(rollouts: RolloutSet, episode_id: str | None) -> Picture | None:
    """Six moments of one prediction in all its views, or of up to eight predictions, head view first.

    Raises:
        DataError: the set has no prediction of this episode.
    """
    rows: list[SheetRow] = []
    if episode_id is not None:
        if episode_id not in rollouts.episode_ids:
            raise DataError(
                "No prediction of this episode",
                where=rollouts.root,
                expected=f"one of {', '.join(sorted(rollouts.episode_ids)[:3])}, ...",
                got=episode_id,
            )
        for view in rollouts.views(episode_id):
            frames = VideoFrames(rollouts.clip(episode_id, view))
            rows.append(SheetRow(view, frames[evenly_spaced(len(frames), MOMENTS)]))
        return contact_sheet(rows, title=f"{rollouts.method}  ·  {episode_id}")
    views = {str(row["episode_id"]): str(row["view"]) for row in reversed(read_rows(rollouts.root / "index.parquet"))}
    names = sorted(rollouts.episode_ids)
    for episode_id in [names[i] for i in evenly_spaced(len(names), SHEET_ROWS)]:
        frames = VideoFrames(rollouts.clip(episode_id, views[episode_id]))
        moments = evenly_spaced(len(frames), MOMENTS)
        rows.append(SheetRow(f"{rollouts.method}  ·  {episode_id}", frames[moments], views[episode_id]))
    return contact_sheet(rows) if rows else None
