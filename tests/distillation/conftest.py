"""What distillation is tested on: clips for very small models, and the artifacts of a very small run."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from safetensors.torch import save_file

from worldline_core.actions.episode_tracks import EpisodeTracks, write_index, write_shard
from worldline_core.data.episodes import episode_index
from worldline_core.model.checkpoint import save_checkpoint
from worldline_core.model.world_model_config import CausalSpec
from worldline_core.training.clip_source import clip_key

VIEWS = ("head", "left_wrist", "right_wrist")
FRAMES = 21
EPISODES = {"a": "train", "b": "train", "c": "validation"}
IMAGE = (32, 32)
SIGMA = 40.0


def write_latents(root: Path) -> None:
    generator = torch.Generator().manual_seed(0)
    root.mkdir()
    tensors = {
        clip_key(name, 1, start): torch.randn(3, 4, 1 + (FRAMES - 1 - start) // 4, 4, 4, generator=generator).half()
        for name in EPISODES
        for start in range(0, FRAMES, 4)
    }
    save_file(tensors, root / "00000.safetensors")
    rows = [
        {
            "episode_id": name,
            "shard": "00000.safetensors",
            "num_frames": FRAMES,
            "views": list(VIEWS),
            "source": "test",
            "embodiment": "test",
            "split": split,
            "instruction": "",
            "primary_view": "head",
        }
        for name, split in EPISODES.items()
    ]
    pq.write_table(pa.Table.from_pylist(rows), root / "index.parquet")
    description = {
        "layout": "clips",
        "start_step": 4,
        "strides": [1],
        "tokenizer": "0123",
        "latent_shape": [4, 4, 4],
        "image_size": list(IMAGE),
    }
    (root / "store.json").write_text(json.dumps(description))


def tracks_of(name: str) -> EpisodeTracks:
    """One arm that moves to the right, one metre in front of the head camera; the right wrist's camera matrix is unusable."""
    random = np.random.default_rng(len(name))
    K = np.stack([np.array([[32.0, 0, 15.5], [0, 32.0, 15.5], [0, 0, 1]])] * 3)
    K[2] = np.nan
    position = np.stack([np.linspace(-0.4, 0.4, FRAMES), np.zeros(FRAMES), np.ones(FRAMES)], axis=-1)
    capsules = np.stack([position, position + np.array([0.0, 0.2, 0.0])], axis=1)[:, None]
    cameras = np.broadcast_to(np.eye(4), (FRAMES, 3, 4, 4))
    tools = np.broadcast_to(np.eye(4), (FRAMES, 1, 4, 4))
    shape = (FRAMES, 3, 1)
    return EpisodeTracks(
        episode_id=name,
        embodiment="test",
        views=VIEWS,
        arms=("right",),
        image_size=IMAGE,
        controls="action",
        camera_motion=("static", "recorded", "recorded"),
        uv=random.uniform(0, 32, (*shape, 2)).astype(np.float32),
        depth=np.ones(shape, np.float32),
        rot6d=np.ones((*shape, 6), np.float32),
        gripper=np.ones(shape, np.float32),
        valid=np.ones(shape, bool),
        T_base_tool=tools.astype(np.float32),
        T_base_camera=cameras.astype(np.float32),
        K=K.astype(np.float32),
        capsules=capsules.astype(np.float32),
        capsule_radii=np.array([0.05], np.float32),
    )


@pytest.fixture
def inputs(tmp_path: Path, make_model: Callable, make_contract: Callable) -> dict[str, Path]:
    return write_inputs(tmp_path, make_model, make_contract)


def write_inputs(root: Path, make_model: Callable, make_contract: Callable) -> dict[str, Path]:
    """Latents, tracks, an index of episodes and checkpoints of random weights."""
    folders = {name: root / name for name in ("latents", "tracks", "episodes", "stage2", "tokenizer", "stage1")}
    write_latents(folders["latents"])
    folders["tracks"].mkdir()
    shard = write_shard(folders["tracks"], 0, [tracks_of(name) for name in EPISODES])
    write_index(folders["tracks"], shard, sigma_px_ref=SIGMA)
    folders["episodes"].mkdir()
    rows = [
        episode_index.EpisodeRow(
            episode_id=name,
            dataset="datasets/test",
            episode_index=number,
            start=0,
            stop=FRAMES,
            num_frames=FRAMES,
            video_frames=FRAMES,
            fps=8.0,
            source="test",
            embodiment="test",
            scene="s",
            task_family="grasp",
            instruction="",
            outcome="success",
            split=split,
            views=VIEWS,
            bank=None,
            candidate=None,
            primary_view="head",
        )
        for number, (name, split) in enumerate(EPISODES.items())
    ]
    episode_index.write_index(folders["episodes"], rows)
    for kind in ("stage1", "stage2"):
        save_checkpoint(folders[kind], make_model(0), kind=kind, action_contract=make_contract(sigma_px_ref=SIGMA))
    return folders


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
def clip(make_spec: Callable) -> Clip:
    generator = torch.Generator().manual_seed(1)
    latents, noise = torch.randn(2, 2, 3, 4, 5, 4, 4, generator=generator)
    maps = torch.randn(2, 3, 9, 5, 4, 4, generator=generator)
    mask = (torch.rand(2, 3, 5, 4, 4, generator=generator) > 0.5).float()
    return Clip(latents, maps, noise, mask, make_spec())
