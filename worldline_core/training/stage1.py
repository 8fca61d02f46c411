"""Stage I: action-free, text-conditioned prediction of a single task-facing view (method.md sections 1 and 4)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import torch
from pydantic import Field

from worldline_core.config.base import StrictModel
from worldline_core.model.checkpoint import load_checkpoint, save_checkpoint
from worldline_core.model.world_model import WorldModel, WorldModelConfig, is_text_parameter
from worldline_core.training.clip_loader import ClipLoader
from worldline_core.training.clip_sampler import ClipSampler, ClipSampling, source_counts
from worldline_core.training.episode_rows import training_rows
from worldline_core.training.flow_matching import LossWeighting, SigmaSampling
from worldline_core.training.latent_store import LatentStore
from worldline_core.training.objective import FlowMatchingObjective
from worldline_core.training.text import TextConfig, load_text_encoder
from worldline_core.training.trainer import ParameterGroup, TrainerConfig, process_rank, train
from worldline_core.training.validation import validation_function


class Stage1Config(StrictModel):
    """``model`` describes a model that starts from scratch; with the input ``base``, that checkpoint's own is used."""

    kind: Literal["base", "stage1"] = "stage1"
    model: WorldModelConfig = Field(default_factory=lambda: WorldModelConfig.model_validate({}))
    trainer: TrainerConfig
    clips: ClipSampling = ClipSampling(view_weights={"primary": 1.0})
    splits: tuple[str, ...] = ("train",)
    validation_splits: tuple[str, ...] = ("validation",)
    text: TextConfig = TextConfig()
    text_dropout: float = Field(default=0.1, ge=0, le=1)
    sigma: SigmaSampling = SigmaSampling()
    weighting: LossWeighting = LossWeighting()


def stage1_groups(model: WorldModel) -> list[ParameterGroup]:
    """All parameters of both towers; the action branch is untouched, so it is still zero when Stage II begins."""
    return [
        ParameterGroup("generation", dict(model.generation_parameters())),
        ParameterGroup("text", {name: value for name, value in model.named_parameters() if is_text_parameter(name)}),
    ]


def train_stage1(config: Stage1Config, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """Train on ``inputs['latents']`` (episodes that ``inputs['episodes']`` allows), optionally from ``inputs['base']``.

    Raises:
        CheckpointError: if ``base`` is not a base or Stage I checkpoint.
        DataError: if no clip is long enough, or latents are not finite.
    """
    torch.manual_seed(config.trainer.seed)
    if "base" in inputs:
        model, info = load_checkpoint(Path(inputs["base"]), expect_kind=("base", "stage1"), towers="both")
        start = info.weights_sha256
    else:
        model = WorldModel(config.model)
        model.initialise(torch.Generator().manual_seed(config.trainer.seed))
        start = "scratch"
    model.to(config.trainer.device).train()
    store = LatentStore.open(Path(inputs["latents"]))
    rows = training_rows(store, Path(inputs["episodes"]), stage=1)
    text = load_text_encoder(config.text, model.config.vocab_size)
    loader = ClipLoader(store, views=model.config.views, text=text, device=config.trainer.device)
    rank, world_size = process_rank()
    sampler = ClipSampler(
        store,
        config.clips,
        splits=config.splits,
        batch_size=config.trainer.batch_size,
        seed=config.trainer.seed,
        rank=rank,
        world_size=world_size,
        rows=rows,
    )
    objective = FlowMatchingObjective(
        model, sigma=config.sigma, weighting=config.weighting, text_dropout=config.text_dropout
    )
    result = train(
        config.trainer,
        groups=stage1_groups(model),
        objective=objective,
        load=lambda index: loader.load(sampler.clips(index)),
        validate=validation_function(
            store, config.clips, config.validation_splits, config.trainer, rows, loader, objective
        ),
        output=output,
        identity={
            "config": config.model_dump(mode="json"),
            "start": start,
            "tokenizer": store.description["tokenizer"],
        },
        title="stage I" if config.kind == "stage1" else "base",
        rank=rank,
        world_size=world_size,
    )
    used = [row for row in rows if row.split in config.splits]
    metadata = {
        "step": config.trainer.steps,
        "seed": config.trainer.seed,
        "start": start,
        "tokenizer": store.description["tokenizer"],
        "episodes": len(used),
        "sources": source_counts(used),
        "text": config.text.model_dump(mode="json"),
        "metrics": result.metrics,
    }
    if rank == 0:
        weights = {**model.state_dict(), **result.average}
        save_checkpoint(output, model, kind=config.kind, action_contract={}, metadata=metadata, state_dict=weights)
    parameters = sum(value.numel() for value in model.parameters())
    clips = config.trainer.steps * config.trainer.batch_size * config.trainer.accumulation * world_size
    return {"steps": config.trainer.steps, "clips": clips, "parameters": parameters, **result.metrics}
