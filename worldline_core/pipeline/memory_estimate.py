"""Memory of trainings on so many devices, and the refusal of one that cannot fit.

Activations are counted by running a stage's own objective on tensors that have shapes and no values (`memory_trace`).
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

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
from worldline_core.distillation.teacher_trajectories import TrajectoryBatch, teacher_trajectories
from worldline_core.distillation.trajectory_regression import TrajectoryObjective
from worldline_core.errors import ConfigError
from worldline_core.model.checkpoint import read_checkpoint_info
from worldline_core.model.lpips import LPIPS
from worldline_core.model.mixture import is_text_parameter
from worldline_core.model.networks import build_world_model
from worldline_core.model.tokenizers import spatial_compression, tokenizer_outline
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import MixtureConfig, WanConfig, WorldModelConfig
from worldline_core.pipeline.memory_trace import Held, extrapolated, traced
from worldline_core.training.adapters import add_adapters, share_frozen
from worldline_core.training.clip_config import JOINT, SUBSET, ClipSampling, FrameInput
from worldline_core.training.clip_loader import Batch
from worldline_core.training.clip_sampler import Clip
from worldline_core.training.clip_source import LatentStore
from worldline_core.training.flow_matching import FlowMatchingObjective
from worldline_core.training.optimizers import BLOCK, in_eight_bits
from worldline_core.training.processes import hold_weights
from worldline_core.training.relational import ClipSimilarities, RelationalTerm, SimilarityMatrices, common_shape
from worldline_core.training.resident import track_bytes
from worldline_core.training.stage1 import is_trained
from worldline_core.training.stage2 import stage2_model_config
from worldline_core.training.trainer import autocast
from worldline_core.training.training_config import (
    LoRAConfig,
    RelationalConfig,
    ShardingConfig,
    Stage1Config,
    Stage2Config,
    TrainerConfig,
)
from worldline_core.training.video_teacher import teacher_outline

USABLE = 0.92
"""Share of a device's memory that a stage may fill; the rest is for the driver, communication and fragmentation."""

AnyStage = Stage1Config | Stage2Config | DistillConfig


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
    @cache
    def of(cls, tokenizer: Path | None, teacher: Path | None, image_size: tuple[int, int]) -> Sources:
        """With the latents that a tokenizer makes of pictures of a size."""
        space = spatial_compression(tokenizer)
        return cls(tokenizer, teacher, image_size, (image_size[0] // space, image_size[1] // space))

    def batch(self, model: WorldModelConfig, clips: int, views: Sequence[str], frames: int, text: int = 0) -> Batch:
        """An uninitialised batch of clips of so many recorded frames, with maps, or with ``text`` tokens for each clip."""
        size, count = (clips, len(views)), len(latent_frame_indices(frames))
        drawn = self.grid if model.takes_maps else (1, 1)
        embedded = (model.text_size,) if isinstance(model, WanConfig) else ()  # in place of ids
        texts = torch.zeros(clips, text, *embedded, dtype=torch.float32 if embedded else torch.long)
        return Batch(
            (Clip("", 0, frames, 1),) * clips,
            tuple(views),
            torch.empty(*size, model.latent_channels, count, *self.grid),
            None if text else torch.empty(*size, model.control_channels, count, *drawn),
            texts if text else None,
            torch.ones(clips, text, dtype=torch.bool) if text else None,
        )

    def largest(
        self, model: WorldModelConfig, trainer: TrainerConfig, clips: ClipSampling, views: Sequence[str], text: int = 0
    ) -> Batch:
        """The largest micro-batch, of the longest clips."""
        views, count = self.shown(trainer, clips, views)
        return self.batch(model, count, views, max(clips.lengths), text)

    @staticmethod
    def shown(trainer: TrainerConfig, clips: ClipSampling, views: Sequence[str]) -> tuple[Sequence[str], int]:
        """All views where steps are joint, else one, and the number of clips in a micro-batch."""
        joint = clips.view_weights is None or {JOINT, SUBSET} & clips.view_weights.keys()
        count, views = (1, views) if joint else (clips.single_view_factor, views[:1])
        return views, count * trainer.batch_size

    @cache  # noqa: B019 - a few sources a process
    def looking(
        self, by: Literal["tokenizer", "teacher"], frames: int, precision: Literal["bf16", "fp32"], views: int = 1
    ) -> Held:
        """Memory that the tokenizer needs to encode one view of a clip, or the relational teacher to encode all of them."""
        with FakeTensorMode(), torch.no_grad(), autocast(TrainerConfig(steps=1, precision=precision)):
            look = teacher_outline(self.teacher)[1] if by == "teacher" else tokenizer_outline(self.tokenizer).encode
            return traced(lambda: look(torch.empty(views, 3, frames, *self.image_size)))


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
    """A device's repeated work: ``run``, by the step's number, returns the loss where something is trained.

    Attributes:
        models, scores: world models that are trained, the first alone averaged, and those that are not.
        whole: other models that are not trained, whole on every device.
    """

    run: Callable[[int], Any]
    models: Sequence[WorldModel] = ()
    scores: Sequence[WorldModel] = ()
    whole: Mapping[str, nn.Module] = {}


def adapted(config: WorldModelConfig, lora: LoRAConfig) -> WorldModel:
    """A model with adapters, made within a FakeTensorMode; peft, which moves them from device to device, does so outside of it."""
    with unset_fake_temporarily(), torch.device("meta"):
        model = build_world_model(config)
        add_adapters(model, lora, 0)
    return model._apply(lambda one: torch.empty(one.shape, dtype=one.dtype))


def _new_bytes(model: nn.Module, seen: set[int]) -> float:
    """Bytes of a model's weights whose storages no other model has named yet."""
    found = {value.untyped_storage()._cdata: value.nbytes for value in model.parameters()}
    new = {key: size for key, size in found.items() if key not in seen}
    seen.update(new)
    return sum(new.values())


def _moment_bytes(parameter: Tensor, trainer: TrainerConfig) -> float:
    if trainer.optimizer.moments == "8bit" and in_eight_bits(parameter):
        return 2 * (1 + 4 / BLOCK) * parameter.numel()
    return 2 * 4 * parameter.numel()


@dataclass(frozen=True, eq=False)
class Training:
    """One training, by its configuration alone.

    Attributes:
        work: a step with a model of some depth, made without values.
        trained: whether a parameter gets gradients, by its name.
        turns: numbers of steps, one of each kind that the training takes (distribution matching alternates), and their shares.
        before: what is done before a step's forward pass, and how often: clips are encoded, a teacher looks at them.
    """

    title: str
    trainer: TrainerConfig
    model: WorldModelConfig
    work: Callable[[WorldModel], Work]
    trained: Callable[[str], bool] = lambda _: True
    lora: LoRAConfig | None = None
    turns: Mapping[int, float] = field(default_factory=lambda: {0: 1.0})
    before: Sequence[tuple[int, Callable[[], Held]]] = ()

    def outline(self, layers: int, weights: Literal["fp32", "bf16"] | None = None) -> Work:
        """The step of a model of so many layers; call it within a FakeTensorMode.

        Args:
            weights: those of trained matrices as a device computes with them; None: all in float32, as shards are kept.
        """
        network = build_world_model(self.model.model_copy(update={"num_layers": layers}))
        for name, parameter in network.named_parameters():
            parameter.requires_grad_(self.trained(name))
        work = self.work(network if self.lora is None else adapted(network.config, self.lora))
        if weights is not None:
            for one in (*work.models, *work.scores):
                hold_weights(one, self.trainer.precision, weights)
            if self.lora is not None and len(work.models) > 1:
                share_frozen(work.models[1], work.scores[0])
        return work

    def _held(self, sharded: bool) -> Held:
        """A micro-step; its operations are a mean over the kinds of steps."""
        trainer = self.trainer.model_copy(update={"device": "cpu"})  # tensors without values follow a CPU's paths

        def trace(step: int, layers: int) -> Held:
            with FakeTensorMode():
                work = self.outline(layers, "bf16" if sharded else trainer.weights)
                for one in (*work.models, *work.scores):
                    one.checkpointing = trainer.sharding.checkpointing

                def loss() -> Tensor:
                    with autocast(trainer):
                        return work.run(step)

                return traced(loss, [value for one in work.models for value in one.parameters()])

        steps = {step: extrapolated(partial(trace, step), self.model.num_layers) for step in self.turns}
        before = [(times, held()) for times, held in self.before]
        most = max([*(max(held[:2]) for held in steps.values()), *(held.forward for _, held in before)])
        operations = sum(share * steps[step].operations for step, share in self.turns.items())
        return Held(most, 0, operations + sum(times * held.operations for times, held in before))

    def estimate(self, devices: int) -> Estimate:
        """Memory on each of so many devices that share the training."""
        trainer, sharding = self.trainer, self.trainer.sharding
        shards, clips = min(sharding.shards or devices, devices), trainer.batch_size * devices
        micro_steps = trainer.accumulation if trainer.global_batch is None else -(-trainer.global_batch // clips)
        held = self._held(sharded=shards > 1)
        with FakeTensorMode():
            work = self.outline(self.model.num_layers, trainer.weights if shards == 1 else None)
        trained = [[value for value in model.parameters() if value.requires_grad] for model in work.models]
        count = sum(value.numel() for values in trained for value in values)
        block = sum(value.numel() for value in work.models[0].layers[0].parameters())
        summed = micro_steps == 1 or sharding.reduce_every_micro_step
        seen: set[int] = set()
        scores = sum(_new_bytes(score, seen) for score in work.scores)
        parts = {
            "weights": sum(_new_bytes(model, seen) for model in work.models) / shards,
            "moments": sum(_moment_bytes(value, trainer) for values in trained for value in values) / shards,
            "average": (trainer.average == "device") * sum(4 * value.numel() for value in trained[0]) / shards,
            **{name: sum(value.nbytes for value in one.state_dict().values()) for name, one in work.whole.items()},
            "frozen scores": scores / shards,
            # Two blocks are gathered at a time, and the gradients of one are summed, in bfloat16 and float32.
            "gathered": 0 if shards == 1 else block * (2 * 2 + 2 + 4),
            "gradients": max(sum(value.nbytes for value in values) for values in trained) / (shards if summed else 1),
            "activations": held.forward,
        }
        operations = micro_steps * held.operations if trainer.precision == "bf16" else None
        parts = {name: size for name, size in parts.items() if size}
        parameters = count or sum(value.numel() for value in work.models[0].parameters())
        return Estimate(self.title, parameters, parts, operations, trainer.steps, trainer.minutes)


class _Similarities(ClipSimilarities):
    """Similarity matrices of a relational teacher."""

    def __init__(self, config: RelationalConfig) -> None:
        self.config = config

    def similarities(
        self, clips: Sequence[Clip], views: Sequence[str], grid: tuple[int, int, int], frames: Tensor | None = None
    ) -> SimilarityMatrices:
        shape = bins, rows, columns = common_shape(self.config, grid)
        count, cells = len(clips), rows * columns
        cross = torch.empty(count, len(views) - 1, bins, cells, cells)
        return SimilarityMatrices(shape, torch.empty(count, len(views), bins - 1, cells, cells), cross)


def trainings(config: AnyStage, model: WorldModelConfig, source: Sources) -> list[Training]:
    """The trainings of one step, in their order."""
    frames = isinstance(config.input, FrameInput)

    def encoded(clips: ClipSampling, views: Sequence[str], trainer: TrainerConfig) -> tuple[int, Callable[[], Held]]:
        shown, count = source.shown(trainer, clips, views)
        return count * len(shown), partial(source.looking, "tokenizer", max(clips.lengths), trainer.precision)

    if isinstance(config, DistillConfig):
        model, first = model.model_copy(update={"towers": "generation"}), config.teacher_forcing.trainer
        found = [
            Training(
                f"distill: {part.replace('_', ' ')}", getattr(config, part).trainer, model,
                partial(_distillation, part, config, source), lora=config.lora,
                turns={0: 1 - 1 / CYCLE, CYCLE - 1: 1 / CYCLE} if part == "distribution_matching" else {0: 1.0},
                before=[encoded(config.first_clips, config.views, first)] if part == "teacher_forcing" and frames else [],
            )
            for part in ("teacher_forcing", "trajectory_regression", "distribution_matching")
        ]  # fmt: skip
        return [found[0], _trajectory_shard(config, model, source), *found[1:]]
    relational = config.relational if isinstance(config, Stage2Config) else None
    stage1 = config if isinstance(config, Stage1Config) else None
    text, tower = (0, "") if stage1 is None else (stage1.text.max_length, stage1.text_tower)
    whole_model, model = model, model.model_copy(update={"towers": "generation"}) if tower == "stored" else model

    def work(network: WorldModel) -> Work:
        batch, term = source.largest(model, config.trainer, config.clips, model.views, text), None
        whole: dict[str, nn.Module] = {"tokenizer": tokenizer_outline(source.tokenizer)} if frames else {}
        if relational is not None:
            whole["teacher"] = teacher_outline(source.teacher)[0]
            term = RelationalTerm(relational, _Similarities(relational), network.config.num_layers)
            term.layer = max(1, network.config.num_layers // 2)  # it makes no difference which: all are held
        objective = FlowMatchingObjective(network, sigma=config.sigma, weighting=config.weighting, relational=term)
        if tower == "stored":
            layers = network.config.num_layers
            reader = build_world_model(whole_model.model_copy(update={"num_layers": layers}))
            hold_weights(reader, "bf16", "bf16")
            objective.encode_text = torch.no_grad()(reader.encode_text)

        def run(step: int) -> Tensor:
            return objective.loss(batch, torch.Generator(), step)[0]

        return Work(run, (network,), whole=whole)

    title = "stage II" if stage1 is None else {"base": "base", "stage1": "stage I"}[stage1.kind]
    before = [encoded(config.clips, model.views, config.trainer)] if frames else []
    if relational is not None:
        longest, precision, count = max(config.clips.lengths), config.trainer.precision, len(model.views)
        teaching = partial(source.looking, "teacher", longest, precision, count)
        before.append((config.trainer.batch_size, teaching))
    trained = partial(_stage1_trains, tower) if text else lambda _: True
    return [Training(title, config.trainer, model, work, trained, config.lora, before=before)]


def _stage1_trains(tower: str, name: str) -> bool:
    return is_trained(name) and (tower == "trained" or not is_text_parameter(name))


def _distillation(part: str, config: DistillConfig, source: Sources, network: WorldModel) -> Work:
    """A step of one of the three trainings of Stage III."""
    first, model = config.teacher_forcing, network.config
    clips = config.first_clips if part == "teacher_forcing" else config.clips
    batch = source.largest(model, getattr(config, part).trainer, clips, config.views)
    whole: dict[str, nn.Module] = {}
    if isinstance(config.input, FrameInput):  # it stays, though the later steps use the latents of the trajectories
        whole["encoder"] = tokenizer_outline(source.tokenizer)
    models, scores, distance = [network], list[WorldModel](), None
    if part == "teacher_forcing":
        scores = [build_world_model(model).requires_grad_(False)] if first.teacher_share else []
        objective: Any = TeacherForcingObjective(network, config, *scores)
    else:
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
        if part == "trajectory_regression":
            objective = TrajectoryObjective(network, config, distance)
        else:
            fake = build_world_model(model) if config.lora is None else adapted(model, config.lora)
            real = build_world_model(model).requires_grad_(False)
            models, scores = [network, fake], [real]
            objective = DistributionMatchingObjective(network, real, fake, config, distance)

    def run(step: int) -> Tensor:
        return objective.loss(batch, torch.Generator(), step)[0]

    return Work(run, models, scores, whole)


def _trajectory_shard(config: DistillConfig, model: WorldModelConfig, source: Sources) -> Training:
    """A shard of the teacher's trajectories, whose clips are made together; the teacher is whole on every device."""
    regression, steps = config.trajectory_regression, config.trajectory_regression.trajectories
    clips, longest = min(steps.clips, steps.clips_per_shard), max(config.clips.lengths)
    frames = isinstance(config.input, FrameInput)

    def work(teacher: WorldModel) -> Work:
        batch = source.batch(model, clips, config.views, longest)

        def run(_: int) -> None:
            teacher_trajectories(
                teacher, batch.latents, maps_of(batch), torch.empty_like(batch.latents), views=batch.views,
                spec=config.spec, substeps=(1,) * config.spec.steps,
            )  # fmt: skip

        return Work(run, [teacher], whole={"encoder": tokenizer_outline(source.tokenizer)} if frames else {})

    trainer = TrainerConfig(
        steps=-(-steps.clips // clips),
        batch_size=clips,
        precision=regression.trainer.precision,
        sharding=ShardingConfig(shards=1),
    )
    encoded = (clips * len(config.views), partial(source.looking, "tokenizer", longest, trainer.precision))
    return Training(
        f"distill: trajectories (a shard of {clips} clips)", trainer, model, work, trained=lambda _: False,
        # A pass of each Euler step and one that writes the cache, of equal length; only the first kind is repeated.
        turns={0: (1 + sum(steps.substeps)) / (1 + config.spec.steps)}, before=[encoded] if frames else [],
    )  # fmt: skip


def require_memory(config: StrictModel, inputs: Mapping[str, Path]) -> None:
    """Refuse a training that this process's card cannot hold, before anything is loaded.

    Raises:
        ConfigError: its parts in GB, and the setting that would fit.
    """
    if not isinstance(config, AnyStage):
        return
    device = (config.teacher_forcing if isinstance(config, DistillConfig) else config).trainer.device
    memory, source = device_memory(device), _sources(config, inputs)
    start = inputs.get({Stage1Config: "base", Stage2Config: "stage1", DistillConfig: "stage2"}[type(config)])
    if memory is None or source is None or (start is None and not isinstance(config, Stage1Config)):
        return  # the training itself names the input that is missing
    model = config.model if isinstance(config, Stage1Config) else MixtureConfig()
    if start is not None:
        model = read_checkpoint_info(Path(start)).config
    if isinstance(config, Stage2Config):
        model = stage2_model_config(config, model)
    resident = resident_bytes(config, inputs, model)
    instead = "set input.resident to false, " if resident else ""
    for training in trainings(config, model, source):
        need = training.estimate(int(os.environ.get("WORLD_SIZE", "1")))
        need = replace(need, parts={**need.parts, **({"resident input": resident} if resident else {})})
        if not need.fits(memory):
            raise ConfigError(
                "This training does not fit the device's memory.",
                where=f"{need.title} on {device}",
                expected=f"at most {gigabytes(USABLE * memory)} GB",
                got=f"{gigabytes(need.total)} GB ({need.describe_parts()})",
                next_step=f"{instead}take more devices or what `worldline plan --fit` proposes, first "
                "trainer.sharding.checkpointing: block",
            )


def resident_bytes(config: AnyStage, inputs: Mapping[str, Path], model: WorldModelConfig) -> int:
    """Bytes of what every device keeps of all episodes: latents, samples of tracks, shares of things."""
    if isinstance(config.input, FrameInput) or not config.input.resident:
        return 0
    distilled = isinstance(config, DistillConfig)
    weighting = (config.teacher_forcing if distilled else config).weighting
    latents, views = LatentStore.open(Path(inputs["latents"])), config.views if distilled else model.views
    tracks = ActionTracks.open(Path(inputs["tracks"])).rows if "tracks" in inputs else []
    samples = track_bytes(len(views), max((len(row["arms"] or ()) for row in tracks), default=0), model.native_size)
    shares = 2 * math.prod(latents.latent_shape[1:]) if any(weighting.things) else 0
    return latents.stored_bytes + sum(row.num_frames * (samples + len(row.views) * shares) for row in latents.rows)


def device_memory(device: str) -> float | None:
    """Bytes of a card; None for a processor, whose memory the system shares out."""
    on_gpu = torch.device(device).type == "cuda"
    return float(torch.cuda.get_device_properties(device).total_memory) if on_gpu else None


def _sources(config: AnyStage, inputs: Mapping[str, Path]) -> Sources | None:
    tokenizer, teacher = (Path(inputs[name]) if name in inputs else None for name in ("tokenizer", "teacher"))
    if isinstance(config.input, FrameInput):
        return None if tokenizer is None else Sources.of(tokenizer, teacher, config.input.image_size)
    if "latents" not in inputs:
        return None
    latents = LatentStore.open(Path(inputs["latents"]))
    return Sources(tokenizer, teacher, latents.image_size, latents.latent_shape[1:])
