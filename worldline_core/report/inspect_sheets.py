"""Contact sheets for `worldline inspect`: several episodes, several predictions, or one episode with its controls."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from worldline_core.errors import DataError
from worldline_core.pictures.contact_sheet import SheetRow, contact_sheet, evenly_spaced
from worldline_core.pictures.labels import Picture
from worldline_core.store.artifact_files import read_rows

if TYPE_CHECKING:
    from worldline_core.actions.episode_tracks import EpisodeTracks
    from worldline_core.data.episodes.episode_set import EpisodeSet
    from worldline_core.rollout.rollout_set import RolloutSet

SHEET_ROWS = 8
MOMENTS = 6


def episode_sheet(episodes: EpisodeSet) -> Picture | None:
    """Six moments of up to eight episodes, spread over embodiments and tasks."""
    from worldline_core.report.sections.data import one_of_each

    rows: list[SheetRow] = []
    for index in one_of_each(read_rows(episodes.root / "index.parquet"), SHEET_ROWS):
        row = episodes.rows[index]
        try:
            frames = np.asarray(episodes.frames(index, row.primary_view, evenly_spaced(row.video_frames, MOMENTS)))
        except DataError:
            continue
        rows.append(SheetRow(f"{row.embodiment}  ·  {row.instruction}  ·  {row.outcome}", frames, row.episode_id))
    return contact_sheet(rows) if rows else None


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
            frames = np.asarray(rollouts.frames(episode_id, view, rollouts.seeds(episode_id)[0]))
            rows.append(SheetRow(view, frames[evenly_spaced(len(frames), MOMENTS)]))
        return contact_sheet(rows, title=f"{rollouts.method}  ·  {episode_id}")
    views = {str(row["episode_id"]): str(row["view"]) for row in reversed(read_rows(rollouts.root / "index.parquet"))}
    for episode_id in evenly_chosen(sorted(rollouts.episode_ids)):
        frames = np.asarray(rollouts.frames(episode_id, views[episode_id], rollouts.seeds(episode_id)[0]))
        moments = evenly_spaced(len(frames), MOMENTS)
        rows.append(SheetRow(f"{rollouts.method}  ·  {episode_id}", frames[moments], views[episode_id]))
    return contact_sheet(rows) if rows else None


def tracks_sheet(episodes: EpisodeSet, position: int, tracks: EpisodeTracks, sigma_px_ref: float) -> Picture:
    """Four moments of an episode in every view, with what its tracks say drawn over them."""
    from worldline_core.actions.overlay_views import overlay_sheet
    from worldline_core.actions.overlays import OverlayStyle

    row = episodes.rows[position]
    moments = evenly_spaced(min(tracks.num_frames, row.video_frames), 4)
    frames = {view: np.asarray(episodes.frames(position, view, moments)) for view in tracks.views if view in row.views}
    title = f"{row.episode_id}  ·  {row.embodiment}  ·  {row.instruction}"
    return overlay_sheet(frames, tracks, moments, style=OverlayStyle(sigma_px_ref), title=title)


def evenly_chosen(names: list[str]) -> list[str]:
    """Up to eight names, spread over the list."""
    if len(names) <= SHEET_ROWS:
        return names
    return [names[round(i)] for i in np.linspace(0, len(names) - 1, SHEET_ROWS)]
