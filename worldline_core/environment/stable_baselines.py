"""Batched episodes for Stable-Baselines3 (extra ``rl``): one call of the model for all of them on each thread.

``PPO("MultiInputPolicy", VecMonitor(WorldLineVecEnv(8, embodiment="ur5e_silver", reward="soft")))``. The twin in MuJoCo needs no
adapter: ``make_vec_env`` of Stable-Baselines3 takes it with ``flat_observation`` and ``normalised_actions``.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import gymnasium
import numpy as np

from worldline_core.environment.environment import WorldLineVectorEnv
from worldline_core.errors import needing

with needing("rl", "Stable-Baselines3"):
    from stable_baselines3.common.vec_env import VecEnv
    from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn


Indices = int | Iterable[int] | None


class WorldLineVecEnv(VecEnv):
    """``WorldLineVectorEnv`` as a ``VecEnv``; observations are flat and actions normalised unless the options say otherwise.

    Episodes end together, and the next ones begin at once: the last observation is ``terminal_observation`` in the infos, and
    ``TimeLimit.truncated`` says that an episode ended by its length. Seeds and options count for the next reset.

    Args:
        options: of ``WorldLineVectorEnv``.
    """

    def __init__(self, num_envs: int = 1, **options: Any) -> None:
        given: dict[str, Any] = {"flat_observation": True, "normalised_actions": True} | options
        self.envs = WorldLineVectorEnv(num_envs, **given, autoreset=False)
        self._actions = np.empty(0)
        super().__init__(num_envs, self.envs.single_observation_space, self.envs.single_action_space)

    def reset(self) -> dict[str, np.ndarray]:
        """New episodes, with the seeds and options that were set."""
        options = {name: [one.get(name) for one in self._options] for one in self._options for name in one}
        observation, _ = self.envs.reset(seed=self._seeds, options=options)
        self.reset_infos = self.envs.infos()
        self._reset_seeds()
        self._reset_options()
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Step all episodes; where they end, the observation is that of the next ones."""
        observation, rewards, terminated, truncated, _ = self.envs.step(self._actions)
        infos, done = self.envs.infos(), terminated | truncated
        for slot, info in enumerate(infos):
            info["TimeLimit.truncated"] = bool(truncated[slot])
            if done[slot]:
                info["terminal_observation"] = {key: value[slot] for key, value in observation.items()}
        if done.all():
            observation = self.reset()
        return observation, rewards.astype(np.float32), done, infos

    def close(self) -> None:
        """Nothing to close."""

    def get_images(self) -> Sequence[np.ndarray | None]:
        return self.envs.render() or [None] * self.num_envs

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """An attribute of each environment by Gymnasium's ``call``, or else one that all share."""
        if hasattr(self.envs, attr_name):
            return [getattr(self.envs, attr_name) for _ in self._get_indices(indices)]
        found = self.envs.call(attr_name)
        return [found[slot] for slot in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Set an attribute that all environments share."""
        if len(list(self._get_indices(indices))) != self.num_envs:
            raise AttributeError(f"{attr_name} is shared by all environments of a batch")
        setattr(self.envs, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Indices = None, **method_kwargs: Any
    ) -> list[Any]:
        """A method's result of every environment, as Gymnasium's ``call``."""
        found = self.envs.call(method_name, *method_args, **method_kwargs)
        return [found[slot] for slot in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type[gymnasium.Wrapper], indices: Indices = None) -> list[bool]:
        """No: a batch is wrapped as a whole."""
        del wrapper_class
        return [False for _ in self._get_indices(indices)]
