"""One batch, from the number of its micro-step to tensors.

`ClipReader` asks the sampler which clips they are and reads them into one array (in this process, or in the processes of
a `ClipPrefetcher`); `ClipLoader` turns the array into latents and adds action maps and text ids.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from worldline_core.actions.action_maps import control_frames, render_action_maps, stack_controls
from worldline_core.actions.actions_config import WristProjection
from worldline_core.actions.episode_tracks import ActionTracks, EpisodeTracks, collate_tracks
from worldline_core.errors import ArtifactError, ConfigError, DataError
from worldline_core.model.action_branch import native_vectors
from worldline_core.model.text import ClipFacts, TextEncoder
from worldline_core.store.artifact_files import read_json_lines
from worldline_core.store.atomic import write_bytes_atomic
from worldline_core.training.clip_config import ReadingConfig
from worldline_core.training.clip_sampler import ClipSampler
from worldline_core.training.clip_source import Clip, ClipBatch, ClipSource

logger = logging.getLogger(__name__)

_ATTEMPTS = 20


@dataclass(frozen=True)
class SkippedClip:
    """A clip of micro-step ``index`` that could not be read, and why."""

    index: int
    clip: Clip
    reason: str


@dataclass(frozen=True)
class ReadBatch:
    """Clips as read: ``data`` is (b, v, ...) as the source gives it, valid until the next batch is read.

    ``batch`` names the clips that are in it, replacements included; ``skipped`` those that were replaced.
    """

    batch: ClipBatch
    data: Tensor
    skipped: tuple[SkippedClip, ...] = ()


class ClipReader:
    """Reads the clips of micro-steps in this process. Pickled into loader processes, it opens its files there.

    Args:
        views: the model's view slots.
        config: what to do with a clip that cannot be read.
    """

    def __init__(
        self, source: ClipSource, sampler: ClipSampler, views: tuple[str, ...], config: ReadingConfig | None = None
    ) -> None:
        self.source = source
        self.sampler = sampler
        self.views = views
        self.config = ReadingConfig() if config is None else config

    @property
    def max_bytes(self) -> int:
        """Size of the largest batch."""
        clip = int(np.prod(self.source.shape(self.sampler.longest))) * self.source.dtype.itemsize
        return clip * max(size * len(ClipBatch((), view).slots(self.views)) for view, size in self.sampler.batch_kinds)

    def read(self, index: int, memory: np.ndarray | None = None) -> ReadBatch:
        """The clips of micro-step ``index``.

        Args:
            memory: uint8, `max_bytes` long, that the batch is read into; None for memory of its own.

        Raises:
            DataError: a clip cannot be read and is not to be skipped, or nothing readable can be found for it.
            ArtifactError: the source does not hold what is asked of it.
        """
        wanted = self.sampler.clips(index)
        out = self.source.batch_array(wanted, self.views, memory)
        clips: list[Clip] = []
        skipped: list[SkippedClip] = []
        for place, clip in enumerate(wanted.clips):
            for attempt in range(_ATTEMPTS):
                try:
                    self.source.read(clip, self.source.recorded_views(clip, wanted, self.views), out[place])
                except DataError as error:
                    if self.config.on_unreadable == "raise":
                        raise
                    skipped.append(SkippedClip(index, clip, str(error)))
                    clip = self.sampler.replacement(index, place, attempt)
                else:
                    clips.append(clip)
                    break
            else:
                raise DataError(
                    "No readable clip was found.",
                    where=f"micro-step {index}, clip {place}",
                    expected=f"one of {_ATTEMPTS} clips that can be read",
                    got=skipped[-1].reason,
                    next_step="run filter on this EpisodeSet again; its videos may have been damaged since",
                )
        return ReadBatch(ClipBatch(tuple(clips), wanted.view, wanted.absent), torch.from_numpy(out), tuple(skipped))


class SkipLog:
    """Counts the clips that a run skipped, in a file beside its training state: a continued run goes on counting.

    What was skipped is a function of the micro-step, so a step that is done again after a kill adds nothing.
    """

    def __init__(self, folder: Path, rank: int, limit: int) -> None:
        self.path = folder / f"skipped_clips-{rank}.jsonl"
        self.limit = limit
        self._rows = read_json_lines(self.path)

    def add(self, skipped: Sequence[SkippedClip]) -> None:
        """Write down what was skipped.

        Raises:
            DataError: more than ``limit`` clips have been skipped.
        """
        for item in skipped:
            row = {"index": item.index, "clip": str(item.clip), "reason": item.reason}
            if row not in self._rows:
                logger.warning("Clip skipped: %s", item.reason)
                self._rows.append(row)
                write_bytes_atomic(self.path, "".join(f"{json.dumps(row)}\n" for row in self._rows).encode())
        if len(self._rows) > self.limit:
            raise DataError(
                "Too many clips cannot be read.",
                where=self.path,
                expected=f"at most {self.limit} (input.max_skipped)",
                got=len(self._rows),
                next_step="the reasons are in this file; run filter again, or raise the limit",
            )

    @staticmethod
    def count(folder: Path) -> int:
        """How many clips all processes have skipped."""
        return sum(len(read_json_lines(path)) for path in folder.glob("skipped_clips-*.jsonl"))


@dataclass(frozen=True)
class Batch:
    """One micro-batch. Outcome labels are not here on purpose: they never reach the model.

    ``fps``: frames per second of each clip as it is shown (a stride lowers the rate); None where no rates are known.
    ``frames``: where clips are read as frames, those that the latents are of, valid until the next batch is read.
    ``weights``: of the squared error, where some places count more than others (what the task moves).
    """

    clips: tuple[Clip, ...]
    views: tuple[str, ...]
    latents: Float[Tensor, "b v c t h w"]
    action_maps: Float[Tensor, "b v a t #h #w"] | None = None
    text_ids: Int[Tensor, "b n"] | None = None
    text_mask: Bool[Tensor, "b n"] | None = None
    frames: UInt8[Tensor, "b v frames height width 3"] | None = None
    fps: Float[Tensor, " b"] | None = None
    weights: Float[Tensor, "b v 1 t h w"] | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """The episodes, for error messages."""
        return tuple(clip.episode_id for clip in self.clips)


class ClipLoader:
    """Turns clips into batches.

    Args:
        store: where clips are read from.
        text: turns instructions into ids; its prompts may name a clip's duration and size.
        tracks: controls; the maps get the width that the tracks were made for.
        wrist_projection: how maps of wrist views are projected; needed with ``tracks``.
        native_size: of the control vectors that are given instead of maps, where the model takes these.
        action_frames: control frames whose maps a latent frame takes.
        frame_rates: frame rate of each episode [1/s]; needed with ``text``, and for temporal positions by each clip's own
            rate.
    """

    def __init__(
        self,
        store: ClipSource,
        *,
        views: tuple[str, ...],
        tracks: ActionTracks | None = None,
        text: TextEncoder | None = None,
        frame_rates: Mapping[str, float] | None = None,
        wrist_projection: WristProjection | None = None,
        native_size: int | None = None,
        action_frames: int = 1,
        device: str = "cpu",
    ) -> None:
        self.store = store
        self.views = views
        self.tracks = tracks
        self.text = text
        self.frame_rates = frame_rates or {}
        self.wrist_projection: WristProjection | None = wrist_projection
        self.native_size = native_size
        self.action_frames = action_frames
        self.device = device
        self._tracks: dict[str, EpisodeTracks] = {}

    def load(self, batch: ClipBatch) -> Batch:
        """Read the clips of one batch in this process, and finish it.

        Raises:
            ArtifactError: if the store or the tracks lack an episode.
            DataError: if a clip is damaged, or cached latents are not finite.
        """
        out = self.store.batch_array(batch, self.views)
        for clip, target in zip(batch.clips, out, strict=True):
            self.store.read(clip, self.store.recorded_views(clip, batch, self.views), target)
        return self.finish(ReadBatch(batch, torch.from_numpy(out)))

    def finish(self, read: ReadBatch) -> Batch:
        """What a model sees of clips that were read, here or in a loader process.

        Raises:
            ArtifactError: if the tracks lack an episode.
        """
        frames = read.data if read.data.dtype == torch.uint8 else None
        return self.conditioned(read.batch, self.store.latents(read.data, self.device), frames)

    def conditioned(self, batch: ClipBatch, latents: Tensor, frames: Tensor | None = None) -> Batch:
        """Latents of a batch's clips, with the conditions that this loader adds; raises as `finish` does."""
        clips, views = batch.clips, batch.slots(self.views)
        maps = None if self.tracks is None else self.action_maps(clips, views)
        ids = mask = None
        if self.text is not None:
            facts = [self.clip_facts(clip) for clip in clips]
            ids, mask = self.text([self.store.row(clip.episode_id).instruction for clip in clips], facts)
            ids, mask = ids.to(self.device), mask.to(self.device)
        rates = [self._rate(clip) for clip in clips] if self.frame_rates else None
        fps = None if rates is None else torch.tensor(rates, device=self.device)
        return Batch(clips, views, latents, maps, ids, mask, frames, fps)

    def clip_facts(self, clip: Clip) -> ClipFacts:
        """What a prompt may say about a clip; a stride lowers its rate."""
        return ClipFacts(clip.num_frames, self._rate(clip), self.store.image_size)

    def _rate(self, clip: Clip) -> float:
        rate = self.frame_rates.get(clip.episode_id)
        if rate is None:
            raise ArtifactError("The frame rate of an episode is not known.", where=clip.episode_id)
        return rate / clip.stride

    def action_maps(self, clips: tuple[Clip, ...], views: tuple[str, ...]) -> Float[Tensor, "b v a t h w"]:
        """Maps at latent resolution (or vectors) of the controls that each latent frame takes (docs/method.md section 2)."""
        if self.tracks is None or self.wrist_projection is None:
            raise ConfigError("Action maps need action tracks and how wrist views are projected", where="ClipLoader")
        cut = []
        for clip in clips:
            frames = [clip.frames[index] for index in control_frames(clip.num_frames, self.action_frames)]
            if clip.episode_id not in self._tracks:
                self._tracks[clip.episode_id] = self.tracks.tracks(clip.episode_id)
            tracks = self._tracks[clip.episode_id]
            cut.append(tracks.clip(frames, wrist_projection=self.wrist_projection, start=clip.start))
        if self.native_size is not None:
            return native_vectors(cut, views, self.native_size).to(self.device)
        tensors = collate_tracks(cut, views=views).to(self.device)
        grid_size = self.store.latent_shape[1:]
        maps = render_action_maps(tensors, cut[0].image_size, grid_size, sigma_px_ref=self.tracks.sigma_px_ref)
        return stack_controls(maps, self.action_frames)
