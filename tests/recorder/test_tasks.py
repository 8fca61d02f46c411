"""Tasks, their outcomes and where cameras stand; pictures only in the last test."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from pydantic import ValidationError

mujoco = pytest.importorskip("mujoco", reason="the recorder needs MuJoCo (extra: sim)")

from worldline_core.errors import DataError
from worldline_core.recorder.attempts import BankSpec, RecordBanksConfig
from worldline_core.recorder.bodies import BODIES
from worldline_core.recorder.looks import SCENES
from worldline_core.recorder.outcomes import LIFTED, outcome
from worldline_core.recorder.record import RecordGroup
from worldline_core.recorder.scene import (
    BUTTON_TRAVEL,
    DRAWER_TRAVEL,
    KINDS,
    TASKS,
    Layout,
    apply_layout,
    sample_layout,
)
from worldline_core.recorder.simulate import EpisodeRecorder


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
    for number in range(15):
        random = np.random.default_rng([3, number])
        assert recorder.move(layout_of(recorder, tasks[number % len(tasks)], random), random, 33) is not None


def test_outcomes_are_read_from_the_things(recorder: EpisodeRecorder) -> None:
    random = np.random.default_rng(0)
    layouts = {task: layout_of(recorder, task, random) for task in TASKS}
    lift, place, close, press, carry = (layouts[task] for task in TASKS)

    qpos = still(recorder, lift)
    assert judged(recorder, lift, qpos) == ("failure", "missed")
    qpos[4:, joint_of(recorder, f"{lift.target.kind}_0") + 2] += LIFTED + 0.01
    assert judged(recorder, lift, qpos) == ("success", "")

    qpos = still(recorder, place)
    assert judged(recorder, place, qpos) == ("failure", "missed")
    address = joint_of(recorder, f"{place.target.kind}_0")
    qpos[-1, address : address + 2] = place.goal.xy
    assert judged(recorder, place, qpos) == ("success", "")

    qpos = still(recorder, close)
    assert judged(recorder, close, qpos) == ("failure", "missed")
    qpos[-1, joint_of(recorder, "drawer_0")] = 0.5 * DRAWER_TRAVEL
    assert judged(recorder, close, qpos) == ("failure", "incomplete")
    qpos[-1, joint_of(recorder, "drawer_0")] = 0.1 * DRAWER_TRAVEL
    assert judged(recorder, close, qpos) == ("success", "")

    qpos = still(recorder, press)
    assert judged(recorder, press, qpos) == ("failure", "missed")
    qpos[-1, joint_of(recorder, "button_1")] = BUTTON_TRAVEL
    assert judged(recorder, press, qpos) == ("failure", "wrong place")
    qpos[-1, joint_of(recorder, "button_0")] = BUTTON_TRAVEL
    assert judged(recorder, press, qpos) == ("success", "")

    qpos = still(recorder, carry)
    assert judged(recorder, carry, qpos) == ("failure", "missed")
    address = joint_of(recorder, "tray_0")
    qpos[4:, address + 2] += LIFTED + 0.01
    assert judged(recorder, carry, qpos) == ("success", "")
    # One end on the table, the other raised.
    qpos[4:, address + 3 : address + 7] = [np.cos(0.3), np.sin(0.3), 0.0, 0.0]
    assert judged(recorder, carry, qpos)[0] == "failure"


def test_layouts_name_what_is_there_and_keep_things_apart(recorder: EpisodeRecorder) -> None:
    random = np.random.default_rng(2)
    distractors = 0
    for number in range(60):
        layout = layout_of(recorder, TASKS[number % 5], random)
        names = [name for name, _ in layout.named()]
        assert len(set(names)) == len(names)
        assert max(Counter(name.split("_")[0] for name in names).values()) <= max(KINDS.values())
        assert f"{layout.target.colour} {layout.target.kind}" in layout.instruction
        things = [thing for _, thing in layout.named()]
        assert len({thing.colour for thing in things}) == len(things)
        for thing in layout.others:
            distractors += 1
            assert np.linalg.norm(thing.xy - layout.target.xy) > 0.1
    assert distractors > 20


def test_a_bank_mixes_successes_and_failures_of_one_initial_state(recorder: EpisodeRecorder) -> None:
    spec = BankSpec(name="b", embodiment="ur5e_slate", family="carry", scene="scene_12", layout=3)
    layout, motions = RecordBanksConfig(banks=(spec,), candidates=8).draw(recorder, spec)
    assert layout.family == "carry"
    assert list(motions) == [f"{candidate:03d}" for candidate in range(8)]
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
