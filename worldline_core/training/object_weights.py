"""Weights of the loss that are larger where things are: what the task moves counts more than the table."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import accumulate

import cv2
import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float, UInt8
from torch import Tensor

from worldline_core.actions.actions_config import TEMPORAL_FACTOR
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.video.frames import MadeFrames
from worldline_core.errors import DataError
from worldline_core.progress import with_progress
from worldline_core.training.clip_sampler import Clip, ClipRow
from worldline_core.training.resident import frame_numbers, on_device

_FULL = np.zeros((256, 2), np.uint8)
"""Share of (what the task moves, other things) in a pixel of each label: 1 is what the task moves, 2 and more are other things."""
_FULL[1, 0] = _FULL[2:, 1] = 255


class ObjectWeights:
    """Weights of clips of recorded worlds, larger where things are or were at the start.

    Args:
        episodes: with exact masks of things.
        grid_size: (h, w) of the latents.
        moved, others: extra weight of a cell that is full of what the task moves, or of other things.
        resident: episodes whose shares of things are all read now and stay on the device; None: each is read when it is needed.

    Raises:
        DataError: a resident recording has no masks of things.
    """

    def __init__(
        self,
        episodes: EpisodeSet,
        grid_size: tuple[int, int],
        moved: float,
        others: float,
        *,
        device: str = "cpu",
        resident: Sequence[ClipRow] | None = None,
    ) -> None:
        self._episodes = episodes
        self._grid_size = grid_size
        self._moved, self._others = moved, others
        self._device = device
        self._shares: dict[tuple[str, str], np.ndarray] = {}
        self._kept: Tensor | None = None
        self._first: dict[tuple[str, str], int] = {}
        if resident is not None:
            self._keep(resident)

    def __call__(self, clips: Sequence[Clip], views: Sequence[Sequence[str]]) -> Float[Tensor, "b v 1 t h w"]:
        """Weights whose mean over the noisy frames of a clip is 1.

        Args:
            clips: of one length.
            views: of each clip, as they were recorded.

        Raises:
            DataError: a recording has no masks of things.
        """
        shown = [[(clip.episode_id, view) for view in names] for clip, names in zip(clips, views, strict=True)]
        frames = frame_numbers(clips, range(clips[0].num_frames))
        if self._kept is None:
            read = [[self._read(name)[own] for name in names] for names, own in zip(shown, frames, strict=True)]
            shares = on_device(np.array(read), self._device)
        else:
            first = np.array([[self._first[name] for name in names] for names in shown])
            shares = self._kept[on_device(first[..., None] + frames[:, None], self._device)]
        return object_weights(latent_shares(shares), self._moved, self._others)

    def _keep(self, rows: Sequence[ClipRow]) -> None:
        """Read the shares of all views of some episodes onto the device."""
        counts = {(row.episode_id, view): row.num_frames for row in rows for view in row.views}
        self._first = dict(zip(counts, accumulate(counts.values(), initial=0), strict=False))
        self._kept = torch.empty(sum(counts.values()), 2, *self._grid_size, dtype=torch.uint8, device=self._device)
        with ThreadPoolExecutor() as pool:  # zlib and cv2 work beside each other
            read = pool.map(self._resized, map(self._labels, counts))
            for (name, count), shares in zip(with_progress(counts.items(), "reading masks", "view"), read, strict=True):
                if len(shares) != count:
                    raise DataError(
                        "Masks of things are not of every frame", where=", view ".join(name), expected=count, got=len(shares)
                    )  # fmt: skip
                self._kept[self._first[name] : self._first[name] + count] = torch.from_numpy(shares)

    def _read(self, name: tuple[str, str]) -> UInt8[np.ndarray, "n 2 h w"]:
        if name not in self._shares:
            self._shares[name] = self._resized(self._labels(name))
        return self._shares[name]

    def _labels(self, name: tuple[str, str]) -> MadeFrames:
        labels = self._episodes.thing_labels(self._episodes.position(name[0]), name[1])
        if labels is None:
            raise DataError(
                "A recording has no exact masks of things", where=", view ".join(name),
                expected="recordings of `worldline record`", next_step="set weighting.things to [0, 0]",
            )  # fmt: skip
        return labels

    def _resized(self, labels: MadeFrames) -> UInt8[np.ndarray, "n 2 h w"]:
        """Share of each cell that shows what the task moves, and other things; 255 is all of it."""
        resized = [
            cv2.resize(_FULL.take(frame, axis=0), self._grid_size[::-1], interpolation=cv2.INTER_AREA)
            for frame in labels
        ]
        return np.moveaxis(np.stack(resized), -1, 1)


def latent_shares(frames: UInt8[Tensor, "b v n 2 h w"]) -> Float[Tensor, "b v 2 t h w"]:
    """Shares 0..1 of latent frames: the first covers one frame, each other four, of which it takes the largest share."""
    first, others = frames[:, :, :1], rearrange(frames[:, :, 1:], "b v (t k) s h w -> b v t k s h w", k=TEMPORAL_FACTOR)
    return rearrange(torch.cat((first, others.amax(3)), 2), "b v t s h w -> b v s t h w").float() / 255


def object_weights(shares: Float[Tensor, "b v 2 t h w"], moved: float, others: float) -> Float[Tensor, "b v 1 t h w"]:
    """``1 + moved sqrt(s1) + others sqrt(s2)``, s the larger share of now and of the first frame, at mean 1 over noisy frames."""
    seen = torch.maximum(shares, shares[:, :, :, :1])
    weight = 1 + moved * seen[:, :, :1].sqrt() + others * seen[:, :, 1:].sqrt()
    return weight / weight[:, :, :, 1:].mean(dim=(1, 2, 3, 4, 5), keepdim=True)
