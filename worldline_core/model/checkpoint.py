"""Checkpoints: ``model.safetensors`` and ``checkpoint.json``, read strictly."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import torch
from pydantic import ValidationError
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from worldline_core.errors import CheckpointError
from worldline_core.model.world_model import WorldModel, is_text_parameter
from worldline_core.model.world_model_config import WorldModelConfig
from worldline_core.store.atomic import write_bytes_atomic, write_json_atomic

CheckpointKind = Literal["base", "stage1", "stage2", "causal"]
FORMAT = "worldline.checkpoint"
VERSION = 1
WEIGHTS, DESCRIPTION = "model.safetensors", "checkpoint.json"


@dataclass(frozen=True)
class CheckpointInfo:
    """What a checkpoint says about itself."""

    kind: CheckpointKind
    config: WorldModelConfig
    action_contract: dict[str, Any]
    """Units, frame, gripper polarity, fps, sigma of the action maps it was trained with."""
    metadata: dict[str, Any]
    dtype: str
    weights_sha256: str


def save_checkpoint(
    folder: Path,
    model: WorldModel,
    *,
    kind: CheckpointKind,
    action_contract: Mapping[str, Any],
    metadata: Mapping[str, Any] | None = None,
    dtype: torch.dtype = torch.float16,
    state_dict: Mapping[str, Tensor] | None = None,
) -> None:
    """Write a model. Equal weights and metadata give equal bytes.

    Args:
        state_dict: weights to store instead of the model's own (an averaged copy).

    Raises:
        CheckpointError: the kind is unknown, or a weight is not finite in ``dtype``.
    """
    if kind not in get_args(CheckpointKind):
        raise CheckpointError("Unknown checkpoint kind", expected=list(get_args(CheckpointKind)), got=kind)
    source = model.state_dict() if state_dict is None else state_dict
    tensors: dict[str, Tensor] = {}
    for name, tensor in sorted(source.items()):
        tensors[name] = tensor.detach().to("cpu", dtype).contiguous().clone()
        if not bool(torch.isfinite(tensors[name]).all()):
            raise CheckpointError(
                "A weight is not finite", where=name, next_step=f"it may overflow {dtype}; check training"
            )
    content = save(tensors)
    write_bytes_atomic(folder / WEIGHTS, content)
    write_json_atomic(
        folder / DESCRIPTION,
        {
            "format": FORMAT,
            "version": VERSION,
            "kind": kind,
            "config": model.config.model_dump(mode="json"),
            "action_contract": dict(action_contract),
            "metadata": dict(metadata or {}),
            "dtype": str(dtype).removeprefix("torch."),
            "weights_sha256": hashlib.sha256(content).hexdigest(),
        },
    )


def read_checkpoint_info(folder: Path) -> CheckpointInfo:
    """Read ``checkpoint.json`` alone.

    Raises:
        CheckpointError: the file is missing, damaged, of another format, or has an invalid config.
    """
    path = folder / DESCRIPTION
    if not path.is_file():
        raise CheckpointError("No checkpoint here", where=folder, expected=f"a folder with {DESCRIPTION} and {WEIGHTS}")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise CheckpointError("The checkpoint description is not JSON", where=path, got=str(error)) from error
    if not isinstance(content, dict) or content.get("format") != FORMAT or content.get("version") != VERSION:
        got = {key: content.get(key) for key in ("format", "version")} if isinstance(content, dict) else type(content)
        raise CheckpointError(
            "Not a checkpoint of this version", where=path, expected={"format": FORMAT, "version": VERSION}, got=got
        )
    wanted = {"kind", "config", "action_contract", "metadata", "dtype", "weights_sha256"}
    missing = wanted - content.keys()
    if missing:
        raise CheckpointError("The checkpoint description lacks keys", where=path, expected=sorted(missing))
    if content["kind"] not in get_args(CheckpointKind):
        raise CheckpointError(
            "Unknown checkpoint kind", where=path, expected=list(get_args(CheckpointKind)), got=content["kind"]
        )
    try:
        config = WorldModelConfig.model_validate(content["config"])
    except ValidationError as error:
        raise CheckpointError("The checkpoint's model config is not valid", where=path, got=str(error)) from error
    return CheckpointInfo(
        kind=content["kind"],
        config=config,
        action_contract=content["action_contract"],
        metadata=content["metadata"],
        dtype=content["dtype"],
        weights_sha256=content["weights_sha256"],
    )


def load_checkpoint(
    folder: Path,
    *,
    expect_kind: CheckpointKind | tuple[CheckpointKind, ...] | None = None,
    towers: Literal["both", "generation"] | None = None,
    action_contract: Mapping[str, Any] | None = None,
    dtype: torch.dtype = torch.float32,
) -> tuple[WorldModel, CheckpointInfo]:
    """Build the model and fill it; nothing may be missing, left over, or of another shape.

    Args:
        expect_kind: kind or kinds the caller can use.
        towers: ``generation`` drops the understanding tower of a checkpoint that has it; None keeps what is stored.
        action_contract: keys the caller relies on; each must be stored with the same value.

    Raises:
        CheckpointError: anything that does not fit, saying what was expected and what was found.
    """
    info = read_checkpoint_info(folder)
    kinds = (expect_kind,) if isinstance(expect_kind, str) else expect_kind
    if kinds is not None and info.kind not in kinds:
        raise CheckpointError(
            "The checkpoint is of the wrong kind", where=folder, expected=" or ".join(kinds), got=info.kind
        )
    check_action_contract(info.action_contract, action_contract or {}, where=folder)
    config = info.config
    if towers == "both" and config.towers != "both":
        raise CheckpointError(
            "The checkpoint has no understanding tower", where=folder, expected="both", got=config.towers
        )
    if towers == "generation":
        config = config.model_copy(update={"towers": "generation"})
    path = folder / WEIGHTS
    if not path.is_file():
        raise CheckpointError("The checkpoint has no weights", where=path)
    content = path.read_bytes()
    digest = hashlib.sha256(content).hexdigest()
    if digest != info.weights_sha256:
        raise CheckpointError(
            "The weights are not those the checkpoint describes", where=path, expected=info.weights_sha256, got=digest
        )
    try:
        tensors = load(content)
    except SafetensorError as error:
        raise CheckpointError("The weights file is damaged", where=path, got=str(error)) from error
    if config.towers == "generation":
        tensors = {name: tensor for name, tensor in tensors.items() if not is_text_parameter(name)}
    model = WorldModel(config)
    fill(model, tensors, where=path, dtype=dtype)
    return model, info


def fill(model: torch.nn.Module, tensors: Mapping[str, Tensor], *, where: object, dtype: torch.dtype) -> None:
    """Load ``tensors`` into ``model`` in ``dtype``, strictly.

    Raises:
        CheckpointError: keys are missing or left over, or a shape differs.
    """
    own = {name: tuple(tensor.shape) for name, tensor in model.state_dict().items()}
    missing, unexpected = sorted(own.keys() - tensors.keys()), sorted(tensors.keys() - own.keys())
    if missing or unexpected:
        raise CheckpointError(
            "The weights do not fit the model",
            where=where,
            expected=f"{len(own)} tensors; missing: {', '.join(missing[:8]) or 'none'}",
            got=f"{len(tensors)} tensors; unexpected: {', '.join(unexpected[:8]) or 'none'}",
        )
    for name, shape in own.items():
        if tuple(tensors[name].shape) != shape:
            raise CheckpointError(
                "A weight has the wrong shape", where=f"{where}: {name}", expected=shape, got=tuple(tensors[name].shape)
            )
    model.to(dtype)
    model.load_state_dict({name: tensor.to(dtype) for name, tensor in tensors.items()})


def check_action_contract(stored: Mapping[str, Any], wanted: Mapping[str, Any], *, where: object) -> None:
    """Compare every key of ``wanted`` with what a checkpoint was trained on.

    Raises:
        CheckpointError: a key is absent or has another value.
    """
    for key, value in wanted.items():
        if key not in stored or stored[key] != value:
            raise CheckpointError(
                "The action contract differs from the one the model was trained with",
                where=f"{where}: {key}",
                expected=value,
                got=stored.get(key, "not stored"),
                next_step="render the action tracks with the stored contract, or use another checkpoint",
            )
