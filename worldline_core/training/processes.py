"""Training on several processes: torchrun starts them, each takes its part of every global batch, weights stay equal."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from datetime import timedelta

import torch
from torch import nn

# The first process makes the offline trajectories alone: at full size that takes hours while the others wait.
_PATIENCE = timedelta(hours=24)


def join_processes(device: str) -> tuple[int, int]:
    """(rank, world size) as torchrun sets them; (0, 1) otherwise. Joins the process group when there is one.

    Call it before anything is moved to ``device``: on GPUs it makes "cuda" this process's own card.
    """
    world_size = int(os.environ.get("WORLD_SIZE", "1"))
    rank = int(os.environ.get("RANK", "0"))
    if world_size > 1 and not torch.distributed.is_initialized():
        on_gpu = torch.device(device).type == "cuda"
        if on_gpu:
            torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", "0")))
        torch.distributed.init_process_group("nccl" if on_gpu else "gloo", timeout=_PATIENCE)
    return rank, world_size


def wait_for_all() -> None:
    """Return once every process has come here; at once when there is only this one."""
    if torch.distributed.is_initialized():
        torch.distributed.barrier()


def average_gradients(parameters: Iterable[nn.Parameter]) -> None:
    """Mean of every gradient over the processes, in place.

    Where only some processes used a parameter (text dropout is drawn by each), it counts as zero on the others; where
    none did, there is still no gradient.
    """
    if not torch.distributed.is_initialized():
        return
    parameters = list(parameters)
    device = parameters[0].device
    used = torch.tensor([parameter.grad is not None for parameter in parameters], dtype=torch.int32, device=device)
    torch.distributed.all_reduce(used)
    for parameter, count in zip(parameters, used.tolist(), strict=True):
        if not count:
            continue
        if parameter.grad is None:
            parameter.grad = torch.zeros_like(parameter)
        torch.distributed.all_reduce(parameter.grad)
        parameter.grad /= torch.distributed.get_world_size()


def average_values(values: Mapping[str, float]) -> dict[str, float]:
    """Mean of every number over the processes, the same on all of them; they must name the same numbers."""
    if not torch.distributed.is_initialized():
        return dict(values)
    names = sorted(values)
    on_gpu = torch.distributed.get_backend() == "nccl"
    numbers = torch.tensor([values[name] for name in names], dtype=torch.float64, device="cuda" if on_gpu else "cpu")
    torch.distributed.all_reduce(numbers)
    numbers /= torch.distributed.get_world_size()
    return dict(zip(names, numbers.tolist(), strict=True))
