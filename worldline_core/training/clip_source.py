"""Where clips are read from: cached latents on disk or on the training device, or frames of an EpisodeSet.

Reading is split in two so that it can run in other processes: `ClipSource.read` touches files and fills an array;
`ClipSource.latents` turns that array into what the model sees, on the model's device.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float, Int, UInt8
from safetensors import SafetensorError, safe_open
from torch import Tensor

from worldline_core.actions.action_maps import control_frames
from worldline_core.actions.actions_config import TEMPORAL_FACTOR
from worldline_core.actions.episode_tracks import SAMPLES, ActionTracks, TrackBatch, collate_tracks
from worldline_core.data.episodes.episode_index import EpisodeRow
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.video.clip import FrameDecoder
from worldline_core.data.video.frames import VideoFrames
from worldline_core.errors import ArtifactError, ConfigError, DataError
from worldline_core.model.tokenizers import (
    VideoTokenizer,
    load_tokenizer,
    resize_frame,
    resized_video,
    tokenizer_fingerprint,
)
from worldline_core.progress import with_progress
from worldline_core.store.artifact_files import read_json, read_rows
from worldline_core.training.clip_config import PRIMARY, ClipInput, ClipSampling, FrameInput
from worldline_core.training.clip_sampler import Clip, ClipRow, latent_frame_count, longest_clip

logger = logging.getLogger(__name__)

Layout = Literal["groups", "clips"]
INDEX, DESCRIPTION = "index.parquet", "store.json"


class ClipSource(ABC):
    """Episodes whose clips can be read.

    Attributes:
        root: folder, for error messages.
        start_step: clips start at multiples of it.
        latent_shape: (c, h, w) of one view's latent frame.
        image_size: (H, W) of the frames that the latents are of.
        description: at least ``tokenizer`` (its fingerprint) and ``views``.
        dtype: of what `read` gives.
    """

    root: Path
    start_step: int
    latent_shape: tuple[int, int, int]
    image_size: tuple[int, int]
    description: dict[str, Any]
    dtype: np.dtype[Any]

    def __init__(self, rows: Sequence[ClipRow]) -> None:
        self.rows = list(rows)
        self._by_id = {row.episode_id: row for row in self.rows}

    def row(self, episode_id: str) -> ClipRow:
        """The row of an episode.

        Raises:
            ArtifactError: the source does not hold it.
        """
        if episode_id not in self._by_id:
            raise ArtifactError(
                f"The {type(self).__name__} does not hold this episode (or not all the views that are trained on).",
                where=self.root,
                got=episode_id,
                next_step="encode the latents of the same EpisodeSet that is trained on",
            )
        return self._by_id[episode_id]

    @abstractmethod
    def shape(self, num_frames: int) -> tuple[int, ...]:
        """Shape of what `read` gives for one view of a clip."""

    @abstractmethod
    def read(self, clip: Clip, views: tuple[str, ...], out: np.ndarray) -> None:
        """Fill ``out`` (v, *shape) with the views of a clip. Works in any process.

        Raises:
            DataError: the clip is damaged; the message names it.
            ArtifactError: the clip does not belong to this source.
        """

    @abstractmethod
    def latents(self, read: Tensor, device: str) -> Float[Tensor, "b v c t h w"]:
        """Latents (float32) of clips that were read, on ``device``."""


@dataclass(frozen=True)
class LatentRow(ClipRow):
    """One episode of a latent store. A start frame is a multiple of the store's ``start_step``."""

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
    """A Latents artifact: safetensors shards, read by memory mapping, beside an index of the episodes.

    A causal tokenizer treats the first frame of a clip specially, so a clip's latents depend on where it starts. Two
    layouts keep every clip exact:

    - ``groups`` (tokenizers whose later latent frames depend on their own four frames only): a single-frame latent for
      every start frame, and for every stride and phase the latents of the groups of four frames that follow;
    - ``clips`` (tokenizers with a longer memory): for every stride and start frame the latents of the whole remaining
      clip.
    """

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
        """Fill ``out`` (v, c, t, h, w) with the clip's latents.

        Raises:
            ArtifactError: if the episode, stride or view is not stored, or a shard is damaged.
            DataError: if the clip does not fit, starts between stored start frames, or holds values that are not finite.
        """
        selected = self.stored_views(clip, views)
        with self.shard(clip.episode_id) as shard:
            frames = [shard.get_slice(name)[:, :, first:stop] for name, first, stop in self.parts(clip)]
        torch.from_numpy(out).copy_(torch.cat(frames, dim=2)[selected])
        if not np.isfinite(out).all():
            raise self.not_finite(clip.episode_id)

    def latents(self, read: Tensor, device: str) -> Float[Tensor, "b v c t h w"]:
        return read.to(device, copy=True)  # what clips are read into is used again

    def parts(self, clip: Clip) -> list[tuple[str, int, int]]:
        """Tensors that a clip's latent frames are in, in order: (name, first latent frame, stop)."""
        frames = latent_frame_count(clip.num_frames)
        if self.layout == "clips":
            return [(clip_key(clip.episode_id, clip.stride, clip.start), 0, frames)]
        index = clip.start // self.start_step
        single = (single_key(clip.episode_id), index, index + 1)
        if frames == 1:
            return [single]
        offset, phase = divmod(clip.start + clip.stride, TEMPORAL_FACTOR * clip.stride)
        return [single, (group_key(clip.episode_id, clip.stride, phase), offset, offset + frames - 1)]

    def stored_views(self, clip: Clip, views: tuple[str, ...]) -> list[int]:
        """Numbers of a clip's views among those that are stored; raises as `read` does."""
        row = self.row(clip.episode_id)
        if clip.stride not in self.strides:
            raise ArtifactError(
                "The latent store was not encoded at this stride.",
                where=self.root,
                expected=self.strides,
                got=clip.stride,
            )
        longest = longest_clip(row.num_frames, clip.start, clip.stride)
        if clip.start % self.start_step or clip.start < 0 or clip.num_frames > longest:
            raise DataError(
                "A clip does not fit the stored latents of its episode.",
                where=clip.episode_id,
                expected=f"a start frame divisible by {self.start_step}, within {row.num_frames} frames",
                got=f"start {clip.start}, {clip.num_frames} frames, stride {clip.stride}",
            )
        if missing := [view for view in views if view not in row.views]:
            raise ArtifactError(
                "The latent store does not hold this view.", where=clip.episode_id, expected=row.views, got=missing
            )
        return [row.views.index(view) for view in views]

    @contextmanager
    def shard(self, episode_id: str) -> Iterator[Any]:
        """The open safetensors file that holds an episode; it stays open."""
        path = self.root / self._shard_of[episode_id]
        try:
            if path.name not in self._shards:
                self._shards[path.name] = safe_open(path, framework="pt")
            yield self._shards[path.name]
        except (OSError, SafetensorError) as error:
            raise ArtifactError(
                "A latent shard is damaged or cannot be opened.",
                where=path,
                got=error,
                next_step="encode the latents again",
            ) from error

    def not_finite(self, episode_id: str) -> DataError:
        return DataError(
            "Cached latents hold values that are not finite.",
            where=f"{self._shard_of[episode_id]}, episode {episode_id}",
            next_step="delete this Latents artifact and encode it again; check the tokenizer",
        )


class ResidentLatents(ClipSource):
    """All latents of a store on one device, in half precision: what is "read" of a clip are the numbers of its frames."""

    dtype: np.dtype[Any] = np.dtype(np.int64)

    def __init__(self, store: LatentStore, device: str) -> None:
        super().__init__(store.rows)
        self.store = store
        self.root, self.start_step, self.image_size = store.root, store.start_step, store.image_size
        self.latent_shape, self.description = store.latent_shape, store.description
        self._first: dict[str, tuple[int, int]] = {}  # by tensor: number of its first frame, frames of a view
        count = 0
        for row in self.rows:
            with store.shard(row.episode_id) as shard:
                for name in _names(shard, row.episode_id):
                    views, _, frames = shard.get_slice(name).get_shape()[:3]
                    self._first[name] = (count, frames)
                    count += views * frames
        self._frames = torch.empty((count, *self.latent_shape), dtype=torch.float16, device=device)
        for row in with_progress(self.rows, "reading latents", "episode"):
            with store.shard(row.episode_id) as shard:
                for name in _names(shard, row.episode_id):
                    frames = rearrange(shard.get_tensor(name), "v c t h w -> (v t) c h w")
                    if not bool(torch.isfinite(frames).all()):
                        raise store.not_finite(row.episode_id)
                    self._frames[self._first[name][0] :][: len(frames)] = frames

    def shape(self, num_frames: int) -> tuple[int, ...]:
        """(t,) of a clip's latents."""
        return (latent_frame_count(num_frames),)

    def read(self, clip: Clip, views: tuple[str, ...], out: np.ndarray) -> None:
        """Fill ``out`` (v, t) with the numbers of the clip's latent frames; raises as `LatentStore.read` does."""
        selected = np.array(self.store.stored_views(clip, views))
        place = 0
        for name, first, stop in self.store.parts(clip):
            number, per_view = self._first[name]
            out[:, place : place + stop - first] = (number + selected * per_view)[:, None] + np.arange(first, stop)
            place += stop - first

    def latents(self, read: Int[Tensor, "b v t"], device: str) -> Float[Tensor, "b v c t h w"]:
        return rearrange(self._frames[read.to(device)], "b v t c h w -> b v c t h w").float().contiguous()


def _names(shard: Any, episode_id: str) -> list[str]:
    return [name for name in shard.keys() if name.startswith(f"{episode_id}/")]  # noqa: SIM118


class ResidentTracks:
    """Track samples of many episodes on one device.

    Raises:
        DataError: the episodes' frames have several sizes.
    """

    def __init__(self, tracks: ActionTracks, episode_ids: Sequence[str], views: tuple[str, ...], device: str) -> None:
        samples: list[TrackBatch] = []
        self._first: dict[str, int] = {}
        sizes: set[tuple[int, int]] = set()
        count = 0
        for episode_id in episode_ids:
            episode = tracks.tracks(episode_id)
            samples.append(collate_tracks([episode], views))
            self._first[episode_id] = count
            count += episode.num_frames
            sizes.add(episode.image_size)
        if len(sizes) > 1:
            raise DataError("Resident action tracks have frames of one size", where=tracks.root, got=sorted(sizes))
        (self.image_size,) = sizes
        arms = max(sample.valid.shape[3] for sample in samples)
        self._samples = {
            name: torch.cat([_padded(getattr(sample, name)[0], arms) for sample in samples]).to(device)
            for name in SAMPLES
        }
        self._views = views

    def batch(self, clips: Sequence[Clip], per_latent_frame: int, views: Sequence[str]) -> TrackBatch:
        """Samples of the control frames of clips of one length, as `collate_tracks` gives them."""
        within = np.array(control_frames(clips[0].num_frames, per_latent_frame))
        firsts = np.array([self._first[clip.episode_id] + clip.start for clip in clips])
        strides = np.array([clip.stride for clip in clips])
        numbers = torch.from_numpy(firsts[:, None] + strides[:, None] * within).to(self._samples["uv"].device)
        chosen = [self._views.index(view) for view in views]
        return TrackBatch(**{name: values[numbers][:, :, chosen] for name, values in self._samples.items()})


def _padded(values: Tensor, arms: int) -> Tensor:
    """``values`` (n v a ...) with more arms, which are never valid."""
    return torch.cat([values, values.new_zeros((*values.shape[:2], arms - values.shape[2], *values.shape[3:]))], 2)


class FrameSource(ClipSource):
    """Frames of an EpisodeSet, decoded and encoded when they are needed.

    Its episodes are those that have all ``views`` (and perhaps others), or (``primary_alone``) their task-facing one.

    Raises:
        CheckpointError: the folder holds no tokenizer.
        ConfigError: the tokenizer cannot code images of this size.
        DataError: no episode has the views.
        UnavailableError: the decoder that is asked for cannot be loaded.
    """

    dtype: np.dtype[Any] = np.dtype(np.uint8)

    def __init__(
        self,
        episodes: EpisodeSet,
        tokenizer_folder: Path,
        config: FrameInput,
        *,
        views: tuple[str, ...],
        primary_alone: bool = False,
        device: str = "cpu",
    ) -> None:
        needed = [set((row.primary_view,) if primary_alone else views) for row in episodes.rows]
        pairs = zip(episodes.rows, needed, strict=True)
        super().__init__([ClipRow.from_episode(row, row.views) for row, names in pairs if names <= set(row.views)])
        if not self.rows:
            raise DataError(
                "No episode has the views that are trained on.",
                where=episodes.root,
                expected="the task-facing view" if primary_alone else ", ".join(views),
                got=f"{len(episodes)} episodes without",
            )
        if len(self.rows) < len(episodes):
            lacking = len(episodes) - len(self.rows)
            logger.info("%d of %d episodes lack a view that is trained on.", lacking, len(episodes))
        self._tokenizer: VideoTokenizer | None = load_tokenizer(tokenizer_folder, device)
        space = self._tokenizer.spatial_compression
        height, width = config.image_size
        if height % space or width % space:
            raise ConfigError(
                "The tokenizer cannot code images of this size.",
                where="input.image_size",
                expected=f"multiples of {space}",
                got=f"{height}x{width}",
            )
        self.root = episodes.root
        self.episodes = episodes
        self.config = config
        self.image_size = config.image_size
        self.start_step = config.start_step
        self.latent_shape = (self._tokenizer.latent_channels, height // space, width // space)
        self._decoder: FrameDecoder | None = None
        self.description = {
            "tokenizer": tokenizer_fingerprint(self._tokenizer, tokenizer_folder),
            "views": list(views),
            "decoder": FrameDecoder.name,
        }

    def __getstate__(self) -> dict[str, Any]:
        # Loader processes read frames: they open files themselves and have no use for the tokenizer.
        episodes = EpisodeSet(self.episodes.root, self.episodes.rows)
        return {**self.__dict__, "episodes": episodes, "_tokenizer": None, "_decoder": None}

    @property
    def decoder(self) -> FrameDecoder:
        """This process's decoder."""
        if self._decoder is None:
            self._decoder = FrameDecoder(self.config.open_files)
        return self._decoder

    def shape(self, num_frames: int) -> tuple[int, ...]:
        """(n, H, W, 3) of one view of a clip."""
        return num_frames, *self.image_size, 3

    def read(self, clip: Clip, views: tuple[str, ...], out: np.ndarray) -> None:
        """Fill ``out`` (v, n, H, W, 3), uint8 RGB, with the clip's frames at the training size.

        Raises:
            DataError: a frame cannot be read; the message names the clip, the view and the file.
            ArtifactError: the episode is not in the set.
        """
        position = self.episodes.position(self.row(clip.episode_id).episode_id)
        for pictures, view in zip(out, views, strict=True):
            where: object = f"{clip}, view {view}"
            try:
                video = self.episodes.clip(position, view)
                where = f"{clip}, view {view}, in {video.path}"
                for target, picture in zip(pictures, self.decoder.frames(video, clip.frames), strict=True):
                    resize_frame(picture, self.image_size, out=target)
            except DataError as error:
                raise DataError(
                    f"A clip cannot be read: {error.what}",
                    where=where,
                    expected=error.expected,
                    got=error.got,
                    next_step="repair or drop the episode, or set input.on_unreadable to skip",
                ) from error

    @torch.no_grad()
    def latents(self, read: UInt8[Tensor, "b v n h w 3"], device: str) -> Float[Tensor, "b v c t h_l w_l"]:
        """Latents of frames, rounded to half precision as cached ones are.

        Clips and views are encoded one by one, as encode_latents does: another batch size might round differently.
        """
        tokenizer = cast("VideoTokenizer", self._tokenizer)
        encoded: list[Tensor] = []
        for frames in rearrange(read, "b v n h w c -> (b v) n h w c"):
            video = rearrange(frames.to(device, non_blocking=True), "n h w c -> 1 c n h w").contiguous()
            encoded.append(tokenizer.encode(video.float() / 127.5 - 1.0)[0].to(torch.float16))
        return rearrange(torch.stack(encoded).float(), "(b v) c t h w -> b v c t h w", b=read.shape[0])


@dataclass(frozen=True)
class LoadedView:
    """One view of one episode at the training size; ``name`` is episode/view."""

    name: str
    frames: UInt8[Tensor, "3 n h w"]


def load_views(
    episodes: EpisodeSet, positions: Sequence[int], image_size: tuple[int, int], minimum: int
) -> list[LoadedView]:
    """All views of the episodes at ``positions`` that have ``minimum`` frames or more, in memory.

    Raises:
        DataError: there is none.
    """
    views: list[LoadedView] = []
    for position in with_progress(positions, "reading episodes", "episode"):
        row = episodes.rows[position]
        for view in row.views:
            frames = VideoFrames(episodes.clip(position, view))
            if len(frames) >= minimum:
                views.append(LoadedView(f"{row.episode_id}/{view}", resized_video(frames, image_size)))
    if not views:
        raise DataError("No episode is long enough to train on", where=episodes.root, expected=f">= {minimum} frames")
    return views


def training_rows(
    source: ClipSource,
    episodes: EpisodeSet,
    *,
    stage: Literal[1, 2],
    tracks: ActionTracks | None = None,
    outcomes: Sequence[str] | None = None,
    views: Sequence[str] | None = None,
) -> list[ClipRow]:
    """Rows of the source whose episode is fit for the stage and ended in one of ``outcomes``; Stage II needs action tracks.

    Args:
        views: those that an episode needs for Stage II, whatever else it lacks; None: all of the source's.

    Raises:
        DataError: if none is left.
    """

    def fit(row: EpisodeRow) -> bool:
        stage2_ok = row.stage2_ok or (views is not None and row.stage2_reason == "missing_view")
        return (row.stage1_ok if stage == 1 else stage2_ok) and (outcomes is None or row.outcome in outcomes)

    allowed = {row.episode_id for row in episodes.rows if fit(row)}
    # Episodes encoded by their task-facing view alone are for Stage I, however fit their other views are.
    needed = set(source.description.get("views", ()) if views is None else views) if stage == 2 else set[str]()
    rows = [row for row in source.rows if row.episode_id in allowed and needed <= set(row.views)]
    fitting = [row for row in rows if tracks is None or row.episode_id in tracks]
    if len(fitting) < len(rows):
        logger.warning("%d of %d episodes have no action tracks and are left out.", len(rows) - len(fitting), len(rows))
    if not fitting:
        raise DataError(
            "No episode is left to train on.",
            where=f"stage {stage}",
            expected="episodes that are in the EpisodeSet, the source of clips and (Stage II) the action tracks",
            got=f"{len(allowed)} fit episodes in the set, {len(source.rows)} in the source",
            next_step="see the quarantine tables of curate, filter and render_actions",
        )
    return fitting


def open_source(
    reading: ClipInput,
    clips: ClipSampling,
    inputs: Mapping[str, Path],
    episodes: EpisodeSet,
    views: Sequence[str],
    device: str,
) -> ClipSource:
    """The configured source: cached ``latents``, or frames that ``tokenizer`` encodes during training.

    Raises:
        ConfigError: the input that the clips come from is not given.
    """
    needed = "tokenizer" if isinstance(reading, FrameInput) else "latents"
    if needed not in inputs:
        raise ConfigError(
            f"Clips from {reading.kind} need the input {needed}.",
            where="input.kind",
            expected=f"an input named {needed}",
            got=", ".join(sorted(inputs)),
            next_step=f"give --input {needed}=FOLDER, or choose the other kind of input",
        )
    if not isinstance(reading, FrameInput):
        store = LatentStore.open(Path(inputs["latents"]))
        return ResidentLatents(store, device) if reading.resident else store
    return FrameSource(
        episodes,
        Path(inputs["tokenizer"]),
        reading,
        views=clips.needed_views(views),
        primary_alone=set(clips.view_weights or {}) == {PRIMARY},
        device=device,
    )
