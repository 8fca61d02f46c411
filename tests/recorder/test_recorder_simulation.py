"""Physics, labels and kinematics of the recorder; no pictures needed."""

from __future__ import annotations

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco", reason="the recorder needs MuJoCo (extra: sim)")

from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.embodiment_report import random_states
from worldline_core.geometry.kinematic_tree import read_tree, tool_poses
from worldline_core.recorder.bodies import BODIES
from worldline_core.recorder.controllers import Waypoint, sample_waypoints
from worldline_core.recorder.looks import SCENES
from worldline_core.recorder.rendering import OPENCV_AXES, wrist_camera_pose
from worldline_core.recorder.scene import SceneModel, build_scene, sample_layout
from worldline_core.recorder.simulate import EpisodeRecorder


@pytest.fixture(scope="module", params=sorted(BODIES))
def scene(request: pytest.FixtureRequest) -> SceneModel:
    return build_scene(BODIES[request.param])


def test_committed_descriptions_have_the_poses_of_the_recorder(scene: SceneModel) -> None:
    robot, data = load_embodiment(scene.robot.name), mujoco.MjData(scene.model)
    states = random_states(robot, 5)
    for state, tools in zip(states, tool_poses(robot, read_tree(robot), states), strict=True):
        for arm in robot.arms:
            for joint, value in zip(arm.joints, state[robot.joint_columns(arm)], strict=True):
                data.joint(joint).qpos[0] = value
        mujoco.mj_kinematics(scene.model, data)
        for number, (arm, indices) in enumerate(zip(robot.arms, scene.arms, strict=True)):
            np.testing.assert_allclose(tools[number, :3, 3], data.site_xpos[indices.tool_site], atol=1e-7)
            rotation = data.site_xmat[indices.tool_site].reshape(3, 3)
            np.testing.assert_allclose(tools[number, :3, :3], rotation, atol=1e-7)
            mount, (translation, axes) = np.array(arm.wrist_camera.T_link_camera), wrist_camera_pose(scene, number)
            np.testing.assert_allclose(mount[:3, 3], translation, atol=1e-7)
            np.testing.assert_allclose(mount[:3, :3], axes @ OPENCV_AXES, atol=1e-7)


def test_recorded_actions_alone_reproduce_the_motion() -> None:
    recorder = EpisodeRecorder("viperx_graphite")
    layout, another = (
        sample_layout(recorder.scene.robot, task, np.random.default_rng(seed), SCENES["scene_12"])
        for task, seed in (("lift", 5), ("place", 7))
    )
    motion = recorder.move(layout, np.random.default_rng(6), 33)
    other = recorder.move(another, np.random.default_rng(8), 33)
    again = recorder.replay(layout, motion.action)
    np.testing.assert_array_equal(again.qpos, motion.qpos)
    assert again.outcome == motion.outcome
    assert not np.array_equal(other.qpos, motion.qpos)


def test_a_single_arm_uses_the_whole_table_and_pads_never_touch_what_is_placed() -> None:
    random = np.random.default_rng(2)
    layouts = [sample_layout(BODIES["xarm7_single"], "place", random, SCENES["scene_12"]) for _ in range(60)]
    assert {np.sign(layout.target.y) for layout in layouts} == {-1.0, 1.0}
    for layout in layouts:
        assert np.linalg.norm(layout.target.xy - layout.goal.xy) > 0.1


def test_waypoints_are_met_in_time_and_at_rest() -> None:
    points = [Waypoint(0.0, (0, 0, 0), 0.0, 1.0), *(Waypoint(t, (1, 2, 3), 0.5, t - 1.0) for t in (1.0, 2.0))]
    positions, yaw, opening = sample_waypoints(points, np.array([0.0, 0.5, 1.0, 1.01, 5.0]))
    np.testing.assert_allclose(positions, [[0, 0, 0], [0.5, 1, 1.5], [1, 2, 3], [1, 2, 3], [1, 2, 3]])
    np.testing.assert_allclose(yaw, [0, 0.25, 0.5, 0.5, 0.5])
    np.testing.assert_allclose(opening[[0, 1, 2, 4]], [1.0, 0.5, 0.0, 1.0])
