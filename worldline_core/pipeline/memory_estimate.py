"""Memory of trainings on so many devices, and the refusal of one that cannot fit.

Activations are counted by running a stage's own objective on tensors that have shapes and no values (`memory_trace`).
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, cast

import torch
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensorMode, unset_fake_temporarily

from worldline_core.actions.action_maps import latent_frame_indices
from worldline_core.actions.episode_tracks import ActionTracks
from worldline_core.config import StrictModel
from worldline_core.distillation.auxiliary_losses import PerceptualLoss
from worldline_core.distillation.causal_objective import maps_of
from worldline_core.distillation.causal_teacher_forcing import TeacherForcingObjective
from worldline_core.distillation.distill_config import CYCLE, DistillConfig, DistillStep
from worldline_core.distillation.distribution_matching import DistributionMatchingObjective
from worldline_core.distillation.trajectory_regression import TrajectoryBatch, TrajectoryObjective, teacher_trajectories
from worldline_core.errors import ConfigError
from worldline_core.model.checkpoint import read_checkpoint_info
from worldline_core.model.lpips import LPIPS
from worldline_core.model.networks import build_world_model
from worldline_core.model.tokenizers import spatial_compression, tokenizer_outline
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import WanConfig, WorldModelConfig
from worldline_core.pipeline.memory_trace import SHALLOW, extrapolated, traced
from worldline_core.training.adapters import add_adapters, share_frozen
from worldline_core.training.clip_config import JOINT, SUBSET, ClipSampling, FrameInput
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
from worldline_core.training.training_config import (
    LoRAConfig,
    ShardingConfig,
    Stage1Config,
    Stage2Config,
    TrainerConfig,
)
from worldline_core.training.video_teacher import teacher_outline

USABLE = 0.92
"""Share of a device's memory that a stage may fill; the rest is for the driver, communication and fragmentation."""

_MOMENT = "most"
"""Beginning of the names of bytes held at different moments: the largest of them counts."""
AnyStage = Stage1Config | Stage2Config | DistillConfig
Before = tuple[int, Callable[[], Any]]


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
        self, model: WorldModelConfig, trainer: TrainerConfig, clips: ClipSampling, views: Sequence[str], text: int = 0
    ) -> Batch:
        """The largest micro-batch, of the longest clips: in all views where steps are joint, else in one."""
        joint = clips.view_weights is None or {JOINT, SUBSET} & clips.view_weights.keys()
        count, views = (1, views) if joint else (clips.single_view_factor, views[:1])
        return self.batch(model, count * trainer.batch_size, views, max(clips.lengths), text)

    def encoder(self, batch: Batch) -> tuple[nn.Module, Before]:
        """The tokenizer, and its encoding of a batch, one view of a clip after the other."""
        tokenizer, size = tokenizer_outline(self.tokenizer), (1, 3, batch.clips[0].num_frames, *self.image_size)
        return tokenizer, (len(batch.clips) * len(batch.views), lambda: tokenizer.encode(torch.empty(size)))


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
        """Returns whether a device of so many bytes holds it."""
        return self.total <= USABLE * memory

    def describe_parts(self) -> str:
        return ", ".join(f"{name} {gigabytes(size)}" for name, size in self.parts.items())


class Work(NamedTuple):
    """A device's repeated work.

    Attributes:
        run: by the step's number; where something is trained, its loss comes first.
        models: world models: the one that is averaged, others that are trained, frozen scores.
        whole: other models that are not trained, whole on every device.
        before: what is done before ``run``, and how often: clips are encoded, a teacher looks at them.
    """

    run: Callable[[int], Sequence[Any]]
    models: Sequence[WorldModel]
    whole: Mapping[str, nn.Module] = {}
    before: Sequence[Before] = ()


def outlined(config: WorldModelConfig, lora: LoRAConfig | None = None) -> WorldModel:
    """A model without values, with adapters where they are asked for; call it within a FakeTensorMode."""
    with unset_fake_temporarily(), torch.device("meta"):  # peft moves adapters from device to device
        model = build_world_model(config)
        if lora is not None:
            add_adapters(model, lora, 0)
    return model._apply(lambda one: torch.empty(one.shape, dtype=one.dtype))


def _weight_bytes(models: Sequence[nn.Module]) -> int:
    """Bytes of models' weights; those that share a storage count once."""
    weights = [value for model in models for value in model.parameters()]
    return sum({value.untyped_storage()._cdata: value.nbytes for value in weights}.values())


def _hold(models: Sequence[WorldModel], trainer: TrainerConfig, weights: Literal["fp32", "bf16"]) -> None:
    """Give models the weights that a device computes with."""
    for one in models:
        hold_weights(one, trainer.precision, weights)
    if len(models) > 2:  # what the fake score does not train is the real one's
        share_frozen(*models[1:])


def _moment_bytes(parameter: Tensor, trainer: TrainerConfig) -> float:
    eight_bits = trainer.optimizer.moments == "8bit" and in_eight_bits(parameter)
    return 2 * parameter.numel() * (1 + 4 / BLOCK if eight_bits else 4)


@dataclass(frozen=True, eq=False)
class Training:
    """One training, by its configuration alone.

    Attributes:
        work: a step of the model, whose depth may be another one, made without values.
        turns: numbers of steps, one of each kind that the training takes (distribution matching alternates), and their shares.
        shallow: depths that the line of a deeper model goes through.
    """

    title: str
    trainer: TrainerConfig
    model: WorldModelConfig
    work: Callable[[WorldModelConfig], Work]
    turns: Sequence[tuple[int, float]] = ((0, 1.0),)
    shallow: tuple[int, int] = SHALLOW

    def figures(self, layers: int, shards: int) -> dict[str, float]:
        """Bytes on each of so many devices, and operations of a micro-step, of a model of so many layers.

        Each grows by as much with every layer. Gradients and operations are those of one micro-step; the most bytes before and
        after the loss are apart, for each kind of step.
        """
        trainer = self.trainer.model_copy(update={"device": "cpu"})  # tensors without values follow a CPU's paths
        with FakeTensorMode():
            work = self.work(self.model.model_copy(update={"num_layers": layers}))
            if shards == 1:
                _hold(work.models, trainer, trainer.weights)
            trained = [[value for value in model.parameters() if value.requires_grad] for model in work.models]
            weights = [value for values in trained for value in values]
            counts = [sum(value.numel() for value in values) for values in trained]
            block = sum(value.numel() for value in work.models[0].layers[0].parameters())
            scores = _weight_bytes([one for one, count in zip(work.models[1:], counts[1:], strict=True) if not count])
            found = {
                "parameters": sum(counts) or sum(value.numel() for value in work.models[0].parameters()),
                "weights": (_weight_bytes(work.models) - scores) / shards,
                "moments": sum(_moment_bytes(value, trainer) for value in weights) / shards,
                "average": (trainer.average == "device") * 4 * counts[0] / shards,
                **{name: sum(value.nbytes for value in one.state_dict().values()) for name, one in work.whole.items()},
                "frozen scores": scores / shards,
                # Two blocks are gathered at a time, and the gradients of one are summed, in bfloat16 and float32.
                "gathered": 0 if shards == 1 else block * (2 * 2 + 2 + 4),
                "gradients": max(sum(value.nbytes for value in values) for values in trained),
                "operations": 0.0,
            }
            if shards > 1:
                _hold(work.models, trainer, "bf16")  # shards are kept in float32
            for one in work.models:
                one.checkpointing = trainer.sharding.checkpointing

            def loss(step: int) -> Tensor:
                with autocast(trainer):
                    return work.run(step)[0]

            for step, share in self.turns:
                held = traced(partial(loss, step), weights)
                found |= {f"{_MOMENT} in {step}": held.forward, f"{_MOMENT} after {step}": held.backward}
                found["operations"] += share * held.operations
            for number, (times, look) in enumerate(work.before):
                with torch.no_grad(), autocast(trainer):
                    held = traced(look)
                found[f"{_MOMENT} before, {number}"] = held.forward
                found["operations"] += times * held.operations
        return found

    def estimate(self, devices: int) -> Estimate:
        """Memory on each of so many devices that share the training."""
        trainer, sharding = self.trainer, self.trainer.sharding
        shards, clips = min(sharding.shards or devices, devices), trainer.batch_size * devices
        micro_steps = trainer.accumulation if trainer.global_batch is None else -(-trainer.global_batch // clips)
        parts = extrapolated(partial(self.figures, shards=shards), self.model.num_layers, self.shallow)
        if micro_steps == 1 or sharding.reduce_every_micro_step:
            parts["gradients"] /= shards
        parts["activations"] = max(parts.pop(name) for name in list(parts) if name.startswith(_MOMENT))
        operations = parts.pop("operations")
        return Estimate(
            self.title,
            parameters=round(parts.pop("parameters")),
            parts={name: size for name, size in parts.items() if size},
            operations=micro_steps * operations if trainer.precision == "bf16" else None,
            steps=trainer.steps,
            minutes=trainer.minutes,
        )


def trainings(config: AnyStage, model: WorldModelConfig, source: Sources) -> list[Training]:
    """The trainings of one step, in their order."""
    if not isinstance(config, DistillConfig):
        title = "stage II" if isinstance(config, Stage2Config) else {"base": "base", "stage1": "stage I"}[config.kind]
        return [Training(title, config.trainer, model, partial(_flow_matching, config, source))]
    steps = config.trajectory_regression.trajectories
    clips = min(steps.clips, steps.clips_per_shard)
    shard = TrainerConfig(
        steps=-(-steps.clips // clips),
        batch_size=clips,
        precision=config.trajectory_regression.trainer.precision,
        sharding=ShardingConfig(shards=1),
    )
    # A pass of each Euler step and one that writes the cache, of equal length; only the first kind is repeated.
    passes = (1 + sum(steps.substeps)) / (1 + config.spec.steps)
    model = model.model_copy(update={"towers": "generation"})
    alternating = ((0, 1 - 1 / CYCLE), (CYCLE - 1, 1 / CYCLE))
    shallow = (4, 5)  # at lower depths a score's worst moment can be another one
    parts: dict[DistillStep, dict[str, tuple[Any, ...]]] = {
        "teacher_forcing": {"teacher forcing": (config.teacher_forcing.trainer,)},
        "trajectory_regression": {
            f"trajectories (a shard of {clips} clips)": (shard, ((0, passes),)),
            "trajectory regression": (config.trajectory_regression.trainer,),
        },
        "distribution_matching": {
            "distribution matching": (config.distribution_matching.trainer, alternating, shallow)
        },
    }
    return [
        Training(f"distill: {part}", trainer, model, partial(_distillation, part, config, source, trainer), *settings)
        for step in config.trainers
        for part, (trainer, *settings) in parts[step].items()
    ]


def _flow_matching(config: Stage1Config | Stage2Config, source: Sources, model: WorldModelConfig) -> Work:
    """A step of Stage I or II."""
    trainer, first = config.trainer, config if isinstance(config, Stage1Config) else None
    stored = first is not None and first.text_tower == "stored"
    network = outlined(model.model_copy(update={"towers": "generation"}) if stored else model, config.lora)
    if first is not None and config.lora is None:
        read = () if first.text_tower == "trained" else network.text_parameters()
        for _, value in (*network.action_parameters(), *read):
            value.requires_grad_(False)
    text = 0 if first is None else first.text.max_length
    batch = source.largest(model, trainer, config.clips, model.views, text)
    whole, before, term = dict[str, nn.Module](), list[Before](), None
    if isinstance(config.input, FrameInput):
        whole["tokenizer"], encode = source.encoder(batch)
        before.append(encode)
    if isinstance(config, Stage2Config) and config.relational is not None:
        relational = config.relational.model_copy(update={"student_layer": None})  # all are held, whichever it is
        whole["teacher"], look = teacher_outline(source.teacher)
        term = RelationalTerm(relational, cast("Any", None), network.config.num_layers)
        term.targets = lambda batch, grid: similarity_matrices(
            torch.empty(*batch.latents.shape[:2], *grid, 1), common_shape(relational, grid)
        )
        size = len(model.views), 3, max(config.clips.lengths), *source.image_size
        before.append((trainer.batch_size, lambda: look(torch.empty(size))))
    objective = FlowMatchingObjective(network, sigma=config.sigma, weighting=config.weighting, relational=term)
    if stored:
        reader = hold_weights(outlined(model), "bf16", "bf16")
        objective.encode_text = torch.no_grad()(reader.encode_text)
    return Work(partial(objective.loss, batch, torch.Generator()), [network], whole=whole, before=before)


def _distillation(
    part: str, config: DistillConfig, source: Sources, trainer: TrainerConfig, model: WorldModelConfig
) -> Work:
    """A step of one of the trainings of Stage III, or a shard of trajectories, whose clips are made together."""
    making, forcing = part.startswith("trajectories"), part == "teacher forcing"
    batch = source.largest(model, trainer, config.first_clips if forcing else config.clips, config.views)
    whole, before, distance = dict[str, nn.Module](), list[Before](), None
    if isinstance(config.input, FrameInput):  # it stays, though the later steps use the latents of the trajectories
        whole["encoder"], encode = source.encoder(batch)
        before = [encode] if making or forcing else []
    network = outlined(model, None if making else config.lora)
    if making:
        network.requires_grad_(False)

        def run(_: int) -> Sequence[Tensor]:
            noise, spec = torch.empty_like(batch.latents), config.spec
            given = network, batch.latents, maps_of(batch), noise
            return [teacher_trajectories(*given, views=batch.views, spec=spec, substeps=(1,) * spec.steps)]

        return Work(run, [network], whole=whole, before=before)
    models = [network]
    if forcing:
        if config.teacher_forcing.teacher_share:
            models.append(outlined(model).requires_grad_(False))
        objective: Any = TeacherForcingObjective(network, config, *models[1:])
        return Work(partial(objective.loss, batch, torch.Generator()), models, whole, before)
    shown, views, channels, frames, *grid = batch.latents.shape
    nodes = torch.empty(shown, config.spec.steps + 1, views, channels, frames - 1, *grid)
    mask = torch.ones(shown, views, frames, *grid)
    batch = TrajectoryBatch(**vars(batch), nodes=nodes, history=batch.latents, mask=mask)
    if config.lpips_weights is not None:
        decoder, lpips = tokenizer_outline(source.tokenizer), LPIPS().requires_grad_(False)
        if config.perceptual.bfloat16:
            for parameter in decoder.parameters():
                parameter.data = parameter.data.bfloat16()
        whole |= {"tokenizer": decoder, "lpips": lpips}
        compared = 1 + config.perceptual.latent_frames
        perceptual = PerceptualLoss(decoder, lpips, config.perceptual.latent_frames)
        # One view after the other, and what comes before the compared frames without gradients: neither adds up.
        distance = lambda a, b: perceptual(a[:1, :1, :, -compared:], b[:1, :1, :, -compared:])  # noqa: E731
    if part == "trajectory regression":
        objective = TrajectoryObjective(network, config, distance)
    else:
        models += [outlined(model, config.lora), outlined(model).requires_grad_(False)]
        objective = DistributionMatchingObjective(network, models[2], models[1], config, distance)
    return Work(partial(objective.loss, batch, torch.Generator()), models, whole, before)


def require_memory(config: StrictModel, inputs: Mapping[str, Path]) -> None:
    """Refuse a training that this process's card cannot hold, before anything is loaded.

    Raises:
        ConfigError: its parts in GB, and the setting that would fit.
    """
    if not isinstance(config, AnyStage):
        return
    device = (config.teacher_forcing if isinstance(config, DistillConfig) else config).trainer.device
    memory, frames = device_memory(device), isinstance(config.input, FrameInput)
    if memory is None or ("tokenizer" if frames else "latents") not in inputs:
        return  # the training itself names the input that is missing
    folders = inputs.get("tokenizer"), inputs.get("teacher")
    if isinstance(config.input, FrameInput):
        source = Sources.of(*folders, config.input.image_size)
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
                where=f"{need.title} on {device}",
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
