"""Physics, labels and kinematics of the recorder; no pictures needed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco", reason="the recorder needs MuJoCo (extra: sim)")

from tools.kinematics_export import embodiment_yaml, kinematics_xml
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.recorder.bodies import BODIES, REACH_X
from worldline_core.recorder.controllers import ArmSolver, Waypoint, plan_waypoints, sample_waypoints, tool_rotation
from worldline_core.recorder.looks import SCENES
from worldline_core.recorder.scene import SceneModel, build_scene, sample_layout
from worldline_core.recorder.simulate import EpisodeRecorder

EMBODIMENTS = Path(__file__).resolve().parents[2] / "configs" / "embodiments"


@pytest.fixture(scope="module", params=sorted(BODIES))
def scene(request: pytest.FixtureRequest) -> SceneModel:
    return build_scene(BODIES[request.param])


def random_joints(scene: SceneModel, random: np.random.Generator) -> list[np.ndarray]:
    return [random.uniform(*arm.limits.T) for arm in scene.arms]


def test_arm_kinematics_of_the_embodiment_equal_mujoco(scene: SceneModel) -> None:
    import torch

    data = mujoco.MjData(scene.model)
    columns: list[float] = []
    for arm, joints in enumerate(random_joints(scene, np.random.default_rng(4))):
        data.qpos[scene.arms[arm].qpos] = joints
        columns += [*joints, 0.5]
    mujoco.mj_kinematics(scene.model, data)
    poses = ArmKinematics(load_embodiment(scene.robot.name)).tool_poses(torch.tensor([columns], dtype=torch.float64))
    for arm, indices in enumerate(scene.arms):
        np.testing.assert_allclose(np.asarray(poses)[0, arm, :3, 3], data.site_xpos[indices.tool_site], atol=1e-6)


def test_committed_descriptions_are_what_the_recorder_writes(scene: SceneModel) -> None:
    name = scene.robot.name
    assert (EMBODIMENTS / f"{name}.xml").read_text() == kinematics_xml(scene)
    assert (EMBODIMENTS / f"{name}.yaml").read_text() == embodiment_yaml(scene)


def test_inverse_kinematics_reaches_the_table(scene: SceneModel) -> None:
    solver = ArmSolver(scene)
    robot = scene.robot
    for arm, placed in enumerate(robot.arms):
        for x in REACH_X:
            for y in robot.reach_y:
                target = np.array([x, robot.side(arm) * y, 0.09])
                _, error = solver.solve(arm, np.array(placed.home), target, tool_rotation(0.2), 300)
                assert error < 0.005


def test_recorded_actions_alone_reproduce_the_motion() -> None:
    recorder = EpisodeRecorder("viperx_graphite")
    layout = sample_layout(recorder.scene.robot, "lift", np.random.default_rng(5), SCENES["scene_12"])
    motion = recorder.move(layout, np.random.default_rng(6), 33)
    other = recorder.move(
        sample_layout(recorder.scene.robot, "place", np.random.default_rng(7), SCENES["scene_12"]),
        np.random.default_rng(8),
        33,
    )
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


def test_candidates_of_a_layout_start_at_the_same_pose() -> None:
    robot = BODIES["viperx_graphite"]
    layout = sample_layout(robot, "place", np.random.default_rng(0), SCENES["scene_12"])
    first = [plan_waypoints(robot, layout, np.random.default_rng(seed), 4.0) for seed in range(6)]
    starts = {tuple((w[0].position, w[0].yaw, w[0].opening) for w in plan) for plan in first}
    assert len(starts) == 1
    assert len({plan[layout.arm][2].position for plan in first}) == 6


def test_waypoints_are_met_in_time_and_at_rest() -> None:
    points = [
        Waypoint(0.0, (0, 0, 0), 0.0, 1.0),
        Waypoint(1.0, (1, 2, 3), 0.5, 0.0),
        Waypoint(2.0, (1, 2, 3), 0.5, 1.0),
    ]
    positions, yaw, opening = sample_waypoints(points, np.array([0.0, 0.5, 1.0, 1.01, 5.0]))
    np.testing.assert_allclose(positions, [[0, 0, 0], [0.5, 1, 1.5], [1, 2, 3], [1, 2, 3], [1, 2, 3]])
    np.testing.assert_allclose(yaw, [0, 0.25, 0.5, 0.5, 0.5])
    np.testing.assert_allclose(opening[[0, 1, 2, 4]], [1.0, 0.5, 0.0, 1.0])
