"""The network that a configuration describes."""

from __future__ import annotations

from worldline_core.model.mixture import MixtureModel
from worldline_core.model.wan import WanModel
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import MixtureConfig, WanConfig, WorldModelConfig


def build_world_model(config: WorldModelConfig) -> WorldModel:
    """A model without values worth keeping: fill it, or initialise it."""
    match config:
        case MixtureConfig():
            return MixtureModel(config)
        case WanConfig():
            return WanModel(config)
        case _:
            raise TypeError(f"{type(config).__name__} describes no network")
