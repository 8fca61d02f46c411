"""What the distillation of a run trains, Stage III: its three steps, on batches out of memory that depend on the step alone.

Axes: b clips, v views, c latent channels, t latent frames, h and w rows and columns.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from tools.small_world_data import SHORT, VIEWS
from tools.small_world_memory import Memory
from tools.small_world_runs import ForcingSettings, MatchingSettings, RegressionSettings
from tools.small_world_steps import Start, Step, compile_pass, drawn, named, object_weights
from worldline_core.distillation.causal_objective import maps_of
from worldline_core.distillation.causal_teacher_forcing import TeacherForcingObjective
from worldline_core.distillation.distill_config import DistillConfig
from worldline_core.distillation.distribution_matching import DistributionMatchingObjective
from worldline_core.distillation.teacher_trajectories import TrajectoryBatch, teacher_trajectories
from worldline_core.distillation.trajectory_regression import TrajectoryObjective
from worldline_core.errors import ConfigError
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import CAUSAL_SIGMAS
from worldline_core.training.clip_loader import Batch
from worldline_core.training.stage import VALIDATION_SEED
from worldline_core.training.trainer import (
    ParameterGroup,
    held_out_losses,
    step_generator,
)
from worldline_core.training.training_config import TrainerConfig

LONG_BLOCKS = 4
"""Blocks of a cut of a long recording: 65 frames."""
MOST_VALIDATED = 120
"""Validation recordings that are looked at while a model trains."""


def distillation(seed: int, sigmas: tuple[float, ...], forcing: ForcingSettings | None = None) -> DistillConfig:
    """Stage III of the small world: no perceptual term, plain few-step trajectories, recorded targets."""
    first: dict[str, Any] = {}
    if forcing is not None:
        named = {"sigma", "history", "history_noise"} | ({"teacher_share"} if forcing.teacher else set())
        first = {**forcing.model_dump(include=named), "teacher_frames": SHORT, "weighting": {"motion": 1.0}}
    without_lpips = {"auxiliary": {"lpips": 0.0}}
    return DistillConfig.model_validate(
        {
            "clips": {"lengths": [SHORT, 1 + 16 * LONG_BLOCKS]},
            "sigmas": sigmas,
            "teacher_forcing": first,
            "trajectory_regression": {**without_lpips, "trajectories": {"substeps": [1] * (len(sigmas) - 1)}},
            "distribution_matching": {
                **without_lpips,
                "sigma_range": [0.1, 0.98],
                "target": "recorded",
                "trainer": {"steps": 6, "log_every": 6, "seed": seed},
            },
        }
    )


def is_long(number: int, every: int) -> bool:
    """Whether a batch is one of long recordings."""
    return every > 0 and number % every == every - 1


def recorded_batch(
    memory: Memory,
    size: int,
    draws: torch.Generator,
    *,
    long: bool,
    action_frames: int,
    things: tuple[float, float] = (0.0, 0.0),
) -> TrajectoryBatch:
    """Clips and where the robot is; long ones are a third as many. The nodes are the recording itself.

    Args:
        action_frames: control frames whose maps a latent frame takes.
        things: extra weight of what the task moves, and of other things.
    """
    episodes = memory.episodes(short=not long)
    rows = drawn(len(episodes), size // 3 if long else size, draws)
    if long:
        starts = drawn(episodes.latents.shape[3] - 4 * LONG_BLOCKS, len(rows), draws)
        latents, maps, robot, shares = episodes.cuts(rows, starts, LONG_BLOCKS, action_frames)
    else:
        latents, maps, robot, shares = episodes.clips(rows, action_frames)
    return TrajectoryBatch(
        clips=named(episodes, rows),
        views=VIEWS,
        latents=latents,
        action_maps=maps,
        weights=object_weights(shares, *things),
        nodes=latents[:, None],
        history=latents,
        mask=robot,
    )


class ForcingObjective(TeacherForcingObjective):
    """Teacher forcing whose noise on recorded blocks has a level of its own for each clip."""

    def disturbance(self, noise: Tensor, generator: torch.Generator) -> Tensor:
        level = torch.rand((len(noise), 1, 1, 1, 1, 1), generator=generator, device=noise.device)
        return level * super().disturbance(noise, generator)


def student(start: Start, forcing: ForcingSettings | None = None) -> tuple[WorldModel, DistillConfig, dict[str, Any]]:
    """The model that is distilled, how, and what it is saved with.

    Args:
        forcing: names the nodes of its sampler; None: it has them.

    Raises: ConfigError for a model of other views or controls than the three views and action maps.
    """
    model, info = start.loaded(start.parent, "stage2", "causal")
    if info.views != VIEWS or info.config.native_size is not None:
        raise ConfigError(
            "The causal model takes maps and all views", where=start.parent, expected=VIEWS, got=info.views
        )
    own = CAUSAL_SIGMAS if info.causal is None else info.causal.sigmas
    config = distillation(start.seed, own if forcing is None else forcing.sigmas, forcing)
    return model, config, {"model": model, "kind": "causal", "action_contract": info.contract, "causal": config.spec}


def student_groups(model: WorldModel) -> list[ParameterGroup]:
    """All parameters of the model that is distilled."""
    return [ParameterGroup("student", dict(model.named_parameters()))]


def forcing_step(start: Start, settings: ForcingSettings) -> Step:
    """Causal teacher forcing."""
    memory = start.memory
    model, config, saved = student(start, settings)
    if settings.compile:
        compile_pass(model, "forward_teacher_forcing")
    teacher = None if settings.teacher is None else start.loaded(settings.teacher, "stage2")[0]
    objective = ForcingObjective(model, config, teacher)

    def load(index: int) -> Batch:
        long = is_long(index, settings.long_every)
        return recorded_batch(
            memory,
            settings.batch,
            start.draws(index),
            long=long,
            action_frames=model.config.action_frames,
            things=settings.things,
        )

    def held_out(trainer: TrainerConfig) -> dict[str, float]:
        episodes, batches = memory.episodes("validation"), trainer.validation_batches
        size = max(1, min(MOST_VALIDATED, len(episodes)) // batches)

        def batch(index: int) -> Batch:
            rows = torch.arange(index * size, (index + 1) * size) % len(episodes)
            latents, maps, _, _ = episodes.clips(rows, model.config.action_frames)
            return Batch(named(episodes, rows), VIEWS, latents, maps)

        return held_out_losses(trainer, batch, objective.validation_losses, VALIDATION_SEED)

    return Step(objective, student_groups(model), load, saved, held_out if memory.count("validation") else None)


def regression_step(start: Start, settings: RegressionSettings) -> Step:
    """Trajectory regression, on trajectories of the model it starts from."""
    model, config, saved = student(start)
    teacher = start.loaded(start.parent, "causal")[0].eval().requires_grad_(False)
    stored = [trajectories(start, teacher, config, settings, number) for number in range(settings.batches)]

    def load(index: int) -> Batch:
        draws = start.draws(index)
        made = stored[int(drawn(len(stored), 1, draws))]
        rows = torch.randperm(len(made.latents), generator=draws)[: settings.batch]
        parts = {name: value[rows].float() for name, value in vars(made).items() if isinstance(value, Tensor)}
        return TrajectoryBatch(clips=tuple(made.clips[row] for row in rows.tolist()), views=VIEWS, **parts)

    return Step(TrajectoryObjective(model, config, None), student_groups(model), load, saved)


def trajectories(
    start: Start, teacher: WorldModel, config: DistillConfig, settings: RegressionSettings, number: int
) -> TrajectoryBatch:
    """The teacher's trajectories of some clips, in half precision: a function of seed and number."""
    # Negative numbers are no steps: these are other clips than the steps'.
    draws = start.draws(-1 - number)
    batch = recorded_batch(
        start.memory,
        settings.clips,
        draws,
        long=is_long(number, settings.long_every),
        action_frames=teacher.config.action_frames,
    )
    device = batch.latents.device
    noise = torch.randn(
        batch.latents.shape, generator=step_generator(start.seed, -1 - number, str(device)), device=device
    )
    with torch.autocast(device.type, torch.bfloat16):
        nodes = teacher_trajectories(
            teacher,
            batch.latents,
            maps_of(batch),
            noise,
            views=VIEWS,
            spec=config.spec,
            substeps=config.trajectory_regression.trajectories.substeps,
        )
    halves = {name: value.half() for name, value in vars(batch).items() if isinstance(value, Tensor)}
    return TrajectoryBatch(clips=batch.clips, views=VIEWS, **{**halves, "nodes": nodes.half()})


def matching_step(start: Start, settings: MatchingSettings) -> Step:
    """Distribution matching with the score of the run's Stage II model."""
    model, config, saved = student(start)
    real, fake = (start.loaded(start.stage2, "stage2")[0] for _ in range(2))
    rate = config.distribution_matching.fake_score_rate
    groups = [
        *student_groups(model),
        ParameterGroup("fake score", dict(fake.named_parameters()), rate, averaged=False),
    ]

    def load(index: int) -> Batch:
        taken = model.config.action_frames
        return recorded_batch(start.memory, settings.batch, start.draws(index), long=False, action_frames=taken)

    return Step(DistributionMatchingObjective(model, real, fake.train(), config, None), groups, load, saved)
