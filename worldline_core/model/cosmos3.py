"""Cosmos3 weights in a folder of diffusers: pretrained ones read, trained ones written back."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from pydantic import ValidationError

from worldline_core.errors import ArtifactError, CheckpointError
from worldline_core.model.backbone_folder import SINGLE, Pretrained, transformer_folder
from worldline_core.model.checkpoint import WEIGHTS, read_checkpoint_info, read_weights, write_weights
from worldline_core.model.layers import is_action_parameter
from worldline_core.model.mixture import is_text_parameter
from worldline_core.model.world_model_config import Cosmos3Size, MixtureConfig, cosmos3_config
from worldline_core.store.artifact_files import digest_file
from worldline_core.store.atomic import write_json_atomic

CLASS_NAME = "Cosmos3OmniTransformer"
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

BESIDE = "worldline"
"""Folder of what diffusers' class has no place for, and of the description that seals all files."""
_NOT_OF_THE_NETWORK = {
    "views", "view_offsets", "view_offset_unit", "spatial_compression", "view_embedding", "towers", "fps", "action_channels",
    "native_size", "action_frames", "action_conditioning",
}  # fmt: skip


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
) -> Pretrained:
    """Cosmos3 from a transformer in diffusers format, or a pipeline with a ``transformer`` subfolder.

    Args:
        changes: fields of the config to set besides (view slots, their unit, the generation tower alone).
        size: refuse another; None takes any.
        revision: commit of the hub that the folder must be of; None takes any.

    Raises:
        UnavailableError: there is no such folder.
        CheckpointError: the folder is incomplete, damaged, or holds another architecture.
    """
    root, raw = transformer_folder(folder, f"nvidia/Cosmos3-{f'{size or "nano"}'.title()}", revision)
    config = config_from_diffusers(raw, where=root / "config.json", fps=fps, expected=size)
    config = MixtureConfig.model_validate(config.model_dump() | dict(changes or {}))
    tensors = read_weights(root / SINGLE, None)
    without_text = config.towers == "generation"
    ignored = {
        name for name in tensors if name.startswith(UNUSED_PARAMETERS) or (without_text and is_text_parameter(name))
    }
    kept = {name: tensor for name, tensor in tensors.items() if name not in ignored}
    return Pretrained.of(config, kept, root, ignored=ignored)


def write_cosmos3(checkpoint: Path, pretrained: Path, output: Path) -> Path:
    """Write a checkpoint into a copy of the pretrained folder that it came from, as diffusers and vLLM-Omni run it: without controls.

    ``worldline/`` holds what their class has no place for: the branches of the controls and the view embedding, and
    ``checkpoint.json``, the description with the action contract, with the SHA-256 of every file. It is written last.

    Raises:
        ArtifactError: the output exists.
        UnavailableError: there is no pretrained folder.
        CheckpointError: the checkpoint is causal, of another network, or of other sizes than the pretrained one.
    """
    if output.exists() and any(output.iterdir()):
        raise ArtifactError("Folder exists already", where=output, next_step="export into a new folder")
    info = read_checkpoint_info(checkpoint)
    if not isinstance(info.config, MixtureConfig) or info.kind == "causal":
        raise CheckpointError(
            "diffusers has no class for this model", where=checkpoint, expected="Cosmos3 that denoises whole clips",
            got=f"{info.config.network}, {info.kind}", next_step="export the base, Stage I or Stage II checkpoint",
        )  # fmt: skip
    root, raw = transformer_folder(pretrained, "nvidia/Cosmos3", None)
    network = config_from_diffusers(raw, where=root / "config.json").model_dump(exclude=_NOT_OF_THE_NETWORK)
    own = info.config.model_dump(exclude=_NOT_OF_THE_NETWORK)
    if other := {name: value for name, value in own.items() if value != network[name]}:
        raise CheckpointError(
            "The checkpoint is not of this pretrained network", where=checkpoint, got=other,
            expected={name: network[name] for name in other}, next_step="give the folder that import_backbone read",
        )  # fmt: skip
    trained, given = read_weights(checkpoint / WEIGHTS, info.weights_sha256), read_weights(root / SINGLE, None)
    beside = {
        name: trained.pop(name) for name in list(trained) if is_action_parameter(name) or name == "view_embedding"
    }
    kept = {
        name for name in given.keys() - trained.keys()
        if name.startswith(UNUSED_PARAMETERS) or (info.config.towers == "generation" and is_text_parameter(name))
    }  # fmt: skip
    if different := sorted(given.keys() ^ trained.keys() ^ kept):
        raise CheckpointError("Weights of another network", where=root, got=different[:8])
    weights = {path for path in root.iterdir() if path.name.startswith(Path(SINGLE).stem)}
    for path in sorted(pretrained.rglob("*")):
        place = path.relative_to(pretrained)
        if path.is_file() and path not in weights and place.parts[0] != ".cache":
            (output / place).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, output / place)
    dtype = getattr(torch, info.dtype)
    write_weights(output / root.relative_to(pretrained) / SINGLE, given | trained, dtype)
    write_weights(output / BESIDE / WEIGHTS, beside, dtype)
    files = {str(path.relative_to(output)): digest_file(path) for path in sorted(output.rglob("*")) if path.is_file()}
    write_json_atomic(output / BESIDE / "checkpoint.json", info.model_dump(mode="json") | {"files": files})
    return output
