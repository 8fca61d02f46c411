"""The sheet of `worldline plan`: what every stage of a preset takes on so many devices, as a table or as JSON.

Nothing is loaded or written: every figure follows from the configuration and the model classes (`memory_estimate.py`). Where a
folder of weights is not here yet, its published shapes stand for it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from pydantic import BeforeValidator, ByteSize, Field
from torch._subclasses.fake_tensor import FakeTensorMode

from worldline_core.actions.actions_config import TEMPORAL_FACTOR
from worldline_core.config import StrictModel
from worldline_core.errors import ConfigError
from worldline_core.model.checkpoint import DESCRIPTION, read_checkpoint_info
from worldline_core.model.small_decoder import SmallDecoder
from worldline_core.model.tokenizers import WanTokenizer, tokenizer_outline
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import TextConfig, WorldModelConfig, cosmos3_nano_config
from worldline_core.pipeline.memory_estimate import (
    USABLE,
    ClipFrames,
    ClipShape,
    Cost,
    Estimate,
    Training,
    encoding,
    extrapolated,
    gigabytes,
    parameter_counts,
    to_bfloat16,
    traced,
    trainings,
    trajectory_shard,
    weight_bytes,
)
from worldline_core.pipeline.pipeline_config import PipelineConfig
from worldline_core.rollout.rollout_config import BlockCausalConfig, FullClipConfig, RolloutConfig, TextToVideoConfig
from worldline_core.rollout.samplers import FULL_STEPS, BlockCausalSimulator, Noise, sigmas_causal
from worldline_core.shipped import project_path
from worldline_core.training.clip_config import FrameInput
from worldline_core.training.clip_sampler import latent_frame_count

PEAK_FLOPS = {"A100": 312e12, "H100": 989e12, "H200": 989e12, "B200": 2250e12}
"""Operations per second in bfloat16 without sparsity, SXM boards (NVIDIA data sheets)."""
JUDGES = {"evaluate_video: SAM 3": 465_782_146, "evaluate_policy: Qwen3-VL": 8_767_123_696}
"""Parameters of the published judges (facebook/sam3, its tracker; Qwen/Qwen3-VL-8B-Instruct)."""


def _with_unit(value: object) -> object:
    if isinstance(value, str) and not value.strip().upper().endswith("B"):
        raise ValueError("give a unit: 80GB, 80GiB")
    return value


class Machine(StrictModel):
    """Devices that share a run; ``utilisation``: the share of the card's peak that is reached."""

    devices: int = Field(default=8, ge=1)
    memory: Annotated[ByteSize, BeforeValidator(_with_unit)]
    card: Literal["A100", "H100", "H200", "B200"] = "H100"
    utilisation: float = Field(default=0.4, gt=0, le=1)

    def seconds(self, flops: float) -> float:
        """Time of so many operations on one device."""
        return flops / (self.utilisation * PEAK_FLOPS[self.card])


@dataclass(frozen=True)
class SizeSheet:
    """The stages of one configuration on one kind of machine."""

    config: PipelineConfig
    project: Path
    machine: Machine

    @cached_property
    def model(self) -> WorldModelConfig:
        """Shape of Stage I's model: that of the base checkpoint, of the backbone to import, or the configured one."""
        base = self.config.models.base
        if base is not None and (folder := project_path(self.project, base)) and (folder / DESCRIPTION).is_file():
            return read_checkpoint_info(folder).config
        if self.config.import_backbone is not None:
            return cosmos3_nano_config(fps=self.config.import_backbone.fps, **self.config.import_backbone.changes)
        if self.config.train_stage1 is None:
            raise ConfigError(
                "The size of the model is not known.",
                where="models.base",
                expected="a base checkpoint, import_backbone, or train_stage1.model",
                next_step="give one of them",
            )
        return self.config.train_stage1.model

    @property
    def generation(self) -> WorldModelConfig:
        """Shape of the model that Stage II and III train and roll out."""
        return self.model.model_copy(update={"towers": "generation"})

    def folder(self, name: str) -> Path | None:
        """Folder of outside weights, if it is here."""
        path = getattr(self.config.models, name)
        folder = None if path is None else project_path(self.project, path)
        return folder if folder is not None and folder.is_dir() else None

    def source(self, stage: object = None) -> ClipFrames:
        """The pictures and latents that a stage reads: its own frames, or those of the cache."""
        reading = getattr(stage, "input", None)
        size = reading.image_size if isinstance(reading, FrameInput) else self.config.encode_latents.image_size
        return ClipFrames.of(self.folder("tokenizer"), self.folder("teacher"), size)

    def trainings(self) -> list[Training]:
        """Every training, in the order of a run."""
        stages = (
            (self.config.train_stage1, self.model),
            (self.config.train_stage2, self.generation),
            (self.config.distill, self.generation),
        )
        return [
            one for stage, model in stages if stage is not None for one in trainings(stage, model, self.source(stage))
        ]

    def rows(self) -> Iterator[tuple[Estimate, str]]:
        """Every stage in the order of a run, and the setting with which it would fit; empty where it does."""
        if self.config.caches_latents:
            yield self._row(self._encoding(), "a smaller image_size")
        for training in self.trainings():
            if training.title == "distill: trajectory regression":
                yield self._row(self._trajectories(), "fewer clips_per_shard")
            need = training.estimate(self.machine.devices)
            if training.trainer.minutes:
                seconds = self.machine.seconds(need.flops)
                need = replace(need, steps=round(60 * training.trainer.minutes / seconds))
            fits = need.fits(self.machine.memory)
            setting = "" if fits else training.fitting_setting(self.machine.devices, self.machine.memory)
            yield need, setting
        yield from self._rollouts()
        video, policy = self.config.evaluate_video, self.config.evaluate_policy
        judges = (video is not None and "sam3" in video.segmenters, policy is not None and policy.judge == "qwen3_vl")
        for (title, count), used in zip(JUDGES.items(), judges, strict=True):
            if used:
                counted = Estimate(title, count, {"weights": 2 * count}, facts={"counted": "weights alone"})
                yield self._row(counted, "a device of more memory")

    def _row(self, need: Estimate, setting: str) -> tuple[Estimate, str]:
        return need, "" if need.fits(self.machine.memory) else setting

    def _encoding(self) -> Estimate:
        """The cache of latents, of an episode of 30 s at 30 frames per second."""
        config, frames, source = self.config.encode_latents, 901, self.source()
        weights, cost = encoding(source, ClipShape(1, tuple(config.views), 129, source.grid))
        counts = [
            latent_frame_count(1 + (frames - 1 - start) // stride // TEMPORAL_FACTOR * TEMPORAL_FACTOR)
            for stride in config.strides
            for start in range(0, frames, config.start_step)
        ]
        cells = self.model.latent_channels * source.grid[0] * source.grid[1]
        facts = {
            "bytes stored of an episode of 30 s at 30 frames per second": 2 * sum(counts) * len(config.views) * cells
        }
        parts = {"tokenizer": weights, "activations": cost.activations}
        title = "encode_latents (a clip of 129 frames)"
        return Estimate(title, weights // 4, parts, cost.all_flops, facts=facts)

    def _trajectories(self) -> Estimate:
        """The causal teacher's trajectories, shard by shard, spread over the devices."""
        config, source = self.config.distill, self.source(self.config.distill)
        shard = trajectory_shard(config, self.generation, source)
        shards = -(-config.trajectory_regression.trajectories.clips // shard.facts["clips of a shard"])
        facts = {**shard.facts, "bytes stored": shards * shard.facts["bytes stored"]}
        return replace(shard, steps=-(-shards // self.machine.devices), facts=facts)

    def _rollouts(self) -> Iterator[tuple[Estimate, str]]:
        """One row for all rollouts that cost the same."""
        alike: dict[str, list[str]] = {}
        what = {"sampler", "num_frames", "batch_size", "bfloat16", "weights"}
        for name, run in self.config.rollouts.items():
            if run.checkpoint is not None and run.config is not None:
                alike.setdefault(run.config.model_dump_json(include=what), []).append(name)
        for names in alike.values():
            config = self.config.rollouts[names[0]].config
            if config is not None:
                yield self.rollout(", ".join(names), config)

    def rollout(self, names: str, config: RolloutConfig) -> tuple[Estimate, str]:
        """The row of a prediction: sampling its latents, block by block or at once, and decoding them."""
        sampler = config.sampler
        model = self.model if isinstance(sampler, TextToVideoConfig) else self.generation
        longest = (sampler.clip_frames if isinstance(sampler, FullClipConfig) else None) or 129
        frames = config.num_frames if config.num_frames != "whole" else longest
        shape = ClipShape(config.batch_size, model.views, frames, self.source().grid)

        def trace(layers: int) -> Cost:
            cost, nbytes = _sampling(model.model_copy(update={"num_layers": layers}), shape, config, self.config)
            return cost._replace(held=nbytes)

        cost = extrapolated(trace, model.num_layers, (2, 3))
        codec, decoding = _decoding(self.folder("tokenizer"), shape, config)
        count = parameter_counts(model)[0]
        parts = {
            "weights": (2 if config.weights == "bfloat16" else 4) * count,
            "tokenizer": codec,
            "caches": cost.held,
            "activations": max(cost.activations - cost.held, decoding.activations),
        }
        need = Estimate(
            f"rollout {names} (a prediction)", count, {name: size for name, size in parts.items() if size},
            cost.all_flops + decoding.all_flops, facts={"tokens of a clip": shape.tokens(model)},
        )  # fmt: skip
        instead = "a smaller batch_size" if config.batch_size > 1 else "a smaller num_frames"
        return self._row(need, instead + (", or weights: bfloat16" if config.weights == "float32" else ""))


def _sampling(
    model: WorldModelConfig, shape: ClipShape, config: RolloutConfig, pipeline: PipelineConfig
) -> tuple[Cost, float]:
    """Cost of sampling the latents of a batch, and bytes of the causal sampler's caches."""
    sampler = config.sampler
    with_text = isinstance(sampler, TextToVideoConfig)  # which predicts each view by itself
    one = replace(shape, views=shape.views[:1]) if with_text else shape
    with FakeTensorMode(), torch.no_grad(), torch.autocast("cpu", torch.bfloat16, enabled=config.bfloat16):
        network = WorldModel(model).requires_grad_(False)
        if config.weights == "bfloat16":
            to_bfloat16(network)
        text = (sampler.text or TextConfig()).max_length if isinstance(sampler, TextToVideoConfig) else 0
        batch = one.batch(model, maps=not with_text, text=text)
        maps = batch.action_maps
        if isinstance(sampler, BlockCausalConfig) and maps is not None:
            spec = pipeline.distill.spec
            spec = spec.model_copy(update={"sigmas": sigmas_causal(spec, sampler.steps)})
            noise = Noise(range(shape.clips))
            running = BlockCausalSimulator(network, spec, noise=noise, views=shape.views, bfloat16=config.bfloat16)

            def all_blocks() -> None:
                running.start(batch.latents[:, :, :, 0], maps[:, :, :, :1])
                for controls in maps[:, :, :, 1:].split(spec.block_size, dim=3):
                    running.step(controls)

            return traced(all_blocks), float(running.cache.nbytes)
        context = None

        def read_text() -> None:
            nonlocal context
            if batch.text_ids is not None:
                context = network.encode_text(batch.text_ids, batch.text_mask)

        def euler_step() -> None:  # they cost the same, one after the other
            network(batch.latents, torch.rand(shape.clips), action_maps=maps, text=context, views=one.views)

        steps = (getattr(sampler, "steps", None) or FULL_STEPS) * len(shape.views) // len(one.views)
        return traced(read_text).then(traced(euler_step).repeated(steps)), 0.0


def _decoding(tokenizer: Path | None, shape: ClipShape, config: RolloutConfig) -> tuple[int, Cost]:
    """Bytes of a tokenizer, and the cost of decoding a batch: one clip at a time, all of its views at once.

    A small decoder whose folder is not here yet has the default size.
    """
    with FakeTensorMode(), torch.no_grad(), torch.autocast("cpu", torch.bfloat16, enabled=config.bfloat16):
        codec = tokenizer_outline(tokenizer)
        if config.weights == "bfloat16" and isinstance(codec, WanTokenizer):
            to_bfloat16(codec)
        decoder = getattr(config.sampler, "decoder", None)
        small = None if decoder is None else SmallDecoder.outline(decoder, codec)

        def trace(frames: int) -> Cost:
            latents = torch.empty(len(shape.views), codec.latent_channels, frames, *shape.grid)
            return traced(lambda: (small or codec).decode(latents))

        cost = extrapolated(trace, latent_frame_count(shape.frames), (3, 5))
        return weight_bytes(codec) + (0 if small is None else weight_bytes(small)), cost.repeated(shape.clips)


def as_json(machine: Machine, rows: Sequence[tuple[Estimate, str]]) -> dict[str, Any]:
    """The sheet for programs: bytes, seconds, hours."""
    stages = []
    for row, setting in rows:
        seconds, hours = _times(machine, row)
        stages.append(
            {
                "stage": row.title, "parameters": row.parameters, "bytes": dict(row.parts), "total_bytes": row.total,
                "fits": not setting, "instead": setting, "flops": row.flops, "seconds": seconds, "hours": hours,
                "facts": dict(row.facts),
            }
        )  # fmt: skip
    return {
        "devices": machine.devices, "memory_bytes": int(machine.memory), "usable": USABLE,
        "utilisation": machine.utilisation, "peak_flops": PEAK_FLOPS[machine.card], "stages": stages,
    }  # fmt: skip


def as_text(machine: Machine, rows: Sequence[tuple[Estimate, str]]) -> str:
    """The sheet as a Markdown table, GB a device; below it the settings with which the rest would fit."""
    lines = [
        f"{machine.devices} devices of {gigabytes(machine.memory)} GB ({USABLE:.0%} of it usable), "
        f"{machine.utilisation:.0%} of {PEAK_FLOPS[machine.card] / 1e12:.0f} TFLOP/s",
        "",
        "| stage | parameters | GB a device | of that | seconds | hours | fits |",
        "|---|---|---|---|---|---|---|",
    ]
    for row, setting in rows:
        seconds, hours = _times(machine, row)
        count = row.parameters
        size = f"{count / 1e9:.2f} G" if count >= 1e9 else f"{count / 1e6:.1f} M"
        times = f"{seconds:.3g}" if seconds else "", "" if hours is None else f"{hours:.3g}"
        cells = (row.title, size, gigabytes(row.total), row.describe_parts(), *times, "NO" if setting else "yes")
        lines.append(f"| {' | '.join(cells)} |")
    lines.append("")
    for row, setting in rows:
        figures = {**row.facts, **({"PFLOP": row.flops / 1e15} if row.flops else {})}
        facts = "; ".join(f"{name}: {_fact(name, value)}" for name, value in figures.items())
        lines.append(f"- {row.title}: {facts}" + (f". It does not fit: set {setting}" if setting else ""))
    return "\n".join(lines)


def _times(machine: Machine, row: Estimate) -> tuple[float, float | None]:
    """Seconds of one step, prediction or clip, and hours of all steps where their number is known."""
    seconds = machine.seconds(row.flops)
    return seconds, None if row.steps is None else row.steps * seconds / 3600


def _fact(name: str, value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{amount} ({key} frames)" for key, amount in value.items())
    if "bytes" in name:
        return f"{gigabytes(value)} GB"
    return f"{value:.3g}" if isinstance(value, float) else str(value)
