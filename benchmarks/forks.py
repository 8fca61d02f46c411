"""Branches of one history against rollouts that each begin at the observed pictures.

    python benchmarks/forks.py [--model artifacts/shipped/models/causal] [--branches 32] [--history 3] [--steps 1] [--threads 2]

Both drive the same controls, of a shipped recording with an offset for each branch, and must give the same pictures. Processor
seconds of all threads stand beside the wall's, which a busy machine stretches.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from worldline_core import Camera, WorldLine
from worldline_core.data.episodes.episode_set import EpisodeSet

SHIPPED = Path("artifacts/shipped")


def timed[T](work: Callable[[], T]) -> tuple[T, float, float]:
    """What the work gives; its seconds on the wall, and those of all threads."""
    wall, processor = time.perf_counter(), time.process_time()
    result = work()
    return result, time.perf_counter() - wall, time.process_time() - processor


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", type=Path, default=SHIPPED / "models" / "causal")
    parser.add_argument("--branches", type=int, default=32)
    parser.add_argument("--history", type=int, default=3, help="steps that the branches share")
    parser.add_argument("--steps", type=int, default=1, help="steps of each branch")
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    world = WorldLine.from_pretrained(options.model)
    recordings = EpisodeSet.open(SHIPPED / "recordings")
    position = next(i for i, row in enumerate(recordings.rows) if set(row.views) >= set(world.views))
    episode = recordings.episode(position)
    images = {view: recordings.frames(position, view, [0])[0] for view in world.views}
    cameras = {view: Camera(episode.cameras[view].K, episode.cameras[view].T_base_camera[0]) for view in world.views}
    unit = world.unit(33)
    rows = np.minimum(np.arange(1 + unit * (options.history + options.steps)), len(episode.action) - 1)
    controls = np.repeat(episode.action[rows][None], options.branches, axis=0).astype(np.float64)
    offsets = np.linspace(-0.05, 0.05, options.branches)[:, None, None]
    controls[:, 1 + unit * options.history :] += offsets
    steps = [slice(begin, begin + unit) for begin in range(1, controls.shape[1], unit)]

    def start():
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
    figures = {
        "branches": options.branches,
        "history_steps": options.history,
        "branch_steps": options.steps,
        "frames_per_step": unit,
        "threads": options.threads,
        "seconds": {"forked": wall, "separate": separate_wall, "ratio": separate_wall / wall},
        "processor_seconds": {
            "forked": processor, "separate": separate_processor, "ratio": separate_processor / processor,
        },
        "largest_difference_grey_levels": int(max(differences)),
    }  # fmt: skip
    print(json.dumps(figures, indent=1))


if __name__ == "__main__":
    main()
