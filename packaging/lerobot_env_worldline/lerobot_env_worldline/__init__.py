"""WorldLine's simulator as an environment of LeRobot: ``lerobot-eval --env.type=worldline``."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import SyncVectorEnv, VectorEnv
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE

from worldline_core.environment.environment import WorldLineVectorEnv
from worldline_core.environment.mujoco_world import MujocoEnv
from worldline_core.errors import ConfigError
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.model.checkpoint import read_checkpoint_info
from worldline_core.model.world_model_config import match_views
from worldline_core.shipped import shipped_folder


class RecordedVectorEnv(WorldLineVectorEnv):
    """As ``WorldLineVectorEnv``; the state also has the key that ``--eval.recording`` writes."""

    def _observation(self) -> dict[str, Any]:
        observation = super()._observation()
        state: np.ndarray = observation["agent_pos"]
        return observation | {OBS_STATE: state.copy()}


class RecordedMujocoEnv(MujocoEnv):
    """As ``MujocoEnv``; the state also has the key that ``--eval.recording`` writes."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        state = self.observation_space["agent_pos"]
        self.observation_space = spaces.Dict({**self.observation_space.spaces, OBS_STATE: state})

    def _observed(self) -> dict[str, Any]:
        observation = super()._observed()
        return observation | {OBS_STATE: observation["agent_pos"].copy()}


@EnvConfig.register_subclass("worldline")
@dataclass
class WorldLineEnvConfig(EnvConfig):
    """Options of ``--env.type=worldline``; see ``WorldLineVectorEnv`` for what they mean.

    ``world=mujoco`` computes the same starts by physics (``MujocoEnv``; for recordings of ``worldline record``), with new pictures at
    every step unless ``observe_every`` is given; of the model only rate, views and size of pictures count there.
    The policy's ``n_action_steps`` should be ``observe_every`` (by default the model's block, 16).
    """

    task: str | None = "Simulator-v0"
    world: str = "simulator"
    fps: int = 8
    embodiment: str = "ur5e_silver"
    model: str | None = None
    recordings: str | None = None
    splits: list[str] = field(default_factory=lambda: ["test"])
    views: list[str] | None = None
    episode_length: int = 32
    observe_every: int | None = None
    device: str = "cpu"

    def __post_init__(self) -> None:
        if self.world not in ("simulator", "mujoco"):
            raise ConfigError("No such world", where="--env.world", expected="simulator or mujoco", got=self.world)
        info = read_checkpoint_info(Path(self.model or shipped_folder() / "models" / "causal"))
        size = tuple(cells * info.config.spatial_compression for cells in info.contract.grid_size)
        count = load_embodiment(self.embodiment).state_size
        self.fps = round(info.contract.fps)
        self.features = {
            ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(count,)),
            OBS_STATE: PolicyFeature(type=FeatureType.STATE, shape=(count,)),
        }
        views = self.views or list(info.views)
        if self.world == "simulator":
            match_views(info.view_sets, views, "--env.views")
        for view in views:
            self.features[f"{OBS_IMAGES}.{view}"] = PolicyFeature(type=FeatureType.VISUAL, shape=(*size, 3))
        self.features_map = {key: key for key in self.features}

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments of the environment."""
        return {
            "model": self.model, "recordings": self.recordings, "embodiment": self.embodiment, "splits": self.splits,
            "views": self.views, "episode_frames": self.episode_length, "observe_every": self.observe_every,
            "device": self.device,
        }  # fmt: skip

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, VectorEnv]]:
        """One batched environment: its episodes are stepped together, in this process."""
        del use_async_envs
        if self.world == "mujoco":
            views = [key.removeprefix(f"{OBS_IMAGES}.") for key in self.features if key.startswith(OBS_IMAGES)]
            height, width, _ = self.features[f"{OBS_IMAGES}.{views[0]}"].shape
            physics = partial(
                RecordedMujocoEnv, recordings=self.recordings, embodiment=self.embodiment, splits=self.splits, views=views,
                image_size=(height, width), episode_frames=self.episode_length, observe_every=self.observe_every or 1,
            )  # fmt: skip
            return {self.type: {0: SyncVectorEnv([physics] * n_envs)}}
        return {self.type: {0: RecordedVectorEnv(n_envs, **self.gym_kwargs)}}
