"""The processes that share a training: how they meet, what they agree on, and what is said when one of them is gone."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta

import torch

from worldline_core.errors import ConfigError, TrainingError

# Longer than one process needs for what it does alone while the others wait: a shard of trajectories, a checkpoint.
_PROCESS_TIMEOUT = timedelta(hours=1)


def join_processes(device: str) -> None:
    """Join the processes that torchrun has started to share a run; nothing happens where this one is alone.

    Call it before anything is moved to ``device``: on GPUs it makes "cuda" this process's own card. Tensors on GPUs go
    through NCCL; numbers to agree on, and states that are being written, go through gloo.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) > 1 and not torch.distributed.is_initialized():
        on_gpu = torch.device(device).type == "cuda"
        if on_gpu:
            torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", "0")))
        torch.distributed.init_process_group("cpu:gloo,cuda:nccl" if on_gpu else "gloo", timeout=_PROCESS_TIMEOUT)


def processes() -> tuple[int, int]:
    """(rank, number) of the processes that share this run; (0, 1) where this one is alone."""
    if not torch.distributed.is_initialized():
        return 0, 1
    return torch.distributed.get_rank(), torch.distributed.get_world_size()


def wait_for_all() -> None:
    """Return once every process has called this; at once when there is only one."""
    if torch.distributed.is_initialized():
        torch.distributed.barrier()


def average_values(values: Mapping[str, float]) -> dict[str, float]:
    """Mean of every number over the processes, the same on all of them; they must name the same numbers."""
    if not torch.distributed.is_initialized():
        return dict(values)
    names = sorted(values)
    numbers = torch.tensor([values[name] for name in names], dtype=torch.float64)
    torch.distributed.all_reduce(numbers)
    numbers /= torch.distributed.get_world_size()
    return dict(zip(names, numbers.tolist(), strict=True))


def any_process(flag: bool) -> bool:
    """Whether it holds on at least one process."""
    return average_values({"flag": float(flag)})["flag"] > 0


def another_process_ended(error: BaseException | None) -> bool:
    """Whether this is what the network says of a process that cannot be reached any more."""
    return isinstance(error, torch.distributed.DistError) or (isinstance(error, RuntimeError) and "gloo" in str(error))


@contextmanager
def reporting_lost_processes(where: str) -> Iterator[None]:
    """Say in plain words that another process has ended, where its silence shows as an error of the network.

    Raises:
        TrainingError: another process cannot be reached any more.
    """
    try:
        yield
    except RuntimeError as error:
        if processes()[1] == 1 or not another_process_ended(error):
            raise
        raise TrainingError(
            "Another process of this training has ended or cannot be reached.",
            where=f"{where}, process {processes()[0]} of {processes()[1]}",
            expected="all processes to take every step together",
            got=str(error).splitlines()[0],
            next_step="look for the first error among the messages of the other processes (torchrun names the process "
            "that failed); the same command continues from the last saved state",
        ) from error


@dataclass(frozen=True)
class BatchPlan:
    """How the micro-batches of a training are shared out among processes, whose number may change when it goes on.

    A step has ``per_step`` micro-batches, whatever the number of processes. Micro-batch number m of the run decides its
    clips and its noise. ``together`` neighbours are drawn as one batch (clips of one length), as many as there were
    processes when the run began, so that processes side by side have equal work.
    """

    per_step: int
    together: int
    rank: int = 0
    world_size: int = 1

    @classmethod
    def of(cls, wanted: int, together: int | None = None) -> BatchPlan:
        """The plan for these processes.

        Raises:
            ConfigError: the micro-batches of a step cannot be shared out evenly.
        """
        rank, world_size = processes()
        if wanted % world_size:
            counts = [str(count) for count in range(1, wanted + 1) if wanted % count == 0]
            raise ConfigError(
                "The micro-batches of a step cannot be shared out evenly among these processes.",
                where="trainer.global_batch, or the number of processes that the run began with",
                expected=f"a number of processes that divides {wanted} micro-batches: {', '.join(counts)}",
                got=f"{world_size} processes",
                next_step="start as many processes as divide it, or choose another global_batch or batch_size",
            )
        return cls(wanted, together or world_size, rank, world_size)

    @property
    def accumulation(self) -> int:
        """Micro-batches of a step that this process takes one after the other."""
        return self.per_step // self.world_size

    def number(self, index: int) -> int:
        """Number in the whole run of this process's ``index``-th micro-batch."""
        return index * self.world_size + self.rank

    def drawn(self, index: int) -> tuple[int, int]:
        """(number of the draw, place within it) of this process's ``index``-th micro-batch."""
        return divmod(self.number(index), self.together)


ALONE = BatchPlan(1, 1)
"""One process, one micro-batch a step."""
