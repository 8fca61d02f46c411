"""Pretrained weights as the base checkpoint that Stage I starts from."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from worldline_core.model.checkpoint import save_checkpoint, write_weights
from worldline_core.model.cosmos3 import read_cosmos3
from worldline_core.model.wan_weights import read_wan
from worldline_core.model.world_model_config import ImportBackboneConfig

TEXTS = "texts.safetensors"
"""Embeddings of texts, by the texts, beside the weights of a model that takes text so."""


def import_backbone(config: ImportBackboneConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """Load ``inputs['diffusers']`` (a published folder in diffusers format) and write a base checkpoint.

    Weights go from file to file: what is held is one file of the result.
    """
    folder, dtype = inputs["diffusers"], getattr(torch, config.dtype)
    texts: dict[str, Tensor] = {}
    if config.size == "wan2.2-ti2v-5b":
        found, texts = read_wan(folder, changes=config.changes, revision=config.revision, prompts=config.prompts)
    else:
        found = read_cosmos3(folder, fps=config.fps, changes=config.changes, size=config.size, revision=config.revision)
    if texts:
        output.mkdir(parents=True, exist_ok=True)
        write_weights(output / TEXTS, texts, dtype)
    facts = {"source": f"{config.size} in diffusers format", "ignored": found.ignored, "new": found.new}
    save_checkpoint(
        output, found.model, kind="base", action_contract=None, metadata=facts, dtype=dtype, state_dict=found.tensors
    )
    parameters = sum(parameter.numel() for parameter in found.model.parameters())
    return {"parameters": parameters, "ignored": len(found.ignored)}
