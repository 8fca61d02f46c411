"""Prompts of the full-size backbone."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from worldline_core.errors import CheckpointError, ConfigError, UnavailableError
from worldline_core.model.text import VISION_START, ClipFacts, Cosmos3Text
from worldline_core.rehearsal.outside_models import write_qwen2_tokenizer

CLIP = ClipFacts(num_frames=129, fps=24.0, image_size=(480, 640))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_qwen2_tokenizer(tmp_path / "tokenizer")
    return tmp_path / "tokenizer"


@pytest.mark.parametrize("system_prompt", [True, False])
def test_ids_are_those_of_diffusers(folder: Path, system_prompt: bool) -> None:
    from diffusers.pipelines.cosmos.pipeline_cosmos3_omni import Cosmos3OmniPipeline

    (folder.parent / "model_index.json").write_text(json.dumps({"default_use_system_prompt": system_prompt}))
    text = Cosmos3Text(folder, system_prompt=system_prompt)
    with pytest.raises(CheckpointError, match="system_prompt"):
        Cosmos3Text(folder, system_prompt=not system_prompt)
    pipeline = SimpleNamespace(
        config=SimpleNamespace(default_use_system_prompt=system_prompt),
        text_tokenizer=text.tokenizer,
        llm_special_tokens={
            "start_of_generation": text.tokenizer.convert_tokens_to_ids(VISION_START),
            "eos_token_id": text.tokenizer.eos_token_id,
        },
        duration_template="The video is {duration:.1f} seconds long and is of {fps:.0f} FPS.",
        inverse_duration_template="",
        image_resolution_template="",
        inverse_image_resolution_template="",
        video_resolution_template="This video is of {height}x{width} resolution.",
        inverse_video_resolution_template="",
    )
    for instruction in ("lift the red cube.", "put it down", ""):
        expected, _ = Cosmos3OmniPipeline.tokenize_prompt(
            pipeline, instruction, num_frames=129, height=480, width=640, fps=24.0
        )
        assert text.ids(instruction, CLIP) == expected


def test_a_long_instruction_loses_its_last_words_and_nothing_else(folder: Path) -> None:
    whole = Cosmos3Text(folder).ids("lift the red cube", CLIP)
    assert Cosmos3Text(folder, max_length=len(whole)).ids("lift the red cube", CLIP) == whole
    shorter = Cosmos3Text(folder, max_length=len(whole) - 1)
    assert shorter.ids("lift the red cube", CLIP) == shorter.ids("lift the red", CLIP)
    with pytest.raises(ConfigError, match="too short for the prompt's frame"):
        Cosmos3Text(folder, max_length=10).ids("lift", CLIP)


def test_missing_or_foreign_tokenizers_are_named(tmp_path: Path) -> None:
    with pytest.raises(UnavailableError, match="text tokenizer is not here"):
        Cosmos3Text(tmp_path / "nothing")
    write_qwen2_tokenizer(tmp_path)
    for path in tmp_path.glob("tokenizer*.json"):
        path.write_text(path.read_text().replace("<|vision_start|>", "<|vision_begin|>"))
    with pytest.raises(CheckpointError, match="Not the tokenizer of a Cosmos3 model"):
        Cosmos3Text(tmp_path)
