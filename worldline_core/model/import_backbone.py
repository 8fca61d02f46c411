"""Turn pretrained Cosmos3 weights into the base checkpoint that Stage I starts from."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import torch
from pydantic import Field

from worldline_core.config.base import StrictModel
from worldline_core.model.checkpoint import save_checkpoint
from worldline_core.model.cosmos3 import load_cosmos3


class ImportBackboneConfig(StrictModel):
    """How the pretrained weights are read and stored."""

    fps: float = Field(30.0, gt=0, description="frame rate of the clips: temporal positions advance by 24 / fps")
    dtype: Literal["bfloat16", "float16"] = "bfloat16"
    changes: dict[str, Any] = Field({}, description="fields of the model's config to set besides (view slots)")


def import_backbone(config: ImportBackboneConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """Load ``inputs['diffusers']`` (a Cosmos3 folder in diffusers format) and write a base checkpoint.

    The action branch is new and zero, so the result computes exactly what the pretrained model does.

    Raises:
        UnavailableError: there are no weights in the folder.
        CheckpointError: the folder is damaged, or holds another architecture.
    """
    dtype = {"bfloat16": torch.bfloat16, "float16": torch.float16}[config.dtype]
    model, report = load_cosmos3(inputs["diffusers"], fps=config.fps, changes=config.changes, dtype=dtype)
    metadata = {"source": "Cosmos3 in diffusers format", "ignored": list(report.ignored), "new": list(report.new)}
    save_checkpoint(output, model, kind="base", action_contract={}, metadata=metadata, dtype=dtype)
    return {"parameters": sum(parameter.numel() for parameter in model.parameters()), "ignored": len(report.ignored)}
