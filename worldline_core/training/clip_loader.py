"""Batches of clips, from the number of a micro-step to tensors: a `torch.utils.data.DataLoader` reads clips ahead of training, and
`ClipLoader` turns what was read into latents and adds action maps and text ids.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from itertools import count

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor
from torch.utils.data import DataLoader

from worldline_core.actions.action_maps import ControlDrawing, control_frames
from worldline_core.actions.episode_tracks import ActionTracks, collate_tracks, drawn_size
from worldline_core.errors import TrainingError, WorldLineError
from worldline_core.model.text import ClipFacts, TextEncoder
from worldline_core.training.clip_sampler import Clip, ClipBatch, ClipSampler
from worldline_core.training.clip_source import ClipSource
from worldline_core.training.resident import ResidentTracks, frame_numbers, on_device

START_METHOD = "spawn"
"""Start method of loader processes: forked ones would share the threads and CUDA state of this one."""


def read_ahead(
    source: ClipSource, batches: Iterable[ClipBatch], workers: int, *, pinned: bool = False
) -> Iterator[Tensor | WorldLineError]:
    """Read batches in order, ahead of time, in ``workers`` processes; ``pinned``: into memory that a GPU reads at full speed."""
    loader = DataLoader(
        source,
        batch_size=None,
        sampler=batches,
        num_workers=workers,
        multiprocessing_context=START_METHOD,
        worker_init_fn=_start_worker,
        pin_memory=pinned,
        generator=torch.Generator(),  # its own: training's random state stays as it is
    )
    return iter(loader)


def _start_worker(_: int) -> None:
    cv2.setNumThreads(1)


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
        tracks: controls; the maps get the width that the tracks were made for.
        text: turns instructions into ids; its prompts may name a clip's duration and size.
        frame_rates: of each episode [1/s]; needed with ``text``, and for temporal positions by each clip's own rate.
        action_frames: control frames that a latent frame takes.
        native_size: of the control vectors of a model that takes these.
        object_weights: loss weights of clips, given their recorded views; None: all places count alike.
    """

    source: ClipSource
    views: tuple[str, ...]
    tracks: ActionTracks | None = None
    text: TextEncoder | None = None
    frame_rates: Mapping[str, float] = field(default_factory=dict)
    action_frames: int = 1
    native_size: int | None = None
    maps: bool = True
    object_weights: Callable[[Sequence[Clip], Sequence[Sequence[str]]], Tensor] | None = None
    device: str = "cpu"

    def __post_init__(self) -> None:
        self._tracks = None if self.tracks is None else cache(self.tracks.tracks)
        self._resident: ResidentTracks | None = None
        if self.source.resident and self.tracks:
            rows = [row for row in self.source.rows if row.episode_id in self.tracks]
            self._resident = ResidentTracks(self.tracks, rows, self.views, self.device, self.native_size)

    def batches(self, sampler: ClipSampler, workers: int = 0) -> Callable[[int], Batch]:
        """Returns a function from the number of a micro-step to its batch. It raises as `load`, and TrainingError where one of the
        ``workers``, processes that read ahead, has ended. Another order than the numbers' own starts reading anew.

        Raises: ConfigError: the source has no clips of this length.
        """
        self.source.require_length(sampler.longest, "clips.lengths")
        if self.source.resident or not workers:
            return lambda index: self.load(sampler.clips(index))
        pinned = torch.device(self.device).type == "cuda"
        ahead: dict[int, Iterator[Tensor | WorldLineError]] = {}  # by the micro-step whose clips come next

        def load(index: int) -> Batch:
            if index not in ahead:
                ahead.clear()
                ahead[index] = read_ahead(self.source, map(sampler.clips, count(index)), workers, pinned=pinned)
            batch = sampler.clips(index)
            try:
                read = next(ahead[index])
            except RuntimeError as error:
                ahead.clear()
                raise TrainingError(
                    "A loader process has ended.", where=f"micro-step {index}: {'; '.join(map(str, batch.clips))}",
                    expected="clips", got=error,
                    next_step="see its traceback above; if memory ran out, lower input.workers or the batch",
                ) from error  # fmt: skip
            if isinstance(read, WorldLineError):
                ahead.clear()  # nothing holds the loader processes any more
                raise read
            ahead[index + 1] = ahead.pop(index)
            return self.load(batch, read)

        return load

    def load(self, batch: ClipBatch, read: Tensor | None = None) -> Batch:
        """One batch, whose clips are read now unless they were. Raises: DataError: a clip is damaged; ArtifactError: it is lacking."""
        read = self.source.read_batch(batch) if read is None else read
        frames = read if read.dtype == torch.uint8 else None
        return self.conditioned(batch, self.source.latents(read, self.device), frames)

    def conditioned(self, batch: ClipBatch, latents: Tensor, frames: Tensor | None = None) -> Batch:
        """Latents of a batch's clips, with the conditions that this loader adds. Raises: ArtifactError: the tracks lack an episode."""
        clips, views = batch.clips, batch.views
        ids = mask = fps = weights = None
        facts = [self.clip_facts(clip) for clip in clips] if self.frame_rates or self.text is not None else []
        if self.text is not None:
            texts = [self.source.row(clip.episode_id).instruction for clip in clips]
            ids, mask = (on_device(values, self.device) for values in self.text(texts, facts))
        if facts:
            fps = on_device(np.array([fact.fps for fact in facts], np.float32), self.device)
        if self.object_weights is not None:
            weights = self.object_weights(clips, self.source.recorded_views(batch))
        return Batch(clips, views, latents, self.action_maps(clips, views), ids, mask, frames, fps, weights)

    def clip_facts(self, clip: Clip) -> ClipFacts:
        """Facts that a prompt may state about a clip; a stride lowers its rate."""
        return ClipFacts(clip.num_frames, self.frame_rates[clip.episode_id] / clip.stride, self.source.image_size)

    def action_maps(self, clips: tuple[Clip, ...], views: tuple[str, ...]) -> Float[Tensor, "b v a t h w"] | None:
        """Controls that each latent frame takes (docs/method.md section 2): in each view the map at latent resolution, or the
        vector; None without action tracks."""
        if self.tracks is None or self._tracks is None:
            return None
        if self._resident is not None:
            samples, size = self._resident.batch(clips, self.action_frames, views), self._resident.image_size
        else:
            episodes = [self._tracks(clip.episode_id) for clip in clips]
            frames = frame_numbers(clips, control_frames(clips[0].num_frames, self.action_frames)).tolist()
            samples = collate_tracks(episodes, views, self.native_size, frames).to(self.device)
            size = drawn_size(episodes)
        sigma = self.tracks.sigma_px_ref if self.maps else None
        drawing = ControlDrawing(self.source.latent_shape[1:], sigma, self.native_size, self.action_frames)
        by_vector = None
        if self.native_size is not None:
            by_vector = on_device(np.array([[view in clip.vectors for view in views] for clip in clips]), self.device)
        return drawing.draw(samples, size, by_vector)
