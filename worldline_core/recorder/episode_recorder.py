"""Record single episodes: everything follows from (seed, stream, embodiment, split, number)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from worldline_core.data.episodes.episode import Episode
from worldline_core.errors import DataError
from worldline_core.recorder.controllers import plan_waypoints
from worldline_core.recorder.inverse_kinematics import InverseKinematics
from worldline_core.recorder.rendering import SceneRenderer
from worldline_core.recorder.robots import ROBOTS
from worldline_core.recorder.scene_model import FRAME_RATE, SceneModel, build_scene_model
from worldline_core.recorder.scenes import SCENES, TEST_SCENES, TRAIN_SCENES
from worldline_core.recorder.simulate import Motion, execute, plan_actions
from worldline_core.recorder.task_layout import Layout, sample_layout

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
