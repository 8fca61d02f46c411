"""Memory of trainings on so many devices, and the refusal of one that cannot fit.

Activations are counted by running a stage's own objective on tensors that have shapes and no values. torch's MemTracker gives the
same figures within 0.4 % for a single pass, but refuses modules that are called several times before a backward pass, as the
tokenizers and Stage III do.
"""

from __future__ import annotations

import multiprocessing
import os
import weakref
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch
from pydantic import ByteSize, Field
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from worldline_core.config import StrictModel
from worldline_core.distillation.auxiliary_losses import PerceptualLoss
from worldline_core.distillation.causal_objective import maps_of
from worldline_core.distillation.causal_teacher_forcing import TeacherForcingObjective
from worldline_core.distillation.distill_config import CYCLE, DistillConfig
from worldline_core.distillation.distribution_matching import DistributionMatchingObjective
from worldline_core.distillation.teacher_trajectories import TrajectoryBatch, teacher_trajectories
from worldline_core.distillation.trajectory_regression import TrajectoryObjective
from worldline_core.errors import ConfigError
from worldline_core.model.checkpoint import DESCRIPTION, SINGLE_PRECISION, read_checkpoint_info
from worldline_core.model.lpips import LPIPS
from worldline_core.model.networks import build_world_model
from worldline_core.model.tokenizers import tokenizer_outline
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import MixtureConfig, WorldModelConfig, cosmos3_config
from worldline_core.pipeline.pipeline_config import PipelineConfig
from worldline_core.progress import Progress
from worldline_core.shipped import project_path
from worldline_core.training.clip_config import JOINT, SUBSET, ClipSampling, FrameInput
from worldline_core.training.clip_loader import Batch
from worldline_core.training.clip_sampler import Clip, latent_frame_count
from worldline_core.training.clip_source import LatentStore
from worldline_core.training.flow_matching import FlowMatchingObjective
from worldline_core.training.relational import ClipSimilarities, RelationalTerm, SimilarityMatrices, common_shape
from worldline_core.training.stage1 import is_trained
from worldline_core.training.stage2 import stage2_model_config
from worldline_core.training.trainer import autocast
from worldline_core.training.training_config import RelationalConfig, Stage1Config, Stage2Config, TrainerConfig
from worldline_core.training.video_teacher import teacher_outline

WHOLE = 8
"""Most layers of a model that is traced as it is."""
USABLE = 0.92
"""Share of a device's memory that a stage may fill; the rest is for the driver, communication and fragmentation."""

AnyStage = Stage1Config | Stage2Config | DistillConfig


class Held(NamedTuple):
    """Most bytes held at once until the loss is there, and from then on, without gradients of parameters."""

    forward: float
    backward: float


class _Tracker(TorchDispatchMode):
    """Follows the storages that a computation allocates and frees.

    Decisions that depend on values (a loss is finite, a text is padded) see 0.5, 1 or True.
    """

    def __init__(self) -> None:
        super().__init__()
        self.live = self.most = 0
        self._followed: set[int] = set()

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        if func is torch.ops.prim.device.default:
            return args[0].device
        if func is torch.ops.aten._local_scalar_dense.default:
            return True if args[0].dtype == torch.bool else 0.5 if args[0].is_floating_point() else 1
        result = func(*args, **(kwargs or {}))
        unknown = [storage for storage in _storages(result) if storage._cdata not in self._followed]
        given = {storage._cdata for storage in _storages((args, kwargs))} if unknown else set[int]()
        for storage in unknown:
            if storage._cdata not in given and storage._cdata not in self._followed:  # else it is no new memory
                self._followed.add(storage._cdata)
                self.live += storage.nbytes()
                self.most = max(self.most, self.live)
                weakref.finalize(storage, self._freed, storage._cdata, storage.nbytes())
        return result

    def _freed(self, key: int, size: int) -> None:
        self._followed.remove(key)
        self.live -= size


def _storages(values: Any) -> list[torch.UntypedStorage]:
    return [value.untyped_storage() for value in tree_leaves(values) if isinstance(value, Tensor)]


def traced(work: Callable[[], Any], parameters: Iterable[nn.Parameter] = ()) -> Held:
    """Bytes that ``work`` holds and, with `parameters` that are trained, the backward pass of the loss that it returns.

    Call it within a FakeTensorMode; what exists before (the weights) is not counted.
    """
    trained = [parameter for parameter in parameters if parameter.requires_grad]
    for parameter in trained:
        parameter.register_post_accumulate_grad_hook(lambda one: setattr(one, "grad", None))
    with _Tracker() as tracker:
        loss = work()
        forward, tracker.most = tracker.most, tracker.live
        if trained:
            loss.backward()
    return Held(forward, tracker.most)


def extrapolated(trace: Callable[[int], Held], layers: int) -> Held:
    """``trace(layers)``; of deep models by a straight line through two shallow ones, for layers are equal."""
    if layers <= WHOLE:
        return trace(layers)
    return Held(*(a + (b - a) * (layers - 3) for a, b in zip(trace(3), trace(4), strict=True)))


def to_bfloat16(model: nn.Module) -> None:
    """Give a model weights in bfloat16, except those that stay in float32, as sharded trainings and rollouts have them."""
    for name, module in model.named_modules():
        for key, value in list(module.named_parameters(recurse=False)):
            if not f"{name}.".startswith(SINGLE_PRECISION):
                module.register_parameter(key, nn.Parameter(value.detach().bfloat16(), value.requires_grad))


def parameter_counts(model: WorldModelConfig, trained: Callable[[str], bool] = lambda _: True) -> tuple[int, int]:
    """Parameters that are trained, and all those of one transformer block."""
    with torch.device("meta"):
        network = build_world_model(model)
    counted = sum(value.numel() for name, value in network.named_parameters() if trained(name))
    return counted, sum(value.numel() for value in network.layers[0].parameters())


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
        with FakeTensorMode():
            space = tokenizer_outline(tokenizer).spatial_compression
        return cls(tokenizer, teacher, image_size, (image_size[0] // space, image_size[1] // space))

    def batch(self, model: WorldModelConfig, clips: int, views: Sequence[str], frames: int, text: int = 0) -> Batch:
        """An uninitialised batch of clips of so many recorded frames, with maps, or with ``text`` tokens for each clip."""
        size, count = (clips, len(views)), latent_frame_count(frames)
        drawn = self.grid if model.takes_maps else (1, 1)
        return Batch(
            (Clip("", 0, frames, 1),) * clips,
            tuple(views),
            torch.empty(*size, model.latent_channels, count, *self.grid),
            None if text else torch.empty(*size, model.control_channels, count, *drawn),
            torch.zeros(clips, text, dtype=torch.long) if text else None,
            torch.ones(clips, text, dtype=torch.bool) if text else None,
        )

    def largest(
        self, model: WorldModelConfig, trainer: TrainerConfig, clips: ClipSampling, views: Sequence[str], text: int = 0
    ) -> Batch:
        """The largest micro-batch: the longest clips, in all views where steps are joint, else in one."""
        joint = clips.view_weights is None or {JOINT, SUBSET} & clips.view_weights.keys()
        count, views = (1, views) if joint else (clips.single_view_factor, views[:1])
        return self.batch(model, count * trainer.batch_size, views, max(clips.lengths), text)

    def video(self, frames: int, views: int = 1) -> Tensor:
        """Pictures of a clip; clips are encoded one by one, and so are their views."""
        return torch.empty(views, 3, frames, *self.image_size)

    @cache  # noqa: B019 - a few sources a process
    def encoding(self, frames: int, precision: Literal["bf16", "fp32"]) -> float:
        """Most bytes held while the tokenizer encodes a clip."""
        trainer = TrainerConfig(steps=1, precision=precision)
        with FakeTensorMode(), torch.no_grad(), autocast(trainer):
            tokenizer = tokenizer_outline(self.tokenizer)
            return traced(lambda: tokenizer.encode(self.video(frames))).forward

    @cache  # noqa: B019 - a few sources a process
    def teaching(self, frames: int, views: int, precision: Literal["bf16", "fp32"]) -> float:
        """Most bytes held while the relational teacher looks at a clip."""
        trainer = TrainerConfig(steps=1, precision=precision)
        with FakeTensorMode(), torch.no_grad(), autocast(trainer):
            features = teacher_outline(self.teacher)[1]
            return traced(lambda: features(self.video(frames, views))).forward


@dataclass(frozen=True)
class Estimate:
    """Memory of one stage on one device.

    Attributes:
        parameters: trained ones, or those of a model that only predicts.
        parts: bytes at the worst moment, by name.
    """

    title: str
    parameters: int
    parts: Mapping[str, float]

    @property
    def total(self) -> float:
        return sum(self.parts.values())

    def fits(self, memory: float) -> bool:
        """Returns whether a device of so many bytes holds it."""
        return self.total <= USABLE * memory

    def describe_parts(self) -> str:
        return ", ".join(f"{name} {gigabytes(size)}" for name, size in self.parts.items())


Row = tuple[Estimate, str]
"""A line of the sheet: what a training takes, and the setting with which it would fit; empty where it does."""


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


def whole_bytes(models: Mapping[str, nn.Module]) -> dict[str, float]:
    """Bytes of weights and buffers."""
    return {name: sum(value.nbytes for value in one.state_dict().values()) for name, one in models.items()}


@dataclass(frozen=True, eq=False)
class Training:
    """One training, by its configuration alone.

    Attributes:
        work: a step with a model of some depth, made without values.
        trained: whether a parameter gets gradients, by its name.
        turns: numbers of steps, one of each kind that the training takes (distribution matching alternates).
        before: most bytes held before each step's forward pass, where clips are encoded or a teacher looks at them.
    """

    title: str
    trainer: TrainerConfig
    model: WorldModelConfig
    work: Callable[[WorldModel], Work]
    trained: Callable[[str], bool] = lambda _: True
    turns: Sequence[int] = (0,)
    before: Sequence[Callable[[], float]] = ()

    def outline(self, layers: int) -> Work:
        """The step of a model of so many layers; call it within a FakeTensorMode."""
        network = build_world_model(self.model.model_copy(update={"num_layers": layers}))
        for name, parameter in network.named_parameters():
            parameter.requires_grad_(self.trained(name))
        return self.work(network)

    @cache  # noqa: B019 - a few trainings a process
    def activations(self, *, sharded: bool) -> float:
        """Most bytes of activations of a micro-step."""
        trainer = self.trainer.model_copy(update={"device": "cpu"})  # tensors without values follow a CPU's paths

        def trace(step: int, layers: int) -> Held:
            with FakeTensorMode():
                work = self.outline(layers)
                for one in (*work.models, *work.scores):
                    one.checkpointing = trainer.sharding.checkpointing
                    if sharded and trainer.precision == "bf16":
                        to_bfloat16(one)

                def loss() -> Tensor:
                    with autocast(trainer):
                        return work.run(step)

                return traced(loss, [value for one in work.models for value in one.parameters()])

        steps = (max(extrapolated(partial(trace, step), self.model.num_layers)) for step in self.turns)
        return max([*steps, *(held() for held in self.before)])

    @cache  # noqa: B019 - a few trainings a process
    def estimate(self, devices: int) -> Estimate:
        """Memory on each of so many devices that share the training."""
        trainer, shards = self.trainer, min(self.trainer.sharding.shards or devices, devices)
        micro_steps = trainer.accumulation
        if trainer.global_batch is not None:
            micro_steps = -(-trainer.global_batch // (trainer.batch_size * devices))
        with FakeTensorMode():
            work = self.outline(1)
        trained, block = parameter_counts(self.model, self.trained)
        own, part = 4 * len(work.models) * trained / shards, 4 * trained / shards
        summed = micro_steps == 1 or trainer.sharding.reduce_every_micro_step
        parts = {
            "weights": own,
            "moments": 2 * own,
            "average": part,
            **whole_bytes(work.whole),
            "frozen scores": len(work.scores) * part,
            # Two blocks are gathered at a time, and the gradients of one are summed, in bfloat16 and float32.
            "gathered": 0 if shards == 1 else block * (2 * 2 + 2 + 4),
            "gradients": part if summed else 4 * trained,
            "activations": self.activations(sharded=shards > 1),
        }
        return Estimate(self.title, len(work.models) * trained, {name: size for name, size in parts.items() if size})

    def fitting_setting(self, devices: int, memory: float) -> str:
        """The nearest setting with which this training would fit devices of ``memory`` bytes; empty where it does."""
        if self.estimate(devices).fits(memory):
            return ""
        changes = {"checkpointing": "block", "reduce_every_micro_step": True, "shards": None}
        sharding = self.trainer.sharding.model_copy(update=changes)
        block = replace(self, trainer=self.trainer.model_copy(update={"sharding": sharding}))
        for count in (devices * 2**power for power in range(11)):
            if (need := block.estimate(count)).fits(memory):
                several = "" if count == 1 else f", reduce_every_micro_step: true, on {count} devices"
                return f"trainer.sharding.checkpointing: block{several} ({gigabytes(need.total)} GB a device)"
        return "shorter clips, devices of more memory, or a smaller model"


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
    if isinstance(config, DistillConfig):
        model, first = model.model_copy(update={"towers": "generation"}), config.teacher_forcing.trainer
        return [
            Training(
                f"distill: {part.replace('_', ' ')}", getattr(config, part).trainer, model,
                partial(_distillation, part, config, source),
                turns=(0, CYCLE - 1) if part == "distribution_matching" else (0,),
                before=[partial(source.encoding, max(config.first_clips.lengths), first.precision)]
                if part == "teacher_forcing" and frames
                else [],
            )
            for part in ("teacher_forcing", "trajectory_regression", "distribution_matching")
        ]  # fmt: skip
    relational = config.relational if isinstance(config, Stage2Config) else None
    text = config.text.max_length if isinstance(config, Stage1Config) else 0

    def work(network: WorldModel) -> Work:
        batch, term = source.largest(model, config.trainer, config.clips, model.views, text), None
        tokenizer, whole = tokenizer_outline(source.tokenizer), dict[str, nn.Module]()
        if frames:
            whole["tokenizer"] = tokenizer
        if relational is not None:
            whole["teacher"] = teacher_outline(source.teacher)[0]
            term = RelationalTerm(relational, _Similarities(relational), network.config.num_layers)
            term.layer = max(1, network.config.num_layers // 2)  # it makes no difference which: all are held
        objective = FlowMatchingObjective(network, sigma=config.sigma, weighting=config.weighting, relational=term)

        def run(step: int) -> Tensor:
            return objective.loss(batch, torch.Generator(), step)[0]

        return Work(run, (network,), whole=whole)

    title = {"base": "base", "stage1": "stage I"}[config.kind] if isinstance(config, Stage1Config) else "stage II"
    longest, precision, before = max(config.clips.lengths), config.trainer.precision, list[Callable[[], float]]()
    if frames:
        before.append(partial(source.encoding, longest, precision))
    if relational is not None:
        before.append(partial(source.teaching, longest, len(model.views), precision))
    return [Training(title, config.trainer, model, work, is_trained if text else lambda _: True, before=before)]


def _distillation(part: str, config: DistillConfig, source: Sources, network: WorldModel) -> Work:
    """A step of one of the three trainings of Stage III."""
    first, model = config.teacher_forcing, network.config
    clips = config.first_clips if part == "teacher_forcing" else config.clips
    batch = source.largest(model, getattr(config, part).trainer, clips, config.views)
    tokenizer, whole = tokenizer_outline(source.tokenizer), dict[str, nn.Module]()
    if isinstance(config.input, FrameInput):
        whole["encoder"] = tokenizer  # it stays there, though the later steps use the latents of the trajectories
    models, scores, distance = [network], list[WorldModel](), None
    if part == "teacher_forcing":
        scores = [build_world_model(model)] if first.teacher_share else []
        objective: Any = TeacherForcingObjective(network, config, *scores)
    else:
        shown, views, channels, frames, *grid = batch.latents.shape
        nodes = torch.empty(shown, config.spec.steps + 1, views, channels, frames - 1, *grid)
        mask = torch.ones(shown, views, frames, *grid)
        batch = TrajectoryBatch(**vars(batch), nodes=nodes, history=batch.latents, mask=mask)
        if config.lpips_weights is not None:
            decoder, lpips = tokenizer_outline(source.tokenizer), LPIPS().requires_grad_(False)
            if config.perceptual.bfloat16:
                to_bfloat16(decoder)
            whole |= {"tokenizer": decoder, "lpips": lpips}
            compared = 1 + config.perceptual.latent_frames
            perceptual = PerceptualLoss(decoder, lpips, config.perceptual.latent_frames)
            # One view after the other, and what comes before the compared frames without gradients: neither adds up.
            distance = lambda a, b: perceptual(a[:1, :1, :, -compared:], b[:1, :1, :, -compared:])  # noqa: E731
        if part == "trajectory_regression":
            objective = TrajectoryObjective(network, config, distance)
        else:
            fake, real = build_world_model(model), build_world_model(model)
            models, scores = [network, fake], [real]
            objective = DistributionMatchingObjective(network, real, fake, config, distance)

    def run(step: int) -> Tensor:
        return objective.loss(batch, torch.Generator(), step)[0]

    return Work(run, models, scores, whole)


def trajectory_shard(config: DistillConfig, model: WorldModelConfig, source: Sources) -> Estimate:
    """A shard of the teacher's trajectories, whose clips are made together; the teacher is whole on every device."""
    model, regression = model.model_copy(update={"towers": "generation"}), config.trajectory_regression
    clips = min(regression.trajectories.clips, regression.trajectories.clips_per_shard)
    trainer = regression.trainer.model_copy(update={"device": "cpu"})
    with FakeTensorMode() as fake:
        batch = source.batch(model, clips, config.views, max(config.clips.lengths))
        encoder = {"encoder": tokenizer_outline(source.tokenizer)} if isinstance(config.input, FrameInput) else {}

    def trace(layers: int) -> Held:
        with fake, torch.no_grad(), autocast(trainer):
            teacher = build_world_model(model.model_copy(update={"num_layers": layers})).requires_grad_(False)

            def run() -> None:
                teacher_trajectories(
                    teacher, batch.latents, maps_of(batch), torch.empty_like(batch.latents), views=batch.views,
                    spec=config.spec, substeps=(1,) * config.spec.steps,
                )  # fmt: skip

            return traced(run)

    held, count = extrapolated(trace, model.num_layers).forward, parameter_counts(model)[0]
    if encoder:
        held = max(held, source.encoding(batch.clips[0].num_frames, trainer.precision))
    parts = {"weights": 4 * count, **whole_bytes(encoder), "activations": held}
    return Estimate(f"distill: trajectories (a shard of {clips} clips)", count, parts)


def stage_rows(
    config: AnyStage, model: WorldModelConfig, source: Sources, devices: int, memory: float
) -> list[Callable[[], Row]]:
    """Functions that estimate the trainings of one step, and the setting with which each would fit; empty where it does."""
    rows: list[Callable[[], Row]] = []
    for one in trainings(config, model, source):
        if isinstance(config, DistillConfig) and one.title.endswith("regression"):
            rows.append(partial(_shard_row, config, model, source, memory))
        rows.append(partial(_training_row, one, devices, memory))
    return rows


def _training_row(training: Training, devices: int, memory: float) -> Row:
    return training.estimate(devices), training.fitting_setting(devices, memory)


def _shard_row(config: DistillConfig, model: WorldModelConfig, source: Sources, memory: float) -> Row:
    shard = trajectory_shard(config, model, source)
    return shard, "" if shard.fits(memory) else "fewer clips_per_shard"


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
    for row in stage_rows(config, model, source, int(os.environ.get("WORLD_SIZE", "1")), memory):
        need, setting = row()
        if setting:
            raise ConfigError(
                "This training does not fit the device's memory.",
                where=f"{need.title} on {device}",
                expected=f"at most {gigabytes(USABLE * memory)} GB",
                got=f"{gigabytes(need.total)} GB ({need.describe_parts()})",
                next_step=f"set {setting}; `worldline plan` shows every stage",
            )


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


class SizeSheet(StrictModel):
    """The trainings of one preset on so many devices of one kind; ``project``: folder that the preset's paths begin in."""

    config: PipelineConfig
    project: Path
    devices: int = Field(default=8, ge=1)
    memory: ByteSize

    @property
    def model(self) -> WorldModelConfig:
        """Shape of Stage I's model: that of the base checkpoint, of the backbone to import as models.base, or the configured
        one."""
        base = self.folder("base")
        if base is not None and (base / DESCRIPTION).is_file():
            return read_checkpoint_info(base).config
        if self.config.import_backbone is not None and self.config.models.base is not None:
            return cosmos3_config(
                self.config.import_backbone.size,
                fps=self.config.import_backbone.fps,
                **self.config.import_backbone.changes,
            )
        if self.config.train_stage1 is None:
            raise ConfigError(
                "The size of the model is not known.",
                where="models.base",
                expected="a base checkpoint, import_backbone, or train_stage1.model",
            )
        return self.config.train_stage1.model

    def folder(self, name: str) -> Path | None:
        """Folder of outside weights, if it is here."""
        path = getattr(self.config.models, name)
        folder = None if path is None else project_path(self.project, path)
        return folder if folder is not None and folder.is_dir() else None

    def source(self, stage: AnyStage) -> Sources:
        """The pictures and latents that a stage reads: its own frames, or those of the cache."""
        reading = stage.input if isinstance(stage.input, FrameInput) else self.config.encode_latents
        return Sources.of(self.folder("tokenizer"), self.folder("teacher"), reading.image_size)

    def _rows(self) -> list[Callable[[], Row]]:
        generation = self.model.model_copy(update={"towers": "generation"})
        stages = (
            (self.config.train_stage1, self.model),
            (self.config.train_stage2, generation),
            (self.config.distill, generation),
        )
        given = ((stage, model) for stage, model in stages if stage is not None)
        return [row for s, m in given for row in stage_rows(s, m, self.source(s), self.devices, self.memory)]

    def row(self, number: int) -> Row:
        """One line of the sheet."""
        return self._rows()[number]()

    def rows(self) -> list[Row]:
        """Memory of every training in the order of a run, and the setting with which it would fit; a core each."""
        numbers = range(len(self._rows()))
        with (
            Progress("worldline plan", len(numbers), "training") as progress,
            ProcessPoolExecutor(len(os.sched_getaffinity(0)), multiprocessing.get_context("fork")) as pool,
        ):
            # The last ones take longest.
            waiting = {number: pool.submit(self.row, number) for number in reversed(numbers)}
            for _ in as_completed(waiting.values()):
                progress.advance()
        return [waiting[number].result() for number in numbers]

    def as_text(self, rows: Iterable[Row]) -> str:
        """The sheet as a Markdown table; the last column names the setting with which a stage would fit."""
        lines = [
            f"{self.devices} devices of {gigabytes(self.memory)} GB ({USABLE:.0%} of it usable)\n",
            "| stage | parameters | GB a device | of that | fits |",
            "|---|---|---|---|---|",
        ]
        for row, setting in rows:
            count = f"{row.parameters / 1e9:.2f} G" if row.parameters >= 1e9 else f"{row.parameters / 1e6:.1f} M"
            fits = f"no: set {setting}" if setting else "yes"
            lines.append(f"| {row.title} | {count} | {gigabytes(row.total)} | {row.describe_parts()} | {fits} |")
        return "\n".join(lines)
