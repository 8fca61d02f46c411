"""Cached tokenizer latents: safetensors shards, read by memory mapping.

A causal tokenizer treats the first frame of a clip specially, so a clip's latents depend on where it starts. Two
layouts keep every clip exact:

- ``groups`` (tokenizers whose later latent frames depend on their own four frames only): a single-frame latent for
  every start frame, and for every stride and phase the latents of the groups of four frames that follow;
- ``clips`` (tokenizers with a longer memory): for every stride and start frame the latents of the whole remaining clip.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow.parquet as pq
import torch
from jaxtyping import Float
from safetensors import SafetensorError, safe_open
from torch import Tensor

from worldline_core.errors import ArtifactError, DataError
from worldline_core.training.clip_source import TEMPORAL_COMPRESSION, Clip, ClipRow, longest_clip

__all__ = [
    "TEMPORAL_COMPRESSION",
    "LatentRow",
    "LatentStore",
    "Layout",
    "clip_key",
    "group_key",
    "latent_frame_count",
    "single_key",
]

Layout = Literal["groups", "clips"]


@dataclass(frozen=True)
class LatentRow:
    """One episode of the store. ``num_frames`` counts video frames; a start frame is a multiple of ``start_step``."""

    episode_id: str
    shard: str
    num_frames: int
    views: tuple[str, ...]
    source: str
    embodiment: str
    split: str
    instruction: str
    primary_view: str


def latent_frame_count(num_frames: int) -> int:
    """T_l = 1 + (T - 1) / 4 (method.md section 2).

    Raises:
        DataError: if ``num_frames`` is not one more than a multiple of four.
    """
    if num_frames < 1 or (num_frames - 1) % TEMPORAL_COMPRESSION:
        raise DataError(
            "A clip has a length that the causal tokenizer cannot encode.",
            expected="4 k + 1 frames",
            got=num_frames,
        )
    return 1 + (num_frames - 1) // TEMPORAL_COMPRESSION


def group_key(episode_id: str, stride: int, phase: int) -> str:
    """Tensor name of the group latents whose first video frame is ``phase`` modulo 4 x stride."""
    return f"{episode_id}/groups/{stride}/{phase}"


def clip_key(episode_id: str, stride: int, start: int) -> str:
    """Tensor name of the latents of the clip that starts at ``start`` and runs to the end of the episode."""
    return f"{episode_id}/clips/{stride}/{start}"


def single_key(episode_id: str) -> str:
    """Tensor name of the single-frame latents of all allowed start frames."""
    return f"{episode_id}/single"


class LatentStore:
    """Read access to a Latents artifact; a clip source (see clip_source.py)."""

    dtype: np.dtype[Any] = np.dtype(np.float32)

    def __init__(self, root: Path, description: dict[str, Any], rows: list[LatentRow]) -> None:
        self.root = root
        self.description = description
        self.layout: Layout = description["layout"]
        self.start_step: int = description["start_step"]
        self.strides: tuple[int, ...] = tuple(description["strides"])
        self.latent_shape: tuple[int, int, int] = tuple(description["latent_shape"])
        self.image_size: tuple[int, int] = tuple(description["image_size"])
        self.rows = rows
        self._by_id = {row.episode_id: row for row in rows}
        self._shards: dict[str, Any] = {}

    @classmethod
    def open(cls, root: Path) -> LatentStore:
        """Open a finished Latents folder.

        Raises:
            ArtifactError: if the folder is not a Latents artifact.
        """
        root = Path(root)
        for name in ("store.json", "index.parquet"):
            if not (root / name).is_file():
                raise ArtifactError(
                    "This folder is not a Latents artifact.",
                    where=root / name,
                    expected="store.json and index.parquet",
                    got="no such file",
                    next_step="run the encode_latents step first",
                )
        description = json.loads((root / "store.json").read_text())
        rows = [
            LatentRow(**{**row, "views": tuple(row["views"])})
            for row in pq.read_table(root / "index.parquet").to_pylist()
        ]
        return cls(root, description, rows)

    def __len__(self) -> int:
        return len(self.rows)

    def row(self, episode_id: str) -> LatentRow:
        """The index row of an episode.

        Raises:
            ArtifactError: if the store does not hold it.
        """
        if episode_id not in self._by_id:
            raise ArtifactError(
                "The latent store does not hold this episode.",
                where=self.root,
                got=episode_id,
                next_step="encode the latents of the same EpisodeSet that is trained on",
            )
        return self._by_id[episode_id]

    def max_frames(self, row: ClipRow, start: int, stride: int) -> int:
        """Longest clip length (4 k + 1 frames) that starts at ``start`` with ``stride``."""
        return longest_clip(row.num_frames, start, stride)

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
        """A copy of what was read, on ``device``: buffers that were read into are used again."""
        return read.to(device, copy=True)

    def clip(
        self,
        episode_id: str,
        start_frame: int,
        num_frames: int,
        stride: int = 1,
        views: tuple[str, ...] | None = None,
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
                "The latent store was not encoded at this stride.",
                where=self.root,
                expected=self.strides,
                got=stride,
            )
        if start_frame % self.start_step or start_frame < 0 or num_frames > self.max_frames(row, start_frame, stride):
            raise DataError(
                "A clip does not fit the stored latents of its episode.",
                where=episode_id,
                expected=f"a start frame divisible by {self.start_step}, within {row.num_frames} frames",
                got=f"start {start_frame}, {num_frames} frames, stride {stride}",
            )
        selected = self._view_indices(row, views)
        clip = self._read(row, start_frame, frames, stride)[selected].to(torch.float32)
        if not bool(torch.isfinite(clip).all()):
            raise DataError(
                "Cached latents hold values that are not finite.",
                where=f"{row.shard}, episode {episode_id}",
                next_step="delete this Latents artifact and encode it again; check the tokenizer",
            )
        return clip

    def _view_indices(self, row: LatentRow, views: tuple[str, ...] | None) -> list[int]:
        missing = [view for view in views or () if view not in row.views]
        if missing:
            raise ArtifactError(
                "The latent store does not hold this view.",
                where=row.episode_id,
                expected=row.views,
                got=missing,
            )
        return [row.views.index(view) for view in views or row.views]

    def _read(self, row: LatentRow, start: int, frames: int, stride: int) -> Float[Tensor, "v c t h w"]:
        shard = self._shard(row.shard)
        try:
            if self.layout == "clips":
                return shard.get_slice(clip_key(row.episode_id, stride, start))[:, :, :frames]
            index = start // self.start_step
            first = shard.get_slice(single_key(row.episode_id))[:, :, index : index + 1]
            if frames == 1:
                return first
            period = TEMPORAL_COMPRESSION * stride
            group_start = start + stride
            offset = group_start // period
            groups = shard.get_slice(group_key(row.episode_id, stride, group_start % period))
            return torch.cat([first, groups[:, :, offset : offset + frames - 1]], dim=2)
        except SafetensorError as error:
            raise ArtifactError(
                "A latent shard is damaged.",
                where=self.root / row.shard,
                got=error,
                next_step="encode the latents again",
            ) from error

    def _shard(self, name: str) -> Any:
        if name not in self._shards:
            path = self.root / name
            try:
                self._shards[name] = safe_open(path, framework="pt")
            except (OSError, SafetensorError) as error:
                raise ArtifactError("A latent shard cannot be opened.", where=path, got=error) from error
        return self._shards[name]
