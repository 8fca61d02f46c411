"""Run one episode: waypoints to joint targets at the frame rate, physics in between, state at every frame.

The commanded targets of frame t are executed at t and interpolated linearly up to those of frame t+1, so that the
recorded actions alone reproduce the motion.

Record single episodes: everything follows from (seed, stream, embodiment, split, number).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from worldline_core.data.episodes.episode import Episode
from worldline_core.errors import DataError
from worldline_core.recorder.controllers import Waypoint, plan_waypoints, sample_waypoints
from worldline_core.recorder.inverse_kinematics import InverseKinematics, tool_rotation
from worldline_core.recorder.rendering import SceneRenderer
from worldline_core.recorder.robots import ROBOTS, Robot
from worldline_core.recorder.scene_model import FRAME_RATE, SUBSTEPS, SceneModel, build_scene_model
from worldline_core.recorder.task_layout import (
    SCENES,
    TEST_SCENES,
    TRAIN_SCENES,
    Layout,
    apply_layout,
    outcome,
    sample_layout,
)


@dataclass(frozen=True)
class Motion:
    """What happened: ``state`` and ``action`` (N, J), full positions ``qpos`` (N, nq), and the measured outcome."""

    state: np.ndarray
    action: np.ndarray
    qpos: np.ndarray
    outcome: str


def opening_to_fingers(robot: Robot, opening: np.ndarray) -> np.ndarray:
    """Finger joint positions for an opening 0 (closed) .. 1 (open)."""
    closed, opened = robot.finger_travel
    return closed + np.asarray(opening) * (opened - closed)


def fingers_to_opening(robot: Robot, fingers: np.ndarray) -> np.ndarray:
    """Opening 0..1 (clipped) from finger joints (..., F)."""
    closed, opened = robot.finger_travel
    return np.clip((np.mean(fingers, axis=-1) - closed) / (opened - closed), 0.0, 1.0)


def plan_actions(
    scene: SceneModel, solver: InverseKinematics, plans: list[list[Waypoint]], num_frames: int
) -> tuple[np.ndarray, float]:
    """Joint targets and openings (N, J) of all arms, and the largest position error of the solver [m]."""
    times = np.arange(num_frames) / FRAME_RATE
    columns, worst = [], 0.0
    for arm, points in enumerate(plans):
        positions, yaws, pitches, openings = sample_waypoints(points, times)
        joints = np.asarray(scene.robot.arms[arm].home, dtype=np.float64)
        targets = []
        for frame in range(num_frames):
            rotation = tool_rotation(yaws[frame], pitches[frame])
            joints, error = solver.solve(arm, joints, positions[frame], rotation, 300 if frame == 0 else 80)
            worst = max(worst, error)
            targets.append(joints)
        columns += [np.array(targets), openings[:, None]]
    return np.concatenate(columns, axis=1).astype(np.float32), worst


def execute(scene: SceneModel, data: Any, layout: Layout, action: np.ndarray) -> Motion:
    """Drive the simulator with the recorded actions (N, J) from the layout's initial state."""
    import mujoco

    model, robot = scene.model, scene.robot
    apply_layout(scene, data, layout)
    # Actions are stored as float32; the simulator is driven by exactly what is stored.
    control = np.zeros((len(action), model.nu))
    column = 0
    for arm in range(len(robot.arms)):
        count = len(scene.joint_qpos[arm])
        joints = action[:, column : column + count].astype(np.float64)
        fingers = opening_to_fingers(robot, action[:, column + count].astype(np.float64))
        control[:, scene.arm_actuators[arm]] = joints
        control[:, scene.finger_actuators[arm]] = fingers[:, None]
        data.qpos[scene.joint_qpos[arm]] = joints[0]
        data.qpos[scene.finger_qpos[arm]] = fingers[0]
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
    return Motion(np.array(states, dtype=np.float32), action, np.array(snapshots), outcome(scene, data, layout))


def read_state(scene: SceneModel, data: Any) -> np.ndarray:
    """(J,) joint positions then opening, arm after arm."""
    parts: list[np.ndarray] = []
    for arm in range(len(scene.robot.arms)):
        parts.append(data.qpos[scene.joint_qpos[arm]])
        parts.append(np.atleast_1d(fingers_to_opening(scene.robot, data.qpos[scene.finger_qpos[arm]])))
    return np.concatenate(parts)


# Largest accepted distance between a planned tool position and what the arm can reach.
REACH_TOLERANCE_M = 0.012


@dataclass(frozen=True)
class Recording:
    """An episode with its frames ``(N, H, W, 3)`` and exact robot masks ``(N, h, w)`` by view."""

    episode: Episode
    frames: dict[str, np.ndarray]
    robot_masks: dict[str, np.ndarray]


def state_names(scene: SceneModel) -> tuple[str, ...]:
    """Names of the state columns: ``<arm>/<joint>`` then ``<arm>/gripper``, arm after arm."""
    names: list[str] = []
    for arm, addresses in zip(scene.robot.arms, scene.joint_qpos, strict=True):
        by_address = {int(scene.model.joint(j).qposadr[0]): scene.model.joint(j).name for j in range(scene.model.njnt)}
        names += [by_address[int(a)] for a in addresses] + [f"{arm.name}/gripper"]
    return tuple(names)


class EpisodeRecorder:
    """Records episodes of one embodiment; holds the compiled model and its renderers."""

    def __init__(self, embodiment: str) -> None:
        import mujoco

        if embodiment not in ROBOTS:
            raise DataError("Unknown embodiment", expected=" | ".join(sorted(ROBOTS)), got=embodiment)
        self.scene = build_scene_model(ROBOTS[embodiment])
        self._solver = InverseKinematics(self.scene)
        self._data: Any = mujoco.MjData(self.scene.model)
        self._renderer: SceneRenderer | None = None

    def close(self) -> None:
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def layout(self, family: str, random: np.random.Generator) -> Layout:
        return sample_layout(self.scene.robot, family, random)

    def move(self, layout: Layout, random: np.random.Generator, num_frames: int) -> Motion | None:
        """Plan and execute; None when the plan leaves what the arms can reach."""
        duration = (num_frames - 1) / FRAME_RATE
        plans = plan_waypoints(self.scene.robot, layout, random, duration)
        action, worst = plan_actions(self.scene, self._solver, plans, num_frames)
        if worst > REACH_TOLERANCE_M:
            return None
        return execute(self.scene, self._data, layout, action)

    def replay(self, layout: Layout, action: np.ndarray) -> Motion:
        """Execute recorded actions (N, J) from the layout's initial state."""
        return execute(self.scene, self._data, layout, action)

    def film(
        self,
        layout: Layout,
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
        # A replay in between may have recoloured objects: the layout decides what they look like.
        self.replay(layout, motion.action[:1])
        self._renderer.set_scene(SCENES[scene_id], jitter)
        frames, masks, cameras = self._renderer.render(motion.qpos)
        episode = Episode(
            episode_id=episode_id,
            source="worldline_recorder",
            embodiment=self.scene.robot.name,
            scene=scene_id,
            # Free motion has no task.
            task_family="unknown" if layout.family == "play" else layout.family,
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
            state_names=state_names(self.scene),
        )
        return Recording(episode, frames, masks)

    def record(
        self, *, episode_id: str, split: str, family: str, entropy: tuple[int, ...], num_frames: int
    ) -> Recording:
        """Draw, execute and film one episode; the same ``entropy`` gives the same episode.

        Raises: DataError when no reachable plan is found in 50 draws.
        """
        random = np.random.default_rng(entropy)
        scenes = TRAIN_SCENES if split in ("train", "validation") else TEST_SCENES
        scene_id = str(random.choice(scenes))
        for _ in range(50):
            layout = self.layout(family, random)
            motion = self.move(layout, random, num_frames)
            if motion is not None:
                return self.film(layout, motion, episode_id=episode_id, scene_id=scene_id, split=split, jitter=random)
        raise DataError("No reachable plan found", where=f"episode {episode_id}", next_step="check the robot's reach")
