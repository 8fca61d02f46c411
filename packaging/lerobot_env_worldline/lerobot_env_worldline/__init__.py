"""WorldLine's simulator as an environment of LeRobot: ``lerobot-eval --env.type=worldline``."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE

from worldline_core.environment.environment import WorldLineVectorEnv
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.model.checkpoint import read_checkpoint_info
from worldline_core.shipped import shipped_folder


class RecordedVectorEnv(WorldLineVectorEnv):
    """As ``WorldLineVectorEnv``; the state also has the key that ``--eval.recording`` writes."""

    def _observation(self) -> dict[str, Any]:
        observation = super()._observation()
        state: np.ndarray = observation["agent_pos"]
        return observation | {OBS_STATE: state.copy()}


@EnvConfig.register_subclass("worldline")
@dataclass
class WorldLineEnvConfig(EnvConfig):
    """Options of ``--env.type=worldline``; see ``WorldLineVectorEnv`` for what they mean.

    The policy's ``n_action_steps`` should be ``observe_every`` (by default the model's block, 16).
    """

    task: str | None = "Simulator-v0"
    fps: int = 8
    embodiment: str = "ur5e_silver"
    model: str | None = None
    recordings: str | None = None
    splits: list[str] = field(default_factory=lambda: ["test"])
    views: list[str] | None = None
    episode_length: int = 32
    observe_every: int | None = None
    stop_at_success: bool = False
    device: str = "cpu"

    def __post_init__(self) -> None:
        info = read_checkpoint_info(Path(self.model or shipped_folder() / "models" / "causal"))
        size = tuple(cells * info.config.spatial_compression for cells in info.contract.grid_size)
        count = load_embodiment(self.embodiment).state_size
        self.fps = round(info.contract.fps)
        self.features = {
            ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(count,)),
            OBS_STATE: PolicyFeature(type=FeatureType.STATE, shape=(count,)),
        }
        for view in self.views or info.views:
            self.features[f"{OBS_IMAGES}.{view}"] = PolicyFeature(type=FeatureType.VISUAL, shape=(*size, 3))
        self.features_map = {key: key for key in self.features}

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments of the environment."""
        return {
            "model": self.model, "recordings": self.recordings, "embodiment": self.embodiment, "splits": self.splits,
            "views": self.views, "episode_frames": self.episode_length, "observe_every": self.observe_every,
            "stop_at_success": self.stop_at_success, "device": self.device,
        }  # fmt: skip

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, VectorEnv]]:
        """One batched environment: its episodes are stepped together, in this process."""
        del use_async_envs
        return {self.type: {0: RecordedVectorEnv(n_envs, **self.gym_kwargs)}}
