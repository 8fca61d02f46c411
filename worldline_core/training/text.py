"""Task text as token ids. The embedded default reads UTF-8 bytes; the full size reads the backbone's own chat prompt."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, Protocol

import torch
from jaxtyping import Bool, Int
from pydantic import Field
from torch import Tensor

from worldline_core.config.base import StrictModel
from worldline_core.errors import ConfigError
from worldline_core.model.text import ClipFacts, Cosmos3Text

BYTE_OFFSET = 2
END_OF_TEXT = 1


class TextConfig(StrictModel):
    """``bytes`` needs nothing; ``cosmos3`` reads the backbone's tokenizer from the local folder ``path``.

    ``max_length``: tokens of a text; longer instructions are cut.
    """

    kind: Literal["bytes", "cosmos3"] = "bytes"
    path: str | None = None
    max_length: int = Field(default=48, ge=2)


class TextEncoder(Protocol):
    """Texts, each with the clip it describes, to right-padded ids and a mask that is True on real tokens."""

    def __call__(
        self, texts: Sequence[str], clips: Sequence[ClipFacts]
    ) -> tuple[Int[Tensor, "b n"], Bool[Tensor, "b n"]]: ...


class ByteText:
    """Ids 2..257 are bytes, 1 ends a text, 0 pads. Longer texts are cut; nothing is said of the clip."""

    vocabulary_size = 256 + BYTE_OFFSET

    def __init__(self, max_length: int) -> None:
        self.max_length = max_length

    def __call__(
        self, texts: Sequence[str], clips: Sequence[ClipFacts]
    ) -> tuple[Int[Tensor, "b n"], Bool[Tensor, "b n"]]:
        """Ids of the texts alone."""
        coded = [
            [byte + BYTE_OFFSET for byte in text.lower().strip().encode()[: self.max_length - 1]] + [END_OF_TEXT]
            for text in texts
        ]
        length = max(len(ids) for ids in coded)
        ids = torch.zeros(len(coded), length, dtype=torch.long)
        for row, values in zip(ids, coded, strict=True):
            row[: len(values)] = torch.tensor(values)
        return ids, ids != 0


def load_text_encoder(config: TextConfig, vocabulary_size: int) -> TextEncoder:
    """The text encoder of a config.

    Raises:
        ConfigError: it does not fit the model's vocabulary, or ``path`` is missing.
        UnavailableError: there is no tokenizer at ``path``.
        CheckpointError: the tokenizer there is not a Cosmos3 model's.
    """
    if config.kind == "cosmos3" and config.path is None:
        raise ConfigError("The backbone's text tokenizer needs a folder.", where="text.path", expected="a path")
    encoder = (
        ByteText(config.max_length)
        if config.path is None or config.kind == "bytes"
        else Cosmos3Text(Path(config.path), max_length=config.max_length)
    )
    if vocabulary_size < encoder.vocabulary_size:
        raise ConfigError(
            "The model's vocabulary is too small for this text.",
            where="model.vocab_size",
            expected=f">= {encoder.vocabulary_size}",
            got=vocabulary_size,
        )
    return encoder
