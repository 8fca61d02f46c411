"""Distillation from frames that are encoded on the way: the same as from cached latents, and each clip encoded no more
often than the teacher sees it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from flows.pipeline import chain
from tasks.execution.chain import outline
from tests.distillation.conftest import EPISODES, FRAMES, IMAGE, SIGMA, VIEWS, tracks_of  # pyright: ignore[reportMissingImports]
from tests.distillation.test_distill import config  # pyright: ignore[reportMissingImports]
from worldline_core.actions.episode_tracks import write_index, write_shard
from worldline_core.config import load_config
from worldline_core.data.episodes.episode import CameraTrack, Episode
from worldline_core.data.episodes.episode_set import EpisodeSetWriter
from worldline_core.distillation.distill import distill
from worldline_core.distillation.distill_config import DistillConfig
from worldline_core.errors import ConfigError, DataError
from worldline_core.model.checkpoint import load_checkpoint, read_checkpoint_info, save_checkpoint
from worldline_core.model.tokenizers import PatchTokenizer, PatchTokenizerConfig
from worldline_core.pipeline.pipeline_config import PipelineConfig
from worldline_core.training.clip_config import EncodeLatentsConfig
from worldline_core.training.clip_source import FrameSource
from worldline_core.training.encode_latents import encode_latents

FRAME_INPUT = {"kind": "frames", "image_size": list(IMAGE), "start_step": 4}


@pytest.fixture
def recorded(tmp_path: Path, make_model: Callable, make_contract: Callable) -> dict[str, Path]:
    """Recordings, a tokenizer, cached latents, tracks and a Stage II model of them."""
    names = ("episodes", "tokenizer", "latents", "tracks", "stage2")
    folders = {name: tmp_path / "in" / name for name in names}
    K, random = np.array([[20.0, 0, 15.5], [0, 20.0, 15.5], [0, 0, 1.0]]), np.random.default_rng(0)
    with EpisodeSetWriter(folders["episodes"]) as writer:
        for name, split in EPISODES.items():
            blocks = random.integers(30, 220, (FRAMES, 4, 4, 3)).repeat(8, 1).repeat(8, 2)
            state = np.linspace([0, 0], [1, 1], FRAMES, dtype=np.float32)
            episode = Episode(
                episode_id=name, source="synthetic", embodiment="test", scene=name, task_family="lift", instruction="",
                outcome="success", split=split, fps=8.0, state=state, action=state, timestamps=np.arange(FRAMES) / 8.0,
                cameras={view: CameraTrack(view, K, np.eye(4)[None], *IMAGE[::-1]) for view in VIEWS},
            )  # fmt: skip
            writer.add(episode, dict.fromkeys(VIEWS, blocks.astype(np.uint8)))
    generator = torch.Generator().manual_seed(5)
    tokenizer = PatchTokenizer(PatchTokenizerConfig(static_channels=3, motion_channels=1))
    for basis in (tokenizer.static_basis, tokenizer.motion_basis):
        basis.copy_(torch.linalg.qr(torch.randn(basis.shape[1], basis.shape[0], generator=generator))[0].T)
    folders["tokenizer"].mkdir(parents=True)
    tokenizer.save(folders["tokenizer"])
    encode_latents(EncodeLatentsConfig(image_size=IMAGE), folders, folders["latents"])
    description = json.loads((folders["latents"] / "store.json").read_text())
    folders["tracks"].mkdir()
    shard = write_shard(folders["tracks"], 0, [tracks_of(name) for name in EPISODES])
    write_index(folders["tracks"], shard, sigma_px_ref=SIGMA)
    contract = make_contract(sigma_px_ref=SIGMA, tokenizer=description["tokenizer"])
    save_checkpoint(folders["stage2"], make_model(0), kind="stage2", action_contract=contract)
    return folders


def online(**changes: object) -> DistillConfig:
    return DistillConfig.model_validate({**config().model_dump(), "input": {**FRAME_INPUT, **changes}})


@pytest.mark.slow
@pytest.mark.usefixtures("forked_loaders")
def test_frames_on_the_way_are_as_good_as_cached_latents(
    recorded: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    distill(config(), recorded, tmp_path / "cached")
    inputs = {name: folder for name, folder in recorded.items() if name != "latents"}
    encoded: list[int] = []
    inner = FrameSource.latents

    def latents(self: FrameSource, read: torch.Tensor, device: str) -> torch.Tensor:
        encoded.append(len(read))
        return inner(self, read, device)

    monkeypatch.setattr(FrameSource, "latents", latents)
    distill(online(), inputs, tmp_path / "online")
    monkeypatch.undo()
    for step in ("teacher_forcing", "trajectory_regression", "."):
        cached, found = (load_checkpoint(tmp_path / kind / step)[0].state_dict() for kind in ("cached", "online"))
        for name, value in cached.items():
            torch.testing.assert_close(found[name], value, rtol=1e-3, atol=2e-4, msg=f"{step}: {name}")
    # Three steps of teacher forcing, two shards of trajectories, and one held-out batch after each of the three steps.
    assert len(encoded) == 3 + 2 + 3
    info = read_checkpoint_info(tmp_path / "online")
    assert info.metadata["input"]["kind"] == "frames"
    assert "input" not in read_checkpoint_info(tmp_path / "cached").metadata
    distill(online(workers=1), inputs, tmp_path / "ahead")
    weights = [(tmp_path / kind / "model.safetensors").read_bytes() for kind in ("online", "ahead")]
    assert weights[0] == weights[1]


def test_a_clip_that_cannot_be_read_stops_the_run_or_is_counted(recorded: dict[str, Path], tmp_path: Path) -> None:
    inputs = {name: folder for name, folder in recorded.items() if name != "latents"}
    for video in (recorded["episodes"] / "datasets").rglob("*head*/**/*.mp4"):
        video.write_bytes(video.read_bytes()[:200])
        break
    with pytest.raises(DataError, match=r"(?s)cannot be read.*input\.on_unreadable"):
        distill(online(), inputs, tmp_path / "strict")


def test_latents_are_encoded_before_where_a_step_reads_them_alone(project_root: Path) -> None:
    frames = "{kind: frames, image_size: [64, 96]}"
    overrides = [f"{step}.input={frames}" for step in ("train_stage1", "train_stage2")]
    for last, cached in (([], True), ([f"distill.input={frames}"], False)):
        settings = load_config(PipelineConfig, preset="smoke", overrides=[*overrides, *last])
        calls = outline(chain, settings)
        assert ("encode_latents" in calls) is cached
        assert ("latents" in calls["distill"].inputs) is cached


def test_the_input_that_is_asked_for_must_be_there(recorded: dict[str, Path], tmp_path: Path) -> None:
    inputs = {name: folder for name, folder in recorded.items() if name != "latents"}
    with pytest.raises(ConfigError, match=r"(?s)need the input latents.*--input latents=FOLDER"):
        distill(config(), inputs, tmp_path)
