"""Many sessions on one server at once: the time of a block as a client sees it, whether any is lost or mixed up, and memory.

    python benchmarks/serve_load.py [--sessions 32] [--minutes 5] [--checkpoint FOLDER] [--threads 2]

Every session drives a shipped recording with controls that depend on what it saw, again and again from its start; the digest
of each round must be the one that the same session gives alone.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import statistics
import threading
import time
from pathlib import Path

import numpy as np
import torch

from worldline_core import WorldLine
from worldline_core.serving.app import make_server
from worldline_core.serving.client import RemoteSimulation, SimulatorClient
from worldline_core.serving.serve_config import ServeConfig
from worldline_core.shipped import shipped_folder

BLOCKS = 3
"""Of a round."""


def resident_mib() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def round_trip(simulation: RemoteSimulation, seed: int, times: list[float]) -> str:
    """One round from the start; the digest of all that was seen."""
    generator, digest = np.random.default_rng(seed), hashlib.sha256()
    simulation.reset()
    for _ in range(BLOCKS):
        mean = simulation.pictures[0]["head"].mean()
        noise = generator.normal(0, 0.02, (1, simulation.frames_per_step, simulation.state.shape[1]))
        begin = time.perf_counter()
        frames = simulation.step(simulation.state[:, None] + noise + 1e-4 * mean)
        times.append(time.perf_counter() - begin)
        digest.update(b"".join(video.tobytes() for video in frames[0].values()))
    return digest.hexdigest()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sessions", type=int, default=32)
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--checkpoint", type=Path, default=shipped_folder() / "models" / "causal")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    world = WorldLine.from_pretrained(options.checkpoint)
    config = ServeConfig(port=0, episodes=shipped_folder() / "recordings", idle_s=3600)
    server = make_server(world, config, None)
    thread = threading.Thread(target=server.run)
    thread.start()
    while not server.started:
        time.sleep(0.05)
    url = f"ws://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
    with SimulatorClient(url) as client:
        names = [row["id"] for row in client.metadata["episodes"]]
        alone: list[float] = []
        expected = []
        for number in range(options.sessions):
            simulation = client.start(names[number % len(names)], seeds=[number])
            expected.append(round_trip(simulation, number, alone))
            simulation.close()
    times: list[list[float]] = [[] for _ in range(options.sessions)]
    rounds, wrong, lost = [0] * options.sessions, [0] * options.sessions, [True] * options.sessions
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
    memory = []
    while any(each.is_alive() for each in threads):
        time.sleep(min(5.0, 6 * options.minutes))
        memory.append(resident_mib())
    server.should_exit = True
    thread.join()
    every = np.array([seconds for found in times for seconds in found])
    p50, p99 = np.percentile(every, [50, 99])
    quarter = max(1, len(memory) // 4)
    print(json.dumps({
        "sessions": options.sessions, "minutes": options.minutes, "threads": options.threads, "blocks": len(every),
        "rounds_per_session": [min(rounds), max(rounds)], "lost": sum(lost), "mixed_up": sum(wrong),
        "alone_p50_s": statistics.median(alone), "p50_s": p50, "p99_s": p99, "p99_over_p50": p99 / p50,
        "memory_mib": {"second_quarter": float(np.mean(memory[quarter : 2 * quarter] or memory)),
                       "last_quarter": float(np.mean(memory[-quarter:])), "largest": max(memory)},
    }, indent=1))  # fmt: skip


if __name__ == "__main__":
    main()
