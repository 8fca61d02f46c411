"""What Stage I and Stage II share around their objective: caches, clips, the run itself, and its checkpoint."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from worldline_core.actions.tracks import ActionTracks
from worldline_core.config.base import StrictModel
from worldline_core.data.episode_set import EpisodeSet
from worldline_core.model.checkpoint import save_checkpoint
from worldline_core.model.world_model import WorldModel
from worldline_core.training.clip_loader import ClipLoader
from worldline_core.training.clip_sampler import ClipSampler, ClipSampling, source_counts
from worldline_core.training.episode_rows import training_rows
from worldline_core.training.flow_matching import LossWeighting, SigmaSampling
from worldline_core.training.latent_store import LatentRow, LatentStore
from worldline_core.training.objective import FlowMatchingObjective
from worldline_core.training.trainer import ParameterGroup, TrainerConfig, TrainingResult, train
from worldline_core.training.validation import validation_function


class StageConfig(StrictModel):
    """What both stages are told of their clips, their loss and their run."""

    trainer: TrainerConfig
    clips: ClipSampling = ClipSampling()
    splits: tuple[str, ...] = ("train",)
    validation_splits: tuple[str, ...] = ("validation",)
    sigma: SigmaSampling = Field(default_factory=SigmaSampling)
    weighting: LossWeighting = Field(default_factory=LossWeighting)


@dataclass(frozen=True)
class Stage:
    """One run of a stage: what it reads, and which process of how many this is."""

    config: StageConfig
    title: str
    output: Path
    episodes: EpisodeSet
    store: LatentStore
    rows: list[LatentRow]
    rank: int
    world_size: int

    @classmethod
    def open(
        cls,
        config: StageConfig,
        inputs: Mapping[str, Path],
        output: Path,
        *,
        number: Literal[1, 2],
        title: str,
        processes: tuple[int, int],
        tracks: ActionTracks | None = None,
    ) -> Stage:
        """Open ``latents`` and ``episodes`` and choose what stage ``number`` may train on.

        Args:
            processes: (rank, world size).

        Raises:
            ArtifactError: a folder is not what it should be.
            DataError: no episode is left.
        """
        episodes = EpisodeSet.open(Path(inputs["episodes"]))
        store = LatentStore.open(Path(inputs["latents"]))
        rows = training_rows(store, episodes, stage=number, tracks=tracks)
        return cls(config, title, output, episodes, store, rows, *processes)

    @property
    def used(self) -> list[LatentRow]:
        """Episodes of the training splits."""
        return [row for row in self.rows if row.split in self.config.splits]

    def train(
        self, objective: FlowMatchingObjective, groups: Sequence[ParameterGroup], loader: ClipLoader, *, start: str
    ) -> TrainingResult:
        """Train, or go on with a killed run. ``start`` names the weights that the run began with.

        Raises:
            TrainingError: a loss or gradient is not finite.
            ArtifactError: a saved state is damaged or belongs to another run.
        """
        config = self.config
        sampler = ClipSampler(
            self.store,
            config.clips,
            splits=config.splits,
            batch_size=config.trainer.batch_size,
            seed=config.trainer.seed,
            rank=self.rank,
            world_size=self.world_size,
            rows=self.rows,
        )
        validate = validation_function(
            self.store, config.clips, config.validation_splits, config.trainer, self.rows, loader, objective
        )
        return train(
            config.trainer,
            groups=groups,
            objective=objective,
            load=lambda index: loader.load(sampler.clips(index)),
            validate=validate,
            output=self.output,
            identity={
                "config": config.model_dump(mode="json"),
                "start": start,
                "tokenizer": self.store.description["tokenizer"],
            },
            title=self.title,
            rank=self.rank,
            world_size=self.world_size,
        )

    def save(
        self,
        model: WorldModel,
        result: TrainingResult,
        *,
        kind: Literal["base", "stage1", "stage2"],
        action_contract: dict[str, Any],
        facts: Mapping[str, Any],
    ) -> dict[str, Any]:
        """Write the averaged weights (the first process alone does) and return the counts of the run."""
        trainer = self.config.trainer
        if self.rank == 0:
            metadata = {
                "step": trainer.steps,
                "seed": trainer.seed,
                "tokenizer": self.store.description["tokenizer"],
                "episodes": len(self.used),
                "sources": source_counts(self.used),
                "metrics": result.metrics,
                **facts,
            }
            weights = {**model.state_dict(), **result.average}
            save_checkpoint(
                self.output,
                model,
                kind=kind,
                action_contract=action_contract,
                metadata=metadata,
                state_dict=weights,
            )
        clips = trainer.steps * trainer.batch_size * trainer.accumulation * self.world_size
        return {"steps": trainer.steps, "clips": clips}
