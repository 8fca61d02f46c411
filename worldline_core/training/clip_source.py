"""Sources of clips: cached latents on disk or on the training device, or frames of an EpisodeSet."""

from __future__ import annotations

import logging
import math
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float, Shaped, UInt8
from safetensors import SafetensorError, safe_open
from torch import Tensor
from torch.utils.data import Dataset

from worldline_core.actions.action_maps import latent_frame_indices
from worldline_core.actions.actions_config import TEMPORAL_FACTOR
from worldline_core.actions.episode_tracks import ActionTracks
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.video.clip import FrameDecoder
from worldline_core.data.video.frames import VideoFrames
from worldline_core.errors import ArtifactError, ConfigError, DataError, WorldLineError
from worldline_core.model.tokenizers import (
    VideoTokenizer,
    load_tokenizer,
    resize_frame,
    resized_video,
    tokenizer_fingerprint,
)
from worldline_core.progress import with_progress
from worldline_core.store.artifact_files import read_json, read_rows
from worldline_core.training.clip_config import ClipInput, FrameInput
from worldline_core.training.clip_sampler import Clip, ClipBatch, ClipRow, longest_clip
from worldline_core.training.resident import on_device

logger = logging.getLogger(__name__)

Layout = Literal["groups", "clips"]
INDEX, DESCRIPTION = "index.parquet", "store.json"
_VIEWS_LEFT_OUT = "views without a camera, which take train_stage2.native_size, in"


class ClipSource(Dataset[Tensor | WorldLineError], ABC):
    """Episodes whose clips can be read, in any process (an item of this dataset is a batch), and made into latents where a model is.

    Attributes:
        root: folder, for error messages.
        start_step: clips start at multiples of it.
        latent_shape: (c, h, w) of one view's latent frame.
        image_size: (H, W) of the frames that the latents are of.
        clip_frames: most frames of a clip; None: all that the episode has.
        description: at least ``tokenizer`` (its fingerprint).
        resident: clips are kept on the training device.
        facts: how clips are read, for a checkpoint's metadata.
    """

    root: Path
    start_step: int
    latent_shape: tuple[int, int, int]
    image_size: tuple[int, int]
    clip_frames: int | None = None
    description: dict[str, Any]
    resident = False
    facts: Mapping[str, Any] = {}

    def __init__(self, rows: Sequence[ClipRow]) -> None:
        self.rows = list(rows)
        self._by_id = {row.episode_id: row for row in self.rows}

    def row(self, episode_id: str) -> ClipRow:
        """The row of an episode. Raises: ArtifactError: the source does not hold it."""
        if episode_id not in self._by_id:
            raise ArtifactError(
                "Clips of this episode are not held", where=self.root, expected=f"one of {len(self.rows)} episodes",
                got=episode_id, next_step="encode the latents of the EpisodeSet that is trained on",
            )  # fmt: skip
        return self._by_id[episode_id]

    def require_length(self, frames: int, where: str) -> None:
        """Raises ConfigError where clips of so many frames, which the setting ``where`` asks for, are not held."""
        if self.clip_frames is not None and frames > self.clip_frames:
            raise ConfigError(
                "Longer clips are asked for than the latents were encoded for", where=where, expected=f"at most {self.clip_frames}",
                got=f"{frames} frames", next_step=f"set encode_latents.clip_frames to {frames} and encode again, or ask for shorter ones",
            )  # fmt: skip

    def __getitem__(self, batch: ClipBatch) -> Tensor | WorldLineError:
        """As `read_batch`, but an error is an item like any other, and reaches the training process as it is."""
        try:
            return self.read_batch(batch)
        except WorldLineError as error:
            return error

    @abstractmethod
    def read(self, clip: Clip, views: tuple[str, ...]) -> Shaped[Tensor, "v ..."]:
        """Some views of a clip. Raises: ArtifactError: it does not belong to this source; DataError: it is damaged (the message
        names it, and of frames also the view and the file)."""

    def recorded_views(self, batch: ClipBatch) -> list[tuple[str, ...]]:
        """The recorded views that fill each clip's slots: the task-facing one has a name of its own."""
        return [(self.row(clip.episode_id).primary_view,) if batch.primary else batch.views for clip in batch.clips]

    def read_batch(self, batch: ClipBatch) -> Shaped[Tensor, "b v ..."]:
        """All clips of a batch; raises as `read`."""
        return torch.stack(list(map(self.read, batch.clips, self.recorded_views(batch))))

    def latents(self, read: Shaped[Tensor, "b v ..."], device: str) -> Float[Tensor, "b v c t h w"]:
        """Latents (float32) of clips that were read, on ``device``."""
        return read.to(device)


def latent_key(episode_id: str, kind: Literal["single", "groups", "clips"], *numbers: int) -> str:
    """Name of a tensor of `LatentStore`: "single", "groups" of a stride and phase (of the first frame, modulo 4 x stride), or the
    longest of the "clips" of a stride and start."""
    return "/".join([episode_id, kind, *map(str, numbers)])


class LatentStore(ClipSource):
    """A Latents artifact: safetensors shards, read by memory mapping, beside an index of the episodes.

    A causal tokenizer treats the first frame of a clip specially, so a clip's latents depend on where it starts. Two layouts
    keep every clip exact:

    - ``groups`` (later latent frames depend on their own four frames alone): a single-frame latent of every start, and for
      every stride and phase the latents of the groups of four frames that follow;
    - ``clips`` (a longer memory): for every stride and start the whole remaining clip, or ``clip_frames`` frames of it.
    """

    def __init__(self, root: Path, description: dict[str, Any], rows: Sequence[ClipRow]) -> None:
        super().__init__(rows)
        self.root, self.description = root, description
        self.start_step = description["start_step"]
        self.latent_shape = tuple(description["latent_shape"])
        self.image_size = tuple(description["image_size"])
        self.clip_frames = description["clip_frames"]
        self._shards: dict[str, Any] = {}

    @classmethod
    def open(cls, root: Path) -> LatentStore:
        """Open a finished Latents folder. Raises: ArtifactError: it is none."""
        try:
            rows = [ClipRow(**{**row, "views": tuple(row["views"])}) for row in read_rows(root / INDEX)]
            return cls(root, read_json(root / DESCRIPTION), rows)
        except (TypeError, KeyError) as error:
            raise ArtifactError(
                "This folder is not a Latents artifact.", where=root, expected=f"{DESCRIPTION} and {INDEX} of encode_latents",
                got=repr(error), next_step="run the encode_latents step first",
            ) from error  # fmt: skip

    def __getstate__(self) -> dict[str, Any]:
        # Open shards stay in the process that opened them.
        return {**self.__dict__, "_shards": {}}

    @property
    def stored_bytes(self) -> int:
        return sum(path.stat().st_size for path in self.root.glob("*.safetensors"))

    def read(self, clip: Clip, views: tuple[str, ...]) -> Float[Tensor, "v c t h w"]:
        """Latents of one clip (float32), views in the given order."""
        selected = self._stored_views(clip, views)
        with self._shard(self.row(clip.episode_id).shard) as shard:
            frames = [shard.get_slice(name)[:, :, first:stop] for name, first, stop in self._parts(clip)]
        return torch.cat(frames, dim=2)[selected].float()

    def _parts(self, clip: Clip) -> list[tuple[str, int, int]]:
        """Tensors that a clip's latent frames are in, in order: (name, first latent frame, stop)."""
        frames = len(latent_frame_indices(clip.num_frames))
        if self.description["layout"] == "clips":
            return [(latent_key(clip.episode_id, "clips", clip.stride, clip.start), 0, frames)]
        index = clip.start // self.start_step
        single = (latent_key(clip.episode_id, "single"), index, index + 1)
        if frames == 1:
            return [single]
        offset, phase = divmod(clip.start + clip.stride, TEMPORAL_FACTOR * clip.stride)
        return [single, (latent_key(clip.episode_id, "groups", clip.stride, phase), offset, offset + frames - 1)]

    def _stored_views(self, clip: Clip, views: tuple[str, ...]) -> list[int]:
        """Numbers of a clip's views among those that are stored; raises as `read` does."""
        row = self.row(clip.episode_id)
        most = self.clip_frames or row.num_frames
        fits = clip.start >= 0 and clip.num_frames <= min(longest_clip(row.num_frames, clip.start, clip.stride), most)
        strides = self.description["strides"]
        if clip.stride not in strides or not fits or clip.start % self.start_step or not {*views} <= {*row.views}:
            held = (
                f"strides {strides}, a start divisible by {self.start_step}, at most {most} of {row.num_frames} frames"
            )
            raise ArtifactError(
                "The latents do not hold this clip.", where=self.root, expected=f"{held}, views {row.views}",
                got=f"{clip}, views {views}", next_step="encode the latents with these settings, or ask for other clips",
            )  # fmt: skip
        return [row.views.index(view) for view in views]

    @contextmanager
    def _shard(self, name: str) -> Iterator[Any]:
        """An open safetensors file; it stays open."""
        path = self.root / name
        try:
            if path.name not in self._shards:
                self._shards[path.name] = safe_open(path, framework="pt")
            yield self._shards[path.name]
        except (OSError, SafetensorError) as error:
            raise ArtifactError(
                "A latent shard cannot be read.", where=path, got=error, next_step="encode the latents again"
            ) from error


class ResidentLatents(LatentStore):
    """All latents of a store on one device in half precision, frame by frame and view by view: a batch is one gather there."""

    resident = True

    def __init__(self, store: LatentStore, device: str) -> None:
        super().__init__(store.root, store.description, store.rows)
        # A shard's header takes a few places, too.
        places = self.stored_bytes // (2 * math.prod(self.latent_shape))
        self._frames = torch.empty(places, *self.latent_shape, dtype=torch.float16, device=device)
        self._first: dict[str, tuple[int, int]] = {}
        """Place of each tensor's first frame, and its number of frames."""
        place = 0
        for file in with_progress(sorted({row.shard for row in self.rows}), "reading latents", "shard"):
            with self._shard(file) as shard:
                for name in shard.keys():  # noqa: SIM118
                    latents = shard.get_tensor(name).to(device)
                    frames = rearrange(latents, "v c t h w -> (v t) c h w")
                    self._first[name] = place, latents.shape[2]
                    self._frames[place : place + len(frames)] = frames
                    place += len(frames)
        self._shards.clear()

    def read_batch(self, batch: ClipBatch) -> Float[Tensor, "b v c t h w"]:
        selected = np.array(list(map(self._stored_views, batch.clips, self.recorded_views(batch))))
        parts = [self._parts(clip) for clip in batch.clips]
        lengths = [stop - first for _, first, stop in parts[0]]
        found = np.array([[self._place(*part) for part in own] for own in parts])
        place, count = rearrange(found, "b parts two -> two b 1 parts")
        first = place + count * selected[..., None]
        places = first.repeat(lengths, axis=-1) + np.concatenate([np.arange(length) for length in lengths])
        channels, *grid = self.latent_shape
        images = rearrange(on_device(places, self._frames.device) * channels, "b v t -> b v 1 t")
        images = images + rearrange(torch.arange(channels, device=images.device), "c -> c 1")
        return self._frames.flatten(0, 1).index_select(0, images.flatten()).float().view(*images.shape, *grid)

    def _place(self, name: str, first: int, stop: int) -> tuple[int, int]:
        """Place of the wanted frame in a tensor's first view, and how many frames a view has."""
        place, frames = self._first.get(name, (0, 0))
        if stop > frames:  # the next frames in memory are another episode's
            raise ArtifactError(
                "The latents lack frames of this clip.", where=f"{self.root}, {name}", expected=f"{stop} latent frames",
                got=frames, next_step="encode the latents again",
            )  # fmt: skip
        return place + first, frames


class FrameSource(ClipSource):
    """Frames of an EpisodeSet, decoded and encoded when they are needed.

    Raises: CheckpointError: the folder holds no tokenizer. ConfigError: it does not take pictures of this size.
    """

    def __init__(self, episodes: EpisodeSet, tokenizer: Path, config: FrameInput, device: str = "cpu") -> None:
        super().__init__([ClipRow.from_episode(row, row.views) for row in episodes.rows])
        self._tokenizer: VideoTokenizer | None = load_tokenizer(tokenizer, device)
        space = self._tokenizer.spatial_compression
        height, width = self.image_size = config.image_size
        if height % space or width % space:
            raise ConfigError(
                "The tokenizer cannot code images of this size", where="input.image_size", expected=f"multiples of {space}",
                got=f"{height}x{width}",
            )  # fmt: skip
        self.root, self.episodes, self.start_step = episodes.root, episodes, config.start_step
        self.latent_shape = (self._tokenizer.latent_channels, height // space, width // space)
        self.decoder = FrameDecoder()
        self.description = {"tokenizer": tokenizer_fingerprint(self._tokenizer, tokenizer)}
        self.facts = {"input": {"kind": config.kind, "decoder": FrameDecoder.name}}

    def __getstate__(self) -> dict[str, Any]:
        # Loader processes read frames: they open files themselves and have no use for the tokenizer.
        return {**self.__dict__, "episodes": EpisodeSet(self.root, self.episodes.rows), "_tokenizer": None}

    def read(self, clip: Clip, views: tuple[str, ...]) -> UInt8[Tensor, "v n h w 3"]:
        """The clip's frames at the training size, RGB."""
        position = self.episodes.position(clip.episode_id)
        frames = np.empty((len(views), clip.num_frames, *self.image_size, 3), np.uint8)
        for pictures, view in zip(frames, views, strict=True):
            try:
                video = self.episodes.clip(position, view)
                for target, picture in zip(pictures, self.decoder.frames(video, clip.frames), strict=True):
                    resize_frame(picture, self.image_size, out=target)
            except DataError as error:
                raise DataError(
                    f"A clip cannot be read: {error.what}", where=f"{clip}, view {view}, in {error.where}",
                    expected=error.expected, got=error.got, next_step="repair or drop the episode",
                ) from error  # fmt: skip
        return torch.from_numpy(frames)

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


def load_views(
    episodes: EpisodeSet, positions: Sequence[int], image_size: tuple[int, int], minimum: int
) -> list[tuple[str, UInt8[Tensor, "3 n h w"]]]:
    """All views, named episode/view, of those episodes with ``minimum`` frames or more. Raises: DataError: there is none."""
    views = [
        (f"{row.episode_id}/{view}", resized_video(VideoFrames(episodes.clip(position, view)), image_size))
        for position in with_progress(positions, "reading episodes", "episode")
        if (row := episodes.rows[position]).video_frames >= minimum
        for view in row.views
    ]
    if not views:
        raise DataError("No episode is long enough to train on", where=episodes.root, expected=f">= {minimum} frames")
    return views


def training_rows(
    source: ClipSource,
    episodes: EpisodeSet,
    *,
    stage: Literal[1, 2],
    views: Sequence[str] = (),
    tracks: ActionTracks | None = None,
    vectors: bool = False,
    outcomes: Sequence[str] | None = None,
) -> list[ClipRow]:
    """Rows of the source whose episode is fit for the stage and ended in one of ``outcomes``.

    Stage I needs the task-facing view. Stage II needs controls and one of ``views``; without ``vectors`` (the model knows control
    vectors) one with a camera, and its clips show no others.

    Raises: DataError: none is left.
    """
    held = {row.episode_id: row for row in source.rows}
    rows, left_out = list[ClipRow](), Counter[str]()
    for episode in episodes.rows:
        row, controlled = held.get(episode.episode_id), tracks is None or episode.episode_id in tracks
        known = None if vectors or tracks is None or not controlled else tracks.calibrated_views(episode.episode_id)
        shown = tuple(view for view in (row.views if row else ()) if known is None or view in known)
        without_camera = vectors and episode.stage2_reason == "missing_calibration"
        fit = episode.stage1_ok if stage == 1 else episode.stage2_ok or without_camera
        wanted = {episode.primary_view} if stage == 1 else {*views}
        if outcomes is not None and episode.outcome not in outcomes:
            left_out[f"outcome {episode.outcome}"] += 1
        elif not fit:
            left_out[(stage == 2 and episode.stage2_reason) or f"not fit for Stage {stage}"] += 1
        elif row is None:
            left_out[f"split {episode.split}: not among the clips"] += 1
        elif not controlled:
            left_out["no controls"] += 1
        elif wanted.isdisjoint(shown):
            left_out["none of the views"] += 1
        else:
            rows.append(replace(row, views=shown))
            left_out[_VIEWS_LEFT_OUT] += shown != row.views
    reasons = ", ".join(f"{reason} {count}" for reason, count in left_out.most_common() if count)
    if not rows:
        raise DataError(
            "No episode is left to train on.", where=f"stage {stage}, one of the views {', '.join(views) or 'that are task-facing'}",
            expected="episodes that are in the EpisodeSet, the source of clips and (Stage II) the action tracks",
            got=reasons or "an empty EpisodeSet",
            next_step="docs/filters.md says what each reason asks for; other episodes are in the quarantine tables of earlier steps",
        )  # fmt: skip
    if reasons:
        level = logging.WARNING if left_out["no controls"] or left_out[_VIEWS_LEFT_OUT] else logging.INFO
        counts = stage, len(rows), len(episodes), reasons
        logger.log(level, "Stage %d: clips of %d of %d episodes; left out: %s.", *counts)
    return rows


def open_source(reading: ClipInput, inputs: Mapping[str, Path], episodes: EpisodeSet, device: str) -> ClipSource:
    """The configured source of ``latents``, or of frames that ``tokenizer`` encodes. Raises: ConfigError: it is not given."""
    needed = "tokenizer" if isinstance(reading, FrameInput) else "latents"
    if needed not in inputs:
        raise ConfigError(
            f"Clips from {reading.kind} need the input {needed}.", where="input.kind", got=", ".join(sorted(inputs)),
            next_step=f"give --input {needed}=FOLDER, or choose the other kind of input",
        )  # fmt: skip
    if isinstance(reading, FrameInput):
        return FrameSource(episodes, Path(inputs["tokenizer"]), reading, device)
    store = LatentStore.open(Path(inputs["latents"]))
    return ResidentLatents(store, device) if reading.resident else store
