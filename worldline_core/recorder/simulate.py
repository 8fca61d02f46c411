"""One episode: plan it, run the physics, film it.

The joint targets of frame t are commanded at t and interpolated linearly up to those of frame t+1, so that the recorded
actions alone reproduce the motion.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from worldline_core.data.episodes.episode import Episode
from worldline_core.errors import DataError
from worldline_core.recorder.controllers import InverseKinematics, Waypoint, plan_actions, plan_waypoints
from worldline_core.recorder.rendering import SCENES, TEST_SCENES, TRAIN_SCENES, SceneRenderer
from worldline_core.recorder.robots import ROBOTS, Robot
from worldline_core.recorder.scene_model import FRAME_RATE, SUBSTEPS, SceneModel, build_scene_model
from worldline_core.recorder.task_layout import Layout, apply_layout, outcome, sample_layout

# Largest accepted distance between a planned tool position and what the arm can reach.
REACH_TOLERANCE_M = 0.012
# What a recorded episode calls a task: free motion has none, and what changes a thing's state is one family.
_TASK_FAMILIES = {"play": "unknown", "close": "state_change", "press": "state_change", "carry": "lift"}


@dataclass(frozen=True)
class Motion:
    """What happened: ``state`` and ``action`` (N, J), full positions ``qpos`` (N, nq), and the measured outcome.

    ``failure`` says what went wrong, where the world tells it.
    """

    state: np.ndarray
    action: np.ndarray
    qpos: np.ndarray
    outcome: str
    failure: str = ""


@dataclass(frozen=True)
class Recording:
    """An episode with its frames ``(N, H, W, 3)`` and exact robot masks ``(N, h, w)`` by view; what went wrong in it.

    ``thing_labels``: uint8 (N, h, w) by view, which thing a pixel shows: 1 what the task moves, 2 where it goes, 3..
    others, 0 none. Empty in worlds that do not label their things.
    """

    episode: Episode
    frames: dict[str, np.ndarray]
    robot_masks: dict[str, np.ndarray]
    failure: str = ""
    thing_labels: dict[str, np.ndarray] = field(default_factory=dict)


def opening_to_fingers(robot: Robot, opening: np.ndarray) -> np.ndarray:
    """Finger joint positions for an opening 0 (closed) .. 1 (open)."""
    closed, opened = robot.finger_travel
    return closed + np.asarray(opening) * (opened - closed)


def fingers_to_opening(robot: Robot, fingers: np.ndarray) -> np.ndarray:
    """Opening 0..1 (clipped) from finger joints (..., F)."""
    closed, opened = robot.finger_travel
    return np.clip((np.mean(fingers, axis=-1) - closed) / (opened - closed), 0.0, 1.0)


def execute(scene: SceneModel, data: Any, action: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Drive the simulator with the recorded actions (N, J); ``data`` holds the things at their places.

    Returns: states (N, J) float32 and full positions (N, nq); ``data`` is left at the last frame.
    """
    import mujoco

    model, robot = scene.model, scene.robot
    # Actions are stored as float32; the simulator is driven by exactly what is stored.
    control = np.zeros((len(action), model.nu))
    column = 0
    for arm in scene.arms:
        count = len(arm.joint_names)
        joints = action[:, column : column + count].astype(np.float64)
        fingers = opening_to_fingers(robot, action[:, column + count].astype(np.float64))
        control[:, arm.actuators] = joints
        control[:, arm.finger_actuators] = fingers[:, None]
        data.qpos[arm.qpos] = joints[0]
        data.qpos[arm.finger_qpos] = fingers[0]
        column += count + 1
    mujoco.mj_forward(model, data)
    states, snapshots = [], []
    for frame in range(len(action)):
        states.append(read_state(scene, data))
        snapshots.append(data.qpos.copy())
        if frame + 1 == len(action):
            break
        for substep in range(SUBSTEPS):
            blend = (substep + 1) / SUBSTEPS
            data.ctrl[:] = (1 - blend) * control[frame] + blend * control[frame + 1]
            mujoco.mj_step(model, data)
    return np.array(states, dtype=np.float32), np.array(snapshots)


def read_state(scene: SceneModel, data: Any) -> np.ndarray:
    """(J,) joint positions then opening, arm after arm."""
    parts: list[np.ndarray] = []
    for arm in scene.arms:
        parts.append(data.qpos[arm.qpos])
        parts.append(np.atleast_1d(fingers_to_opening(scene.robot, data.qpos[arm.finger_qpos])))
    return np.concatenate(parts)


class TaskLayout(Protocol):
    """What every world's layout has."""

    @property
    def family(self) -> str: ...
    @property
    def instruction(self) -> str: ...
    @property
    def arm(self) -> int: ...


class WorldRecorder[L: TaskLayout](ABC):
    """Records episodes of one embodiment in one world; holds the compiled model and its renderers."""

    def __init__(self, scene: SceneModel) -> None:
        import mujoco

        self.scene = scene
        self._solver = InverseKinematics(self.scene)
        self._data: Any = mujoco.MjData(self.scene.model)
        self._renderer: SceneRenderer | None = None

    @abstractmethod
    def layout(self, family: str, random: np.random.Generator) -> L:
        """Draw an initial state and an instruction."""

    @abstractmethod
    def plan(self, layout: L, random: np.random.Generator, duration: float) -> list[list[Waypoint]]:
        """Waypoints per arm for ``duration`` seconds."""

    @abstractmethod
    def apply(self, layout: L) -> None:
        """Put every thing at its place, in its colour."""

    @abstractmethod
    def judge(self, layout: L, qpos: np.ndarray) -> tuple[str, str]:
        """Outcome, and what went wrong, of positions (N, nq); the simulation stands at the last of them."""

    @abstractmethod
    def set_scene(self, renderer: SceneRenderer, layout: L, scene_id: str, jitter: np.random.Generator) -> None:
        """Colours, light and cameras of an episode."""

    @abstractmethod
    def paint(self, layout: L, qpos: np.ndarray) -> None:
        """Change colours that depend on positions (nq,)."""

    def labels(self, layout: L) -> np.ndarray | None:
        """uint8 (number of geoms,): which thing each geom belongs to, as in ``Recording.thing_labels``."""
        return None

    def close(self) -> None:
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def move(self, layout: L, random: np.random.Generator, num_frames: int) -> Motion | None:
        """Plan and execute; None when the plan leaves what the arms can reach."""
        plans = self.plan(layout, random, (num_frames - 1) / FRAME_RATE)
        action, worst = plan_actions(self.scene, self._solver, plans, num_frames)
        if worst > REACH_TOLERANCE_M:
            return None
        return self.replay(layout, action)

    def replay(self, layout: L, action: np.ndarray) -> Motion:
        """Execute recorded actions (N, J) from the layout's initial state."""
        self.apply(layout)
        state, qpos = execute(self.scene, self._data, action)
        return Motion(state, action, qpos, *self.judge(layout, qpos))

    def film(
        self,
        layout: L,
        motion: Motion,
        *,
        episode_id: str,
        scene_id: str,
        split: str,
        jitter: np.random.Generator,
        bank: str | None = None,
        candidate: int | None = None,
    ) -> Recording:
        """Render a motion in a scene and describe it as an episode."""
        if self._renderer is None:
            self._renderer = SceneRenderer(self.scene)
        # Another layout may have been executed since: this one decides where objects stand and what they look like.
        self.apply(layout)
        self.set_scene(self._renderer, layout, scene_id, jitter)
        frames, masks, things, cameras = self._renderer.render(
            motion.qpos, lambda qpos: self.paint(layout, qpos), self.labels(layout)
        )
        episode = Episode(
            episode_id=episode_id,
            source="worldline_recorder",
            embodiment=self.scene.robot.name,
            scene=scene_id,
            task_family=_TASK_FAMILIES.get(layout.family, layout.family),
            instruction=layout.instruction,
            outcome=motion.outcome,
            split=split,
            fps=float(FRAME_RATE),
            state=motion.state,
            action=motion.action,
            timestamps=np.arange(len(motion.state)) / FRAME_RATE,
            cameras=cameras,
            bank=bank,
            candidate=candidate,
            primary_view="head",
            state_names=self.scene.state_names,
        )
        return Recording(episode, frames, masks, motion.failure, things)

    def draw(
        self, *, episode_id: str, split: str, family: str, entropy: tuple[int, ...], num_frames: int
    ) -> tuple[L, Motion, str, np.random.Generator]:
        """Layout, executed motion and scene id of one episode, and the generator that goes on to its cameras.

        Raises: DataError when no reachable plan is found in 50 draws.
        """
        random = np.random.default_rng(entropy)
        scenes = TRAIN_SCENES if split in ("train", "validation") else TEST_SCENES
        scene_id = str(random.choice(scenes))
        for _ in range(50):
            layout = self.layout(family, random)
            motion = self.move(layout, random, num_frames)
            if motion is not None:
                return layout, motion, scene_id, random
        raise DataError("No reachable plan found", where=f"episode {episode_id}", next_step="check the robot's reach")

    def record(
        self, *, episode_id: str, split: str, family: str, entropy: tuple[int, ...], num_frames: int
    ) -> Recording:
        """Draw, execute and film one episode; the same ``entropy`` gives the same episode.

        Raises: DataError when no reachable plan is found in 50 draws.
        """
        layout, motion, scene_id, random = self.draw(
            episode_id=episode_id, split=split, family=family, entropy=entropy, num_frames=num_frames
        )
        return self.film(layout, motion, episode_id=episode_id, scene_id=scene_id, split=split, jitter=random)


class EpisodeRecorder(WorldRecorder[Layout]):
    """The table with a cube, a pad and a drawer."""

    def __init__(self, embodiment: str) -> None:
        if embodiment not in ROBOTS:
            raise DataError("Unknown embodiment", expected=" | ".join(sorted(ROBOTS)), got=embodiment)
        super().__init__(build_scene_model(ROBOTS[embodiment]))

    def layout(self, family: str, random: np.random.Generator) -> Layout:
        return sample_layout(self.scene.robot, family, random)

    def plan(self, layout: Layout, random: np.random.Generator, duration: float) -> list[list[Waypoint]]:
        return plan_waypoints(self.scene.robot, layout, random, duration)

    def apply(self, layout: Layout) -> None:
        apply_layout(self.scene, self._data, layout)

    def judge(self, layout: Layout, qpos: np.ndarray) -> tuple[str, str]:
        return outcome(self.scene, self._data, layout), ""

    def set_scene(self, renderer: SceneRenderer, layout: Layout, scene_id: str, jitter: np.random.Generator) -> None:
        renderer.set_scene(SCENES[scene_id], jitter)

    def paint(self, layout: Layout, qpos: np.ndarray) -> None:
        """Nothing changes its colour here."""
