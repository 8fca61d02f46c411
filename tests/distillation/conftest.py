"""Clips for very small models, and the artifacts of a very small run."""

from __future__ import annotations

import shutil
from dataclasses import dataclass

import numpy as np
import pytest
import torch

from tests.training.conftest import write_episodes, write_latents, write_tracks
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.model.checkpoint import save_checkpoint
from worldline_core.model.world_model_config import CausalSpec

FRAMES = 21
SIGMA = 40.0


def trainer(steps, **changes):
    return {
        "steps": steps, "batch_size": 2, "precision": "fp32", "log_every": 6, "validation_batches": 1,
        "save_every_seconds": 3600, "optimizer": {"learning_rate": 1e-3, "warmup_steps": 2},
        **changes,
    }  # fmt: skip


def write_inputs(root, make_model, make_contract):
    """Recordings, their latents and tracks, and checkpoints of random weights.

    One arm moves to the right, one metre in front of the head camera; the right wrist's camera matrix is unusable.
    """
    folders = {name: root / name for name in ("latents", "tracks", "episodes", "stage2", "tokenizer", "stage1")}
    write_latents(folders["latents"], 3, 1, FRAMES)
    write_episodes(folders["episodes"], 3, 1, FRAMES)
    K = np.tile(np.array([[32.0, 0, 15.5], [0, 32.0, 15.5], [0, 0, 1]], np.float32), (3, 1, 1))
    K[2] = np.nan
    position = np.stack([np.linspace(-0.4, 0.4, FRAMES), np.zeros(FRAMES), np.ones(FRAMES)], axis=-1)
    capsules = np.stack([position, position + np.array([0.0, 0.2, 0.0])], axis=1)[:, None].astype(np.float32)
    body = {"capsules": capsules, "capsule_radii": np.array([0.05], np.float32)}
    motion = ("static", "recorded", "recorded")
    write_tracks(folders["tracks"], 3, FRAMES, SIGMA, K=K, camera_motion=motion, **body)
    contract = make_contract(sigma_px_ref=SIGMA, tokenizer="synthetic")
    for kind in ("stage1", "stage2"):
        save_checkpoint(folders[kind], make_model(0), kind=kind, action_contract=contract)
    return folders


@pytest.fixture(scope="session")
def written(tmp_path_factory, make_model, make_contract):
    return write_inputs(tmp_path_factory.mktemp("written"), make_model, make_contract)


@pytest.fixture
def inputs(tmp_path, written):
    """Copies, which a test may change."""
    shutil.copytree(written["episodes"].parent, tmp_path, dirs_exist_ok=True)
    return {name: tmp_path / name for name in written}


@dataclass(frozen=True)
class Clip:
    """Two blocks of two latent frames after the observed one."""

    latents: torch.Tensor
    maps: torch.Tensor
    noise: torch.Tensor
    mask: torch.Tensor
    spec: CausalSpec
    views: tuple[str, ...] = VIEWS


@pytest.fixture
def clip(make_spec):
    generator = torch.Generator().manual_seed(1)
    latents, noise = torch.randn(2, 2, 3, 4, 5, 4, 4, generator=generator)
    maps = torch.randn(2, 3, 9, 5, 4, 4, generator=generator)
    mask = (torch.rand(2, 3, 5, 4, 4, generator=generator) > 0.5).float()
    return Clip(latents, maps, noise, mask, make_spec())
