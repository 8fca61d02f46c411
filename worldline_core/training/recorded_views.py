"""Recordings held in memory, one video per view: what the small tokenizer and the small teacher are trained on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import UInt8
from torch import Tensor
from tqdm import tqdm

from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import DataError
from worldline_core.model.video_tokenizer import frames_to_video


@dataclass(frozen=True)
class RecordedView:
    """One view of one episode at the training size; ``name`` is episode/view."""

    name: str
    frames: UInt8[Tensor, "3 n h w"]


def load_views(
    episodes: EpisodeSet, positions: Sequence[int], image_size: tuple[int, int], minimum: int
) -> list[RecordedView]:
    """All views of the episodes at ``positions`` that have ``minimum`` frames or more.

    Raises:
        DataError: there is none.
    """
    views: list[RecordedView] = []
    for position in tqdm(positions, desc="reading episodes", disable=None):
        row = episodes.rows[position]
        for view in row.views:
            frames = episodes.frames(position, view)
            if len(frames) >= minimum:
                video = frames_to_video(frames, image_size)
                views.append(RecordedView(f"{row.episode_id}/{view}", ((video + 1.0) * 127.5).round().to(torch.uint8)))
    if not views:
        raise DataError("No episode is long enough to train on", where=episodes.root, expected=f">= {minimum} frames")
    return views
