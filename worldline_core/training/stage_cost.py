"""What a training stage's own objective costs on its longest clips: it runs once without values (`model/step_cost.py`)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from worldline_core.model.step_cost import StepCost, cost_at_depth, cost_of, in_bfloat16, without_values
from worldline_core.model.tokenizers import tokenizer_outline
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import WorldModelConfig
from worldline_core.training.clip_config import ClipInput, FrameInput
from worldline_core.training.clip_loader import Batch
from worldline_core.training.clip_source import LatentStore
from worldline_core.training.flow_matching import FlowMatchingObjective
from worldline_core.training.relational import RelationalScales, RelationalTerm, SimilarityMatrices, common_shape
from worldline_core.training.stage_memory import (
    ClipShape,
    Estimate,
    Spread,
    StageMemory,
    largest_clips,
    require_fit,
    rough_bytes,
)
from worldline_core.training.trainer import Objective, autocast
from worldline_core.training.training_config import RelationalConfig, StageConfig, TrainerConfig
from worldline_core.training.video_teacher import teacher_outline


def trained_cost(
    objective: Callable[[WorldModel], Objective[Any]],
    batch: Callable[[], Any],
    model: WorldModelConfig,
    trainer: TrainerConfig,
    spread: Spread,
    *,
    trained: Callable[[str], bool] = lambda _: True,
    step: int = 0,
) -> StepCost:
    """What one micro-step takes: the loss and its way back.

    Args:
        objective: of a model; batch: what the loader gives. Both are made without values.
        trained: whether a parameter gets gradients, by its name.
        step: where steps differ in what they compute.
    """

    trainer = trainer.model_copy(update={"device": "cpu"})  # tensors without values follow a CPU's paths

    def trace(layers: int) -> StepCost:
        with without_values():
            network = WorldModel(model.model_copy(update={"num_layers": layers}))
            network.checkpointing = spread.checkpointing
            aim = objective(network)
            models = [value for value in vars(aim).values() if isinstance(value, nn.Module)]
            for name, parameter in network.named_parameters():
                parameter.requires_grad_(trained(name))
            if spread.shards > 1 and trainer.precision == "bf16":
                for one in models:
                    in_bfloat16(one)
            given = batch()

            def loss() -> Tensor:
                with autocast(trainer):
                    return aim.loss(given, torch.Generator(), step)[0]

            cost = cost_of(loss, [parameter for one in models for parameter in one.parameters()])
        scale = 2 if spread.shards > 1 and trainer.precision == "bf16" else 1  # summed in float32
        return replace(cost, gradients=scale * cost.gradients)

    return cost_at_depth(trace, model.num_layers)


def parameter_counts(model: WorldModelConfig, trained: Callable[[str], bool] = lambda _: True) -> tuple[int, int]:
    """Parameters that are trained, and all those of one transformer block, counted on the real model."""
    with torch.device("meta"):
        network = WorldModel(model)
    counted = sum(value.numel() for name, value in network.named_parameters() if trained(name))
    return counted, sum(value.numel() for value in network.layers[0].parameters())


def frozen_bytes(model: nn.Module) -> int:
    """Bytes of a model's weights."""
    return sum(value.numel() * value.element_size() for value in model.state_dict().values())


def encoding_cost(tokenizer: Path | None, shape: ClipShape) -> tuple[int, StepCost]:
    """Bytes of a tokenizer, and what encoding a micro-batch costs: clips and views one by one, as `FrameSource` does."""
    size, cost = _encoding_cost(tokenizer, shape.frames, shape.grid)
    return size, cost.times(shape.clips * len(shape.views))


@cache
def _encoding_cost(tokenizer: Path | None, frames: int, grid: tuple[int, int]) -> tuple[int, StepCost]:
    with without_values():
        codec = tokenizer_outline(tokenizer)
        video = torch.empty(1, 3, frames, *(side * codec.spatial_compression for side in grid))

        def encode() -> None:
            with torch.no_grad():
                codec.encode(video)

        return frozen_bytes(codec), cost_of(encode)


@cache
def teaching_cost(teacher: Path | None, shape: ClipShape, image_size: tuple[int, int]) -> tuple[int, StepCost]:
    """Bytes of a relational teacher, and what it costs for the clips of a micro-batch, one by one."""
    with without_values():
        network, features = teacher_outline(teacher)
        frames = torch.empty(len(shape.views), 3, shape.frames, *image_size)

        def teach() -> None:
            features(frames)

        return frozen_bytes(network), cost_of(teach).times(shape.clips)


def flow_matching_estimate(
    title: str,
    config: StageConfig,
    model: WorldModelConfig,
    grid: tuple[int, int],
    *,
    maps: bool,
    text: int = 0,
    tokenizer: Path | None = None,
    relational: RelationalConfig | None = None,
    teacher: Path | None = None,
    trained: Callable[[str], bool] = lambda _: True,
) -> Estimate:
    """What Stage I or II takes.

    Args:
        grid: rows and columns of the latents.
        maps: whether controls are given; text: tokens of every clip's text, 0 without.
        tokenizer, teacher: folders; where there is none, the published shapes at full size.
        trained: whether a parameter is trained, by its name.
    """

    def estimate(spread: Spread) -> StageMemory:
        trainer = config.trainer
        shape = largest_clips(config.clips, trainer.batch_size, model.views, grid, spread.frames)
        frozen: dict[str, int] = {}
        before = StepCost()
        if isinstance(config.input, FrameInput):
            frozen["tokenizer"], before = encoding_cost(tokenizer, shape)
        if relational is not None:
            size = config.input.image_size if isinstance(config.input, FrameInput) else (8 * grid[0], 8 * grid[1])
            frozen["teacher"], teaching = teaching_cost(teacher, shape, size)
            before = before.then(teaching)

        def objective(network: WorldModel) -> FlowMatchingObjective:
            # The student's middle layer: where it lies makes no difference to what is held.
            term = None if relational is None else _OutlinedRelations(relational, shape, network)
            return FlowMatchingObjective(network, sigma=config.sigma, weighting=config.weighting, relational=term)

        cost = trained_cost(
            objective, lambda: shape.batch(model, maps=maps, text=text), model, trainer, spread, trained=trained
        )
        counts = parameter_counts(model, trained)
        return StageMemory(title, trainer, spread, shape, shape.tokens(model), *counts, cost, frozen, before=before)

    return estimate


def require_stage_fits(
    title: str, config: StageConfig, model: WorldModelConfig, inputs: Mapping[str, Path], **more: Any
) -> None:
    """Refuse Stage I or II before anything is loaded, where its device cannot hold it; ``more``: see `flow_matching_estimate`.

    Raises:
        ConfigError: the sheet's line, and the setting that would fit.
    """
    grid = latent_grid(config.input, inputs)
    if grid is None:
        return  # `Stage.open` says so
    folders = {name: Path(inputs[name]) for name in ("tokenizer", "teacher") if name in inputs}
    estimate = flow_matching_estimate(title, config, model, grid, **folders, **more)
    shape = largest_clips(config.clips, config.trainer.batch_size, model.views, grid)
    require_fit(estimate, config.trainer, config.clips.lengths, rough_bytes(model, shape))


def latent_grid(reading: ClipInput, inputs: Mapping[str, Path]) -> tuple[int, int] | None:
    """Rows and columns of the latents that a training reads; None where the input that they come from is not given."""
    if isinstance(reading, FrameInput) and "tokenizer" in inputs:
        with without_values():
            space = tokenizer_outline(Path(inputs["tokenizer"])).spatial_compression
        return reading.image_size[0] // space, reading.image_size[1] // space
    if not isinstance(reading, FrameInput) and "latents" in inputs:
        return LatentStore.open(Path(inputs["latents"])).latent_shape[1:]
    return None


class _OutlinedRelations(RelationalTerm):
    """The relational terms with a teacher that has answered already."""

    def __init__(self, config: RelationalConfig, shape: ClipShape, model: WorldModel) -> None:
        self.config = config
        self.layer = max(1, model.config.num_layers // 2)
        self.scales = RelationalScales(config)
        self.shape = shape

    def targets(self, batch: Batch, grid: tuple[int, int, int]) -> SimilarityMatrices:
        bins, rows, columns = common_shape(self.config, grid)
        cells, clips, views = rows * columns, self.shape.clips, len(self.shape.views)
        return SimilarityMatrices(
            (bins, rows, columns),
            torch.empty(clips, views, bins - 1, cells, cells),
            torch.empty(clips, views - 1, bins, cells, cells),
        )
