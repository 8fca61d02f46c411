"""LoRA adapters (2106.09685) on the generation tower, by `peft`: what is trained of a model, what is saved, and how it is merged.

An adapter's folder has peft's two files, so that peft reads it, and beside them the weights that were trained in full and the
description of the checkpoint that it becomes with the one it started from.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import torch
from torch import Tensor

from worldline_core.config import StrictModel
from worldline_core.errors import CheckpointError, needing
from worldline_core.model.checkpoint import (
    CHECKPOINT_DTYPE,
    CheckpointInfo,
    check_fit,
    described,
    load_checkpoint,
    read_checkpoint_info,
    read_description,
    read_weights,
    save_checkpoint,
    write_weights,
)
from worldline_core.model.layers import is_action_parameter
from worldline_core.model.networks import build_world_model
from worldline_core.model.world_model import WorldModel
from worldline_core.store.atomic import write_json_atomic
from worldline_core.training.processes import gathered, place_model, processes
from worldline_core.training.training_config import LoRAConfig, MergeAdapterConfig, TrainerConfig

logger = logging.getLogger(__name__)

FORMAT, VERSION = "worldline.adapter", 1
FOLDER, DESCRIPTION, PEFT_CONFIG = "adapter", "adapter.json", "adapter_config.json"
ADAPTERS, FULL = "adapter_model.safetensors", "full_weights.safetensors"
_MARK, _NAMED, _PREFIX = ".lora_", ".default.", "base_model.model."
"""Parts of names: of an adapter's parameters; of those in a model, where adapters have names; of those in peft's files."""


class AdapterInfo(StrictModel):
    """The content of ``adapter.json``.

    Attributes:
        start: digest of the weights that it was trained from.
        checkpoint: description of the checkpoint that it becomes with them.
        adapters, full: digests of the files of weights.
    """

    start: str
    lora: LoRAConfig
    checkpoint: CheckpointInfo
    adapters: str
    full: str


def add_adapters(model: WorldModel, config: LoRAConfig, seed: int) -> None:
    """Give every layer's attention and feed-forward an adapter, which starts without effect. Those are trained, and in full what a
    pretrained model knows nothing of: the action branches and the view embedding.

    Raises:
        UnavailableError: peft is not installed.
    """
    peft = load_peft()
    with torch.random.fork_rng([]):
        torch.manual_seed(seed)
        peft.inject_adapter_in_model(peft.LoraConfig(**_peft_settings(model, config)), model)
    for name, parameter in model.named_parameters():
        parameter.requires_grad_(_MARK in name or is_action_parameter(name) or name == "view_embedding")


def load_peft() -> ModuleType:
    """The library, which takes seconds the first time. Raises: UnavailableError: it is not installed."""
    with needing("one-gpu", "peft", where="lora"):
        import peft
    return peft


def _peft_settings(model: WorldModel, config: LoRAConfig) -> dict[str, Any]:
    return {"r": config.rank, "lora_alpha": config.scale * config.rank, "target_modules": model.adapted}


def prepare(
    model: WorldModel, trainer: TrainerConfig, lora: LoRAConfig | None, *, shared: WorldModel | None = None
) -> WorldModel:
    """Give a model that is to be trained its adapters, if any, and put it on its device (`place_model`). What adapters cost is logged.

    Args:
        shared: a frozen model of the same checkpoint, whose weights take the place of those that are not trained.
    """
    if lora is not None:
        add_adapters(model, lora, trainer.seed)
        if shared is None:
            trained = sum(parameter.numel() for parameter in model.parameters() if parameter.requires_grad)
            whole = sum(parameter.numel() for parameter in model.parameters())
            logger.warning(
                "LoRA of rank %d trains %.2g %% of the weights. It saves memory, and follows controls less well: on Cosmos3-Edge "
                "others measured an end effector 14.0 px off after 1 s, and 5.8 px after full fine-tuning (SO-101).",
                lora.rank, 100 * trained / whole,
            )  # fmt: skip
        else:
            own = dict(shared.named_parameters())
            for name, parameter in model.named_parameters():
                if not parameter.requires_grad:
                    parameter.data = own[name.replace(".base_layer.", ".")].data
    precision, weights = trainer.precision, trainer.weights
    return place_model(model, trainer.sharding, precision=precision, device=trainer.device, weights=weights)


def save_trained(
    output: Path,
    model: WorldModel,
    average: Mapping[str, Tensor],
    *,
    start: Path | None,
    lora: LoRAConfig | None,
    description: Mapping[str, Any],
    towers: Literal["both", "generation"],
) -> None:
    """Write the checkpoint of a training (the first process alone writes), and its adapter alone beside it where there is one.

    What was not trained is taken from ``start`` as it is there, not as it was rounded for training.

    Args:
        average: the trained weights, by their names in ``model``.
        start: the checkpoint that the training began with.
        description: what `save_checkpoint` takes beside weights.
        towers: of the checkpoint; ``model`` may have fewer.
    """
    config = model.config.model_copy(update={"towers": towers})
    if start is None or (config == model.config and all(one.requires_grad for one in model.parameters())):
        weights = gathered({**model.state_dict(), **average}, CHECKPOINT_DTYPE)
        if processes()[0] == 0:
            save_checkpoint(output, model, state_dict=weights, **description)
        return
    info = described(CheckpointInfo, {**description, "config": config, "dtype": "", "weights_sha256": ""}, output)
    average = {name: value.detach().float().cpu() for name, value in average.items()}
    if lora is not None:
        folder = output / FOLDER
        adapters = {f"{_PREFIX}{name.replace(_NAMED, '.')}": value for name, value in average.items() if _MARK in name}
        full = {name: value for name, value in average.items() if _MARK not in name}
        write_json_atomic(folder / PEFT_CONFIG, {"peft_type": "LORA", **_peft_settings(model, lora)})
        stated = AdapterInfo(
            start=read_checkpoint_info(start).weights_sha256, lora=lora, checkpoint=info,
            adapters=write_weights(folder / ADAPTERS, adapters, torch.float32),
            full=write_weights(folder / FULL, full, torch.float32),
        )  # fmt: skip
        write_json_atomic(
            folder / DESCRIPTION, {"format": FORMAT, "version": VERSION, **stated.model_dump(mode="json")}
        )
    _save_merged(output, start, info, average, lora)


def _save_merged(
    output: Path, start: Path, info: CheckpointInfo, trained: Mapping[str, Tensor], lora: LoRAConfig | None
) -> None:
    """Write a checkpoint: that of ``start`` with some weights put in place of its own, and ``scale B A`` added to others."""
    model, _ = load_checkpoint(start, adapt=lambda _: info.config)
    weights = model.state_dict()  # shares the model's memory
    for name, value in trained.items():
        if _MARK not in name:
            weights[name].copy_(value)
        elif lora is not None and ".lora_A." in name:
            adapted = weights[f"{name.partition(_MARK)[0]}.weight"]
            adapted.add_(trained[name.replace(".lora_A.", ".lora_B.")] @ value, alpha=lora.scale)
    kept = {
        name: getattr(info, name) for name in ("kind", "action_contract", "causal", "trained", "vectors", "metadata")
    }
    save_checkpoint(output, model, **kept)


def merge_adapter(config: MergeAdapterConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """Merge ``inputs['adapter']`` into ``inputs['start']``, the checkpoint that it was trained from.

    Raises:
        CheckpointError: the adapter is damaged, or started from another checkpoint.
    """
    del config
    folder, start = Path(inputs["adapter"]), Path(inputs["start"])
    content = read_description(folder / DESCRIPTION, FORMAT, "adapter", VERSION)
    info = described(AdapterInfo, content, folder)
    if (found := read_checkpoint_info(start).weights_sha256) != info.start:
        raise CheckpointError(
            "The adapter started from other weights", where=folder, expected=info.start, got=f"{found}, {start}",
            next_step="give the checkpoint that it was trained from",
        )  # fmt: skip
    trained = {
        name.removeprefix(_PREFIX).replace(".weight", f"{_NAMED}weight"): value
        for name, value in read_weights(folder / ADAPTERS, info.adapters).items()
    } | read_weights(folder / FULL, info.full)
    with torch.device("meta"):
        model = build_world_model(info.checkpoint.config)
        add_adapters(model, info.lora, 0)
    own = {name: tuple(value.shape) for name, value in model.named_parameters() if value.requires_grad}
    check_fit(own, trained, folder)
    _save_merged(output, start, info.checkpoint, trained, info.lora)
    return {
        "adapted": sum(".lora_A." in name for name in trained),
        "parameters": sum(v.numel() for v in trained.values()),
    }
