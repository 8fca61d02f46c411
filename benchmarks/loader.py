"""Speed of the training input beside raw decoding of the same clips.

Run: `python benchmarks/loader.py [--processes 2] [--only 480x640]`. It makes its own recordings (three views, encoded as
curation does) in a temporary folder, then times, in turns so that a busy machine disturbs all alike:

- *raw*: processes that do nothing but decode the clips and drop the frames;
- *loader*: the same number of loader processes that read the same clips in the same order, and the
  training process that takes every batch from them.

The ratio of a table is loader to raw in frames per second of processor time, all processes added up (the training process
too), which hardly depends on what else the machine does; the ratio by the clock stands beside it. Medians of the rounds.
"""

from __future__ import annotations

import multiprocessing
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.harness import RECORDINGS, command_line, print_table
from worldline_core.data.episodes.episode import VIEWS, Episode
from worldline_core.data.episodes.episode_set import EpisodeSet, EpisodeSetWriter
from worldline_core.training.clip_config import ClipSampling, FrameInput, ReadingConfig
from worldline_core.training.clip_loader import ClipDataset, read_ahead
from worldline_core.training.clip_sampler import Clip, ClipBatch, ClipSampler
from worldline_core.training.clip_source import FrameSource

TICK = os.sysconf("SC_CLK_TCK")
CASES: dict[str, dict[str, Any]] = {
    "480x640": {"size": (480, 640), "fps": 30.0, "episodes": 4, "frames": 160, "lengths": (33, 65, 97), "batch": 1, "steps": 10},
    "64x96": {"size": (64, 96), "fps": 8.0, "episodes": 12, "frames": 80, "lengths": (33,), "batch": 8, "steps": 12},
}  # fmt: skip


def scene(seed: int, count: int, height: int, width: int) -> np.ndarray:
    """uint8 (N, H, W, 3): textured things that move over a textured background, with sensor noise."""
    random = np.random.default_rng(seed)
    coarse = random.integers(30, 220, (height // 16 + 2, width // 16 + 2, 3), dtype=np.uint8)
    background = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    thing = random.integers(0, 255, (height // 4, width // 4, 3), dtype=np.uint8)
    thing = cv2.GaussianBlur(thing, (5, 5), 0)
    frames = np.empty((count, height, width, 3), np.uint8)
    for index in range(count):
        frame = background.copy()
        row = int((0.5 + 0.4 * np.sin(0.05 * index + seed)) * (height - thing.shape[0]))
        column = int((0.5 + 0.4 * np.cos(0.03 * index + 2 * seed)) * (width - thing.shape[1]))
        frame[row : row + thing.shape[0], column : column + thing.shape[1]] = thing
        noise = random.integers(-3, 4, (height, width, 1), dtype=np.int16)
        frames[index] = np.clip(frame + noise, 0, 255)
    return frames


def write_recordings(root: Path, case: dict[str, Any]) -> EpisodeSet:
    """An EpisodeSet of the case's size."""
    count = case["frames"]
    with EpisodeSetWriter(root, video_preset="fast") as writer:
        for number in range(case["episodes"]):
            state = np.zeros((count, 2), np.float32)
            episode = Episode(
                episode_id=f"episode-{number:03d}",
                source="benchmark",
                embodiment="none",
                scene=f"scene-{number}",
                task_family="unknown",
                instruction="",
                outcome="unknown",
                split="train",
                fps=case["fps"],
                state=state,
                action=state,
                timestamps=np.arange(count) / case["fps"],
                state_names=("joint", "gripper"),
            )
            views = {view: scene(3 * number + place, count, *case["size"]) for place, view in enumerate(VIEWS)}
            writer.add(episode, views)
    return EpisodeSet.open(root)


def processor_seconds(processes: Sequence[int]) -> float:
    """User and system time that processes have used."""
    total = 0
    for number in processes:
        fields = Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()
        total += int(fields[11]) + int(fields[12])
    return total / TICK


def decode_raw(source: FrameSource, clips: Sequence[Clip]) -> None:
    """Every frame of the clips, and nothing more."""
    for clip in clips:
        position = source.episodes.position(clip.episode_id)
        for view in VIEWS:
            for _ in source.decoder.frames(source.episodes.clip(position, view), clip.frames):
                pass


def serve(source: FrameSource, clips: list[Clip], pipe: Connection) -> None:
    """A process of the baseline: one pass over its clips whenever it is asked."""
    import torch

    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    while pipe.recv():
        decode_raw(source, clips)
        pipe.send(True)


class Baseline:
    """Processes that share clips as the loader's do: clip i belongs to process i modulo their number."""

    def __init__(self, source: FrameSource, batches: list[tuple[Clip, ...]], processes: int) -> None:
        context = multiprocessing.get_context("spawn")
        self.processes, self.pipes = [], []
        for number in range(processes):
            ours, theirs = context.Pipe()
            clips = [clip for batch in batches[number::processes] for clip in batch]
            process = context.Process(target=serve, args=(source, clips, theirs), daemon=True)
            process.start()
            self.processes.append(process)
            self.pipes.append(ours)

    def run(self) -> None:
        for pipe in self.pipes:
            pipe.send(True)
        for pipe in self.pipes:
            pipe.recv()

    def close(self) -> None:
        for pipe in self.pipes:
            pipe.send(False)
        for process in self.processes:
            process.join()


class RepeatedClips:
    """The clips of the first steps again and again, so that every pass reads what the baselines read."""

    def __init__(self, sampler: ClipSampler, steps: int) -> None:
        self.sampler, self.steps = sampler, steps

    def clips(self, index: int) -> ClipBatch:
        return self.sampler.clips(index % self.steps)


def measure(case: dict[str, Any], episodes: EpisodeSet, processes: int, rounds: int) -> dict[str, Any]:
    """Frames a second of the loader and of the baseline."""
    config = FrameInput.model_validate({"image_size": case["size"]})
    source = FrameSource(episodes, RECORDINGS.with_name("models") / "tokenizer", config)
    sampling = ClipSampling.model_validate({"lengths": case["lengths"]})
    sampler = ClipSampler(
        source.rows, sampling, views=VIEWS, splits=["train"], start_step=1, batch_size=case["batch"], seed=0
    )
    steps = case["steps"]
    batches = [sampler.clips(index).clips for index in range(steps)]
    frames = len(VIEWS) * sum(clip.num_frames for batch in batches for clip in batch)
    raw = Baseline(source, batches, processes)
    repeated: Any = RepeatedClips(sampler, steps)
    loader = read_ahead(ClipDataset(source, repeated, ReadingConfig(workers=processes)), 0, None)

    loading: list[int] = []

    def load() -> None:
        for _ in range(steps):
            next(loader)
        # What was read ahead before is read again before the clock stops: a pass reads as much as it takes.
        spent = -1.0
        while (now := processor_seconds(loading)) > spent:
            spent = now
            time.sleep(0.1)

    baselines = {process.pid for process in raw.processes}
    load()
    loading += [process.pid or 0 for process in multiprocessing.active_children() if process.pid not in baselines]
    me = os.getpid()
    runs: dict[str, tuple[Callable[[], None], list[int]]] = {
        "raw": (raw.run, [process.pid for process in raw.processes]),
        "loader": (load, loading),
    }
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in runs}
    for turn in range(rounds + 1):
        for name, (run, workers) in runs.items():
            before, started = processor_seconds([me, *workers]), time.perf_counter()
            run()
            spent = processor_seconds([me, *workers]) - before, time.perf_counter() - started
            if turn:  # the first round opens files and touches memory for the first time
                times[name].append(spent)
    raw.close()
    found: dict[str, Any] = {"decoder": source.decoder.name, "frames_a_round": frames}
    for name, spent in times.items():
        found[f"{name}_frames_per_processor_second"] = frames / statistics.median(cpu for cpu, _ in spent)
        found[f"{name}_frames_per_second"] = frames / statistics.median(wall for _, wall in spent)
    found["ratio"] = found["loader_frames_per_processor_second"] / found["raw_frames_per_processor_second"]
    # By pairs of neighbours in time: what else the machine did was most alike for those.
    found["ratio_by_the_clock"] = statistics.median(
        a[1] / b[1] for a, b in zip(times["raw"], times["loader"], strict=True)
    )
    return found


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--only", choices=sorted(CASES))
    arguments = parser.parse_args()

    def rows() -> Iterator[tuple[str, ...]]:
        for name, case in CASES.items():
            if arguments.only not in (None, name):
                continue
            with tempfile.TemporaryDirectory() as folder:
                episodes = write_recordings(Path(folder) / "set", case)
                found = measure(case, episodes, arguments.processes, arguments.rounds)
            cells = [
                f"{found[f'{kind}_frames_per_processor_second']:.0f} ({found[f'{kind}_frames_per_second']:.0f})"
                for kind in ("raw", "loader")
            ]
            yield name, found["decoder"], *cells, f"{found['ratio']:.2f} ({found['ratio_by_the_clock']:.2f})"

    print(
        f"{arguments.processes} processes; frames per second of processor time (by the clock), all processes together"
    )
    print_table(("", "decoder", "raw", "loader", "loader over raw"), rows())


if __name__ == "__main__":
    main()
