"""Processes that read clips ahead of training, handed on in the order that training asks for them.

Every micro-step has one of a fixed number of slots in memory that all processes share, so memory is bounded whichever
process is faster. Slots are reused, because the page faults of fresh memory cost about as much as decoding into it.
"""

from __future__ import annotations

import multiprocessing
import signal
from concurrent.futures import Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from types import TracebackType
from typing import Any, Self

import numpy as np
import torch

from worldline_core.errors import TrainingError
from worldline_core.scale.process_end import end_with_pool
from worldline_core.training.clip_loader import ClipReader, ReadBatch, SkippedClip
from worldline_core.training.clip_source import ClipBatch


class ClipPrefetcher:
    """Reads micro-batches in ``workers`` processes (spawned, so that threads and CUDA of this one do no harm).

    Args:
        prefetch: micro-batches that a process may be ahead. Memory: workers x (prefetch + 1) batches.
        stop: nothing is read from this micro-step on.
        pinned: hand batches on in page-locked memory, which a GPU reads at full speed.
    """

    def __init__(
        self, reader: ClipReader, *, workers: int, prefetch: int = 2, stop: int | None = None, pinned: bool = False
    ) -> None:
        self._reader = reader
        self._stop = stop
        self._slots = workers * (prefetch + 1)
        context = multiprocessing.get_context("spawn")
        shared = context.RawArray("B", self._slots * reader.max_bytes)
        self._memory = _slots(shared, self._slots)
        self._pinned = torch.empty(reader.max_bytes, dtype=torch.uint8, pin_memory=True) if pinned else None
        self._pool = ProcessPoolExecutor(workers, context, _start_process, (reader, shared, self._slots))
        self._reads: dict[int, Future[tuple[ClipBatch, tuple[SkippedClip, ...]]]] = {}
        self._closed = False

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def read(self, index: int) -> ReadBatch:
        """The clips of micro-step ``index``; asked for in order, they are there already.

        The batch is valid until the next one is read.

        Raises:
            DataError, ArtifactError: whatever reading raised in the process.
            TrainingError: a process has ended; the message names the clips of the first batch that is missing.
        """
        if self._closed:
            raise TrainingError("The loader is closed.", where=f"micro-step {index}")
        if index not in self._reads:
            # Out of order: what is still being read ends first, because its slots are used again.
            wait(self._reads.values())
            self._reads.clear()
        end = index + self._slots if self._stop is None else min(index + self._slots, max(self._stop, index + 1))
        try:
            self._submit(index)
            with suppress(BrokenProcessPool):  # said when the first batch that is missing is asked for
                for ahead in range(index + 1, end):
                    self._submit(ahead)
            batch, skipped = self._reads.pop(index).result()
        except BrokenProcessPool as error:
            self.close()
            raise TrainingError(
                "A loader process has ended.",
                where=f"micro-step {index}: {'; '.join(map(str, self._reader.sampler.clips(index).clips))}",
                expected="clips",
                got=error,
                next_step="see its traceback above; if memory ran out, lower input.workers, input.prefetch or the batch",
            ) from error
        data = torch.from_numpy(
            self._reader.source.batch_array(batch, self._reader.views, self._memory[index % self._slots])
        )
        if self._pinned is not None:
            # The copy of the batch before may still be on its way to the GPU.
            torch.cuda.current_stream().synchronize()
            data = self._pinned[: data.nbytes].view(data.dtype).view(data.shape).copy_(data)
        return ReadBatch(batch, data, skipped)

    def _submit(self, index: int) -> None:
        if index not in self._reads:
            self._reads[index] = self._pool.submit(_read, index)

    def close(self) -> None:
        """End the processes, each after the batch that it is reading."""
        self._closed = True
        self._pool.shutdown(cancel_futures=True)


def _slots(shared: Any, count: int) -> np.ndarray:
    return np.frombuffer(shared, np.uint8).reshape(count, -1)


# In a loader process: what it reads with, and the slots that it reads into.
_process: tuple[ClipReader, np.ndarray]


def _start_process(reader: ClipReader, shared: Any, slots: int) -> None:
    import cv2

    global _process
    _process = reader, _slots(shared, slots)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the training process, which closes this one
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    end_with_pool()


def _read(index: int) -> tuple[ClipBatch, tuple[SkippedClip, ...]]:
    reader, slots = _process
    read = reader.read(index, slots[index % len(slots)])
    return read.batch, read.skipped
