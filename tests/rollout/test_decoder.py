"""Rollouts that a small decoder shows instead of the tokenizer's own."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from worldline_core.errors import CheckpointError
from worldline_core.model.small_decoder import SmallDecoder, SmallDecoderConfig
from worldline_core.model.tokenizers import load_tokenizer, tokenizer_fingerprint
from worldline_core.rollout.rollout import rollout
from worldline_core.rollout.rollout_config import BlockCausalConfig, FullClipConfig, RolloutConfig, TextToVideoConfig
from worldline_core.store.artifact_files import digest_folder
from worldline_core.store.store import ArtifactStore

CONFIG = RolloutConfig(method="causal", batch_size=2)


def test_a_small_decoder_shows_the_same_latents_otherwise(inputs: dict[str, Path], tmp_path: Path) -> None:
    rollout(CONFIG, inputs, tmp_path / "without")
    tokenizer = load_tokenizer(inputs["tokenizer"])
    torch.manual_seed(0)
    for name, folder in ((tokenizer_fingerprint(tokenizer, inputs["tokenizer"]), "own"), ("0123", "foreign")):
        SmallDecoder(SmallDecoderConfig.of(tokenizer, name, width=4, depth=1), tokenizer).save(tmp_path / folder)
    own = tmp_path / "own"
    config = CONFIG.model_copy(update={"sampler": BlockCausalConfig(decoder=own)})
    assert rollout(config, inputs, tmp_path / "rollout")["predictions"] == 4
    assert digest_folder(tmp_path / "rollout") != digest_folder(tmp_path / "without")
    whole = CONFIG.model_copy(update={"sampler": FullClipConfig(steps=1, decoder=own)})
    stage2 = {**inputs, "checkpoint": inputs["checkpoint"].parent / "stage2"}
    rollout(whole, stage2, tmp_path / "stage2")
    text = {**inputs, "checkpoint": inputs["checkpoint"].parent / "base"}
    captioned = CONFIG.model_copy(update={"sampler": TextToVideoConfig(steps=1, decoder=own)})
    rollout(captioned, text, tmp_path / "text")
    for sampler, given in ((BlockCausalConfig, inputs), (TextToVideoConfig, text)):
        foreign = CONFIG.model_copy(update={"sampler": sampler(decoder=tmp_path / "foreign")})
        with pytest.raises(CheckpointError, match="trained for another tokenizer"):
            rollout(foreign, given, tmp_path / "refused")
        assert not (tmp_path / "refused").exists()
    # Its content is part of the key of a rollout.
    store = ArtifactStore(tmp_path / "store")
    keys = {store.key("rollout", 2, each, {}) for each in (CONFIG, config)}
    weights = own / "decoder.safetensors"
    weights.write_bytes(weights.read_bytes() + b" ")
    assert len({*keys, store.key("rollout", 2, config, {})}) == 3
