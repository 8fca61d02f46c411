"""Planning in closed loop: after every executed chunk the next one is chosen anew, from what the cameras see then.

A :class:`ClosedLoopPlanner` branches a simulation that begins at the last picture, predicts every candidate to the end of the horizon,
and scores the video of the whole episode: the real pictures so far, then the predicted ones. The best-scored sequence is executed.

Axis legend: k candidates, n frames, j columns of the embodiment's state, c frames of a chunk (one step of the model).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from worldline_core.errors import ConfigError, DataError
from worldline_core.evaluation.planning.bracket import Selector, shown_video
from worldline_core.evaluation.recordings import Trajectory, simulated_points
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.model.tokenizers import frames_to_video, video_to_frames
from worldline_core.rollout.observation import Camera, image_size, project_controls
from worldline_core.rollout.simulation import CommandedRobot, Simulation
from worldline_core.rollout.worldline import WorldLine

Sequences = Float[np.ndarray, "k n j"]


@dataclass(frozen=True)
class Situation:
    """The state of an episode that proposals begin at.

    Attributes:
        images: by view, ``uint8 (H, W, 3)``: what the cameras see now.
        state: ``(j)``, the last command.
        frames: commands of a proposal.
        executed: commands that were executed before.
    """

    images: Mapping[str, np.ndarray]
    state: np.ndarray
    frames: int
    executed: int


Propose = Callable[[Situation, int, np.random.Generator], Sequences]
"""So many sequences of ``situation.frames`` commands each: from a policy, from recordings, or drawn."""
Score = Callable[[Trajectory], float]
"""Rates a video, the higher the better: real pictures so far, then predicted ones, at the model's size."""


@dataclass(frozen=True)
class Plan:
    """The next controls, and the candidates that they were chosen from.

    Attributes:
        controls: ``(c, j)``, the next chunk, within the robot's limits.
        sequence: ``(n, j)``, the whole chosen sequence, of which ``controls`` is the beginning.
        score: of its video. scores: of all candidates, the chosen one first, then falling.
        model_calls: steps that the model predicted for this choice, counted for each candidate.
    """

    controls: np.ndarray
    sequence: np.ndarray
    score: float
    scores: np.ndarray
    model_calls: int


class ClosedLoopPlanner:
    """Chooses the controls of one episode, chunk by chunk.

    Args:
        world: the model; a causal one makes chunks of a block, a Stage II model of a clip.
        cameras: of the given views, wrist cameras at their pose of the first call of :meth:`plan` (or with a known mount); they follow
            the arms by kinematics.
        embodiment: name or YAML file of the robot, or its kinematics.
        instruction: the task, for the score.
        propose, score: source of the candidates, and their order.
        candidates: sequences scored at each call; from the second call on one is what is left of the last choice.
        horizon: chunks that are predicted at each call.
        batch: candidates that are simulated together.
        margin: what is left of the last choice is chosen unless another candidate scores better by more than this.
        seed: of the proposals, and of the model's noise, which all candidates share.
        limits: as of ``WorldLine.start``.

    Raises: ConfigError: there is no such embodiment, or a number is not positive.
    """

    def __init__(
        self,
        world: WorldLine,
        cameras: Mapping[str, Camera],
        *,
        embodiment: str | Path | ArmKinematics,
        instruction: str,
        propose: Propose,
        score: Score,
        candidates: int = 24,
        horizon: int = 2,
        batch: int = 8,
        margin: float = 0.0,
        seed: int = 42,
        limits: bool = True,
    ) -> None:
        numbers = {"candidates": candidates, "horizon": horizon, "batch": batch}
        if min(numbers.values()) <= 0 or not margin >= 0:
            raise ConfigError(
                "A planner's numbers are out of range", expected="positive numbers; a margin of at least 0",
                got={**numbers, "margin": margin},
            )  # fmt: skip
        known = isinstance(embodiment, ArmKinematics)
        self.kinematics = embodiment if known else ArmKinematics(load_embodiment(embodiment))
        self.world, self.cameras, self.instruction = world, dict(cameras), instruction
        self.propose, self.score, self.candidates, self.horizon = propose, score, candidates, horizon
        self._batch, self._margin, self._seed, self._limits = batch, margin, seed, limits
        self._random = np.random.default_rng(seed)
        self._first_state: np.ndarray | None = None
        self._past: dict[str, list[np.ndarray]] = {}
        self._points: np.ndarray | None = None
        self._last: np.ndarray | None = None
        self._executed = 0

    def plan(self, images: Mapping[str, np.ndarray], state: np.ndarray, *, horizon: int | None = None) -> Plan:
        """The next controls.

        Args:
            images: what the cameras saw since the last call, ``uint8 (n, H, W, 3)`` by view, the last picture now; or only now,
                ``(H, W, 3)``. More pictures show the score more of what happened.
            state: ``(j)``, the last executed command (at the first call the one that belongs to the images).
            horizon: chunks to predict this time, where an episode ends earlier than the planner's horizon.

        Raises:
            DataError: images, state or proposals have a wrong shape or are not finite, or a score is not finite. The planner's
                knowledge of the episode is then as before the call.
        """
        seen = {view: np.asarray(video)[None] if np.ndim(video) == 3 else video for view, video in images.items()}
        now = {view: video[-1] for view, video in seen.items()}
        command = np.asarray(state, dtype=np.float64)
        simulation = self._begin(now, command)
        first_points = simulated_points(simulation, 0) if self._points is None else self._points
        chunk = simulation.frames_per_step
        frames = (horizon or self.horizon) * chunk
        executed = self._executed + (0 if self._last is None else chunk)
        past = {view: [*self._past.get(view, []), self._shrunk(video[:-1])] for view, video in seen.items()}
        sequences = self._sequences(Situation(now, command, frames, executed), chunk)
        parts = [sequences[begin : begin + self._batch] for begin in range(0, len(sequences), self._batch)]
        scores = np.concatenate([self._scores(simulation, part, past, first_points) for part in parts])
        if not np.isfinite(scores).all():
            raise DataError(
                "A score is not a finite number", expected=f"{len(scores)} finite scores, higher is better", got=scores.tolist(),
                next_step="let the score function give its lowest score to a video in which it sees nothing",
            )  # fmt: skip
        ranked = scores.copy()
        if ranked.max() <= ranked[0] + (0.0 if self._last is None else self._margin):
            ranked[0] = np.inf
        order = np.argsort(-ranked, kind="stable")
        best = sequences[order[0]]
        self._first_state = command if self._first_state is None else self._first_state
        self._past = {view: [*past[view], self._shrunk(video[-1:])] for view, video in seen.items()}
        self._points, self._last, self._executed = first_points, best, executed
        return Plan(best[:chunk], best, float(scores[order[0]]), scores[order], len(scores) * frames // chunk)

    def _begin(self, now: Mapping[str, np.ndarray], command: np.ndarray) -> Simulation:
        """A simulation that begins at these pictures, its cameras where the arms have carried them."""
        cameras = self.cameras
        if self._first_state is not None:
            self.kinematics.embodiment.check_state(command[None], "the state of a planner")
            rows = np.stack((self._first_state, command))
            size = image_size(now, cameras)
            tracks = project_controls(cameras, size, self.kinematics, controls=rows, fps=self.world.contract.fps)
            cameras = {
                view: camera
                if camera.T_base_camera is None
                else Camera(camera.K, tracks.T_base_camera[-1, tracks.views.index(view)].astype(np.float64))
                for view, camera in cameras.items()
            }
        return self.world.start(
            now, cameras, embodiment=self.kinematics, state=command, seed=self._seed, limits=self._limits
        )

    def _sequences(self, situation: Situation, chunk: int) -> Sequences:
        """The rest of the last choice (its last command held), then proposals; within the robot's limits."""
        kept = np.empty((0, situation.frames, len(situation.state)))
        if self._last is not None:
            kept = self._last[None, np.minimum(np.arange(chunk, chunk + situation.frames), len(self._last) - 1)]
        wanted = (self.candidates - len(kept), situation.frames, len(situation.state))
        proposed = np.empty(wanted)
        if wanted[0]:
            proposed = np.asarray(self.propose(situation, wanted[0], self._random), dtype=np.float64)
        if proposed.shape != wanted or not np.isfinite(proposed).all():
            raise DataError(
                "Proposals do not fit", expected=f"{wanted}: candidates, frames, columns of the state; finite",
                got=f"{proposed.shape}, {int((~np.isfinite(proposed)).sum())} not finite",
            )  # fmt: skip
        sequences = np.concatenate([kept, proposed])
        starts = np.repeat(situation.state[None], len(sequences), axis=0)
        robot = CommandedRobot(self.kinematics, self.world.contract.fps, starts, limits=self._limits)
        return robot.follow(sequences)[1]

    def _scores(
        self, simulation: Simulation, sequences: np.ndarray, past: Mapping[str, list[np.ndarray]], first: np.ndarray
    ) -> np.ndarray:
        """Scores of candidates, predicted together; ``first``: tools in the head view of the episode's first picture."""
        branches = simulation.fork(len(sequences))
        videos = [{v: [*past[v], image[None]] for v, image in clip.items()} for clip in branches.pictures]
        real = sum(len(piece) for piece in next(iter(videos[0].values())))
        unknown = np.full((real, *first.shape[1:]), np.nan)
        unknown[:1] = first
        points = [[unknown] for _ in videos]
        for start in range(0, sequences.shape[1], branches.frames_per_step):
            clips = branches.step(sequences[:, start : start + branches.frames_per_step])
            for number, clip in enumerate(clips):
                for view, video in clip.items():
                    videos[number][view].append(video)
                points[number].append(simulated_points(branches, number))
        scores: list[float] = []
        for video, tools in zip(videos, points, strict=True):
            frames: dict[str, Any] = {view: np.concatenate(pieces) for view, pieces in video.items()}
            trajectory = Trajectory(self.instruction, frames, branches.fps, np.concatenate(tools))
            scores.append(float(self.score(trajectory)))
        return np.array(scores)

    def _shrunk(self, video: np.ndarray) -> np.ndarray:
        """Real frames ``(n, H, W, 3)`` at the model's size."""
        if not len(video):
            return np.empty((0, *self.world.image_size, 3), np.uint8)
        return video_to_frames(frames_to_video(video, self.world.image_size))


def recorded(controls: Float[np.ndarray, "m n j"]) -> Propose:
    """Proposals from recorded sequences (row 0 is the first command after the start; the last one is held), drawn without repetition
    where there are enough; later in the episode, the rest of each."""

    def propose(situation: Situation, count: int, random: np.random.Generator) -> np.ndarray:
        order = np.concatenate([random.permutation(len(controls)) for _ in range(-(-count // len(controls)))])
        frames = np.arange(situation.executed, situation.executed + situation.frames)
        return np.asarray(controls)[order[:count]][:, np.minimum(frames, controls.shape[1] - 1)]

    return propose


def judged(selector: Selector) -> Score:
    """Score of a selector of open-loop planning (measured, or a vision-language model), 0..1."""
    return lambda video: selector.score(video.instruction, shown_video(video))[0] / 100.0
