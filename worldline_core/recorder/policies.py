"""Scripted policies of graded quality: each of them tries every start, so that policies can be compared.

What a simulator is worth to whoever evaluates policies is whether it ranks them as the world does. A start (body, scene,
camera, things, instruction) is one bank of the EpisodeSet, a policy one of its candidates; the episode's source is the
policy's name.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from worldline_core.config import StrictModel
from worldline_core.data.episodes.episode_set import EpisodeSet, EpisodeSetWriter
from worldline_core.errors import DataError
from worldline_core.progress import Progress
from worldline_core.recorder.banks import BankGrid, BankSpec
from worldline_core.recorder.controllers import ScriptedPolicy
from worldline_core.recorder.record import (
    EMBODIMENT_STREAM,
    SPLIT_STREAM,
    check_recorded,
    open_recorder,
    run_in_processes,
)
from worldline_core.recorder.rendering import prepare_rendering
from worldline_core.recorder.scene_model import FRAME_RATE
from worldline_core.recorder.simulate import EpisodeRecorder, Motion
from worldline_core.recorder.things import Layout, sample_layout
from worldline_core.store.atomic import write_json_atomic

PolicyName = Annotated[str, Field(pattern="^[a-z][a-z0-9_]{0,39}$")]


class RecordPoliciesConfig(StrictModel):
    """Every policy from every start of the grid.

    Attributes:
        policies: by name; their order numbers the candidates.
        starts: ``count`` starts of every task with every embodiment.
        workers: processes, each of which records whole starts.
    """

    policies: dict[PolicyName, ScriptedPolicy] = Field(min_length=2)
    starts: BankGrid
    seed: int = Field(default=0, ge=0)
    num_frames: int = Field(default=33, ge=17, le=400)
    workers: int = Field(default=2, ge=1, le=64)
    video_crf: int = Field(default=18, ge=0, le=51)


def draw_start(
    recorder: EpisodeRecorder, start: BankSpec, config: RecordPoliciesConfig
) -> tuple[Layout, dict[str, Motion]]:
    """The first initial state that every policy can attempt, and the attempts by policy.

    Raises: DataError when 20 initial states hold none.
    """
    for trial in range(20):
        entropy = (config.seed, EMBODIMENT_STREAM[start.embodiment], SPLIT_STREAM["test"], start.layout, trial)
        layout = sample_layout(recorder.scene.robot, start.family, np.random.default_rng(entropy))
        motions: dict[str, Motion] = {}
        for number, (name, policy) in enumerate(config.policies.items()):
            for draw in range(5):
                random = np.random.default_rng((*entropy, number, draw))
                motion = recorder.move(layout, random, config.num_frames, policy)
                if motion is not None:
                    motions[name] = motion
                    break
            else:
                break
        if len(motions) == len(config.policies):
            return layout, motions
    raise DataError("No initial state is in reach of every policy", where=f"start {start.name}")


def camera_draws(config: RecordPoliciesConfig, start: BankSpec) -> np.random.Generator:
    """Of the same small camera shift for all policies: they share the first picture."""
    return np.random.default_rng((config.seed, start.layout))


def _record_start(task: tuple[BankSpec, RecordPoliciesConfig, Path]) -> None:
    """Record what is missing of a start; runs in a worker process."""
    start, config, output = task
    recorder = open_recorder(start.embodiment)
    layout, motions = draw_start(recorder, start, config)
    writer = EpisodeSetWriter(output, fps=FRAME_RATE, video_crf=config.video_crf)
    for number, (policy, motion) in enumerate(motions.items()):
        name = _episode_id(start, policy)
        if writer.has(name):
            continue
        recording = recorder.film(
            layout,
            motion,
            episode_id=name,
            scene_id=start.scene,
            split="test",
            jitter=camera_draws(config, start),
            bank=start.name,
            candidate=number,
        )
        episode = replace(recording.episode, source=policy)
        writer.add(episode, recording.frames, recording.robot_masks, thing_labels=recording.thing_labels)
    recorder.close()


def _episode_id(start: BankSpec, policy: str) -> str:
    return f"{start.name}-{policy}"


def record_policies(config: RecordPoliciesConfig, output: Path) -> dict[str, Any]:
    """Record every policy's attempts at every start into ``output`` (an EpisodeSet); finished episodes survive a kill.

    Returns the successes and attempts of each policy, by task.

    Raises: UnavailableError without MuJoCo; DataError when a start cannot be drawn, or the folder holds other episodes.
    """
    starts = config.starts.specs()
    wanted = {_episode_id(start, policy) for start in starts for policy in config.policies}
    if not EpisodeSetWriter.finished(output):
        prepare_rendering()
        writer = EpisodeSetWriter(output, fps=FRAME_RATE, video_crf=config.video_crf)
        missing = [s for s in starts if not all(writer.has(_episode_id(s, policy)) for policy in config.policies)]
        with Progress("record policies", len(starts), "start", done=len(starts) - len(missing)) as progress:
            for _ in run_in_processes(_record_start, [(start, config, output) for start in missing], config.workers):
                progress.advance()
        writer.close()
    rows = EpisodeSet.open(output).rows
    check_recorded(output, {row.episode_id for row in rows}, wanted)
    families = {start.name: start.family for start in starts}
    table: dict[str, dict[str, dict[str, int]]] = defaultdict(dict)
    for row in rows:
        cell = table[row.source].setdefault(families[row.bank or ""], {"attempts": 0, "successes": 0})
        cell["attempts"] += 1
        cell["successes"] += row.outcome == "success"
    counts = {"starts": len(starts), "episodes": len(rows), "policies": {name: table[name] for name in config.policies}}
    write_json_atomic(output / "recording.json", counts)
    return counts
