"""The simulator as a batched Gymnasium environment, and as a single one.

A step takes one command a frame, in the embodiment's layout and units. Pictures come block by block, because the model
predicts a block at once: commands are collected, and when the block is full it is predicted. ``observe_every`` says how often a
policy sees new pictures: by default once a block, so a policy should act in chunks of ``frames_per_step`` commands. With a
smaller number the block is also predicted from what was commanded so far, the last command held, and predicted again when
there are more (``frames_per_step / observe_every`` times the work). Between two observations the pictures stay; the state of the
robot (``agent_pos``) is new at every step.

Episodes begin at recorded first frames: a seed ``s`` at start ``s`` modulo their number, with noise of seed ``s``. They end after
``episode_frames`` steps, where a judge looks at the whole video: ``is_success``, and a reward of 1. What the judge cannot see is no
success.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from worldline_core.errors import ConfigError, DataError
from worldline_core.evaluation.policy.judge import judge_trajectory
from worldline_core.evaluation.policy.measured_judge import MeasuredEvidenceJudge
from worldline_core.evaluation.recordings import Trajectory, simulated_points
from worldline_core.evaluation.segmenters.segmenter import open_segmenter
from worldline_core.geometry.embodiment import LIMIT_TOLERANCE_RAD, Embodiment, load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.rollout.recorded_starts import RecordedStart, RecordedStarts
from worldline_core.rollout.simulation import Frames, Simulation
from worldline_core.rollout.worldline import WorldLine
from worldline_core.shipped import shipped_folder

Success = Callable[[Trajectory], bool | None]
"""True for a video that shows its task done; None where that cannot be seen."""


def measured_success() -> Success:
    """The measured judge with the shipped segmenter: it tracks the thing that the instruction names by its colour."""
    segmenter = open_segmenter("learned", learned=shipped_folder() / "models" / "segmenter", sam3=None)
    judge = MeasuredEvidenceJudge(segmenter)
    return lambda trajectory: judge_trajectory(judge, trajectory).success


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

    def predict(self) -> tuple[Simulation, Frames]:
        """The simulation after at most a block of the commands, and their videos.

        A copy predicts an unfinished block with the last command held: it is predicted again when there are more commands.
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


@dataclass
class RunningEpisode:
    """One running episode: its start, its video so far, the tools in the head view, the newest picture, and the robot's state."""

    start: RecordedStart
    video: dict[str, list[np.ndarray]]
    points: list[np.ndarray]
    picture: dict[str, np.ndarray]
    state: np.ndarray
    success: bool = False

    def trajectory(self, fps: float) -> Trajectory:
        """The video so far, as a judge sees it."""
        video: dict[str, Any] = {view: np.concatenate(pieces) for view, pieces in self.video.items()}
        return Trajectory(self.start.instruction, video, fps, np.concatenate(self.points))


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


def robot_spaces(
    robot: Embodiment, views: Sequence[str], image_size: tuple[int, int]
) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Dict]:
    """Commands of a robot, and observations of it: pictures ``uint8 (H, W, 3)`` by view, and its state."""
    low, high = (np.full(robot.state_size, bound, np.float32) for bound in (-np.inf, np.inf))
    for arm in robot.arms:
        low[robot.joint_columns(arm)], high[robot.joint_columns(arm)] = np.array(arm.limits, np.float32).T
        column = robot.gripper_column(arm)
        low[column], high[column] = sorted((arm.gripper.closed, arm.gripper.open))
    picture = gymnasium.spaces.Box(0, 255, (*image_size, 3), np.uint8)
    # A recording may begin a little beyond a limit, and stays where it is.
    state = gymnasium.spaces.Box(low - LIMIT_TOLERANCE_RAD, high + LIMIT_TOLERANCE_RAD, dtype=np.float32)
    seen = gymnasium.spaces.Dict({"pixels": gymnasium.spaces.Dict(dict.fromkeys(views, picture)), "agent_pos": state})
    return gymnasium.spaces.Box(low, high, dtype=np.float32), seen


def checked_commands(actions: Any, shape: tuple[int, ...] | None, robot: Embodiment) -> np.ndarray:
    """Commands of one step as float64.

    Raises: DataError: they have another shape or are not finite.
    """
    try:
        given = np.asarray(actions)
    except ValueError:  # rows of different lengths
        given = np.empty(0)
    numbers = given.dtype.kind in "fiu" and given.shape == shape
    if not numbers or not np.isfinite(commands := given.astype(np.float64)).all():
        raise DataError(
            "Not the commands of one step",
            expected=f"finite {shape}: {', '.join(robot.state_names)}",
            got="numbers that are not finite" if numbers else f"{given.dtype} {given.shape}",
        )
    return commands


class WorldLineVectorEnv(VectorEnv[dict[str, Any], np.ndarray, np.ndarray]):
    """Episodes of one robot, side by side; they begin and end together.

    Args:
        model: a Stage II or causal checkpoint, or a ``WorldLine``; by default the shipped causal one.
        recordings: an EpisodeSet, whose first frames are the starts; by default the shipped one.
        embodiment, splits: of the recordings that are used; ``embodiment`` may be left out where all are of one robot.
        views: that are simulated, one of the sets that the model was trained on; by default the largest.
        episode_frames: steps of an episode.
        observe_every: steps between two observations of pictures, a divisor of the block's length; by default the block.
        success: "measured" (`measured_success`), a function, or None: then nothing is a success.
        limits: as of ``WorldLine.start``.
        autoreset: begin new episodes at the step after the last one, as Gymnasium's "NextStep"; False: ``reset`` is needed.
        options: further arguments of ``WorldLine.from_pretrained``.

    Raises:
        ConfigError: ``observe_every`` does not divide the block, or a number is not positive.
        DataError: no recording fits.
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        model: Path | str | WorldLine | None = None,
        recordings: Path | str | None = None,
        embodiment: str | None = None,
        splits: Sequence[str] = ("test",),
        views: Sequence[str] | None = None,
        episode_frames: int = 32,
        observe_every: int | None = None,
        success: Literal["measured"] | Success | None = "measured",
        limits: bool = True,
        autoreset: bool = True,
        render_mode: Literal["rgb_array"] | None = "rgb_array",
        **options: Any,
    ) -> None:
        counted = all(isinstance(number, int) and number > 0 for number in (num_envs, episode_frames))
        if not counted or not (success in ("measured", None) or callable(success)):
            raise ConfigError(
                "Not an environment", got=f"num_envs {num_envs}, episode_frames {episode_frames}, success {success}",
                expected="at least one environment and frame; success: measured, a function, or None",
            )  # fmt: skip
        shipped = shipped_folder()
        self.world = (
            model
            if isinstance(model, WorldLine)
            else WorldLine.from_pretrained(model or shipped / "models" / "causal", **options)
        )
        self.views = self.world.chosen_views(views)
        self.starts = RecordedStarts(
            Path(recordings or shipped / "recordings"),
            view_sets=[self.views], fps=self.world.contract.fps, embodiment=embodiment, splits=splits,
        )  # fmt: skip
        self.kinematics = ArmKinematics(load_embodiment(self.starts.embodiment))
        self.num_envs, self.episode_frames = num_envs, episode_frames
        self._limits, self._autoreset = limits, autoreset
        self._succeeds = measured_success() if success == "measured" else success
        self.render_mode = render_mode
        self.metadata = {
            "render_modes": ["rgb_array"], "render_fps": round(self.world.contract.fps),
            "autoreset_mode": AutoresetMode.NEXT_STEP if autoreset else AutoresetMode.DISABLED,
        }  # fmt: skip
        self._random = [np.random.default_rng() for _ in range(num_envs)]
        self._episodes: list[RunningEpisode] = []
        self._running = self._begun([0])
        self.frames_per_step = self._running.simulation.frames_per_step
        self.observe_every = observe_every or self.frames_per_step
        if self.observe_every < 1 or self.frames_per_step % self.observe_every:
            raise ConfigError(
                "observe_every does not divide a block of the model",
                expected=f"observe_every a divisor of {self.frames_per_step}", got=f"observe_every {self.observe_every}",
            )  # fmt: skip
        self.single_action_space, self.single_observation_space = robot_spaces(
            self.kinematics.embodiment, self.views, self.world.image_size
        )
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin new episodes, at the starts of the seeds (an integer counts up), or else at drawn ones.

        Raises: DataError: other seeds than one, or one for each.
        """
        self._begin(each_seed(seed, self.num_envs))
        return self._observation(), self._infos()

    def step(self, actions: np.ndarray) -> tuple[dict[str, Any], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One command for each episode; see the module's text for when pictures are new.

        Raises: DataError: the commands have another shape or are not finite, or the episodes have ended or not begun.
        """
        commands = checked_commands(actions, self.action_space.shape, self.kinematics.embodiment)
        over = self._running.age == self.episode_frames
        if not self._episodes or (over and not self._autoreset):
            raise DataError("An episode has ended or not begun", next_step="call reset first")
        if over:
            self._begin([None] * self.num_envs)
        else:
            self._advance(commands)
        last = self._running.age == self.episode_frames
        success = np.array([episode.success for episode in self._episodes])
        return self._observation(), success.astype(np.float64), success, last & ~success, self._infos()

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
        """An attribute of every environment."""
        return self.call(name)

    def _begun(self, seeds: Sequence[int]) -> CommandedSimulation:
        starts = [self.starts[seed % len(self.starts)] for seed in seeds]
        return CommandedSimulation(
            self.world.start(
                [start.images for start in starts], [start.cameras for start in starts], embodiment=self.kinematics,
                state=np.stack([start.state for start in starts]), seed=seeds, limits=self._limits,
            )
        )  # fmt: skip

    def _begin(self, given: Sequence[int | None]) -> None:
        """Start at the given seeds; where there is none, at one drawn by the episode's generator."""
        seeds: list[int] = []
        for slot, seed in enumerate(given):
            if seed is not None:
                self._random[slot] = np.random.default_rng(seed)
            seeds.append(int(self._random[slot].integers(2**31)) if seed is None else int(seed))
        self._running = self._begun(seeds)
        simulation = self._running.simulation
        self._episodes = [
            RunningEpisode(
                self.starts[seed % len(self.starts)], {view: [frame[None]] for view, frame in picture.items()},
                [simulated_points(simulation, slot)], picture, simulation.state[slot],
            )
            for slot, (seed, picture) in enumerate(zip(seeds, simulation.pictures, strict=True))
        ]  # fmt: skip

    def _advance(self, commands: np.ndarray) -> None:
        """Take one command for each episode; predict and judge when it is time."""
        running = self._running
        for episode, state in zip(self._episodes, running.take(commands)[1], strict=True):
            episode.state = state
        count, last = len(running.commands), running.age == self.episode_frames
        if not last and count % self.observe_every:
            return
        simulation, clips = running.predict()
        for slot, (episode, clip) in enumerate(zip(self._episodes, clips, strict=True)):
            episode.picture = {view: video[-1] for view, video in clip.items()}
            if last or count == self.frames_per_step:
                for view, video in clip.items():
                    episode.video[view].append(video)
                episode.points.append(simulated_points(simulation, slot)[:count])
            if last and self._succeeds is not None:
                found = self._succeeds(episode.trajectory(self.world.contract.fps))
                if not isinstance(found, bool | np.bool_ | None):
                    raise DataError("Not a judgement", where="success", expected="True, False or None", got=found)
                episode.success = bool(found)

    def _observed(self, slot: int) -> dict[str, Any]:
        episode = self._episodes[slot]
        pictures = {view: episode.picture[view].copy() for view in self.views}
        return {"pixels": pictures, "agent_pos": episode.state.astype(np.float32)}

    def _observation(self) -> dict[str, Any]:
        each = [self._observed(slot) for slot in range(self.num_envs)]
        pictures = {view: np.stack([one["pixels"][view] for one in each]) for view in self.views}
        return {"pixels": pictures, "agent_pos": np.stack([one["agent_pos"] for one in each])}

    def _info(self, slot: int) -> dict[str, Any]:
        episode = self._episodes[slot]
        start = episode.start
        return {"is_success": episode.success, "episode_id": start.episode_id, "task": start.instruction}

    def _infos(self) -> dict[str, Any]:
        gathered: dict[str, Any] = {}
        for slot in range(self.num_envs):
            gathered = self._add_info(gathered, self._info(slot), slot)
        return gathered


class WorldLineEnv(gymnasium.Env[dict[str, Any], np.ndarray]):
    """One episode at a time; arguments as of :class:`WorldLineVectorEnv`."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 8}  # noqa: RUF012

    def __init__(self, render_mode: Literal["rgb_array"] | None = None, **options: Any) -> None:
        self.vector = WorldLineVectorEnv(1, render_mode=render_mode, autoreset=False, **options)
        self.render_mode = render_mode
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": self.vector.metadata["render_fps"]}
        self.action_space = self.vector.single_action_space
        self.observation_space = self.vector.single_observation_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin an episode: at start ``seed`` modulo their number, or at a drawn one."""
        super().reset(seed=seed)
        chosen = int(self.np_random.integers(2**31)) if seed is None else seed
        self.vector.reset(seed=[chosen])
        return self.vector._observed(0), self.vector._info(0)

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """One command."""
        _, reward, terminated, truncated, _ = self.vector.step(np.asarray(action)[None])
        observed, info = self.vector._observed(0), self.vector._info(0)
        return observed, float(reward[0]), bool(terminated[0]), bool(truncated[0]), info

    def render(self) -> np.ndarray | None:
        """Latest picture, its views side by side."""
        pictures = self.vector.render()
        return None if pictures is None else pictures[0]
