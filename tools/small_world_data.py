"""Recordings of the small world for training in memory: files at the model's resolution, and their latents.

A file holds up to ten episodes of one body and one split, with all that training reads: frames, action maps, and where
the robot and the things are. `record_files` writes them in several processes; `Memory` reads what is there, also
while more is being recorded, and keeps the latents on the device.

Axes: n episodes, v views, c latent channels, f video frames, t latent frames, h and w rows and columns.
"""

from __future__ import annotations

import functools
import json
import multiprocessing
import os
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, field
from itertools import zip_longest
from pathlib import Path

import cv2
import numpy as np
import torch
from einops import rearrange
from safetensors import safe_open
from safetensors.numpy import save
from torch import Tensor
from tqdm import tqdm

from worldline_core.actions.action_maps import latent_frame_indices, render_action_maps
from worldline_core.actions.action_tracks import compute_tracks
from worldline_core.actions.actions_config import TEMPORAL_FACTOR
from worldline_core.actions.episode_tracks import collate_tracks
from worldline_core.config import CONFIG_ROOT, load_config
from worldline_core.distillation.auxiliary_losses import clip_robot_masks
from worldline_core.errors import DataError
from worldline_core.geometry.kinematics import KinematicsByName
from worldline_core.model.patch_tokenizer import PatchTokenizer
from worldline_core.model.world_model_config import VIEWS
from worldline_core.recorder.record import Job, RecordConfig, open_recorder, plan_jobs
from worldline_core.recorder.rendering import prepare_rendering
from worldline_core.recorder.simulate import EpisodeRecorder, Recording
from worldline_core.store.atomic import write_bytes_atomic
from worldline_core.training.train_tokenizer import to_video

SIZE, GRID, SIGMA_PX_REF = (64, 96), (8, 12), 36.0
SHORT = 33
"""Frames of a short recording; all others are long."""
EPISODES_A_FILE = 10
FIRST_SEED, VALIDATION_SEED = 3000, 3990
VARIED_SEEDS = range(3200, 3208)
PATIENCE_S = 600.0


@dataclass(frozen=True)
class Fact:
    """What is known of a recorded episode besides its arrays."""

    id: str
    embodiment: str
    split: str
    outcome: str
    family: str
    instruction: str
    failure: str
    held_out_camera: bool


@dataclass(frozen=True)
class FileTask:
    """One file to record: its place, the episodes in it, and whether masks at full resolution are kept."""

    path: Path
    jobs: list[Job]
    num_frames: int
    with_masks: bool


def recordings(last_seed: int) -> list[tuple[str, RecordConfig]]:
    """Names and configurations in the order in which they are recorded: first what training can begin with.

    "validation" is fifty more episodes of each body in training scenes, of a seed that nothing trains on.
    """
    folder = CONFIG_ROOT / "recording"
    training, varied, test, long = (
        load_config(RecordConfig, path=folder / f"{name}.yaml")
        for name in ("small_world", "small_world_varied", "small_world_test", "small_world_long")
    )
    chunks = [("small_world", training.model_copy(update={"seed": seed})) for seed in range(FIRST_SEED, last_seed + 1)]
    groups = tuple(group.model_copy(update={"count": 50}) for group in training.groups if group.split == "validation")
    validation = ("validation", training.model_copy(update={"groups": groups, "seed": VALIDATION_SEED}))
    held_out, long_ones = ("small_world_test", test), ("small_world_long", long)
    first = [*chunks[:1], validation, *chunks[1:4], held_out, *chunks[4:6], long_ones]
    worse = [("small_world_varied", varied.model_copy(update={"seed": seed})) for seed in VARIED_SEEDS]
    # By turns, so that a training that does not wait for all has some of each.
    turns = [name for pair in zip_longest(worse, chunks[6:]) for name in pair if name is not None]
    return [*first, *turns]


def plan_files(folder: Path, last_seed: int, only: str | None) -> list[FileTask]:
    """All files, numbered in the order of `recordings`; of one of them alone with `only`, under the same numbers."""
    wanted: list[FileTask] = []
    first = 0
    for name, config in recordings(last_seed):
        groups: dict[tuple[str, str, bool], list[Job]] = defaultdict(list)
        for job in plan_jobs(config):
            groups[job.embodiment, job.split, job.held_out_camera].append(job)
        files = [
            (jobs[start : start + EPISODES_A_FILE], split != "train" or name == "small_world_long")
            for (_, split, _), jobs in groups.items()
            for start in range(0, len(jobs), EPISODES_A_FILE)
        ]
        # Bodies mixed, so that an unfinished recording has some of each.
        order = list(range(len(files)))
        np.random.default_rng(0).shuffle(order)
        tasks = [
            FileTask(folder / f"{number:05d}.safetensors", files[index][0], config.num_frames, files[index][1])
            for number, index in enumerate(order, first)
        ]
        first += len(tasks)
        if only in (None, name):
            wanted += tasks
    return wanted


def record_files(tasks: list[FileTask], workers: int) -> None:
    """Record the files that are not there yet, in several processes."""
    missing = [task for task in tasks if not task.path.exists()]
    prepare_rendering()
    # One thread for each process: together they would take many times the cores there are.
    os.environ.update(OMP_NUM_THREADS="1", MKL_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
    # A fresh interpreter for each process: OpenGL contexts do not survive a fork.
    with multiprocessing.get_context("spawn").Pool(workers) as pool:
        done = pool.imap_unordered(record_file, missing)
        for _ in tqdm(done, desc="record", unit="file", total=len(missing), mininterval=10):
            pass


# A compiled model serves all files of its body in this process.
_recorder = functools.cache(open_recorder)


@functools.cache
def _kinematics() -> KinematicsByName:
    return KinematicsByName({})


def record_file(task: FileTask) -> None:
    """Record some episodes of one body into one file."""
    recorder = _recorder(task.jobs[0].embodiment, task.jobs[0].held_out_camera)
    arrays: dict[str, list[np.ndarray]] = defaultdict(list)
    facts: list[Fact] = []
    for job in task.jobs:
        recording = _recorded(recorder, job, task.num_frames)
        for name, array in _arrays(recording, task.with_masks).items():
            arrays[name].append(array)
        episode = recording.episode
        facts.append(
            Fact(
                id=job.episode_id,
                embodiment=job.embodiment,
                split=job.split,
                outcome=episode.outcome,
                family=job.family,
                instruction=episode.instruction,
                failure=recording.failure,
                held_out_camera=job.held_out_camera,
            )
        )
    # The next file is of another body: its renderers need the memory of these.
    recorder.close()
    header = {"facts": json.dumps([asdict(fact) for fact in facts])}
    write_bytes_atomic(task.path, save({name: np.stack(values) for name, values in arrays.items()}, metadata=header))


def _recorded(recorder: EpisodeRecorder, job: Job, num_frames: int) -> Recording:
    return recorder.record(
        episode_id=job.episode_id,
        split=job.split,
        family=job.family,
        entropy=job.entropy,
        num_frames=num_frames,
        policy=job.policy,
    )


def _arrays(recording: Recording, with_masks: bool) -> dict[str, np.ndarray]:
    """An episode's part of `Recorded`, by name."""
    episode, count = recording.episode, recording.episode.num_frames
    tracks, _ = compute_tracks(episode, _kinematics().get(episode.embodiment))
    cut = tracks.clip(latent_frame_indices(count))
    maps = render_action_maps(collate_tracks([cut], views=VIEWS), cut.image_size, GRID, sigma_px_ref=SIGMA_PX_REF)
    robot = clip_robot_masks([tracks.clip(list(range(count)))], VIEWS, GRID)
    frames = np.empty((len(VIEWS), count, *SIZE, 3), np.uint8)
    things = np.zeros((len(VIEWS), 2, count, *GRID), np.float32)
    masks = np.zeros((len(VIEWS), 2, count, *SIZE), np.uint8)
    for v, view in enumerate(VIEWS):
        labels, robots = recording.thing_labels[view], recording.robot_masks[view]
        for f in range(count):
            frames[v, f] = cv2.resize(recording.frames[view][f], SIZE[::-1], interpolation=cv2.INTER_AREA)
            things[v, :, f] = _shares((labels[f] == 1, labels[f] > 1), GRID)
            if with_masks:
                masks[v, :, f] = _shares((robots[f], labels[f] == 1), SIZE) >= 0.5
    # A latent frame covers four frames: the largest share of them.
    grouped = rearrange(things[:, :, 1:], "v k (t g) h w -> v k t g h w", g=TEMPORAL_FACTOR).max(axis=3)
    arrays = {
        "maps": maps[0].half().numpy(),
        "robot": robot[0].numpy().astype(np.uint8),
        "things": np.concatenate((things[:, :, :1], grouped), axis=2).astype(np.float16),
        "frames": frames,
    }
    return arrays | ({"masks": masks} if with_masks else {})


def _shares(masks: Iterable[np.ndarray], size: tuple[int, int]) -> np.ndarray:
    """Of each cell of a grid (rows, columns), the share that each mask covers."""
    return np.stack([cv2.resize(m.astype(np.float32), size[::-1], interpolation=cv2.INTER_AREA) for m in masks])


@dataclass(frozen=True)
class Recorded:
    """What a file holds.

    Attributes:
        frames: uint8 (n, v, f, 64, 96, 3).
        maps: float16 (n, v, 9, t, 8, 12) action maps.
        robot: uint8 (n, v, t, 8, 12) where the robot is.
        things: float16 (n, v, 2, t, 8, 12) share of each cell that shows what the task moves, and other things.
        masks: uint8 (n, v, 2, f, 64, 96) the robot, and what the task moves; None in short recordings for training.
    """

    facts: list[Fact]
    frames: np.ndarray
    maps: np.ndarray
    robot: np.ndarray
    things: np.ndarray
    masks: np.ndarray | None = None

    @classmethod
    def read(cls, path: Path) -> Recorded:
        with safe_open(path, framework="numpy") as file:
            names = list(file.keys())
            facts = [Fact(**values) for values in json.loads(file.metadata()["facts"])]
            return cls(facts, **{name: file.get_tensor(name) for name in names})

    @property
    def split(self) -> str:
        return self.facts[0].split

    @property
    def short(self) -> bool:
        return self.frames.shape[2] == SHORT


@dataclass
class Arrivals:
    """The files of a folder, each read once, in the order of their numbers."""

    folder: Path
    seen: set[Path] = field(default_factory=set)

    def new(self) -> Iterator[Recorded]:
        """Files that have come since."""
        for path in sorted(set(self.folder.glob("[0-9]*.safetensors")) - self.seen):
            self.seen.add(path)
            yield Recorded.read(path)

    def wait(self, take: Callable[[], int], wanted: int) -> None:
        """Call `take`, which reads files and gives the number of episodes that are there, until there are `wanted`.

        Raises: DataError when no file comes for ten minutes.
        """
        files, since = len(self.seen), time.monotonic()
        while (there := take()) < wanted:
            if len(self.seen) > files:
                files, since = len(self.seen), time.monotonic()
            elif time.monotonic() - since > PATIENCE_S:
                raise DataError(
                    "Too few recordings, and no more come",
                    where=self.folder,
                    expected=f"{wanted} episodes",
                    got=there,
                    next_step="record more, or wait for fewer",
                )
            time.sleep(1)


@dataclass(frozen=True)
class Episodes:
    """Episodes of one length and one split on the device.

    Attributes:
        latents: half (n, v, c, t, h, w).
        singles: half (n, v, c, t, h, w): the last video frame of every latent frame coded alone, as first frames of
            clips are; of long recordings only.
        maps, things, robot: as in `Recorded`.
    """

    facts: list[Fact]
    latents: Tensor
    maps: Tensor
    things: Tensor
    robot: Tensor
    singles: Tensor | None

    def __len__(self) -> int:
        return len(self.facts)

    def draw(self, size: int, generator: torch.Generator) -> Tensor:
        """Rows (size,) of random episodes."""
        return torch.randint(len(self), (size,), generator=generator, device=self.latents.device)

    def clips(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Latents and action maps of whole episodes, in single precision."""
        return self.latents[rows].float(), self.maps[rows].float()

    def cuts(self, rows: Tensor, starts: Tensor, blocks: int) -> tuple[Tensor, Tensor]:
        """Latents and action maps of parts of long episodes: `starts` alone as first frames, then blocks of four.

        Raises: DataError for short recordings, whose frames are not coded alone.
        """
        if self.singles is None:
            raise DataError("Short recordings are not cut", expected="recordings of small_world_long.yaml")
        frames = starts[:, None] + torch.arange(4 * blocks + 1, device=starts.device)
        later = rearrange(self.latents[rows[:, None], :, :, frames[:, 1:]], "n t v c h w -> n v c t h w")
        first = rearrange(self.singles[rows, :, :, starts], "n v c h w -> n v c 1 h w")
        maps = rearrange(self.maps[rows[:, None], :, :, frames], "n t v c h w -> n v c t h w")
        return torch.cat((first, later), dim=3).float(), maps.float()

    def random_cuts(self, size: int, generator: torch.Generator, blocks: int) -> tuple[Tensor, Tensor]:
        """Latents and action maps of random parts of random long episodes."""
        rows = self.draw(size, generator)
        last = self.latents.shape[3] - 4 * blocks
        return self.cuts(rows, torch.randint(last, (size,), generator=generator, device=rows.device), blocks)


def joined(parts: list[Episodes]) -> Episodes:
    """Episodes of several parts, in their order."""

    def cat(name: str) -> Tensor:
        return torch.cat([getattr(part, name) for part in parts])

    return Episodes(
        facts=[fact for part in parts for fact in part.facts],
        latents=cat("latents"),
        maps=cat("maps"),
        things=cat("things"),
        robot=cat("robot"),
        singles=None if parts[0].singles is None else cat("singles"),
    )


@dataclass
class Memory:
    """Recordings of a folder as latents on the tokenizer's device; `poll` adds what has come since.

    Attributes:
        held: short recordings of other splits than "train", to measure with.
    """

    arrivals: Arrivals
    tokenizer: PatchTokenizer
    held: list[Recorded] = field(default_factory=list)
    _episodes: dict[tuple[bool, str], Episodes] = field(default_factory=dict)

    @property
    def device(self) -> str:
        return self.tokenizer.mean.device.type

    def poll(self) -> None:
        fresh: dict[tuple[bool, str], list[Episodes]] = defaultdict(list)
        for recorded in self.arrivals.new():
            fresh[recorded.short, recorded.split].append(self._encoded(recorded))
            if recorded.short and recorded.split != "train":
                self.held.append(recorded)
        for kind, parts in fresh.items():
            self._episodes[kind] = joined([self._episodes[kind], *parts] if kind in self._episodes else parts)

    def wait(self, wanted: int) -> None:
        """Wait for short recordings to train with.

        Raises: DataError when no more come.
        """

        def take() -> int:
            self.poll()
            return self.count()

        self.arrivals.wait(take, wanted)
        counts = {f"{'short' if short else 'long'} {split}": len(e) for (short, split), e in self._episodes.items()}
        print("recordings", json.dumps(counts), flush=True)

    def count(self, split: str = "train", *, short: bool = True) -> int:
        """Number of recordings of a split."""
        return len(self._episodes[short, split]) if (short, split) in self._episodes else 0

    def episodes(self, split: str = "train", *, short: bool = True) -> Episodes:
        """Recordings of a split.

        Raises: DataError when there are none.
        """
        if (short, split) not in self._episodes:
            raise DataError(
                f"No {'short' if short else 'long'} recordings of the split {split}",
                where=self.arrivals.folder,
                next_step="record them, or leave out of the plan what needs them",
            )
        return self._episodes[short, split]

    @torch.no_grad()
    def _encoded(self, recorded: Recorded) -> Episodes:
        video = videos(recorded.frames, self.device)
        singles = None
        if not recorded.short:
            frames = rearrange(video[:, :, :, ::TEMPORAL_FACTOR], "n v c t h w -> (n v t) c 1 h w")
            codes = self.tokenizer.encode(frames).half()
            singles = rearrange(codes, "(n v t) c 1 h w -> n v c t h w", n=len(video), v=len(VIEWS))
        return Episodes(
            facts=recorded.facts,
            latents=self.encode(video).half(),
            maps=torch.from_numpy(recorded.maps).to(self.device),
            things=torch.from_numpy(recorded.things).to(self.device),
            robot=torch.from_numpy(recorded.robot).to(self.device),
            singles=singles,
        )

    def encode(self, video: Tensor) -> Tensor:
        """Latents (n, v, c, t, h, w) of videos (n, v, 3, f, H, W) in [-1, 1]."""
        return self.tokenizer.encode(video.flatten(0, 1)).unflatten(0, (-1, len(VIEWS)))


def videos(frames: np.ndarray, device: str) -> Tensor:
    """Frames uint8 (n, v, f, H, W, 3) as (n, v, 3, f, H, W) in [-1, 1]."""
    return to_video(rearrange(torch.from_numpy(frames).to(device), "n v f h w c -> n v c f h w"))
