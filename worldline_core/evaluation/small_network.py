"""Reading of the small networks of the evaluation: their weights, and a JSON file beside them that says their size."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from pydantic import BaseModel, ValidationError
from torch import nn

from worldline_core.errors import ArtifactError
from worldline_core.model.checkpoint import fill, read_weights
from worldline_core.store.artifact_files import read_json

WEIGHTS_FILE = "model.safetensors"


def load_network[D: BaseModel, N: nn.Module](
    folder: Path, description: str, described: type[D], build: Callable[[D], N], *, noun: str, next_step: str
) -> tuple[N, D]:
    """The network in a folder, on the CPU in float32, and its description.

    Args:
        description: name of the JSON file.
        noun: what it is, for errors.
        next_step: what to do where the folder holds none.

    Raises: ArtifactError for a missing or damaged folder, or weights of another network.
    """
    missing = [name for name in (description, WEIGHTS_FILE) if not (folder / name).is_file()]
    if missing:
        raise ArtifactError(
            f"Not a trained {noun}", where=folder, expected=f"{description} and {WEIGHTS_FILE}",
            got=f"missing {missing}", next_step=next_step,
        )  # fmt: skip
    try:
        found = described.model_validate(read_json(folder / description))
        tensors = read_weights(folder / WEIGHTS_FILE, None)
        with torch.device("meta"):  # a description may ask for any size: only weights that are there take memory
            network = build(found)
        fill(network, tensors, where=folder / WEIGHTS_FILE, dtype=torch.float32)
    except (ArtifactError, ValidationError) as error:
        raise ArtifactError(
            f"The {noun} cannot be read", where=folder, got=str(error), next_step="train it again"
        ) from error
    return network, found
