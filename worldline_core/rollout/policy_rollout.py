"""The step rollout_policy: a policy of openpi's protocol drives the simulator from recorded first frames on.

The loop is that of WorldArena's policy evaluator (tsinghua-fib-lab/WorldArena, `embodied_task/worldarena_track2`: `docs/DETAILS.md`,
`length.py`) for models of joints: the policy gets the last picture and the last command, in the beginning the first
one of the recording. Every ``down_sample``-th of its actions is queued, the model takes a step's worth at a time, and where less is
left the rest is dropped and the policy asked again. A video has ``length_scale`` times as many frames as every ``down_sample``-th
of its recording, rounded up.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from worldline_core.data.episodes.episode_index import QuarantineRow, write_quarantine
from worldline_core.errors import DataError
from worldline_core.geometry.kinematics import KinematicsByName
from worldline_core.policies.openpi import OpenpiPolicy
from worldline_core.progress import with_progress
from worldline_core.rollout.recorded_starts import RecordedStart, RecordedStarts
from worldline_core.rollout.rollout_config import PolicyRolloutConfig
from worldline_core.rollout.rollout_set import RolloutSetWriter
from worldline_core.rollout.simulation import Simulation
from worldline_core.rollout.worldline import WorldLine


class UnusableCommandsError(DataError):
    """The policy's commands are far beyond the robot's limits."""


def rollout_policy(config: PolicyRolloutConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """Roll ``checkpoint`` with ``tokenizer`` out of the first frames of ``episodes``, driven by a policy; writes a RolloutSet.

    Videos already there are kept. A recording in which the policy commands what no robot can do, such as degrees, goes to
    ``quarantine.parquet`` as ``invalid_controls``; a policy that fails ends the step.

    Returns:
        counts, frames, and how often the policy was asked.

    Raises:
        DataError: there is no start, every one was refused, or a chunk does not fit the robot or the model's step.
        UnavailableError: the policy is not there, fails, or is too slow.
    """
    world = WorldLine.from_pretrained(
        Path(inputs["checkpoint"]), tokenizer=Path(inputs["tokenizer"]), device=config.device,
        bfloat16=config.bfloat16, steps=config.steps,
    )  # fmt: skip
    starts = RecordedStarts(
        Path(inputs["episodes"]), view_sets=world.view_sets, fps=world.contract.fps, needs_cameras=world.needs_cameras,
        splits=config.splits,
    )  # fmt: skip
    left_out = Counter(starts.left_out.values())
    if not starts.rows:
        raise DataError(
            "No recording to start from", where=inputs["episodes"], got=dict(left_out),
            expected=f"views, cameras and rate ({world.contract.fps:g}) of the model, splits {config.splits}",
        )  # fmt: skip
    kinematics, asked = KinematicsByName({}), 0
    writer = RolloutSetWriter(output, config.method, world.contract.fps, crf=config.crf)
    refused: list[QuarantineRow] = []
    frames = 0
    with config.policy.connect() as policy:
        for row in with_progress(starts.rows, "rollout_policy", "video"):
            start = starts.at(row.episode_id)
            views = tuple(start.images)
            recorded = len(range(0, row.num_frames, config.down_sample))
            length = math.ceil(recorded * config.length_scale)
            if writer.has(row.episode_id, config.seed, views):
                for view in views:
                    writer.register(row.episode_id, config.seed, view, length, world.image_size)
            else:
                simulation = world.start(
                    start.images, start.cameras, embodiment=kinematics.get(row.embodiment), state=start.state,
                    seed=config.seed,
                )  # fmt: skip
                try:
                    asked += _drive(config, policy, simulation, start, writer, length)
                except UnusableCommandsError as error:
                    refused.append(QuarantineRow(row.episode_id, row.source, "invalid_controls", str(error)))
                    continue
            frames += length
    if refused:
        write_quarantine(output, refused)
        left_out["invalid_controls"] = len(refused)
    made = len(starts.rows) - len(refused)
    if not made:
        raise DataError("The policy drove no recording", where=config.policy.url, got=refused[0].detail)
    writer.close()
    return {
        "method": config.method, "found": len(starts.rows) + len(starts.left_out), "kept": made, "left_out": dict(left_out),
        "episodes": made, "frames": frames, "asked": asked,
    }  # fmt: skip


def _drive(
    config: PolicyRolloutConfig,
    policy: OpenpiPolicy,
    simulation: Simulation,
    start: RecordedStart,
    writer: RolloutSetWriter,
    length: int,
) -> int:
    """Write one video; how often the policy was asked."""
    step, columns, asked = simulation.frames_per_step, simulation.state.shape[1], 0
    queue = np.empty((0, columns))
    with writer.video(start.episode_id, config.seed, simulation.views, simulation.image_size) as add:
        add({view: picture[None] for view, picture in simulation.pictures[0].items()})
        while (done := simulation.num_frames) < length:
            if len(queue) < step:
                observation = config.policy.observation(
                    simulation.pictures[0], simulation.commands[0, -1], start.instruction
                )  # fmt: skip
                least = (step - 1) * config.down_sample + 1
                queue = policy.chunk(observation, rows=least, columns=columns)[:: config.down_sample]
                asked += 1
            try:
                (clip,) = simulation.step(queue[:step])
            except DataError as error:
                raise UnusableCommandsError(
                    error.what, where=f"frame {done}, {error.where}", expected=error.expected, got=error.got,
                    next_step=error.next_step,
                ) from error  # fmt: skip
            queue = queue[step:]
            add({view: video[: length - done] for view, video in clip.items()})
    return asked
