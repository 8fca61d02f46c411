"""Stable-Baselines3 in both worlds: its checker, its vector environments, and training over a batch."""

import sys
import warnings

import gymnasium
import numpy as np
import pytest
import torch

pytest.importorskip("stable_baselines3")

from gymnasium.utils.env_checker import data_equivalence
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

from worldline_core.environment import ENVIRONMENT, MUJOCO_ENVIRONMENT
from worldline_core.environment.environment import WorldLineEnv
from worldline_core.environment.stable_baselines import WorldLineVecEnv
from worldline_core.errors import UnavailableError
from worldline_core.rollout.simulation import Session

FORM = {"embodiment": "ur5e_silver", "flat_observation": True, "normalised_actions": True}


@pytest.fixture
def calls(monkeypatch):
    """Number of environments that each call of the model stepped, on one thread."""
    counts, threads = [], torch.get_num_threads()
    original = Session.step_lazily
    monkeypatch.setattr(Session, "step_lazily", lambda one, maps: counts.append(len(maps)) or original(one, maps))
    torch.set_num_threads(1)
    yield counts
    torch.set_num_threads(threads)


@pytest.mark.slow
@pytest.mark.parametrize("name", [ENVIRONMENT, MUJOCO_ENVIRONMENT])
def test_its_checker_finds_nothing(world, name, request):
    options = {"model": world} if name == ENVIRONMENT else {}
    if name == MUJOCO_ENVIRONMENT:
        request.getfixturevalue("rendering")
    environment = gymnasium.make(name, episode_frames=6, observe_every=2, reward="soft", **FORM, **options)
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        check_env(environment.unwrapped)
    assert not [str(one.message) for one in found]
    environment.close()


@pytest.mark.slow
def test_a_batch_is_its_own_vector_of_single_environments(world, calls):
    """To the end of two episodes: observations, rewards, terminal observations, time limits; but one call of the model for all."""
    options = {"model": world, "episode_frames": 6, "observe_every": 4, "reward": "soft"}
    options["success"] = lambda video: "drawer" in video.instruction
    ours = WorldLineVecEnv(2, **FORM, **options)
    theirs = DummyVecEnv([lambda: WorldLineEnv(**FORM, **options)] * 2)
    assert (ours.observation_space, ours.action_space) == (theirs.observation_space, theirs.action_space)
    for one in (ours, theirs):
        one.seed(3)
    assert data_equivalence(ours.reset(), dict(theirs.reset()))
    random = np.random.default_rng(0)
    ends = []
    for _ in range(12):
        actions = random.uniform(-0.3, 0.3, (2, 14)).astype(np.float32)
        mine, other = ours.step(actions), theirs.step(actions)
        assert all(data_equivalence(a, b) for a, b in zip(mine, (dict(other[0]), *other[1:]), strict=True))
        ends += [info for info, done in zip(mine[3], mine[2], strict=True) if done]
    assert len(ends) == 4
    assert all(info["TimeLimit.truncated"] is (not info["is_success"]) for info in ends)
    assert {info["is_success"] for info in ends} == {True, False}
    assert all(ours.observation_space.contains(info["terminal_observation"]) for info in ends)
    # Of an episode at steps 4 and 6: of ours both clips at once, of theirs one by one.
    assert (calls.count(2), calls.count(1)) == (4, 8)
    start = ours.envs.starts.rows[2].episode_id
    for one in (ours, theirs):
        one.set_options({"start": start, "frame": 5})
        one.seed(7)
    assert data_equivalence(ours.reset(), dict(theirs.reset()))
    assert ours.reset_infos[1]["episode_id"] == start
    assert ours.get_attr("task")[0] == ours.env_method("task", indices=[0])[0]
    assert ours.render().shape == (2 * 64, 3 * 96, 3)
    with pytest.raises(AttributeError, match="nothing"):
        ours.get_attr("nothing")
    ours.close()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["PPO", "SAC"])
def test_training_runs_over_a_batch(world, calls, kind):
    """With one call of the model for all environments at each step with new pictures; equal seeds give equal weights."""

    def trained():
        env = VecMonitor(WorldLineVecEnv(
            4, model=world, embodiment="ur5e_silver", reward="soft", success=None, episode_frames=4, observe_every=2,
        ))  # fmt: skip
        if kind == "PPO":
            return PPO("MultiInputPolicy", env, n_steps=8, batch_size=16, n_epochs=1, seed=1).learn(32)
        return SAC("MultiInputPolicy", env, buffer_size=64, learning_starts=16, batch_size=4, seed=1).learn(32)

    one = trained()
    assert one.num_timesteps == 32
    assert calls == [4] * 4  # eight steps of four environments, pictures at every second
    assert all(episode["l"] == 4 for episode in one.ep_info_buffer)
    other = trained()
    first, second = one.policy.state_dict(), other.policy.state_dict()
    assert all(np.array_equal(first[key].numpy(), second[key].numpy()) for key in first)


def test_without_it_the_adapter_says_what_to_install(monkeypatch):
    module = "worldline_core.environment.stable_baselines"
    monkeypatch.delitem(sys.modules, module)
    for name in [name for name in sys.modules if name.startswith("stable_baselines3")]:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(UnavailableError, match=r"(?s)Stable-Baselines3 is not installed.*worldline\[rl\]"):
        __import__(module)
