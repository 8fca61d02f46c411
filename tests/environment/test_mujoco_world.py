"""MuJoCo's twin of the simulator's environment, and policies compared in both."""

import json
import sys
import warnings
import weakref
from itertools import pairwise

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

pytest.importorskip("mujoco")

from benchmarks import policies_inside
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.environment import MUJOCO_ENVIRONMENT
from worldline_core.environment.environment import WorldLineEnv
from worldline_core.environment.mujoco_world import MujocoEnv
from worldline_core.errors import ConfigError, DataError
from worldline_core.model.tokenizers import resize_frame
from worldline_core.recorder.attempts import BankGrid, RecordingConfig, RecordPoliciesConfig, record_into
from worldline_core.recorder.controllers import ScriptedPolicy
from worldline_core.rollout.recorded_starts import RecordedStarts

ROBOT = "ur5e_silver"
POLICIES = {
    "expert": ScriptedPolicy(),
    "blind": ScriptedPolicy(bias_m=(0.0, 0.12)),
    "late": ScriptedPolicy(delay_frames=28),
}


@pytest.fixture(scope="module")
def physics():
    environment = gymnasium.make(MUJOCO_ENVIRONMENT, embodiment=ROBOT, episode_frames=32).unwrapped
    yield environment
    environment.close()


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """Three policies at two starts."""
    folder = tmp_path_factory.mktemp("policies") / "recordings"
    grid = BankGrid(embodiments=(ROBOT,), families=("press",), scenes=("scene_12", "scene_13"), count=2)
    config = RecordPoliciesConfig(policies=POLICIES, starts=grid, seed=3, num_frames=33, workers=1)
    record_into(RecordingConfig(policies=config), folder, 1)
    return folder


def driven(physics, number, commands):
    """States, whether the episode ended in success, and the last information."""
    observed, info = physics.reset(seed=number)
    states, ended = [observed["agent_pos"]], False
    for index, command in enumerate(commands, start=1):
        observed, reward, ended, truncated, info = physics.step(command)
        states.append(observed["agent_pos"])
        assert (reward == 1.0) == ended == info["is_success"]
        assert (ended or truncated) == (index == len(commands))
    return np.array(states), ended, info


@pytest.mark.slow
def test_recorded_commands_lead_where_they_led(physics, shipped):
    """Every task starts with the recorded picture, goes through the same states and ends the same, twice: a start leaves nothing behind."""
    recordings = EpisodeSet.open(shipped / "recordings")
    for number in [*range(len(physics.starts)), 0]:
        row, start = physics.starts.rows[number], physics.starts[number]
        first = physics.reset(seed=number)[0]["pixels"]
        for view, picture in first.items():
            recorded = np.empty_like(picture)
            resize_frame(start.images[view], picture.shape[:2], out=recorded)
            # What differs is the encoder's noise: another place of the camera would cost ten times as much.
            assert np.abs(recorded.astype(int) - picture).mean() < 2.5
        states, success, info = driven(physics, number, physics.starts.commands(number))
        episode = recordings.episode(recordings.position(row.episode_id))
        np.testing.assert_allclose(states, episode.state, atol=1e-5)
        assert success == (row.outcome == "success")
        assert bool(info["failure"]) == (row.outcome == "failure")
    with pytest.raises(DataError, match="ended or not begun"):
        physics.step(physics.starts.commands(0)[0])


def test_pictures_are_new_at_every_step_unless_told_otherwise(physics, monkeypatch):
    commands = physics.starts.commands(0)
    before, _ = physics.reset(seed=0)
    after = physics.step(commands[8])[0]
    assert any(not np.array_equal(after["pixels"][view], before["pixels"][view]) for view in physics.views)
    np.testing.assert_array_equal(physics.render(), np.concatenate(list(after["pixels"].values()), axis=1))
    monkeypatch.setattr(physics, "_observe_every", 4)
    seen = [physics.reset(seed=0)[0], *(physics.step(command)[0] for command in commands[8:13])]
    changed = [not np.array_equal(a["pixels"]["head"], b["pixels"]["head"]) for a, b in pairwise(seen)]
    assert changed == [False, False, False, True, False]


@pytest.mark.slow
def test_both_worlds_begin_alike_at_any_frame_and_score_alike(physics, world, shipped):
    """In MuJoCo the things have moved as they did when it was recorded; commands are held within the same limits."""
    recordings = EpisodeSet.open(shipped / "recordings")
    name, frame = physics.starts.rows[0].episode_id, 20
    options = {"start": name, "frame": frame, "reward": "soft", "normalised_actions": True, "observe_every": 2}
    twin = MujocoEnv(embodiment=ROBOT, episode_frames=4, **options)
    inside = WorldLineEnv(embodiment=ROBOT, success=None, episode_frames=4, model=world, **options)
    episode = recordings.episode(recordings.position(name))
    begun = [one.reset(seed=5) for one in (twin, inside)]
    np.testing.assert_allclose(begun[0][0]["agent_pos"], episode.state[frame], atol=1e-5)
    np.testing.assert_allclose(begun[1][0]["agent_pos"], episode.action[frame], atol=1e-5)
    for view, picture in begun[0][0]["pixels"].items():
        recorded = np.empty_like(picture)
        resize_frame(recordings.frames(recordings.position(name), view, [frame])[0], picture.shape[:2], out=recorded)
        assert np.abs(recorded.astype(int) - picture).mean() < 2.5
    assert begun[0][1]["score"] == pytest.approx(begun[1][1]["score"], abs=0.1)
    assert begun[0][1]["task_state"].keys() == begun[1][1]["task_state"].keys()
    rewards = []
    for command in episode.action[frame + 1 : frame + 5]:
        _, reward, ended, truncated, info = twin.step(twin.spaces.actions(command))
        rewards.append(reward)
    ended_at = twin._data.qpos[twin._recorder.scene.arms[0].qpos]
    np.testing.assert_allclose(ended_at, episode.state[frame + 4][:6], atol=1e-4)
    assert (rewards[0], rewards[2], ended or truncated) == (0.0, 0.0, True)
    assert sum(rewards) == pytest.approx(info["score"] - begun[0][1]["score"])
    far = np.clip(episode.action[frame] + 2.0, twin.spaces._low, twin.spaces._high)
    for one in (twin, inside):
        one.reset(seed=5)
        one.step(one.spaces.actions(far))
    commanded = inside.spaces.commands(inside.spaces.actions(far))[None, None]
    followed = inside.vector._running[0].simulation.follow(commanded)[0][:, -1]
    np.testing.assert_allclose(twin._robot.command, followed, atol=1e-9)
    for asked, said in (({"frame": 33}, "No such frame"), ({"start": "x"}, "No recording of this name")):
        with pytest.raises(DataError, match=said):
            twin.reset(options=asked)
    with pytest.raises(ConfigError, match="reward sotf"):
        MujocoEnv(embodiment=ROBOT, reward="sotf")
    # Software OpenGL needs its renderers back, not when and on which thread the garbage collector comes by.
    renderers = weakref.ref(twin._recorder._renderer)
    del twin, begun, one
    assert renderers() is None


@pytest.mark.slow
def test_it_is_an_environment_with_the_spaces_of_the_simulator(physics, world):
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        check_env(physics)
    assert not [str(one.message) for one in found if "symmetric and normalized space" not in str(one.message)]
    both = {"flat_observation": True, "normalised_actions": True, "limits": False, "observe_every": 8}
    for options in ({"views": VIEWS[::-1]}, both):
        twin = MujocoEnv(embodiment=ROBOT, **options)
        inside = WorldLineEnv(model=world, embodiment=ROBOT, success=None, **options)
        assert (twin.action_space, twin.observation_space) == (inside.action_space, inside.observation_space)
    physics.reset(seed=0)
    with pytest.raises(DataError, match=r"finite \(14,\): left/shoulder"):
        physics.step(np.zeros(13))


@pytest.mark.slow
def test_a_start_is_drawn_by_the_policies_in_the_order_of_their_recording(compared, monkeypatch):
    starts = RecordedStarts(compared, embodiment=ROBOT, splits=("test",), view_sets=[("head",)], fps=8)
    assert len(EpisodeSet.open(compared)) == 6
    assert len({row.bank for row in starts.rows}) == len(starts) == 2  # attempts of one bank are one start
    drawn = []
    original = RecordPoliciesConfig.draw

    def draw(config, recorder, spec):
        drawn.append(list(config.policies))
        return original(config, recorder, spec)

    monkeypatch.setattr(RecordPoliciesConfig, "draw", draw)
    again = MujocoEnv(compared, embodiment=ROBOT)
    again.reset(seed=1)
    assert drawn == [["expert", "blind", "late"]]
    # A button that nobody has touched.
    np.testing.assert_allclose(again.target(), [0.0], atol=1e-3)
    again.close()


@pytest.mark.slow
def test_each_start_is_filmed_by_its_own_camera(tmp_path):
    group = {"embodiment": ROBOT, "split": "test", "count": 1, "families": ["press"]}
    groups = [group | {"held_out_camera": held_out} for held_out in (False, True)]
    config = RecordingConfig.model_validate({"episodes": {"groups": groups, "num_frames": 17, "workers": 1}})
    record_into(config, tmp_path / "recordings", 1)
    environment = MujocoEnv(tmp_path / "recordings", embodiment=ROBOT)
    first, other, again = (environment.reset(seed=number)[0]["pixels"]["head"] for number in (0, 1, 0))
    environment.close()
    assert np.array_equal(first, again) and not np.array_equal(first, other)


def test_recordings_whose_starts_are_not_known_are_refused(physics, shipped, monkeypatch):
    with pytest.raises(DataError, match=r"(?s)The manifest does not say where things stood.*banks"):
        MujocoEnv(shipped / "banks", embodiment=ROBOT, splits=("bank", "test"))
    with pytest.raises(ConfigError, match="observe_every 0"):
        MujocoEnv(embodiment=ROBOT, observe_every=0)
    drawn = physics._drawn
    monkeypatch.setattr(physics, "_drawn", lambda name: (drawn(name)[0], drawn(name)[1] + 0.01, drawn(name)[2]))
    with pytest.raises(DataError, match="cannot be drawn again as it was recorded"):
        physics.reset(seed=0)


@pytest.mark.slow
def test_recorded_policies_are_compared_in_both_worlds(compared, tmp_path, monkeypatch, capsys):
    arguments = ["policies_inside.py", "--recordings", str(compared), "--output", str(tmp_path), "--batch", "2"]
    monkeypatch.setattr(sys, "argv", arguments)
    policies_inside.main()
    lines = (tmp_path / "attempts.jsonl").read_text()
    attempts = [json.loads(line) for line in lines.splitlines()]
    assert len(attempts) == 6
    ended = {(row.bank, row.source): row.outcome == "success" for row in EpisodeSet.open(compared).rows}
    assert {(one["start"], one["policy"]): one["mujoco"] for one in attempts} == ended
    assert all(one["same_commands"] == one["simulator"] and one["judged"] == one["mujoco"] for one in attempts)
    found = json.loads(capsys.readouterr().out)
    assert found["rates"]["blind"]["simulator"] == 0.0
    for name, facts in found["agreement"]["scripted"]["policies"].items():
        assert facts["predicted"] == np.mean([one["simulator"] for one in attempts if one["policy"] == name])
    policies_inside.main()
    assert (tmp_path / "attempts.jsonl").read_text() == lines
