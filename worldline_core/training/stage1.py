"""Stage I: action-free, text-conditioned prediction of a single task-facing view (docs/method.md sections 1 and 4)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from worldline_core.errors import ConfigError
from worldline_core.model.checkpoint import CheckpointInfo, load_checkpoint, read_checkpoint_info
from worldline_core.model.layers import is_action_parameter
from worldline_core.model.networks import build_world_model
from worldline_core.model.text import load_text_encoder
from worldline_core.model.world_model import WorldModel
from worldline_core.training.flow_matching import FlowMatchingObjective
from worldline_core.training.processes import hold_weights, processes
from worldline_core.training.stage import Stage
from worldline_core.training.stored_text import StoredText, prompts_of
from worldline_core.training.trainer import ParameterGroup, autocast, trained_groups
from worldline_core.training.training_config import Stage1Config


def is_trained(name: str) -> bool:
    """Returns whether Stage I trains a parameter: all of both towers, not the action branch."""
    return not is_action_parameter(name)


def stage1_groups(model: WorldModel) -> list[ParameterGroup]:
    """What is trained of both towers; the action branch is untouched, so it is still zero when Stage II begins."""
    generation = ParameterGroup("generation", dict(model.generation_parameters()))
    return trained_groups(generation, ParameterGroup("text", dict(model.text_parameters())))


def train_stage1(config: Stage1Config, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """Train on ``inputs['episodes']``, by cached ``latents`` or by frames and a ``tokenizer``; optionally from ``base``.

    Raises:
        CheckpointError: if ``base`` is not a base or Stage I checkpoint.
        ConfigError: if the text does not fit the model's vocabulary.
        DataError: if no clip is long enough, or one cannot be read.
    """

    parent = Path(inputs["base"]) if "base" in inputs else None
    title = "stage I" if config.kind == "stage1" else "base"
    if parent is None and config.text_tower != "trained":
        raise ConfigError(
            "A text tower that is not trained comes from a checkpoint", where=f"{title}: text_tower", expected="an input base",
            got="none", next_step="give --input base=FOLDER, or set text_tower to trained",
        )  # fmt: skip

    def load_model() -> tuple[WorldModel, CheckpointInfo | None]:
        if parent is not None:
            towers = "generation" if config.text_tower == "stored" else "both"
            first = processes()[0] == 0
            model, info = load_checkpoint(parent, expect_kind=("base", "stage1"), towers=towers, weights=first)
            for _, parameter in model.text_parameters():
                parameter.requires_grad_(config.text_tower == "trained")
            return model, info
        model = build_world_model(config.model)
        model.initialise(torch.Generator().manual_seed(config.trainer.seed))
        return model, None

    stage = Stage.open(config, inputs, output, number=1, title=title, load_model=load_model, parent=parent)
    model = stage.model
    loader = stage.loader(text=load_text_encoder(config.text, model.config))
    objective = FlowMatchingObjective(
        model, sigma=config.sigma, weighting=config.weighting, text_dropout=config.text_dropout
    )
    if parent is not None and config.text_tower == "stored":
        objective.encode_text = _stored_text(config, parent, prompts_of(loader, stage.rows, config.clips))
    result = stage.train(objective, stage1_groups(model), loader)
    facts = {"start": stage.start, "text": config.text.model_dump(mode="json")}
    towers = None if parent is None else read_checkpoint_info(parent).config.towers
    counts = stage.save(result, kind=config.kind, action_contract=None, facts=facts, towers=towers)
    parameters = sum(value.numel() for value in model.parameters())
    return {**counts, "parameters": parameters, **result.metrics}


def _stored_text(config: Stage1Config, base: Path, prompts: Sequence[tuple[int, ...]]) -> StoredText:
    """Keys and values of the prompts, by the text tower of ``base``, which alone is on the device meanwhile."""
    trainer = config.trainer
    model, _ = load_checkpoint(base, towers="both")
    hold_weights(model.requires_grad_(False), trainer.precision)
    for _, parameter in model.text_parameters():
        parameter.data = parameter.data.to(trainer.device)
    with autocast(trainer):
        return StoredText(model, prompts, trainer.device)
