"""What predictions cost: times of every batch as they happen, and their summary.

Times belong to no digest: they lie in ``run/`` of a RolloutSet.
"""

from __future__ import annotations

import json
import os
import platform
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from worldline_core.rollout.samplers import BlockCausalSimulator
from worldline_core.store.artifact_files import read_json_lines
from worldline_core.store.atomic import write_bytes_atomic, write_json_atomic

TIMES_FILE = "batches.jsonl"
SPEED_FILE = "speed.json"


@dataclass(frozen=True)
class Elapsed:
    """Seconds that something took: on the wall, and of all this process's threads (which a busy machine does not
    stretch; on a GPU they say nothing of the kernels).
    """

    wall: float
    processor: float


def timed[T](work: Callable[[], T], device: str) -> tuple[T, Elapsed]:
    """What ``work`` returns, and what it took; on a GPU until its kernels are done (those of other streams go on)."""
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
    """What every block takes of one long rollout that goes on with its last controls; nothing of it is kept.

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
    """The device in words: a GPU's name, or the processor and how many threads are used."""
    if torch.device(device).type == "cuda":
        return torch.cuda.get_device_name(device)
    facts = Path("/proc/cpuinfo")
    lines = facts.read_text(encoding="utf-8").splitlines() if facts.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    processor = names[0] if names else platform.processor() or platform.machine()
    return f"{processor}, {torch.get_num_threads()} threads of {os.cpu_count()} cores"


@dataclass(frozen=True)
class BatchTime:
    """Wall seconds of one batch of trajectories.

    Attributes:
        trajectories, frames: in the batch; a frame is one instant in all views.
        seconds: observing, encoding, sampling and decoding; writing to disk is left out.
        block_seconds: of sampling each block (its cache write included); empty where a clip is sampled whole.
        first: whether it was the first of its call, which pays for loading kernels and caches.
    """

    trajectories: int
    frames: int
    seconds: float
    block_seconds: tuple[float, ...]
    first: bool


class SpeedLog:
    """Times of the batches of a rollout. A resumed call adds to those of the calls before it."""

    def __init__(self, run_folder: Path) -> None:
        self.folder = run_folder
        self.times = [
            BatchTime(**{**row, "block_seconds": tuple(row["block_seconds"])})
            for row in read_json_lines(run_folder / TIMES_FILE)
        ]
        content = "".join(f"{json.dumps(asdict(row))}\n" for row in self.times)
        write_bytes_atomic(run_folder / TIMES_FILE, content.encode())

    def add(self, row: BatchTime) -> None:
        """Append one batch."""
        self.times.append(row)
        with (self.folder / TIMES_FILE).open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(asdict(row)) + "\n")

    def close(self, facts: dict[str, Any]) -> None:
        """Write ``speed.json``: ``facts`` and the summary."""
        write_json_atomic(self.folder / SPEED_FILE, {**facts, **summarise(self.times)})


def summarise(times: Sequence[BatchTime]) -> dict[str, Any]:
    """Seconds per frame, and seconds of each block averaged over trajectories.

    The first batch of a call warms up; it counts only where there is no other. A block's mean is over the batches of
    the longest trajectories, so that all blocks are means over the same ones.
    """
    counted = [row for row in times if not row.first] or list(times)
    frames, seconds = sum(row.frames for row in counted), sum(row.seconds for row in counted)
    longest = max((len(row.block_seconds) for row in counted), default=0)
    whole = [row for row in counted if len(row.block_seconds) == longest]
    trajectories = sum(row.trajectories for row in whole)
    blocks = [sum(row.block_seconds[block] for row in whole) / trajectories for block in range(longest)]
    return {
        "frames": frames,
        "trajectories": sum(row.trajectories for row in counted),
        "seconds": seconds,
        "seconds_per_frame": seconds / frames if frames else None,
        "block_seconds": blocks,
    }
