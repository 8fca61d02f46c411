"""Rollouts that a small decoder shows instead of the tokenizer's own."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from pydantic import ValidationError

from worldline_core.errors import CheckpointError
from worldline_core.model.small_decoder import SmallDecoder, SmallDecoderConfig
from worldline_core.model.tokenizers import load_tokenizer, tokenizer_fingerprint
from worldline_core.rollout.rollout import rollout
from worldline_core.rollout.rollout_config import RolloutConfig
from worldline_core.store.artifact_files import digest_folder
from worldline_core.store.store import ArtifactStore

CONFIG = RolloutConfig(method="causal", batch_size=2)


def test_a_small_decoder_shows_the_same_latents_otherwise(inputs: dict[str, Path], tmp_path: Path) -> None:
    rollout(CONFIG, inputs, tmp_path / "without")
    tokenizer = load_tokenizer(inputs["tokenizer"])
    torch.manual_seed(0)
    for name, folder in ((tokenizer_fingerprint(tokenizer, inputs["tokenizer"]), "own"), ("0123", "foreign")):
        SmallDecoder(SmallDecoderConfig.of(tokenizer, name, width=4, depth=1)).save(tmp_path / folder)
    config = CONFIG.model_copy(update={"decoder": tmp_path / "own"})
    assert rollout(config, inputs, tmp_path / "rollout")["predictions"] == 4
    assert digest_folder(tmp_path / "rollout") != digest_folder(tmp_path / "without")
    whole = config.model_copy(update={"sampler": "full_clip", "steps": 1})
    stage2 = {**inputs, "checkpoint": inputs["checkpoint"].parent / "stage2"}
    rollout(whole, stage2, tmp_path / "stage2")
    text = {**inputs, "checkpoint": inputs["checkpoint"].parent / "base"}
    rollout(whole.model_copy(update={"sampler": "text_to_video"}), text, tmp_path / "text")
    for sampler, given in (("block_causal", inputs), ("text_to_video", text)):
        foreign = config.model_copy(update={"decoder": tmp_path / "foreign", "sampler": sampler})
        with pytest.raises(CheckpointError, match="trained for another tokenizer"):
            rollout(foreign, given, tmp_path / f"foreign_{sampler}")
        assert not (tmp_path / f"foreign_{sampler}").exists()
    with pytest.raises(ValidationError, match="has no latents to decode"):
        RolloutConfig(sampler="copy_first_frame", decoder=tmp_path / "own")
    # Its content is part of the key of a rollout; without it, keys are what they were.
    store = ArtifactStore(tmp_path / "store")
    keys = {store.key("rollout", 2, each, {}) for each in (CONFIG, config)}
    weights = tmp_path / "own" / "decoder.safetensors"
    weights.write_bytes(weights.read_bytes() + b" ")
    assert len({*keys, store.key("rollout", 2, config, {})}) == 3
    assert "decoder" not in CONFIG.model_dump()
