"""How much memory Stage III takes: each step's own objective, and the teacher's trajectories, without values."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import torch
from torch import Tensor, nn

from worldline_core.distillation.auxiliary_losses import PerceptualLoss
from worldline_core.distillation.causal_objective import CausalObjective, maps_of
from worldline_core.distillation.causal_teacher_forcing import TeacherForcingObjective
from worldline_core.distillation.distill_config import CYCLE, DistillConfig
from worldline_core.distillation.distribution_matching import DistributionMatchingObjective
from worldline_core.distillation.teacher_trajectories import teacher_trajectories
from worldline_core.distillation.trajectory_regression import TrajectoryObjective
from worldline_core.distillation.trajectory_store import TrajectoryBatch
from worldline_core.errors import ConfigError
from worldline_core.model.lpips import LPIPS
from worldline_core.model.step_cost import StepCost, cost_at_depth, cost_of, in_bfloat16, without_values
from worldline_core.model.tokenizers import tokenizer_outline
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import WorldModelConfig
from worldline_core.training.clip_config import ClipSampling, FrameInput
from worldline_core.training.clip_sampler import latent_frame_count
from worldline_core.training.stage_cost import encoding_cost, frozen_bytes, parameter_counts, trained_cost
from worldline_core.training.stage_memory import (
    USABLE,
    ClipShape,
    Estimate,
    Spread,
    StageMemory,
    device_memory,
    gigabytes,
    largest_clips,
    require_fit,
    rough_bytes,
)
from worldline_core.training.trainer import autocast
from worldline_core.training.training_config import TrainerConfig

TEACHER_FORCING = "distill: teacher forcing"


@dataclass(frozen=True)
class DistillEstimates:
    """What each step takes.

    Attributes:
        model: the generation tower; grid: rows and columns of the latents; tokenizer: its folder.
    """

    config: DistillConfig
    model: WorldModelConfig
    grid: tuple[int, int]
    tokenizer: Path | None = None

    def steps(self) -> dict[str, Estimate]:
        """By the steps' names, in their order."""
        return {
            "teacher_forcing": self._teacher_forcing,
            "trajectory_regression": self._trajectory_regression,
            "distribution_matching": self._distribution_matching,
        }

    def require_fit(self) -> None:
        """Refuse a step that its device cannot hold, before anything is loaded.

        Raises:
            ConfigError: the sheet's line, and the setting that would fit.
        """
        for name, estimate in self.steps().items():
            trainer: TrainerConfig = getattr(self.config, name).trainer
            shape = self._shape(trainer, Spread())
            taught = name == "teacher_forcing" and self.config.teacher_forcing.teacher_share > 0
            rough = rough_bytes(self.model, shape, models=3 if name == "distribution_matching" else 1 + taught)
            if self.config.lpips_weights is not None:
                # Decoding eight frames of a view keeps some hundreds of values for each of their pixels.
                rough += 4000 * 8 * shape.clips * len(shape.views) * 256 * shape.grid[0] * shape.grid[1]
            require_fit(estimate, trainer, self.config.clips.lengths, rough)
        memory = device_memory(self.config.trajectory_regression.trainer.device)
        if 2 * rough_bytes(self.model, self.shard) > memory:
            teacher, cost = self.trajectories()
            if teacher + cost.activations > USABLE * memory:
                raise ConfigError(
                    "A shard of the teacher's trajectories does not fit the device's memory.",
                    where="distill.trajectory_regression.trajectories",
                    expected=f"at most {gigabytes(USABLE * memory)} GB",
                    got=f"teacher {gigabytes(teacher)}, {self.shard.clips} clips {gigabytes(cost.activations)}",
                    next_step="set fewer clips_per_shard; `worldline plan` shows every stage",
                )

    @property
    def shard(self) -> ClipShape:
        """The clips of one shard of trajectories: they are made together."""
        settings = self.config.trajectory_regression.trajectories
        clips = min(settings.clips, settings.clips_per_shard)
        return ClipShape(clips, tuple(self.config.views), max(self.config.clips.lengths), self.grid)

    def trajectories(self) -> tuple[int, StepCost]:
        """Bytes of the teacher that makes trajectories, whole on every device, and the cost of a shard."""
        regression, shape = self.config.trajectory_regression, self.shard

        def trace(layers: int) -> StepCost:
            with without_values():
                teacher = WorldModel(self.model.model_copy(update={"num_layers": layers})).requires_grad_(False)
                batch = shape.batch(self.model, maps=True)
                maps, noise = maps_of(batch), torch.empty_like(batch.latents)

                def make() -> Tensor:
                    with autocast(regression.trainer.model_copy(update={"device": "cpu"})):
                        return teacher_trajectories(
                            teacher, batch.latents, maps, noise, views=batch.views, spec=self.config.spec,
                            substeps=regression.trajectories.substeps,
                        )  # fmt: skip

                return cost_of(make)

        encoder, encoding = self._encoding(shape)
        made = cost_at_depth(trace, self.model.num_layers, forward_only=True)
        return 4 * parameter_counts(self.model)[0] + encoder, made if encoding is None else encoding.then(made)

    def _encoding(self, shape: ClipShape) -> tuple[int, StepCost | None]:
        """Bytes of what encodes clips on the way, and its cost; none where latents are cached."""
        return encoding_cost(self.tokenizer, shape) if isinstance(self.config.input, FrameInput) else (0, None)

    def _teacher_forcing(self, spread: Spread) -> StageMemory:
        settings = self.config.teacher_forcing
        views = {"view_weights": settings.view_weights, "single_view_factor": settings.single_view_factor}
        shape = self._shape(settings.trainer, spread, self.config.clips.model_copy(update=views))

        def objective(model: WorldModel) -> TeacherForcingObjective:
            return TeacherForcingObjective(model, self.config, WorldModel(model.config) if taught else None)

        taught = settings.teacher_share > 0
        memory = self._memory(TEACHER_FORCING, settings.trainer, spread, shape, objective)
        return replace(memory, frozen_parts=4 * memory.trained) if taught else memory

    def _trajectory_regression(self, spread: Spread) -> StageMemory:
        settings = self.config.trajectory_regression
        shape = self._shape(settings.trainer, spread)
        return self._memory(
            "distill: trajectory regression", settings.trainer, spread, shape,
            lambda model: TrajectoryObjective(model, self.config, None), perceptual=True,
        )  # fmt: skip

    def _distribution_matching(self, spread: Spread) -> StageMemory:
        """The student's turn and the fake score's; both have weights and moments, one at a time has gradients."""
        settings = self.config.distribution_matching
        shape = self._shape(settings.trainer, spread)

        def objective(model: WorldModel) -> DistributionMatchingObjective:
            real, fake = WorldModel(model.config), WorldModel(model.config)
            fake.checkpointing = spread.checkpointing
            return DistributionMatchingObjective(model, real, fake, self.config, None)

        def turn(step: int) -> StageMemory:
            title = "distill: distribution matching"
            return self._memory(title, settings.trainer, spread, shape, objective, step=step, perceptual=step > 0)

        fake, student = turn(0), turn(CYCLE - 1)
        both = student.cost.then(fake.cost)
        products = student.cost.times(1 / CYCLE).then(fake.cost.times(1 - 1 / CYCLE)).products
        return replace(
            student,
            trained=2 * student.trained,
            frozen_parts=4 * student.trained,
            not_averaged=student.trained,
            cost=replace(both, products=products),
        )

    def _memory(
        self,
        title: str,
        trainer: TrainerConfig,
        spread: Spread,
        shape: ClipShape,
        objective: Callable[[WorldModel], CausalObjective[TrajectoryBatch]]
        | Callable[[WorldModel], TeacherForcingObjective],
        *,
        step: int = 0,
        perceptual: bool = False,
    ) -> StageMemory:
        cost = trained_cost(objective, lambda: self._batch(shape), self.model, trainer, spread, step=step)
        frozen: dict[str, int] = {}
        if self.config.lpips_weights is not None and title != TEACHER_FORCING:
            frozen["tokenizer"], decoding = perceptual_cost(
                self.tokenizer, shape, self.config.perceptual.latent_frames, bfloat16=self.config.perceptual.bfloat16
            )
            if perceptual:
                # It comes last in the forward pass, and is over when the way back begins.
                held = cost.kept + decoding.activations
                cost = replace(
                    cost,
                    activations=max(cost.activations, held),
                    peak=max(cost.peak, held),
                    products=cost.products + decoding.products,
                )
        counts = parameter_counts(self.model)
        encoder, encoding = self._encoding(shape)
        if encoding is not None:
            frozen["encoder"] = encoder
        # Trajectories keep the latents of their clips.
        before = encoding if encoding is not None and title == TEACHER_FORCING else StepCost()
        return StageMemory(
            title, trainer, spread, shape, shape.tokens(self.model), *counts, cost, frozen, before=before
        )

    def _shape(self, trainer: TrainerConfig, spread: Spread, clips: ClipSampling | None = None) -> ClipShape:
        return largest_clips(
            clips or self.config.clips, trainer.batch_size, self.config.views, self.grid, spread.frames
        )

    def _batch(self, shape: ClipShape) -> TrajectoryBatch:
        plain = shape.batch(self.model, maps=True)
        clips, views, channels, frames, *grid = plain.latents.shape
        size = (clips, self.config.spec.steps + 1, views, channels, frames - 1, *grid)
        mask = torch.ones(clips, views, frames, *grid)
        return TrajectoryBatch(**vars(plain), nodes=torch.empty(size), history=plain.latents, mask=mask)


@cache
def perceptual_cost(
    tokenizer: Path | None, shape: ClipShape, latent_frames: int, *, bfloat16: bool
) -> tuple[int, StepCost]:
    """Bytes of tokenizer and LPIPS, and what the perceptual term costs, its gradients too."""
    with without_values():
        codec, network = tokenizer_outline(tokenizer), LPIPS().requires_grad_(False)
        if bfloat16:
            in_bfloat16(codec)
        distance = PerceptualLoss(codec, network, latent_frames)
        # One view after the other, each like the first.
        size = (1, 1, codec.latent_channels, latent_frame_count(shape.frames), *shape.grid)
        predicted, target = nn.Parameter(torch.empty(size)), torch.empty(size)
        cost = cost_of(lambda: distance(predicted, target), [predicted]).times(shape.clips * len(shape.views))
        return frozen_bytes(codec) + frozen_bytes(network), cost
