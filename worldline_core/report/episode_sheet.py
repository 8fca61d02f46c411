"""Rows of episodes for contact sheets: which ones, and how they are titled."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from worldline_core.data.episodes.episode_index import EpisodeRow
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import DataError
from worldline_core.pages.page import words
from worldline_core.pictures.contact_sheet import SheetRow, evenly_spaced

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


def _groups(rows: Sequence[EpisodeRow], positions: Iterable[int]) -> list[list[int]]:
    """Positions by embodiment and task, in the order of their names."""
    found: dict[tuple[str, str], list[int]] = {}
    for position in positions:
        found.setdefault((rows[position].embodiment, rows[position].task_family), []).append(position)
    return [group for _, group in sorted(found.items())]


def _thinned(positions: list[int], most: int) -> list[int]:
    """At most `most`, evenly spread over the list."""
    return [positions[i] for i in evenly_spaced(len(positions), most)]
