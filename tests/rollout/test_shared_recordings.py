"""An AgiBot recording of a minute through rollout, video metrics and policy rules, with small models of random weights."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from worldline_core.actions.actions_config import RenderActionsConfig
from worldline_core.actions.render_actions import render_actions
from worldline_core.data.curation.curate import curate
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.episodes.episode import VIEWS, Episode
from worldline_core.data.episodes.episode_set import EpisodeSet, EpisodeSetWriter
from worldline_core.model.checkpoint import save_checkpoint
from worldline_core.model.tokenizers import fit_patch_tokenizer, frames_to_video
from worldline_core.model.world_model_config import CAUSAL_SIGMAS, CausalSpec
from worldline_core.rollout.rollout_set import RolloutSet

SIZE = (64, 96)
SIGMA_PX_REF = 36.0
RETURNED = {"MALLOC_MMAP_THRESHOLD_": "65536", "MALLOC_TRIM_THRESHOLD_": "65536", "MALLOC_ARENA_MAX": "1"}
"""Lets glibc return freed blocks at once: what it kept, up to 45 MiB as its threshold grew, counted as memory in use."""


def inputs_of(
    root: Path, recordings: Sequence[tuple[Episode, dict[str, np.ndarray]]], fps: float, make_model: Callable, make_contract: Callable
) -> dict[str, str]:  # fmt: skip
    """The recordings as an EpisodeSet with its tracks, and a causal and a Stage II model of random weights for them."""
    with EpisodeSetWriter(root / "episodes") as writer:
        for episode, frames in recordings:
            writer.add(episode, frames)
    config = RenderActionsConfig(source="state", sigma_px_ref=SIGMA_PX_REF, previews=0)  # pyright: ignore[reportCallIssue]
    counts = render_actions(config, {"episodes": root / "episodes"}, root / "tracks")
    assert counts["kept"] == len(recordings)
    clip = frames_to_video(recordings[0][1]["head"][:9])
    tokenizer = fit_patch_tokenizer([clip[None]], channels=8, refinement_width=4, refinement_depth=1)
    tokenizer.save(root / "tokenizer")
    contract = make_contract(
        fps=fps, grid_size=(8, 12), controls="ee_pose", sigma_px_ref=SIGMA_PX_REF,
        tokenizer=tokenizer.encoder_digest[:16],
    )  # fmt: skip
    model = make_model(latent_channels=8, prediction="first_frame_residual")
    spec = CausalSpec(
        block_size=4,
        sink_blocks=1,
        recent_blocks=3,
        anchor_blocks=None,
        sigmas=(CAUSAL_SIGMAS[0], CAUSAL_SIGMAS[3], 0.0),
    )
    save_checkpoint(root / "causal", model, kind="causal", action_contract=contract, causal=spec)
    save_checkpoint(root / "stage2", model, kind="stage2", action_contract=contract)
    return {name: str(root / name) for name in ("episodes", "tracks", "tokenizer", "causal", "stage2")}


def chain(folders: dict[str, str], kind: str, segmenter: Path) -> dict[str, Any]:
    inputs = {name: folders[name] for name in ("episodes", "tracks", "tokenizer")} | {"checkpoint": folders[kind]}
    sampler = {"causal": {"kind": "block_causal"}, "stage2": {"kind": "full_clip", "steps": 1, "clip_frames": 33}}
    config = {"method": "model", "num_frames": "whole", "bfloat16": False, "sampler": sampler[kind]}
    return {"rollout": config, "inputs": inputs, "segmenter": str(segmenter)}


@pytest.fixture(scope="module")
def agibot(shared_data: Path, tmp_path_factory: pytest.TempPathFactory, make_model: Callable, make_contract: Callable) -> Callable[[int], dict[str, str]]:  # fmt: skip
    """Makes an AgiBot recording of some seconds at 30 Hz in three views.

    The sample has 300 poses and 4 pictures of each camera: both are looped there and back.
    """
    root = tmp_path_factory.mktemp("agibot")
    source = {"kind": "agibot_gesim", "path": str(shared_data / "agibot_gesim"), "fps": 30}
    curate(CurateConfig.model_validate({"sources": [source], "image_size": SIZE}), {}, root / "curated")
    curated = EpisodeSet.open(root / "curated")
    episode = curated.episode(0)

    def there_and_back(length: int, count: int) -> np.ndarray:
        place = np.arange(count) % (2 * length - 2)
        return np.where(place < length, place, 2 * length - 2 - place)

    @cache
    def make(seconds: int) -> dict[str, str]:
        count = 30 * seconds
        poses, pictures = there_and_back(episode.num_frames, count), there_and_back(4, count)
        arrays = {name: getattr(episode, name)[poses] for name in ("state", "action", "T_base_ee", "gripper")}
        cameras = {
            view: replace(camera, T_base_camera=camera.poses(poses)) if camera.moving else camera
            for view, camera in episode.cameras.items()
        }
        looped = replace(
            episode, **arrays, cameras=cameras, timestamps=np.arange(count) / 30.0, video_frames=None, split="test",
            outcome="success", instruction="pick up the red cup",
        )  # fmt: skip
        frames = {view: curated.frames(0, view)[pictures] for view in VIEWS}
        return inputs_of(root / str(seconds), [(looped, frames)], 30.0, make_model, make_contract)

    return make


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["causal", "stage2"])
def test_a_minute_goes_through_in_the_memory_of_a_quarter(
    agibot: Callable[[int], dict[str, str]], tmp_path: Path, project_root: Path, kind: str
) -> None:
    """Rollout, video metrics and policy rules of 1800 frames of three views, against those of 450: peak of the process.

    Of its decoded frames alone 1350 more would take 71 MiB, as floating-point pictures 285 MiB.
    """
    peaks: list[float] = []
    segmenter = project_root / "artifacts" / "shipped" / "models" / "segmenter"
    for seconds in (15, 60):
        output = tmp_path / str(seconds)
        given = tmp_path / f"{seconds}.json"
        given.write_text(json.dumps(chain(agibot(seconds), kind, segmenter)))
        command = [sys.executable, str(Path(__file__).with_name("run_chain.py")), str(output), str(given)]
        done = subprocess.run(
            command, check=False, capture_output=True, text=True, cwd=project_root, env=os.environ | RETURNED
        )
        assert done.returncode == 0, done.stderr
        peaks.append(float(done.stdout.split()[-1]))
        rollouts = RolloutSet.open(output / "rollout")
        assert {row.view: row.num_frames for row in rollouts.rows} == dict.fromkeys(VIEWS, 30 * seconds)
        decisions = pq.read_table(output / "policy" / "decisions.parquet").to_pylist()
        assert sorted(row["method"] for row in decisions) == ["model", "true"]
        by_frame = pq.read_table(output / "video" / "by_frame.parquet").to_pylist()
        assert max(row["frame"] for row in by_frame) == 30 * seconds - 1
    print(f"{kind}: {peaks[0]:.0f} MiB for 15 s, {peaks[1]:.0f} MiB for 60 s")
    assert peaks[1] - peaks[0] < 15, peaks  # 2 when measured
