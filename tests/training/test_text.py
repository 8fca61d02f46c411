"""What the text tower is fed: bytes for the embedded default, the backbone's own chat prompt at full size."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from worldline_core.errors import ConfigError, UnavailableError
from worldline_core.model.text import ClipFacts, Cosmos3Text, load_text_encoder
from worldline_core.model.world_model_config import TextConfig
from worldline_core.rehearsal.outside_models import write_qwen2_tokenizer
from worldline_core.training.clip_loader import Batch, ClipLoader
from worldline_core.training.clip_sampler import Clip, ClipBatch
from worldline_core.training.clip_source import LatentStore
from worldline_core.training.flow_matching import FlowMatchingObjective
from worldline_core.training.stage1 import train_stage1
from worldline_core.training.training_config import Stage1Config

CLIP = ClipFacts(17, 8.0, (32, 32))


def test_stage1_feeds_the_chat_prompt_of_each_clip(
    world: Any, tiny_model: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_qwen2_tokenizer(tmp_path / "tokenizer")
    config = Stage1Config.model_validate(
        {
            "model": tiny_model | {"vocab_size": 1024},
            "text": {"kind": "cosmos3", "path": str(tmp_path / "tokenizer"), "max_length": 200},
            "text_dropout": 0.0,
            "clips": {"lengths": [9], "view_weights": {"primary": 1}},
            "trainer": {"steps": 2, "batch_size": 2, "validation_batches": 0},
        }
    )
    seen: list[Batch] = []
    inner = FlowMatchingObjective.loss

    def loss(self: FlowMatchingObjective, batch: Batch, generator: torch.Generator, step: int) -> Any:
        seen.append(batch)
        return inner(self, batch, generator, step)

    monkeypatch.setattr(FlowMatchingObjective, "loss", loss)
    train_stage1(config, world.inputs, tmp_path / "out")
    text = Cosmos3Text(tmp_path / "tokenizer")
    assert len(seen) == 2
    for batch in seen:
        for clip, ids, mask in zip(batch.clips, batch.text_ids, batch.text_mask, strict=True):
            instruction = f"move {int(clip.episode_id.removeprefix('episode-'))}"
            # 9 frames at 8 a second; the synthetic pictures are 32 pixels high and wide.
            assert ids[mask].tolist() == text.ids(instruction, ClipFacts(9, 8.0, (32, 32)))


def test_a_stride_slows_the_frames_that_the_prompt_names(world: Any) -> None:
    asked: list[ClipFacts] = []

    def record(texts: list[str], clips: list[ClipFacts]) -> tuple[torch.Tensor, torch.Tensor]:
        asked.extend(clips)
        return torch.ones(len(texts), 1, dtype=torch.long), torch.ones(len(texts), 1, dtype=torch.bool)

    store = LatentStore.open(world.latents)
    loader = ClipLoader(store, views=("head",), text=record, frame_rates={"episode-000": 8.0})
    assert loader.clip_facts(Clip("episode-000", 0, 9, 2)) == ClipFacts(9, 4.0, (32, 32))
    batch = loader.load(ClipBatch((Clip("episode-000", 0, 9, 1),), ("head",)))
    assert batch.fps.tolist() == [8.0]
    assert asked == [ClipFacts(9, 8.0, (32, 32))]


def test_bytes_are_what_the_shipped_checkpoints_were_trained_on() -> None:
    ids, mask = load_text_encoder(TextConfig(max_length=6), 300)([" Lift ", "put it down"], [CLIP, CLIP])
    # Bytes of "lift" and "put i" are shifted by two, 1 ends a text, 0 pads.
    assert ids.tolist() == [[110, 107, 104, 118, 1, 0], [114, 119, 118, 34, 107, 1]]
    assert mask.tolist() == [[True] * 5 + [False], [True] * 6]


def test_text_that_does_not_fit_the_model_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="vocabulary is too small"):
        load_text_encoder(TextConfig(), 100)
    with pytest.raises(UnavailableError, match="text tokenizer is not here"):
        load_text_encoder(TextConfig(kind="cosmos3", path=str(tmp_path / "none")), 151_936)
    with pytest.raises(ConfigError, match="needs a folder"):
        load_text_encoder(TextConfig(kind="cosmos3"), 300)
    write_qwen2_tokenizer(tmp_path)
    with pytest.raises(ConfigError, match="vocabulary is too small"):
        load_text_encoder(TextConfig(kind="cosmos3", path=str(tmp_path)), 20)
