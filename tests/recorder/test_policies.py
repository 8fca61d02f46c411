"""Drawn looks and shifts, misses of any size, and policies that are compared from the same starts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

mujoco = pytest.importorskip("mujoco", reason="the recorder needs MuJoCo (extra: sim)")

from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import DataError
from worldline_core.recorder.attempts import BankGrid, RecordPoliciesConfig, record_policies
from worldline_core.recorder.controllers import MISSES, Miss, ScriptedPolicy, miss_of, plan_waypoints
from worldline_core.recorder.looks import RANGES, SCENES, UNSEEN, look_of, scenes, texture, trains
from worldline_core.recorder.record import RecordConfig, RecordGroup, Variety, plan_jobs, record
from worldline_core.recorder.scene import sample_layout
from worldline_core.recorder.simulate import EpisodeRecorder


@pytest.mark.parametrize("name", sorted(RANGES))
def test_a_look_is_a_function_of_its_name(name: str) -> None:
    looks = [look_of(f"{name}_{number:04d}") for number in range(20)]
    again = RANGES[name].draw(np.random.default_rng((7100, sorted(RANGES, reverse=True).index(name), 3)))
    assert again == looks[3]
    assert len({look.table for look in looks}) == 20
    low, high = RANGES[name].size
    assert all(low <= look.size <= high for look in looks)


def test_training_and_test_scenes_are_apart() -> None:
    for look in ("plain", "wide"):
        training, test = scenes(look, True), scenes(look, False)
        assert not set(training) & set(test)
        assert all(map(trains, training)) and not any(map(trains, test))
    with pytest.raises(DataError, match="not for training"):
        scenes("unseen", True)
    with pytest.raises(ValidationError, match="unseen looks are for tests"):
        RecordGroup(embodiment="viperx_pearl", count=1, look="unseen")
    for name in ("scene_16", "wide_1", "unseen_00000", "wide_0001\n"):
        with pytest.raises(DataError, match="Unknown scene"):
            look_of(name)
    assert all(texture(name).shape == (128, 128, 3) for name in UNSEEN.textures if name)


@pytest.fixture(scope="module")
def recorder() -> EpisodeRecorder:
    return EpisodeRecorder("xarm7_white")


@pytest.fixture(scope="module")
def ur5e() -> EpisodeRecorder:
    return EpisodeRecorder("ur5e_silver")


# Where the outcome turns lies between the two sizes.
@pytest.mark.parametrize(
    ("family", "kind", "hit", "miss"),
    [
        ("lift", "beside", 0.005, 0.095),
        ("lift", "low", 0.11, 0.05),
        ("place", "release_off", 0.01, 0.11),
        ("close", "left_open", 0.12, 0.6),
        ("press", "short", 0.004, 0.07),
        ("carry", "beside", 0.005, 0.09),
    ],
)
def test_the_size_of_a_miss_decides(recorder: EpisodeRecorder, family: str, kind: str, hit: float, miss: float) -> None:
    assert hit < MISSES[family][kind] and miss < MISSES[family][kind]
    for size, outcome in ((hit, "success"), (miss, "failure")):
        random = np.random.default_rng(1)
        layout = sample_layout(recorder.scene.robot, family, random, look_of("wide_8001"))
        policy = ScriptedPolicy(miss=Miss.model_validate({"kind": kind, "size": size}))
        motion = recorder.move(layout, random, 33, policy)
        assert motion is not None and motion.outcome == outcome, size


def test_misses_are_drawn_evenly_and_apart_from_everything_else() -> None:
    group = RecordGroup(embodiment="viperx_pearl", count=200, look="wide")
    jobs = plan_jobs(RecordConfig(groups=(group,), misses=0.5))
    missing = [job.policy.miss for job in jobs if job.policy and job.policy.miss]
    assert 70 < len(missing) < 130
    assert {miss.kind for miss in missing} == {kind for kinds in MISSES.values() for kind in kinds}
    assert miss_of(1.0, "lift", (1, 2)) == miss_of(0.5, "lift", (1, 2)) or miss_of(0.5, "lift", (1, 2)) is None
    plain = plan_jobs(RecordConfig(groups=(group,)))
    assert [job.entropy for job in jobs] == [job.entropy for job in plain]
    assert all(job.policy is None for job in plain)


def test_groups_have_their_own_length() -> None:
    group = RecordGroup(embodiment="viperx_pearl", count=2)
    jobs = plan_jobs(RecordConfig(groups=(group, group.model_copy(update={"num_frames": 65}))))
    assert sorted(job.num_frames for job in jobs) == [33, 33, 65, 65]


@pytest.mark.slow
def test_shifts_are_named_in_the_index(rendering: None, tmp_path: Path) -> None:
    groups = {
        "xarm7_white": {"look": "unseen", "held_out_camera": True}, "panda_ivory": {"look": "wide"},
        "viperx_pearl": {"look": "wide"}, "viperx_graphite": {"held_out_camera": True},
    }  # fmt: skip
    planned = [{"embodiment": name, **group, "split": "ood_test", "count": 1} for name, group in groups.items()]
    record(RecordConfig.model_validate({"groups": planned, "num_frames": 17, "misses": 1.0}), tmp_path)
    episodes = EpisodeSet.open(tmp_path)
    shifts = {row.embodiment: episodes.episode(i).conventions.get("shift") for i, row in enumerate(episodes.rows)}
    assert shifts == {**dict.fromkeys(groups), "xarm7_white": "look+camera", "panda_ivory": "body"}
    assert (tmp_path / "misses.json").read_text().count('"size"') == 4


POLICIES = {
    "expert": ScriptedPolicy(),
    "blind": ScriptedPolicy(bias_m=(0.0, 0.12)),
    "late": ScriptedPolicy(delay_frames=6),
}
GRID = BankGrid(embodiments=("ur5e_silver",), families=("press",), scenes=("scene_12",), count=1)
CONFIG = RecordPoliciesConfig(policies=POLICIES, starts=GRID, seed=3, num_frames=33, workers=1)


def test_every_policy_tries_the_same_start(ur5e):
    (start,) = GRID.specs()
    layout, motions = CONFIG.draw(ur5e, start)
    again, same = CONFIG.draw(ur5e, start)
    assert layout.target == again.target
    assert list(motions) == list(POLICIES)
    for name, motion in motions.items():
        np.testing.assert_array_equal(motion.action, same[name].action)
        np.testing.assert_allclose(motion.state[0], motions["expert"].state[0], atol=1e-6)
    assert motions["expert"].outcome == "success"
    assert motions["blind"].outcome == "failure"


def test_a_late_policy_does_the_same_later_and_a_late_gripper_alone(ur5e):
    layout = sample_layout(ur5e.scene.robot, "lift", np.random.default_rng(2), SCENES["scene_12"])
    on_time, late, gripper = (
        ur5e.move(layout, np.random.default_rng(9), 33, policy).action
        for policy in (ScriptedPolicy(), ScriptedPolicy(delay_frames=5), ScriptedPolicy(gripper_delay_frames=-3))
    )
    np.testing.assert_array_equal(late[5:], on_time[:-5])
    np.testing.assert_array_equal(late[:5], np.repeat(on_time[:1], 5, axis=0))
    moves = np.array([name.endswith("/gripper") for name in ur5e.scene.state_names])
    np.testing.assert_array_equal(gripper[:, ~moves], on_time[:, ~moves])
    np.testing.assert_array_equal(gripper[:-3, moves], on_time[3:, moves])


def test_mistakes_set_the_share_of_wrong_plans(ur5e):
    layout = sample_layout(ur5e.scene.robot, "press", np.random.default_rng(0), SCENES["scene_12"])

    def aims(mistakes):
        randoms = map(np.random.default_rng, range(60))
        plans = (plan_waypoints(ur5e.scene.robot, layout, random, 4.0, mistakes=mistakes) for random in randoms)
        # A right plan goes down onto the button within some millimetres.
        down = [plan[layout.arm][2].position for plan in plans]
        return np.mean([np.hypot(x - layout.target.x, y - layout.target.y) < 0.03 and z < 0.05 for x, y, z in down])

    assert aims(0.0) == 1.0
    assert aims(1.0) == 0.0
    assert 0.3 < aims(0.5) < 0.7


def test_variety_is_drawn_within_its_limits_and_changes_nothing_else():
    config = RecordConfig(groups=(RecordGroup(embodiment="viperx_pearl", count=200),))
    variety = Variety(share=1, noise_m=0.05, delay_frames=4, gripper_delay_frames=(-3, 2))
    jobs = plan_jobs(config.model_copy(update={"variety": variety}))
    noise, delay, gripper = np.array(
        [(p.noise_m, p.delay_frames, p.gripper_delay_frames) for p in (job.policy for job in jobs)]
    ).T
    assert (noise == 0).mean() == pytest.approx(0.5, abs=0.1)
    assert 0.04 < noise.max() <= 0.05
    assert (set(delay), set(gripper)) == (set(range(5)), set(range(-3, 3)))
    assert [replace(job, policy=None) for job in jobs] == plan_jobs(config)
    half = Variety(share=0.5, noise_m=0.01, delay_frames=0)
    assert 70 < sum(half.draw(np.random.default_rng(number)) is None for number in range(200)) < 130
    with pytest.raises(ValueError, match="earliest <= latest"):
        Variety(share=1, noise_m=0, delay_frames=0, gripper_delay_frames=(3, -3))


@pytest.mark.slow
def test_a_recorded_comparison_of_policies(tmp_path):
    counts = record_policies(CONFIG, tmp_path)
    assert counts["policies"]["expert"] == {"press": {"attempts": 1, "successes": 1}}
    episodes = EpisodeSet.open(tmp_path)
    firsts = {row.source: episodes.frames(i, "head", [0])[0] for i, row in enumerate(episodes.rows)}
    assert {row.bank for row in episodes.rows} == {GRID.specs()[0].name}
    assert firsts.keys() == POLICIES.keys()
    # One start, one first picture; what differs is the encoder's noise.
    assert max(np.abs(picture.astype(int) - firsts["expert"]).mean() for picture in firsts.values()) < 1.0
    assert record_policies(CONFIG, tmp_path) == counts
