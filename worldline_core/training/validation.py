"""Losses on held-out clips: always the same clips, noise and noise levels."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence

from worldline_core.training.clip_input import ReadingConfig
from worldline_core.training.clip_loader import ClipLoader
from worldline_core.training.clip_reader import ClipReader
from worldline_core.training.clip_sampler import JOINT, ClipSampler, ClipSampling
from worldline_core.training.clip_source import ClipRow, ClipSource
from worldline_core.training.objective import FlowMatchingObjective
from worldline_core.training.trainer import TrainerConfig, autocast, step_generator

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
