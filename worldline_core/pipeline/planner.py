"""What every stage of a preset takes on so many devices, for `worldline plan`. Nothing is loaded, and nothing is written.

Every figure follows from the configuration and the model classes (`training/stage_memory.py`, `model/step_cost.py`). Where a
folder of weights is not here yet, its published shapes stand for it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import torch

from worldline_core.actions.actions_config import TEMPORAL_FACTOR
from worldline_core.distillation.distill_config import DistillConfig
from worldline_core.distillation.distill_memory import DistillEstimates
from worldline_core.errors import ConfigError
from worldline_core.model.checkpoint import DESCRIPTION, read_checkpoint_info
from worldline_core.model.step_cost import Card, StepCost, without_values
from worldline_core.model.tokenizers import tokenizer_outline
from worldline_core.model.world_model_config import WorldModelConfig, cosmos3_nano_config
from worldline_core.pipeline.pipeline_config import PipelineConfig
from worldline_core.pipeline.plan import caches_latents
from worldline_core.pipeline.rollout_cost import decoding_cost, rollout_cost
from worldline_core.pipeline.sheet import Machine, Row
from worldline_core.rollout.rollout_config import RolloutConfig
from worldline_core.shipped import project_path
from worldline_core.store.artifact_files import read_json
from worldline_core.training.clip_config import ClipSampling, FrameInput
from worldline_core.training.clip_sampler import latent_frame_count
from worldline_core.training.stage1 import is_trained
from worldline_core.training.stage_cost import encoding_cost, flow_matching_estimate, parameter_counts
from worldline_core.training.stage_memory import USABLE, ClipShape, Estimate, Spread, fitting_setting
from worldline_core.training.training_config import StageConfig, TrainerConfig


@dataclass(frozen=True)
class Planner:
    """The stages of one configuration on one kind of machine."""

    config: PipelineConfig
    project: Path
    machine: Machine

    @property
    def model(self) -> WorldModelConfig:
        """What Stage I trains: the base checkpoint's shape, that of the backbone to import, or the configured one."""
        base = self.config.models.base
        if base is not None and (folder := project_path(self.project, base)) and (folder / DESCRIPTION).is_file():
            return read_checkpoint_info(folder).config
        if self.config.import_backbone is not None:
            return cosmos3_nano_config(fps=self.config.import_backbone.fps, **self.config.import_backbone.changes)
        if self.config.train_stage1 is None:
            raise ConfigError(
                "Nothing says what the model is.",
                where="models.base",
                expected="a base checkpoint, import_backbone, or train_stage1.model",
                next_step="give one of them",
            )
        return self.config.train_stage1.model

    @property
    def generation(self) -> WorldModelConfig:
        """What Stage II and III train and roll out."""
        return self.model.model_copy(update={"towers": "generation"})

    def folder(self, name: str) -> Path | None:
        """Where outside weights lie, if they are here."""
        path = getattr(self.config.models, name)
        folder = None if path is None else project_path(self.project, path)
        return folder if folder is not None and folder.is_dir() else None

    def grid(self, image_size: tuple[int, int]) -> tuple[int, int]:
        """Rows and columns of the latents of images of this size."""
        with without_values():
            space = tokenizer_outline(self.folder("tokenizer")).spatial_compression
        return image_size[0] // space, image_size[1] // space

    def rows(self) -> Iterator[Row]:
        """The stages, in the order of a run."""
        size = self.config.encode_latents.image_size
        if caches_latents(self.config):
            yield self._encoding(size)
        for name, (estimate, trainer, clips) in self.trainings().items():
            if name == "trajectory_regression":
                yield self._trajectories()
            yield self._training(estimate, trainer, clips)
        yield from self._rollouts(size)
        yield from self._judges()

    def trainings(self) -> dict[str, tuple[Estimate, TrainerConfig, ClipSampling]]:
        """What each training takes, by the name of its settings."""
        config, tokenizer = self.config, self.folder("tokenizer")
        first, second = config.train_stage1, config.train_stage2
        found: dict[str, tuple[Estimate, TrainerConfig, ClipSampling]] = {}
        if first is not None:
            estimate = flow_matching_estimate(
                "stage I", first, self.model, self._stage_grid(first), maps=False, text=first.text.max_length,
                tokenizer=tokenizer, trained=is_trained,
            )  # fmt: skip
            found["train_stage1"] = estimate, first.trainer, first.clips
        estimate = flow_matching_estimate(
            "stage II", second, self.generation, self._stage_grid(second), maps=True, tokenizer=tokenizer,
            relational=second.relational, teacher=self.folder("teacher"),
        )  # fmt: skip
        found["train_stage2"] = estimate, second.trainer, second.clips
        for name, step in self._distillation.steps().items():
            found[name] = step, getattr(config.distill, name).trainer, config.distill.clips
        return found

    @property
    def _distillation(self) -> DistillEstimates:
        grid = self._stage_grid(self.config.distill)
        return DistillEstimates(self.config.distill, self.generation, grid, self.folder("tokenizer"))

    def _stage_grid(self, stage: StageConfig | DistillConfig) -> tuple[int, int]:
        size = self.config.encode_latents.image_size
        return self.grid(stage.input.image_size if isinstance(stage.input, FrameInput) else size)

    def _training(self, estimate: Estimate, trainer: TrainerConfig, clips: ClipSampling) -> Row:
        machine, spread = self.machine, Spread.of(trainer, self.machine.devices)
        estimate = cache(estimate)
        need = estimate(spread)
        work = StepCost()
        for frames, share in typical_lengths(clips):
            one = need if frames == need.shape.frames else estimate(replace(spread, frames=frames))
            work = work.then(one.cost.times(share)).then(one.before.times(share))
        seconds = self._seconds(work.times(spread.micro_steps))
        fits = need.fits(machine.memory)
        states = 16 * need.trained - 4 * need.not_averaged
        facts = {
            "tokens of a clip": {str(frames): replace(need.shape, frames=frames).tokens(self.model)
                                 for frames in sorted({min(clips.lengths), max(clips.lengths)})},
            "clips a step": trainer.global_batch or trainer.batch_size * trainer.accumulation * machine.devices,
            "shards": spread.shards,
            "checkpointing": spread.checkpointing,
            **_work(work.times(spread.micro_steps), machine.card),
            "bytes of a training state": states,
            "host bytes of loading": 6 * need.trained,
            "host bytes of a state being written, of all hosts": states * machine.devices // spread.shards,
        }  # fmt: skip
        return Row(
            need.title,
            need.trained,
            need.parts,
            seconds,
            trainer.minutes / 60 if trainer.minutes else (trainer.steps or 0) * seconds / 3600,
            fits,
            "" if fits else fitting_setting(estimate, spread, machine.memory, clips.lengths),
            facts,
        )

    def _encoding(self, image_size: tuple[int, int]) -> Row:
        """The cache of latents, of an episode of 30 s at 30 frames per second."""
        config, frames = self.config.encode_latents, 901
        grid = self.grid(image_size)
        shape = ClipShape(1, config.views, 129, grid)
        weights, cost = encoding_cost(self.folder("tokenizer"), shape)
        counts = [
            latent_frame_count(1 + (frames - 1 - start) // stride // TEMPORAL_FACTOR * TEMPORAL_FACTOR)
            for stride in config.strides
            for start in range(0, frames, config.start_step)
        ]
        stored = sum(counts) * len(config.views) * self.model.latent_channels * grid[0] * grid[1] * 2
        facts = {"bytes stored of an episode of 30 s at 30 frames per second": stored}
        parts = {"tokenizer": weights, "activations": cost.activations}
        return self._row("encode_latents (a clip of 129 frames)", weights // 4, parts, cost, facts)

    def _trajectories(self) -> Row:
        """The causal teacher's trajectories, shard by shard, spread over the devices."""
        shape, (weights, cost) = self._distillation.shard, self._distillation.trajectories()
        shards = -(-self.config.distill.trajectory_regression.trajectories.clips // shape.clips)
        latents = (latent_frame_count(shape.frames) - 1) * shape.grid[0] * shape.grid[1] * self.model.latent_channels
        nodes = shape.clips * (self.config.distill.spec.steps + 1) * len(shape.views) * latents
        kept = shape.clips * len(shape.views) * latents if isinstance(self.config.distill.input, FrameInput) else 0
        facts = {"clips of a shard": shape.clips, "bytes stored": 2 * (nodes + kept) * shards}
        row = self._row(
            f"distill: trajectories (a shard of {shape.clips} clips)", weights // 4,
            {"weights": weights, "activations": cost.activations}, cost, facts, "fewer clips_per_shard",
        )  # fmt: skip
        return replace(row, hours=-(-shards // self.machine.devices) * row.seconds / 3600)

    def _rollouts(self, image_size: tuple[int, int]) -> Iterator[Row]:
        """One row for all rollouts that cost the same."""
        alike: dict[str, list[str]] = {}
        for name, run in self.config.rollouts.items():
            if run.checkpoint is not None and run.config is not None:
                what = {
                    "sampler",
                    "steps",
                    "num_frames",
                    "clip_frames",
                    "batch_size",
                    "bfloat16",
                    "weights",
                    "decoder",
                    "text",
                }
                alike.setdefault(run.config.model_dump_json(include=what), []).append(name)
        for names in alike.values():
            run = self.config.rollouts[names[0]]
            if run.config is not None:
                model = self.model if run.config.sampler == "text_to_video" else self.generation
                yield self._rollout(", ".join(names), run.config, model, image_size)

    def _rollout(self, name: str, config: RolloutConfig, model: WorldModelConfig, image_size: tuple[int, int]) -> Row:
        frames = config.num_frames if config.num_frames != "whole" else config.clip_frames or 129
        shape = ClipShape(config.batch_size, model.views, frames, self.grid(image_size))
        cost = rollout_cost(model, shape, config, self.config.distill.spec)
        codec, decoding = decoding_cost(self.folder("tokenizer"), shape, config)
        count = parameter_counts(model)[0]
        parts = {
            "weights": (2 if config.weights == "bfloat16" else 4) * count,
            "tokenizer": codec,
            "caches": cost.kept,
            "activations": max(cost.activations - cost.kept, decoding.activations),
        }
        facts = {"tokens of a clip": shape.tokens(model)}
        instead = "a smaller batch_size" if config.batch_size > 1 else "a smaller num_frames"
        if config.weights == "float32":
            instead += ", or weights: bfloat16"
        return self._row(f"rollout {name} (a prediction)", count, parts, cost.then(decoding), facts, instead)

    def _row(
        self, title: str, parameters: int, parts: Mapping[str, float], work: StepCost, facts: Mapping[str, Any],
        instead: str = "a smaller batch_size",
    ) -> Row:  # fmt: skip
        kept = {name: size for name, size in parts.items() if size}
        fits = sum(kept.values()) <= USABLE * self.machine.memory
        facts = {**facts, **_work(work, self.machine.card)} if work.flops else facts
        return Row(title, parameters, kept, self._seconds(work), None, fits, "" if fits else instead, facts)

    def _seconds(self, work: StepCost) -> float:
        return work.flops / (self.machine.utilisation * self.machine.card.flops)

    def _judges(self) -> Iterator[Row]:
        """Outside models of the evaluations, their weights in bfloat16."""
        video = self.config.evaluate_video
        if video is not None and "sam3" in video.segmenters:
            from transformers import Sam3TrackerVideoConfig, Sam3TrackerVideoModel

            yield self._weights("evaluate_video: SAM 3", Sam3TrackerVideoModel, Sam3TrackerVideoConfig())
        policy = self.config.evaluate_policy
        if policy is not None and policy.judge == "qwen3_vl":
            from transformers import Qwen3VLConfig, Qwen3VLForConditionalGeneration

            folder = policy.vlm.weights
            place = None if folder is None else project_path(self.project, folder) / "config.json"
            here = place is not None and place.is_file()
            shape = read_json(place) if place is not None and here else QWEN3_VL_8B
            yield self._weights("evaluate_policy: Qwen3-VL", Qwen3VLForConditionalGeneration, Qwen3VLConfig(**shape))

    def _weights(self, title: str, kind: Any, config: Any) -> Row:
        with torch.device("meta"):
            count = sum(value.numel() for value in kind(config).parameters())
        return self._row(title, count, {"weights": 2 * count}, StepCost(), {"counted": "weights alone"})


QWEN3_VL_8B: dict[str, Any] = {
    "text_config": {
        "hidden_size": 4096, "num_hidden_layers": 36, "num_attention_heads": 32, "num_key_value_heads": 8,
        "head_dim": 128, "intermediate_size": 12288, "vocab_size": 151936,
    },
    "vision_config": {
        "depth": 27, "hidden_size": 1152, "intermediate_size": 4304, "num_heads": 16, "out_hidden_size": 4096,
        "deepstack_visual_indexes": [8, 16, 24],
    },
    "tie_word_embeddings": False,
}  # fmt: skip
"""The published judge (Qwen/Qwen3-VL-8B-Instruct, config.json)."""


def _work(cost: StepCost, card: Card) -> dict[str, float]:
    """Operations, bytes of their operands, and the least time on a card."""
    return {"PFLOP": cost.flops / 1e15, "GB moved": cost.bytes / 1e9, "floor in seconds": cost.floor_seconds(card)}


def typical_lengths(clips: ClipSampling) -> list[tuple[int, float]]:
    """Clip lengths and their shares, whose mean cost is that of all lengths.

    Costs are at most quadratic in the length, so for many evenly drawn lengths three do (Simpson's rule).
    """
    ordered = sorted(clips.lengths)
    if len(ordered) <= 3:
        return [(length, 1 / len(ordered)) for length in ordered]
    return [(ordered[0], 1 / 6), (ordered[len(ordered) // 2], 4 / 6), (ordered[-1], 1 / 6)]
