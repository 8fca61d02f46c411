"""The largest setting of a preset that fits a card: what is given up, one thing after the other."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Sequence

from worldline_core.config import value_at
from worldline_core.errors import ConfigError
from worldline_core.pipeline.pipeline_config import PipelineConfig
from worldline_core.progress import Progress
from worldline_core.training.clip_config import TEMPORAL_FACTOR, FrameInput

LORA_RANK = 64
_LENGTHS = (97, 65, 33, 17)
_SCALES = (0.8, 0.6, 0.4)
_CELL = 32
"""Pixels of a patch of the Wan 2.2 autoencoder's latents, which pictures are multiples of."""


def smaller_settings(config: PipelineConfig) -> list[list[str]]:
    """Changes of a configuration, each list with all those before it: first what costs time alone, then precision, the length of
    clips, the size of pictures, and last all weights but adapters."""
    parts = [f"distill.{step}" for step in config.distill.trainers]
    trainers = [f"{name}.trainer" for name in (*config.stages, *parts) if name != "distill"]
    steps = [
        [f"{one}.sharding.checkpointing=block" for one in trainers]
        + ["distill.trajectory_regression.trajectories.clips_per_shard=1"],
        [f"{one}.average=host" for one in trainers],
        [f"{one}.optimizer.moments=8bit" for one in trainers],
        [f"{one}.weights=bf16" for one in trainers],
    ]
    block, longest = TEMPORAL_FACTOR * config.distill.block_size, max(config.distill.clips.lengths)
    for length in _LENGTHS:
        if length < longest and (length - 1) % block == 0:
            cached = [f"encode_latents.clip_frames={length}"] if config.encode_latents.clip_frames else []
            steps.append([f"{name}.clips.lengths=[{length}]" for name in config.stages] + cached)
    framed = [name for name, stage in config.stages.items() if isinstance(stage.input, FrameInput)]
    sizes = ["curate.image_size", "encode_latents.image_size", *(f"{name}.input.image_size" for name in framed)]
    for scale in _SCALES:
        size = [int(scale * side) // _CELL * _CELL for side in config.encode_latents.image_size]
        if min(size) > 0:
            steps.append([f"{name}={size}" for name in sizes])
    steps.append([f"{name}.lora.rank={LORA_RANK}" for name in ("train_stage2", "distill")])
    return [[change for step in steps[:count] for change in step] for count in range(len(steps) + 1)]


def largest_fitting(
    load: Callable[[Sequence[str]], PipelineConfig], fits: Callable[[PipelineConfig], bool]
) -> list[str]:
    """Changes of the first of `smaller_settings` that fits; memory falls from each to the next.

    Raises: ConfigError: not even the smallest fits.
    """
    settings = smaller_settings(load(()))
    rest = range(1, len(settings))
    with Progress("worldline plan --fit", 1 + len(rest).bit_length(), "setting") as progress:

        def known(number: int) -> bool:
            answer = fits(load(settings[number]))
            progress.advance()
            return answer

        found = 0 if known(0) else 1 + bisect_left(rest, True, key=known)
    if found == len(settings):
        raise ConfigError(
            "No setting of this preset fits the card", where="worldline plan --fit",
            next_step="take a preset of a smaller model (edge-24gb; my_robot below 24 GB), or a card of more memory",
        )  # fmt: skip
    last = dict(change.split("=", 1) for change in settings[found])
    before = load(()).model_dump(mode="json")
    return [f"{key}={value}" for key, value in last.items() if str(value_at(before, *key.split("."))) != value]
