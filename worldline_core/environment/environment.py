"""The simulator as a batched Gymnasium environment, and as a single one.

A step takes one command a frame, in the embodiment's layout and units. Pictures come block by block, because the model
predicts a block at once: commands are collected, and when the block is full it is predicted. ``observe_every`` says how often a
policy sees new pictures: by default once a block, so a policy should act in chunks of ``frames_per_step`` commands. With a
smaller number the block is also predicted from what was commanded so far, the last command held, and predicted again when
there are more (``frames_per_step / observe_every`` times the work). Between two observations the pictures stay; the state of the
robot (``agent_pos``) is new at every step.

Episodes begin at recorded first frames: a seed ``s`` at start ``s`` modulo their number, with noise of seed ``s``; or at any frame of
a recording that is named, with what happened before it: the robot's motion, and the video so far. They end after
``episode_frames`` steps, where a judge looks at the whole video: ``is_success``, and a reward of 1. What the judge cannot see is no
success.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Literal, get_args

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from worldline_core.errors import ConfigError, DataError
from worldline_core.evaluation.policy.judge import judge_trajectory
from worldline_core.evaluation.policy.measured_judge import MeasuredEvidenceJudge, soft_score
from worldline_core.evaluation.recordings import Trajectory, shown_points, simulated_points
from worldline_core.evaluation.segmenters.segmenter import Segmenter, open_segmenter
from worldline_core.geometry.embodiment import LIMIT_TOLERANCE_RAD, Embodiment, load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.rollout.observation import project_controls, require_drivable
from worldline_core.rollout.recorded_starts import RecordedStart, RecordedStarts
from worldline_core.rollout.simulation import USUAL_CLIP_FRAMES, LazyFrames, Simulation
from worldline_core.rollout.worldline import WorldLine
from worldline_core.shipped import shipped_folder

Success = Callable[[Trajectory], bool | None]
"""True for a video that shows its task done; None where that cannot be seen. Frames are decoded as they are indexed (`LazyFrames`)."""


Reward = Literal["success", "soft"]


def shipped_segmenter() -> Segmenter:
    """The segmenter that the measured judge uses here."""
    return open_segmenter("learned", learned=shipped_folder() / "models" / "segmenter", sam3=None)


class MeasuredSuccess:
    """The measured judge with the shipped segmenter: it tracks the thing that the instruction names by its colour."""

    def __init__(self) -> None:
        self._judge = MeasuredEvidenceJudge(shipped_segmenter())

    def __call__(self, trajectory: Trajectory) -> bool:
        return judge_trajectory(self._judge, trajectory).success


class RobotSpaces:
    """Commands of a robot as actions; pictures ``uint8 (H, W, 3)`` by view and its state as observations.

    Args:
        flat: observations have one level of keys, the views and ``agent_pos``, instead of ``pixels`` and ``agent_pos``.
        normalised: actions are -1 to 1: linear from a joint's lower to its upper limit, and over a gripper's range (of an
            embodiment whose grippers are 0 when closed: -1 closed, 1 open).

    Attributes:
        action, observation: spaces of one environment.

    Raises:
        ConfigError: actions shall be normalised, and a joint has no limits.
    """

    def __init__(
        self, robot: Embodiment, views: Sequence[str], image_size: tuple[int, int], *, flat: bool, normalised: bool
    ) -> None:
        self.robot, self.flat, self.normalised = robot, flat, normalised
        self._low, self._high = (np.full(robot.state_size, bound) for bound in (-np.inf, np.inf))
        for arm in robot.arms:
            self._low[robot.joint_columns(arm)], self._high[robot.joint_columns(arm)] = np.array(arm.limits).T
            column = robot.gripper_column(arm)
            self._low[column], self._high[column] = sorted((arm.gripper.closed, arm.gripper.open))
        if normalised and not np.isfinite(self._high - self._low).all():
            free = [robot.state_names[column] for column in np.flatnonzero(~np.isfinite(self._high - self._low))]
            raise ConfigError(
                "Commands of a joint without limits cannot be normalised", where=f"embodiment {robot.name}, {free[0]}",
                expected="limits of every joint", next_step="add them to the embodiment's file, or take commands in its units",
            )  # fmt: skip
        low, high = self._low.astype(np.float32), self._high.astype(np.float32)
        self.action = gymnasium.spaces.Box(low, high, dtype=np.float32)
        if normalised:
            self.action = gymnasium.spaces.Box(-1.0, 1.0, low.shape, np.float32)
        # A recording may begin a little beyond a limit, and stays where it is.
        state = gymnasium.spaces.Box(low - LIMIT_TOLERANCE_RAD, high + LIMIT_TOLERANCE_RAD, dtype=np.float32)
        picture = gymnasium.spaces.Box(0, 255, (*image_size, 3), np.uint8)
        pictures: dict[str, gymnasium.Space[Any]] = dict.fromkeys(views, picture)
        parts = pictures if flat else {"pixels": gymnasium.spaces.Dict(pictures)}
        self.observation = gymnasium.spaces.Dict({**parts, "agent_pos": state})

    def observed(self, pictures: Mapping[str, np.ndarray], state: np.ndarray) -> dict[str, Any]:
        """An observation, or a batch of them, from pictures by view and states in the embodiment's units."""
        parts = pictures if self.flat else {"pixels": dict(pictures)}
        return {**parts, "agent_pos": state.astype(np.float32)}

    def commands(self, actions: Any, count: int | None = None) -> np.ndarray:
        """Commands of one step in the embodiment's units, float64 ``(j)``, or ``(count, j)``.

        Raises: DataError: the actions have another shape, are not finite, or beyond -1 to 1 where they are normalised.
        """
        shape = (self.robot.state_size,) if count is None else (count, self.robot.state_size)
        try:
            given = np.asarray(actions)
        except ValueError:  # rows of different lengths
            given = np.empty(0)
        numbers = given.dtype.kind in "fiu" and given.shape == shape
        if not numbers or not np.isfinite(commands := given.astype(np.float64)).all():
            raise DataError(
                "Not the commands of one step", expected=f"finite {shape}: {', '.join(self.robot.state_names)}",
                got="numbers that are not finite" if numbers else f"{given.dtype} {given.shape}",
            )  # fmt: skip
        if not self.normalised:
            return commands
        if (beyond := np.abs(commands) > 1).any():
            column = int(np.argwhere(beyond)[0][-1])
            raise DataError(
                "A normalised action is out of range", where=self.robot.state_names[column], expected="-1 to 1",
                got=commands[beyond][0], next_step="clip the actions; commands in radians need normalised_actions=False",
            )  # fmt: skip
        return ((1 - commands) * self._low + (1 + commands) * self._high) / 2

    def actions(self, commands: np.ndarray) -> np.ndarray:
        """The actions, float32, that are these commands ``(..., j)`` in the embodiment's units: the inverse of `commands`."""
        given = np.asarray(commands, np.float64)
        if self.normalised:
            given = (2 * given - self._low - self._high) / (self._high - self._low)
        return given.astype(np.float32)


def each_seed(given: int | Sequence[int | None] | None, count: int) -> list[int | None]:
    """A seed for each of ``count`` episodes: those given, or counted up from the one given, or None for each.

    Raises: DataError when ``given`` has another number of seeds, or something that is no seed.
    """
    if isinstance(given, int | np.integer):
        given = [int(given) + number for number in range(count)]
    seeds: list[int | None] = [None] * count
    if given is not None:
        seeds = list(given) if isinstance(given, Sequence | np.ndarray) else []
    known = [seed for seed in seeds if seed is not None]
    if len(seeds) != count or not all(isinstance(seed, int | np.integer) and 0 <= seed < 2**63 for seed in known):
        raise DataError("Not the seeds of the episodes", expected=f"one, or {count}, from 0 to 2^63 - 1", got=given)
    return seeds


def each_start(
    options: dict[str, Any] | None, usual: tuple[str | None, int], count: int
) -> list[tuple[str | None, int]]:
    """Recording (None: that of the seed) and frame at which each of ``count`` episodes begins.

    Args:
        options: of a reset: ``start`` and ``frame``, one for all or a list for each; where there is none or None, the usual one.

    Raises: DataError for another number of them, or names that are nearly these.
    """
    given = dict(options or {})
    columns: list[list[Any]] = []
    for name, value in zip(("start", "frame"), usual, strict=True):
        asked = given.pop(name, None)
        each = list(asked) if isinstance(asked, list | tuple | np.ndarray) else [asked] * count
        if len(each) != count:
            raise DataError("Not the starts of the episodes", where=name, expected=f"one, or {count}", got=asked)
        columns.append([value if one is None else one for one in each])
    # Wrappers and LeRobot give options of their own, so that only what looks misspelt is refused.
    misspelt = [name for name in given if get_close_matches(str(name), ("start", "frame"), cutoff=0.75)]
    if misspelt:
        raise DataError("Unknown options of a reset", expected="start, frame", got=", ".join(misspelt))
    return list(zip(*columns, strict=True))


class SideBySide:
    """Maps over several clips at once, because one of them does not fill the cores.

    Args:
        count: threads, which share those of torch.
    """

    def __init__(self, count: int) -> None:
        self.count = count
        share = torch.get_num_threads() // count
        self._pool = ThreadPoolExecutor(count, initializer=torch.set_num_threads, initargs=(share,))

    def __call__[T](self, work: Callable[..., T], *arguments: Sequence[Any]) -> list[T]:
        if self.count == 1 or len(arguments[0]) == 1:
            return list(map(work, *arguments))
        threads = torch.get_num_threads()
        results = list(self._pool.map(work, *arguments))
        torch.set_num_threads(threads)  # what a thread of the pool sets is also the default of threads that begin later
        return results


class CommandedSimulation:
    """A simulation that takes one command at a time, and predicts a block where it is asked to.

    Attributes:
        commands: those that are not behind the simulation yet, ``(b, j)`` each.
        age: number of commands so far.
    """

    def __init__(self, simulation: Simulation) -> None:
        self.simulation, self.age = simulation, 0
        self.commands: list[np.ndarray] = []

    def take(self, commands: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Take one more command for each clip; returns what is executed of it, and the robots' states, ``(b, j)`` each."""
        self.commands.append(commands)
        self.age += 1
        executed, states = self.simulation.follow(np.stack(self.commands, axis=1))
        return executed[:, -1], states[:, -1]

    def predict(self) -> tuple[Simulation, list[dict[str, LazyFrames]]]:
        """The simulation after at most a block of the commands, and their videos, which are decoded where they are read.

        A copy predicts an unfinished block with the last command held: it is predicted again when there are more commands.
        """
        frames = self.simulation.frames_per_step
        block = np.stack(self.commands[:frames], axis=1)
        count = block.shape[1]
        simulation = self.simulation if count == frames else self.simulation.copy()
        held = np.repeat(block[:, -1:], frames - count, axis=1)
        clips = simulation.step_lazily(np.concatenate((block, held), axis=1))
        if count == frames:
            self.commands = self.commands[frames:]
            return simulation, clips
        return simulation, [{view: LazyFrames([video[:count]]) for view, video in clip.items()} for clip in clips]


@dataclass
class RunningEpisode:
    """One running episode: its video up to the last whole block, the newest picture, the robot's state, and the last reward.

    Attributes:
        score: the soft score; with further models the lowest of all.
        disagreement: the highest soft score less the lowest, 0..1; NaN without further models.
        doubted: the models disagreed too much, so the episode earns nothing more.
    """

    start: RecordedStart
    video: Trajectory
    picture: dict[str, np.ndarray]
    state: np.ndarray
    success: bool = False
    reward: float = 0.0
    score: float = 0.0
    facts: dict[str, float] = field(default_factory=dict)
    disagreement: float = math.nan
    doubted: bool = False

    def info(self) -> dict[str, Any]:
        known: dict[str, Any] = {"is_success": self.success, "episode_id": self.start.episode_id}
        known["task"] = self.start.instruction
        if self.facts:
            known |= {"score": self.score, "task_state": dict(self.facts)}
        if not math.isnan(self.disagreement):
            known |= {"disagreement": self.disagreement, "doubted": self.doubted}
        return known

    def look(self, segmenter: Segmenter, video: Trajectory, others: Sequence[float] = ()) -> None:
        """Measure how far the task is in the video so far; the reward is the change.

        Args:
            others: soft scores of the other models' videos.
        """
        before = self.score
        own, self.facts = soft_score(segmenter, video)
        self.score = min(own, *others) if others else own
        self.disagreement = max(own, *others) - self.score if others else math.nan
        self.reward = 0.0 if self.doubted else self.score - before


def longer(video: Trajectory, clip: Mapping[str, np.ndarray | LazyFrames], points: np.ndarray | None) -> Trajectory:
    """A video that goes on with a clip, and the tools in its head view where they are known."""
    seen: Any = video.frames
    frames: dict[str, Any] = {view: LazyFrames.joined(seen[view], more) for view, more in clip.items()}
    known = None if video.points is None or points is None else np.concatenate((video.points, points))
    return Trajectory(video.instruction, frames, video.fps, known)


class WorldLineVectorEnv(VectorEnv[dict[str, Any], np.ndarray, np.ndarray]):
    """Episodes of one robot, side by side; they begin and end together.

    Args:
        model: a Stage II or causal checkpoint, or a ``WorldLine``; by default the shipped causal one.
        members: further ones, given the same commands, because an optimised policy finds what one model gets wrong: a success is one
            in all videos, the soft score is the lowest. Observations are of ``model``.
        largest_disagreement: of soft scores (``disagreement`` in the infos); an episode with more is ``doubted``: it earns nothing
            more. A batch ends early where all of its episodes are doubted, so a single environment at once.
        recordings: an EpisodeSet, whose first frames are the starts; by default the shipped one.
        embodiment, splits: of the recordings that are used; ``embodiment`` may be left out where all are of one robot.
        views: that are simulated, one of the sets that the model was trained on; by default the largest.
        episode_frames: steps of an episode.
        observe_every: steps between two observations of pictures, a divisor of the block's length; by default the block.
        success: "measured" (`MeasuredSuccess`), a function, or None: then nothing is a success.
        reward: "success", 1 at the end of an episode that is one; or "soft", at every new picture what it adds to the likelihood
            that the task is done (`soft_score`), so that an episode's sum is the likelihood at its end less that at its beginning;
            infos have it (``score``) and what is measured (``task_state``).
        start, frame: name of a recording and number of a frame at which every episode begins; a reset's ``options`` may name others.
        flat_observation: one level of keys, the views and ``agent_pos``.
        normalised_actions: -1 to 1 from one limit of a joint or gripper to the other (`RobotSpaces`).
        limits: as of ``WorldLine.start``.
        autoreset: begin new episodes at the step after the last one, as Gymnasium's "NextStep"; False: ``reset`` is needed.
        options: further arguments of ``WorldLine.from_pretrained``.

    Raises:
        ConfigError: ``observe_every`` does not divide the block, a number is not positive, members predict at another rate, or
            there is nothing that could disagree.
        DataError: no recording fits, or there is no such start or frame.
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        model: Path | str | WorldLine | None = None,
        members: Sequence[Path | str | WorldLine] = (),
        largest_disagreement: float | None = None,
        recordings: Path | str | None = None,
        embodiment: str | None = None,
        splits: Sequence[str] = ("test",),
        views: Sequence[str] | None = None,
        episode_frames: int = 32,
        observe_every: int | None = None,
        success: Literal["measured"] | Success | None = "measured",
        reward: Reward = "success",
        start: str | None = None,
        frame: int = 0,
        flat_observation: bool = False,
        normalised_actions: bool = False,
        limits: bool = True,
        autoreset: bool = True,
        render_mode: Literal["rgb_array"] | None = "rgb_array",
        **options: Any,
    ) -> None:
        counted = all(isinstance(number, int) and number > 0 for number in (num_envs, episode_frames))
        judged = (success in ("measured", None) or callable(success)) and reward in get_args(Reward)
        if not counted or not judged:
            raise ConfigError(
                "Not an environment",
                got=f"num_envs {num_envs}, episode_frames {episode_frames}, success {success}, reward {reward}",
                expected="at least one environment and frame; success: measured, a function, or None; reward: success or soft",
            )  # fmt: skip
        if largest_disagreement is not None and not (members and reward == "soft" and 0 <= largest_disagreement <= 1):
            raise ConfigError(
                "No disagreement can be measured", where="largest_disagreement", got=largest_disagreement,
                expected="members, the soft reward, and a number from 0 to 1",
            )  # fmt: skip
        shipped = shipped_folder()
        self.world = _opened(model or shipped / "models" / "causal", options)
        self.views = self.world.chosen_views(views)
        self.starts = RecordedStarts(
            Path(recordings or shipped / "recordings"),
            view_sets=[self.views], fps=self.world.contract.fps, needs_cameras=self.world.needs_cameras,
            embodiment=embodiment, splits=splits,
        )  # fmt: skip
        self.kinematics = ArmKinematics(load_embodiment(self.starts.embodiment))
        self.num_envs, self.episode_frames = num_envs, episode_frames
        self._limits, self._autoreset = limits, autoreset
        self._succeeds = MeasuredSuccess() if success == "measured" else success
        self._segmenter = shipped_segmenter() if reward == "soft" else None
        self._usual_start = start, frame
        self.render_mode = render_mode
        self.metadata = {
            "render_modes": ["rgb_array"], "render_fps": round(self.world.contract.fps),
            "autoreset_mode": AutoresetMode.NEXT_STEP if autoreset else AutoresetMode.DISABLED,
        }  # fmt: skip
        self._largest_disagreement = 1.0 if largest_disagreement is None else largest_disagreement
        self._random = [np.random.default_rng() for _ in range(num_envs)]
        self._episodes: list[RunningEpisode] = []
        self._side_by_side = SideBySide(min(torch.get_num_threads(), num_envs))
        parts = self._side_by_side.count if self.world.device == "cpu" else 1
        self._parts = np.array_split(np.arange(num_envs), parts)
        self._running: list[CommandedSimulation] = []  # one for each part of the batch
        # Refuses before an episode begins what is not there, or what the model cannot be driven at.
        (first,) = self._chosen([0], each_start(None, self._usual_start, 1))
        require_drivable(self.world.info, self.views, first.cameras, self.kinematics.embodiment.name)
        self.frames_per_step = self.world.unit(USUAL_CLIP_FRAMES)
        self.observe_every = observe_every or self.frames_per_step
        if self.observe_every < 1 or self.frames_per_step % self.observe_every:
            raise ConfigError(
                "observe_every does not divide a block of the model",
                expected=f"observe_every a divisor of {self.frames_per_step}", got=f"observe_every {self.observe_every}",
            )  # fmt: skip
        self._members = [self._member(other, recordings, splits, options) for other in members]
        self.spaces = RobotSpaces(
            self.kinematics.embodiment, self.views, self.world.image_size, flat=flat_observation,
            normalised=normalised_actions,
        )  # fmt: skip
        self.single_action_space, self.single_observation_space = self.spaces.action, self.spaces.observation
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin new episodes, at the starts of the seeds (an integer counts up), or else at drawn ones.

        Args:
            options: ``start``, a recording's name, and ``frame``, the number of one of its frames; one for all, or a list.

        Raises: DataError: other seeds or options than one, or one for each; there is no such recording or frame.
        """
        self._begin(each_seed(seed, self.num_envs), each_start(options, self._usual_start, self.num_envs))
        return self._observation(), self._infos()

    def step(self, actions: np.ndarray) -> tuple[dict[str, Any], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One command for each episode; see the module's text for when pictures are new.

        Raises: DataError: the commands have another shape or are not finite, or the episodes have ended or not begun.
        """
        commands = self.spaces.commands(actions, self.num_envs)
        if not self._episodes or (self._over and not self._autoreset):
            raise DataError("An episode has ended or not begun", next_step="call reset first")
        if self._over:
            self.reset()
        else:
            self._advance(commands)
        last = self._over
        success = np.array([episode.success for episode in self._episodes])
        rewards = np.array([episode.reward for episode in self._episodes])
        return self._observation(), rewards, success, last & ~success, self._infos()

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Latest picture of each episode, its views side by side, ``uint8 (H, views * W, 3)``."""
        if self.render_mode is None:
            return None
        return tuple(
            np.concatenate([episode.picture[view] for view in self.views], axis=1) for episode in self._episodes
        )

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """An attribute or a method's result of every environment, as in Gymnasium's own vector environments."""
        if name == "render":
            return self.render() or ()
        if name in ("task", "task_description"):
            return tuple(episode.start.instruction for episode in self._episodes)
        if name == "_max_episode_steps":
            return (self.episode_frames,) * self.num_envs
        raise AttributeError(f"{type(self).__name__} has no attribute {name!r} for each environment")

    def get_attr(self, name: str) -> tuple[Any, ...]:
        return self.call(name)

    @property
    def _over(self) -> bool:
        return self._running[0].age == self.episode_frames or all(episode.doubted for episode in self._episodes)

    def _member(
        self,
        model: Path | str | WorldLine,
        recordings: Path | str | None,
        splits: Sequence[str],
        options: dict[str, Any],
    ) -> WorldLineVectorEnv:
        """The same episodes in another model, which judges at least as often."""
        world = _opened(model, options)
        if world.contract.fps != self.world.contract.fps:
            raise ConfigError(
                "A member predicts at another rate", where="members", expected=f"{self.world.contract.fps:g} frames per second",
                got=f"{world.contract.fps:g}",
            )  # fmt: skip
        return WorldLineVectorEnv(
            self.num_envs, model=world, recordings=recordings, embodiment=self.starts.embodiment, splits=splits,
            views=self.views, episode_frames=self.episode_frames, success=self._succeeds,
            observe_every=math.gcd(self.observe_every, world.unit(USUAL_CLIP_FRAMES)),
            reward="success" if self._segmenter is None else "soft", limits=self._limits,
        )  # fmt: skip

    def _chosen(self, seeds: Sequence[int], asked: Sequence[tuple[str | None, int]]) -> list[RecordedStart]:
        """The start of each episode: the one that is asked for, or that of its seed."""
        numbered = (self.starts.rows[seed % len(self.starts)].episode_id for seed in seeds)
        pairs = zip(numbered, asked, strict=True)
        return [self.starts.at(own if name is None else name, frame) for own, (name, frame) in pairs]

    def _begin(self, given: Sequence[int | None], asked: Sequence[tuple[str | None, int]]) -> None:
        """Start with the given seeds, where there is none with one drawn by the episode's generator."""
        for slot, seed in enumerate(given):
            if seed is not None:
                self._random[slot] = np.random.default_rng(seed)
        seeds = [int(self._random[slot].integers(2**31) if seed is None else seed) for slot, seed in enumerate(given)]
        starts = self._chosen(seeds, asked)
        named = [(start.episode_id, frame) for start, (_, frame) in zip(starts, asked, strict=True)]
        for member in self._members:
            member._begin(seeds, named)

        def begun(part: np.ndarray) -> CommandedSimulation:
            own = [starts[slot] for slot in part]
            return CommandedSimulation(self.world.start(
                [start.images for start in own], [start.cameras for start in own], embodiment=self.kinematics,
                state=np.stack([start.state for start in own]), seed=[seeds[slot] for slot in part], limits=self._limits,
                earlier=[start.earlier for start in own],
            ))  # fmt: skip

        self._running = self._side_by_side(begun, self._parts)
        first = [
            (picture, simulated_points(running.simulation, slot), running.simulation.state[slot])
            for running in self._running
            for slot, picture in enumerate(running.simulation.pictures)
        ]
        self._episodes = [
            RunningEpisode(start, self._video_so_far(start, picture, points), picture, state)
            for start, (picture, points, state) in zip(starts, first, strict=True)
        ]
        if self._segmenter is not None:
            self._look([episode.video for episode in self._episodes])
            for episode in self._episodes:
                episode.reward = 0.0

    def _video_so_far(self, start: RecordedStart, picture: dict[str, np.ndarray], points: np.ndarray) -> Trajectory:
        """The picture, as the model sees it, and where a judge will look at it, what was recorded before."""
        size, fps = self.world.image_size, self.world.contract.fps
        frames: dict[str, Any] = {view: seen[None] for view, seen in picture.items()}
        if not len(start.earlier) or (self._succeeds is None and self._segmenter is None):
            return Trajectory(start.instruction, frames, fps, points)
        shown = next(iter(start.images.values())).shape[:2]
        tracks = project_controls(start.cameras, shown, self.kinematics, controls=start.commands[:-1], fps=fps)
        before = Trajectory(start.instruction, self.starts.before(start, size), fps, shown_points(tracks, size))
        return longer(before, frames, points)

    def _advance(self, commands: np.ndarray) -> None:
        """Take one command for each episode; predict and judge when it is time."""
        for member in self._members:
            member._advance(commands)
        states = [running.take(commands[part])[1] for part, running in zip(self._parts, self._running, strict=True)]
        for episode, state in zip(self._episodes, np.concatenate(states), strict=True):
            episode.state, episode.reward = state, 0.0
        count, last = len(self._running[0].commands), self._running[0].age == self.episode_frames
        if not last and count % self.observe_every:
            return
        # A block of a few clips does not fill several cores.
        predicted = self._side_by_side(CommandedSimulation.predict, self._running)
        shown = [
            (clip, simulated_points(simulation, slot)[:count])
            for simulation, clips in predicted
            for slot, clip in enumerate(clips)
        ]
        videos = []
        for episode, (clip, points) in zip(self._episodes, shown, strict=True):
            episode.picture = {view: video[-1] for view, video in clip.items()}
            videos.append(longer(episode.video, clip, points))
            if count == self.frames_per_step:
                episode.video = videos[-1]
        if last and self._succeeds is not None:
            # A user's function is called for one video at a time.
            beside = isinstance(self._succeeds, MeasuredSuccess)
            judged = self._side_by_side(self._succeeds, videos) if beside else map(self._succeeds, videos)
            for slot, (episode, found) in enumerate(zip(self._episodes, judged, strict=True)):
                if not isinstance(found, bool | np.bool_ | None):
                    raise DataError("Not a judgement", where="success", expected="True, False or None", got=found)
                episode.success = bool(found) and all(member._episodes[slot].success for member in self._members)
        for episode in self._episodes:
            episode.reward = float(episode.success)
        if self._segmenter is not None:
            self._look(videos)
            for episode in self._episodes:
                episode.doubted |= episode.disagreement > self._largest_disagreement

    def _look(self, videos: Sequence[Trajectory]) -> None:
        """Measure how far each episode is in its video so far."""
        others = [[member._episodes[slot].score for member in self._members] for slot in range(self.num_envs)]
        self._side_by_side(RunningEpisode.look, self._episodes, [self._segmenter] * self.num_envs, videos, others)

    def _observed(self, slot: int) -> dict[str, Any]:
        episode = self._episodes[slot]
        return self.spaces.observed({view: episode.picture[view].copy() for view in self.views}, episode.state)

    def _observation(self) -> dict[str, Any]:
        episodes = self._episodes
        pictures = {view: np.stack([episode.picture[view] for episode in episodes]) for view in self.views}
        return self.spaces.observed(pictures, np.stack([episode.state for episode in episodes]))

    def infos(self) -> list[dict[str, Any]]:
        return [episode.info() for episode in self._episodes]

    def _infos(self) -> dict[str, Any]:
        gathered: dict[str, Any] = {}
        for slot, info in enumerate(self.infos()):
            gathered = self._add_info(gathered, info, slot)
        return gathered


def _opened(model: Path | str | WorldLine, options: Mapping[str, Any]) -> WorldLine:
    return model if isinstance(model, WorldLine) else WorldLine.from_pretrained(model, **options)


class WorldLineEnv(gymnasium.Env[dict[str, Any], np.ndarray]):
    """One episode at a time; arguments as of :class:`WorldLineVectorEnv`."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 8}  # noqa: RUF012

    def __init__(self, render_mode: Literal["rgb_array"] | None = None, **options: Any) -> None:
        self.vector = WorldLineVectorEnv(1, render_mode=render_mode, autoreset=False, **options)
        self.render_mode = render_mode
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": self.vector.metadata["render_fps"]}
        self.spaces = self.vector.spaces
        self.action_space, self.observation_space = self.spaces.action, self.spaces.observation

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin an episode: at start ``seed`` modulo their number, at a drawn one, or at the one named by the options."""
        super().reset(seed=seed)
        chosen = int(self.np_random.integers(2**31)) if seed is None else seed
        self.vector.reset(seed=[chosen], options=options)
        return self.vector._observed(0), self.vector.infos()[0]

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        _, reward, terminated, truncated, _ = self.vector.step(np.asarray(action)[None])
        observed, info = self.vector._observed(0), self.vector.infos()[0]
        return observed, float(reward[0]), bool(terminated[0]), bool(truncated[0]), info

    def render(self) -> np.ndarray | None:
        pictures = self.vector.render()
        return None if pictures is None else pictures[0]
