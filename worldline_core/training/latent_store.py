"""Cached tokenizer latents: `encode_latents` writes them, `LatentStore` reads clips from them.

A causal tokenizer treats the first frame of a clip specially, so a clip's latents depend on where it starts. Two
layouts keep every clip exact:

- ``groups`` (tokenizers whose later latent frames depend on their own four frames only): a single-frame latent for
  every start frame, and for every stride and phase the latents of the groups of four frames that follow;
- ``clips`` (tokenizers with a longer memory): for every stride and start frame the latents of the whole remaining clip.

They lie in safetensors shards, read by memory mapping, beside an index of the episodes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from safetensors import SafetensorError, safe_open
from torch import Tensor

from worldline_core.actions.actions_config import TEMPORAL_FACTOR
from worldline_core.errors import ArtifactError, DataError
from worldline_core.store.artifact_files import read_json, read_rows
from worldline_core.training.clip_source import Clip, ClipRow, ClipSource, latent_frame_count, longest_clip

Layout = Literal["groups", "clips"]
INDEX, DESCRIPTION = "index.parquet", "store.json"


@dataclass(frozen=True)
class LatentRow(ClipRow):
    """One episode of the store. A start frame is a multiple of the store's ``start_step``."""

    shard: str


def group_key(episode_id: str, stride: int, phase: int) -> str:
    """Tensor name of the group latents whose first video frame is ``phase`` modulo 4 x stride."""
    return f"{episode_id}/groups/{stride}/{phase}"


def clip_key(episode_id: str, stride: int, start: int) -> str:
    """Tensor name of the latents of the clip that starts at ``start`` and runs to the end of the episode."""
    return f"{episode_id}/clips/{stride}/{start}"


def single_key(episode_id: str) -> str:
    """Tensor name of the single-frame latents of all allowed start frames."""
    return f"{episode_id}/single"


class LatentStore(ClipSource):
    """Read access to a Latents artifact."""

    dtype: np.dtype[Any] = np.dtype(np.float32)

    def __init__(self, root: Path, description: dict[str, Any], rows: Sequence[LatentRow]) -> None:
        super().__init__(rows)
        self.root = root
        self.description = description
        self.layout: Layout = description["layout"]
        self.start_step = description["start_step"]
        self.strides: tuple[int, ...] = tuple(description["strides"])
        self.latent_shape = tuple(description["latent_shape"])
        self.image_size = tuple(description["image_size"])
        self._shard_of = {row.episode_id: row.shard for row in rows}
        self._shards: dict[str, Any] = {}

    @classmethod
    def open(cls, root: Path) -> LatentStore:
        """Open a finished Latents folder.

        Raises:
            ArtifactError: if the folder is not a Latents artifact.
        """
        missing = [name for name in (DESCRIPTION, INDEX) if not (root / name).is_file()]
        if missing:
            raise ArtifactError(
                "This folder is not a Latents artifact.",
                where=root,
                expected=f"{DESCRIPTION} and {INDEX}",
                got=f"no {' and no '.join(missing)}",
                next_step="run the encode_latents step first",
            )
        try:
            rows = [LatentRow(**{**row, "views": tuple(row["views"])}) for row in read_rows(root / INDEX)]
        except (TypeError, KeyError) as error:
            raise ArtifactError(
                "The index of the latents has other columns", where=root / INDEX, got=str(error)
            ) from error
        return cls(root, read_json(root / DESCRIPTION), rows)

    def __getstate__(self) -> dict[str, Any]:
        # Open shards stay in the process that opened them.
        return {**self.__dict__, "_shards": {}}

    def shape(self, num_frames: int) -> tuple[int, ...]:
        """(c, t, h, w) of a clip's latents."""
        channels, height, width = self.latent_shape
        return channels, latent_frame_count(num_frames), height, width

    def read(self, clip: Clip, views: tuple[str, ...], out: np.ndarray) -> None:
        """Fill ``out`` (v, c, t, h, w) with the clip's latents; raises as `clip` does."""
        torch.from_numpy(out).copy_(self.clip(clip.episode_id, clip.start, clip.num_frames, clip.stride, views))

    def latents(self, read: Tensor, device: str) -> Float[Tensor, "b v c t h w"]:
        """A copy of what was read, on ``device``: the buffers that clips are read into are used again."""
        return read.to(device, copy=True)

    def clip(
        self, episode_id: str, start_frame: int, num_frames: int, stride: int = 1, views: tuple[str, ...] | None = None
    ) -> Float[Tensor, "v c t h w"]:
        """Latents (float32) of the clip of ``num_frames`` frames at ``start_frame``, ``start_frame + stride``, ...

        Raises:
            ArtifactError: if the episode, stride or view is not stored, or a shard is damaged.
            DataError: if the clip does not fit, starts between stored start frames, or holds values that are not finite.
        """
        row = self.row(episode_id)
        frames = latent_frame_count(num_frames)
        if stride not in self.strides:
            raise ArtifactError(
                "The latent store was not encoded at this stride.", where=self.root, expected=self.strides, got=stride
            )
        longest = longest_clip(row.num_frames, start_frame, stride)
        if start_frame % self.start_step or start_frame < 0 or num_frames > longest:
            raise DataError(
                "A clip does not fit the stored latents of its episode.",
                where=episode_id,
                expected=f"a start frame divisible by {self.start_step}, within {row.num_frames} frames",
                got=f"start {start_frame}, {num_frames} frames, stride {stride}",
            )
        missing = [view for view in views or () if view not in row.views]
        if missing:
            raise ArtifactError(
                "The latent store does not hold this view.", where=episode_id, expected=row.views, got=missing
            )
        selected = [row.views.index(view) for view in views or row.views]
        clip = self._stored(episode_id, start_frame, frames, stride)[selected].to(torch.float32)
        if not bool(torch.isfinite(clip).all()):
            raise DataError(
                "Cached latents hold values that are not finite.",
                where=f"{self._shard_of[episode_id]}, episode {episode_id}",
                next_step="delete this Latents artifact and encode it again; check the tokenizer",
            )
        return clip

    def _stored(self, episode_id: str, start: int, frames: int, stride: int) -> Float[Tensor, "v c t h w"]:
        """``frames`` latent frames of all stored views, in half precision."""
        path = self.root / self._shard_of[episode_id]
        try:
            if path.name not in self._shards:
                self._shards[path.name] = safe_open(path, framework="pt")
            shard = self._shards[path.name]
            if self.layout == "clips":
                return shard.get_slice(clip_key(episode_id, stride, start))[:, :, :frames]
            index = start // self.start_step
            first = shard.get_slice(single_key(episode_id))[:, :, index : index + 1]
            if frames == 1:
                return first
            period = TEMPORAL_FACTOR * stride
            offset, phase = divmod(start + stride, period)
            groups = shard.get_slice(group_key(episode_id, stride, phase))
            return torch.cat([first, groups[:, :, offset : offset + frames - 1]], dim=2)
        except (OSError, SafetensorError) as error:
            raise ArtifactError(
                "A latent shard is damaged or cannot be opened.",
                where=path,
                got=error,
                next_step="encode the latents again",
            ) from error
