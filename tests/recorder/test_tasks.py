"""Tasks and contact tasks: their outcomes, who succeeds at them, physics that repeats itself, and kinematics."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from pydantic import ValidationError

mujoco = pytest.importorskip("mujoco", reason="the recorder needs MuJoCo (extra: sim)")

from worldline_core.errors import DataError
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.embodiment_report import random_states
from worldline_core.geometry.kinematic_tree import read_tree, tool_poses
from worldline_core.recorder import scene
from worldline_core.recorder.attempts import SEALED_FILE, BankSpec, RecordBanksConfig, record_banks
from worldline_core.recorder.bodies import BODIES
from worldline_core.recorder.controllers import ScriptedPolicy, Waypoint, sample_waypoints
from worldline_core.recorder.looks import SCENES, look_of
from worldline_core.recorder.record import RecordGroup
from worldline_core.recorder.rendering import OPENCV_AXES, wrist_camera_pose
from worldline_core.recorder.scene import (
    CONTACT,
    LIFTED,
    TASKS,
    Layout,
    apply_layout,
    build_scene,
    sample_layout,
)
from worldline_core.recorder.simulate import EpisodeRecorder, ExecutedMotion, draw_layout, outcome


@pytest.fixture(scope="module")
def recorder() -> EpisodeRecorder:
    return EpisodeRecorder("ur5e_slate")


def layout_of(recorder: EpisodeRecorder, task: str, random: np.random.Generator) -> Layout:
    return sample_layout(recorder.scene.robot, task, random, SCENES["scene_12"])


def judged(recorder: EpisodeRecorder, layout: Layout, qpos: np.ndarray) -> tuple[str, str]:
    return outcome(recorder.scene, recorder._data, layout, qpos, recorder.tool_positions(layout.arm, qpos))


def joint_of(recorder: EpisodeRecorder, name: str) -> int:
    return int(recorder.scene.model.joint(name).qposadr[0])


def still(recorder: EpisodeRecorder, layout: Layout) -> np.ndarray:
    """(8, nq) the layout's initial positions, arms at their start."""
    apply_layout(recorder.scene, recorder._data, layout)
    mujoco.mj_forward(recorder.scene.model, recorder._data)
    return np.repeat(recorder._data.qpos[None].copy(), 8, axis=0)


@pytest.mark.slow
def test_every_task_succeeds_in_about_half_of_the_draws_and_fails_in_several_ways(recorder: EpisodeRecorder) -> None:
    found: dict[str, Counter[str]] = {task: Counter() for task in TASKS}
    for number in range(200):
        random = np.random.default_rng([8, number])
        task = TASKS[number % len(TASKS)]
        motion = recorder.move(layout_of(recorder, task, random), random, 33)
        assert (motion.outcome == "failure") == bool(motion.failure)
        found[task][motion.failure or motion.outcome] += 1
    for task, counts in found.items():
        assert 0.35 <= counts["success"] / 40 <= 0.65, (task, counts)
    assert set().union(*found.values()) >= {"success", "missed", "slipped", "dropped", "wrong place", "incomplete"}


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=[] if n in ("panda_ivory", "xarm7_single") else [pytest.mark.slow]) for n in sorted(BODIES)],
)
def test_bodies_reach_their_workspace(name: str) -> None:
    recorder = EpisodeRecorder(name)
    tasks = [task for task in TASKS if task != "carry" or len(BODIES[name].arms) == 2]
    for number, task in enumerate(tasks):
        random = np.random.default_rng([3, number])
        assert recorder.move(layout_of(recorder, task, random), random, 33) is not None


def test_outcomes_are_read_from_the_things(recorder: EpisodeRecorder) -> None:
    random = np.random.default_rng(0)
    lift, place, close, press, carry = layouts = [layout_of(recorder, task, random) for task in TASKS]

    def ends(layout: Layout, joint: str, columns: slice, *values: float) -> tuple[str, str]:
        """Outcome where the thing of this joint is elsewhere from the fourth frame on."""
        qpos = still(recorder, layout)
        qpos[4:, joint_of(recorder, joint) :][:, columns] = values
        return judged(recorder, layout, qpos)

    def height(layout: Layout, joint: str) -> float:
        return still(recorder, layout)[0, joint_of(recorder, joint) + 2] + LIFTED + 0.01

    for layout in layouts:
        assert judged(recorder, layout, still(recorder, layout)) == ("failure", "missed")
    block, thing = f"{lift.target.kind}_0", f"{place.target.kind}_0"
    assert ends(lift, block, slice(2, 3), height(lift, block)) == ("success", "")
    assert ends(place, thing, slice(2), *place.goal.xy) == ("success", "")
    assert ends(close, "drawer_0", slice(1), 0.5 * scene.DRAWER_TRAVEL) == ("failure", "incomplete")
    assert ends(close, "drawer_0", slice(1), 0.1 * scene.DRAWER_TRAVEL) == ("success", "")
    assert ends(press, "button_1", slice(1), scene.BUTTON_TRAVEL) == ("failure", "wrong place")
    assert ends(press, "button_0", slice(1), scene.BUTTON_TRAVEL) == ("success", "")
    raised = height(carry, "tray_0")
    assert ends(carry, "tray_0", slice(2, 3), raised) == ("success", "")
    # One end on the table, the other raised.
    assert ends(carry, "tray_0", slice(2, 7), raised, np.cos(0.3), np.sin(0.3), 0.0, 0.0)[0] == "failure"


def test_layouts_name_what_is_there_and_keep_things_apart(recorder: EpisodeRecorder) -> None:
    random = np.random.default_rng(2)
    distractors = 0
    for number in range(60):
        layout = layout_of(recorder, TASKS[number % 5], random)
        names = [name for name, _ in layout.named()]
        assert len(set(names)) == len(names)
        assert max(Counter(name.split("_")[0] for name in names).values()) <= max(scene.KINDS.values())
        assert f"{layout.target.colour} {layout.target.kind}" in layout.instruction
        things = [thing for _, thing in layout.named()]
        assert len({thing.colour for thing in things}) == len(things)
        for thing in layout.others:
            distractors += 1
            assert np.linalg.norm(thing.xy - layout.target.xy) > 0.1
    assert distractors > 20


def test_a_bank_mixes_successes_and_failures_of_one_initial_state(recorder: EpisodeRecorder) -> None:
    spec = BankSpec(name="b", embodiment="ur5e_slate", family="carry", scene="scene_12", layout=3)
    layout, motions = RecordBanksConfig(banks=(spec,), candidates=4).draw(recorder, spec)
    assert layout.family == "carry"
    assert list(motions) == [f"{candidate:03d}" for candidate in range(4)]
    assert 0.25 <= np.mean([motion.outcome == "success" for motion in motions.values()]) <= 0.75
    for motion in motions.values():
        np.testing.assert_array_equal(motion.qpos[0], motions["000"].qpos[0])


def test_what_nobody_can_record_is_refused() -> None:
    with pytest.raises(ValidationError, match="Input should be 'lift', 'place', 'close', 'press' or 'carry'"):
        RecordGroup.model_validate({"embodiment": "viperx_pearl", "count": 1, "families": ["play"]})
    with pytest.raises(ValidationError, match="carry needs two arms; xarm7_single has one"):
        RecordGroup(embodiment="xarm7_single", count=1)
    with pytest.raises(DataError, match="Unknown body"):
        EpisodeRecorder("so101")


PLAIN = look_of("scene_12")


@pytest.fixture(
    scope="module",
    params=["ur5e_silver", *(pytest.param(name, marks=pytest.mark.slow) for name in ("viperx_pearl", "xarm7_white"))],
)
def contact(request: pytest.FixtureRequest) -> EpisodeRecorder:
    return EpisodeRecorder(request.param, contact=True)


def moved(contact: EpisodeRecorder, family: str, seed: int, policy: ScriptedPolicy | None) -> ExecutedMotion:
    random = np.random.default_rng((seed, 9))
    return contact.move(draw_layout(contact.scene.robot, family, random, PLAIN), random, 33, policy)  # type: ignore[return-value]


@pytest.mark.parametrize("family", CONTACT)
def test_who_looks_succeeds_and_who_does_not_fails_at_times(contact: EpisodeRecorder, family: str) -> None:
    good = moved(contact, family, 0, ScriptedPolicy())
    assert (good.outcome, good.failure) == ("success", "")
    if contact.scene.robot.name != "ur5e_silver":
        return
    # Who does not fails at times; and physics repeats itself.
    careless: list[ExecutedMotion] = []
    while {motion.outcome for motion in careless} != {"success", "failure"}:
        assert len(careless) < 12
        careless.append(moved(contact, family, len(careless), None))
    assert all((motion.outcome == "failure") == bool(motion.failure) for motion in careless)
    facts = careless[0].facts
    assert facts and np.isfinite(list(facts.values())).all()
    if family == "roll":
        assert moved(contact, family, 0, None).facts == facts


def test_tasks_and_scenes_fit() -> None:
    single = EpisodeRecorder("xarm7_single")
    layout = draw_layout(single.scene.robot, "grip", np.random.default_rng(0), PLAIN)
    with pytest.raises(DataError, match="scene lacks the task's things"):
        single.move(layout, np.random.default_rng(0), 33)
    with pytest.raises(ValidationError, match="level needs two arms; xarm7_single has one"):
        RecordGroup(embodiment="xarm7_single", count=1, families=("level",))


@pytest.mark.slow
def test_facts_are_sealed_with_the_outcomes(rendering: None, tmp_path: Path) -> None:
    spec = BankSpec(name="bank", embodiment="ur5e_silver", family="topple", scene="unseen_0003", layout=1)
    record_banks(RecordBanksConfig(banks=(spec,), candidates=4, num_frames=29, masks=False), tmp_path)
    rows = pq.read_table(tmp_path / SEALED_FILE).to_pylist()
    for row in rows:
        facts = json.loads(row["facts"])
        assert (row["outcome"] == "success") == (facts["lean"] < 0.35 and facts["height"] > 0.07)


@pytest.mark.parametrize("name", sorted(BODIES))
def test_committed_descriptions_have_the_poses_of_the_recorder(name: str) -> None:
    robot, built = load_embodiment(name), build_scene(BODIES[name])
    data = mujoco.MjData(built.model)
    states = random_states(robot, 5)
    for state, tools in zip(states, tool_poses(robot, read_tree(robot), states), strict=True):
        for arm in robot.arms:
            for joint, value in zip(arm.joints, state[robot.joint_columns(arm)], strict=True):
                data.joint(joint).qpos[0] = value
        mujoco.mj_kinematics(built.model, data)
        for number, (arm, indices) in enumerate(zip(robot.arms, built.arms, strict=True)):
            np.testing.assert_allclose(tools[number, :3, 3], data.site_xpos[indices.tool_site], atol=1e-7)
            rotation = data.site_xmat[indices.tool_site].reshape(3, 3)
            np.testing.assert_allclose(tools[number, :3, :3], rotation, atol=1e-7)
            mount, (translation, axes) = np.array(arm.wrist_camera.T_link_camera), wrist_camera_pose(built, number)
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
