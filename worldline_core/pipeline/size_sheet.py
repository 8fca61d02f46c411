"""The table of `worldline plan`: memory, operations and time of every stage of a preset on so many devices.

Every figure follows from the configuration and the model classes; published shapes stand for folders of weights that are not here.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import torch
from pydantic import ByteSize, Field
from torch._subclasses.fake_tensor import FakeTensorMode

from worldline_core.config import StrictModel
from worldline_core.errors import ConfigError
from worldline_core.model.checkpoint import DESCRIPTION, read_checkpoint_info
from worldline_core.model.layers import TextContext
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


class Machine(StrictModel):
    """Devices that share a run; ``utilisation``: the share of the card's peak that is reached."""

    devices: int = Field(default=8, ge=1)
    memory: ByteSize
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
        config, generation = self.config, self.generation
        stages = (config.train_stage1, self.model), (config.train_stage2, generation), (config.distill, generation)
        return [
            one for stage, model in stages if stage is not None for one in trainings(stage, model, self.source(stage))
        ]

    def rows(self) -> Iterator[tuple[Estimate, str]]:
        """Every stage in the order of a run, and the setting with which it would fit; empty where it does."""
        devices, memory = self.machine.devices, self.machine.memory
        if self.config.caches_latents:
            source, views = self.source(), tuple(self.config.encode_latents.views)
            weights, cost = encoding(source, ClipShape(1, views, 129, source.grid))
            parts = {"tokenizer": weights, "activations": cost.activations}
            need = Estimate("encode_latents (a clip of 129 frames)", weights // 4, parts, cost.all_flops)
            yield self._row(need, "a smaller image_size")
        for training in self.trainings():
            if training.title == "distill: trajectory regression":
                shard = trajectory_shard(self.config.distill, self.generation, self.source(self.config.distill))
                shard = replace(shard, steps=-(-(shard.steps or 1) // devices))
                yield self._row(shard, "fewer clips_per_shard")
            need = training.estimate(devices)
            if training.trainer.minutes:
                need = replace(need, steps=round(60 * training.trainer.minutes / self.machine.seconds(need.flops)))
            yield need, "" if need.fits(memory) else training.fitting_setting(devices, memory)
        alike: dict[str, list[str]] = {}  # rollouts that cost the same share a row
        what = {"sampler", "num_frames", "batch_size", "bfloat16", "weights"}
        for name, run in self.config.rollouts.items():
            if run.checkpoint is not None and run.config is not None:
                alike.setdefault(run.config.model_dump_json(include=what), []).append(name)
        for names in alike.values():
            if (config := self.config.rollouts[names[0]].config) is not None:
                yield self.rollout(", ".join(names), config)

    def _row(self, need: Estimate, setting: str) -> tuple[Estimate, str]:
        return need, "" if need.fits(self.machine.memory) else setting

    def rollout(self, names: str, config: RolloutConfig) -> tuple[Estimate, str]:
        """The row of a prediction: sampling its latents, block by block or at once, and decoding them."""
        sampler = config.sampler
        model = self.model if isinstance(sampler, TextToVideoConfig) else self.generation
        longest = (sampler.clip_frames if isinstance(sampler, FullClipConfig) else None) or 129
        frames = config.num_frames if config.num_frames != "whole" else longest
        shape = ClipShape(config.batch_size, model.views, frames, self.source().grid)

        def trace(layers: int) -> Cost:
            return self._sampling(model.model_copy(update={"num_layers": layers}), shape, config)

        cost = extrapolated(trace, model.num_layers, (2, 3))
        codec, decoding = _decoding(self.folder("tokenizer"), shape, config)
        count = parameter_counts(model)[0]
        parts = {
            "weights": (2 if config.weights == "bfloat16" else 4) * count,
            "tokenizer": codec,
            "activations": max(cost.activations, cost.held + decoding.activations),
        }
        need = Estimate(f"rollout {names} (a prediction)", count, parts, cost.all_flops + decoding.all_flops)
        return self._row(need, "a smaller batch_size or num_frames, or weights: bfloat16")

    def _sampling(self, model: WorldModelConfig, shape: ClipShape, config: RolloutConfig) -> Cost:
        """Cost of sampling the latents of a batch; a causal sampler's caches are still held at its end."""
        sampler = config.sampler
        text = (sampler.text or TextConfig()).max_length if isinstance(sampler, TextToVideoConfig) else 0
        one = replace(shape, views=shape.views[:1]) if text else shape  # with text each view is predicted by itself
        with FakeTensorMode(), torch.no_grad(), torch.autocast("cpu", torch.bfloat16, enabled=config.bfloat16):
            network = WorldModel(model).requires_grad_(False)
            if config.weights == "bfloat16":
                to_bfloat16(network)
            batch = one.batch(model, maps=not text, text=text)
            maps = batch.action_maps
            if isinstance(sampler, BlockCausalConfig) and maps is not None:
                spec = self.config.distill.spec
                spec = spec.model_copy(update={"sigmas": sigmas_causal(spec, sampler.steps)})
                noise = Noise(range(shape.clips))
                running = BlockCausalSimulator(network, spec, noise=noise, views=shape.views, bfloat16=config.bfloat16)

                def all_blocks() -> None:
                    running.start(batch.latents[:, :, :, 0], maps[:, :, :, :1])
                    for controls in maps[:, :, :, 1:].split(spec.block_size, dim=3):
                        running.step(controls)

                return traced(all_blocks)
            ids, mask = batch.text_ids, batch.text_mask
            read: list[TextContext] = []
            reading = Cost() if ids is None else traced(lambda: read.append(network.encode_text(ids, mask)))
            sigma, text_read = torch.rand(shape.clips), read[0] if read else None
            euler = traced(lambda: network(batch.latents, sigma, action_maps=maps, text=text_read, views=one.views))
            steps = (getattr(sampler, "steps", None) or FULL_STEPS) * len(shape.views) // len(one.views)
            return reading.then(euler.repeated(steps))


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


def as_text(machine: Machine, rows: Sequence[tuple[Estimate, str]]) -> str:
    """The sheet as a Markdown table; the last column names the setting with which a stage would fit."""
    lines = [
        f"{machine.devices} devices of {gigabytes(machine.memory)} GB ({USABLE:.0%} of it usable), "
        f"{machine.utilisation:.0%} of {PEAK_FLOPS[machine.card] / 1e12:.0f} TFLOP/s",
        "",
        "| stage | parameters | GB a device | of that | PFLOP | seconds | hours | fits |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row, setting in rows:
        seconds = machine.seconds(row.flops)
        hours = "" if row.steps is None else f"{row.steps * seconds / 3600:.3g}"
        count = f"{row.parameters / 1e9:.2f} G" if row.parameters >= 1e9 else f"{row.parameters / 1e6:.1f} M"
        cells = (row.title, count, gigabytes(row.total), row.describe_parts(), f"{row.flops / 1e15:.3g}")
        lines.append(
            f"| {' | '.join(cells)} | {seconds:.3g} | {hours} | {f'no: set {setting}' if setting else 'yes'} |"
        )
    return "\n".join(lines)
