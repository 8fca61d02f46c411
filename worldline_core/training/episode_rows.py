"""Which episodes a stage may train on: those in the latent store that the filters let through for this stage."""

from __future__ import annotations

import logging
from typing import Literal

from worldline_core.actions.tracks import ActionTracks
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import DataError
from worldline_core.training.clip_source import ClipRow, ClipSource

logger = logging.getLogger(__name__)


def training_rows[RowT: ClipRow](
    store: ClipSource[RowT], episodes: EpisodeSet, *, stage: Literal[1, 2], tracks: ActionTracks | None = None
) -> list[RowT]:
    """Rows of the store whose episode is in the set, fit for the stage, and (Stage II) has action tracks.

    Raises:
        DataError: if none is left.
    """
    allowed = {row.episode_id for row in episodes.rows if (row.stage1_ok if stage == 1 else row.stage2_ok)}
    # Episodes encoded by their task-facing view alone are for Stage I, however fit their other views are.
    every_view = set(store.description.get("views", ())) if stage == 2 else set()
    rows = [row for row in store.rows if row.episode_id in allowed and every_view <= set(row.views)]
    fitting = [row for row in rows if tracks is None or row.episode_id in tracks]
    if len(fitting) < len(rows):
        logger.warning("%d of %d episodes have no action tracks and are left out.", len(rows) - len(fitting), len(rows))
    if not fitting:
        raise DataError(
            "No episode is left to train on.",
            where=f"stage {stage}",
            expected="episodes that are in the EpisodeSet, the clips' store and (Stage II) the action tracks",
            got=f"{len(allowed)} fit episodes in the set, {len(store)} in the store",
            next_step="see the quarantine tables of curate, filter and render_actions",
        )
    return fitting
