"""From the number of a micro-step to the arrays of its clips: what loader processes do, and what to do with a bad clip."""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from torch import Tensor, from_numpy

from worldline_core.errors import DataError
from worldline_core.training.clip_sampler import PRIMARY, Clip, ClipBatch, ClipSampler
from worldline_core.training.clip_source import ClipSource, ReadingConfig

logger = logging.getLogger(__name__)

_ATTEMPTS = 20


@dataclass(frozen=True)
class SkippedClip:
    """A clip that could not be read, and why."""

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


class BatchReader(Protocol):
    """Reads micro-batches by their number."""

    def read(self, index: int) -> ReadBatch: ...

    def close(self) -> None: ...


class ClipReader:
    """Reads in this process. Pickled into loader processes, it opens its files there.

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
        kinds = self.sampler.batch_kinds
        return clip * max(size * (len(self.views) if view is None else 1) for view, size in kinds)

    def read(self, index: int, buffer: np.ndarray | None = None) -> ReadBatch:
        """The clips of micro-step ``index``.

        Args:
            buffer: uint8, `max_bytes` long, that the batch is read into; None for memory of its own.

        Raises:
            DataError: a clip cannot be read and is not to be skipped, or nothing readable can be found for it.
            ArtifactError: the source does not hold what is asked of it.
        """
        wanted = self.sampler.clips(index)
        slots, _ = batch_views(wanted, self.source, self.views)
        shape = (len(wanted.clips), len(slots), *self.source.shape(wanted.clips[0].num_frames))
        out = _array(shape, self.source.dtype, buffer)
        clips: list[Clip] = []
        skipped: list[SkippedClip] = []
        for place, clip in enumerate(wanted.clips):
            clips.append(self._read(index, place, clip, wanted.view, out[place], skipped))
        return ReadBatch(ClipBatch(tuple(clips), wanted.view), from_numpy(out), tuple(skipped))

    def close(self) -> None:
        """Nothing is held here that a batch does not need."""

    def _read(
        self, index: int, place: int, clip: Clip, view: str | None, out: np.ndarray, skipped: list[SkippedClip]
    ) -> Clip:
        for attempt in range(_ATTEMPTS):
            names = batch_views(ClipBatch((clip,), view), self.source, self.views)[1][0]
            try:
                self.source.read(clip, names, out)
            except DataError as error:
                if self.config.on_unreadable == "raise":
                    raise
                skipped.append(SkippedClip(index, clip, str(error)))
                clip = self.sampler.replacement(index, place, attempt)
            else:
                return clip
        raise DataError(
            "No readable clip was found.",
            where=f"micro-step {index}, clip {place}",
            expected=f"one of {_ATTEMPTS} clips that can be read",
            got=skipped[-1].reason,
            next_step="run filter on this EpisodeSet again; its videos may have been damaged since",
        )


def batch_views(
    batch: ClipBatch, source: ClipSource, views: tuple[str, ...]
) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """(the model's view slots of a batch, the views of each clip that fill them)."""
    if batch.view is None:
        return views, [views] * len(batch.clips)
    if batch.view == PRIMARY:
        # The task-facing view takes the head slot whatever it is called in its source.
        return (views[0],), [(source.row(clip.episode_id).primary_view,) for clip in batch.clips]
    return (batch.view,), [(batch.view,)] * len(batch.clips)


def read_clips(source: ClipSource, batch: ClipBatch, views: tuple[str, ...]) -> Tensor:
    """(b, v, ...) of the clips of one batch, in memory of its own; raises as the source's `read` does."""
    slots, per_clip = batch_views(batch, source, views)
    out = np.empty((len(batch.clips), len(slots), *source.shape(batch.clips[0].num_frames)), source.dtype)
    for clip, names, target in zip(batch.clips, per_clip, out, strict=True):
        source.read(clip, names, target)
    return from_numpy(out)


def _array(shape: tuple[int, ...], dtype: np.dtype, buffer: np.ndarray | None) -> np.ndarray:
    if buffer is None:
        return np.empty(shape, dtype)
    return buffer[: int(np.prod(shape)) * dtype.itemsize].view(dtype).reshape(shape)


class SkipLog:
    """Counts the clips that a run skipped, in a file beside its training state: a continued run goes on counting.

    What was skipped is a function of the micro-step, so a step that is done again after a kill adds nothing.
    """

    def __init__(self, folder: Path, rank: int, limit: int) -> None:
        self.path = folder / f"skipped_clips-{rank}.jsonl"
        self.limit = limit
        self._seen = _logged([self.path])

    def add(self, skipped: Sequence[SkippedClip]) -> None:
        """Write down what was skipped.

        Raises:
            DataError: more than ``limit`` clips have been skipped.
        """
        for item in skipped:
            line = json.dumps({"index": item.index, "clip": str(item.clip), "reason": item.reason})
            if line in self._seen:
                continue
            logger.warning("Clip skipped: %s", item.reason)
            self._seen.add(line)
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open("a", encoding="utf-8") as file:
                file.write(line + "\n")
        if len(self._seen) > self.limit:
            raise DataError(
                "Too many clips cannot be read.",
                where=self.path,
                expected=f"at most {self.limit} (input.max_skipped)",
                got=len(self._seen),
                next_step="the reasons are in this file; run filter again, or raise the limit",
            )

    @staticmethod
    def count(folder: Path, before: int) -> int:
        """Clips that all processes skipped in the micro-steps before ``before``."""
        lines = _logged(sorted(folder.glob("skipped_clips-*.jsonl")))
        return sum(json.loads(line)["index"] < before for line in lines)


def _logged(paths: Sequence[Path]) -> set[str]:
    """Whole lines of the files: one that a kill cut short is written again."""
    lines: set[str] = set()
    for path in paths:
        text = path.read_text(encoding="utf-8") if path.is_file() else ""
        if text and not text.endswith("\n"):
            text = text[: text.rfind("\n") + 1]
            path.write_text(text, encoding="utf-8")
        lines.update(f"{line}" for line in text.splitlines())
    return lines
