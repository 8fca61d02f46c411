"""Many clients of one server of the causal model, beside one client alone.

    python benchmarks/serving.py [--sessions 32] [--minutes 5] [--model FOLDER] [--threads 2]

Every session drives a shipped recording with controls that depend on what it saw, again and again from its start; the digest of
each round must be the one that the same session gives alone.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import statistics
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch

from benchmarks.harness import RECORDINGS, command_line
from worldline_core import WorldLine
from worldline_core.serving.app import make_server
from worldline_core.serving.client import RemoteSimulation, SimulatorClient
from worldline_core.serving.serve_config import ServeConfig

EPISODE = "ur5e_silver-test-s1-00000"
BLOCKS_A_ROUND = 3


@contextmanager
def served(world: WorldLine) -> Iterator[str]:
    """Address of a server of this model in a thread."""
    server = make_server(world, ServeConfig(port=0, episodes=RECORDINGS, idle_s=3600), None)
    thread = threading.Thread(target=server.run)
    thread.start()
    while not server.started:
        time.sleep(0.05)
    try:
        yield f"ws://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
    finally:
        server.should_exit = True
        thread.join()


def round_trip(simulation: RemoteSimulation, seed: int, times: list[float]) -> str:
    """One round from the start; returns the digest of all pictures."""
    generator, digest = np.random.default_rng(seed), hashlib.sha256()
    simulation.reset()
    for _ in range(BLOCKS_A_ROUND):
        mean = simulation.pictures[0]["head"].mean()
        noise = generator.normal(0, 0.02, (1, simulation.frames_per_step, simulation.state.shape[1]))
        begin = time.perf_counter()
        frames = simulation.step(simulation.state[:, None] + noise + 1e-4 * mean)
        times.append(time.perf_counter() - begin)
        digest.update(b"".join(video.tobytes() for video in frames[0].values()))
    return digest.hexdigest()


def resident_mib() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def measure_load(world: WorldLine, options: argparse.Namespace) -> dict[str, object]:
    alone: list[float] = []
    expected, memory = [], []
    times: list[list[float]] = [[] for _ in range(options.sessions)]
    rounds, wrong, lost = [0] * options.sessions, [0] * options.sessions, [True] * options.sessions
    with served(world) as url:
        with SimulatorClient(url) as client:
            names = [row["id"] for row in client.metadata["episodes"]]
            for number in range(options.sessions):
                simulation = client.start(names[number % len(names)], seeds=[number])
                expected.append(round_trip(simulation, number, alone))
                simulation.close()
        end = time.monotonic() + 60 * options.minutes

        def work(number: int) -> None:
            with SimulatorClient(url, deadline_s=600) as client:
                simulation = client.start(names[number % len(names)], seeds=[number])
                while time.monotonic() < end:
                    wrong[number] += round_trip(simulation, number, times[number]) != expected[number]
                    rounds[number] += 1
            lost[number] = False

        threads = [threading.Thread(target=work, args=(number,)) for number in range(options.sessions)]
        for each in threads:
            each.start()
        while any(each.is_alive() for each in threads):
            time.sleep(min(5.0, 6 * options.minutes))
            memory.append(resident_mib())
    every = np.array([seconds for found in times for seconds in found])
    p50, p99 = np.percentile(every, [50, 99])
    quarter = max(1, len(memory) // 4)
    return {
        "blocks": len(every), "rounds_per_session": [min(rounds), max(rounds)], "lost": sum(lost),
        "mixed_up": sum(wrong), "alone_p50_s": statistics.median(alone), "p50_s": p50, "p99_over_p50": p99 / p50,
        "memory_mib": {"second_quarter": float(np.mean(memory[quarter : 2 * quarter] or memory)),
                       "last_quarter": float(np.mean(memory[-quarter:])), "largest": max(memory)},
    }  # fmt: skip


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--model", type=Path, default=RECORDINGS.with_name("models") / "causal")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--sessions", type=int, default=32, help="clients at once")
    parser.add_argument("--minutes", type=float, default=5.0, help="duration")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    print(json.dumps(measure_load(WorldLine.from_pretrained(options.model), options), indent=1))


if __name__ == "__main__":
    main()
