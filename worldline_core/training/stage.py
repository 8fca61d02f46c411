"""What Stage I and Stage II share around their objective: clips, the run itself, and its checkpoint.

Losses on held-out clips: always the same clips, noise and noise levels.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from pydantic import Field

from worldline_core.actions.track_store import ActionTracks
from worldline_core.config import StrictModel
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import ConfigError
from worldline_core.model.checkpoint import save_checkpoint
from worldline_core.model.world_model import WorldModel
from worldline_core.training.clip_loader import Batch, ClipLoader
from worldline_core.training.clip_prefetcher import ClipPrefetcher
from worldline_core.training.clip_reader import BatchReader, ClipReader, SkipLog
from worldline_core.training.clip_sampler import JOINT, PRIMARY, ClipSampler, ClipSampling, source_counts
from worldline_core.training.clip_source import (
    ClipInput,
    ClipRow,
    ClipSource,
    FrameInput,
    LatentInput,
    ReadingConfig,
    named_rows,
    training_rows,
)
from worldline_core.training.flow_matching import FlowMatchingObjective, LossWeighting, SigmaSampling
from worldline_core.training.frame_source import FrameSource
from worldline_core.training.latent_store import LatentStore
from worldline_core.training.trainer import (
    ParameterGroup,
    TrainerConfig,
    TrainingResult,
    autocast,
    step_generator,
    train,
)

logger = logging.getLogger(__name__)
VALIDATION_SEED = 20_000


def validation_function(
    store: ClipSource,
    clips: ClipSampling,
    splits: Sequence[str],
    trainer: TrainerConfig,
    rows: Sequence[ClipRow],
    loader: ClipLoader,
    objective: FlowMatchingObjective,
    reading: ReadingConfig | None = None,
) -> Callable[[], dict[str, float]] | None:
    """A function that measures the held-out losses, or None (said in the log) where there are no such clips.

    Args:
        reading: what to do with held-out clips that cannot be read (default: stop).
    """
    longest = max(clips.lengths) - 1
    held_out = [row for row in rows if row.split in splits and row.num_frames > longest * max(clips.strides)]
    if not held_out or not trainer.validation_batches:
        logger.warning("No held-out clips of %d frames in the splits %s: no validation loss.", longest + 1, splits)
        return None
    # At least two clips, so that "shuffled actions" are another clip's.
    size = max(2, trainer.batch_size)
    # Where steps on one view are mixed in, it is still the joint prediction that counts.
    if clips.view_weights is not None and JOINT in clips.view_weights:
        clips = clips.model_copy(update={"view_weights": None})
    # A few clips stand for all: drawn anew by their weights, they come from many episodes.
    clips = clips.model_copy(update={"order": "weighted", "hop": None})
    sampler = ClipSampler(store, clips, splits=splits, batch_size=size, seed=VALIDATION_SEED, rows=held_out)
    reader = ClipReader(store, sampler, loader.views, reading)

    def validate() -> dict[str, float]:
        totals: dict[str, float] = {}
        objective.model.eval()
        for index in range(trainer.validation_batches):
            read = reader.read(index)
            for item in read.skipped:
                logger.warning("Held-out clip skipped: %s", item.reason)
            batch = loader.finish(read)
            with autocast(trainer):
                values = objective.validation_losses(batch, step_generator(VALIDATION_SEED, index, trainer.device))
            for key, value in values.items():
                totals[key] = totals.get(key, 0.0) + value / trainer.validation_batches
        objective.model.train()
        return totals

    return validate


class StageConfig(StrictModel):
    """What both stages are told of their clips, their loss and their run.

    ``input``: ``{kind: latents}`` reads what encode_latents cached; ``{kind: frames, ...}`` reads the recordings' frames
    and encodes them on the way (see clip_input.py).
    """

    trainer: TrainerConfig
    # Left out of dumps at its default: what was made before it existed keeps its key in the store.
    input: ClipInput = Field(default=LatentInput(), exclude_if=lambda value: value == LatentInput())
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
    store: ClipSource
    rows: list[ClipRow]
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
        views: tuple[str, ...],
        processes: tuple[int, int],
        tracks: ActionTracks | None = None,
    ) -> Stage:
        """Open ``episodes``, and ``latents`` or ``tokenizer``, and choose what stage ``number`` may train on.

        Args:
            views: the model's view slots.
            processes: (rank, world size).

        Raises:
            ArtifactError: a folder is not what it should be.
            ConfigError: the input that the clips come from is not given.
            DataError: no episode is left.
            UnavailableError: the decoder that is asked for cannot be loaded.
        """
        episodes = EpisodeSet.open(Path(inputs["episodes"]))
        store = _open_source(config, inputs, episodes, views)
        rows = list(training_rows(store, episodes, stage=number, tracks=tracks))
        return cls(config, title, output, episodes, store, rows, *processes)

    @property
    def used(self) -> list[ClipRow]:
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
        sampler = self._sampler()
        validate = validation_function(
            self.store,
            config.clips,
            config.validation_splits,
            config.trainer,
            self.rows,
            loader,
            objective,
            config.input,
        )
        skips = SkipLog(self.output / "run", self.rank, config.input.max_skipped)
        reader = self._reader(ClipReader(self.store, sampler, loader.views, config.input))

        def load(index: int) -> Batch:
            read = reader.read(index)
            skips.add(read.skipped)
            return loader.finish(read)

        try:
            return train(
                config.trainer,
                groups=groups,
                objective=objective,
                load=load,
                validate=validate,
                output=self.output,
                identity={
                    "config": config.model_dump(mode="json"),
                    "start": start,
                    "tokenizer": self.store.description["tokenizer"],
                    "episodes": named_rows(self.rows),
                },
                title=self.title,
                rank=self.rank,
                world_size=self.world_size,
            )
        finally:
            reader.close()

    def _sampler(self) -> ClipSampler:
        return ClipSampler(
            self.store,
            self.config.clips,
            splits=self.config.splits,
            batch_size=self.config.trainer.batch_size,
            seed=self.config.trainer.seed,
            rank=self.rank,
            world_size=self.world_size,
            rows=self.rows,
        )

    def _reader(self, reader: ClipReader) -> BatchReader:
        """In this process, or in processes of its own."""
        source, trainer = self.config.input, self.config.trainer
        if not source.workers:
            return reader
        return ClipPrefetcher(
            reader,
            workers=source.workers,
            prefetch=source.prefetch,
            stop=trainer.steps * trainer.accumulation,
            pinned=torch.device(trainer.device).type == "cuda",
        )

    def input_facts(self) -> dict[str, Any]:
        """How clips were read, for the checkpoint; nothing where they were cached latents in the default order."""
        facts: dict[str, Any] = {}
        source, trainer = self.config.input, self.config.trainer
        micro_steps = trainer.steps * trainer.accumulation
        if isinstance(source, FrameInput):
            facts["input"] = {"kind": source.kind, "decoder": self.store.description["decoder"]}
        if self.config.clips.order == "epochs":
            facts["epochs"] = self._sampler().epochs(micro_steps)
        if source.on_unreadable == "skip":
            facts["skipped_clips"] = SkipLog.count(self.output / "run", micro_steps)
        return facts

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
                **self.input_facts(),
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


def _open_source(
    config: StageConfig, inputs: Mapping[str, Path], episodes: EpisodeSet, views: tuple[str, ...]
) -> ClipSource:
    needed = "tokenizer" if isinstance(config.input, FrameInput) else "latents"
    if needed not in inputs:
        raise ConfigError(
            f"Clips from {config.input.kind} need the input {needed}.",
            where="input.kind",
            expected=f"an input named {needed}",
            got=", ".join(sorted(inputs)),
            next_step=f"give --input {needed}=FOLDER, or choose the other kind of input",
        )
    if not isinstance(config.input, FrameInput):
        return LatentStore.open(Path(inputs["latents"]))
    return FrameSource.open(
        episodes,
        Path(inputs["tokenizer"]),
        config.input,
        views=views,
        primary_alone=set(config.clips.view_weights or {}) == {PRIMARY},
        device=config.trainer.device,
    )
