"""Processes that read clips ahead of training, in the order that training asks for them.

Micro-step i belongs to process i modulo their number, and to one of a fixed number of slots in memory that all processes
share: the order does not depend on which process is faster, and memory is bounded by the slots. Slots are reused, because
the page faults of fresh shared memory cost about as much as decoding into it.
"""

from __future__ import annotations

import mmap
import multiprocessing
import os
import signal
import tempfile
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import reduction
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from types import TracebackType
from typing import Self

import numpy as np
import torch

from worldline_core.errors import TrainingError, WorldLineError
from worldline_core.training.clip_loader import ClipReader, ReadBatch, SkippedClip
from worldline_core.training.clip_source import ClipBatch

_JOIN_SECONDS = 5.0


@dataclass(frozen=True)
class _Answer:
    """What a process reports of a micro-step; the clips themselves lie in the slot."""

    index: int
    batch: ClipBatch
    shape: tuple[int, ...]
    skipped: tuple[SkippedClip, ...]


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
        self._slot_bytes = -(-reader.max_bytes // mmap.PAGESIZE) * mmap.PAGESIZE
        self._first = self._next = self._sent = 0
        self._workers: list[tuple[SpawnProcess, Connection]] = []
        self._outstanding: deque[int] = deque()
        self._pinned = torch.empty(reader.max_bytes, dtype=torch.uint8, pin_memory=True) if pinned else None
        descriptor = _anonymous_file(self._slots * self._slot_bytes)
        try:
            self._memory = mmap.mmap(descriptor, self._slots * self._slot_bytes)
            self._start(workers, descriptor)
        finally:
            os.close(descriptor)

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
            TrainingError: the process has ended; the message names the clips it was to read.
        """
        if not self._workers:
            raise TrainingError("The loader is closed.", where=f"micro-step {index}")
        if index != self._next:
            self._restart(index)
        self._next = index + 1
        self._dispatch(index)
        answer = self._receive(index)
        if isinstance(answer, WorldLineError):
            raise answer
        count = int(np.prod(answer.shape))
        dtype = self._reader.source.dtype
        data = torch.from_numpy(np.frombuffer(self._memory, dtype, count, self._offset(index)).reshape(answer.shape))
        return ReadBatch(answer.batch, self._staged(data), answer.skipped)

    def close(self) -> None:
        """End the processes; those that do not end by themselves are stopped."""
        workers, self._workers = self._workers, []
        for _, connection in workers:
            connection.close()
        for process, _ in workers:
            process.join(_JOIN_SECONDS)
            if process.is_alive():
                process.terminate()
                process.join()
            process.close()

    def _start(self, workers: int, descriptor: int) -> None:
        context = multiprocessing.get_context("spawn")
        try:
            for number in range(workers):
                ours, theirs = context.Pipe()
                process = context.Process(
                    target=_serve,
                    args=(self._reader, theirs, self._slots * self._slot_bytes, self._slot_bytes),
                    name=f"clip loader {number}",
                    daemon=True,
                )
                process.start()
                theirs.close()  # so that the end of the process is the end of the connection
                self._workers.append((process, ours))
                reduction.send_handle(ours, descriptor, process.pid)
        except BaseException:
            self.close()
            raise

    def _offset(self, index: int) -> int:
        return (index - self._first) % self._slots * self._slot_bytes

    def _worker(self, index: int) -> tuple[SpawnProcess, Connection]:
        return self._workers[(index - self._first) % len(self._workers)]

    def _dispatch(self, index: int) -> None:
        """Ask for everything that there is a slot for while ``index`` is in use."""
        end = index + self._slots if self._stop is None else min(index + self._slots, max(self._stop, index + 1))
        for ahead in range(self._sent, end):
            # That a process has ended is reported when its answer is missing: earlier answers can still be read.
            with suppress(BrokenPipeError, ConnectionResetError):
                self._worker(ahead)[1].send((ahead, self._offset(ahead)))
            self._outstanding.append(ahead)
            self._sent = ahead + 1

    def _receive(self, index: int) -> _Answer | WorldLineError:
        process, connection = self._worker(index)
        try:
            answer_index, answer = connection.recv()
        except (EOFError, ConnectionResetError):
            process.join(_JOIN_SECONDS)
            code = process.exitcode
            clips = "; ".join(str(clip) for clip in self._reader.sampler.clips(index).clips)
            self.close()
            raise TrainingError(
                "A loader process has ended.",
                where=f"micro-step {index}: {clips}",
                expected="clips",
                got="killed by a signal" if code is not None and code < 0 else f"exit code {code}",
                next_step="see its traceback above; if memory ran out, lower input.workers, input.prefetch or the batch",
            ) from None
        if self._outstanding.popleft() != index or answer_index != index:
            raise TrainingError("Clips came out of order.", where=f"micro-step {index}", got=answer_index)
        return answer

    def _restart(self, index: int) -> None:
        """Continue at another micro-step: what is still being read is awaited and dropped."""
        while self._outstanding:
            self._receive(self._outstanding[0])
        self._first = self._sent = index

    def _staged(self, data: torch.Tensor) -> torch.Tensor:
        if self._pinned is None:
            return data
        # The copy of the batch before may still be on its way to the GPU.
        torch.cuda.current_stream().synchronize()
        target = self._pinned[: data.nbytes].view(data.dtype).view(data.shape)
        return target.copy_(data)


def _anonymous_file(size: int) -> int:
    """A file without a name in memory: nothing is left behind however processes end, and /dev/shm has no say."""
    if hasattr(os, "memfd_create"):
        descriptor = os.memfd_create("worldline-clips")
    else:
        with tempfile.TemporaryFile() as file:
            descriptor = os.dup(file.fileno())
    os.ftruncate(descriptor, size)
    return descriptor


def _serve(reader: ClipReader, connection: Connection, memory_bytes: int, slot_bytes: int) -> None:
    """A loader process: reads what it is asked for until the connection ends.

    Errors that name a clip are answers. Anything else ends the process with its traceback, and the training process
    says which clips it was about.
    """
    import cv2

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the training process, which closes this one
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    try:
        descriptor = reduction.recv_handle(connection)
        memory = mmap.mmap(descriptor, memory_bytes)
        os.close(descriptor)
        while True:
            index, offset = connection.recv()
            slot = np.frombuffer(memory, np.uint8, slot_bytes, offset)
            try:
                read = reader.read(index, slot)
                connection.send((index, _Answer(index, read.batch, tuple(read.data.shape), read.skipped)))
            except WorldLineError as error:
                connection.send((index, error))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return
