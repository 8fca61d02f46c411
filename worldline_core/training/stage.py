"""Common parts of Stage I and Stage II around their objective: start model, clips, run and checkpoint."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal

import torch

from worldline_core.actions.episode_tracks import ActionTracks
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.model.checkpoint import CheckpointInfo
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import ActionContract, NativeVectors
from worldline_core.training.action_following import ActionFollowing, MeasuredObjective
from worldline_core.training.adapters import prepare, save_trained
from worldline_core.training.clip_config import JOINT, ClipSampling
from worldline_core.training.clip_loader import ClipLoader
from worldline_core.training.clip_sampler import ClipRow, ClipSampler
from worldline_core.training.clip_source import ClipSource, open_source, training_rows
from worldline_core.training.flow_matching import FlowMatchingObjective
from worldline_core.training.object_weights import ObjectWeights
from worldline_core.training.optimizers import require_one_process
from worldline_core.training.processes import BatchPlan, join_processes
from worldline_core.training.trainer import ParameterGroup, Probe, TrainingResult, batch_plan, held_out_losses, train
from worldline_core.training.training_config import (
    ActionFollowingConfig,
    LossWeighting,
    Stage1Config,
    Stage2Config,
    StageConfig,
    TrainerConfig,
)

logger = logging.getLogger(__name__)
VALIDATION_SEED = 20_000


@dataclass(frozen=True)
class Stage:
    """One run of a stage: the model, and the clips it is trained on.

    Attributes:
        start: digest of the weights that the run begins with, or "scratch"; parent_kind: that checkpoint's kind; parent: its
            folder.
        rows: the episodes that this stage may train on and be validated on.
    """

    config: StageConfig
    title: str
    output: Path
    model: WorldModel
    start: str
    parent_kind: str | None
    parent: Path | None
    episodes: EpisodeSet
    source: ClipSource
    rows: list[ClipRow]

    @classmethod
    def open(
        cls,
        config: StageConfig,
        inputs: Mapping[str, Path],
        output: Path,
        *,
        number: Literal[1, 2],
        title: str,
        load_model: Callable[[], tuple[WorldModel, CheckpointInfo | None]],
        parent: Path | None,
        tracks: ActionTracks | None = None,
    ) -> Stage:
        """Join the processes, load the model, open ``episodes`` and ``latents`` (or ``tokenizer``), choose the episodes.

        Raises:
            ArtifactError: a folder is not what it should be.
            ConfigError: the input that the clips come from is not given.
            DataError: no episode is left.
            UnavailableError: the decoder that is asked for cannot be loaded.
        """
        trainer = config.trainer
        device = trainer.device
        join_processes(device)
        trains_text = not isinstance(config, Stage1Config) or config.text_tower == "trained"
        require_one_process(trainer, {"lora": config.lora is not None, "text_tower": not trains_text})
        torch.manual_seed(trainer.seed)
        model, info = load_model()
        prepare(model, trainer, config.lora).train()
        episodes = EpisodeSet.open(Path(inputs["episodes"]))
        source = open_source(config.input, inputs, episodes, device)
        rows = training_rows(
            source, episodes, stage=number, views=config.clips.shown_views(model.config.views), tracks=tracks,
            vectors=model.config.native_size is not None, outcomes=config.outcomes,
        )  # fmt: skip
        start, kind = ("scratch", None) if info is None else (info.weights_sha256, info.kind)
        return cls(config, title, output, model, start, kind, parent, episodes, source, rows)

    @property
    def vector_share(self) -> float:
        """Share of views that take the control vector instead of the map; 0 for a model of maps alone."""
        config = self.config
        return config.vector_share if isinstance(config, Stage2Config) and config.native_size is not None else 0.0

    @property
    def training_rows(self) -> list[ClipRow]:
        return [row for row in self.rows if row.split in self.config.splits]

    @cached_property
    def sampler(self) -> ClipSampler:
        """Sampler of the clips of every micro-step."""
        trainer = self.config.trainer
        return ClipSampler(
            self.training_rows,
            self.config.clips,
            views=self.model.config.views,
            start_step=self.source.start_step,
            batch_size=trainer.batch_size,
            seed=trainer.seed,
            plan=self.plan,
            where=f"clips of the splits {list(self.config.splits)}",
            vector_share=self.vector_share,
        )

    @cached_property
    def plan(self) -> BatchPlan:
        """Distribution of each step's micro-batches over the processes."""
        return batch_plan(self.config.trainer, self.output)

    def loader(self, **conditions: Any) -> ClipLoader:
        """A loader of this run's clips; ``conditions`` as `ClipLoader` takes them (action tracks, text)."""
        return ClipLoader(
            self.source,
            views=self.model.config.views,
            action_frames=self.model.config.action_frames,
            frame_rates={row.episode_id: row.fps for row in self.episodes.rows},
            native_size=self.model.config.native_size,
            maps=self.model.config.takes_maps,
            object_weights=weights_of(
                self.config.weighting, self.episodes, self.source, self.rows, self.config.trainer.device
            ),
            device=self.config.trainer.device,
            **conditions,
        )

    def held_out(self, loader: ClipLoader) -> HeldOutClips:
        """Clips that the run is measured on."""
        return HeldOutClips(
            self.config.clips, self.config.validation_splits, loader, self.rows, self.episodes, self.vector_share
        )

    def train(
        self,
        objective: FlowMatchingObjective,
        groups: Sequence[ParameterGroup],
        loader: ClipLoader,
        probe: Probe | None = None,
    ) -> TrainingResult:
        """Train, or continue a killed run.

        Raises:
            TrainingError: a loss or gradient is not finite.
            ArtifactError: a saved state is damaged or belongs to another run.
        """
        config, trainer = self.config, self.config.trainer
        return train(
            trainer,
            groups=groups,
            objective=objective,
            load=loader.batches(self.sampler, config.input.workers),
            validate=self.held_out(loader).validation(trainer, objective),
            probe=probe,
            output=self.output,
            identity={
                "config": config.model_dump(mode="json"),
                "start": self.start,
                "tokenizer": self.source.description["tokenizer"],
                "episodes": [vars(row) for row in self.rows],
            },
            title=self.title,
            models=(self.model,),
        )

    def _vectors(self) -> NativeVectors | None:
        """The control vectors that the run trains on."""
        if self.model.config.native_size is None:
            return None
        known = tuple(sorted({row.embodiment for row in self.training_rows}))
        return NativeVectors(embodiments=known, share=self.vector_share if self.model.config.takes_maps else 1.0)

    def save(
        self,
        result: TrainingResult,
        *,
        kind: Literal["base", "stage1", "stage2"],
        action_contract: ActionContract | None,
        facts: Mapping[str, Any],
        towers: Literal["both", "generation"] | None = None,
    ) -> dict[str, Any]:
        """Gather and write the averaged weights (the first process alone writes) and return the counts of the run.

        Args:
            towers: of the checkpoint, where it has more than the model that was trained.
        """
        trainer = self.config.trainer
        description: dict[str, Any] = {
            "kind": kind,
            "action_contract": action_contract,
            "trained": self.sampler.trained(self.model.config.views) if kind == "stage2" else None,
            "vectors": self._vectors() if kind == "stage2" else None,
            "metadata": {
                "step": result.steps,
                "seed": trainer.seed,
                "tokenizer": self.source.description["tokenizer"],
                "episodes": len(self.training_rows),
                "sources": dict(sorted(Counter(row.source for row in self.training_rows).items())),
                "metrics": result.metrics,
                **self.source.facts,
                **facts,
            },
        }
        save_trained(
            self.output, self.model, result.average, start=self.parent, lora=self.config.lora, description=description,
            towers=towers or self.model.config.towers,
        )  # fmt: skip
        clips = result.steps * trainer.batch_size * self.plan.per_step
        found, fit, kept = len(self.episodes), len(self.rows), len(self.training_rows)
        left_out = {"in other splits": fit - kept, "not fit for this stage, or without latents or tracks": found - fit}
        return {"steps": result.steps, "clips": clips, "found": found, "kept": kept, "left_out": left_out}


def weights_of(
    weighting: LossWeighting, episodes: EpisodeSet, source: ClipSource, rows: Sequence[ClipRow], device: str
) -> ObjectWeights | None:
    """Loss weights of things, where the configuration asks for them; with resident latents those of all ``rows`` are resident."""
    if not any(weighting.things):
        return None
    _, height, width = source.latent_shape
    resident = rows if source.resident else None
    return ObjectWeights(episodes, (height, width), *weighting.things, device=device, resident=resident)


@dataclass(frozen=True)
class HeldOutClips:
    """Clips of ``splits`` that a run is measured on."""

    clips: ClipSampling
    splits: Sequence[str]
    loader: ClipLoader
    rows: Sequence[ClipRow]
    episodes: EpisodeSet
    vector_share: float

    def validation(self, trainer: TrainerConfig, objective: MeasuredObjective) -> Callable[[], dict[str, float]] | None:
        """A function that measures the losses: always the same clips, noise and noise levels.

        The clips are of recordings long enough for every length and stride that is trained; where there are none, of all, at the
        lengths and strides that fit. None where no clip fits. Both are logged.
        """
        clips, splits = self.clips, self.splits
        shortest, longest = ((pick(clips.lengths) - 1) * pick(clips.strides) + 1 for pick in (min, max))
        split_rows = [row for row in self.rows if row.split in splits and row.num_frames >= shortest]
        if not split_rows or not trainer.validation_batches:
            logger.warning("No held-out clips of %d frames in the splits %s: no validation loss.", shortest, splits)
            return None
        held_out = [row for row in split_rows if row.num_frames >= longest]
        if not held_out:
            held_out = split_rows
            logger.warning(
                "The longest recording of the splits %s has %d frames, the longest clips span %d: the validation loss is of the "
                "lengths and strides that fit.",
                splits,
                max(row.num_frames for row in held_out),
                longest,
            )
        # At least two clips, so that "shuffled actions" are another clip's.
        size = max(2, trainer.batch_size)
        # Where steps on one view are mixed in, it is still the joint prediction that counts.
        if clips.view_weights is not None and JOINT in clips.view_weights:
            clips = clips.model_copy(update={"view_weights": None})
        sampler = ClipSampler(
            held_out, clips, views=self.loader.views, start_step=self.loader.source.start_step,
            batch_size=size, seed=VALIDATION_SEED, vector_share=self.vector_share, where=f"clips of the splits {list(splits)}",
        )  # fmt: skip
        load = self.loader.batches(sampler)
        return partial(held_out_losses, trainer, load, objective.validation_losses, VALIDATION_SEED)

    def action_following(
        self,
        config: ActionFollowingConfig | None,
        trainer: TrainerConfig,
        objective: MeasuredObjective,
        tokenizer: Path | None,
        sampler: ClipSampler,
        frames_per_unit: int,
    ) -> ActionFollowing | None:
        """The measurement, where it is asked for, on views that ``sampler`` shows together."""
        if config is None:
            return None
        rows = [row for row in self.rows if row.split in self.splits]
        return ActionFollowing(
            config, objective, self.loader, rows, self.episodes, tokenizer,
            view_sets=sampler.view_sets(self.loader.views), frames_per_unit=frames_per_unit, trainer=trainer,
        )  # fmt: skip
