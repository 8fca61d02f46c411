"""Recordings of a moving square, their action tracks, and small models of random weights."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.training.conftest import build_episode, build_tracks, cameras_of
from worldline_core import Camera, WorldLine
from worldline_core.actions.episode_tracks import write_index, write_shard
from worldline_core.data.episodes.episode import VIEWS, Episode
from worldline_core.data.episodes.episode_set import EpisodeSet, EpisodeSetWriter
from worldline_core.model.checkpoint import save_checkpoint
from worldline_core.model.networks import build_world_model
from worldline_core.model.tokenizers import fit_patch_tokenizer
from worldline_core.model.world_model_config import CAUSAL_SIGMAS, CausalSpec, MixtureConfig, NativeVectors
from worldline_core.rollout.rollout import rollout
from worldline_core.rollout.rollout_set import RolloutSet
from worldline_core.training.clip_config import EncodeLatentsConfig
from worldline_core.training.encode_latents import encode_latents

SIZE = (32, 48)
SPEC = CausalSpec(block_size=4, sink_blocks=1, recent_blocks=1, anchor_blocks=None, sigmas=CAUSAL_SIGMAS)
N = 33
NAMES = {"a-0": "ur5e_pair", "a-1": "ur5e_pair", "b/0 x": "aloha_viperx", "b-1": "aloha_viperx", "b-2": "aloha_viperx"}


def recorded(seed, count=N):
    generator = np.random.default_rng(seed)
    frames = np.repeat(generator.integers(60, 190, (1, 4, 6, 3)).repeat(8, 1).repeat(8, 2), count, axis=0)
    for frame in range(count):
        left = frame if frame < N else frame % 38
        frames[frame, 8:20, left : left + 10] = (220, 40, 40)
    return frames.astype(np.uint8)


def track(name, shift, count=N, views=VIEWS):
    """Tracks of ``count`` frames, with cameras of ``views``."""
    uv = np.full((count, 3, 2, 2), 14, np.float32)
    uv[..., 0] = np.linspace(5, 40, count)[:, None, None] + shift
    motion = zip(VIEWS, ("static", "kinematics", "kinematics"), strict=True)
    valid = np.ones((count, 3, 2), bool)
    valid[:, [view not in views for view in VIEWS]] = False
    return build_tracks(
        name, count, arms=2, embodiment=NAMES.get(name, "ur5e_pair"), image_size=SIZE, uv=uv, valid=valid,
        camera_motion=tuple(kind if view in views else "absent" for view, kind in motion),
        rot6d=np.ones((count, 3, 2, 6), np.float32),
    )  # fmt: skip


def write_recordings(root, episodes, joints_of=14, frames=None):
    """An EpisodeSet and its tracks.

    Args:
        episodes: (id, split, frames, views with a video, views with a camera).
        joints_of: numbers of a state.
        frames: makes the frames of an episode and a view; by default those of its number, in every view.
    """
    K = [[40.0, 0.0, 24.0], [0.0, 40.0, 16.0], [0.0, 0.0, 1.0]]
    tracks = []
    with EpisodeSetWriter(root / "episodes") as writer:
        for seed, (name, split, count, views, calibrated) in enumerate(episodes):
            joints = np.linspace(np.zeros(joints_of), np.full(joints_of, seed), count, dtype=np.float32)
            episode = build_episode(
                name, joints, embodiment=NAMES.get(name, "ur5e_pair"), outcome="success" if seed % 2 else "failure",
                split=split, cameras=cameras_of(K, SIZE, calibrated),
            )  # fmt: skip
            writer.add(episode, {view: frames(name, view) if frames else recorded(seed, count) for view in views})
            tracks.append(track(name, seed, count, calibrated))
    write_index(root / "tracks", write_shard(root / "tracks", 0, tracks), sigma_px_ref=40.0)
    return {"episodes": root / "episodes", "tracks": root / "tracks"}


def fit_tokenizer(folder):
    torch.manual_seed(0)
    video = torch.from_numpy(np.stack([recorded(s) for s in range(4)])).permute(0, 4, 1, 2, 3).float() / 127.5 - 1
    tokenizer = fit_patch_tokenizer([video], channels=8, refinement_width=4, refinement_depth=1)
    tokenizer.save(folder)
    return tokenizer


MODEL = MixtureConfig(
    latent_channels=8, hidden_size=24, num_layers=1, num_heads=2, num_kv_heads=1, head_dim=12, intermediate_size=32,
    rope_sections=(2, 2, 2), towers="generation",
)  # fmt: skip


def small_model(**changes):
    """A model as training begins, with both towers where it has a vocabulary."""
    towers = {"towers": "both"} if "vocab_size" in changes else {}
    model = build_world_model(MODEL.model_copy(update=towers | changes))
    model.initialise(torch.Generator().manual_seed(0))
    return model


def mixed_views(root, splits):
    """Two recordings each of three views, of two and of the head alone, with their latents; what encoding counted."""
    views = {"three": VIEWS, "two": ("head", "right_wrist"), "one": ("head",)}
    episodes = [
        (f"{name}-{number}", splits[name], 17, views[name], views[name]) for name in views for number in range(2)
    ]
    made = {**write_recordings(root, episodes), "tokenizer": root / "tokenizer"}
    fit_tokenizer(root / "tokenizer")
    counts = encode_latents(EncodeLatentsConfig(image_size=SIZE), made, root / "latents")
    return {**made, "latents": root / "latents"}, counts


@pytest.fixture(scope="session")
def inputs(tmp_path_factory, make_contract, make_spec):
    root = tmp_path_factory.mktemp("rollout")
    write_recordings(root, [(name, "test" if seed else "train", N, VIEWS, VIEWS) for seed, name in enumerate(NAMES)])
    digest = fit_tokenizer(root / "tokenizer").encoder_digest[:16]
    generator = torch.Generator().manual_seed(0)
    model = build_world_model(MODEL)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=generator) * 0.2)
    contract = make_contract(grid_size=(4, 6), tokenizer=digest)

    def save(name, kind, model=model, **given):
        causal = SPEC if kind == "causal" else None
        save_checkpoint(root / name, model, kind=kind, **{"action_contract": contract, "causal": causal, **given})

    save("stage2", "stage2")
    save("causal", "causal")
    save("small_blocks", "causal", causal=make_spec(recent_blocks=1, sigmas=(1.0, 0.5, 0.0)))
    torch.manual_seed(1)
    both = build_world_model(MODEL.model_copy(update={"towers": "both", "vocab_size": 300}))
    torch.nn.init.normal_(both.proj_out.weight, std=0.2)
    facts = {"tokenizer": digest, "text": {"kind": "bytes", "max_length": 48, "path": None}}
    for name, said in (("base", facts), ("silent", None), ("foreign", facts | {"tokenizer": "0123"})):
        save(name, "base", both, action_contract=None, metadata=said)
    vectors = NativeVectors(embodiments=("aloha_viperx", "ur5e_pair"), share=1.0)
    undrawn = contract.model_copy(update={"sigma_px_ref": None})
    for name, takes, kind in (
        ("film", "vectors", "stage2"),
        ("either", "either", "stage2"),
        ("either_causal", "either", "causal"),
    ):
        film = build_world_model(MODEL.model_copy(update={"action_conditioning": takes, "native_size": 14}))
        shared = {key: value for key, value in model.state_dict().items() if takes == "either" or "action_" not in key}
        film.load_state_dict(shared, strict=False)
        torch.nn.init.normal_(film.action_film.proj[0].weight, generator=torch.Generator().manual_seed(2))
        save(name, kind, film, action_contract=contract if takes == "either" else undrawn, vectors=vectors)
    folders = {name: root / name for name in ("episodes", "tracks", "tokenizer")}
    return folders | {"checkpoint": root / "causal"}


def rolled(config, inputs, output, **changes):
    """The set of a rollout, and what it counted."""
    summary = rollout(config.model_copy(update=changes), inputs, output)
    return RolloutSet.open(output), summary


@pytest.fixture(scope="session")
def shipped(project_root):
    return project_root / "artifacts" / "shipped"


@pytest.fixture(scope="session")
def small_world(shipped, make_model):
    """A causal model of random weights with the shipped tokenizer: blocks of one latent frame (four pictures), one Euler step."""
    given = WorldLine.from_pretrained(shipped / "models" / "causal")
    model = make_model(latent_channels=32, num_layers=1)
    spec = CausalSpec(block_size=1, sink_blocks=1, recent_blocks=2, anchor_blocks=None, sigmas=(1.0, 0.0))
    return WorldLine(model, given.info.model_copy(update={"config": model.config, "causal": spec}), given.tokenizer)


ROBOT = "ur5e_silver"


@dataclass
class HeldOut:
    """A held-out recording, as a user would have it at hand: pictures, cameras at the first frame, and commands."""

    root: Path
    episode: Episode
    frames: dict[str, np.ndarray]
    cameras: dict[str, Camera]
    controls: np.ndarray

    @property
    def images(self):
        return {view: video[0] for view, video in self.frames.items()}

    def begin(self, world, **options):
        usual = {"embodiment": ROBOT, "state": self.controls[0], "limits": False}
        return world.start(self.images, self.cameras, **usual | options)

    def held(self, columns):
        """Sixteen rows of the first command, with other values in some columns."""
        rows = np.repeat(self.controls[:1], 16, axis=0)
        rows[:, list(columns)] = list(columns.values())
        return rows


@pytest.fixture(scope="session")
def held_out(shipped):
    """Two recordings of a UR5e pair."""
    recordings = EpisodeSet.open(shipped / "recordings")
    found = [i for i, row in enumerate(recordings.rows) if row.embodiment == ROBOT and row.split == "test"]
    return [
        HeldOut(
            recordings.root, episode, {view: recordings.frames(position, view, list(range(17))) for view in VIEWS},
            {view: Camera(camera.K, camera.T_base_camera[0]) for view, camera in episode.cameras.items()},
            episode.action[:33].astype(np.float64),
        )
        for position, episode in [(position, recordings.episode(position)) for position in found[:2]]
    ]  # fmt: skip
