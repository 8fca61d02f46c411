"""Pictures of episodes: which ones a sheet shows, how its rows are titled, and one episode with its controls."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from worldline_core.actions.episode_tracks import EpisodeTracks
from worldline_core.actions.overlay_views import overlay_sheet
from worldline_core.actions.overlays import OverlayStyle
from worldline_core.data.episodes.episode_index import EpisodeRow
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import DataError
from worldline_core.pages.page import words
from worldline_core.pictures import Picture, SheetRow, evenly_spaced

MOMENTS = 6


def one_of_each(rows: Sequence[EpisodeRow], most: int) -> list[int]:
    """Positions that show every pair of embodiment and task once, at most `most`: failures and successes in turn."""
    groups = _groups(rows, range(len(rows)))
    chosen: list[int] = []
    for turn, group in enumerate(groups):
        wanted = "failure" if turn % 2 else "success"
        chosen.append(min(group, key=lambda i: (rows[i].outcome != wanted, rows[i].episode_id)))
    return _thinned(chosen, most)


def some_of_each(rows: Sequence[EpisodeRow], positions: Iterable[int], most: int) -> list[int]:
    """Up to `most` of some positions, taken in turn from every pair of embodiment and task as far as they go."""
    groups = _groups(rows, positions)
    if len(groups) > most:
        return sorted(_thinned([group[0] for group in groups], most))
    longest = max((len(group) for group in groups), default=0)
    in_turn = [group[depth] for depth in range(longest) for group in groups if depth < len(group)]
    return sorted(in_turn[:most])


def episode_rows(episodes: EpisodeSet, positions: Iterable[int]) -> tuple[list[SheetRow], list[str]]:
    """Six moments of each episode's primary view, titled; and what could not be read."""
    shown: list[SheetRow] = []
    unreadable: list[str] = []
    for position in positions:
        row = episodes.rows[position]
        try:
            moments = evenly_spaced(row.video_frames, MOMENTS)
            frames = np.asarray(episodes.frames(position, row.primary_view, moments))
        except DataError as error:
            unreadable.append(f"{row.episode_id}: {error.what}")
            continue
        title = f"{row.embodiment}  ·  {row.instruction or '(no instruction)'}"
        note = f"{row.episode_id}  ·  {row.scene}  ·  {words(row.split)}  ·  {row.outcome}"
        shown.append(SheetRow(title, frames, note))
    return shown, unreadable


def episode_overlay(
    episodes: EpisodeSet, index: int, tracks: EpisodeTracks, sigma_px_ref: float, title: str | None = None
) -> Picture:
    """Four moments of an episode in every view, with what the tracks say drawn over them.

    Raises:
        DataError: the episode has no view with a track, or its frames cannot be decoded.
    """
    row = episodes.rows[index]
    moments = evenly_spaced(min(tracks.num_frames, row.video_frames), 4)
    frames = {view: np.asarray(episodes.frames(index, view, moments)) for view in tracks.views if view in row.views}
    return overlay_sheet(frames, tracks, moments, style=OverlayStyle(sigma_px_ref), title=title)


def _groups(rows: Sequence[EpisodeRow], positions: Iterable[int]) -> list[list[int]]:
    """Positions by embodiment and task, in the order of their names."""
    found: dict[tuple[str, str], list[int]] = {}
    for position in positions:
        found.setdefault((rows[position].embodiment, rows[position].task_family), []).append(position)
    return [group for _, group in sorted(found.items())]


def _thinned(positions: list[int], most: int) -> list[int]:
    """At most `most`, evenly spread over the list."""
    return [positions[i] for i in evenly_spaced(len(positions), most)]
