from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mujoco")

from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.recorder.attempts import BankGrid, RecordPoliciesConfig, record_policies
from worldline_core.recorder.controllers import ScriptedPolicy, plan_waypoints
from worldline_core.recorder.looks import SCENES
from worldline_core.recorder.record import RecordConfig, RecordGroup, Variety, plan_jobs
from worldline_core.recorder.scene import sample_layout
from worldline_core.recorder.simulate import EpisodeRecorder

POLICIES = {
    "expert": ScriptedPolicy(),
    "blind": ScriptedPolicy(bias_m=(0.0, 0.12)),
    "late": ScriptedPolicy(delay_frames=6),
}
GRID = BankGrid(embodiments=("ur5e_silver",), families=("press",), scenes=("scene_12",), count=1)
CONFIG = RecordPoliciesConfig(policies=POLICIES, starts=GRID, seed=3, num_frames=33, workers=1)


@pytest.fixture(scope="module")
def recorder():
    with_body = EpisodeRecorder("ur5e_silver")
    yield with_body
    with_body.close()


def test_every_policy_tries_the_same_start(recorder):
    (start,) = GRID.specs()
    layout, motions = CONFIG.draw(recorder, start)
    again, same = CONFIG.draw(recorder, start)
    assert layout.target == again.target
    assert list(motions) == list(POLICIES)
    for name, motion in motions.items():
        np.testing.assert_array_equal(motion.action, same[name].action)
        np.testing.assert_allclose(motion.state[0], motions["expert"].state[0], atol=1e-6)
    assert motions["expert"].outcome == "success"
    assert motions["blind"].outcome == "failure"


def test_a_late_policy_does_the_same_later_and_a_late_gripper_alone(recorder):
    layout = sample_layout(recorder.scene.robot, "lift", np.random.default_rng(2), SCENES["scene_12"])
    on_time, late, gripper = (
        recorder.move(layout, np.random.default_rng(9), 33, policy).action
        for policy in (ScriptedPolicy(), ScriptedPolicy(delay_frames=5), ScriptedPolicy(gripper_delay_frames=-3))
    )
    np.testing.assert_array_equal(late[5:], on_time[:-5])
    np.testing.assert_array_equal(late[:5], np.repeat(on_time[:1], 5, axis=0))
    moves = np.array([name.endswith("/gripper") for name in recorder.scene.state_names])
    np.testing.assert_array_equal(gripper[:, ~moves], on_time[:, ~moves])
    np.testing.assert_array_equal(gripper[:-3, moves], on_time[3:, moves])


def test_mistakes_set_the_share_of_wrong_plans(recorder):
    layout = sample_layout(recorder.scene.robot, "press", np.random.default_rng(0), SCENES["scene_12"])

    def aims(mistakes):
        randoms = map(np.random.default_rng, range(60))
        plans = (plan_waypoints(recorder.scene.robot, layout, random, 4.0, mistakes=mistakes) for random in randoms)
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
