"""Task text as token ids. The embedded default reads UTF-8 bytes; the full size uses the backbone's own tokenizer."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, Protocol

import torch
from jaxtyping import Bool, Int
from pydantic import Field
from torch import Tensor

from worldline_core.config.base import StrictModel
from worldline_core.errors import ConfigError, UnavailableError

BYTE_OFFSET = 2
END_OF_TEXT = 1


class TextConfig(StrictModel):
    """``bytes`` needs nothing; ``pretrained`` reads a tokenizer from the local folder ``path``."""

    kind: Literal["bytes", "pretrained"] = "bytes"
    path: str | None = None
    max_length: int = Field(default=48, ge=2)


class TextEncoder(Protocol):
    """Texts to right-padded ids and a mask that is True on real tokens."""

    def __call__(self, texts: list[str]) -> tuple[Int[Tensor, "b n"], Bool[Tensor, "b n"]]: ...


class ByteText:
    """Ids 2..257 are bytes, 1 ends a text, 0 pads. Longer texts are cut."""

    vocabulary_size = 256 + BYTE_OFFSET

    def __init__(self, max_length: int) -> None:
        self.max_length = max_length

    def __call__(self, texts: list[str]) -> tuple[Int[Tensor, "b n"], Bool[Tensor, "b n"]]:
        coded = [
            [byte + BYTE_OFFSET for byte in text.lower().strip().encode()[: self.max_length - 1]] + [END_OF_TEXT]
            for text in texts
        ]
        length = max(len(ids) for ids in coded)
        ids = torch.zeros(len(coded), length, dtype=torch.long)
        for row, values in zip(ids, coded, strict=True):
            row[: len(values)] = torch.tensor(values)
        return ids, ids != 0


class PretrainedText:
    """A transformers tokenizer read from a local folder."""

    def __init__(self, path: Path, max_length: int) -> None:
        from transformers import AutoTokenizer

        if not path.is_dir():
            raise UnavailableError(
                "The text tokenizer is not here.",
                where=path,
                expected="a folder with tokenizer files",
                next_step="download the backbone's tokenizer to this folder",
            )
        self.tokenizer = AutoTokenizer.from_pretrained(path, local_files_only=True)
        self.max_length = max_length

    def __call__(self, texts: list[str]) -> tuple[Int[Tensor, "b n"], Bool[Tensor, "b n"]]:
        coded = self.tokenizer(
            texts,
            padding=True,
            truncation=True,
            max_length=self.max_length,
            padding_side="right",
            return_tensors="pt",
        )
        return coded["input_ids"], coded["attention_mask"].bool()


def load_text_encoder(config: TextConfig, vocabulary_size: int) -> TextEncoder:
    """The text encoder of a config.

    Raises:
        ConfigError: if it does not fit the model's vocabulary, or ``path`` is missing.
    """
    if config.kind == "bytes":
        if vocabulary_size < ByteText.vocabulary_size:
            raise ConfigError(
                "The model's vocabulary is too small for byte text.",
                where="model.vocab_size",
                expected=f">= {ByteText.vocabulary_size}",
                got=vocabulary_size,
            )
        return ByteText(config.max_length)
    if config.path is None:
        raise ConfigError("A pretrained text tokenizer needs a folder.", where="text.path", expected="a path", got=None)
    return PretrainedText(Path(config.path), config.max_length)
