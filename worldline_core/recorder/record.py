"""`worldline record`: simulated robots, scenes and scripted controllers into an EpisodeSet with a manifest.

Deterministic per (seed, embodiment, split, number): any number of processes, a kill and a restart give the same
bytes. Needs the optional dependency MuJoCo and an OpenGL library for off-screen rendering.
"""

from __future__ import annotations

import json
import multiprocessing
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from worldline_core.config import StrictModel
from worldline_core.data.episodes.episode import CameraTrack
from worldline_core.data.episodes.episode_set import EpisodeSet, EpisodeSetWriter
from worldline_core.errors import DataError
from worldline_core.progress import Progress
from worldline_core.recorder.bodies import BODIES
from worldline_core.recorder.controllers import ScriptedPolicy, miss_of
from worldline_core.recorder.looks import LookName
from worldline_core.recorder.rendering import prepare_rendering
from worldline_core.recorder.scene import CONTACT, TASKS, TWO_ARMED, Family
from worldline_core.recorder.simulate import EpisodeRecorder, Job, Recording
from worldline_core.scale.process import end_with_pool
from worldline_core.store.atomic import write_json_atomic

DEFECTS_FILE = "injected_defects.json"


def _stretch(recording: Recording, index: np.ndarray) -> Recording:
    """The recording at frame numbers ``index`` (frames may repeat); time stays even."""
    episode = recording.episode
    cameras = {
        view: replace(camera, T_base_camera=camera.T_base_camera[index]) if camera.moving else camera
        for view, camera in episode.cameras.items()
    }
    return Recording(
        replace(
            episode,
            state=episode.state[index],
            action=episode.action[index],
            timestamps=np.arange(len(index)) / episode.fps,
            cameras=cameras,
        ),
        {view: images[index] for view, images in recording.frames.items()},
        {view: masks[index] for view, masks in recording.robot_masks.items()},
    )


def static_lead_in(recording: Recording, random: np.random.Generator) -> Recording:
    """The robot stands still for two seconds before it starts."""
    count = recording.episode.num_frames
    return _stretch(recording, np.concatenate([np.zeros(16, dtype=np.int64), np.arange(count)]))


def reset_segment(recording: Recording, random: np.random.Generator) -> Recording:
    """The arms jump back to where they started, as when a second attempt is recorded into the same file."""
    count = recording.episode.num_frames
    return _stretch(recording, np.concatenate([np.arange(count), np.arange(count // 2)]))


def frozen_camera(recording: Recording, random: np.random.Generator) -> Recording:
    """The head camera delivers one picture from a quarter of the episode on."""
    images = recording.frames["head"].copy()
    start = len(images) // 4
    images[start:] = images[start]
    return replace(recording, frames={**recording.frames, "head": images})


def corrupted_frames(recording: Recording, random: np.random.Generator) -> Recording:
    """Some frames of the head view are noise or black."""
    images = recording.frames["head"].copy()
    chosen = random.choice(np.arange(4, len(images)), size=8, replace=False)
    for number, frame in enumerate(sorted(int(c) for c in chosen)):
        if number % 2:
            images[frame] = 0
        else:
            images[frame] = random.integers(0, 256, images[frame].shape, dtype=np.uint8)
    return replace(recording, frames={**recording.frames, "head": images})


def lagged_state(recording: Recording, random: np.random.Generator) -> Recording:
    """States and actions are stamped four frames (0.5 s) late against the pictures."""
    index = np.maximum(np.arange(recording.episode.num_frames) - 4, 0)
    episode = replace(recording.episode, state=recording.episode.state[index], action=recording.episode.action[index])
    return replace(recording, episode=episode)


def _with_camera(recording: Recording, view: str, camera: CameraTrack) -> Recording:
    cameras = {**recording.episode.cameras, view: camera}
    return replace(recording, episode=replace(recording.episode, cameras=cameras))


def inverted_extrinsics(recording: Recording, random: np.random.Generator) -> Recording:
    """All camera poses are given as base-in-camera instead of camera-in-base."""
    for view, camera in recording.episode.cameras.items():
        inverse = np.linalg.inv(camera.T_base_camera)
        recording = _with_camera(recording, view, replace(camera, T_base_camera=inverse))
    return recording


def intrinsics_of_other_size(recording: Recording, random: np.random.Generator) -> Recording:
    """K of the head camera belongs to pictures of 480 x 640, the recorded ones are smaller."""
    camera = recording.episode.cameras["head"]
    scale = np.diag([640 / camera.width, 480 / camera.height, 1.0])
    return _with_camera(recording, "head", replace(camera, K=scale @ camera.K))


DEFECTS: dict[str, Callable[[Recording, np.random.Generator], Recording]] = {
    spoil.__name__: spoil
    for spoil in (
        static_lead_in, reset_segment, frozen_camera, corrupted_frames, lagged_state, inverted_extrinsics,
        intrinsics_of_other_size,
    )
}  # fmt: skip


def _one_of(names: Collection[str]) -> AfterValidator:
    def check(name: str) -> str:
        if name not in names:
            raise ValueError(f"expected one of {', '.join(sorted(names))}")
        return name

    return AfterValidator(check)


Embodiment = Annotated[str, _one_of(BODIES)]
Defect = Annotated[str, _one_of(DEFECTS)]
# Random streams of the splits; a number never changes, because recordings must stay the same.
SPLIT_STREAM = {"train": 0, "validation": 1, "test": 2, "ood_test": 3, "bank": 4}

# What went wrong in each failed episode; for evaluation, never read by a judge.
FAILURES_FILE = "failures.json"
# By how much which episodes miss; likewise.
MISSES_FILE = "misses.json"


class RecordGroup(StrictModel):
    """``count`` episodes of one embodiment in one split; families take turns.

    With ``held_out_camera`` the head camera stands where it never stands otherwise. ``look``: the fixed scenes, or scenes drawn from a wide
    range, or from one outside of it (``looks.py``). What was held out is noted in the conventions of drawn looks, ``shift``: look, body,
    camera, or several with a plus. ``num_frames``: as of the whole recording, if not given.
    """

    embodiment: Embodiment
    split: Literal["train", "validation", "test", "ood_test"] = "train"
    count: int = Field(ge=1, le=1_000_000)
    families: tuple[Family, ...] = TASKS
    held_out_camera: bool = False
    look: LookName = "plain"
    num_frames: int | None = Field(default=None, ge=17, le=2000)

    @model_validator(mode="after")
    def _enough_arms(self) -> RecordGroup:
        for family in TWO_ARMED:
            if family in self.families and len(BODIES[self.embodiment].arms) < 2:
                raise ValueError(f"{family} needs two arms; {self.embodiment} has one")
        if self.look == "unseen" and self.split in ("train", "validation"):
            raise ValueError("unseen looks are for tests: split test or ood_test wanted, got " + self.split)
        return self


class Variety(StrictModel):
    """Ordinary controllers carried out worse than planned: near misses, late starts, a gripper at the wrong time.

    Each of the three befalls half of these episodes, by an amount drawn evenly up to the limit.

    Attributes:
        share: of all episodes.
        noise_m: largest standard deviation of the error of aim, along x and along y.
        delay_frames: latest start.
        gripper_delay_frames: earliest and latest gripper, against the arm.
    """

    share: float = Field(ge=0, le=1)
    noise_m: float = Field(ge=0, le=0.2)
    delay_frames: int = Field(ge=0, le=32)
    gripper_delay_frames: tuple[int, int] = (0, 0)

    @model_validator(mode="after")
    def _in_order(self) -> Variety:
        earliest, latest = self.gripper_delay_frames
        if not -32 <= earliest <= latest <= 32:
            raise ValueError(f"gripper_delay_frames: -32 <= earliest <= latest <= 32 wanted, got {earliest}, {latest}")
        return self

    def draw(self, random: np.random.Generator) -> ScriptedPolicy | None:
        """Draw the faults of one episode; None where it is carried out as planned."""
        if random.uniform() >= self.share:
            return None
        noisy, late, gripper_off = random.uniform(size=3) < 0.5
        earliest, latest = self.gripper_delay_frames
        noise = random.uniform(0, self.noise_m)
        delay, gripper = random.integers(self.delay_frames + 1), random.integers(earliest, latest + 1)
        return ScriptedPolicy(
            mistakes=None,
            noise_m=float(noise * noisy),
            delay_frames=int(delay * late),
            gripper_delay_frames=int(gripper * gripper_off),
        )


class RecordConfig(StrictModel):
    """Episodes to record.

    Attributes:
        seed: every seed gives other episodes (and other episode ids).
        num_frames: frames per episode at 8 per second.
        workers: processes.
        video_crf: x264 quality of the stored videos.
        defects: per embodiment, how many of the first training recordings are spoiled in which way
            (``DEFECTS``); what was done to which episode is written to ``injected_defects.json``.
        variety: carry some episodes out worse than planned.
        misses: share of the episodes that miss by any amount, from nothing to well beyond where the outcome turns; by how much
            is written to ``misses.json``.
    """

    groups: tuple[RecordGroup, ...] = Field(min_length=1)
    seed: int = Field(default=0, ge=0)
    num_frames: int = Field(default=33, ge=17, le=2000)
    workers: int = Field(default=2, ge=1, le=64)
    video_crf: int = Field(default=18, ge=0, le=51)
    defects: dict[Embodiment, dict[Defect, int]] = Field(default_factory=dict)
    variety: Variety | None = None
    misses: float = Field(default=0.0, ge=0, le=1)

    def policy(self, family: str, entropy: tuple[int, ...]) -> ScriptedPolicy | None:
        """Change to the execution of one episode; None: as planned."""
        miss = miss_of(self.misses, family, entropy)
        return miss or (self.variety and self.variety.draw(np.random.default_rng((*entropy, 2))))

    @model_validator(mode="after")
    def _enough_to_spoil(self) -> RecordConfig:
        for embodiment, wanted in self.defects.items():
            recorded = sum(g.count for g in self.groups if g.embodiment == embodiment and g.split == "train")
            if sum(wanted.values()) > recorded:
                raise ValueError(f"{sum(wanted.values())} defects for {recorded} training episodes of {embodiment}")
        return self


def plan_jobs(config: RecordConfig) -> list[Job]:
    """All episodes of a configuration, embodiments mixed so that an interrupted run holds some of each."""
    defects = {
        embodiment: [name for name, count in wanted.items() for _ in range(count)]
        for embodiment, wanted in config.defects.items()
    }
    recorded: Counter[tuple[str, str]] = Counter()
    jobs: list[tuple[int, Job]] = []
    for group in config.groups:
        for position in range(group.count):
            number = recorded[group.embodiment, group.split]
            recorded[group.embodiment, group.split] += 1
            entropy = (config.seed, BODIES[group.embodiment].stream, SPLIT_STREAM[group.split], number)
            family = group.families[position % len(group.families)]
            left = defects.get(group.embodiment, []) if group.split == "train" else []
            job = Job(
                episode_id=f"{group.embodiment}-{group.split}-s{config.seed}-{number:05d}",
                embodiment=group.embodiment,
                split=group.split,
                family=family,
                entropy=entropy,
                defect=left.pop(0) if left else None,
                held_out_camera=group.held_out_camera,
                look=group.look,
                policy=config.policy(family, entropy),
                num_frames=group.num_frames or config.num_frames,
            )
            jobs.append((round(10 * position / group.count), job))
    # A tenth of every group in turn, so that a worker keeps its compiled model for a while.
    jobs.sort(
        key=lambda item: (
            item[0], item[1].embodiment, item[1].family in CONTACT, item[1].split, item[1].episode_id
        )
    )  # fmt: skip
    return [job for _, job in jobs]


# One recorder per process: a compiled model and its renderers are reused while the embodiment stays the same.
_RECORDERS: dict[tuple[str, bool], EpisodeRecorder] = {}


def _close_recorders() -> None:
    for recorder in _RECORDERS.values():
        recorder.close()
    _RECORDERS.clear()


def _record_job(task: tuple[Job, RecordConfig, Path]) -> None:
    """Record one episode into the set's parts; runs in a worker process."""
    job, config, output = task
    key = (job.embodiment, job.family in CONTACT)
    if key not in _RECORDERS:
        _close_recorders()
        _RECORDERS[key] = EpisodeRecorder(*key)
    recording = _RECORDERS[key].record(job)
    if recording.failure:
        write_json_atomic(output / "run" / "failures" / f"{job.episode_id}.json", recording.failure)
    if job.defect is not None:
        recording = DEFECTS[job.defect](recording, np.random.default_rng((*job.entropy, 1)))
    writer = EpisodeSetWriter(output, video_crf=config.video_crf)
    writer.add(recording.episode, recording.frames, recording.robot_masks, thing_labels=recording.thing_labels)


def run_in_processes[T, R](work: Callable[[T], R], tasks: Sequence[T], workers: int, chunk: int = 1) -> Iterator[R]:
    """Results of `work` for each task, in their order; the processes end with this one."""
    if workers == 1 or len(tasks) <= 1:
        yield from map(work, tasks)
        return
    # A fresh interpreter per worker: OpenGL contexts do not survive a fork.
    with multiprocessing.get_context("spawn").Pool(workers, end_with_pool) as pool:
        yield from pool.imap(work, tasks, chunksize=chunk)


def record(config: RecordConfig, output: Path) -> dict[str, Any]:
    """Record an EpisodeSet into ``output``; finished episodes survive a kill.

    Returns counts: episodes, and outcomes per embodiment and family.

    Raises: UnavailableError without MuJoCo; DataError when a task cannot be reached by an arm, or the folder holds other
        episodes than these.
    """
    jobs = plan_jobs(config)
    # A kill may come between the set's last file and the account of it.
    if not EpisodeSetWriter.finished(output):
        prepare_rendering()
        writer = EpisodeSetWriter(output, video_crf=config.video_crf)
        missing = [job for job in jobs if not writer.has(job.episode_id)]
        done = len(jobs) - len(missing)
        with Progress("record", len(jobs), "episode", done=done) as progress:
            # Long runs of one body: a worker that changes it compiles a model and opens renderers.
            chunk = min(24, 1 + len(missing) // (4 * config.workers))
            for _ in run_in_processes(_record_job, [(job, config, output) for job in missing], config.workers, chunk):
                progress.advance()
        _close_recorders()
        writer.close()
    table: dict[str, dict[str, dict[str, int]]] = {}
    for row in check_recorded(output, [job.episode_id for job in jobs]).rows:
        cell = table.setdefault(row.embodiment, {}).setdefault(row.task_family, {})
        cell[row.outcome] = cell.get(row.outcome, 0) + 1
    defects = {job.episode_id: job.defect for job in sorted(jobs, key=lambda job: job.episode_id) if job.defect}
    if defects:
        write_json_atomic(output / DEFECTS_FILE, defects)
    missed = {job.episode_id: job.policy.miss.model_dump() for job in jobs if job.policy and job.policy.miss}
    if missed:
        write_json_atomic(output / MISSES_FILE, dict(sorted(missed.items())))
    counts = {"episodes": len(jobs), "outcomes": table}
    failures = {
        path.stem: json.loads(path.read_text()) for path in sorted((output / "run" / "failures").glob("*.json"))
    }
    if failures:
        write_json_atomic(output / FAILURES_FILE, failures)
        counts["failures"] = dict(sorted(Counter(failures.values()).items()))
    return counts


def check_recorded(output: Path, planned: Collection[str]) -> EpisodeSet:
    """The finished set.

    Raises: DataError where it holds other episodes than were planned.
    """
    episodes, wanted = EpisodeSet.open(output), set(planned)
    recorded = {row.episode_id for row in episodes.rows}
    if recorded != wanted:
        raise DataError(
            "The folder holds other episodes than the configuration plans", where=output, expected=f"{len(wanted)} episodes",
            got=f"{len(wanted - recorded)} of them missing, {len(recorded - wanted)} others",
            next_step="record into a new folder",
        )  # fmt: skip
    return episodes
