"""Prompts of the full-size backbone."""

from __future__ import annotations

from pathlib import Path

import pytest

from worldline_core.errors import CheckpointError, UnavailableError
from worldline_core.model.text import SYSTEM_PROMPT, Cosmos3Text, video_prompt

TEMPLATE = (
    "{% for message in messages %}<|im_start|>{{ message['role'] }}\n{{ message['content'] }}<|im_end|>\n{% endfor %}"
    "{% if add_generation_prompt %}<|im_start|>assistant\n{% endif %}"
)
CLIP = {"num_frames": 129, "fps": 24.0, "image_size": (480, 640)}


def write_tokenizer(folder: Path, *, vision: bool = True) -> None:
    """A word tokenizer with Qwen2's special tokens and chat template."""
    from tokenizers import Tokenizer, models, pre_tokenizers
    from transformers import PreTrainedTokenizerFast

    special = ["<|endoftext|>", "<|im_start|>", "<|im_end|>", *(["<|vision_start|>"] if vision else [])]
    words = f"{SYSTEM_PROMPT} system user assistant lift the red cube put it down .".replace(".", " . ").split()
    vocabulary = {word: index for index, word in enumerate(dict.fromkeys(["[UNK]", *special, *words]))}
    tokenizer = Tokenizer(models.WordLevel(vocabulary, unk_token="[UNK]"))  # noqa: S106 - a token of text
    tokenizer.pre_tokenizer = pre_tokenizers.Whitespace()
    fast = PreTrainedTokenizerFast(
        tokenizer_object=tokenizer,
        unk_token="[UNK]",  # noqa: S106
        eos_token="<|im_end|>",  # noqa: S106
        additional_special_tokens=special,
    )
    fast.chat_template = TEMPLATE
    fast.save_pretrained(folder)


def test_prompt_carries_duration_and_resolution() -> None:
    facts = "The video is 5.4 seconds long and is of 24 FPS. This video is of 480x640 resolution."
    assert video_prompt("Lift the cube.", **CLIP) == f"Lift the cube. {facts}"
    assert video_prompt(" ", **CLIP) == facts


def test_ids_follow_the_chat_template_and_end_with_the_start_of_vision(tmp_path: Path) -> None:
    write_tokenizer(tmp_path)
    text = Cosmos3Text(tmp_path, **CLIP)
    decoded = text.tokenizer.decode(text.ids("lift the red cube"))
    assert decoded.startswith("<|im_start|> system You are a helpful assistant")
    assert "<|im_start|> user lift the red cube" in decoded
    assert decoded.endswith("<|im_start|> assistant <|im_end|> <|vision_start|>")
    ids, mask = text(["lift the red cube", "lift the red cube put it down"])
    assert mask.sum(dim=1).tolist() == [len(text.ids("lift the red cube")), ids.shape[1]]
    assert ids[0, mask[0]].tolist() == text.ids("lift the red cube")


def test_missing_or_foreign_tokenizers_are_named(tmp_path: Path) -> None:
    with pytest.raises(UnavailableError, match="text tokenizer is not here"):
        Cosmos3Text(tmp_path / "nothing", **CLIP)
    write_tokenizer(tmp_path, vision=False)
    with pytest.raises(CheckpointError, match="Not the tokenizer of a Cosmos3 model"):
        Cosmos3Text(tmp_path, **CLIP)
