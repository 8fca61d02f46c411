"""What the three steps of Stage III share: the caches, the clips, and the run of one step from start to checkpoint."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, cast

import torch

from worldline_core.actions.episode_tracks import ActionTracks
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.distillation.auxiliary_losses import PerceptualDistance, PerceptualLoss
from worldline_core.distillation.distill_config import DistillConfig
from worldline_core.distillation.teacher_trajectories import NODES
from worldline_core.model.checkpoint import (
    CheckpointInfo,
    check_action_contract,
    read_checkpoint_info,
    save_checkpoint,
)
from worldline_core.model.tokenizer import load_tokenizer
from worldline_core.model.world_model import WorldModel
from worldline_core.store.atomic import write_bytes_atomic
from worldline_core.training.clip_loader import Batch, ClipLoader
from worldline_core.training.clip_sampler import ClipSampler, ClipSampling
from worldline_core.training.clip_source import TEMPORAL_COMPRESSION, ClipRow, named_rows, training_rows
from worldline_core.training.latent_store import LatentStore
from worldline_core.training.stage import validation_function
from worldline_core.training.trainer import (
    Objective,
    ParameterGroup,
    TrainerConfig,
    TrainingResult,
    join_processes,
    train,
    wait_for_all,
)

if TYPE_CHECKING:
    from worldline_core.training.flow_matching import FlowMatchingObjective

logger = logging.getLogger(__name__)

STEPS = ("teacher_forcing", "trajectory_regression", "distribution_matching")
LPIPS_OFF = "off: no LPIPS weights configured"


@dataclass(frozen=True)
class DistillationStage:
    """Everything the three steps share."""

    config: DistillConfig
    stage2: Path
    stage2_info: CheckpointInfo
    store: LatentStore
    loader: ClipLoader
    rows: list[ClipRow]
    output: Path
    perceptual: PerceptualDistance | None
    rank: int
    world_size: int

    def folder(self, step: str) -> Path:
        """Where a step's checkpoint lies; the last step's is the result itself."""
        return self.output if step == STEPS[-1] else self.output / step

    @classmethod
    def open(cls, config: DistillConfig, inputs: Mapping[str, Path], output: Path) -> DistillationStage:
        """Open every input and check that they belong together.

        Raises:
            CheckpointError: the checkpoint's action maps and latents are not those given here.
        """
        output.mkdir(parents=True, exist_ok=True)
        device = config.teacher_forcing.trainer.device
        rank, world_size = join_processes(device)
        stage2 = Path(inputs["stage2"])
        info = read_checkpoint_info(stage2)
        store = LatentStore.open(Path(inputs["latents"]))
        check_action_contract(
            info.action_contract,
            {"tokenizer": store.description["tokenizer"], "grid_size": list(store.latent_shape[1:])},
            where=stage2,
        )
        tracks = ActionTracks.open(Path(inputs["tracks"]))
        loader = ClipLoader(
            store,
            views=tuple(config.views),
            tracks=tracks,
            sigma_px_ref=info.action_contract["sigma_px_ref"],
            wrist_projection=info.action_contract["wrist_projection"],
            device=device,
        )
        return cls(
            config=config,
            stage2=stage2,
            stage2_info=info,
            store=store,
            loader=loader,
            rows=training_rows(store, EpisodeSet.open(Path(inputs["episodes"])), stage=2, tracks=tracks),
            output=output,
            perceptual=_perceptual(config, Path(inputs["tokenizer"]), device),
            rank=rank,
            world_size=world_size,
        )

    def sampler(
        self, batch_size: int, seed: int, *, distributed: bool, clips: ClipSampling | None = None
    ) -> ClipSampler:
        """Clips of the training splits; the same on every process unless `distributed`."""
        return ClipSampler(
            self.store,
            self.config.clips if clips is None else clips,
            splits=self.config.splits,
            batch_size=batch_size,
            seed=seed,
            rank=self.rank if distributed else 0,
            world_size=self.world_size if distributed else 1,
            rows=self.rows,
        )

    def train_step(
        self,
        step: str,
        trainer: TrainerConfig,
        model: WorldModel,
        objective: Objective,
        load: Callable[[int], Batch],
        parent: CheckpointInfo,
        other_groups: tuple[ParameterGroup, ...] = (),
    ) -> dict[str, float]:
        """Train one step with the shared loop, then write its checkpoint and metrics; a finished step is only read."""
        folder, log = self.folder(step), self.output / step / "metrics.jsonl"
        if (folder / "checkpoint.json").is_file() and log.is_file():
            return prefixed(step, read_checkpoint_info(folder).metadata["metrics"])
        work = self.output / "run" / step
        # Held-out losses need an objective's model and its validation_losses, which these objectives have as well.
        validated = cast("FlowMatchingObjective", objective)
        result: TrainingResult = train(
            trainer,
            groups=(ParameterGroup("student", named_parameters(model)), *other_groups),
            objective=objective,
            load=load,
            validate=validation_function(
                self.loader, self.config.clips, self.config.validation_splits, trainer, self.rows, validated
            ),
            output=work,
            identity={
                "step": step,
                "config": self.config.model_dump(mode="json"),
                "parent": parent.weights_sha256,
                "stage2": self.stage2_info.weights_sha256,
                "episodes": named_rows(self.rows),
            },
            title=step.replace("_", " "),
            rank=self.rank,
            world_size=self.world_size,
        )
        if self.rank == 0:
            names = set(named_parameters(model))
            write_bytes_atomic(log, (work / "metrics.jsonl").read_bytes())
            save_checkpoint(
                folder,
                model,
                kind="causal",
                action_contract=self.stage2_info.action_contract,
                metadata={
                    "distillation": step,
                    "step": trainer.steps,
                    "seed": trainer.seed,
                    "start": {"kind": parent.kind, "weights_sha256": parent.weights_sha256},
                    "tokenizer": self.store.description["tokenizer"],
                    "sigmas": list(NODES),
                    "clip_latent_frames": 1 + (max(self.config.clips.lengths) - 1) // TEMPORAL_COMPRESSION,
                    "block_size": self.config.block_size,
                    "window": self.config.window.model_dump(),
                    "lpips": "on" if self.perceptual is not None else LPIPS_OFF,
                    "metrics": result.metrics,
                },
                state_dict={
                    **model.state_dict(),
                    **{name: value for name, value in result.average.items() if name in names},
                },
            )
        wait_for_all()
        return prefixed(step, result.metrics)


def _perceptual(config: DistillConfig, tokenizer: Path, device: str) -> PerceptualDistance | None:
    wanted = config.trajectory_regression.auxiliary.lpips or config.distribution_matching.auxiliary.lpips
    if config.lpips_weights is None:
        if wanted:
            logger.warning("The perceptual auxiliary is %s; it is left out of the loss.", LPIPS_OFF)
        return None
    codec = load_tokenizer(tokenizer)
    if isinstance(codec, torch.nn.Module):
        codec.to(device).eval().requires_grad_(False)
    return PerceptualLoss(codec, config.lpips_weights, device=device)


def named_parameters(model: WorldModel, prefix: str = "") -> dict[str, torch.nn.Parameter]:
    """Parameters of a model by name."""
    return {prefix + name: parameter for name, parameter in model.named_parameters()}


def prefixed(step: str, metrics: Mapping[str, float]) -> dict[str, float]:
    """Metrics under the name of their step."""
    return {f"{step}/{name}": value for name, value in metrics.items()}
