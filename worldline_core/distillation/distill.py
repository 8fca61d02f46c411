"""The distill step: Stage II in, a four-step block-causal simulator out (paper, Stage III).

Folder: `teacher_forcing/` and `trajectory_regression/` hold the intermediate checkpoints (kind "causal"; both can be
rolled out), every step has its `metrics.jsonl`, the result itself lies at the top. `run/` keeps the training states and
the offline trajectories; a killed run continues there, and on a CPU ends with the same bytes.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from worldline_core.distillation.batches import TrajectoryLoader, TrajectoryMaker
from worldline_core.distillation.distill_config import DistillConfig
from worldline_core.distillation.distillation_step import LPIPS_OFF, STEPS, DistillationStage, named_parameters
from worldline_core.distillation.objectives import (
    DistributionMatchingObjective,
    TeacherForcingObjective,
    TrajectoryObjective,
)
from worldline_core.distillation.teacher_trajectories import INDEX, NODES, TrajectoryStore, write_trajectories
from worldline_core.errors import ConfigError
from worldline_core.model.checkpoint import CheckpointInfo, load_checkpoint
from worldline_core.store.atomic import write_bytes_atomic
from worldline_core.training.clip_source import TEMPORAL_COMPRESSION
from worldline_core.training.trainer import ParameterGroup, TrainerConfig, wait_for_all

__all__ = ["DistillConfig", "distill"]


def distill(config: DistillConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """Distill `stage2` on `latents`, `tracks` and `episodes`; `tokenizer` decodes frames for the perceptual term.

    Raises:
        CheckpointError: the checkpoint is not of Stage II, or its action maps and latents are not those given here.
        DataError: no clip fits the blocks.
        TrainingError: a loss or gradient is not finite.
    """
    torch.manual_seed(config.teacher_forcing.trainer.seed)
    stage = DistillationStage.open(config, inputs, output)
    metrics = {
        **_teacher_forcing(stage),
        **_trajectory_regression(stage),
        **_distribution_matching(stage),
    }
    return {
        "steps": {name: getattr(config, name).trainer.steps for name in STEPS},
        "lpips": "on" if stage.perceptual is not None else LPIPS_OFF,
        "episodes": len([row for row in stage.rows if row.split in config.splits]),
        **metrics,
    }


def _teacher_forcing(stage: DistillationStage) -> dict[str, float]:
    settings = stage.config.teacher_forcing
    model, info = load_checkpoint(stage.stage2, expect_kind="stage2", towers="generation")
    _check_clips(stage.config)
    views = {"view_weights": settings.view_weights, "single_view_factor": settings.single_view_factor}
    clips = stage.config.clips.model_copy(update=views)
    sampler = stage.sampler(settings.trainer.batch_size, settings.trainer.seed, distributed=True, clips=clips)
    return stage.train_step(
        STEPS[0],
        settings.trainer,
        model,
        TeacherForcingObjective(model.to(settings.trainer.device).train(), stage.config),
        lambda index: stage.loader.load(sampler.clips(index)),
        info,
    )


def _trajectory_regression(stage: DistillationStage) -> dict[str, float]:
    settings = stage.config.trajectory_regression
    parent = stage.folder(STEPS[0])
    student, info = load_checkpoint(parent, expect_kind="causal")
    trajectories = _trajectories(stage, parent, info)
    return stage.train_step(
        STEPS[1],
        settings.trainer,
        student,
        TrajectoryObjective(student.to(settings.trainer.device).train(), stage.config, stage.perceptual),
        _trajectory_loader(stage, trajectories, settings.trainer).load,
        info,
    )


def _distribution_matching(stage: DistillationStage) -> dict[str, float]:
    settings = stage.config.distribution_matching
    student, info = load_checkpoint(stage.folder(STEPS[1]), expect_kind="causal")
    teacher = stage.stage2 if settings.real_score == "stage2" else stage.folder(STEPS[0])
    real, fake = (load_checkpoint(teacher, towers="generation")[0].to(settings.trainer.device) for _ in range(2))
    objective = DistributionMatchingObjective(
        student.to(settings.trainer.device).train(), real, fake.train(), stage.config, stage.perceptual
    )
    trajectories = TrajectoryStore.open(_trajectory_folder(stage))
    groups = (ParameterGroup("fake", named_parameters(fake, "fake."), settings.fake_score_rate),)
    return stage.train_step(
        STEPS[2],
        settings.trainer,
        student,
        objective,
        _trajectory_loader(stage, trajectories, settings.trainer).load,
        info,
        groups,
    )


def _trajectories(stage: DistillationStage, teacher_folder: Path, info: CheckpointInfo) -> TrajectoryStore:
    """The offline trajectories of the causal teacher; shards that exist are kept."""
    settings = stage.config.trajectory_regression.trajectories
    trainer = stage.config.trajectory_regression.trainer
    folder = _trajectory_folder(stage)
    if stage.rank == 0 and not (folder / INDEX).is_file():
        teacher, _ = load_checkpoint(teacher_folder, expect_kind="causal")
        per_shard = min(settings.clips, settings.clips_per_shard)
        sampler = stage.sampler(per_shard, settings.seed, distributed=False)
        maker = TrajectoryMaker(stage.config, trainer, teacher.to(trainer.device), stage.loader, sampler)
        write_trajectories(
            folder,
            -(-settings.clips // per_shard),
            maker,
            {
                "teacher": info.weights_sha256,
                "nodes": list(NODES),
                "precision": trainer.precision,
                "clips": stage.config.clips.model_dump(mode="json"),
                **settings.model_dump(mode="json"),
            },
        )
    if stage.rank == 0:
        write_bytes_atomic(stage.output / STEPS[1] / INDEX, (folder / INDEX).read_bytes())
    wait_for_all()
    return TrajectoryStore.open(folder)


def _trajectory_folder(stage: DistillationStage) -> Path:
    return stage.output / "run" / "trajectories"


def _trajectory_loader(stage: DistillationStage, store: TrajectoryStore, trainer: TrainerConfig) -> TrajectoryLoader:
    return TrajectoryLoader(
        store,
        stage.loader,
        batch_size=trainer.batch_size,
        seed=trainer.seed,
        generated_history=stage.config.trajectory_regression.trajectories.history == "generated",
        rank=stage.rank,
        world_size=stage.world_size,
    )


def _check_clips(config: DistillConfig) -> None:
    span = TEMPORAL_COMPRESSION * config.block_size
    if config.clips.view_weights is not None:
        raise ConfigError(
            "Distillation clips hold all views",
            where="distill.clips.view_weights",
            expected="null",
            got=config.clips.view_weights,
            next_step="set distill.teacher_forcing.view_weights for the first step alone",
        )
    odd = [length for length in config.clips.lengths if length <= span or (length - 1) % span]
    if odd:
        raise ConfigError(
            "Clips for distillation are one observed frame and whole blocks",
            where="distill.clips.lengths",
            expected=f"1 + k * {span} frames",
            got=odd,
        )
