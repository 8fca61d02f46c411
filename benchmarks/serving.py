"""Sessions of the causal model: forks beside separate rollouts, the page beside real time, many clients beside one.

    python benchmarks/serving.py forks [--branches 32] [--history 3] [--steps 1]
    python benchmarks/serving.py page [--blocks 12] [--decoder FOLDER]
    python benchmarks/serving.py load [--sessions 32] [--minutes 5]

All take `--model FOLDER` and `--threads 2`.

- `forks`: branches of one history against rollouts that each begin at the observed pictures, with the same controls (of a
  shipped recording, with an offset for each branch); both must give the same pictures.
- `page`: blocks of `worldline play` through its own session, as fast as it goes: inverse kinematics and marks count, waiting
  for a person does not.
- `load`: every session drives a shipped recording with controls that depend on what it saw, again and again from its
  start; the digest of each round must be the one that the same session gives alone.
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
from websockets.sync.client import connect

from benchmarks.harness import RECORDINGS, command_line, timed
from worldline_core import Camera, WorldLine
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.rollout.simulation import Simulation
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


def measure_forks(world: WorldLine, options: argparse.Namespace) -> dict[str, object]:
    recordings = EpisodeSet.open(RECORDINGS)
    position = next(i for i, row in enumerate(recordings.rows) if set(row.views) >= set(world.views))
    episode = recordings.episode(position)
    images = {view: recordings.frames(position, view, [0])[0] for view in world.views}
    cameras = {view: Camera(episode.cameras[view].K, episode.cameras[view].T_base_camera[0]) for view in world.views}
    unit = world.unit(33)
    rows = np.minimum(np.arange(1 + unit * (options.history + options.steps)), len(episode.action) - 1)
    controls = np.repeat(episode.action[rows][None], options.branches, axis=0).astype(np.float64)
    controls[:, 1 + unit * options.history :] += np.linspace(-0.05, 0.05, options.branches)[:, None, None]
    steps = [slice(begin, begin + unit) for begin in range(1, controls.shape[1], unit)]

    def start() -> Simulation:
        return world.start(images, cameras, embodiment=episode.embodiment, state=episode.action[0])

    def separate() -> list[dict[str, np.ndarray]]:
        pictures = []
        for branch in controls:
            simulation = start()
            for step in steps:
                simulation.step(branch[step])
            pictures += simulation.pictures
        return pictures

    def forked() -> list[dict[str, np.ndarray]]:
        simulation = start()
        for step in steps[: options.history]:
            simulation.step(controls[0, step])
        branches = simulation.fork(options.branches)
        for step in steps[options.history :]:
            branches.step(controls[:, step])
        return branches.pictures

    start().step(controls[0, steps[0]])
    one, wall, processor = timed(forked)
    other, separate_wall, separate_processor = timed(separate)
    differences = [np.abs(a[view].astype(int) - b[view]).max() for a, b in zip(one, other, strict=True) for view in a]
    return {
        "frames_per_step": unit,
        "seconds": {"forked": wall, "separate": separate_wall, "ratio": separate_wall / wall},
        "processor_seconds": {
            "forked": processor, "separate": separate_processor, "ratio": separate_processor / processor,
        },
        "largest_difference_grey_levels": int(max(differences)),
    }  # fmt: skip


def measure_page(world: WorldLine, options: argparse.Namespace) -> dict[str, object]:
    firsts, blocks, frames, views = [], [], 0, 0
    with served(world) as url, connect(f"{url}/play/session", max_size=None, proxy=None) as page:

        def until_block() -> dict:
            while not isinstance(found := page.recv(timeout=300), bytes):
                if json.loads(found)["type"] == "error":
                    raise SystemExit(found)
            return json.loads(found[4 : 4 + int.from_bytes(found[:4], "little")])

        for _ in range(3):
            begin = time.perf_counter()
            page.send(json.dumps({"type": "start", "episode": EPISODE}))
            until_block()
            firsts.append(time.perf_counter() - begin)
        for _ in range(options.blocks):
            begin = time.perf_counter()
            for _ in range(world.frames_per_unit):
                page.send(json.dumps({"type": "tick", "arms": [{}, {"move": [0.2, 0, 0.3]}]}))
            head = until_block()
            blocks.append(time.perf_counter() - begin)
            frames, views = head["frames"], len(head["views"])
    rate = frames / statistics.median(blocks)
    return {
        "views": views, "frames_per_block": frames, "first_picture_s": firsts,
        "block_s": {"median": statistics.median(blocks), "largest": max(blocks)},
        "frames_per_second": rate, "times_real_time": rate / world.contract.fps,
    }  # fmt: skip


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
    parser.add_argument("what", choices=("forks", "page", "load"))
    parser.add_argument("--model", type=Path, default=RECORDINGS.with_name("models") / "causal")
    parser.add_argument("--decoder", type=Path, help="folder of a small decoder")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--branches", type=int, default=32)
    parser.add_argument("--history", type=int, default=3, help="forks: steps that the branches share")
    parser.add_argument("--steps", type=int, default=1, help="forks: steps of each branch")
    parser.add_argument("--blocks", type=int, default=12, help="page: blocks to drive")
    parser.add_argument("--sessions", type=int, default=32, help="load: clients at once")
    parser.add_argument("--minutes", type=float, default=5.0, help="load: duration")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    world = WorldLine.from_pretrained(options.model, decoder=options.decoder)
    measure = {"forks": measure_forks, "page": measure_page, "load": measure_load}[options.what]
    print(json.dumps(measure(world, options), indent=1))


if __name__ == "__main__":
    main()
