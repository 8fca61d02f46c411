"""Processor time of the training input beside raw decoding of the same clips.

    python benchmarks/loader.py [--processes 2] [--only 480x640]

It makes its own recordings (three views, encoded as curation does) in a temporary folder, then times, in turns so that a busy
machine disturbs both alike: decoding the clips and dropping the frames (*raw*), and a training process that takes every batch
from loader processes (*loader*). Processor time is that of all processes together; medians of the rounds.

Then a batch of 256 clips of cached latents: read from the store, and resident.
"""

from __future__ import annotations

import multiprocessing
import os
import statistics
import tempfile
import time
from collections.abc import Iterator, Sequence
from itertools import count, cycle
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from benchmarks.harness import RECORDINGS, command_line, print_table, seconds_of
from worldline_core.data.episodes.episode import VIEWS, Episode
from worldline_core.data.episodes.episode_set import EpisodeSet, EpisodeSetWriter
from worldline_core.training.clip_config import ClipSampling, EncodeLatentsConfig, FrameInput
from worldline_core.training.clip_loader import ClipLoader, read_ahead
from worldline_core.training.clip_sampler import Clip, ClipSampler
from worldline_core.training.clip_source import FrameSource, LatentStore, ResidentLatents
from worldline_core.training.encode_latents import encode_latents

TICK = os.sysconf("SC_CLK_TCK")
ROUNDS = 3
TOKENIZER = RECORDINGS.with_name("models") / "tokenizer"
CASES: dict[str, dict[str, Any]] = {
    "480x640": {"size": (480, 640), "fps": 30.0, "episodes": 4, "frames": 160, "lengths": (33, 65, 97), "batch": 1, "steps": 10},
    "64x96": {"size": (64, 96), "fps": 8.0, "episodes": 12, "frames": 80, "lengths": (33,), "batch": 8, "steps": 12},
}  # fmt: skip


def scene(seed: int, count: int, height: int, width: int) -> np.ndarray:
    """uint8 (N, H, W, 3): a textured thing that moves over a textured background, with sensor noise."""
    random = np.random.default_rng(seed)
    coarse = random.integers(30, 220, (height // 16 + 2, width // 16 + 2, 3), dtype=np.uint8)
    frames = np.repeat(cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)[None], count, axis=0)
    thing = cv2.GaussianBlur(random.integers(0, 255, (height // 4, width // 4, 3), dtype=np.uint8), (5, 5), 0)
    for index, frame in enumerate(frames):
        row = int((0.5 + 0.4 * np.sin(0.05 * index + seed)) * (height - thing.shape[0]))
        column = int((0.5 + 0.4 * np.cos(0.03 * index + 2 * seed)) * (width - thing.shape[1]))
        frame[row : row + thing.shape[0], column : column + thing.shape[1]] = thing
        frame[:] = np.clip(frame + random.integers(-3, 4, (height, width, 1), dtype=np.int16), 0, 255)
    return frames


def write_recordings(root: Path, case: dict[str, Any]) -> EpisodeSet:
    """An EpisodeSet of the case's size."""
    count = case["frames"]
    state = np.zeros((count, 2), np.float32)
    facts: dict[str, Any] = dict.fromkeys(("task_family", "outcome"), "unknown")
    facts |= {"source": "benchmark", "embodiment": "none", "instruction": "", "split": "train", "fps": case["fps"]}
    with EpisodeSetWriter(root, video_preset="fast") as writer:
        for number in range(case["episodes"]):
            episode = Episode(
                episode_id=f"episode-{number:03d}", scene=f"scene-{number}", state=state, action=state,
                timestamps=np.arange(count) / case["fps"], state_names=("joint", "gripper"), **facts,
            )  # fmt: skip
            writer.add(episode, {v: scene(3 * number + n, count, *case["size"]) for n, v in enumerate(VIEWS)})
    return EpisodeSet.open(root)


def processor_seconds(processes: Sequence[int]) -> float:
    """User and system time that processes have used."""
    fields = [Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split() for number in processes]
    return sum(int(each[11]) + int(each[12]) for each in fields) / TICK


def decode_raw(source: FrameSource, clips: Sequence[Clip]) -> None:
    """Every frame of the clips, and nothing more."""
    for clip in clips:
        position = source.episodes.position(clip.episode_id)
        for view in VIEWS:
            for _ in source.decoder.frames(source.episodes.clip(position, view), clip.frames):
                pass


def measure(case: dict[str, Any], episodes: EpisodeSet, processes: int) -> tuple[str, float, float, float]:
    """Decoder, frames per second of processor time by raw decoding and by the loader, and their ratio."""
    config = FrameInput.model_validate({"image_size": case["size"]})
    source = FrameSource(episodes, TOKENIZER, config)
    sampling = ClipSampling.model_validate({"lengths": case["lengths"]})
    sampler = ClipSampler(source.rows, sampling, views=VIEWS, start_step=1, batch_size=case["batch"], seed=0)
    steps = case["steps"]
    batches = [sampler.clips(index) for index in range(steps)]
    clips = [clip for batch in batches for clip in batch.clips]
    frames = len(VIEWS) * sum(clip.num_frames for clip in clips)
    loader = read_ahead(source, cycle(batches), processes)  # every pass reads what raw decoding reads
    everyone = [os.getpid()]

    def load() -> None:
        for _ in range(steps):
            next(loader)
        # What was read ahead before is read again before the clock stops: a pass reads as much as it takes.
        spent = -1.0
        while (now := processor_seconds(everyone)) > spent:
            spent = now
            time.sleep(0.1)

    load()
    everyone += [process.pid or 0 for process in multiprocessing.active_children()]
    times: dict[str, list[float]] = {"raw": [], "loader": []}
    for turn in range(ROUNDS + 1):
        for name, run in (("raw", lambda: decode_raw(source, clips)), ("loader", load)):
            before = processor_seconds(everyone)
            run()
            if turn:  # the first round opens files and touches memory for the first time
                times[name].append(processor_seconds(everyone) - before)
    raw, loaded = (frames / statistics.median(spent) for spent in times.values())
    return source.decoder.name, raw, loaded, loaded / raw


def latent_batches(root: Path) -> Iterator[tuple[str, float]]:
    """Milliseconds that a batch of 256 clips of three views takes from a store, and resident."""
    case = CASES["64x96"]
    write_recordings(root / "set", case)
    encode_latents(EncodeLatentsConfig(), {"episodes": root / "set", "tokenizer": TOKENIZER}, root / "latents")
    store = LatentStore.open(root / "latents")
    sampling = ClipSampling.model_validate({"lengths": case["lengths"]})
    sampler = ClipSampler(store.rows, sampling, views=VIEWS, start_step=store.start_step, batch_size=256, seed=0)
    for name, source in (("read", store), ("resident", ResidentLatents(store, "cpu"))):
        load, steps = ClipLoader(source, views=VIEWS).batches(sampler), count()
        yield name, 1000 * seconds_of(lambda load=load, steps=steps: load(next(steps)))


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--only", choices=sorted([*CASES, "latents"]))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)

    def rows() -> Iterator[tuple[str | float, ...]]:
        for name, case in CASES.items():
            if arguments.only in (None, name):
                with tempfile.TemporaryDirectory() as folder:
                    yield name, *measure(case, write_recordings(Path(folder) / "set", case), arguments.processes)

    if arguments.only != "latents":
        print(f"{arguments.processes} loader processes; frames per second of processor time")
        print_table(("", "decoder", "raw", "loader", "loader over raw"), rows())
    if arguments.only in (None, "latents"):
        with tempfile.TemporaryDirectory() as folder:
            print_table(("256 clips of latents", "ms"), latent_batches(Path(folder)))


if __name__ == "__main__":
    main()
