"""Step `record`: simulated robots, scenes and noisy controllers into an EpisodeSet.

Deterministic per (seed, embodiment, split, number): any number of processes, a kill and a restart give the same
bytes. Needs the optional dependency MuJoCo and an OpenGL library for off-screen rendering.
"""

from __future__ import annotations

import importlib
import multiprocessing
import os
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator
from tqdm import tqdm

from worldline_core.config import StrictModel
from worldline_core.errors import UnavailableError
from worldline_core.store.atomic import write_json_atomic

Embodiment = Literal["aloha_viperx", "ur5e_pair", "xarm7_pair", "panda_pair", "so101"]
Family = Literal["lift", "place", "state_change", "play"]
Defect = Literal[
    "static_lead_in",
    "reset_segment",
    "frozen_camera",
    "corrupted_frames",
    "lagged_state",
    "inverted_extrinsics",
    "intrinsics_of_other_size",
]


class RecordGroup(StrictModel):
    """``count`` episodes of one embodiment in one split; families take turns."""

    embodiment: Embodiment
    split: Literal["train", "validation", "test", "ood_test"] = "train"
    count: int = Field(ge=1)
    families: tuple[Family, ...] = ("lift", "place", "state_change", "play")


class RecordConfig(StrictModel):
    """What to record.

    Attributes:
        seed: every seed gives other episodes (and other episode ids).
        num_frames: frames per episode at 8 per second.
        workers: processes.
        video_crf: x264 quality of the stored videos.
        mcap: also write every episode as an MCAP file under ``mcap/``.
        defects: by embodiment, how many of the first training recordings are spoiled in which way (see
            ``defects.py``); what was done to which episode is written to ``injected_defects.json``.
    """

    groups: tuple[RecordGroup, ...] = Field(min_length=1)
    seed: int = Field(default=0, ge=0)
    num_frames: int = Field(default=33, ge=17, le=400)
    workers: int = Field(default=2, ge=1, le=64)
    video_crf: int = Field(default=18, ge=0, le=51)
    mcap: bool = False
    defects: dict[Embodiment, dict[Defect, int]] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _enough_to_spoil(self) -> RecordConfig:
        for embodiment, wanted in self.defects.items():
            recorded = sum(g.count for g in self.groups if g.embodiment == embodiment and g.split == "train")
            if sum(wanted.values()) > recorded:
                raise ValueError(f"{sum(wanted.values())} defects for {recorded} training episodes of {embodiment}")
        return self


@dataclass(frozen=True)
class Job:
    """One episode to record: what it is, and the seed of all its draws."""

    episode_id: str
    embodiment: str
    split: str
    family: str
    entropy: tuple[int, ...]
    defect: str | None = None


# Streams keep the draws of splits and embodiments apart; numbers never change once released.
EMBODIMENT_STREAM = {"aloha_viperx": 0, "ur5e_pair": 1, "xarm7_pair": 2, "panda_pair": 3, "so101": 4}
SPLIT_STREAM = {"train": 0, "validation": 1, "test": 2, "ood_test": 3, "bank": 4}


def plan_jobs(config: RecordConfig) -> list[Job]:
    """All episodes of a configuration, embodiments mixed so that an interrupted run holds some of each."""
    columns: list[list[tuple[float, Job]]] = []
    spoiled = {
        embodiment: [name for name, count in wanted.items() for _ in range(count)]
        for embodiment, wanted in config.defects.items()
    }
    numbers: dict[tuple[str, str], int] = {}
    for group in config.groups:
        column: list[tuple[float, Job]] = []
        for position in range(group.count):
            key = (group.embodiment, group.split)
            number = numbers.get(key, 0)
            numbers[key] = number + 1
            waiting = spoiled.get(group.embodiment, []) if group.split == "train" else []
            job = Job(
                episode_id=f"{group.embodiment}-{group.split}-s{config.seed}-{number:05d}",
                embodiment=group.embodiment,
                split=group.split,
                family=group.families[position % len(group.families)],
                entropy=(config.seed, EMBODIMENT_STREAM[group.embodiment], SPLIT_STREAM[group.split], number),
                defect=waiting.pop(0) if waiting else None,
            )
            column.append((position / group.count, job))
        columns.append(column)
    # Tenths of every group in turn, so that a worker keeps its compiled model for a while.
    merged = sorted(
        (round(share * 10), job.embodiment, job.split, job.episode_id, job) for c in columns for share, job in c
    )
    return [item[-1] for item in merged]


def prepare_rendering() -> None:
    """Choose the off-screen OpenGL back end; ``MUJOCO_GL`` decides where it is set, otherwise EGL.

    Raises: UnavailableError when MuJoCo is not installed.
    """
    chosen = "MUJOCO_GL" in os.environ
    os.environ.setdefault("MUJOCO_GL", "egl")
    try:
        import mujoco  # noqa: F401
    except ImportError as error:
        raise UnavailableError(
            "Recording needs MuJoCo",
            got=str(error),
            next_step="install the extra: uv sync --extra sim; on Debian also libegl1 libegl-mesa0 libgl1-mesa-dri",
        ) from error
    if not chosen:
        # MuJoCo reads the variable once, at import: where it was imported earlier, it has settled on a window.
        for name in ("mujoco.rendering.classic.gl_context", "mujoco.gl_context"):
            if name in sys.modules:
                importlib.reload(sys.modules[name])


_RECORDERS: dict[str, Any] = {}


def _record_job(task: tuple[Job, RecordConfig, Path]) -> tuple[str, str, str]:
    """Record one episode into the set's parts; runs in a worker process."""
    from worldline_core.data.episodes.episode_set import EpisodeSetWriter
    from worldline_core.recorder.defects import DEFECTS
    from worldline_core.recorder.scene_model import FRAME_RATE
    from worldline_core.recorder.simulate import EpisodeRecorder

    job, config, output = task
    if job.embodiment not in _RECORDERS:
        for recorder in _RECORDERS.values():
            recorder.close()
        _RECORDERS.clear()
        _RECORDERS[job.embodiment] = EpisodeRecorder(job.embodiment)
    recording = _RECORDERS[job.embodiment].record(
        episode_id=job.episode_id,
        split=job.split,
        family=job.family,
        entropy=job.entropy,
        num_frames=config.num_frames,
    )
    if job.defect is not None:
        recording = DEFECTS[job.defect](recording, np.random.default_rng((*job.entropy, 1)))
    if config.mcap:
        from worldline_core.data.mcap.io import write_episode_mcap

        path = output / "mcap" / f"{job.episode_id}.mcap"
        write_episode_mcap(path, recording.episode, recording.frames, robot_masks=recording.robot_masks)
    writer = EpisodeSetWriter(output, fps=FRAME_RATE, video_crf=config.video_crf)
    writer.add(recording.episode, recording.frames, recording.robot_masks)
    return job.embodiment, job.family, recording.episode.outcome


def run_jobs(jobs: list[Job], config: RecordConfig, output: Path) -> Iterator[tuple[str, str, str]]:
    """Record in ``config.workers`` processes; yields (embodiment, family, outcome) as episodes get done."""
    tasks = [(job, config, output) for job in jobs]
    if config.workers == 1 or len(tasks) <= 1:
        for task in tasks:
            yield _record_job(task)
        for recorder in _RECORDERS.values():
            recorder.close()
        _RECORDERS.clear()
        return
    # A fresh interpreter per worker: OpenGL contexts do not survive a fork.
    context = multiprocessing.get_context("spawn")
    with context.Pool(config.workers) as pool:
        yield from pool.imap_unordered(_record_job, tasks, chunksize=6)


def record(config: RecordConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """Record an EpisodeSet into ``output``; finished episodes survive a kill.

    Returns counts: episodes, and outcomes per embodiment and family.

    Raises: UnavailableError without MuJoCo; DataError when a task cannot be reached by an arm.
    """
    from worldline_core.data.episodes.episode_set import EpisodeSet, EpisodeSetWriter
    from worldline_core.recorder.defects import DEFECTS_FILE
    from worldline_core.recorder.scene_model import FRAME_RATE

    prepare_rendering()
    writer = EpisodeSetWriter(output, fps=FRAME_RATE, video_crf=config.video_crf)
    jobs = plan_jobs(config)
    waiting = [job for job in jobs if not writer.has(job.episode_id)]
    progress = tqdm(total=len(jobs), initial=len(jobs) - len(waiting), desc="record", unit="episode", disable=None)
    with progress:
        for _ in run_jobs(waiting, config, output):
            progress.update()
    writer.close()
    table: dict[str, dict[str, dict[str, int]]] = {}
    for row in EpisodeSet.open(output).rows:
        cell = table.setdefault(row.embodiment, {}).setdefault(row.task_family, {})
        cell[row.outcome] = cell.get(row.outcome, 0) + 1
    defects = {job.episode_id: job.defect for job in sorted(jobs, key=lambda job: job.episode_id) if job.defect}
    if defects:
        write_json_atomic(output / DEFECTS_FILE, defects)
    counts = {"episodes": len(jobs), "outcomes": table}
    write_json_atomic(output / "recording.json", counts)
    return counts
