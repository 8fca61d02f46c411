"""The small world: tasks whose outcomes a model of 64 x 96 pixels can see and foresee.

Things are large and seen from near, plans that go wrong go wrong by a hand's width, grippers take more than half a
second, and how it ended shows in the last quarter (``docs/recorded_worlds.md``).
"""

from __future__ import annotations

from typing import Any, Literal

import cv2
import numpy as np

from worldline_core.errors import DataError
from worldline_core.recorder.controllers import Waypoint
from worldline_core.recorder.rendering import SCENES, TRAIN_SCENES, SceneRenderer
from worldline_core.recorder.simulate import WorldRecorder
from worldline_core.recorder.small_bodies import BODIES, CENTRE
from worldline_core.recorder.small_controllers import plan_small_waypoints
from worldline_core.recorder.small_things import (
    SmallLayout,
    apply_small_layout,
    build_small_scene,
    light_buttons,
    sample_small_layout,
    small_outcome,
    thing_labels,
)

Cameras = Literal["training", "held_out"]
# Where head cameras stand, across the table, so that arms do not hide what they work on: how far aside from facing the
# robot [deg], elevation [deg], distance to the workspace [m].
HEAD_CAMERAS: dict[Cameras, tuple[tuple[float, float], tuple[float, float], tuple[float, float]]] = {
    "training": ((-25.0, 25.0), (50.0, 64.0), (0.80, 0.92)),
    "held_out": ((40.0, 55.0), (38.0, 45.0), (0.80, 0.92)),
}


# Share of the training episodes in which a body's links have drawn colours instead of its own.
REPAINTED = 0.4


class SmallWorldRecorder(WorldRecorder[SmallLayout]):
    """Five tasks with large things, seen from near; ``cameras`` says where head cameras may stand."""

    def __init__(self, body: str, cameras: Cameras = "training") -> None:
        import mujoco

        if body not in BODIES:
            raise DataError("Unknown body of the small world", expected=" | ".join(sorted(BODIES)), got=body)
        super().__init__(build_small_scene(BODIES[body]))
        self.cameras: Cameras = cameras
        self._kinematics: Any = mujoco.MjData(self.scene.model)
        self._own_colours = self.scene.model.geom_rgba[self.scene.robot_geoms].copy()

    def layout(self, family: str, random: np.random.Generator) -> SmallLayout:
        return sample_small_layout(self.scene.robot, family, random)

    def plan(self, layout: SmallLayout, random: np.random.Generator, duration: float) -> list[list[Waypoint]]:
        return plan_small_waypoints(self.scene.robot, layout, random, duration)

    def apply(self, layout: SmallLayout) -> None:
        apply_small_layout(self.scene, self._data, layout)

    def judge(self, layout: SmallLayout, qpos: np.ndarray) -> tuple[str, str]:
        return small_outcome(self.scene, self._data, layout, qpos, self._tool_positions(layout.arm, qpos))

    def _tool_positions(self, arm: int, qpos: np.ndarray) -> np.ndarray:
        """(N, 3) of an arm's tool."""
        import mujoco

        model, data, site = self.scene.model, self._kinematics, self.scene.arms[arm].tool_site
        positions = []
        for positions_of_frame in qpos:
            data.qpos[:] = positions_of_frame
            mujoco.mj_kinematics(model, data)
            positions.append(data.site_xpos[site].copy())
        return np.array(positions)

    def paint(self, layout: SmallLayout, qpos: np.ndarray) -> None:
        light_buttons(self.scene, layout, qpos)

    def labels(self, layout: SmallLayout) -> np.ndarray:
        return thing_labels(self.scene, layout)

    def set_scene(
        self, renderer: SceneRenderer, layout: SmallLayout, scene_id: str, jitter: np.random.Generator
    ) -> None:
        azimuth, elevation, distance = (jitter.uniform(*limits) for limits in HEAD_CAMERAS[self.cameras])
        turn, rise = np.deg2rad(azimuth * jitter.choice([-1.0, 1.0])), np.deg2rad(elevation)
        target = np.array(CENTRE) + jitter.normal(0, 0.01, 3)
        back = np.array([np.cos(turn) * np.cos(rise), np.sin(turn) * np.cos(rise), np.sin(rise)])
        renderer.set_look(SCENES[scene_id])
        self._paint_body(jitter, repaint=scene_id in TRAIN_SCENES and jitter.uniform() < REPAINTED)
        renderer.place_cameras(target + distance * back, target)

    def _paint_body(self, random: np.random.Generator, repaint: bool) -> None:
        """Give each link its own colour, or, link by link of one colour, another weakly saturated one."""
        colours = self._own_colours.copy()
        if repaint:
            for colour in np.unique(self._own_colours, axis=0):
                if colour[3] > 0:
                    hue, saturation, value = random.uniform(0, 360), random.uniform(0, 0.22), random.uniform(0.12, 0.9)
                    drawn = cv2.cvtColor(np.array([[[hue, saturation, value]]], np.float32), cv2.COLOR_HSV2RGB)[0, 0]
                    colours[(self._own_colours == colour).all(axis=1), :3] = drawn
        self.scene.model.geom_rgba[self.scene.robot_geoms] = colours
