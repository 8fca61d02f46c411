"""Batches of clips, from the number of a micro-step to tensors.

A `torch.utils.data.DataLoader` reads clips, ahead of training where there are workers; `ClipLoader` turns what was read into
latents and adds action maps and text ids.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from itertools import count
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from worldline_core.actions.action_maps import ControlDrawing, control_frames
from worldline_core.actions.actions_config import TEMPORAL_FACTOR
from worldline_core.actions.episode_tracks import ActionTracks, EpisodeTracks, collate_tracks, drawn_size
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import ConfigError, DataError, TrainingError, WorldLineError
from worldline_core.model.text import ClipFacts, TextEncoder
from worldline_core.store.artifact_files import read_json_lines
from worldline_core.store.atomic import write_bytes_atomic
from worldline_core.training.clip_config import ReadingConfig
from worldline_core.training.clip_sampler import Clip, ClipBatch, ClipSampler
from worldline_core.training.clip_source import ClipSource, ResidentLatents, ResidentTracks
from worldline_core.training.processes import processes

logger = logging.getLogger(__name__)

START_METHOD = "spawn"
"""Start method of loader processes: forked ones would share the threads and CUDA state of this one."""
_ATTEMPTS = 20
MOST_SKIPPED = 100
"""Unreadable clips of one process after which a run that skips them stops."""


class ReadBatch(NamedTuple):
    """Clips as read, (b, v, ...) as the source gives them, and the errors of those that were replaced."""

    batch: ClipBatch
    data: Tensor
    errors: Sequence[str] = ()


@dataclass(frozen=True)
class ClipDataset(Dataset[ReadBatch | WorldLineError]):
    """The clips of every micro-step. An error is an item like any other: it reaches the training process as it is."""

    source: ClipSource
    sampler: ClipSampler
    skip: bool = False

    def __getitem__(self, index: int) -> ReadBatch | WorldLineError:
        try:
            return self._read(index)
        except WorldLineError as error:
            return error

    def _read(self, index: int) -> ReadBatch:
        """What cannot be read is replaced by the clip at its place in the next draw."""
        read: dict[int, tuple[Clip, Tensor]] = {}
        errors: list[str] = []
        for attempt in range(_ATTEMPTS):
            batch = self.sampler.clips(index, attempt)
            for place in set(range(len(batch.clips))) - read.keys():
                clip = batch.clips[place]
                try:
                    read[place] = clip, self.source.read(clip, recorded_views(self.source, batch, clip))
                except DataError as error:
                    if not self.skip:
                        raise
                    errors.append(str(error))
            if len(read) == len(batch.clips):
                clips, data = zip(*(read[place] for place in sorted(read)), strict=True)
                return ReadBatch(replace(batch, clips=clips), torch.stack(data), errors)
        raise DataError(
            "No readable clip was found.",
            where=f"micro-step {index}",
            expected=f"one of {_ATTEMPTS} clips that can be read",
            got=errors[-1],
            next_step="run filter on this EpisodeSet again; its videos may have been damaged since",
        )


def recorded_views(source: ClipSource, batch: ClipBatch, clip: Clip) -> tuple[str, ...]:
    """The recorded views that fill a clip's slots: the task-facing one has a name of its own."""
    return (source.row(clip.episode_id).primary_view,) if batch.primary else batch.views


def read_ahead(
    dataset: ClipDataset, first: int, workers: int, *, pinned: bool = False
) -> Iterator[ReadBatch | WorldLineError]:
    """The items of a dataset from ``first`` on, in order, read ahead by so many processes.

    Args:
        pinned: in page-locked memory, which a GPU reads at full speed.
    """
    loader = DataLoader(
        dataset,
        batch_size=None,
        sampler=count(first),
        num_workers=workers,
        multiprocessing_context=START_METHOD if workers else None,
        worker_init_fn=_start_worker,
        pin_memory=pinned,
        generator=torch.Generator(),  # its own: training's random state stays as it is
    )
    return iter(loader)


def _start_worker(_: int) -> None:
    cv2.setNumThreads(1)


def _record_skipped(run: Path, index: int, errors: Sequence[str]) -> None:
    """Write down what a micro-step skipped; a step that is done again after a kill adds nothing.

    Raises:
        DataError: too many clips have been skipped.
    """
    path = run / f"skipped_clips-{processes()[0]}.jsonl"
    rows = read_json_lines(path)
    for row in ({"index": index, "reason": error} for error in errors):
        if row not in rows:
            logger.warning("Clip skipped: %s", row["reason"])
            rows.append(row)
    write_bytes_atomic(path, "".join(f"{json.dumps(row)}\n" for row in rows).encode())
    if len(rows) > MOST_SKIPPED:
        raise DataError(
            "Too many clips cannot be read.",
            where=path,
            expected=f"at most {MOST_SKIPPED}",
            got=len(rows),
            next_step="the reasons are in this file; run filter again",
        )


@dataclass(frozen=True)
class Batch:
    """One micro-batch. Outcome labels are not here on purpose: they never reach the model.

    ``text_ids``: token ids of the texts, or their embeddings.
    ``fps``: frames per second of each clip as it is shown (a stride lowers the rate); None where no rates are known.
    ``frames``: where clips are read as frames, those that the latents are of.
    ``weights``: of the squared error, where some places count more than others (what the task moves).
    """

    clips: tuple[Clip, ...]
    views: tuple[str, ...]
    latents: Float[Tensor, "b v c t h w"]
    action_maps: Float[Tensor, "b v a t #h #w"] | None = None
    text_ids: Int[Tensor, "b n"] | Float[Tensor, "b n s"] | None = None
    text_mask: Bool[Tensor, "b n"] | None = None
    frames: UInt8[Tensor, "b v frames height width 3"] | None = None
    fps: Float[Tensor, " b"] | None = None
    weights: Float[Tensor, "b v 1 t h w"] | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """The episodes, for error messages."""
        return tuple(clip.episode_id for clip in self.clips)


@dataclass
class ClipLoader:
    """Turns clips into batches.

    Attributes:
        source: where clips are read from. With resident latents, action tracks are resident, too.
        views: the model's slots.
        tracks: controls; the maps get the width that the tracks were made for.
        text: turns instructions into ids; its prompts may name a clip's duration and size.
        frame_rates: frame rate of each episode [1/s]; needed with ``text``, and for temporal positions by each clip's own
            rate.
        action_frames: control frames that a latent frame takes.
        native_size: of the control vectors of a model that takes these.
        maps: the model takes maps.
        object_weights: loss weights of clips; None: all places count alike.
    """

    source: ClipSource
    _: KW_ONLY
    views: tuple[str, ...]
    tracks: ActionTracks | None = None
    text: TextEncoder | None = None
    frame_rates: Mapping[str, float] = field(default_factory=dict)
    action_frames: int = 1
    native_size: int | None = None
    maps: bool = True
    object_weights: ObjectWeights | None = None
    device: str = "cpu"

    def __post_init__(self) -> None:
        self._tracks: dict[str, EpisodeTracks] = {}
        self._resident: ResidentTracks | None = None
        if isinstance(self.source, ResidentLatents) and self.tracks:
            names = [row.episode_id for row in self.source.rows if row.episode_id in self.tracks]
            self._resident = ResidentTracks(self.tracks, names, self.views, self.device, self.native_size)

    def batches(self, sampler: ClipSampler, reading: ReadingConfig, run: Path | None = None) -> Callable[[int], Batch]:
        """A function that gives the batch of a micro-step, read ahead by the configured workers.

        Asked for in order, batches are there already; any other order starts reading anew. The function raises DataError
        and ArtifactError for clips that cannot be read, and TrainingError where a loader process has ended.

        Args:
            run: folder in which skipped clips are written down.

        Raises:
            ConfigError: the source has no clips of this length.
        """
        self.source.require_length(sampler.longest, "clips.lengths")
        dataset = ClipDataset(self.source, sampler, reading.on_unreadable == "skip")
        pinned = torch.device(self.device).type == "cuda" and not isinstance(self.source, ResidentLatents)
        ahead: tuple[int, Iterator[ReadBatch | WorldLineError]] | None = None

        def load(index: int) -> Batch:
            nonlocal ahead
            if ahead is None or ahead[0] != index:
                ahead = (index, read_ahead(dataset, index, reading.workers, pinned=pinned))
            batches, ahead = ahead[1], None  # after an error nothing holds the loader processes
            try:
                read = next(batches)
            except RuntimeError as error:
                raise TrainingError(
                    "A loader process has ended.",
                    where=f"micro-step {index}: {'; '.join(map(str, sampler.clips(index).clips))}",
                    expected="clips",
                    got=error,
                    next_step="see its traceback above; if memory ran out, lower input.workers or the batch",
                ) from error
            if isinstance(read, WorldLineError):
                del batches
                raise read
            ahead = (index + 1, batches)
            if read.errors and run is not None:
                _record_skipped(run, index, read.errors)
            return self._finish(read.batch, read.data)

        return load

    def load(self, batch: ClipBatch) -> Batch:
        """Read the clips of one batch in this process, and finish it.

        Raises:
            ArtifactError: the source or the tracks lack an episode.
            DataError: a clip is damaged.
        """
        read = [self.source.read(clip, recorded_views(self.source, batch, clip)) for clip in batch.clips]
        return self._finish(batch, torch.stack(read))

    def _finish(self, batch: ClipBatch, read: Tensor) -> Batch:
        frames = read if read.dtype == torch.uint8 else None
        return self.conditioned(batch, self.source.latents(read, self.device), frames)

    def conditioned(self, batch: ClipBatch, latents: Tensor, frames: Tensor | None = None) -> Batch:
        """Latents of a batch's clips, with the conditions that this loader adds. Raises: ArtifactError: the tracks lack an episode."""
        clips, views = batch.clips, batch.views
        maps = None if self.tracks is None else self.action_maps(clips, views)
        ids = mask = None
        if self.text is not None:
            facts = [self.clip_facts(clip) for clip in clips]
            ids, mask = self.text([self.source.row(clip.episode_id).instruction for clip in clips], facts)
            ids, mask = ids.to(self.device), mask.to(self.device)
        rates = [self._rate(clip) for clip in clips] if self.frame_rates else None
        fps = None if rates is None else torch.tensor(rates, device=self.device)
        weights = None
        if self.object_weights is not None:
            recorded = [recorded_views(self.source, batch, clip) for clip in clips]
            weights = self.object_weights(clips, recorded).to(self.device)
        return Batch(clips, views, latents, maps, ids, mask, frames, fps, weights)

    def clip_facts(self, clip: Clip) -> ClipFacts:
        """Facts that a prompt may state about a clip; a stride lowers its rate."""
        return ClipFacts(clip.num_frames, self._rate(clip), self.source.image_size)

    def _rate(self, clip: Clip) -> float:
        return self.frame_rates[clip.episode_id] / clip.stride

    def action_maps(self, clips: tuple[Clip, ...], views: tuple[str, ...]) -> Float[Tensor, "b v a t h w"]:
        """Controls that each latent frame takes (docs/method.md section 2): in each view the map at latent resolution, or the vector."""
        if self.tracks is None:
            raise ConfigError("Action maps need action tracks", where="ClipLoader")
        if self._resident is not None:
            samples, image_size = self._resident.batch(clips, self.action_frames, views), self._resident.image_size
        else:
            cut = [self._clip_tracks(self.tracks, clip) for clip in clips]
            samples, image_size = collate_tracks(cut, views, self.native_size).to(self.device), drawn_size(cut)
        sigma = self.tracks.sigma_px_ref if self.maps else None
        drawing = ControlDrawing(self.source.latent_shape[1:], sigma, self.native_size, self.action_frames)
        by_vector = torch.tensor([[view in clip.vectors for view in views] for clip in clips], device=self.device)
        return drawing.draw(samples, image_size, by_vector)

    def _clip_tracks(self, tracks: ActionTracks, clip: Clip) -> EpisodeTracks:
        if clip.episode_id not in self._tracks:
            self._tracks[clip.episode_id] = tracks.tracks(clip.episode_id)
        frames = [clip.frames[index] for index in control_frames(clip.num_frames, self.action_frames)]
        return self._tracks[clip.episode_id].clip(frames)


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
            np.stack([self._latent_shares(self._frame_shares(clip.episode_id, view), clip) for view in names])
            for clip, names in zip(clips, views, strict=True)
        ]
        return object_weights(torch.from_numpy(np.stack(stacked)).float() / 255, self._moved, self._others)

    def _latent_shares(self, frames: np.ndarray, clip: Clip) -> np.ndarray:
        """uint8 (2, t, h, w): a latent frame covers four frames, and takes the largest share of them."""
        shown = frames[:, list(clip.frames)]
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
