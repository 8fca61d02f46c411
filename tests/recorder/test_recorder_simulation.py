"""Physics, labels and kinematics of the recorder; no pictures needed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco", reason="the recorder needs MuJoCo (extra: sim)")

from tools.kinematics_export import embodiment_yaml, kinematics_xml
from worldline_core.recorder.bodies import BODIES
from worldline_core.recorder.controllers import Waypoint, sample_waypoints
from worldline_core.recorder.looks import SCENES
from worldline_core.recorder.scene import SceneModel, build_scene, sample_layout
from worldline_core.recorder.simulate import EpisodeRecorder

EMBODIMENTS = Path(__file__).resolve().parents[2] / "configs" / "embodiments"


@pytest.fixture(scope="module", params=sorted(BODIES))
def scene(request: pytest.FixtureRequest) -> SceneModel:
    return build_scene(BODIES[request.param])


def test_committed_descriptions_are_what_the_recorder_writes(scene: SceneModel) -> None:
    name = scene.robot.name
    assert (EMBODIMENTS / f"{name}.xml").read_text() == kinematics_xml(scene)
    assert (EMBODIMENTS / f"{name}.yaml").read_text() == embodiment_yaml(scene)


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
