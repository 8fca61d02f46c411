"""A synthetic world small enough to train on in seconds: latents, tracks and episodes of one square that moves."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from safetensors.torch import save_file

from worldline_core.actions.episode_tracks import EpisodeTracks, write_index, write_shard
from worldline_core.data.episodes.episode import VIEWS, CameraTrack, Episode
from worldline_core.data.episodes.episode_set import EpisodeSetWriter
from worldline_core.model.world_model import WorldModelConfig
from worldline_core.training.clip_source import LatentRow, group_key, single_key
from worldline_core.training.trainer import TrainingRun

FRAMES, CHANNELS, GRID, IMAGE = 17, 4, (4, 4), (32, 32)
TINY_MODEL = {
    "latent_channels": CHANNELS,
    "hidden_size": 32,
    "num_layers": 2,
    "num_heads": 2,
    "num_kv_heads": 1,
    "head_dim": 16,
    "intermediate_size": 48,
    "rope_sections": (4, 2, 2),
    "vocab_size": 300,
}


@dataclass(frozen=True)
class World:
    """Folders of the synthetic artifacts."""

    episodes: Path
    latents: Path
    tracks: Path

    @property
    def inputs(self) -> dict[str, Path]:
        return {"episodes": self.episodes, "latents": self.latents, "tracks": self.tracks}


def centre(number: int, frame: int) -> tuple[float, float]:
    """(row, column) of the square, in latent cells."""
    return 1.5 + 1.2 * np.sin(0.2 * frame + number), 1.5 + 1.2 * np.cos(0.3 * frame + 2 * number)


def picture(number: int, frame: int) -> np.ndarray:
    """(c, h, w): a bump at the centre over an episode's own background."""
    row, column = centre(number, frame)
    rows, columns = np.mgrid[: GRID[0], : GRID[1]]
    bump = np.exp(-((rows - row) ** 2 + (columns - column) ** 2))
    background = np.random.default_rng(number).normal(size=(CHANNELS, 1, 1)) * 0.3
    return (bump[None] * np.array([2.0, -2.0, 1.0, 0.5])[:, None, None] + background).astype(np.float32)


def write_latents(root: Path, count: int, validation: int) -> None:
    root.mkdir(parents=True)
    tensors: dict[str, torch.Tensor] = {}
    rows = []
    for number in range(count):
        name = f"episode-{number:03d}"
        frames = np.stack([picture(number, frame) for frame in range(FRAMES)], 1)
        latents = torch.from_numpy(np.stack([frames] * 3)).half()
        tensors[single_key(name)] = latents[:, :, ::4].contiguous()
        tensors[group_key(name, 1, 1)] = latents[:, :, 4::4].contiguous()
        split = "validation" if number < validation else "train"
        rows.append(
            LatentRow(name, FRAMES, VIEWS, "synthetic", "square", split, f"move {number}", "head", "00000.safetensors")
        )
    save_file(tensors, root / "00000.safetensors")
    pq.write_table(
        pa.Table.from_pylist([{**vars(row), "views": list(row.views)} for row in rows]), root / "index.parquet"
    )
    description = {
        "layout": "groups",
        "start_step": 4,
        "strides": [1],
        "latent_shape": [CHANNELS, *GRID],
        "image_size": list(IMAGE),
        "tokenizer": "synthetic",
    }
    (root / "store.json").write_text(json.dumps(description))


def write_tracks(root: Path, count: int) -> None:
    root.mkdir(parents=True)
    tracks = []
    for number in range(count):
        uv = np.zeros((FRAMES, 3, 1, 2), np.float32)
        for frame in range(FRAMES):
            row, column = centre(number, frame)
            uv[frame, :, 0] = ((column + 0.5) * 8 - 0.5, (row + 0.5) * 8 - 0.5)
        ones = np.ones((FRAMES, 3, 1), np.float32)
        eye = np.tile(np.eye(4, dtype=np.float32), (FRAMES, 3, 1, 1))
        tracks.append(
            EpisodeTracks(
                episode_id=f"episode-{number:03d}",
                embodiment="square",
                views=VIEWS,
                arms=("right",),
                image_size=IMAGE,
                controls="action",
                camera_motion=("static",) * 3,
                uv=uv,
                depth=ones,
                rot6d=np.zeros((FRAMES, 3, 1, 6), np.float32),
                gripper=ones,
                valid=ones.astype(bool),
                T_base_tool=eye[:, :1],
                T_base_camera=eye,
                K=np.tile(np.eye(3, dtype=np.float32), (3, 1, 1)),
                capsules=np.zeros((FRAMES, 1, 2, 3), np.float32),
                capsule_radii=np.ones(1, np.float32),
            )
        )
    write_index(root, write_shard(root, 0, tracks), sigma_px_ref=60.0)


def write_episodes(root: Path, count: int, validation: int) -> None:
    cameras = {
        view: CameraTrack(view, np.array([[20.0, 0, 15.5], [0, 20.0, 15.5], [0, 0, 1.0]]), np.eye(4)[None], 32, 32)
        for view in VIEWS
    }
    with EpisodeSetWriter(root) as writer:
        for number in range(count):
            rows, columns = np.mgrid[: IMAGE[0], : IMAGE[1]]
            frames = np.zeros((FRAMES, *IMAGE, 3), np.uint8)
            for frame in range(FRAMES):
                row, column = centre(number, frame)
                bump = np.exp(-((rows / 8 - row) ** 2 + (columns / 8 - column) ** 2))
                frames[frame] = (40 + 180 * bump[..., None]).astype(np.uint8)
            state = np.linspace([0, 0], [number, 1], FRAMES, dtype=np.float32)
            writer.add(
                Episode(
                    episode_id=f"episode-{number:03d}",
                    source="synthetic",
                    embodiment="square",
                    scene=f"scene-{number}",
                    task_family="lift",
                    instruction=f"move {number}",
                    outcome="failure" if number % 2 else "success",
                    split="validation" if number < validation else "train",
                    fps=8.0,
                    state=state,
                    action=state,
                    timestamps=np.arange(FRAMES) / 8.0,
                    cameras=cameras,
                    state_names=("joint", "gripper"),
                ),
                dict.fromkeys(VIEWS, frames),
                None,
            )


@pytest.fixture(scope="session")
def world(tmp_path_factory: pytest.TempPathFactory) -> World:
    root = tmp_path_factory.mktemp("world")
    write_latents(root / "latents", 8, 2)
    write_tracks(root / "tracks", 8)
    write_episodes(root / "episodes", 8, 2)
    return World(root / "episodes", root / "latents", root / "tracks")


@pytest.fixture(scope="session")
def tiny_model() -> dict[str, object]:
    """Values of a model that fits the world's latents."""
    return dict(TINY_MODEL)


@pytest.fixture
def model_config() -> Callable[..., WorldModelConfig]:
    def make(**changes: object) -> WorldModelConfig:
        return WorldModelConfig.model_validate(TINY_MODEL | changes)

    return make


class Killed(Exception):
    pass


@pytest.fixture
def killed_after(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], AbstractContextManager[object]]:
    """Within the context, training is killed after so many optimiser steps."""

    @contextmanager
    def killed(steps: int) -> Iterator[None]:
        inner, calls = TrainingRun.step, [0]

        def step(run: TrainingRun[Any], number: int) -> Any:
            if calls[0] == steps:
                raise Killed("killed")
            calls[0] += 1
            return inner(run, number)

        with monkeypatch.context() as patch, pytest.raises(Killed, match="killed"):
            patch.setattr(TrainingRun, "step", step)
            yield

    return killed


@pytest.fixture(scope="session")
def tokenizer(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small tokenizer whose latents have the shape of the world's."""
    from worldline_core.model.tokenizers import PatchTokenizer, PatchTokenizerConfig

    generator = torch.Generator().manual_seed(5)
    model = PatchTokenizer(PatchTokenizerConfig(static_channels=3, motion_channels=1))
    for basis in (model.static_basis, model.motion_basis):
        basis.copy_(torch.linalg.qr(torch.randn(basis.shape[1], basis.shape[0], generator=generator))[0].T)
    folder = tmp_path_factory.mktemp("tokenizer")
    model.save(folder)
    return folder
