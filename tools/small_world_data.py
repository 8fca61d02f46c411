"""Recordings of the small world for training in memory: files at the model's resolution.

A file holds up to ten episodes of one body and one split, with all that training reads: frames, action maps, control
vectors, and where the robot and the things are. `record_files` writes them in several processes.

Axes: n episodes, v views, f video frames, t latent frames, h and w rows and columns.
"""

from __future__ import annotations

import functools
import json
import multiprocessing
import os
from collections import defaultdict
from collections.abc import Collection, Iterable
from dataclasses import asdict, dataclass
from itertools import zip_longest
from pathlib import Path

import cv2
import numpy as np
from einops import rearrange
from safetensors import safe_open
from tqdm import tqdm

from worldline_core.actions.action_maps import latent_frame_indices, render_action_maps
from worldline_core.actions.action_tracks import compute_tracks
from worldline_core.actions.actions_config import TEMPORAL_FACTOR
from worldline_core.actions.episode_tracks import collate_tracks, native_vectors
from worldline_core.config import CONFIG_ROOT, load_config
from worldline_core.distillation.auxiliary_losses import clip_robot_masks
from worldline_core.errors import DataError
from worldline_core.geometry.kinematics import KinematicsByName
from worldline_core.model.world_model_config import VIEWS
from worldline_core.recorder.record import RecordConfig, plan_jobs
from worldline_core.recorder.rendering import prepare_rendering
from worldline_core.recorder.simulate import EpisodeRecorder, Job, Recording
from worldline_core.store.atomic import write_arrays_atomic

SIZE, GRID, SIGMA_PX_REF = (64, 96), (8, 12), 36.0
SHORT = 33
"""Frames of a short recording; all others are long."""
EPISODES_A_FILE = 10
NATIVE_SIZE = 32
"""Control vectors are padded to this size."""
NAMES = ("small_world", "validation", "small_world_test", "small_world_long", "small_world_varied")
FIRST_SEED, VALIDATION_SEED = 3000, 3990
VARIED_SEEDS = range(3200, 3208)


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


def plan_files(
    folder: Path, last_seed: int, only: Collection[str] | None, first_seed: int = FIRST_SEED
) -> list[FileTask]:
    """All files, numbered in the order of `recordings`.

    Args:
        only, first_seed: leave out other recordings, and chunks of "small_world" before this seed; the rest keep their numbers.
    """
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
        early = name == "small_world" and config.seed < first_seed
        if (only is None or name in only) and not early:
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
_recorder = functools.cache(EpisodeRecorder)


@functools.cache
def _kinematics() -> KinematicsByName:
    return KinematicsByName({})


def record_file(task: FileTask) -> None:
    """Record some episodes of one body into one file."""
    recorder = _recorder(task.jobs[0].embodiment, task.jobs[0].held_out_camera)
    arrays: dict[str, list[np.ndarray]] = defaultdict(list)
    facts: list[Fact] = []
    for job in task.jobs:
        recording = recorder.record(job, task.num_frames)
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
    write_arrays_atomic(task.path, {name: np.stack(values) for name, values in arrays.items()}, header)


def _arrays(recording: Recording, with_masks: bool) -> dict[str, np.ndarray]:
    """An episode's part of `Recorded`, by name."""
    episode, count = recording.episode, recording.episode.num_frames
    tracks, _ = compute_tracks(episode, _kinematics().get(episode.embodiment))
    cut, whole = tracks.clip(latent_frame_indices(count)), tracks.clip(list(range(count)))
    maps = render_action_maps(collate_tracks([whole], views=VIEWS), whole.image_size, GRID, sigma_px_ref=SIGMA_PX_REF)
    robot = clip_robot_masks([whole], VIEWS, GRID)
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
        "native": native_vectors([cut], VIEWS[:1], NATIVE_SIZE)[0, 0, :, :, 0, 0].numpy(),
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
        maps: float16 (n, v, 9, f, 8, 12) action maps of every frame.
        native: float32 (n, 32, t) control vectors, padded with zeros.
        robot: uint8 (n, v, t, 8, 12) where the robot is.
        things: float16 (n, v, 2, t, 8, 12) share of each cell that shows what the task moves, and other things.
        masks: uint8 (n, v, 2, f, 64, 96) the robot, and what the task moves; None in short recordings for training.
    """

    facts: list[Fact]
    frames: np.ndarray
    maps: np.ndarray
    native: np.ndarray
    robot: np.ndarray
    things: np.ndarray
    masks: np.ndarray | None = None

    @classmethod
    def read(cls, path: Path) -> Recorded:
        """Everything. Raises: DataError for a file of before the maps of every frame were kept."""
        with safe_open(path, framework="numpy") as file:
            names = list(file.keys())
            facts = [Fact(**values) for values in json.loads(file.metadata()["facts"])]
            found = cls(facts, **{name: file.get_tensor(name) for name in names})
        if found.maps.shape[3] != found.frames.shape[2]:
            raise DataError(
                "These recordings lack the action maps of frames between latent frames",
                where=path,
                expected=f"{found.frames.shape[2]} frames of maps",
                got=found.maps.shape[3],
                next_step="remove the folder and record it again",
            )
        return found

    @staticmethod
    def outline(path: Path) -> tuple[list[Fact], int]:
        """Facts of a file's episodes and their number of frames, without its arrays."""
        with safe_open(path, framework="numpy") as file:
            facts = [Fact(**values) for values in json.loads(file.metadata()["facts"])]
            return facts, file.get_slice("frames").get_shape()[2]

    @property
    def split(self) -> str:
        return self.facts[0].split

    @property
    def short(self) -> bool:
        return self.frames.shape[2] == SHORT
