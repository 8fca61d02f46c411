"""Fixtures that several test folders share."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import jaxtyping
import pytest

from tools.runtime_shapes import checked

if TYPE_CHECKING:
    from worldline_core.model.contracts import ActionContract, CausalSpec
    from worldline_core.model.world_model import WorldModel

CHECKED_PACKAGES = ("geometry", "actions", "model", "training", "distillation", "rollout")
"""Of the core: their functions are called with shapes and types checked against the annotations, in tests only."""
jaxtyping.install_import_hook(
    [f"worldline_core.{name}" for name in CHECKED_PACKAGES], f"{checked.__module__}.{checked.__name__}"
)

PROJECT_ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def unchecked_shapes() -> Iterator[None]:
    """For tests that hand in wrong shapes on purpose, to see what production code says of them."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.fixture(scope="session")
def project_root() -> Path:
    return PROJECT_ROOT


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Real samples that may not be copied into the project; they lie beside the checkout."""
    folder = Path(os.environ.get("WORLDLINE_SHARED", PROJECT_ROOT.parent / "shared")) / "data"
    if not folder.is_dir():
        pytest.skip(f"the real samples are not here (looked in {folder})")
    return folder


@pytest.fixture(scope="session")
def make_model() -> Callable[..., WorldModel]:
    """Very small world models (4 latent channels, 9 action channels) whose every weight is random: no path is silent."""

    def make(seed: int = 0, *, scale: float = 0.2, **changes: object) -> WorldModel:
        import torch

        from worldline_core.model.world_model import WorldModel
        from worldline_core.model.world_model_config import WorldModelConfig

        values: dict[str, object] = {
            "latent_channels": 4,
            "hidden_size": 24,
            "num_layers": 2,
            "num_heads": 2,
            "num_kv_heads": 1,
            "head_dim": 12,
            "intermediate_size": 32,
            "rope_sections": (2, 2, 2),
            "towers": "generation",
        }
        generator = torch.Generator().manual_seed(seed)
        model = WorldModel(WorldModelConfig.model_validate(values | changes))
        with torch.no_grad():
            for parameter in model.parameters():
                parameter.copy_(torch.randn(parameter.shape, generator=generator) * scale)
        return model.eval()

    return make


@pytest.fixture(scope="session")
def make_contract() -> Callable[..., ActionContract]:
    """Action contracts of small models."""

    def make(**changes: object) -> ActionContract:
        from worldline_core.model.contracts import ActionContract

        values: dict[str, object] = {
            "controls": "action",
            "sigma_px_ref": 40.0,
            "wrist_projection": "current_camera",
            "fps": 8.0,
            "grid_size": (4, 4),
            "tokenizer": "0123",
        }
        return ActionContract.of_these_maps(**values | changes)

    return make


@pytest.fixture(scope="session")
def make_spec() -> Callable[..., CausalSpec]:
    """Causal blocks of small models: two latent frames, a window of one and three blocks, the paper's nodes."""

    def make(**changes: object) -> CausalSpec:
        from worldline_core.model.contracts import CAUSAL_SIGMAS, CausalSpec

        values = {"block_size": 2, "sink_blocks": 1, "recent_blocks": 3, "sigmas": CAUSAL_SIGMAS}
        return CausalSpec.model_validate(values | changes)

    return make
