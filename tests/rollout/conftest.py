"""Recordings of a moving square, their action tracks, and small models of random weights."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
import torch

from worldline_core.actions.episode_tracks import EpisodeTracks, write_index, write_shard
from worldline_core.data.episodes.episode import VIEWS, CameraTrack, Episode
from worldline_core.data.episodes.episode_set import EpisodeSetWriter
from worldline_core.model.checkpoint import save_checkpoint
from worldline_core.model.tokenizers import fit_patch_tokenizer
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import CAUSAL_SIGMAS, CausalSpec, NativeVectors, WorldModelConfig

SIZE = (32, 48)
SPEC = CausalSpec(block_size=4, sink_blocks=1, recent_blocks=1, anchor_blocks=None, sigmas=CAUSAL_SIGMAS)
N = 33
NAMES = {"a-0": "ur5e_pair", "a-1": "ur5e_pair", "b/0 x": "aloha_viperx", "b-1": "aloha_viperx", "b-2": "aloha_viperx"}


def recorded(seed: int, count: int = N) -> np.ndarray:
    generator = np.random.default_rng(seed)
    frames = np.repeat(generator.integers(60, 190, (1, 4, 6, 3)).repeat(8, 1).repeat(8, 2), count, axis=0)
    for frame in range(count):
        left = frame if frame < N else frame % 38
        frames[frame, 8:20, left : left + 10] = (220, 40, 40)
    return frames.astype(np.uint8)


def track(name: str, shift: float, count: int = N, views: Sequence[str] = VIEWS) -> EpisodeTracks:
    """Tracks of ``count`` frames, with cameras of ``views``."""
    shape = (count, 3, 2)
    uv = np.zeros((*shape, 2), np.float32)
    uv[..., 0] = np.linspace(5, 40, count)[:, None, None] + shift
    uv[..., 1] = 14
    eye = np.tile(np.eye(4, dtype=np.float32), (count, 3, 1, 1))
    motion = zip(VIEWS, ("static", "kinematics", "kinematics"), strict=True)
    valid = np.ones(shape, bool)
    valid[:, [view not in views for view in VIEWS]] = False
    return EpisodeTracks(
        episode_id=name, embodiment=NAMES.get(name, "ur5e_pair"), views=VIEWS, arms=("left", "right"), image_size=SIZE, controls="action",
        camera_motion=tuple(kind if view in views else "absent" for view, kind in motion), uv=uv, depth=np.ones(shape, np.float32),
        rot6d=np.ones((*shape, 6), np.float32), gripper=np.ones(shape, np.float32), valid=valid,
        T_base_tool=eye[:, :2], T_base_camera=eye, K=np.tile(np.eye(3, dtype=np.float32), (3, 1, 1)),
        capsules=np.zeros((count, 1, 2, 3), np.float32), capsule_radii=np.ones(1, np.float32),
    )  # fmt: skip


def write_recordings(
    root: Path, episodes: Sequence[tuple[str, str, int, Sequence[str], Sequence[str]]], joints_of: int = 14
) -> dict[str, Path]:
    """An EpisodeSet and its tracks.

    Args:
        episodes: (id, split, frames, views with a video, views with a camera).
        joints_of: numbers of a state.
    """
    K = np.array([[40.0, 0.0, 24.0], [0.0, 40.0, 16.0], [0.0, 0.0, 1.0]])
    tracks = []
    with EpisodeSetWriter(root / "episodes") as writer:
        for seed, (name, split, count, views, calibrated) in enumerate(episodes):
            joints = np.linspace(np.zeros(joints_of), np.full(joints_of, seed), count, dtype=np.float32)
            episode = Episode(
                episode_id=name, source="synthetic", embodiment=NAMES.get(name, "ur5e_pair"), scene="s",
                task_family="lift", instruction="lift the red cube", outcome="success" if seed % 2 else "failure",
                split=split, fps=8.0, state=joints, action=joints, timestamps=np.arange(count) / 8.0,
                cameras={view: CameraTrack(view, K, np.eye(4)[None], SIZE[1], SIZE[0]) for view in calibrated},
            )  # fmt: skip
            writer.add(episode, {view: recorded(seed, count) for view in views})
            tracks.append(track(name, seed, count, calibrated))
    write_index(root / "tracks", write_shard(root / "tracks", 0, tracks), sigma_px_ref=40.0)
    return {"episodes": root / "episodes", "tracks": root / "tracks"}


@pytest.fixture(scope="session")
def inputs(tmp_path_factory: pytest.TempPathFactory, make_contract: Callable, make_spec: Callable) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("rollout")
    write_recordings(root, [(name, "test" if seed else "train", N, VIEWS, VIEWS) for seed, name in enumerate(NAMES)])
    torch.manual_seed(0)
    video = torch.from_numpy(np.stack([recorded(s) for s in range(4)])).permute(0, 4, 1, 2, 3).float() / 127.5 - 1
    tokenizer = fit_patch_tokenizer([video], channels=8, refinement_width=4, refinement_depth=1)
    tokenizer.save(root / "tokenizer")
    config = WorldModelConfig(
        latent_channels=8, hidden_size=24, num_layers=1, num_heads=2, num_kv_heads=1, head_dim=12, intermediate_size=32,
        rope_sections=(2, 2, 2), towers="generation",
    )  # fmt: skip
    generator = torch.Generator().manual_seed(0)
    model = WorldModel(config)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=generator) * 0.2)
    contract = make_contract(grid_size=(4, 6), tokenizer=tokenizer.encoder_digest[:16])
    save_checkpoint(root / "stage2", model, kind="stage2", action_contract=contract)
    save_checkpoint(root / "causal", model, kind="causal", action_contract=contract, causal=SPEC)
    small = make_spec(recent_blocks=1, sigmas=(1.0, 0.5, 0.0))
    save_checkpoint(root / "small_blocks", model, kind="causal", action_contract=contract, causal=small)
    torch.manual_seed(1)
    both = WorldModel(config.model_copy(update={"towers": "both", "vocab_size": 300}))
    torch.nn.init.normal_(both.proj_out.weight, std=0.2)
    facts = {"tokenizer": tokenizer.encoder_digest[:16], "text": {"kind": "bytes", "max_length": 48, "path": None}}
    save_checkpoint(root / "base", both, kind="base", action_contract=None, metadata=facts)
    save_checkpoint(root / "silent", both, kind="base", action_contract=None)
    save_checkpoint(root / "foreign", both, kind="base", action_contract=None, metadata=facts | {"tokenizer": "0123"})
    vectors = NativeVectors(embodiments=("aloha_viperx", "ur5e_pair"), share=1.0)
    for name, takes, kind in (
        ("film", "vectors", "stage2"),
        ("either", "either", "stage2"),
        ("either_causal", "either", "causal"),
    ):
        driven = contract if takes == "either" else contract.model_copy(update={"sigma_px_ref": None})
        update = {"action_conditioning": takes, "native_size": 14}
        film = WorldModel(config.model_copy(update=update))
        film.load_state_dict(
            {key: value for key, value in model.state_dict().items() if takes == "either" or "action_" not in key},
            strict=False,
        )
        torch.nn.init.normal_(film.action_film.proj[0].weight, generator=torch.Generator().manual_seed(2))
        save_checkpoint(
            root / name,
            film,
            kind=kind,
            action_contract=driven,
            vectors=vectors,
            causal=SPEC if kind == "causal" else None,
        )
    return {
        "episodes": root / "episodes",
        "tracks": root / "tracks",
        "tokenizer": root / "tokenizer",
        "checkpoint": root / "causal",
    }


def digests(root: Path) -> dict[str, str]:
    return {
        str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(root.rglob("*"))
        if path.is_file() and "run" not in path.relative_to(root).parts
    }
