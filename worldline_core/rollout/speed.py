"""Measures what predictions cost, from outside of the samplers.

Times belong to no digest: they are written to ``run/`` of a RolloutSet.
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from worldline_core.rollout.samplers import BlockCausalSimulator

SPEED_FILE = "speed.json"


@dataclass(frozen=True)
class Elapsed:
    """Wall seconds, and processor seconds of all threads, which a busy machine does not stretch (and which say nothing
    about kernels on a GPU).
    """

    wall: float
    processor: float


def timed[T](work: Callable[[], T], device: str) -> tuple[T, Elapsed]:
    """Returns the result of ``work`` and its time; waits for the kernels of the current stream on a GPU."""
    on_gpu = torch.device(device).type == "cuda"
    if on_gpu:
        torch.cuda.current_stream(device).synchronize()
    wall, processor = time.perf_counter(), time.process_time()
    result = work()
    if on_gpu:
        torch.cuda.current_stream(device).synchronize()
    return result, Elapsed(time.perf_counter() - wall, time.process_time() - processor)


def long_rollout(
    simulator: Callable[[], BlockCausalSimulator], first: Tensor, maps: Tensor, blocks: int, *, warm_up: int = 2
) -> dict[str, list[float]]:
    """Seconds of every block of one long rollout under constant controls; its frames are dropped.

    Processor seconds are given only where the processor did the work.

    Args:
        first, maps: observed latents ``(b v c h w)`` and the action maps of a clip ``(b v a t h w)``.
        warm_up: blocks of another rollout before it, which are not counted.
    """
    device = str(maps.device)
    times: list[Elapsed] = []
    for count in (warm_up, blocks):
        running = simulator()
        running.start(first, maps[:, :, :, :1])
        controls = maps[:, :, :, -running.spec.block_size :]
        times = [timed(partial(running.step, controls), device)[1] for _ in range(count)]
    seconds = {"block_seconds": [block.wall for block in times]}
    if maps.device.type == "cpu":
        seconds["block_processor_seconds"] = [block.processor for block in times]
    return seconds


def device_name(device: str) -> str:
    """Name of the GPU, or of the processor with the number of threads in use."""
    if torch.device(device).type == "cuda":
        return torch.cuda.get_device_name(device)
    facts = Path("/proc/cpuinfo")
    lines = facts.read_text(encoding="utf-8").splitlines() if facts.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    processor = names[0] if names else platform.processor() or platform.machine()
    return f"{processor}, {torch.get_num_threads()} threads of {os.cpu_count()} cores"
