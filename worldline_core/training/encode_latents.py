"""The encode_latents step: tokenizer latents of every episode, ready for exact clip reads."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, Protocol

import torch
from jaxtyping import Float
from pydantic import Field
from safetensors.torch import save_file
from torch import Tensor
from tqdm import tqdm

from worldline_core.actions.action_maps import TEMPORAL_FACTOR
from worldline_core.config import StrictModel
from worldline_core.data.episodes.episode_index import EpisodeRow
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import ConfigError, DataError
from worldline_core.model.tokenizers import load_tokenizer, tokenizer_fingerprint
from worldline_core.model.video_tokenizer import frames_to_video
from worldline_core.store.atomic import atomic_path, write_json_atomic
from worldline_core.training.latent_store import (
    LatentRow,
    Layout,
    clip_key,
    group_key,
    single_key,
    write_store_index,
)


class EncodeLatentsConfig(StrictModel):
    """Which latents are cached.

    ``start_step``: clips may start at multiples of it. ``strides``: temporal strides that training may ask for.
    ``primary_alone``: also encode, by their task-facing view alone, episodes that lack some of ``views``: Stage I takes
    them (plain videos have one view), Stage II does not.
    ``layout``: "auto" compares both layouts on the first episode and takes ``groups`` only where it is exact.
    """

    splits: tuple[str, ...] | None = None
    views: tuple[str, ...] = ("head", "left_wrist", "right_wrist")
    primary_alone: bool = False
    image_size: tuple[int, int] = (64, 96)
    start_step: int = Field(default=4, ge=1)
    strides: tuple[int, ...] = Field(default=(1,), min_length=1)
    layout: Literal["auto", "groups", "clips"] = "auto"
    episodes_per_shard: int = Field(default=16, ge=1)
    device: str = "cpu"


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

    def video(index: int, view: str) -> Tensor:
        return frames_to_video(episodes.frames(index, view), config.image_size)

    layout = choose_layout(tokenizer, video(selected[0], _views(episodes.rows[selected[0]], config)[0]), config)
    output.mkdir(parents=True, exist_ok=True)
    rows: list[LatentRow] = []
    shards = [selected[i : i + config.episodes_per_shard] for i in range(0, len(selected), config.episodes_per_shard)]
    progress = tqdm(total=len(selected), desc="encode latents", unit="episode", disable=None)
    for number, members in enumerate(shards):
        name = f"{number:05d}.safetensors"
        marker = output / "run" / f"{number:05d}.json"
        if not ((output / name).is_file() and marker.is_file()):
            tensors: dict[str, Tensor] = {}
            for index in members:
                videos = torch.stack([video(index, view) for view in _views(episodes.rows[index], config)])
                tensors |= encode_episode(tokenizer, episodes.rows[index].episode_id, videos, layout, config)
            with atomic_path(output / name) as temporary:
                save_file(dict(sorted(tensors.items())), temporary)
            shape = next(iter(tensors.values())).shape
            write_json_atomic(marker, {"latent_shape": [shape[1], *shape[3:]]})
        encoded = [episodes.rows[index] for index in members]
        rows += [LatentRow.of(row, _views(row, config), shard=name) for row in encoded]
        progress.update(len(members))
    progress.close()
    facts = json.loads((output / "run" / "00000.json").read_text())
    write_store_index(
        output,
        rows,
        {
            "layout": layout,
            "start_step": config.start_step,
            "strides": list(config.strides),
            "views": list(config.views),
            "image_size": list(config.image_size),
            "temporal_compression": TEMPORAL_FACTOR,
            "tokenizer": tokenizer_fingerprint(tokenizer, Path(inputs["tokenizer"])),
            **facts,
        },
    )
    frames = sum(row.num_frames for row in rows)
    return {"episodes": len(rows), "frames": frames, "shards": len(shards), "layout": layout}


def _views(row: EpisodeRow, config: EncodeLatentsConfig) -> tuple[str, ...]:
    """Which views of an episode are encoded: all that are wanted, the task-facing one alone, or none."""
    if all(view in row.views for view in config.views):
        return tuple(config.views)
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
