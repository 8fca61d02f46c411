"""Cached tokenizer latents: the encode_latents step writes them, `LatentStore` reads clips from them.

A causal tokenizer treats the first frame of a clip specially, so a clip's latents depend on where it starts. Two
layouts keep every clip exact:

- ``groups`` (tokenizers whose later latent frames depend on their own four frames only): a single-frame latent for
  every start frame, and for every stride and phase the latents of the groups of four frames that follow;
- ``clips`` (tokenizers with a longer memory): for every stride and start frame the latents of the whole remaining clip.

They lie in safetensors shards, read by memory mapping, beside an index of the episodes.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from jaxtyping import Float
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from worldline_core.actions.actions_config import TEMPORAL_FACTOR
from worldline_core.data.episodes.episode_index import EpisodeRow
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import ArtifactError, ConfigError, DataError
from worldline_core.model.tokenizers import load_tokenizer, tokenizer_fingerprint
from worldline_core.model.video_tokenizer import frames_to_video
from worldline_core.progress import with_progress
from worldline_core.store.artifact_files import read_json, read_rows
from worldline_core.store.atomic import atomic_path, write_json_atomic
from worldline_core.training.clip_config import EncodeLatentsConfig
from worldline_core.training.clip_source import Clip, ClipRow, ClipSource, latent_frame_count, longest_clip

Layout = Literal["groups", "clips"]
_INDEX, _DESCRIPTION = "index.parquet", "store.json"


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
        missing = [name for name in (_DESCRIPTION, _INDEX) if not (root / name).is_file()]
        if missing:
            raise ArtifactError(
                "This folder is not a Latents artifact.",
                where=root,
                expected=f"{_DESCRIPTION} and {_INDEX}",
                got=f"no {' and no '.join(missing)}",
                next_step="run the encode_latents step first",
            )
        try:
            rows = [LatentRow(**{**row, "views": tuple(row["views"])}) for row in read_rows(root / _INDEX)]
        except (TypeError, KeyError) as error:
            raise ArtifactError(
                "The index of the latents has other columns", where=root / _INDEX, got=str(error)
            ) from error
        return cls(root, read_json(root / _DESCRIPTION), rows)

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


class Encoder(Protocol):
    """The part of a video tokenizer that is needed here."""

    def encode(self, video: Float[Tensor, "b 3 t h w"]) -> Float[Tensor, "b c t_l h_l w_l"]: ...


def encode_clip(tokenizer: Encoder, video: Float[Tensor, "3 n h w"], device: str) -> Float[Tensor, "c t h_l w_l"]:
    """Latents of one clip (RGB in [-1, 1]), rounded to half precision as they are stored."""
    with torch.no_grad():
        return tokenizer.encode(video[None].to(device))[0].to("cpu", torch.float16)


def encode_episode(
    tokenizer: Encoder,
    episode_id: str,
    videos: Float[Tensor, "v 3 n h w"],
    layout: Layout,
    config: EncodeLatentsConfig,
) -> dict[str, Float[Tensor, "v c t h_l w_l"]]:
    """All tensors of one episode, by their names in the shard."""
    count = videos.shape[2]
    tensors: dict[str, Tensor] = {}

    def stacked(indices: range) -> Tensor:
        return torch.stack([encode_clip(tokenizer, video[:, list(indices)], config.device) for video in videos])

    if layout == "groups":
        singles = [stacked(range(start, start + 1)) for start in range(0, count, config.start_step)]
        tensors[single_key(episode_id)] = torch.cat(singles, 2)
    for stride in config.strides:
        period = TEMPORAL_FACTOR * stride
        for start in range(0, count, config.start_step):
            steps = TEMPORAL_FACTOR * ((count - 1 - start) // stride // TEMPORAL_FACTOR)
            indices = range(start, start + stride * steps + 1, stride)
            if layout == "clips":
                tensors[clip_key(episode_id, stride, start)] = stacked(indices)
                continue
            # The first clip of each phase yields every group of that phase.
            key = group_key(episode_id, stride, (start + stride) % period)
            if key in tensors or steps == 0:
                continue
            groups = stacked(indices)[:, :, 1:]
            missing = (start + stride) // period
            if missing:
                groups = torch.cat([torch.zeros_like(groups[:, :, :1]).expand(-1, -1, missing, -1, -1), groups], 2)
            tensors[key] = groups.contiguous()
    return tensors


def choose_layout(tokenizer: Encoder, video: Float[Tensor, "3 n h w"], config: EncodeLatentsConfig) -> Layout:
    """``groups`` where a latent frame depends on its own four frames alone, else ``clips``.

    Raises:
        ConfigError: if ``groups`` is asked for but would not be exact with this tokenizer.
    """
    if config.layout == "clips":
        return "clips"
    span = 2 * TEMPORAL_FACTOR + 1
    if video.shape[1] < span:
        raise DataError("An episode is too short to encode.", expected=f"{span} frames or more", got=video.shape[1])
    whole = encode_clip(tokenizer, video[:, :span], config.device)[:, 2]
    later = encode_clip(tokenizer, video[:, TEMPORAL_FACTOR:span], config.device)[:, 1]
    # One unit of half precision: different batch shapes may round the last bit differently.
    memoryless = bool(torch.allclose(whole.float(), later.float(), rtol=2e-3, atol=2e-3))
    if config.layout == "groups" and not memoryless:
        raise ConfigError(
            "The tokenizer's latents depend on earlier frames, so cached groups would not be exact.",
            where="encode_latents.layout",
            expected="auto or clips",
            got="groups",
        )
    return "groups" if memoryless else "clips"


def encode_latents(config: EncodeLatentsConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """Encode ``inputs['episodes']`` with ``inputs['tokenizer']``; finished shards are kept when the step is restarted.

    Raises:
        DataError: if no episode is selected, or frames and index disagree.
    """
    episodes = EpisodeSet.open(inputs["episodes"])
    tokenizer = load_tokenizer(inputs["tokenizer"], config.device)
    selected = _select(episodes, config)

    def videos(index: int) -> Float[Tensor, "v 3 n h w"]:
        views = _views(episodes.rows[index], config)
        return torch.stack([frames_to_video(episodes.frames(index, view), config.image_size) for view in views])

    layout = choose_layout(tokenizer, videos(selected[0])[0], config)
    output.mkdir(parents=True, exist_ok=True)
    rows: list[LatentRow] = []
    shards = [selected[i : i + config.episodes_per_shard] for i in range(0, len(selected), config.episodes_per_shard)]
    for number, members in enumerate(with_progress(shards, "encode latents", "shard")):
        name = f"{number:05d}.safetensors"
        marker = output / "run" / f"{number:05d}.json"
        if not ((output / name).is_file() and marker.is_file()):
            tensors: dict[str, Tensor] = {}
            for index in members:
                tensors |= encode_episode(tokenizer, episodes.rows[index].episode_id, videos(index), layout, config)
            with atomic_path(output / name) as temporary:
                save_file(dict(sorted(tensors.items())), temporary)
            shape = next(iter(tensors.values())).shape
            write_json_atomic(marker, {"latent_shape": [shape[1], *shape[3:]]})
        encoded = [episodes.rows[index] for index in members]
        rows += [LatentRow.of(row, _views(row, config), shard=name) for row in encoded]
    columns = [{"episode_id": row.episode_id, "shard": row.shard, **vars(row)} for row in rows]
    with atomic_path(output / _INDEX) as temporary:
        pq.write_table(pa.Table.from_pylist(columns), temporary, compression="zstd")
    description = {
        "layout": layout,
        "start_step": config.start_step,
        "strides": list(config.strides),
        "views": list(config.views),
        "image_size": list(config.image_size),
        "temporal_compression": TEMPORAL_FACTOR,
        "tokenizer": tokenizer_fingerprint(tokenizer, Path(inputs["tokenizer"])),
        **json.loads((output / "run" / "00000.json").read_text()),
    }
    write_json_atomic(output / _DESCRIPTION, description)
    frames = sum(row.num_frames for row in rows)
    unfit = [row.split for row in episodes.rows if not _views(row, config)]
    left_out = {"missing_view": len(unfit), "other_split": len(episodes) - len(rows) - len(unfit)}
    return {
        "found": len(episodes),
        "kept": len(rows),
        "left_out": {reason: count for reason, count in left_out.items() if count},
        "frames": frames,
        "shards": len(shards),
        "layout": layout,
    }


def _views(row: EpisodeRow, config: EncodeLatentsConfig) -> tuple[str, ...]:
    """Which views of an episode are encoded: all that are wanted and there, the task-facing one alone, or none."""
    if all(view in row.views for view in config.views if view not in config.optional_views):
        return tuple(view for view in config.views if view in row.views)
    return (row.primary_view,) if config.primary_alone and row.stage1_ok and row.primary_view in row.views else ()


def _select(episodes: EpisodeSet, config: EncodeLatentsConfig) -> list[int]:
    selected = [
        i
        for i, row in enumerate(episodes.rows)
        if (config.splits is None or row.split in config.splits) and _views(row, config)
    ]
    if not selected:
        raise DataError(
            "No episode is left to encode.",
            where="encode_latents",
            expected=f"episodes with the views {config.views} in the splits {config.splits or 'all'}",
            got=f"{len(episodes)} episodes, none of them fitting",
        )
    return selected
