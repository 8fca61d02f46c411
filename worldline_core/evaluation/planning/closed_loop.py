"""Planning in closed loop: after every executed chunk the next one is chosen anew, from what the cameras see then.

A :class:`Planner` is asked for controls, the robot executes their first chunk, and the planner is asked again with the pictures
that came of it. Each time it branches a simulation that begins at the last picture, predicts every candidate to the end of the
horizon, and scores the video of the whole episode: the real pictures so far, then the predicted ones.

Axis legend: k candidates, n frames, j columns of the embodiment's state, c frames of a chunk (one step of the model).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from worldline_core.errors import ConfigError, DataError
from worldline_core.evaluation.planning.selectors import Selector, shown_video
from worldline_core.evaluation.planning.solvers import SOLVERS, Found, Solver, Space, Stopped, coloured_noise, search
from worldline_core.evaluation.recordings import Trajectory, simulated_points
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.model.video_tokenizer import frames_to_video, video_to_frames
from worldline_core.rollout.observation import Camera, image_size, project_controls
from worldline_core.rollout.robot import CommandedRobot, Response
from worldline_core.rollout.simulation import Simulation
from worldline_core.rollout.worldline import WorldLine
from worldline_core.training.video_teacher import VideoTeacher


@dataclass(frozen=True)
class Situation:
    """What proposals begin at.

    Attributes:
        images: by view, ``uint8 (H, W, 3)``: what the cameras see now.
        state: ``(j)``, the last command.
        frames: commands that a proposal has.
        executed: commands that were executed before.
    """

    images: Mapping[str, np.ndarray]
    state: np.ndarray
    frames: int
    executed: int


Propose = Callable[[Situation, int, np.random.Generator], Float[np.ndarray, "k n j"]]
"""So many sequences of ``situation.frames`` commands each: from a policy, from recordings, or drawn."""
Score = Callable[[Trajectory], float]
"""How good a video is, the higher the better: real pictures so far, then predicted ones, at the model's size."""


@dataclass(frozen=True)
class Plan:
    """What to execute, and how it was found.

    Attributes:
        controls: ``(c, j)``, the next chunk, within the robot's limits.
        sequence: ``(n, j)``, the whole chosen sequence, of which ``controls`` is the beginning.
        score: of its video. scores: of all candidates that were scored, the chosen one first, then the better before the worse.
        model_calls: steps that the model predicted for this choice, counted for each candidate.
        seconds: that the search took.
        stopped: by the number of candidates, by time, or because a score was ``certain``.
    """

    controls: np.ndarray
    sequence: np.ndarray
    score: float
    scores: np.ndarray
    model_calls: int
    seconds: float
    stopped: Stopped


class Planner:
    """Chooses the controls of one episode, chunk by chunk.

    Args:
        world: the model; a causal one makes chunks of a block, a Stage II model of a clip.
        cameras: of the views that are given, wrist cameras at their pose of the first call of :meth:`plan` (or with a known
            mount); they follow the arms by kinematics.
        embodiment: name or YAML file of the robot, or its kinematics.
        instruction: what is to be done, for the score.
        propose, score: where candidates come from, and which is best.
        solver: ``best_of_n``, ``cem``, ``icem``, ``mppi``, or a function of your own.
        candidates: sequences scored at each call, at most.
        horizon: chunks that are predicted at each call.
        batch: candidates that are simulated together; time and certainty are looked at between batches.
        seconds: for one call; see :func:`~worldline_core.evaluation.planning.solvers.search`.
        certain: a score from which on nothing better is looked for.
        margin: what is left of the last choice is carried on unless another candidate scores better by more than this.
        seed: of the proposals, and of the model's noise, which all candidates share.
        limits, response: as of ``WorldLine.start``.

    Raises:
        ConfigError: there is no such solver or embodiment, or a number is not positive.
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
        solver: str | Solver = "best_of_n",
        candidates: int = 24,
        horizon: int = 2,
        batch: int = 8,
        seconds: float | None = None,
        certain: float | None = None,
        margin: float = 0.0,
        seed: int = 42,
        limits: bool = True,
        response: Response | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        if isinstance(solver, str) and solver not in SOLVERS:
            raise ConfigError("There is no such solver", expected=" | ".join(SOLVERS), got=solver)
        numbers = {"candidates": candidates, "horizon": horizon, "batch": batch, "seconds": seconds or 1}
        if min(numbers.values()) <= 0 or not margin >= 0:
            raise ConfigError(
                "A planner cannot be run so",
                expected="positive numbers; a margin of at least 0",
                got={**numbers, "margin": margin},
            )
        known = isinstance(embodiment, ArmKinematics)
        self.kinematics = embodiment if known else ArmKinematics(load_embodiment(embodiment))
        self.world, self.cameras, self.instruction = world, dict(cameras), instruction
        self.propose, self.score, self.candidates, self.horizon = propose, score, candidates, horizon
        self._solver: Solver = SOLVERS[solver] if isinstance(solver, str) else solver
        self._batch, self._seconds, self._clock = batch, seconds, clock
        self._certain, self._margin = certain, margin
        self._seed, self._random, self._limits, self._response = seed, np.random.default_rng(seed), limits, response
        self._first_state: np.ndarray | None = None
        self._past: dict[str, list[np.ndarray]] = {}
        self._points: np.ndarray | None = None
        self._found: Found | None = None
        self._executed = 0

    def plan(self, images: Mapping[str, np.ndarray], state: np.ndarray, *, horizon: int | None = None) -> Plan:
        """The next controls.

        Args:
            images: what the cameras saw since the last call, ``uint8 (n, H, W, 3)`` by view, the last picture now; or only
                now, ``(H, W, 3)``. More pictures show the score more of what happened.
            state: ``(j)``, the last command that was executed (at the first call the one that belongs to the images).
            horizon: chunks to predict this time, where an episode ends earlier than the planner's horizon.

        Raises:
            DataError: images, state or proposals have a wrong shape or are not finite, a score is not finite or its function
                failed. What the planner knows of the episode is as before the call.
        """
        seen = {view: np.asarray(video)[None] if np.ndim(video) == 3 else video for view, video in images.items()}
        now = {view: video[-1] for view, video in seen.items()}
        command = np.asarray(state, dtype=np.float64)
        simulation = self._begin(now, command)
        first_points = simulated_points(simulation, 0) if self._points is None else self._points
        chunk = simulation.frames_per_step
        frames = (horizon or self.horizon) * chunk
        executed = self._executed + (chunk if self._found is not None else 0)
        situation = Situation(now, command, frames, executed)
        past = {view: [*self._past.get(view, []), self._shrunk(video[:-1])] for view, video in seen.items()}
        space = Space(
            lambda count: self._proposed(situation, count),
            lambda sequences: self._executable(command, sequences),
            self._kept(chunk, frames),
            self._random,
        )
        found = search(
            self._solver(space, self.candidates),
            lambda sequences: self._scores(simulation, sequences, past, first_points),
            batch=self._batch, seconds=self._seconds, certain=self._certain, clock=self._clock,
            margin=0.0 if self._found is None else self._margin,
        )  # fmt: skip
        self._first_state = command if self._first_state is None else self._first_state
        self._past = {view: [*past[view], self._shrunk(video[-1:])] for view, video in seen.items()}
        self._points, self._found, self._executed = first_points, found, executed
        calls = len(found.scores) * frames // chunk
        best = found.sequences[0]
        return Plan(
            best[:chunk], best, float(found.scores[0]), found.scores, calls, found.seconds, found.stopped
        )  # fmt: skip

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
            now, cameras, embodiment=self.kinematics, state=command, seed=self._seed, limits=self._limits,
            response=self._response,
        )  # fmt: skip

    def _kept(self, chunk: int, frames: int) -> np.ndarray:
        """Sequences of the last search without their executed chunk, the last command held where they end early."""
        if self._found is None:
            return np.empty((0, frames, self.kinematics.embodiment.state_size))
        rows = np.minimum(np.arange(chunk, chunk + frames), self._found.sequences.shape[1] - 1)
        return self._found.sequences[:, rows]

    def _proposed(self, situation: Situation, count: int) -> np.ndarray:
        proposed = np.asarray(self.propose(situation, count, self._random), dtype=np.float64)
        wanted = (count, situation.frames, len(situation.state))
        if proposed.shape != wanted or not np.isfinite(proposed).all():
            raise DataError(
                "Proposals do not fit",
                expected=f"{wanted}: candidates, frames, columns of the state; finite",
                got=f"{proposed.shape}, {int((~np.isfinite(proposed)).sum())} not finite",
            )
        return proposed

    def _executable(self, command: np.ndarray, sequences: np.ndarray) -> np.ndarray:
        starts = np.repeat(command[None], len(sequences), axis=0)
        fps = self.world.contract.fps
        robot = CommandedRobot(self.kinematics, fps, starts, limits=self._limits, response=None)
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
        for number, (video, tools) in enumerate(zip(videos, points, strict=True)):
            frames: dict[str, Any] = {view: np.concatenate(pieces) for view, pieces in video.items()}
            trajectory = Trajectory(self.instruction, frames, branches.fps, np.concatenate(tools))
            try:
                scores.append(float(self.score(trajectory)))
            except Exception as error:
                raise DataError(
                    "The score function of a planner failed",
                    where=f"candidate {number} of a batch of {len(videos)}, a video of {trajectory.num_frames} frames",
                    expected="a number for every video, higher is better",
                    got=f"{type(error).__name__}: {error}",
                ) from error
        return np.array(scores)

    def _shrunk(self, video: np.ndarray) -> np.ndarray:
        """Real frames ``(n, H, W, 3)`` at the model's size."""
        if not len(video):
            return np.empty((0, *self.world.image_size, 3), np.uint8)
        return video_to_frames(frames_to_video(video, self.world.image_size))


def drawn_around(deviation: float | np.ndarray, nominal: np.ndarray | None = None, *, colour: float = 2.0) -> Propose:
    """Proposals by noise around a nominal sequence.

    Args:
        deviation: standard deviation of every column, or ``(j)``, in the state's units.
        nominal: ``(m, j)`` from the episode's first command after the start on (its last row is held); by default the last
            command is held.
        colour: of the noise over time, 0 white, 2 smooth.
    """

    def propose(situation: Situation, count: int, random: np.random.Generator) -> np.ndarray:
        middle = situation.state[None] if nominal is None else _going_on(nominal, situation)
        shape = (count, situation.frames, len(situation.state))
        return middle + deviation * coloured_noise(random, shape, colour)

    return propose


def recorded(controls: Float[np.ndarray, "m n j"]) -> Propose:
    """Proposals from recorded sequences (row 0 is the first command after the start; the last one is held), drawn without
    repetition where there are enough; later in the episode, what is left of each.
    """

    def propose(situation: Situation, count: int, random: np.random.Generator) -> np.ndarray:
        order = np.concatenate([random.permutation(len(controls)) for _ in range(-(-count // len(controls)))])
        return np.stack([_going_on(controls[number], situation) for number in order[:count]])

    return propose


def _going_on(rows: np.ndarray, situation: Situation) -> np.ndarray:
    frames = np.arange(situation.executed, situation.executed + situation.frames)
    return np.asarray(rows)[np.minimum(frames, len(rows) - 1)]


def judged(selector: Selector) -> Score:
    """Score of a selector of open-loop planning (measured, or a vision-language model), 0..1."""
    return lambda video: selector.score(video.instruction, shown_video(video)).score / 100.0


class GoalPicture:
    """Score by nearness to a picture of the goal: the mean cosine similarity of video features, cell by cell, of the last
    picture and the goal's, in -1..1.

    Args:
        encoder: features, for example ``load_teacher(Path("artifacts/shipped/models/teacher"))`` or V-JEPA 2.
        goal: by view (any of those predicted), ``uint8 (H, W, 3)``.
    """

    def __init__(self, encoder: VideoTeacher, goal: Mapping[str, np.ndarray]) -> None:
        if not goal:
            raise DataError("A goal needs a picture of at least one view")
        self._encoder = encoder
        self._goal = {view: np.asarray(image) for view, image in goal.items()}

    def __call__(self, video: Trajectory) -> float:
        missing = sorted(self._goal.keys() - video.frames.keys())
        if missing:
            raise DataError("A view of the goal is not predicted", expected=sorted(video.frames), got=missing)
        return float(np.mean([self._similarity(view, video) for view in self._goal]))

    def _similarity(self, view: str, video: Trajectory) -> float:
        last = video.frames[view][[len(video.frames[view]) - 1]]
        size = (last.shape[1], last.shape[2])
        pictures = [frames_to_video(frames, size) for frames in (last, self._goal[view][None])]
        features = self._encoder.features((torch.stack(pictures) + 1) / 2)
        return float(torch.cosine_similarity(features[0], features[1], dim=-1).mean())
