"""Planning in closed loop: after every executed chunk the next one is chosen anew, from what the cameras see then.

A :class:`ClosedLoopPlanner` branches a simulation that begins at the last picture, predicts every candidate to the end of the horizon,
and scores the video of the whole episode: the real pictures so far, then the predicted ones. A solver is a generator: it yields
candidates, receives their scores, and ends when its candidates are used up. The best-scored sequence of all is executed: with a model
that gives equal controls equal videos, no average of sequences is worth more than one that was scored.

Axis legend: k candidates, n frames, j columns of the embodiment's state, c frames of a chunk (one step of the model).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float

from worldline_core.errors import ConfigError, DataError
from worldline_core.evaluation.planning.bracket import Selector, shown_video
from worldline_core.evaluation.recordings import Trajectory, simulated_points
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.model.tokenizers import frames_to_video, video_to_frames
from worldline_core.rollout.observation import Camera, image_size, project_controls
from worldline_core.rollout.robot import CommandedRobot
from worldline_core.rollout.simulation import Simulation
from worldline_core.rollout.worldline import WorldLine
from worldline_core.training.video_teacher import VideoTeacher

Sequences = Float[np.ndarray, "k n j"]
Batches = Generator[Sequences, Float[np.ndarray, " k"], None]
Stopped = Literal["candidates", "time", "certain"]


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
class SearchSpace:
    """Sequences that a solver may try.

    Attributes:
        propose: so many new sequences.
        limit: the nearest sequences that the robot can execute.
        kept: ``(m, n, j)``, m >= 0, the rest of an earlier search's sequences, best first.
    """

    propose: Callable[[int], Sequences]
    limit: Callable[[Sequences], Sequences]
    kept: Sequences
    random: np.random.Generator

    def first(self, count: int, kept: int = 1) -> Sequences:
        """The best ``kept`` of an earlier search, then new proposals; ``count`` in all."""
        known = self.kept[: min(kept, count)]
        fresh = [self.propose(count - len(known))] if count > len(known) else []
        return self.limit(np.concatenate([known, *fresh]))


Solver = Callable[[SearchSpace, int], Batches]
"""Batches of at most so many candidates together, beginning with :meth:`SearchSpace.first`: a margin favours the very first."""


def best_of_n(space: SearchSpace, count: int) -> Batches:
    """Proposals alone."""
    yield space.first(count)


def icem(space: SearchSpace, count: int) -> Batches:
    """Cross-entropy method with the improvements of iCEM (Pinneri et al. 2020, section 3).

    Each round is drawn from a normal distribution around the best of the round before, with noise that is correlated in time; half of
    the elites compete again and are handed on to the next search, rounds shrink, and the mean is a candidate of the last round.
    """
    shares = 1.25 ** -np.arange(max(1, min(3, count // 3)), dtype=np.float64)
    sizes = np.diff(np.round(count * np.cumsum(shares) / shares.sum()).astype(int), prepend=0).tolist()
    elites = max(2, round(0.3 * sizes[0]))
    carried = round(0.5 * elites)
    batch = space.first(sizes[0], kept=max(1, carried))
    mean = deviation = np.zeros(batch.shape[1:])
    pool, values = batch[:0], np.empty(0)
    for number, size in enumerate(sizes):
        if number:
            batch = mean + deviation * coloured_noise(space.random, (size, *mean.shape), 2.0)
            if number == len(sizes) - 1:
                batch[0] = mean
            batch = space.limit(batch)
        scores = yield batch
        pool, values = np.concatenate((pool, batch)), np.concatenate((values, scores))
        best = np.argsort(-values, kind="stable")[:elites]
        smoothed = 0.9 if number else 1.0
        mean = smoothed * pool[best].mean(axis=0) + (1 - smoothed) * mean
        deviation = smoothed * pool[best].std(axis=0) + (1 - smoothed) * deviation
        pool, values = pool[best[:carried]], values[best[:carried]]


SOLVERS: dict[str, Solver] = {"best_of_n": best_of_n, "icem": icem}


def coloured_noise(random: np.random.Generator, shape: tuple[int, ...], colour: float) -> Sequences:
    """Normal noise ``(k, n, j)`` of unit variance whose power over the frames falls with frequency to the power ``-colour``."""
    frames = shape[1]
    powers = [np.maximum(np.abs(f), 1 / frames) ** -colour for f in (np.fft.rfftfreq(frames), np.fft.fftfreq(frames))]
    spectrum = np.fft.rfft(random.standard_normal(shape), axis=1) * np.sqrt(powers[0])[:, None]
    return np.fft.irfft(spectrum, frames, axis=1) / np.sqrt(powers[1].mean())


@dataclass(frozen=True)
class SearchResult:
    """Sequences ``(k, n, j)`` and their scores ``(k,)``, the chosen one first, then by falling score; why the search stopped."""

    sequences: Sequences
    scores: Float[np.ndarray, " k"]
    stopped: Stopped
    seconds: float


def search(
    batches: Batches,
    evaluate: Callable[[Sequences], Float[np.ndarray, " k"]],
    *,
    batch: int,
    seconds: float | None = None,
    certain: float | None = None,
    margin: float = 0.0,
    clock: Callable[[], float] = time.perf_counter,
) -> SearchResult:
    """Score a solver's candidates, ``batch`` at a time, until they are used up or one of the limits is reached.

    Args:
        seconds: no batch begins that would, lasting as long as the longest one so far, end later. The first is always scored.
        certain: a score that ends the search.
        margin: the first candidate is chosen unless another scores better by more than this.

    Raises: DataError when a score is not finite.
    """
    began, longest = clock(), 0.0
    sequences: list[np.ndarray] = []
    scores: list[float] = []

    def result(stopped: Stopped) -> SearchResult:
        batches.close()
        ranked = np.array(scores)
        if ranked.max() <= ranked[0] + margin:
            ranked[0] = np.inf
        order = np.argsort(-ranked, kind="stable")
        return SearchResult(np.concatenate(sequences)[order], np.array(scores)[order], stopped, clock() - began)

    candidates = next(batches)
    while True:
        for start in range(0, len(candidates), batch):
            before = clock()
            if scores and seconds is not None and before - began + longest > seconds:
                return result("time")
            part = candidates[start : start + batch]
            values = np.asarray(evaluate(part), dtype=np.float64)
            if values.shape != (len(part),) or not np.isfinite(values).all():
                raise DataError(
                    "A score is not a finite number", where=f"candidate {len(scores)} of the search and later ones",
                    expected=f"{len(part)} finite scores, higher is better", got=values.tolist(),
                    next_step="let the score function give its lowest score to a video in which it sees nothing",
                )  # fmt: skip
            sequences.append(part)
            scores += values.tolist()
            longest = max(longest, clock() - before)
            if certain is not None and values.max() >= certain:
                return result("certain")
        try:
            candidates = batches.send(np.array(scores[-len(candidates) :]))
        except StopIteration:
            return result("candidates")


@dataclass(frozen=True)
class Plan:
    """The next controls, and the search for them.

    Attributes:
        controls: ``(c, j)``, the next chunk, within the robot's limits.
        sequence: ``(n, j)``, the whole chosen sequence, of which ``controls`` is the beginning.
        score: of its video. scores: of all candidates, the chosen one first, then falling.
        model_calls: steps that the model predicted for this choice, counted for each candidate.
        seconds: duration of the search.
        stopped: by the number of candidates, by time, or because a score was ``certain``.
    """

    controls: np.ndarray
    sequence: np.ndarray
    score: float
    scores: np.ndarray
    model_calls: int
    seconds: float
    stopped: Stopped


class ClosedLoopPlanner:
    """Chooses the controls of one episode, chunk by chunk.

    Args:
        world: the model; a causal one makes chunks of a block, a Stage II model of a clip.
        cameras: of the given views, wrist cameras at their pose of the first call of :meth:`plan` (or with a known mount); they follow
            the arms by kinematics.
        embodiment: name or YAML file of the robot, or its kinematics.
        instruction: the task, for the score.
        propose, score: source of the candidates, and their order.
        solver: ``best_of_n``, ``icem``, or a function of your own.
        candidates: sequences scored at each call, at most.
        horizon: chunks that are predicted at each call.
        batch: candidates that are simulated together; time and certainty are checked between batches.
        seconds, certain, margin: of one call, as of :func:`search`; the margin is in favour of the rest of the last choice.
        seed: of the proposals, and of the model's noise, which all candidates share.
        limits: as of ``WorldLine.start``.

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
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        if isinstance(solver, str) and solver not in SOLVERS:
            raise ConfigError("There is no such solver", expected=" | ".join(SOLVERS), got=solver)
        numbers = {"candidates": candidates, "horizon": horizon, "batch": batch, "seconds": seconds or 1}
        if min(numbers.values()) <= 0 or not margin >= 0:
            raise ConfigError(
                "A planner's numbers are out of range", expected="positive numbers; a margin of at least 0",
                got={**numbers, "margin": margin},
            )  # fmt: skip
        known = isinstance(embodiment, ArmKinematics)
        self.kinematics = embodiment if known else ArmKinematics(load_embodiment(embodiment))
        self.world, self.cameras, self.instruction = world, dict(cameras), instruction
        self.propose, self.score, self.candidates, self.horizon = propose, score, candidates, horizon
        self._solver: Solver = SOLVERS[solver] if isinstance(solver, str) else solver
        self._batch, self._seconds, self._clock = batch, seconds, clock
        self._certain, self._margin = certain, margin
        self._seed, self._random, self._limits = seed, np.random.default_rng(seed), limits
        self._first_state: np.ndarray | None = None
        self._past: dict[str, list[np.ndarray]] = {}
        self._points: np.ndarray | None = None
        self._last: SearchResult | None = None
        self._executed = 0

    def plan(self, images: Mapping[str, np.ndarray], state: np.ndarray, *, horizon: int | None = None) -> Plan:
        """The next controls.

        Args:
            images: what the cameras saw since the last call, ``uint8 (n, H, W, 3)`` by view, the last picture now; or only now,
                ``(H, W, 3)``. More pictures show the score more of what happened.
            state: ``(j)``, the last executed command (at the first call the one that belongs to the images).
            horizon: chunks to predict this time, where an episode ends earlier than the planner's horizon.

        Raises:
            DataError: images, state or proposals have a wrong shape or are not finite, a score is not finite or its function
                failed. The planner's knowledge of the episode is then as before the call.
        """
        seen = {view: np.asarray(video)[None] if np.ndim(video) == 3 else video for view, video in images.items()}
        now = {view: video[-1] for view, video in seen.items()}
        command = np.asarray(state, dtype=np.float64)
        simulation = self._begin(now, command)
        first_points = simulated_points(simulation, 0) if self._points is None else self._points
        chunk = simulation.frames_per_step
        frames = (horizon or self.horizon) * chunk
        executed = self._executed + (0 if self._last is None else chunk)
        situation = Situation(now, command, frames, executed)
        past = {view: [*self._past.get(view, []), self._shrunk(video[:-1])] for view, video in seen.items()}
        space = SearchSpace(
            lambda count: self._proposed(situation, count),
            lambda sequences: self._executable(command, sequences),
            self._rest(chunk, frames),
            self._random,
        )
        found = search(
            self._solver(space, self.candidates),
            lambda sequences: self._scores(simulation, sequences, past, first_points),
            batch=self._batch, seconds=self._seconds, certain=self._certain, clock=self._clock,
            margin=0.0 if self._last is None else self._margin,
        )  # fmt: skip
        self._first_state = command if self._first_state is None else self._first_state
        self._past = {view: [*past[view], self._shrunk(video[-1:])] for view, video in seen.items()}
        self._points, self._last, self._executed = first_points, found, executed
        calls = len(found.scores) * frames // chunk
        best = found.sequences[0]
        return Plan(best[:chunk], best, float(found.scores[0]), found.scores, calls, found.seconds, found.stopped)

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
        )  # fmt: skip

    def _rest(self, chunk: int, frames: int) -> np.ndarray:
        """Sequences of the last search without their executed chunk, the last command held where they end early."""
        if self._last is None:
            return np.empty((0, frames, self.kinematics.embodiment.state_size))
        rows = np.minimum(np.arange(chunk, chunk + frames), self._last.sequences.shape[1] - 1)
        return self._last.sequences[:, rows]

    def _proposed(self, situation: Situation, count: int) -> np.ndarray:
        proposed = np.asarray(self.propose(situation, count, self._random), dtype=np.float64)
        wanted = (count, situation.frames, len(situation.state))
        if proposed.shape != wanted or not np.isfinite(proposed).all():
            raise DataError(
                "Proposals do not fit", expected=f"{wanted}: candidates, frames, columns of the state; finite",
                got=f"{proposed.shape}, {int((~np.isfinite(proposed)).sum())} not finite",
            )  # fmt: skip
        return proposed

    def _executable(self, command: np.ndarray, sequences: np.ndarray) -> np.ndarray:
        starts = np.repeat(command[None], len(sequences), axis=0)
        fps = self.world.contract.fps
        robot = CommandedRobot(self.kinematics, fps, starts, limits=self._limits)
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
            except Exception as error:  # somebody else's function
                raise DataError(
                    "The score function of a planner failed",
                    where=f"candidate {number} of a batch of {len(videos)}, a video of {trajectory.num_frames} frames",
                    expected="a number for every video, higher is better", got=f"{type(error).__name__}: {error}",
                ) from error  # fmt: skip
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
        nominal: ``(m, j)`` from the episode's first command after the start on (its last row is held); None holds the last command.
        colour: of the noise over time, 0 white, 2 smooth.
    """

    def propose(situation: Situation, count: int, random: np.random.Generator) -> np.ndarray:
        middle = situation.state[None] if nominal is None else _from_here(nominal, situation)
        shape = (count, situation.frames, len(situation.state))
        return middle + deviation * coloured_noise(random, shape, colour)

    return propose


def recorded(controls: Float[np.ndarray, "m n j"]) -> Propose:
    """Proposals from recorded sequences (row 0 is the first command after the start; the last one is held), drawn without repetition
    where there are enough; later in the episode, the rest of each."""

    def propose(situation: Situation, count: int, random: np.random.Generator) -> np.ndarray:
        order = np.concatenate([random.permutation(len(controls)) for _ in range(-(-count // len(controls)))])
        return np.stack([_from_here(controls[number], situation) for number in order[:count]])

    return propose


def _from_here(rows: np.ndarray, situation: Situation) -> np.ndarray:
    frames = np.arange(situation.executed, situation.executed + situation.frames)
    return np.asarray(rows)[np.minimum(frames, len(rows) - 1)]


def judged(selector: Selector) -> Score:
    """Score of a selector of open-loop planning (measured, or a vision-language model), 0..1."""
    return lambda video: selector.score(video.instruction, shown_video(video)).score / 100.0


class GoalPicture:
    """Score by nearness to a picture of the goal: mean cosine similarity (-1..1) of video features, cell by cell, of the last picture
    and the goal's.

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
