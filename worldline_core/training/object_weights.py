"""Weights of the loss that are larger where things are: what the task moves counts more than the table."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from worldline_core.actions.actions_config import TEMPORAL_FACTOR
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import DataError
from worldline_core.training.clip_sampler import Clip


class ObjectWeights:
    """Weights of clips of recorded worlds, larger where things are or were at the start.

    Args:
        episodes: with exact masks of things.
        grid_size: (h, w) of the latents.
        moved, others: extra weight of a cell that is full of what the task moves, or of other things.
    """

    def __init__(self, episodes: EpisodeSet, grid_size: tuple[int, int], moved: float, others: float) -> None:
        self._episodes = episodes
        self._grid_size = grid_size
        self._moved, self._others = moved, others
        self._shares: dict[tuple[str, str], np.ndarray] = {}

    def __call__(self, clips: Sequence[Clip], views: Sequence[Sequence[str]]) -> Float[Tensor, "b v 1 t h w"]:
        """Weights whose mean over the noisy frames of a clip is 1.

        Args:
            views: of each clip, as they were recorded.

        Raises:
            DataError: a recording has no masks of things.
        """
        stacked = [
            np.stack([self._latent_shares(clip, view) for view in names])
            for clip, names in zip(clips, views, strict=True)
        ]
        return object_weights(torch.from_numpy(np.stack(stacked)).float() / 255, self._moved, self._others)

    def _latent_shares(self, clip: Clip, view: str) -> np.ndarray:
        """uint8 (2, t, h, w): a latent frame covers four frames, and takes the largest share of them."""
        shown = self._frame_shares(clip.episode_id, view)[:, list(clip.frames)]
        groups = shown[:, 1:].reshape(2, -1, TEMPORAL_FACTOR, *self._grid_size).max(axis=2)
        return np.concatenate((shown[:, :1], groups), axis=1)

    def _frame_shares(self, episode_id: str, view: str) -> np.ndarray:
        """uint8 (2, n, h, w): share of each cell that shows what the task moves, and other things; 255 is all of it."""
        if (episode_id, view) not in self._shares:
            labels = self._episodes.thing_labels(self._episodes.position(episode_id), view)
            if labels is None:
                raise DataError(
                    "A recording has no exact masks of things", where=f"{episode_id}, view {view}",
                    expected="recordings of `worldline record`", next_step="set weighting.things to [0, 0]",
                )  # fmt: skip
            masks = (255 * np.stack((frame == 1, frame > 1), axis=-1).astype(np.uint8) for frame in labels)
            resized = [cv2.resize(mask, self._grid_size[::-1], interpolation=cv2.INTER_AREA) for mask in masks]
            self._shares[episode_id, view] = np.moveaxis(np.stack(resized), -1, 0)
        return self._shares[episode_id, view]


def object_weights(shares: Float[Tensor, "b v 2 t h w"], moved: float, others: float) -> Float[Tensor, "b v 1 t h w"]:
    """``1 + moved sqrt(s1) + others sqrt(s2)``, s the larger share of now and of the first frame, at mean 1 over noisy frames."""
    seen = torch.maximum(shares, shares[:, :, :, :1])
    weight = 1 + moved * seen[:, :, :1].sqrt() + others * seen[:, :, 1:].sqrt()
    return weight / weight[:, :, :, 1:].mean(dim=(1, 2, 3, 4, 5), keepdim=True)
