"""`encode_latents`: the video tokenizer's latents of every selected episode, in safetensors shards."""

from __future__ import annotations

import fcntl
import logging
import platform
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from itertools import batched, product
from pathlib import Path
from typing import IO, Any, ClassVar, NoReturn

import pyarrow as pa
import pyarrow.parquet as pq
import torch
from jaxtyping import Float, UInt8
from safetensors.torch import save_file
from torch import Tensor

from worldline_core.actions.action_maps import latent_frame_indices
from worldline_core.actions.actions_config import TEMPORAL_FACTOR
from worldline_core.data.episodes.episode_index import EpisodeRow
from worldline_core.data.episodes.episode_set import EpisodeSet, ShardFilesWork
from worldline_core.data.video.frames import VideoFrames
from worldline_core.errors import ArtifactError, ConfigError, DataError
from worldline_core.model.tokenizers import VideoTokenizer, load_tokenizer, resized_video, tokenizer_fingerprint
from worldline_core.scale.account import InputRow, check_account, write_account
from worldline_core.scale.mapping import SerialMapper, ShardMapper, map_episodes, reading_input
from worldline_core.store.atomic import atomic_path, write_json_atomic
from worldline_core.training.clip_config import EncodeLatentsConfig
from worldline_core.training.clip_sampler import ClipRow, longest_clip
from worldline_core.training.clip_source import DESCRIPTION, INDEX, Layout, latent_key

logger = logging.getLogger(__name__)

SHARD_FILE = "{:05d}.safetensors"
_SPAN = 2 * TEMPORAL_FACTOR + 1


def encode_clip(
    tokenizer: VideoTokenizer, video: UInt8[Tensor, "3 n h w"], device: str
) -> Float[Tensor, "c t h_l w_l"]:
    """Latents of one clip, rounded to half precision as they are stored. Raises: DataError for numbers that are not finite."""
    with torch.no_grad():
        latents = tokenizer.encode((video.float() / 127.5 - 1.0)[None].to(device))[0].to("cpu", torch.float16)
    if not bool(torch.isfinite(latents).all()):
        raise DataError("The tokenizer's latents are not finite in half precision.", next_step="check the tokenizer")
    return latents


def clips_to_encode(count: int, layout: Layout, config: EncodeLatentsConfig) -> dict[tuple[int, int], range]:
    """Frames of each clip that is encoded of an episode of ``count`` frames, by stride, and start or phase (see `latent_key`)."""
    clips: dict[tuple[int, int], range] = {}
    for stride, start in product(config.strides, range(0, count, config.start_step)):
        length = longest_clip(count, start, stride)
        number = start
        if layout == "clips":
            length = min(length, config.clip_frames or length)
        else:
            number = (start + stride) % (TEMPORAL_FACTOR * stride)
        if layout == "clips" or length > 1:  # the first clip of each phase yields every group of that phase
            clips.setdefault((stride, number), range(start, start + stride * (length - 1) + 1, stride))
    return clips


def _groups_before(clip: range) -> int:
    """Groups of a clip's phase that begin before the clip; they are stored as zeros."""
    return (clip.start + clip.step) // (TEMPORAL_FACTOR * clip.step)


def encode_episode(
    tokenizer: VideoTokenizer,
    episode_id: str,
    videos: Sequence[UInt8[Tensor, "3 n h w"]],
    layout: Layout,
    config: EncodeLatentsConfig,
) -> dict[str, Float[Tensor, "v c t h_l w_l"]]:
    """All tensors of one episode, given as the videos of its views, by their names in the shard."""
    count = videos[0].shape[1]
    tensors: dict[str, Tensor] = {}

    def stacked(indices: range) -> Tensor:
        return torch.stack([encode_clip(tokenizer, video[:, list(indices)], config.device) for video in videos])

    if layout == "groups":
        singles = [stacked(range(start, start + 1)) for start in range(0, count, config.start_step)]
        tensors[latent_key(episode_id, "single")] = torch.cat(singles, 2)
    for numbers, clip in clips_to_encode(count, layout, config).items():
        latents = stacked(clip)
        if layout == "groups":
            latents = torch.nn.functional.pad(latents[:, :, 1:], (0, 0, 0, 0, _groups_before(clip), 0)).contiguous()
        tensors[latent_key(episode_id, layout, *numbers)] = latents
    return tensors


def stored_latent_frames(count: int, layout: Layout, config: EncodeLatentsConfig) -> int:
    """Latent frames that `encode_episode` stores of each view of an episode of ``count`` frames."""
    clips = clips_to_encode(count, layout, config).values()
    total = sum(len(latent_frame_indices(len(clip))) for clip in clips)
    if layout == "groups":
        total += len(range(0, count, config.start_step)) + sum(_groups_before(clip) - 1 for clip in clips)
    return total


def within_disk(
    config: EncodeLatentsConfig, rows: Sequence[EpisodeRow], layout: Layout, latent_frame_bytes: int
) -> EncodeLatentsConfig:
    """The settings with the smallest doubled ``start_step`` with which latents of some episodes fit ``config.disk``.

    Args:
        latent_frame_bytes: of one view's latent frame.

    Raises:
        ConfigError: they do not fit with one clip of each episode.
    """
    if config.disk is None:
        return config
    longest, tried = max(row.video_frames for row in rows), config
    while True:
        frames = (len(_views(row, tried)) * stored_latent_frames(row.video_frames, layout, tried) for row in rows)
        if (need := latent_frame_bytes * sum(frames)) <= config.disk:
            break
        if tried.start_step >= longest:
            raise ConfigError(
                "The latents do not fit the disk space they are given", where="encode_latents.disk",
                expected=f"{config.disk / 1e9:.3g} GB", got=f"{need / 1e9:.3g} GB with one clip of each of {len(rows)} episodes",
                next_step="give more, set clip_frames, encode fewer splits or views, or train from frames (input.kind: frames)",
            )  # fmt: skip
        tried = tried.model_copy(update={"start_step": 2 * tried.start_step})
    if tried.start_step != config.start_step:
        logger.warning(
            "Clips start at every %d-th frame, not every %d-th, so that latents fit %.3g GB.",
            tried.start_step, config.start_step, config.disk / 1e9,
        )  # fmt: skip
    return tried


def choose_layout(tokenizer: VideoTokenizer, video: UInt8[Tensor, "3 n h w"], config: EncodeLatentsConfig) -> Layout:
    """``groups`` where a latent frame depends on its own four frames alone, else ``clips``.

    Raises:
        DataError: the video is too short to tell.
    """
    if video.shape[1] < _SPAN:
        raise DataError("An episode is too short to encode.", expected=f"{_SPAN} frames or more", got=video.shape[1])
    whole = encode_clip(tokenizer, video[:, :_SPAN], config.device)[:, 2]
    later = encode_clip(tokenizer, video[:, TEMPORAL_FACTOR:_SPAN], config.device)[:, 1]
    # One unit of half precision: different batch shapes may round the last bit differently.
    return "groups" if torch.allclose(whole.float(), later.float(), rtol=2e-3, atol=2e-3) else "clips"


@contextmanager
def _one_thread() -> Iterator[None]:
    """Sums on several threads round differently, and the latents must not depend on how many a process has."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def claim_device(device: str, folder: Path) -> tuple[str, IO[str] | None]:
    """The device that this process works on, and what it holds as long as it has it.

    `cuda` is the first device of this machine that no other process has claimed in `folder`; others are themselves.

    Raises:
        ConfigError: there are more processes than devices.
    """
    if device != "cuda":
        return device, None
    for number in range(torch.cuda.device_count()):
        held = (folder / f"{platform.node()}-cuda-{number}.lock").open("w")
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            held.close()
            continue
        return f"cuda:{number}", held
    raise ConfigError(
        "Every process needs a device of its own",
        where="encode_latents.device",
        expected=f"at most {torch.cuda.device_count()} processes on this machine",
        got="one more",
        next_step="set runner.workers (or the workers of the cluster) to the number of devices",
    )


@dataclass(frozen=True, kw_only=True)
class EncodedEpisode(InputRow):
    """One episode's tensors by their names in the shard."""

    tensors: Mapping[str, Float[Tensor, "v c t h_l w_l"]]


@dataclass(frozen=True)
class EncodeWork(ShardFilesWork[EncodedEpisode]):
    """Encodes each episode; a shard becomes one file of the artifact.

    Attributes:
        codec: the tokenizer's folder.
    """

    step: ClassVar[str] = "encode_latents"
    doing: ClassVar[str] = "Encoding"
    shard_file = SHARD_FILE

    config: EncodeLatentsConfig
    codec: Path
    layout: Layout

    @property
    def processes(self) -> int | None:
        if self.config.device == "cpu":
            return None
        return torch.cuda.device_count() if self.config.device == "cuda" else 1

    @cached_property
    def _device(self) -> tuple[str, IO[str] | None]:
        return claim_device(self.config.device, self.output / "run")

    @cached_property
    def _tokenizer(self) -> VideoTokenizer:
        return load_tokenizer(self.codec, self._device[0])

    def do(self, episode: int) -> EncodedEpisode:
        row = self.episodes.rows[episode]
        with reading_input(f"{self.folder}, episode {row.episode_id}"):
            videos = read_videos(self.episodes, episode, self.config)
        config = self.config.model_copy(update={"device": self._device[0]})
        with _one_thread():
            tensors = encode_episode(self._tokenizer, row.episode_id, videos, self.layout, config)
        size = sum(tensor.nbytes for tensor in tensors.values())
        return EncodedEpisode(
            episode_id=row.episode_id, source=row.source, status="kept", stored_bytes=size, tensors=tensors
        )

    def quarantine_crashed(self, episode: int, detail: str, evidence: Mapping[str, Any]) -> NoReturn:
        """Latents are of every selected episode or of none: what fails here is the tokenizer or the machine."""
        raise ArtifactError(
            "An episode could not be encoded",
            where=self.episodes.rows[episode].episode_id,
            got=detail,
            next_step="look at the memory of the device; finished shards are kept when the step is run again",
        )

    def finish_shard(self, number: int, results: Sequence[EncodedEpisode]) -> None:
        """Write the latents of a shard into one file, and their bytes by episode into another."""
        tensors = {name: tensor for result in results for name, tensor in result.tensors.items()}
        with atomic_path(self.output / SHARD_FILE.format(number)) as temporary:
            save_file(dict(sorted(tensors.items())), temporary)
        stored = {result.episode_id: result.stored_bytes for result in results}
        write_json_atomic(self.summary_path(number), {"stored_bytes": stored})


def encode_latents(
    config: EncodeLatentsConfig, inputs: Mapping[str, Path], output: Path, mapper: ShardMapper | None = None
) -> dict[str, Any]:
    """Encode ``inputs['episodes']`` with ``inputs['tokenizer']``; finished shards are kept when the step is restarted.

    Args:
        mapper: what does the shards, by default this process. The latents do not depend on it.

    Raises:
        DataError: if no episode is selected.
        ConfigError: if the latents do not fit ``config.disk``.
        ArtifactError: if frames and index disagree, or an episode cannot be encoded.
    """
    episodes = EpisodeSet.open(inputs["episodes"])
    selected = _select(episodes, config)
    tokenizer = load_tokenizer(inputs["tokenizer"], config.device)
    with _one_thread():
        video = read_videos(episodes, selected[0], config, _SPAN)[0]
        layout = choose_layout(tokenizer, video, config)
        single = encode_clip(tokenizer, video[:, :1], config.device)
    config = within_disk(config, [episodes.rows[index] for index in selected], layout, single.nbytes)
    fingerprint = tokenizer_fingerprint(tokenizer, Path(inputs["tokenizer"]))
    del tokenizer  # each process that encodes loads its own
    (output / "run").mkdir(parents=True, exist_ok=True)
    work = EncodeWork(output, inputs["episodes"], config, inputs["tokenizer"], layout)
    pieces = list(batched(selected, config.episodes_per_shard))
    map_episodes(mapper or SerialMapper(), work, pieces)
    rows: list[ClipRow] = []
    account: list[InputRow] = []
    for number, members in enumerate(pieces):
        summary = work.summary(number)
        for row in (episodes.rows[index] for index in members):
            rows.append(ClipRow.from_episode(row, _views(row, config), shard=SHARD_FILE.format(number)))
            size = summary["stored_bytes"][row.episode_id]
            account.append(InputRow(episode_id=row.episode_id, source=row.source, status="kept", stored_bytes=size))
    write_account(output, account)
    check_account(output, len(selected), {row.episode_id for row in rows}, set())
    columns = [{"episode_id": row.episode_id, "shard": row.shard, **vars(row)} for row in rows]
    with atomic_path(output / INDEX) as temporary:
        pq.write_table(pa.Table.from_pylist(columns), temporary, compression="zstd")
    description = {
        "layout": layout,
        "start_step": config.start_step,
        "clip_frames": config.clip_frames if layout == "clips" else None,
        "strides": list(config.strides),
        "views": list(config.views),
        "image_size": list(config.image_size),
        "tokenizer": fingerprint,
        "latent_shape": [single.shape[0], *single.shape[2:]],
    }
    write_json_atomic(output / DESCRIPTION, description)
    unfit = [row.split for row in episodes.rows if not _views(row, config)]
    left_out = {"missing_view": len(unfit), "other_split": len(episodes) - len(rows) - len(unfit)}
    return {
        "found": len(episodes),
        "kept": len(rows),
        "left_out": {reason: count for reason, count in left_out.items() if count},
        "frames": sum(row.num_frames for row in rows),
        "shards": len(pieces),
        "layout": layout,
    }


def read_videos(
    episodes: EpisodeSet, position: int, config: EncodeLatentsConfig, most: int | None = None
) -> list[UInt8[Tensor, "3 n h w"]]:
    """The views of an episode that are encoded, at the size of training; of each ``most`` frames at most."""
    clips = (episodes.clip(position, view) for view in _views(episodes.rows[position], config))
    cut = (clip.cut(0, min(clip.num_frames, most or clip.num_frames)) for clip in clips)
    return [resized_video(VideoFrames(clip), config.image_size) for clip in cut]


def _views(row: EpisodeRow, config: EncodeLatentsConfig) -> tuple[str, ...]:
    """Views of an episode to encode: the configured ones that it has, and the task-facing one."""
    return tuple(view for view in dict.fromkeys((*config.views, row.primary_view)) if view in row.views)


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
            got=", ".join(
                f"{count} of split {split} with {' '.join(views)}"
                for (split, views), count in Counter((row.split, row.views) for row in episodes.rows).most_common(5)
            )
            or "an empty EpisodeSet",
            next_step="encode_latents.splits and views say which are encoded",
        )
    return selected
