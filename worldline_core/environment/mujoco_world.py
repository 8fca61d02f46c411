"""The recorder's MuJoCo world as an environment: what the simulator predicts is here computed by physics.

Starts, observations, actions, rate and length are those of ``WorldLineEnv`` with the same recordings, so that a policy can be
tried in both from the same starts (``benchmarks/policies_inside.py``). Pictures are new at every step by default, and
success is read from the simulated things. Recordings do not hold where things stand: each start is drawn again by the configuration in their
manifest. Needs the extras ``sim`` and ``gym``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import gymnasium
import numpy as np

from worldline_core.config import validate
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.data.episodes.episode_index import EpisodeRow
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.environment.environment import checked_commands, robot_spaces
from worldline_core.errors import ConfigError, DataError
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.model.tokenizers import resize_frame
from worldline_core.recorder.attempts import RecordPoliciesConfig
from worldline_core.recorder.outcomes import outcome
from worldline_core.recorder.record import RecordConfig, plan_jobs
from worldline_core.recorder.rendering import prepare_rendering
from worldline_core.recorder.scene import FRAME_RATE, Layout, apply_layout
from worldline_core.recorder.simulate import (
    EpisodeRecorder,
    ExecutedMotion,
    drive,
    motor_targets,
    place_arms,
    read_state,
)
from worldline_core.rollout.recorded_starts import RecordedStarts
from worldline_core.shipped import shipped_folder
from worldline_core.store.artifact_files import MANIFEST_NAME, read_manifest


class MujocoEnv(gymnasium.Env[dict[str, Any], np.ndarray]):
    """One episode at a time of one robot.

    Args:
        recordings: written by ``worldline record`` (episodes, or policies), whose first frames are the starts; by default the
            shipped ones.
        embodiment, splits, views, episode_frames: as of ``WorldLineVectorEnv``.
        image_size: (H, W) of the pictures; the shipped models'.
        observe_every: steps between two pictures.

    Raises:
        ConfigError: ``episode_frames`` or ``observe_every`` is not positive.
        DataError: the recordings are not the recorder's, or none fits.
        UnavailableError: MuJoCo is not installed.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": FRAME_RATE}  # noqa: RUF012

    def __init__(
        self,
        recordings: Path | str | None = None,
        *,
        embodiment: str | None = None,
        splits: Sequence[str] = ("test",),
        views: Sequence[str] = VIEWS,
        image_size: tuple[int, int] = (64, 96),
        episode_frames: int = 32,
        observe_every: int = 1,
        render_mode: Literal["rgb_array"] | None = "rgb_array",
    ) -> None:
        if min(episode_frames, observe_every) < 1:
            raise ConfigError(
                "Not an environment", expected="episode_frames and observe_every of at least 1",
                got=f"episode_frames {episode_frames}, observe_every {observe_every}",
            )  # fmt: skip
        prepare_rendering()
        folder = Path(recordings or shipped_folder() / "recordings")
        self.starts = RecordedStarts(folder, view_sets=[views], fps=FRAME_RATE, embodiment=embodiment, splits=splits)
        self.views, self.image_size, self.render_mode = tuple(views), image_size, render_mode
        self._max_episode_steps, self._observe_every = episode_frames, observe_every
        self.robot = load_embodiment(self.starts.embodiment)
        self.action_space, self.observation_space = robot_spaces(self.robot, self.views, image_size)
        self._recorder = EpisodeRecorder(self.starts.embodiment)
        self._data = self._recorder.new_data()
        self._recipe = _recipe(folder)
        # Drawing a start again tries every policy that recorded it.
        self._drawn = lru_cache(maxsize=1024)(lambda number: self._recipe(self._recorder, self.starts.rows[number]))
        self.task = self.task_description = ""
        self._qpos: list[np.ndarray] = []

    def close(self) -> None:
        """Give the renderers back; software OpenGL needs it."""
        self._recorder.close()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin an episode: at start ``seed`` modulo their number, or at a drawn one.

        Raises: DataError where the drawn start is not the recorded one.
        """
        super().reset(seed=seed)
        number = (int(self.np_random.integers(2**31)) if seed is None else seed) % len(self.starts)
        self._start, (self._layout, self._scene, self._jitter, first) = self.starts[number], self._drawn(number)
        self.task = self.task_description = self._start.instruction
        if self._layout.instruction != self._start.instruction or not np.allclose(first, self._start.state, atol=1e-4):
            raise DataError(
                "A start cannot be drawn again as it was recorded", where=f"episode {self._start.episode_id}",
                expected=f"{self._start.instruction}, {self._start.state}", got=f"{self._layout.instruction}, {first}",
                next_step="record the starts with this version of the project and of MuJoCo",
            )  # fmt: skip
        scene = self._recorder.scene
        apply_layout(scene, self._data, self._layout)
        place_arms(scene, self._data, self._start.state)
        self._target = motor_targets(scene, self._start.state[None])[0]
        self._qpos, self._success, self._failure = [self._data.qpos.copy()], False, ""
        return self._observed(), self._info()

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """One command.

        Raises: DataError: it has another shape or is not finite, or the episode has ended or not begun.
        """
        command = checked_commands(action, self.action_space.shape, self.robot)
        if not 0 < len(self._qpos) <= self._max_episode_steps:
            raise DataError("The episode has ended or not begun", next_step="call reset first")
        scene, before = self._recorder.scene, self._target
        self._target = motor_targets(scene, command[None].astype(np.float32))[0]
        drive(scene, self._data, before, self._target)
        self._qpos.append(self._data.qpos.copy())
        last = len(self._qpos) > self._max_episode_steps
        if last:
            qpos = np.array(self._qpos)
            tool = self._recorder.tool_positions(self._layout.arm, qpos)
            ended, self._failure = outcome(scene, self._data, self._layout, qpos, tool)
            self._success = ended == "success"
        return self._observed(), float(self._success), self._success, last and not self._success, self._info()

    def render(self) -> np.ndarray | None:
        """Latest picture, its views side by side, ``uint8 (H, views * W, 3)``."""
        return np.concatenate([self._pictures[view] for view in self.views], axis=1) if self.render_mode else None

    def target(self) -> np.ndarray:
        """Current position ``(3)`` of the thing that the task moves, or travel ``(1)`` of a drawer or button [m]."""
        address = self._recorder.scene.model.joint(f"{self._layout.target.kind}_0").qposadr[0]
        count = 1 if self._layout.family in ("close", "press") else 3
        return self._qpos[-1][address : address + count].copy()

    def _observed(self) -> dict[str, Any]:
        state = read_state(self._recorder.scene, self._data).astype(np.float32)
        if (len(self._qpos) - 1) % self._observe_every == 0:
            self._film(state)
        return {"pixels": {view: picture.copy() for view, picture in self._pictures.items()}, "agent_pos": state}

    def _film(self, state: np.ndarray) -> None:
        now = ExecutedMotion(state[None], state[None], self._data.qpos[None].copy(), "unknown")
        frames = self._recorder.film(
            self._layout, now, episode_id=self._start.episode_id, scene_id=self._scene, split="test",
            jitter=deepcopy(self._jitter),
        ).frames  # fmt: skip
        self._pictures = {view: np.empty((*self.image_size, 3), np.uint8) for view in self.views}
        for view, picture in self._pictures.items():
            resize_frame(frames[view][0], self.image_size, out=picture)

    def _info(self) -> dict[str, Any]:
        return {
            "is_success": self._success,
            "failure": self._failure,
            "episode_id": self._start.episode_id,
            "task": self.task,
        }


Drawn = tuple[Layout, str, np.random.Generator, np.ndarray]


def _recipe(recordings: Path) -> Callable[[EpisodeRecorder, EpisodeRow], Drawn]:
    """Returns a function that draws a recording again: its things, scene, camera draws and first command."""
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
            return layout, spec.scene, compared.camera_draws(spec), motions[row.source].action[0]

        return of_policies
    if kind == "episodes":
        config = validate(RecordConfig, values, where=where)
        jobs = {job.episode_id: job for job in plan_jobs(config)}

        def of_episodes(recorder: EpisodeRecorder, row: EpisodeRow) -> Drawn:
            job = jobs[row.episode_id]
            recorder.held_out_camera = job.held_out_camera
            layout, motion, scene, random = recorder.draw(job, config.num_frames)
            return layout, scene, random, motion.action[0]

        return of_episodes
    raise DataError(
        "The manifest does not say where things stood in these recordings", where=where,
        expected="recorded episodes or policies", got=step,
        next_step="record the starts with `worldline record`",
    )  # fmt: skip
