"""Memory of trainings on so many devices, and the refusal of one that cannot fit.

Activations are counted by running a stage's own objective on tensors that have shapes and no values (`memory_trace`).
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensorMode, unset_fake_temporarily

from worldline_core.actions.action_maps import latent_frame_indices
from worldline_core.actions.episode_tracks import ActionTracks
from worldline_core.config import StrictModel
from worldline_core.distillation.auxiliary_losses import PerceptualLoss
from worldline_core.distillation.causal_objective import maps_of
from worldline_core.distillation.causal_teacher_forcing import TeacherForcingObjective
from worldline_core.distillation.distill_config import CYCLE, DistillConfig
from worldline_core.distillation.distribution_matching import DistributionMatchingObjective
from worldline_core.distillation.trajectory_regression import TrajectoryBatch, TrajectoryObjective, teacher_trajectories
from worldline_core.errors import ConfigError
from worldline_core.model.checkpoint import read_checkpoint_info
from worldline_core.model.lpips import LPIPS
from worldline_core.model.networks import build_world_model
from worldline_core.model.tokenizers import spatial_compression, tokenizer_outline
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import WanConfig, WorldModelConfig
from worldline_core.pipeline.memory_trace import extrapolated, traced
from worldline_core.training.adapters import add_adapters
from worldline_core.training.clip_config import JOINT, SUBSET, ClipInput, ClipSampling, FrameInput
from worldline_core.training.clip_loader import Batch
from worldline_core.training.clip_sampler import Clip
from worldline_core.training.clip_source import LatentStore
from worldline_core.training.flow_matching import FlowMatchingObjective
from worldline_core.training.optimizers import BLOCK, in_eight_bits
from worldline_core.training.processes import hold_weights
from worldline_core.training.relational import RelationalTerm, common_shape, similarity_matrices
from worldline_core.training.resident import track_bytes
from worldline_core.training.stage2 import stage2_model_config
from worldline_core.training.trainer import autocast
from worldline_core.training.training_config import LoRAConfig, Stage1Config, Stage2Config, TrainerConfig
from worldline_core.training.video_teacher import teacher_outline

USABLE = 0.92
"""Share of a device's memory that a stage may fill; the rest is for the driver, communication and fragmentation."""
AnyStage = Stage1Config | Stage2Config | DistillConfig
Pass = tuple[float, Callable[[], Any]]
"""A computation, and how many times a micro-step runs it. A computation that trains returns its loss first."""
Work = tuple[Sequence[WorldModel], Sequence[Pass], Mapping[str, nn.Module]]
"""World models (the averaged one, then other trained ones, then frozen scores), passes, and models that are not sharded."""


def gigabytes(size: float) -> str:
    """Bytes as GB (10^9), short enough for a table."""
    value = size / 1e9
    return f"{value:.0f}" if value >= 100 else f"{value:.1f}" if value >= 0.1 else f"{value:.3f}"


@dataclass(frozen=True)
class Sources:
    """Folders of outside models (published shapes stand for a missing one), and (H, W) of pictures and of latents."""

    tokenizer: Path | None
    teacher: Path | None
    image_size: tuple[int, int]
    grid: tuple[int, int]

    @classmethod
    def of(cls, tokenizer: Path | None, teacher: Path | None, image_size: tuple[int, int]) -> Sources:
        """With the latents that a tokenizer makes of pictures of a size."""
        space = spatial_compression(tokenizer)
        return cls(tokenizer, teacher, image_size, (image_size[0] // space, image_size[1] // space))

    def batch(self, model: WorldModelConfig, clips: int, views: Sequence[str], frames: int, text: int = 0) -> Batch:
        """An uninitialised batch of clips of so many recorded frames, with maps, or with ``text`` tokens for each clip."""
        size, count = (clips, len(views)), len(latent_frame_indices(frames))
        latents = torch.empty(*size, model.latent_channels, count, *self.grid)
        batch = Batch((Clip("", 0, frames, 1),) * clips, tuple(views), latents)
        if not text:
            drawn = self.grid if model.takes_maps else (1, 1)
            return replace(batch, action_maps=torch.empty(*size, model.control_channels, count, *drawn))
        tokens, mask = torch.zeros(clips, text, dtype=torch.long), torch.ones(clips, text, dtype=torch.bool)
        if isinstance(model, WanConfig):  # embeddings in place of ids
            tokens = torch.zeros(clips, text, model.text_size)
        return replace(batch, text_ids=tokens, text_mask=mask)

    def largest(
        self, model: WorldModelConfig, batch_size: int, clips: ClipSampling, views: Sequence[str], text: int = 0
    ) -> Batch:
        """The largest micro-batch, of the longest clips: in all views where steps are joint, else in one."""
        joint = clips.view_weights is None or {JOINT, SUBSET} & clips.view_weights.keys()
        count, views = (1, views) if joint else (clips.single_view_factor, views[:1])
        return self.batch(model, count * batch_size, views, max(clips.lengths), text)

    def encoder(self, reading: ClipInput, batch: Batch) -> tuple[dict[str, nn.Module], list[Pass]]:
        """The tokenizer of clips that are read as frames, and its encoding of a batch, one view of a clip after the other."""
        if not isinstance(reading, FrameInput):
            return {}, []
        tokenizer, size = tokenizer_outline(self.tokenizer), (1, 3, batch.clips[0].num_frames, *self.image_size)
        return {"encoder": tokenizer}, [
            (len(batch.clips) * len(batch.views), lambda: tokenizer.encode(torch.empty(size)))
        ]


@dataclass(frozen=True)
class Estimate:
    """Memory of one stage on one device, and the length of it.

    Attributes:
        parameters: trained ones, or those of a model that only predicts.
        parts: bytes at the worst moment, by name.
        operations: of a step on the longest clips, on each device; None where they are not in bfloat16.
        steps: of the stage; None where `minutes` say how long it trains.
    """

    title: str
    parameters: int
    parts: Mapping[str, float]
    operations: float | None = None
    steps: int | None = None
    minutes: float | None = None

    @property
    def total(self) -> float:
        return sum(self.parts.values())

    def fits(self, memory: float) -> bool:
        return self.total <= USABLE * memory

    def describe_parts(self) -> str:
        return ", ".join(f"{name} {gigabytes(size)}" for name, size in self.parts.items())


def outlined(config: WorldModelConfig, lora: LoRAConfig | None = None) -> WorldModel:
    """A model without values, with adapters where they are asked for; call it within a FakeTensorMode."""
    with unset_fake_temporarily(), torch.device("meta"):  # peft moves adapters from device to device
        model = build_world_model(config)
        if lora is not None:
            add_adapters(model, lora, 0)
    return model._apply(lambda one: torch.empty(one.shape, dtype=one.dtype))


@dataclass(frozen=True, eq=False)
class Training:
    """One training, by its configuration alone.

    Attributes:
        work: that of the model, whose depth may be another one, made without values.
        shallow: depths that the line of a deeper model goes through; at lower ones its worst moment can be another one.
    """

    title: str
    trainer: TrainerConfig
    model: WorldModelConfig
    work: Callable[[WorldModelConfig], Work]
    shallow: tuple[int, int] = (2, 3)

    def figures(self, layers: int, *, sharded: bool) -> dict[str, float]:
        """Bytes before they are shared out, and operations of a micro-step, of a model of so many layers.

        Each grows by as much with every layer; therefore the most bytes before and after the loss of each pass are apart.
        """
        trainer = self.trainer.model_copy(update={"device": "cpu"})  # tensors without values follow a CPU's paths
        with FakeTensorMode():
            models, passes, whole = self.work(self.model.model_copy(update={"num_layers": layers}))
            for one in models:
                hold_weights(one, trainer.precision, "bf16" if sharded else trainer.weights)
                one.checkpointing = trainer.sharding.checkpointing
            trained = [[value for value in one.parameters() if value.requires_grad] for one in models]
            weights = [value for values in trained for value in values]
            for value in weights:
                value.register_post_accumulate_grad_hook(lambda one: setattr(one, "grad", None))
            # What later models do not train is a frozen score, or shared with one.
            own = [*models[0].parameters(), *(value for values in trained[1:] for value in values)]
            scores = [one for one, values in zip(models[1:], trained[1:], strict=True) if not values]
            short = trainer.optimizer.moments == "8bit"

            def size(values: Iterable[Tensor]) -> int:
                return sum(4 * value.numel() if sharded else value.nbytes for value in values)

            found = {
                "parameters": sum(value.numel() for value in weights or models[0].parameters()),
                "weights": size(own),
                "moments": sum((2 + 8 / BLOCK if short and in_eight_bits(one) else 8) * one.numel() for one in weights),
                "average": sum(4 * value.numel() for value in trained[0]) if trainer.average == "device" else 0,
                **{name: sum(value.nbytes for value in one.state_dict().values()) for name, one in whole.items()},
                "frozen scores": size(value for one in scores for value in one.parameters()),
                # Two blocks are gathered at a time in bfloat16, and the gradients of one are summed, in bfloat16 and float32.
                "gathered": 10 * sum(value.numel() for value in models[0].layers[0].parameters()) if sharded else 0,
                "gradients": max(size(values) for values in trained),
                "operations": 0.0,
            }
            for number, (times, run) in enumerate(passes):
                held = traced(run, autocast(trainer))
                found |= {f"activations of {number}": held.forward, f"activations after {number}": held.backward}
                found["operations"] += times * held.operations
        return found

    def estimate(self, devices: int) -> Estimate:
        """Memory on each of so many devices that share the training."""
        trainer, sharding = self.trainer, self.trainer.sharding
        shards, clips = min(sharding.shards or devices, devices), trainer.batch_size * devices
        micro_steps = trainer.accumulation if trainer.global_batch is None else -(-trainer.global_batch // clips)
        parts = extrapolated(partial(self.figures, sharded=shards > 1), self.model.num_layers, self.shallow)
        shared_out = ["weights", "moments", "average", "frozen scores"]
        if micro_steps == 1 or sharding.reduce_every_micro_step:
            shared_out.append("gradients")
        for name in shared_out:
            parts[name] /= shards
        parts["activations"] = max(parts.pop(name) for name in list(parts) if name.startswith("activations"))
        count, operations = round(parts.pop("parameters")), micro_steps * parts.pop("operations")
        parts = {name: size for name, size in parts.items() if size}
        in_bfloat16 = trainer.precision == "bf16"
        return Estimate(self.title, count, parts, operations if in_bfloat16 else None, trainer.steps, trainer.minutes)


def trainings(config: AnyStage, model: WorldModelConfig, source: Sources) -> list[Training]:
    """The trainings of one step, in their order."""
    if not isinstance(config, DistillConfig):
        title = "stage II" if isinstance(config, Stage2Config) else {"base": "base", "stage1": "stage I"}[config.kind]
        return [Training(title, config.trainer, model, partial(_flow_matching, config, source))]
    steps = config.trajectory_regression.trajectories
    clips, precision = min(steps.clips, steps.clips_per_shard), config.trajectory_regression.trainer.precision
    shard = TrainerConfig.model_validate(
        {"steps": -(-steps.clips // clips), "batch_size": clips, "precision": precision, "sharding": {"shards": 1}}
    )
    trainers: list[tuple[str, TrainerConfig]] = [*config.trainers.items()]
    if len(trainers) > 1:
        trainers.insert(1, (f"trajectories (a shard of {clips} clips)", shard))
    model, made = model.model_copy(update={"towers": "generation"}), list[Training]()
    for part, trainer in trainers:
        work = partial(_distillation, part, trainer.batch_size, config, source)
        shallow = (4, 5) if part == "distribution_matching" else (2, 3)
        made.append(Training(f"distill: {part.replace('_', ' ')}", trainer, model, work, shallow))
    return made


def _flow_matching(config: Stage1Config | Stage2Config, source: Sources, model: WorldModelConfig) -> Work:
    """Stage I or II."""
    first = config if isinstance(config, Stage1Config) else None
    stored = first is not None and first.text_tower == "stored"
    network = outlined(model.model_copy(update={"towers": "generation"}) if stored else model, config.lora)
    if first is not None and config.lora is None:
        read = () if first.text_tower == "trained" else network.text_parameters()
        for _, value in (*network.action_parameters(), *read):
            value.requires_grad_(False)
    text, size = 0 if first is None else first.text.max_length, config.trainer.batch_size
    batch = source.largest(model, size, config.clips, model.views, text)
    (whole, passes), term = source.encoder(config.input, batch), None
    if isinstance(config, Stage2Config) and config.relational is not None:
        relational = config.relational.model_copy(update={"student_layer": None})  # all are held, whichever it is
        whole["teacher"], look = teacher_outline(source.teacher)
        term = RelationalTerm(relational, cast("Any", None), network.config.num_layers)
        term.targets = lambda batch, grid: similarity_matrices(
            torch.empty(*batch.latents.shape[:2], *grid, 1), common_shape(relational, grid)
        )
        clip = len(model.views), 3, max(config.clips.lengths), *source.image_size
        passes.append((size, lambda: look(torch.empty(clip))))
    objective = FlowMatchingObjective(network, sigma=config.sigma, weighting=config.weighting, relational=term)
    if stored:
        reader = hold_weights(outlined(model), "bf16", "bf16")
        objective.encode_text = torch.no_grad()(reader.encode_text)
    return [network], [(1, partial(objective.loss, batch, torch.Generator(), 0)), *passes], whole


def _distillation(part: str, size: int, config: DistillConfig, source: Sources, model: WorldModelConfig) -> Work:
    """A step of one of the trainings of Stage III, or a shard of trajectories, whose clips are made together."""
    spec, first = config.spec, part == "teacher_forcing"
    batch = source.largest(model, size, config.first_clips if first else config.clips, config.views)
    whole, passes = source.encoder(config.input, batch)
    if part.startswith("trajectories"):
        teacher = outlined(model).requires_grad_(False)

        def run() -> Tensor:
            given = teacher, batch.latents, maps_of(batch), torch.empty_like(batch.latents)
            return teacher_trajectories(*given, views=batch.views, spec=spec, substeps=(1,) * spec.steps)

        # A pass of each Euler step and one that writes the cache, of equal length; only the first kind is repeated.
        times = (1 + sum(config.trajectory_regression.trajectories.substeps)) / (1 + spec.steps)
        return [teacher], [(times, run), *passes], whole
    models, distance = [outlined(model, config.lora)], None
    if first:
        if config.teacher_forcing.teacher_share:
            models.append(outlined(model).requires_grad_(False))
        loss = partial(TeacherForcingObjective(models[0], config, *models[1:]).loss, batch, torch.Generator())
        return models, [(1, partial(loss, 0)), *passes], whole
    # The encoder stays, though these steps use the latents of the trajectories.
    clips, views, channels, frames, *grid = batch.latents.shape
    nodes = torch.empty(clips, spec.steps + 1, views, channels, frames - 1, *grid)
    batch = TrajectoryBatch(**vars(batch), nodes=nodes, history=batch.latents, mask=batch.latents[:, :, 0])
    if config.lpips_weights is not None:
        decoder, lpips = tokenizer_outline(source.tokenizer), LPIPS().requires_grad_(False)
        if config.perceptual.bfloat16:
            for parameter in decoder.parameters():
                parameter.data = parameter.data.bfloat16()
        whole |= {"decoder": decoder, "lpips": lpips}
        compared = 1 + config.perceptual.latent_frames
        perceptual = PerceptualLoss(decoder, lpips, config.perceptual.latent_frames)
        # One view after the other, and what comes before the compared frames without gradients: neither adds up.
        distance = lambda a, b: perceptual(a[:1, :1, :, -compared:], b[:1, :1, :, -compared:])  # noqa: E731
    if part == "trajectory_regression":
        loss = partial(TrajectoryObjective(models[0], config, distance).loss, batch, torch.Generator())
        return models, [(1, partial(loss, 0))], whole
    models += [outlined(model, config.lora), outlined(model).requires_grad_(False)]
    objective = DistributionMatchingObjective(models[0], models[2], models[1], config, distance)
    loss = partial(objective.loss, batch, torch.Generator())
    return models, [(1 - 1 / CYCLE, partial(loss, 0)), (1 / CYCLE, partial(loss, CYCLE - 1))], whole


def require_memory(config: StrictModel, inputs: Mapping[str, Path]) -> None:
    """Refuse a training that this process's card cannot hold, before anything is loaded.

    Raises: ConfigError: its parts in GB, and the setting that would fit.
    """
    if not isinstance(config, AnyStage):
        return
    reading, first = config.input, config.teacher_forcing if isinstance(config, DistillConfig) else config
    memory, folders = device_memory(first.trainer.device), (inputs.get("tokenizer"), inputs.get("teacher"))
    if memory is None or ("tokenizer" if isinstance(reading, FrameInput) else "latents") not in inputs:
        return  # the training itself names the input that is missing
    if isinstance(reading, FrameInput):
        source = Sources.of(*folders, reading.image_size)
    else:
        latents = LatentStore.open(inputs["latents"])
        source = Sources(*folders, latents.image_size, latents.latent_shape[1:])
    start = next((inputs[name] for name in ("base", "stage1", "stage2") if name in inputs), None)
    model = cast("Stage1Config", config).model if start is None else read_checkpoint_info(start).config
    if isinstance(config, Stage2Config):
        model = stage2_model_config(config, model)
    resident = resident_bytes(config, inputs, model)
    for training in trainings(config, model, source):
        need = training.estimate(int(os.environ.get("WORLD_SIZE", "1")))
        if resident:
            need = replace(need, parts={**need.parts, "resident input": resident})
        if not need.fits(memory):
            raise ConfigError(
                "This training does not fit the device's memory.",
                where=f"{need.title} on {first.trainer.device}",
                expected=f"at most {gigabytes(USABLE * memory)} GB",
                got=f"{gigabytes(need.total)} GB ({need.describe_parts()})",
                next_step=f"{'set input.resident to false, ' if resident else ''}take more devices or what `worldline plan --fit` "
                "proposes, first trainer.sharding.checkpointing: block",
            )


def resident_bytes(config: AnyStage, inputs: Mapping[str, Path], model: WorldModelConfig) -> int:
    """Bytes of what every device keeps of all episodes: latents, samples of tracks, shares of things."""
    if isinstance(config.input, FrameInput) or not config.input.resident:
        return 0
    distilled = isinstance(config, DistillConfig)
    weighting = (config.teacher_forcing if distilled else config).weighting
    latents, views = LatentStore.open(inputs["latents"]), config.views if distilled else model.views
    tracks = ActionTracks.open(inputs["tracks"]).rows if "tracks" in inputs else []
    samples = track_bytes(len(views), max((len(row["arms"] or ()) for row in tracks), default=0), model.native_size)
    shares = 2 * math.prod(latents.latent_shape[1:]) if any(weighting.things) else 0
    return latents.stored_bytes + sum(row.num_frames * (samples + len(row.views) * shares) for row in latents.rows)


def device_memory(device: str) -> float | None:
    """Bytes of a card; None for a processor, whose memory the system shares out."""
    on_gpu = torch.device(device).type == "cuda"
    return float(torch.cuda.get_device_properties(device).total_memory) if on_gpu else None
