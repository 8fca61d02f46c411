"""Training on recordings that have different views: batches of one set of views, and a checkpoint that says what it saw."""

from __future__ import annotations

import dataclasses
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.rollout.conftest import SIZE, recorded, write_recordings
from worldline_core.actions.episode_tracks import ActionTracks
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.errors import ConfigError
from worldline_core.model.checkpoint import load_checkpoint, read_checkpoint_info, save_checkpoint
from worldline_core.model.tokenizers import fit_patch_tokenizer
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import TrainedClips, WorldModelConfig
from worldline_core.rollout.rollout import rollout
from worldline_core.rollout.rollout_config import FullClipConfig, RolloutConfig
from worldline_core.rollout.rollout_set import RolloutSet
from worldline_core.training.clip_config import ClipSampling, EncodeLatentsConfig
from worldline_core.training.clip_loader import Batch, ClipLoader
from worldline_core.training.clip_sampler import Clip, ClipBatch, ClipRow, ClipSampler
from worldline_core.training.clip_source import LatentStore
from worldline_core.training.encode_latents import encode_latents
from worldline_core.training.flow_matching import FlowMatchingObjective
from worldline_core.training.stage2 import train_stage2
from worldline_core.training.training_config import Stage2Config

HEAD, RIGHT = ("head",), ("head", "right_wrist")
EPISODES = tuple(
    (f"{name}-{number}", "train", 17, views, views)
    for name, views in (("three", VIEWS), ("two", RIGHT), ("one", HEAD))
    for number in range(2)
)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Recordings of three sets of views, their latents, and a base model of random weights."""
    root = tmp_path_factory.mktemp("optional")
    made = write_recordings(root, EPISODES)
    torch.manual_seed(0)
    video = torch.stack([torch.from_numpy(recorded(s)) for s in range(4)]).permute(0, 4, 1, 2, 3).float() / 127.5 - 1
    fit_patch_tokenizer([video], channels=8, refinement_width=4, refinement_depth=1).save(root / "tokenizer")
    model = WorldModel(
        WorldModelConfig(
            latent_channels=8, hidden_size=24, num_layers=1, num_heads=2, num_kv_heads=1, head_dim=12,
            intermediate_size=32, rope_sections=(2, 2, 2), vocab_size=16,
        )
    )  # fmt: skip
    model.initialise(torch.Generator().manual_seed(0))
    save_checkpoint(root / "base", model, kind="base", action_contract=None)
    counts = encode_latents(
        EncodeLatentsConfig(image_size=SIZE), {**made, "tokenizer": root / "tokenizer"}, root / "latents"
    )
    assert (counts["kept"], counts["left_out"]) == (6, {})
    return {**made, "tokenizer": root / "tokenizer", "latents": root / "latents", "stage1": root / "base"}


def stage2(**changes: Any) -> Stage2Config:
    values: dict[str, Any] = {
        "trainer": {"steps": 12, "batch_size": 2, "log_every": 1, "ema_decay": 0.9},
        "clips": {"lengths": [9, 17]},
        "relational": None,
    }
    return Stage2Config.model_validate(values | changes)


def rows(store: LatentStore) -> list[ClipRow]:
    return [dataclasses.replace(row, source=row.episode_id.split("-", maxsplit=1)[0]) for row in store.rows]


def test_batches_hold_clips_of_one_set_of_views(inputs: dict[str, Path]) -> None:
    store = LatentStore.open(inputs["latents"])
    config = ClipSampling(lengths=(9,))
    sampler = ClipSampler(rows(store), config, views=VIEWS, splits=["train"], start_step=4, batch_size=2, seed=3)
    drawn: Counter[str] = Counter()
    for index in range(600):
        batch = sampler.clips(index)
        assert {store.row(clip.episode_id).views for clip in batch.clips} == {batch.views}
        assert sampler.replacement(index, 0, 0).episode_id[:3] == batch.clips[0].episode_id[:3]
        drawn.update(clip.episode_id for clip in batch.clips)
    # Grouping changes nothing of how often an episode is drawn.
    assert min(drawn.values()) > 0.7 * 1200 / 6
    assert set(sampler.view_sets(VIEWS)) == {VIEWS, RIGHT, HEAD}
    weighted = config.model_copy(update={"source_weights": {"three": 0.0}})
    sampler = ClipSampler(rows(store), weighted, views=VIEWS, splits=["train"], start_step=4, batch_size=2, seed=3)
    assert sampler.trained(VIEWS) == TrainedClips(view_sets=(HEAD, RIGHT), strides=(1,))
    whole = ClipSampler(
        [row for row in rows(store) if row.source == "three"], ClipSampling(lengths=(9,)), views=VIEWS, splits=["train"],
        start_step=4, batch_size=2, seed=3,
    )  # fmt: skip
    assert whole.trained(VIEWS) is None


def test_single_views_are_drawn_where_they_are(inputs: dict[str, Path]) -> None:
    store = LatentStore.open(inputs["latents"])
    config = ClipSampling(lengths=(9,), view_weights={"joint": 0.4, "left_wrist": 0.6})
    sampler = ClipSampler(store.rows, config, views=VIEWS, splits=["train"], start_step=4, batch_size=2, seed=3)
    batches = [sampler.clips(index) for index in range(200)]
    assert {batch.views for batch in batches} == {VIEWS, RIGHT, HEAD, ("left_wrist",)}
    for batch in batches:
        assert all(set(batch.views) <= set(store.row(clip.episode_id).views) for clip in batch.clips)
    assert config.shown_views(VIEWS) == ClipSampling().shown_views(VIEWS) == VIEWS
    assert ClipSampling(view_weights={"head": 1.0, "joint": 0.0}).shown_views(VIEWS) == HEAD


def test_subsets_are_drawn_for_a_share_of_the_steps_and_known_by_it(inputs: dict[str, Path]) -> None:
    store = LatentStore.open(inputs["latents"])
    three = [row for row in store.rows if row.views == VIEWS]

    def sampler(share: float, rows: list[Any] = three) -> ClipSampler:
        config = ClipSampling(lengths=(9,), view_weights={"joint": 1 - share, "subset": share})
        return ClipSampler(rows, config, views=VIEWS, splits=["train"], start_step=4, batch_size=2, seed=3)

    drawn = Counter(sampler(0.3).clips(index).views for index in range(600))
    assert set(drawn) == {VIEWS, HEAD, RIGHT, ("head", "left_wrist")}
    assert all(0.06 < drawn[views] / 600 < 0.14 for views in drawn if views != VIEWS)
    assert set(sampler(0.3).trained(VIEWS).view_sets) == set(drawn)  # type: ignore[union-attr]
    assert sampler(0.02).trained(VIEWS) is None  # a set that fewer than 1 % of the steps show is not known
    one = sampler(0.3, [row for row in store.rows if row.views == HEAD])
    assert {one.clips(index).views for index in range(20)} == {HEAD}


def test_a_clip_is_trained_in_a_batch_as_it_would_be_alone(inputs: dict[str, Path]) -> None:
    store, tracks = LatentStore.open(inputs["latents"]), ActionTracks.open(inputs["tracks"])
    loader = ClipLoader(store, views=VIEWS, tracks=tracks)
    model = load_checkpoint(inputs["stage1"], towers="generation")[0].eval()
    with torch.no_grad():
        for parameter in model.parameters():  # what starts at zero would hide the controls
            parameter.add_(0.1 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(1)))
    for name, views in (("three", VIEWS), ("two", RIGHT), ("one", HEAD)):
        clips = tuple(Clip(f"{name}-{number}", 4, 9, 1) for number in range(2))
        together = loader.load(ClipBatch(clips, views))
        velocity = model(
            together.latents, torch.full((2,), 0.5), action_maps=together.action_maps, views=together.views
        )
        for number, clip in enumerate(clips):
            alone = loader.load(ClipBatch((clip,), views))
            assert torch.equal(alone.latents[0], together.latents[number])
            assert torch.equal(alone.action_maps[0], together.action_maps[number])
            own = model(alone.latents, torch.full((1,), 0.5), action_maps=alone.action_maps, views=alone.views)
            torch.testing.assert_close(own.velocity[0], velocity.velocity[number], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("kind", ["latents", "frames"])
def test_stage2_trains_on_every_set_of_views(
    inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    seen: list[Batch] = []
    loss = FlowMatchingObjective.loss

    def watched(objective: FlowMatchingObjective, batch: Batch, *rest: Any) -> Any:
        seen.append(batch)
        return loss(objective, batch, *rest)

    monkeypatch.setattr(FlowMatchingObjective, "loss", watched)
    source = {"kind": kind} | ({"image_size": SIZE} if kind == "frames" else {})
    counts = train_stage2(stage2(input=source), inputs, tmp_path / "out")
    assert counts["steps"] == 12
    assert {batch.views for batch in seen} == {VIEWS, RIGHT, HEAD}
    for batch in seen:
        assert batch.latents.shape[1] == len(batch.views)
        assert batch.action_maps.shape[1] == len(batch.views)
    assert read_checkpoint_info(tmp_path / "out").view_sets == (VIEWS, RIGHT, HEAD)
    again = train_stage2(stage2(input=source), inputs, tmp_path / "again")
    assert again == counts


def test_a_model_of_the_head_alone_trains_on_any_recording_and_rolls_out_the_head(
    inputs: dict[str, Path], tmp_path: Path
) -> None:
    clips = {"lengths": [9, 17], "view_weights": {"head": 1.0}}
    frames = {"kind": "frames", "image_size": SIZE}
    train_stage2(stage2(clips=clips, input=frames), inputs, tmp_path / "model")
    info = read_checkpoint_info(tmp_path / "model")
    assert info.trained == TrainedClips(view_sets=(HEAD,), strides=(1,))
    config = RolloutConfig(sampler=FullClipConfig(steps=1), splits=("train",), num_frames=17)
    summary = rollout(config, inputs | {"checkpoint": tmp_path / "model"}, tmp_path / "out")
    assert summary["predictions"] == 6
    assert {row.view for row in RolloutSet.open(tmp_path / "out").rows} == {"head"}


def test_a_view_that_is_no_slot_of_the_model_is_refused() -> None:
    with pytest.raises(ConfigError, match="Unknown or repeated view"):
        WorldModel(WorldModelConfig(view_offsets=(0.0, 8.0), views=RIGHT))(
            torch.zeros(1, 1, 32, 2, 4, 6), torch.ones(1), views=("left_wrist",)
        )
