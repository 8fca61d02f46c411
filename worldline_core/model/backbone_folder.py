"""A published network in a local folder of diffusers, and the model that is made of it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from worldline_core.errors import CheckpointError, UnavailableError
from worldline_core.model.checkpoint import check_fit
from worldline_core.model.layers import new_action_tensors
from worldline_core.model.networks import build_world_model
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import WorldModelConfig
from worldline_core.store.artifact_files import read_json

SINGLE = "diffusion_pytorch_model.safetensors"


def transformer_folder(folder: Path, published: str, revision: str | None) -> tuple[Path, dict[str, Any]]:
    """Folder of the transformer, itself or a pipeline's, and its configuration.

    Args:
        published: its name on the hub.
        revision: commit of the hub that the folder must be of; None takes any.

    Raises:
        UnavailableError: there is no such folder.
        CheckpointError: it is of another revision.
    """
    root = folder / "transformer" if (folder / "transformer").is_dir() else folder
    if not (root / "config.json").is_file():
        raise UnavailableError(
            "The backbone's weights are not here",
            where=folder,
            expected="a diffusers folder with config.json and *.safetensors",
            next_step=f"download {published} in diffusers format and give its folder",
        )
    if revision is not None and (found := hub_revision(folder)) != revision:
        raise CheckpointError(
            "Weights of another revision" if found else "The folder does not say which revision it is of", where=folder,
            expected=revision, got=found,
            next_step="download it with huggingface_hub (hf download --revision), which notes the commit; or change import_backbone.revision",
        )  # fmt: skip
    return root, read_json(root / "config.json")


def hub_revision(folder: Path) -> str | None:
    """Commit that a downloaded folder is of: a snapshot of the hub's cache has it as name, a local folder beside each file."""
    resolved = folder.resolve()
    if resolved.parent.name == "snapshots":
        return resolved.name
    notes = sorted((folder / ".cache" / "huggingface" / "download").rglob("config.json.metadata"))
    commits = {note.read_text(encoding="utf-8", errors="replace").partition("\n")[0].strip() for note in notes}
    return commits.pop() if len(commits) == 1 else None


@dataclass(frozen=True)
class Pretrained:
    """A model on the meta device, and all of its weights: views of the mapped files, and those that are new.

    The action branch is new: its output layer is zero, so the model starts as the pretrained one.

    Attributes:
        ignored, new: names of the weights that were left out, and that the published network does not have.
    """

    model: WorldModel
    tensors: dict[str, Tensor]
    ignored: list[str]
    new: list[str]

    @classmethod
    def of(
        cls, config: WorldModelConfig, kept: Mapping[str, Tensor], where: Path, *, ignored: Iterable[str] = ()
    ) -> Pretrained:
        """The model of ``config`` with the weights ``kept``, by their names in it.

        Raises:
            CheckpointError: some are missing, left over, or of another shape.
        """
        with torch.device("meta"):
            model = build_world_model(config)
        with torch.random.fork_rng(devices=()):
            torch.manual_seed(0)
            new = new_action_tensors(config)
        if model.view_embedding is not None:
            new["view_embedding"] = torch.zeros(model.view_embedding.shape)
        tensors = {**kept, **new}
        check_fit({name: tuple(tensor.shape) for name, tensor in model.state_dict().items()}, tensors, where)
        return cls(model, tensors, sorted(ignored), sorted(new))
