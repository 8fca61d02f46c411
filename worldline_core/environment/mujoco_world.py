"""The recorder's MuJoCo world as an environment: what the simulator predicts is here computed by physics.

Starts, observations, actions, limits, rate, length and soft reward are those of ``WorldLineEnv`` with the same recordings, so that a
policy can be tried in both from the same starts (``benchmarks/policies_inside.py``). Pictures are new at every step by default, and
success is read from the simulated things. Recordings do not hold where things stand: each start is drawn again by the configuration in their
manifest. Needs the extras ``sim`` and ``gym``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, get_args

import gymnasium
import numpy as np

from worldline_core.config import validate
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.data.episodes.episode_index import EpisodeRow
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.environment.environment import (
    Reward,
    RobotSpaces,
    RunningEpisode,
    each_start,
    longer,
    shipped_segmenter,
)
from worldline_core.errors import ConfigError, DataError
from worldline_core.evaluation.recordings import Trajectory
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.model.tokenizers import resized_frames
from worldline_core.recorder.attempts import RecordPoliciesConfig
from worldline_core.recorder.record import RecordConfig, plan_jobs
from worldline_core.recorder.rendering import prepare_rendering
from worldline_core.recorder.scene import FRAME_RATE, Layout, apply_layout
from worldline_core.recorder.simulate import (
    EpisodeRecorder,
    ExecutedMotion,
    drive,
    motor_targets,
    outcome,
    place_arms,
    read_state,
)
from worldline_core.rollout.recorded_starts import RecordedStart, RecordedStarts
from worldline_core.rollout.simulation import CommandedRobot
from worldline_core.shipped import shipped_folder
from worldline_core.store.artifact_files import MANIFEST_NAME, read_manifest


class MujocoEnv(gymnasium.Env[dict[str, Any], np.ndarray]):
    """One episode at a time of one robot.

    Args:
        recordings: written by ``worldline record`` (episodes, or policies), whose first frames are the starts; by default the
            shipped ones.
        embodiment, splits, episode_frames, reward, start, frame, flat_observation, normalised_actions, limits: as of
            ``WorldLineVectorEnv``; the soft reward is what the judge sees of MuJoCo's pictures.
        views: that are rendered; by default all.
        image_size: (H, W) of the pictures; the shipped models'.
        observe_every: steps between two pictures; by default 1.

    Raises:
        ConfigError: ``episode_frames`` or ``observe_every`` is not positive, or there is no such reward.
        DataError: the recordings are not the recorder's, none fits, or there is no such start or frame.
        UnavailableError: MuJoCo is not installed.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": FRAME_RATE}  # noqa: RUF012

    def __init__(
        self,
        recordings: Path | str | None = None,
        *,
        embodiment: str | None = None,
        splits: Sequence[str] = ("test",),
        views: Sequence[str] | None = None,
        image_size: tuple[int, int] = (64, 96),
        episode_frames: int = 32,
        observe_every: int | None = None,
        reward: Reward = "success",
        start: str | None = None,
        frame: int = 0,
        flat_observation: bool = False,
        normalised_actions: bool = False,
        limits: bool = True,
        render_mode: Literal["rgb_array"] | None = "rgb_array",
    ) -> None:
        views, observe_every = VIEWS if views is None else views, 1 if observe_every is None else observe_every
        if min(episode_frames, observe_every) < 1 or reward not in get_args(Reward):
            raise ConfigError(
                "Not an environment", expected="episode_frames and observe_every of at least 1; reward: success or soft",
                got=f"episode_frames {episode_frames}, observe_every {observe_every}, reward {reward}",
            )  # fmt: skip
        prepare_rendering()
        folder = Path(recordings or shipped_folder() / "recordings")
        self.starts = RecordedStarts(folder, view_sets=[views], fps=FRAME_RATE, embodiment=embodiment, splits=splits)
        self.views, self.image_size, self.render_mode = tuple(views), image_size, render_mode
        self._max_episode_steps, self._observe_every = episode_frames, observe_every
        self.robot = load_embodiment(self.starts.embodiment)
        self.spaces = RobotSpaces(
            self.robot, self.views, image_size, flat=flat_observation, normalised=normalised_actions
        )
        self.action_space, self.observation_space = self.spaces.action, self.spaces.observation
        self._kinematics, self._limits = ArmKinematics(self.robot), limits
        self._segmenter = shipped_segmenter() if reward == "soft" else None
        self._usual_start = start, frame
        if start is not None:
            self.starts.at(start, frame)  # refuses what is not there before an episode begins
        self._recorder = EpisodeRecorder(self.starts.embodiment)
        self._data = self._recorder.new_data()
        recorder, starts, recipe = self._recorder, self.starts, _recipe(folder)
        # Drawing a start again tries every policy that recorded it. Without `self`: in a reference cycle the renderers
        # would be freed by the garbage collector, on any thread.
        self._drawn = lru_cache(maxsize=1024)(lambda name: recipe(recorder, starts.row(name)))
        self.task = self.task_description = ""
        self._left = 0  # steps of the running episode

    def close(self) -> None:
        """Give the renderers back; software OpenGL needs it."""
        self._recorder.close()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin an episode: at start ``seed`` modulo their number, at a drawn one, or at the one named by the options.

        Raises: DataError where there is no such start, or the drawn start is not the recorded one.
        """
        super().reset(seed=seed)
        number = (int(self.np_random.integers(2**31)) if seed is None else seed) % len(self.starts)
        ((name, frame),) = each_start(options, self._usual_start, 1)
        start = self.starts.at(self.starts.rows[number].episode_id if name is None else name, frame)
        self._layout, first, self._filmed = self._drawn(start.episode_id)
        self.task = self.task_description = start.instruction
        if self._layout.instruction != start.instruction or not np.allclose(first, start.state, atol=1e-4):
            raise _drawn_otherwise(start, f"{start.instruction}, {start.state}", f"{self._layout.instruction}, {first}")
        scene, targets = self._recorder.scene, motor_targets(self._recorder.scene, start.commands)
        apply_layout(scene, self._data, self._layout)
        place_arms(scene, self._data, start.state)
        self._qpos, self._failure = [self._data.qpos.copy()], ""
        for before, after in pairwise(targets):
            drive(scene, self._data, before, after)
            self._qpos.append(self._data.qpos.copy())
        self._target, state = targets[-1], read_state(scene, self._data)
        if not np.allclose(state, recorded := self.starts.robot_state(start), atol=1e-2):
            raise _drawn_otherwise(start, f"the state {recorded}", state)
        self._robot = CommandedRobot(
            self._kinematics, FRAME_RATE, start.state[None], limits=self._limits, earlier=[start.earlier]
        )
        self._left = self._max_episode_steps
        picture = self._film(start, state)
        frames: dict[str, Any] = {view: seen[None] for view, seen in picture.items()}
        video = Trajectory(start.instruction, frames, FRAME_RATE)
        self._episode = RunningEpisode(start, video, picture, state)
        if self._segmenter is not None:
            before = Trajectory(start.instruction, self.starts.before(start, self.image_size), FRAME_RATE)
            self._episode.video = longer(before, frames, None)
            self._episode.look(self._segmenter, self._episode.video)
        return self._observed(), self._info()

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """One command.

        Raises: DataError: it has another shape or is not finite, or the episode has ended or not begun.
        """
        command = self.spaces.commands(action)
        if not self._left:
            raise DataError("The episode has ended or not begun", next_step="call reset first")
        self._left -= 1
        scene, episode, before = self._recorder.scene, self._episode, self._target
        self._robot, executed, _ = self._robot.follow(command[None, None])
        self._target = motor_targets(scene, executed[0].astype(np.float32))[0]
        drive(scene, self._data, before, self._target)
        self._qpos.append(self._data.qpos.copy())
        episode.state = read_state(scene, self._data)
        if not self._left:
            qpos = np.array(self._qpos)
            tool = self._recorder.tool_positions(self._layout.arm, qpos)
            ended, self._failure = outcome(scene, self._data, self._layout, qpos, tool)
            episode.success = ended == "success"
        episode.reward = float(episode.success) if self._segmenter is None else 0.0
        shown = not self._left or (self._max_episode_steps - self._left) % self._observe_every == 0
        if shown or self._segmenter is not None:  # the judge looks at every frame, as it does inside
            picture = self._film(episode.start, episode.state)
            episode.video = longer(episode.video, {view: seen[None] for view, seen in picture.items()}, None)
            episode.picture = picture if shown else episode.picture
        if shown and self._segmenter is not None:
            episode.look(self._segmenter, episode.video)
        return self._observed(), episode.reward, episode.success, not (self._left or episode.success), self._info()

    def render(self) -> np.ndarray | None:
        """Latest picture, its views side by side, ``uint8 (H, views * W, 3)``."""
        return (
            np.concatenate([self._episode.picture[view] for view in self.views], axis=1) if self.render_mode else None
        )

    def target(self) -> np.ndarray:
        """Current position ``(3)`` of the thing that the task moves, or travel ``(1)`` of a drawer or button [m]."""
        address = self._recorder.scene.model.joint(f"{self._layout.target.kind}_0").qposadr[0]
        count = 1 if self._layout.family in ("close", "press") else 3
        return self._qpos[-1][address : address + count].copy()

    def _observed(self) -> dict[str, Any]:
        episode = self._episode
        return self.spaces.observed({view: picture.copy() for view, picture in episode.picture.items()}, episode.state)

    def _film(self, start: RecordedStart, state: np.ndarray) -> dict[str, np.ndarray]:
        now = ExecutedMotion(state[None], state[None], self._data.qpos[None].copy(), "unknown")
        frames = self._recorder.film(
            self._layout, now, episode_id=start.episode_id, split="test", masked=False, **deepcopy(self._filmed)
        ).frames
        return {view: resized_frames(frames[view], self.image_size)[0] for view in self.views}

    def _info(self) -> dict[str, Any]:
        return self._episode.info() | {"failure": self._failure}


def _drawn_otherwise(start: RecordedStart, expected: object, got: object) -> DataError:
    return DataError(
        "A start cannot be drawn again as it was recorded", where=f"episode {start.episode_id}, frame {len(start.earlier)}",
        expected=expected, got=got,
        next_step="record the starts with this version of the project and of MuJoCo",
    )  # fmt: skip


Drawn = tuple[Layout, np.ndarray, dict[str, Any]]


def _recipe(recordings: Path) -> Callable[[EpisodeRecorder, EpisodeRow], Drawn]:
    """Returns a function that draws a recording again: its things, its first command, and how it is filmed."""
    manifest = read_manifest(recordings)
    step, values, where = str(manifest.get("step")), manifest.get("config", {}), recordings / MANIFEST_NAME
    kind = step.removeprefix("record_")
    if step == "record":
        kind, values = next((kind, config) for kind, config in values.items() if config is not None)
    if kind == "policies":
        compared = validate(RecordPoliciesConfig, values, where=where)
        # A manifest sorts by name, and what each policy draws depends on its number.
        numbers = {row.source: row.candidate for row in EpisodeSet.open(recordings).rows}
        policies = {name: compared.policies[name] for name in sorted(numbers, key=lambda name: numbers[name] or 0)}
        compared = compared.model_copy(update={"policies": policies})
        specs = {spec.name: spec for spec in compared.starts.specs()}

        def of_policies(recorder: EpisodeRecorder, row: EpisodeRow) -> Drawn:
            spec = specs[row.bank or ""]
            layout, motions = compared.draw(recorder, spec)
            filmed = {"scene_id": spec.scene, "jitter": compared.camera_draws(spec)}
            return layout, motions[row.source].action[0], filmed

        return of_policies
    if kind == "episodes":
        config = validate(RecordConfig, values, where=where)
        jobs = {job.episode_id: job for job in plan_jobs(config)}

        def of_episodes(recorder: EpisodeRecorder, row: EpisodeRow) -> Drawn:
            job = jobs[row.episode_id]
            layout, motion, scene, random = recorder.draw(job)
            filmed = {"scene_id": scene, "jitter": random, "held_out_camera": job.held_out_camera}
            return layout, motion.action[0], filmed

        return of_episodes
    raise DataError(
        "The manifest does not say where things stood in these recordings", where=where,
        expected="recorded episodes or policies", got=step,
        next_step="record the starts with `worldline record`",
    )  # fmt: skip
