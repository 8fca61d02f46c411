"""Task text as a model takes it: UTF-8 bytes for the embedded models, Cosmos3's own chat prompt, stored embeddings for Wan.

Cosmos3 was trained to read a chat: a system prompt (Nano alone), the instruction, and the clip's length and size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from worldline_core.errors import CheckpointError, ConfigError, UnavailableError
from worldline_core.model.checkpoint import read_weights
from worldline_core.model.world_model_config import MixtureConfig, TextConfig, WanConfig, WorldModelConfig
from worldline_core.store.artifact_files import read_json

SYSTEM_PROMPT = "You are a helpful assistant who will generate videos from a give prompt."
"""Spelt as in training, the missing letter included."""
VISION_START = "<|vision_start|>"


@dataclass(frozen=True)
class ClipFacts:
    """Facts about a clip that its prompt states: frames, frames per second as they are shown, (height, width) in pixels."""

    num_frames: int
    fps: float
    image_size: tuple[int, int]


def video_prompt(instruction: str, clip: ClipFacts) -> str:
    """The instruction followed by the clip's duration and resolution."""
    height, width = clip.image_size
    facts = (
        f"The video is {clip.num_frames / clip.fps:.1f} seconds long and is of {clip.fps:.0f} FPS.",
        f"This video is of {height}x{width} resolution.",
    )
    text = instruction.strip()
    for fact in facts:
        text = f"{text.rstrip('.')}. {fact}" if text else fact
    return text


def padded(texts: Sequence[Sequence[int] | Tensor], padding: int = 0) -> tuple[Tensor, Bool[Tensor, "b n"]]:
    """Ids (or embeddings) of all texts, the shorter ones filled up on the right, and a mask that is True on real tokens."""
    real = pad_sequence([torch.ones(len(ids), dtype=torch.bool) for ids in texts], batch_first=True)
    return pad_sequence([torch.as_tensor(ids) for ids in texts], batch_first=True, padding_value=padding), real


class Cosmos3Text:
    """Instructions to right-padded ids ``(b m)`` and a mask that is True on real tokens.

    Args:
        folder: local folder ``text_tokenizer`` of the diffusers pipeline (Qwen2's for Nano, Nemotron's for Edge).
        system_prompt: whether the prompt begins with the system's; Cosmos3-Edge was trained without (``default_use_system_prompt``
            of the pipeline).
        max_length: most tokens of a prompt. An instruction that is too long loses its last words; the chat around it
            and the clip's facts stay whole.

    Raises:
        UnavailableError: there is no such folder.
        CheckpointError: its tokenizer lacks the chat template or the vision token, or the pipeline that it is a part of was trained
            otherwise.
    """

    def __init__(self, folder: Path, *, max_length: int | None = None, system_prompt: bool = True) -> None:
        if not folder.is_dir():
            raise UnavailableError(
                "The text tokenizer is not here",
                where=folder,
                expected="the folder text_tokenizer of a Cosmos3 pipeline",
                next_step="download it from nvidia/Cosmos3-Nano or nvidia/Cosmos3-Edge, as the backbone",
            )
        pipeline = folder.parent / "model_index.json"
        trained = read_json(pipeline).get("default_use_system_prompt", True) if pipeline.is_file() else system_prompt
        if trained != system_prompt:
            raise CheckpointError(
                "The pipeline of this tokenizer was trained with another prompt", where=f"{pipeline}: default_use_system_prompt",
                expected=system_prompt, got=trained, next_step=f"set text.system_prompt to {str(trained).lower()}",
            )  # fmt: skip
        from transformers import AutoTokenizer

        self.tokenizer = AutoTokenizer.from_pretrained(folder, local_files_only=True)
        self.max_length, self.system_prompt = max_length, system_prompt
        start = self.tokenizer.get_vocab().get(VISION_START)
        if start is None or self.tokenizer.eos_token_id is None or self.tokenizer.chat_template is None:
            raise CheckpointError(
                "Not the tokenizer of a Cosmos3 model",
                where=folder,
                expected=f"a chat template, an end token, and {VISION_START}",
                got=type(self.tokenizer).__name__,
            )
        self._ending = [int(self.tokenizer.eos_token_id), int(start)]

    @property
    def vocabulary_size(self) -> int:
        """Upper bound on ids, exclusive."""
        return max(self.tokenizer.get_vocab().values()) + 1

    def ids(self, instruction: str, clip: ClipFacts) -> list[int]:
        """Ids of one prompt: chat template, end of text, start of vision.

        Raises:
            ConfigError: not even a prompt without an instruction fits ``max_length``.
        """
        ids = self._prompt_ids(instruction, clip)
        if self.max_length is None:
            return ids
        words = instruction.split()
        while words and len(ids) > self.max_length:
            words.pop()
            ids = self._prompt_ids(" ".join(words), clip)
        if len(ids) > self.max_length:
            raise ConfigError(
                "The longest allowed text is too short for the prompt's frame",
                where="text.max_length",
                expected=f">= {len(ids)}",
                got=self.max_length,
            )
        return ids

    def _prompt_ids(self, instruction: str, clip: ClipFacts) -> list[int]:
        chat = [{"role": "system", "content": SYSTEM_PROMPT}] if self.system_prompt else []
        chat.append({"role": "user", "content": video_prompt(instruction, clip)})
        text = self.tokenizer.apply_chat_template(chat, tokenize=False, add_generation_prompt=True)
        return [*self.tokenizer(text, add_special_tokens=False)["input_ids"], *self._ending]

    def __call__(
        self, texts: Sequence[str], clips: Sequence[ClipFacts]
    ) -> tuple[Int[Tensor, "b m"], Bool[Tensor, "b m"]]:
        return padded([self.ids(text, clip) for text, clip in zip(texts, clips, strict=True)], self._ending[0])


BYTE_OFFSET = 2
END_OF_TEXT = 1


class TextEncoder(Protocol):
    """Texts, each with the clip it describes, to right-padded ids (or embeddings) and a mask that is True on real tokens."""

    def __call__(
        self, texts: Sequence[str], clips: Sequence[ClipFacts]
    ) -> tuple[Int[Tensor, "b n"] | Float[Tensor, "b n s"], Bool[Tensor, "b n"]]: ...


class ByteText:
    """Ids 2..257 are bytes, 1 ends a text, 0 pads. Longer texts are cut; the facts about the clip are left out."""

    vocabulary_size = 256 + BYTE_OFFSET

    def __init__(self, max_length: int) -> None:
        self.max_length = max_length

    def __call__(
        self, texts: Sequence[str], clips: Sequence[ClipFacts]
    ) -> tuple[Int[Tensor, "b n"], Bool[Tensor, "b n"]]:
        cut = [text.lower().strip().encode()[: self.max_length - 1] for text in texts]
        return padded([[*(byte + BYTE_OFFSET for byte in text), END_OF_TEXT] for text in cut])


class EmbeddedText:
    """Embeddings of texts from a file (``import_backbone.prompts``); what encoded them is not needed any more."""

    def __init__(self, path: Path, size: int) -> None:
        self.path, self.embeddings = path, read_weights(path, None)
        if any(value.ndim != 2 or value.shape[1] != size for value in self.embeddings.values()):
            raise CheckpointError(
                "Embeddings of texts have the wrong shape", where=path, expected=f"(tokens, {size}) by text",
                got={text: tuple(value.shape) for text, value in self.embeddings.items()},
            )  # fmt: skip

    def __call__(
        self, texts: Sequence[str], clips: Sequence[ClipFacts]
    ) -> tuple[Float[Tensor, "b n s"], Bool[Tensor, "b n"]]:
        """Embeddings of the texts alone. Raises: ConfigError for a text that is not in the file."""
        missing = sorted(set(texts) - self.embeddings.keys())
        if missing:
            raise ConfigError(
                "No embedding of this text is stored", where=self.path, expected=f"one of {len(self.embeddings)} texts",
                got=missing[0], next_step="name every instruction of the recordings in import_backbone.prompts, and import again",
            )  # fmt: skip
        return padded([self.embeddings[text].float() for text in texts])


def load_text_encoder(config: TextConfig, model: WorldModelConfig) -> TextEncoder:
    """The text encoder of a config, for a model of this configuration.

    Raises:
        ConfigError: it does not fit the model's vocabulary, or ``path`` is missing.
        UnavailableError: there is no tokenizer at ``path``.
        CheckpointError: the tokenizer there is not a Cosmos3 model's.
    """
    if isinstance(model, WanConfig) != (config.kind == "stored"):
        raise ConfigError(
            "The model takes text otherwise", where="text.kind", got=config.kind,
            expected="stored" if isinstance(model, WanConfig) else "bytes or cosmos3",
        )  # fmt: skip
    if config.kind != "bytes" and config.path is None:
        raise ConfigError("This text needs a folder or a file.", where="text.path", expected="a path")
    path = Path(config.path or "")
    if isinstance(model, WanConfig):
        return EmbeddedText(path, model.text_size)
    if config.kind == "bytes":
        encoder = ByteText(config.max_length)
    else:
        encoder = Cosmos3Text(path, max_length=config.max_length, system_prompt=config.system_prompt)
    if isinstance(model, MixtureConfig) and model.vocab_size < encoder.vocabulary_size:
        raise ConfigError(
            "The model's vocabulary is too small for this text.",
            where="model.vocab_size",
            expected=f">= {encoder.vocabulary_size}",
            got=model.vocab_size,
        )
    return encoder
