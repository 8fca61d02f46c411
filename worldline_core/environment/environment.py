"""The simulator as a batched Gymnasium environment, and as a single one.

A step takes one command a frame, in the embodiment's layout and units. Pictures come block by block, because the model
predicts a block at once: commands are collected, and when the block is full it is predicted. ``observe_every`` says how often a
policy sees new pictures: by default once a block, so a policy should act in chunks of ``frames_per_step`` commands. With a
smaller number the block is also predicted from what was commanded so far, the last command held, and predicted again when
there are more (``frames_per_step / observe_every`` times the work). Between two observations the pictures stay; the state of the
robot (``agent_pos``) is new at every step.

Episodes begin at recorded first frames: a seed ``s`` at start ``s`` modulo their number, with noise of seed ``s``. They end after
``episode_frames`` steps, where a judge looks at the whole video: ``is_success``, and a reward of 1. What the judge cannot see is no
success. Environments that began together are stepped together.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from worldline_core.actions.episode_tracks import EpisodeTracks
from worldline_core.environment.starts import EpisodeStarts, Start
from worldline_core.errors import ConfigError, DataError
from worldline_core.evaluation.policy.judge import confidence_of, judge_trajectory
from worldline_core.evaluation.policy.measured_judge import MeasuredEvidenceJudge
from worldline_core.evaluation.policy.trust import (
    JudgedBy,
    PredictedBy,
    TrustCalibration,
    TrustModel,
    content_digest,
    control_vectors,
    reasons,
    setup_vectors,
)
from worldline_core.evaluation.recordings import Trajectory, simulated_points
from worldline_core.evaluation.segmenters.segmenter import open_segmenter
from worldline_core.geometry.embodiment import LIMIT_TOLERANCE_RAD, Embodiment, load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.model.pretrained import pretrained_folder
from worldline_core.rollout.samplers import FULL_STEPS
from worldline_core.rollout.simulation import Frames, Simulation
from worldline_core.rollout.worldline import WorldLine
from worldline_core.shipped import shipped_folder

Success = Callable[[Trajectory], bool | None]
"""True for a video that shows its task done; None where that cannot be seen."""


class TrustedJudge:
    """Success by the embedded judge, with its trust by a saved calibration.

    Args:
        segmenter: its folder.
        saved: trust.safetensors, or its folder.
        world, checkpoint: the model, and its folder. views, embodiment: of the simulations.

    Raises:
        ArtifactError: there is no such calibration.
        ConfigError: it was made with another judge, robot or checkpoint, or compares the predictions of two models.
    """

    def __init__(
        self, segmenter: Path, saved: Path, world: WorldLine, checkpoint: Path, views: Sequence[str], embodiment: str
    ) -> None:
        opened = open_segmenter("learned", learned=segmenter, sam3=None)
        self._judge = MeasuredEvidenceJudge(opened, states_confidence=True)
        self._saved = TrustModel.read(saved)
        digest = content_digest(segmenter)
        self._saved.require(
            JudgedBy(judge="measured", views=tuple(views), segmenter="learned", segmenter_weights=digest), (embodiment,)
        )
        causal = world.info.causal
        sampler, usual = ("full_clip", FULL_STEPS) if causal is None else ("block_causal", causal.steps)
        asked = PredictedBy(
            checkpoint=content_digest(checkpoint), sampler=sampler, steps=world.steps, shift=world.shift
        )
        either = [asked, asked.model_copy(update={"steps": None})] if world.steps == usual else [asked]
        found = [self._saved.calibration_of(made) for made in either]
        fitting = [calibration for calibration in found if isinstance(calibration, TrustCalibration)]
        if not fitting or "disagreement" in fitting[0].signals:
            raise ConfigError(
                "A saved calibration of trust is not of these simulations", where=saved,
                got=", ".join(fitting[0].signals) + ": disagreement needs a second model" if fitting else found[0],
                next_step="calibrate with rollouts of this checkpoint, without compare_with (docs/evaluation.md)",
            )  # fmt: skip
        self._calibration = fitting[0]
        self._confidence: float | None = None

    def __call__(self, trajectory: Trajectory) -> bool:
        judgement = judge_trajectory(self._judge, trajectory)
        self._confidence = confidence_of(asdict(judgement))
        return judgement.success

    def assess(self, tracks: Sequence[EpisodeTracks]) -> dict[str, Any]:
        """``trust``, the probability that the last verdict is right (NaN where the judge had nothing to judge by), and
        ``do_not_trust``, the reasons not to rely on it ("" where there are none).

        Args:
            tracks: action tracks of the episode so far.
        """
        poses, openings = (
            np.concatenate(rows) for rows in zip(*((t.T_base_tool, t.gripper[:, 0]) for t in tracks), strict=True)
        )
        row = {
            "episode_id": "of a simulation", "disagreement": None,
            "doubt": None if self._confidence is None else 1.0 - self._confidence,
            "new_controls": self._saved.controls.novelty(*control_vectors(poses, openings)),
            "new_setup": self._saved.setups.novelty(*setup_vectors(tracks[0])),
        }  # fmt: skip
        trust = self._calibration.trust([row])
        row["trust"] = None if isinstance(trust, str) else float(trust[0])
        marks = reasons(row, self._saved.least_trust) + (["nothing to judge by"] if row["trust"] is None else [])
        return {"trust": float("nan") if row["trust"] is None else row["trust"], "do_not_trust": ", ".join(marks)}


def judge_of(
    success: Success | Literal["measured"] | None,
    trust: Path | str | None,
    model: Path | str | WorldLine | None,
    world: WorldLine,
    views: Sequence[str],
    embodiment: str,
) -> Success | None:
    """The judge of an environment; the measured one tracks the thing that the instruction names by its colour.

    Raises: ConfigError where trust is asked for in another judge, or in a model without a folder; as of :class:`TrustedJudge`.
    """
    shipped = shipped_folder() / "models"
    if trust is not None:
        if success != "measured" or isinstance(model, WorldLine):
            raise ConfigError(
                "Trust is of the measured judge and of a checkpoint's folder", where="trust",
                got=f"success {success!r}, model {type(model).__name__}",
            )  # fmt: skip
        folder = pretrained_folder(model or shipped / "causal")
        return TrustedJudge(shipped / "segmenter", Path(trust), world, folder, views, embodiment)
    if success != "measured":
        return success
    judge = MeasuredEvidenceJudge(open_segmenter("learned", learned=shipped / "segmenter", sam3=None))
    return lambda trajectory: judge_trajectory(judge, trajectory).success


@dataclass
class RunningEpisode:
    """One running episode: its start, its video so far, the tools in the head view, and the controls' tracks."""

    start: Start
    video: dict[str, list[np.ndarray]]
    points: list[np.ndarray]
    picture: dict[str, np.ndarray]
    state: np.ndarray
    tracks: list[EpisodeTracks]
    success: bool = False
    trust: dict[str, Any] = field(default_factory=dict)

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
        """Take one more command for each episode; returns what is executed of it, and the robots' states, ``(b, j)`` each."""
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
        """The same without the episodes of some slots; None where none is left."""
        kept = [index for index, slot in enumerate(self.slots) if slot not in slots]
        if len(kept) in (0, len(self.slots)):
            return self if kept else None
        commands = [rows[kept] for rows in self.commands]
        return Together(self.simulation.select(kept), [self.slots[index] for index in kept], self.age, commands)


def each_seed(given: int | Sequence[int | None] | None, count: int) -> list[int | None]:
    """A seed for each of ``count`` episodes: those given, or counted up from the one given, or None for each.

    Raises: DataError when ``given`` has another number of seeds, or something that is no seed.
    """
    if isinstance(given, int | np.integer):
        given = [int(given) + number for number in range(count)]
    seeds: list[int | None] = [None] * count if given is None else []
    if isinstance(given, Sequence | np.ndarray):
        seeds = [*given]
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
    """Episodes of one robot, side by side.

    Args:
        model: a Stage II or causal checkpoint, or a ``WorldLine``; by default the shipped causal one.
        recordings: an EpisodeSet, whose first frames are the starts; by default the shipped one.
        embodiment, splits: of the recordings that are used; ``embodiment`` may be left out where all are of one robot.
        views: that are simulated, by default all of the model's.
        episode_frames: steps of an episode.
        observe_every: steps between two observations of pictures, a divisor of the block's length; by default the block.
        success: "measured" (by colour, with the shipped segmenter), a function, or None: then nothing is a success.
        stop_at_success: ask the judge after every block, and end the episode where it sees success.
        trust: trust.safetensors of an evaluation of this checkpoint by the measured judge, or its folder: when an episode has
            been judged, ``info`` has ``trust``, the probability that the judge is right, and ``do_not_trust``, why it should not
            be relied on ("" where it may).
        limits: as of ``WorldLine.start``.
        autoreset_mode: of finished episodes: at the next step, in the same step, or never (``reset`` with ``reset_mask``).
        options: further arguments of ``WorldLine.from_pretrained``.

    Raises:
        ConfigError: ``observe_every`` does not divide the block, or a number is not positive; ``trust`` was made with another
            checkpoint, judge or robot.
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
        stop_at_success: bool = False,
        trust: Path | str | None = None,
        limits: bool = True,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
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
        self.views = self.world.chosen_views(self.world.views if views is None else views)
        self.starts = EpisodeStarts(
            Path(recordings or shipped / "recordings"),
            embodiment=embodiment, splits=splits, views=self.views, fps=self.world.contract.fps,
        )  # fmt: skip
        self.kinematics = ArmKinematics(load_embodiment(self.starts.embodiment))
        self.num_envs, self.episode_frames = num_envs, episode_frames
        self._limits, self._stop_at_success = limits, stop_at_success
        self._succeeds = judge_of(success, trust, model, self.world, self.views, self.starts.embodiment)
        self.render_mode = render_mode
        self._autoreset = AutoresetMode(autoreset_mode)
        self.metadata = {
            "render_modes": ["rgb_array"], "render_fps": round(self.world.contract.fps), "autoreset_mode": self._autoreset,
        }  # fmt: skip
        self._together: list[Together] = []
        self._random = [np.random.default_rng() for _ in range(num_envs)]
        self._done = np.ones(num_envs, dtype=bool)
        self._episodes: list[RunningEpisode] = []
        self.frames_per_step = self._begun([self.starts[0]], [0]).frames_per_step
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

        Args:
            options: ``reset_mask``, bool ``(num_envs)``: which ones begin anew.

        Raises:
            DataError: other seeds than one, or one for each; a mask that names none, or is of another shape.
        """
        mask = np.asarray((options or {}).get("reset_mask", np.ones(self.num_envs, dtype=bool)))
        if mask.dtype != bool or mask.shape != (self.num_envs,) or not mask.any():
            raise DataError("Not a mask of episodes", where="reset_mask", expected=f"bool ({self.num_envs},)", got=mask)
        self._begin(np.flatnonzero(mask).tolist(), each_seed(seed, self.num_envs))
        return self._observation(), self._infos([self._info(slot) for slot in range(self.num_envs)])

    def step(self, actions: np.ndarray) -> tuple[dict[str, Any], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One command for each episode; see the module's text for when pictures are new.

        Raises:
            DataError: the commands have another shape or are not finite, or an episode has ended or not begun.
        """
        commands = checked_commands(actions, self.action_space.shape, self.kinematics.embodiment)
        restarted: list[int] = []
        if self._autoreset == AutoresetMode.NEXT_STEP and self._episodes:
            restarted = [slot for slot in range(self.num_envs) if self._done[slot]]
        elif self._done.any():
            ended = np.flatnonzero(self._done).tolist()
            raise DataError("An episode has ended or not begun", got=ended, next_step="call reset first")
        if not self._episodes:
            raise DataError("The environment was not reset", next_step="call reset first")
        going_on = [rest for group in self._together if (rest := group.without(restarted)) is not None]
        for group in going_on:
            self._advance(group, commands[group.slots])
        ended = np.zeros(self.num_envs, dtype=bool)
        for group in going_on:
            ended[group.slots] = group.age == self.episode_frames
        success = np.array([episode.success for episode in self._episodes])
        success[restarted] = False
        self._together, self._done = going_on, ended | success
        if restarted:
            self._begin(restarted, [None] * self.num_envs)
        infos = [self._info(slot) for slot in range(self.num_envs)]
        observation = self._observation()
        finished = np.flatnonzero(self._done).tolist()
        if self._autoreset == AutoresetMode.SAME_STEP and finished:
            last = [{"final_obs": self._observed(slot), "final_info": infos[slot]} for slot in finished]
            self._begin(finished, [None] * self.num_envs)
            for slot, final in zip(finished, last, strict=True):
                infos[slot] = self._info(slot) | final
            observation = self._observation()
        return observation, success.astype(np.float64), success, ended & ~success, self._infos(infos)

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

    def _begun(self, starts: Sequence[Start], seeds: Sequence[int]) -> Simulation:
        return self.world.start(
            [start.images for start in starts],
            [start.cameras for start in starts],
            embodiment=self.kinematics,
            state=np.stack([start.state for start in starts]),
            seed=seeds,
            limits=self._limits,
        )

    def _begin(self, slots: Sequence[int], seeds: Sequence[int | None]) -> None:
        chosen: list[int] = []
        for slot in slots:
            given = seeds[slot]
            if given is not None:
                self._random[slot] = np.random.default_rng(given)
            chosen.append(int(self._random[slot].integers(2**31)) if given is None else int(given))
        starts = [self.starts[number % len(self.starts)] for number in chosen]
        simulation = self._begun(starts, chosen)
        others = [rest for group in self._together if (rest := group.without(slots)) is not None]
        self._together = [*others, Together(simulation, list(slots))]
        episodes = dict(enumerate(self._episodes))
        for index, slot in enumerate(slots):
            picture = simulation.pictures[index]
            video = {view: [frame[None]] for view, frame in picture.items()}
            points = [simulated_points(simulation, index)]
            tracks = [simulation.tracks[index]]
            episodes[slot] = RunningEpisode(starts[index], video, points, picture, simulation.state[index], tracks)
            self._done[slot] = False
        if len(episodes) < self.num_envs:
            raise DataError("Some episodes were never begun", next_step="reset all of them first")
        self._episodes = [episodes[slot] for slot in range(self.num_envs)]

    def _advance(self, group: Together, commands: np.ndarray) -> None:
        """Take one command for each episode of a group; predict and judge when it is time."""
        for slot, state in zip(group.slots, group.take(commands)[1], strict=True):
            self._episodes[slot].state = state
        count, last = len(group.commands), group.age == self.episode_frames
        full = count == self.frames_per_step
        if not (full or last or count % self.observe_every == 0):
            return
        simulation, clips = group.predict()
        for index, slot in enumerate(group.slots):
            episode = self._episodes[slot]
            episode.picture = {view: video[-1] for view, video in clips[index].items()}
            if full or last:
                for view, video in clips[index].items():
                    episode.video[view].append(video)
                episode.points.append(simulated_points(simulation, index)[:count])
                episode.tracks.append(simulation.tracks[index].clip(range(count)))
            if self._succeeds is not None and (last or (full and self._stop_at_success)):
                found = self._succeeds(episode.trajectory(self.world.contract.fps))
                if not isinstance(found, bool | np.bool_ | None):
                    raise DataError("Not a judgement", where="success", expected="True, False or None", got=found)
                episode.success = bool(found)
                if isinstance(self._succeeds, TrustedJudge):
                    episode.trust = self._succeeds.assess(episode.tracks)

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
        return {
            "is_success": episode.success,
            "episode_id": episode.start.episode_id,
            "task": episode.start.instruction,
            **episode.trust,
        }

    def _infos(self, infos: Sequence[dict[str, Any]]) -> dict[str, Any]:
        gathered: dict[str, Any] = {}
        for slot, info in enumerate(infos):
            gathered = self._add_info(gathered, info, slot)
        return gathered


class WorldLineEnv(gymnasium.Env[dict[str, Any], np.ndarray]):
    """One episode at a time; arguments as of :class:`WorldLineVectorEnv`."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 8}  # noqa: RUF012

    def __init__(self, render_mode: Literal["rgb_array"] | None = None, **options: Any) -> None:
        self.vector = WorldLineVectorEnv(1, render_mode=render_mode, autoreset_mode=AutoresetMode.DISABLED, **options)
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
