"""Pretrained Cosmos3 weights (a local diffusers folder) as the base checkpoint that Stage I starts from."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from pydantic import ValidationError
from torch import Tensor

from worldline_core.errors import CheckpointError, UnavailableError
from worldline_core.model.checkpoint import check_fit, read_weights, save_checkpoint
from worldline_core.model.layers import new_action_tensors
from worldline_core.model.mixture import MixtureModel, is_text_parameter
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import (
    Cosmos3Size,
    ImportBackboneConfig,
    MixtureConfig,
    cosmos3_config,
)
from worldline_core.store.artifact_files import read_json

CLASS_NAME = "Cosmos3OmniTransformer"
SINGLE = "diffusion_pytorch_model.safetensors"
_KINDS: dict[Cosmos3Size, dict[str, object]] = {
    "nano": {"hidden_act": "silu", "qk_norm_for_text": True, "use_und_k_norm_for_gen": False},
    "edge": {"hidden_act": "relu2", "qk_norm_for_text": False, "use_und_k_norm_for_gen": True},
}
UNUSED_PARAMETERS = (
    "lm_head.",
    "audio_proj_in.",
    "audio_proj_out.",
    "audio_modality_embed",
    "action_proj_in.",
    "action_proj_out.",
    "action_modality_embed",
)
"""Heads for text, sound and native actions: this model emits video and takes its actions as maps."""


def config_from_diffusers(
    config: Mapping[str, Any], *, where: object, fps: float | None = None, expected: Cosmos3Size | None = None
) -> MixtureConfig:
    """Translate a diffusers ``config.json``.

    Args:
        expected: refuse another size; None takes any.
        fps: frame rate of the data; the temporal positions follow it where the pretrained model modulates by fps.

    Raises:
        CheckpointError: the folder holds another model, or a variant this package does not compute.
    """
    supported = {"_class_name": CLASS_NAME, "attention_bias": False}
    wrong = {key: config.get(key, value) for key, value in supported.items() if config.get(key, value) != value}
    kind = {name: config.get(name, default) for name, default in _KINDS["nano"].items()}
    size: Cosmos3Size | None = next((size for size, fields in _KINDS.items() if fields == kind), None)
    if wrong or size is None:
        raise CheckpointError(
            "Not a Cosmos3 transformer of a supported kind",
            where=where,
            expected=f"{supported} with {' or '.join(map(str, _KINDS.values()))}",
            got=wrong | kind,
        )
    if expected not in (None, size):
        raise CheckpointError(
            f"Weights of Cosmos3-{size.title()} where those of Cosmos3-{f'{expected}'.title()} are expected", where=where,
            expected=f"import_backbone.size: {expected}", got=size,
            next_step=f"give the folder of nvidia/Cosmos3-{f'{expected}'.title()}, or the preset of Cosmos3-{size.title()}",
        )  # fmt: skip
    names = {
        "latent_channels": "latent_channel",
        "patch_size": "latent_patch_size",
        "hidden_size": "hidden_size",
        "num_layers": "num_hidden_layers",
        "num_heads": "num_attention_heads",
        "num_kv_heads": "num_key_value_heads",
        "head_dim": "head_dim",
        "intermediate_size": "intermediate_size",
        "rms_norm_eps": "rms_norm_eps",
        "rope_theta": "rope_theta",
        "base_fps": "base_fps",
        "temporal_margin": "unified_3d_mrope_temporal_modality_margin",
        "vocab_size": "vocab_size",
        "timestep_scale": "timestep_scale",
    }
    changes: dict[str, Any] = {ours: config[theirs] for ours, theirs in names.items() if theirs in config}
    if config.get("rope_axes_dim") is not None:
        changes["rope_sections"] = tuple(config["rope_axes_dim"])
    if config.get("enable_fps_modulation", True):
        changes["fps"] = fps
    try:
        return cosmos3_config(size, **changes)
    except ValidationError as error:
        raise CheckpointError("The Cosmos3 config is not valid", where=where, got=str(error)) from error


def read_cosmos3(
    folder: Path,
    *,
    fps: float | None = None,
    changes: Mapping[str, object] | None = None,
    size: Cosmos3Size | None = None,
    revision: str | None = None,
) -> tuple[WorldModel, dict[str, Tensor], dict[str, list[str]]]:
    """A model on the meta device, and all of its weights: views of the mapped files, and those that are new; and the names of the
    weights that were left out (``ignored``) and that are new (``new``).

    The action branch is new: its output layer is zero, so the model starts as the pretrained one.

    Args:
        folder: a transformer in diffusers format, or a pipeline with a ``transformer`` subfolder.
        changes: fields of the config to set besides (view slots, their unit, the generation tower alone).
        size: refuse another; None takes any.
        revision: commit of the hub that the folder must be of; None takes any.

    Raises:
        UnavailableError: there is no such folder.
        CheckpointError: the folder is incomplete, damaged, or holds another architecture.
    """
    root = folder / "transformer" if (folder / "transformer").is_dir() else folder
    if not (root / "config.json").is_file():
        raise UnavailableError(
            "The Cosmos3 weights are not here",
            where=folder,
            expected="a diffusers folder with config.json and *.safetensors",
            next_step=f"download nvidia/Cosmos3-{f'{size or "nano"}'.title()} in diffusers format and give its folder",
        )
    if revision is not None and (found := hub_revision(folder)) != revision:
        raise CheckpointError(
            "Weights of another revision" if found else "The folder does not say which revision it is of", where=folder,
            expected=revision, got=found,
            next_step="download it with huggingface_hub (hf download --revision), which notes the commit; or change import_backbone.revision",
        )  # fmt: skip
    raw = read_json(root / "config.json")
    config = config_from_diffusers(raw, where=root / "config.json", fps=fps, expected=size)
    config = MixtureConfig.model_validate(config.model_dump() | dict(changes or {}))
    tensors = read_weights(root / SINGLE, None)
    without_text = config.towers == "generation"
    ignored = {
        name for name in tensors if name.startswith(UNUSED_PARAMETERS) or (without_text and is_text_parameter(name))
    }
    kept = {name: tensor for name, tensor in tensors.items() if name not in ignored}
    with torch.device("meta"):
        model = MixtureModel(config)
    with torch.random.fork_rng(devices=()):
        torch.manual_seed(0)
        new = new_action_tensors(config)
    if model.view_embedding is not None:
        new["view_embedding"] = torch.zeros(model.view_embedding.shape)
    tensors = kept | new
    check_fit({name: tuple(tensor.shape) for name, tensor in model.state_dict().items()}, tensors, root)
    return model, tensors, {"ignored": sorted(ignored), "new": sorted(new)}


def hub_revision(folder: Path) -> str | None:
    """Commit that a downloaded folder is of: a snapshot of the hub's cache has it as name, a local folder beside each file."""
    resolved = folder.resolve()
    if resolved.parent.name == "snapshots":
        return resolved.name
    notes = sorted((folder / ".cache" / "huggingface" / "download").rglob("config.json.metadata"))
    commits = {note.read_text(encoding="utf-8", errors="replace").partition("\n")[0].strip() for note in notes}
    return commits.pop() if len(commits) == 1 else None


def import_backbone(config: ImportBackboneConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """Load ``inputs['diffusers']`` (a Cosmos3 folder in diffusers format) and write a base checkpoint.

    Weights go from file to file: what is held is one file of the result.
    """
    model, tensors, report = read_cosmos3(
        inputs["diffusers"], fps=config.fps, changes=config.changes, size=config.size, revision=config.revision
    )
    save_checkpoint(
        output, model, kind="base", action_contract=None, metadata={"source": "Cosmos3 in diffusers format", **report},
        dtype=getattr(torch, config.dtype), state_dict=tensors,
    )  # fmt: skip
    return {"parameters": sum(parameter.numel() for parameter in model.parameters()), "ignored": len(report["ignored"])}
