"""A synthetic world small enough to train on in seconds: latents, tracks and episodes of one square that moves."""

from __future__ import annotations

import json
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from safetensors.torch import save_file

from worldline_core.actions.episode_tracks import EpisodeTracks, write_index, write_shard
from worldline_core.data.episodes.episode import VIEWS, CameraTrack, Episode
from worldline_core.data.episodes.episode_set import EpisodeSetWriter
from worldline_core.model.checkpoint import save_checkpoint
from worldline_core.model.networks import build_world_model
from worldline_core.model.tokenizers import PatchTokenizer, PatchTokenizerConfig
from worldline_core.model.world_model_config import MixtureConfig
from worldline_core.store.artifact_files import read_json_lines
from worldline_core.training.clip_sampler import ClipRow
from worldline_core.training.clip_source import latent_key
from worldline_core.training.flow_matching import FlowMatchingObjective
from worldline_core.training.trainer import TrainingRun
from worldline_core.training.training_config import Stage1Config, Stage2Config, TeacherConfig
from worldline_core.training.video_teacher import train_teacher

FRAMES, CHANNELS, GRID, IMAGE = 17, 4, (4, 4), (32, 32)
TINY_MODEL = {
    "latent_channels": CHANNELS, "hidden_size": 32, "num_layers": 2, "num_heads": 2, "num_kv_heads": 1, "head_dim": 16,
    "intermediate_size": 48, "rope_sections": (4, 2, 2), "vocab_size": 300,
}  # fmt: skip
FRAME_INPUT = {"kind": "frames", "image_size": list(IMAGE), "start_step": 4}


@dataclass(frozen=True)
class World:
    """Folders of the synthetic artifacts."""

    episodes: Path
    latents: Path
    tracks: Path

    @property
    def inputs(self):
        return {"episodes": self.episodes, "latents": self.latents, "tracks": self.tracks}


def centre(number, frame):
    """(row, column) of the square, in latent cells."""
    return 1.5 + 1.2 * np.sin(0.2 * frame + number), 1.5 + 1.2 * np.cos(0.3 * frame + 2 * number)


def picture(number, frame):
    """(c, h, w): a bump at the centre over an episode's own background."""
    row, column = centre(number, frame)
    rows, columns = np.mgrid[: GRID[0], : GRID[1]]
    bump = np.exp(-((rows - row) ** 2 + (columns - column) ** 2))
    background = np.random.default_rng(number).normal(size=(CHANNELS, 1, 1)) * 0.3
    return (bump[None] * np.array([2.0, -2.0, 1.0, 0.5])[:, None, None] + background).astype(np.float32)


def build_episode(name, state, **changes):
    values = {
        "episode_id": name, "source": "synthetic", "embodiment": "square", "scene": name, "task_family": "lift",
        "instruction": "lift the red cube", "outcome": "success", "split": "train", "fps": 8.0, "state": state,
        "action": state, "timestamps": np.arange(len(state)) / 8.0,
    }  # fmt: skip
    return Episode(**values | changes)


def build_tracks(name, frames, arms=1, **changes):
    """Tracks of tools that do not move, with cameras at the origin."""
    ones, eye = np.ones((frames, 3, arms), np.float32), np.tile(np.eye(4, dtype=np.float32), (frames, 3, 1, 1))
    values = {
        "episode_id": name, "embodiment": "square", "views": VIEWS, "arms": ("left", "right")[-arms:], "image_size": IMAGE,
        "controls": "action", "camera_motion": ("static",) * 3, "uv": np.zeros((frames, 3, arms, 2)), "depth": ones,
        "rot6d": np.zeros((frames, 3, arms, 6), np.float32), "gripper": ones, "valid": ones.astype(bool),
        "T_base_tool": eye[:, :arms], "T_base_camera": eye, "K": eye[0, :, :3, :3],
        "capsules": np.zeros((frames, 1, 2, 3), np.float32), "capsule_radii": np.ones(1, np.float32),
    }  # fmt: skip
    return EpisodeTracks(**values | changes)


def cameras_of(K, size, views=VIEWS):
    return {view: CameraTrack(view, np.array(K), np.eye(4)[None], *size[::-1]) for view in views}


def names_of(count, validation):
    return {f"episode-{number:03d}": "validation" if number < validation else "train" for number in range(count)}


def write_latents(root, count, validation, frames=FRAMES):
    root.mkdir(parents=True)
    tensors, rows = {}, []
    for number, (name, split) in enumerate(names_of(count, validation).items()):
        pictures = np.stack([picture(number, frame) for frame in range(frames)], 1)
        latents = torch.from_numpy(np.stack([pictures] * 3)).half()
        tensors[latent_key(name, "single")] = latents[:, :, ::4].contiguous()
        tensors[latent_key(name, "groups", 1, 1)] = latents[:, :, 4::4].contiguous()
        facts = (split, f"move {number}", "head", "00000.safetensors")
        rows.append(vars(ClipRow(name, frames, VIEWS, "synthetic", "square", *facts)) | {"views": list(VIEWS)})
    save_file(tensors, root / "00000.safetensors")
    pq.write_table(pa.Table.from_pylist(rows), root / "index.parquet")
    description = {
        "layout": "groups", "start_step": 4, "clip_frames": None, "strides": [1], "latent_shape": [CHANNELS, *GRID],
        "image_size": list(IMAGE), "tokenizer": "synthetic",
    }  # fmt: skip
    (root / "store.json").write_text(json.dumps(description))


def write_tracks(root, count, frames=FRAMES, sigma_px_ref=60.0, **changes):
    root.mkdir(parents=True)
    tracks = []
    for number, name in enumerate(names_of(count, 0)):
        centres = np.array([centre(number, frame)[::-1] for frame in range(frames)])
        uv = np.repeat(((centres + 0.5) * 8 - 0.5)[:, None, None], 3, axis=1)
        tracks.append(build_tracks(name, frames, uv=uv, **changes))
    write_index(root, write_shard(root, 0, tracks), sigma_px_ref=sigma_px_ref)


def write_episodes(root, count, validation, frames=FRAMES):
    cameras = cameras_of([[20.0, 0, 15.5], [0, 20.0, 15.5], [0, 0, 1.0]], IMAGE)
    rows, columns = np.mgrid[: IMAGE[0], : IMAGE[1]]
    with EpisodeSetWriter(root) as writer:
        for number, (name, split) in enumerate(names_of(count, validation).items()):
            video = np.zeros((frames, *IMAGE, 3), np.uint8)
            for frame in range(frames):
                row, column = centre(number, frame)
                bump = np.exp(-((rows / 8 - row) ** 2 + (columns / 8 - column) ** 2))
                video[frame] = (40 + 180 * bump[..., None]).astype(np.uint8)
            episode = build_episode(
                name, np.linspace([0, 0], [number, 1], frames, dtype=np.float32), instruction=f"move {number}", split=split,
                outcome="failure" if number % 2 else "success", cameras=cameras, state_names=("joint", "gripper"),
            )  # fmt: skip
            writer.add(episode, dict.fromkeys(VIEWS, video))


@pytest.fixture(scope="session")
def world(tmp_path_factory):
    root = tmp_path_factory.mktemp("world")
    write_latents(root / "latents", 8, 2)
    write_tracks(root / "tracks", 8)
    write_episodes(root / "episodes", 8, 2)
    return World(root / "episodes", root / "latents", root / "tracks")


@pytest.fixture
def model_config():
    """Makes configurations of models that fit the world's latents."""
    return lambda **changes: MixtureConfig.model_validate(TINY_MODEL | changes)


@pytest.fixture(scope="session")
def base(tmp_path_factory):
    """A base checkpoint of random weights that fits the world's latents."""
    model, folder = build_world_model(MixtureConfig.model_validate(TINY_MODEL)), tmp_path_factory.mktemp("base")
    model.initialise(torch.Generator().manual_seed(0))
    torch.nn.init.normal_(model.proj_out.weight, std=0.2)  # a head of zeros would teach no layer below it
    save_checkpoint(folder, model, kind="base", action_contract=None)
    return folder


def trainer(steps, **changes):
    return {
        "steps": steps, "batch_size": 4, "precision": "fp32", "log_every": 3, "validation_batches": 1,
        "save_every_seconds": 1000.0, "save_every_steps": 4, "optimizer": {"learning_rate": 3e-3, "warmup_steps": 2},
        **changes,
    }  # fmt: skip


def stage1(**changes):
    return Stage1Config.model_validate({"model": TINY_MODEL, **changes})


def stage2(steps, **changes):
    values = {
        "trainer": trainer(steps), "clips": {"lengths": [9, 17]}, "action_multiplier": 3.0, "action_dropout": 0.1,
        "relational": None,
    }  # fmt: skip
    return Stage2Config.model_validate(values | changes)


def losses(folder):
    return [row["loss"] for row in read_json_lines(folder / "metrics.jsonl") if "loss" in row]


@pytest.fixture(scope="session")
def teacher(world, tmp_path_factory):
    folder = tmp_path_factory.mktemp("teacher")
    shape = {"image_size": [32, 32], "patch": 8, "hidden_size": 16, "num_layers": 4, "num_heads": 2}
    values = {"shape": shape, "trainer": trainer(6), "clip_frames": 9, "held_out_episodes": 1}
    counts = train_teacher(TeacherConfig.model_validate(values), {"episodes": world.episodes}, folder)
    assert counts["found"] == counts["kept"] + sum(counts["left_out"].values()) == 8
    assert (counts["left_out"]["held out to measure on"], counts["left_out"]["in other splits"]) == (1, 2)
    return folder


class Killed(Exception):
    pass


@pytest.fixture
def killed_after(monkeypatch):
    """Within the context, training is killed after so many optimiser steps."""

    @contextmanager
    def killed(steps):
        inner, calls = TrainingRun.step, [0]

        def step(run, number):
            if calls[0] == steps:
                raise Killed("killed")
            calls[0] += 1
            return inner(run, number)

        with monkeypatch.context() as patch, pytest.raises(Killed, match="killed"):
            patch.setattr(TrainingRun, "step", step)
            yield

    return killed


def write_tokenizer(folder):
    """A small tokenizer whose latents have four channels."""
    generator = torch.Generator().manual_seed(5)
    model = PatchTokenizer(PatchTokenizerConfig(static_channels=3, motion_channels=1))
    for basis in (model.static_basis, model.motion_basis):
        basis.copy_(torch.linalg.qr(torch.randn(basis.shape[1], basis.shape[0], generator=generator))[0].T)
    model.save(folder)
    return folder


@pytest.fixture(scope="session")
def tokenizer(tmp_path_factory):
    return write_tokenizer(tmp_path_factory.mktemp("tokenizer"))


@pytest.fixture
def seen(monkeypatch):
    """Batches that the flow-matching objective is given."""
    seen, loss = [], FlowMatchingObjective.loss

    def watched(objective, batch, *rest):
        seen.append(batch)
        return loss(objective, batch, *rest)

    monkeypatch.setattr(FlowMatchingObjective, "loss", watched)
    return seen
