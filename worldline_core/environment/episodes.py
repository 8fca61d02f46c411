"""Episodes that run in an environment: their videos so far, which ones are stepped together, and whether one succeeded."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from worldline_core.environment.starts import Start
from worldline_core.errors import DataError
from worldline_core.evaluation.policy.judge import judge_trajectory
from worldline_core.evaluation.policy.measured_judge import MeasuredEvidenceJudge
from worldline_core.evaluation.recordings import Trajectory
from worldline_core.evaluation.segmenters.segmenter import open_segmenter
from worldline_core.rollout.session import Frames
from worldline_core.rollout.simulation import Simulation

Success = Callable[[Trajectory], bool | None]
"""Whether a video shows that its task was done; None where that cannot be seen."""


def measured_success(segmenter: Path) -> Success:
    """Success by the embedded judge, which follows what the instruction names by colour."""
    judge = MeasuredEvidenceJudge(open_segmenter("learned", learned=segmenter, sam3=None))
    return lambda trajectory: judge_trajectory(judge, trajectory).success


@dataclass
class RunningEpisode:
    """One running episode: its start, its video so far and the tools in the head view."""

    start: Start
    video: dict[str, list[np.ndarray]]
    points: list[np.ndarray]
    picture: dict[str, np.ndarray]
    state: np.ndarray
    success: bool = False

    def trajectory(self, fps: float) -> Trajectory:
        """The video so far, as a judge sees it."""
        video: dict[str, Any] = {view: np.concatenate(pieces) for view, pieces in self.video.items()}
        return Trajectory(self.start.instruction, video, fps, np.concatenate(self.points))


@dataclass
class Together:
    """Episodes that began together, and the commands since their last finished block."""

    simulation: Simulation
    slots: list[int]
    age: int = 0
    commands: list[np.ndarray] = field(default_factory=list)

    def take(self, commands: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """One more command for each episode ``(b, j)``: what is executed of it, and where the robots then are."""
        self.commands.append(commands)
        self.age += 1
        executed, states = self.simulation.follow(np.stack(self.commands, axis=1))
        return executed[:, -1], states[:, -1]

    def predict(self) -> tuple[Simulation, Frames]:
        """The simulation after the commands that are not behind it yet, at most a block of them, and their videos.

        An unfinished block is predicted with the last command held, by a copy: it is predicted again when there are more
        commands. A full one is behind the simulation then.
        """
        frames = self.simulation.frames_per_step
        block = np.stack(self.commands[:frames], axis=1)
        count = block.shape[1]
        simulation = self.simulation if count == frames else self.simulation.copy()
        held = np.repeat(block[:, -1:], frames - count, axis=1)
        clips = simulation.step(np.concatenate((block, held), axis=1))
        if count == frames:
            self.commands = self.commands[frames:]
        return simulation, [{view: video[:count] for view, video in clip.items()} for clip in clips]

    def without(self, slots: Sequence[int]) -> Together | None:
        """The others."""
        kept = [index for index, slot in enumerate(self.slots) if slot not in slots]
        if len(kept) in (0, len(self.slots)):
            return self if kept else None
        commands = [rows[kept] for rows in self.commands]
        return Together(self.simulation.select(kept), [self.slots[index] for index in kept], self.age, commands)


def each_seed(given: int | Sequence[int | None] | None, count: int) -> list[int | None]:
    """Seeds of so many episodes: those given, or counted up from one, or none.

    Raises: DataError for another number of them, or what is no seed.
    """
    if isinstance(given, int | np.integer):
        given = [int(given) + number for number in range(count)]
    seeds: list[int | None] = [None] * count if given is None else []
    if isinstance(given, Sequence | np.ndarray):
        seeds = [*given]
    known = [seed for seed in seeds if seed is not None]
    if len(seeds) != count or not all(isinstance(seed, int | np.integer) and 0 <= seed < 2**63 for seed in known):
        raise DataError("Not the seeds of the episodes", expected=f"{count}, from 0 to 2^63 - 1, or one", got=given)
    return seeds
