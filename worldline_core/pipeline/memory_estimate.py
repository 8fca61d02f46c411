"""Memory and operations of a training, counted by running its own objective on tensors that have shapes and no values.

torch's own MemTracker gives the same figures within 0.4 % for a single pass, but refuses modules that are called several times
before a backward pass, as the tokenizers and Stage III do; operations are counted by the formulas of its FlopCounterMode.
"""

from __future__ import annotations

import os
import weakref
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, reduce
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import flop_registry, sdpa_backward_flop_count, sdpa_flop_count

from worldline_core.config import StrictModel
from worldline_core.distillation.auxiliary_losses import PerceptualLoss
from worldline_core.distillation.causal_objective import maps_of
from worldline_core.distillation.causal_teacher_forcing import TeacherForcingObjective
from worldline_core.distillation.distill_config import CYCLE, DistillConfig
from worldline_core.distillation.distribution_matching import DistributionMatchingObjective
from worldline_core.distillation.teacher_trajectories import TrajectoryBatch, teacher_trajectories
from worldline_core.distillation.trajectory_regression import TrajectoryObjective
from worldline_core.errors import ConfigError
from worldline_core.model.checkpoint import SINGLE_PRECISION, read_checkpoint_info
from worldline_core.model.lpips import LPIPS
from worldline_core.model.tokenizers import tokenizer_outline
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import WorldModelConfig
from worldline_core.training.clip_config import JOINT, ClipSampling, FrameInput
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

_SMALL = 8
"""Largest size (layers, latent frames) that is traced whole."""
USABLE = 0.92
"""Share of a device's memory that a stage may fill; the rest is for the driver, communication and fragmentation."""

_aten = torch.ops.aten
_ATTENTION = {
    _aten._scaled_dot_product_flash_attention_for_cpu: lambda args: sdpa_flop_count(*(t.shape for t in args[:3])),
    _aten._scaled_dot_product_flash_attention_for_cpu_backward: lambda args: sdpa_backward_flop_count(
        *(t.shape for t in args[:4])
    ),
}


class Cost(NamedTuple):
    """Bytes held at once and operations of one computation.

    Attributes:
        forward, backward: most bytes until the loss is there, and from then on, without gradients of parameters.
        held: bytes when the loss is there.
        peak: most bytes at once, gradients of parameters included; not linear in the size of a model.
        flops: floating-point operations, two for a multiplication and addition, except attention's.
        attention_flops: those of attention, which grow with the square of the tokens.
    """

    forward: float = 0.0
    backward: float = 0.0
    held: float = 0.0
    peak: float = 0.0
    flops: float = 0.0
    attention_flops: float = 0.0

    @property
    def activations(self) -> float:
        return max(self.forward, self.backward)

    @property
    def all_flops(self) -> float:
        return self.flops + self.attention_flops

    def then(self, other: Cost) -> Cost:
        """Both, one after the other."""
        flops, attention = self.flops + other.flops, self.attention_flops + other.attention_flops
        return Cost(*map(max, self, other))._replace(flops=flops, attention_flops=attention)

    def repeated(self, count: float) -> Cost:
        """The same computation several times, one after the other."""
        return self._replace(flops=count * self.flops, attention_flops=count * self.attention_flops)


class _Tracker(TorchDispatchMode):
    """Follows the storages that a computation allocates and frees, and counts its operations.

    Decisions that depend on values (a loss is finite, a text is padded) see 0.5, 1 or True.
    """

    def __init__(self) -> None:
        super().__init__()
        self.live = self.gradients = self.most = self.peak = 0
        self.flops = self.attention_flops = 0.0
        self._storages: dict[int, weakref.ref[Any]] = {}

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        kwargs = kwargs or {}
        if func is torch.ops.prim.device.default:
            return args[0].device
        if func is _aten._local_scalar_dense.default:
            return True if args[0].dtype == torch.bool else 0.5 if args[0].is_floating_point() else 1
        result = func(*args, **kwargs)
        packet = func._overloadpacket
        if packet in _ATTENTION:
            self.attention_flops += _ATTENTION[packet](args)
        elif packet in flop_registry:
            self.flops += flop_registry[packet](*args, **kwargs, out_val=result)
        given = {storage._cdata for storage in _storages((args, kwargs))}
        for storage in _storages(result):
            if storage._cdata not in given and storage._cdata not in self._storages:  # else it is no new memory
                self._follow(storage)
        return result

    def _follow(self, storage: torch.UntypedStorage) -> None:
        key, size = storage._cdata, storage.nbytes()

        def freed(_: object) -> None:
            if self._storages.pop(key, None) is not None:
                self.live -= size

        self._storages[key] = weakref.ref(storage, freed)
        self.live += size
        self.most = max(self.most, self.live)
        self.peak = max(self.peak, self.live + self.gradients)

    def count_gradient(self, parameter: Tensor) -> None:
        """Move a parameter's new gradient from the activations to the gradients."""
        if parameter.grad is not None and self._storages.pop(parameter.grad.untyped_storage()._cdata, None) is not None:
            self.live -= parameter.grad.untyped_storage().nbytes()
            self.gradients += parameter.grad.untyped_storage().nbytes()


def _storages(values: Any) -> list[torch.UntypedStorage]:
    return [value.untyped_storage() for value in tree_leaves(values) if isinstance(value, Tensor)]


def traced(work: Callable[[], Any], parameters: Iterable[nn.Parameter] = ()) -> Cost:
    """Cost of ``work`` and, with `parameters`, of the backward pass of the loss that it returns.

    Call it within a FakeTensorMode; what exists before (the weights) is not counted.
    """
    tracker = _Tracker()
    hooks = [one.register_post_accumulate_grad_hook(tracker.count_gradient) for one in parameters if one.requires_grad]
    with tracker:
        loss = work()
        held, forward, tracker.most = tracker.live, tracker.most, tracker.live
        if hooks:
            loss.backward()
    for hook in hooks:
        hook.remove()
    return Cost(forward, tracker.most, held, tracker.peak, tracker.flops, tracker.attention_flops)


def extrapolated(trace: Callable[[int], Cost], size: int, traced_at: tuple[int, int]) -> Cost:
    """``trace(size)`` by a straight line through two smaller sizes (layers of a model, frames of a clip)."""
    if size <= _SMALL:
        return trace(size)
    small, large = traced_at
    share = (size - small) / (large - small)
    return Cost(*(a + (b - a) * share for a, b in zip(trace(small), trace(large), strict=True)))


def to_bfloat16(model: nn.Module) -> None:
    """Give a model weights in bfloat16, except those that stay in float32, as sharded trainings and rollouts have them."""
    for name, module in model.named_modules():
        for key, value in list(module.named_parameters(recurse=False)):
            if not f"{name}.".startswith(SINGLE_PRECISION):
                module.register_parameter(key, nn.Parameter(value.detach().bfloat16(), value.requires_grad))


def weight_bytes(model: nn.Module) -> int:
    """Bytes of a model's weights and buffers."""
    return sum(value.nbytes for value in model.state_dict().values())


def parameter_counts(model: WorldModelConfig, trained: Callable[[str], bool] = lambda _: True) -> tuple[int, int]:
    """Parameters that are trained, and all those of one transformer block."""
    with torch.device("meta"):
        network = WorldModel(model)
    counted = sum(value.numel() for name, value in network.named_parameters() if trained(name))
    return counted, sum(value.numel() for value in network.layers[0].parameters())


def gigabytes(size: float) -> str:
    """Bytes as GB (10^9), short enough for a table."""
    value = size / 1e9
    return f"{value:.0f}" if value >= 100 else f"{value:.1f}" if value >= 0.1 else f"{value:.3f}"


@dataclass(frozen=True)
class ClipShape:
    """Number of clips, their views, recorded frames, and rows and columns of a latent of one device's micro-batch."""

    clips: int
    views: tuple[str, ...]
    frames: int
    grid: tuple[int, int]

    def batch(self, model: WorldModelConfig, *, maps: bool = True, text: int = 0) -> Batch:
        """An uninitialised batch of this shape, with ``text`` tokens for each clip (0: without text)."""
        size, count = (self.clips, len(self.views)), latent_frame_count(self.frames)
        drawn = self.grid if model.native_size is None else (1, 1)
        return Batch(
            (Clip("", 0, self.frames, 1),) * self.clips,
            self.views,
            torch.empty(*size, model.latent_channels, count, *self.grid),
            torch.empty(*size, model.map_channels, count, *drawn) if maps else None,
            torch.zeros(self.clips, text, dtype=torch.long) if text else None,
            torch.ones(self.clips, text, dtype=torch.bool) if text else None,
        )


@dataclass(frozen=True)
class Estimate:
    """Memory and time of one stage on one device.

    Attributes:
        parameters: trained ones, or those of a model that only predicts.
        parts: bytes at the worst moment, by name; their sum is ``total``.
        flops: of one optimiser step, prediction or clip; steps: how many of these, where known.
    """

    title: str
    parameters: int
    parts: Mapping[str, float]
    flops: float = 0.0
    steps: int | None = None

    @property
    def total(self) -> float:
        return sum(self.parts.values())

    def fits(self, memory: float) -> bool:
        """Returns whether a device of so many bytes holds it."""
        return self.total <= USABLE * memory

    def describe_parts(self) -> str:
        return ", ".join(f"{name} {gigabytes(size)}" for name, size in self.parts.items())


Frozen = dict[str, tuple[int, Cost]]
"""Bytes of models that are not trained, whole on every device, and the cost of what they compute for a micro-batch."""


@dataclass(frozen=True, eq=False)
class Training:
    """One training, by its configuration alone.

    Attributes:
        shape: the largest micro-batch (`largest_batch`).
        objective, batch: what is minimised, and a micro-batch for it; both are made without values.
        trained: whether a parameter gets gradients, by its name.
        turns: steps of each kind that the training takes, and their share (distribution matching alternates).
        models, scores: world models that are trained, the first alone averaged, and those that are not.
        before: what encodes clips and asks the teacher, over when the model's own step begins.
        compared: what compares pictures at the end of the forward pass, in the last turn.
    """

    title: str
    trainer: TrainerConfig
    clips: ClipSampling
    model: WorldModelConfig
    shape: ClipShape
    objective: Callable[[WorldModel], Any]
    batch: Callable[[], Batch]
    trained: Callable[[str], bool] = lambda _: True
    turns: Sequence[tuple[int, float]] = ((0, 1.0),)
    models: int = 1
    scores: int = 0
    before: Callable[[], Frozen] = dict
    compared: Callable[[], Frozen] = dict

    def turn(self, step: int, *, sharded: bool) -> Cost:
        """Cost of the loss and the backward pass of a micro-step."""
        trainer = self.trainer.model_copy(update={"device": "cpu"})  # tensors without values follow a CPU's paths

        def trace(layers: int) -> Cost:
            with FakeTensorMode():
                network = WorldModel(self.model.model_copy(update={"num_layers": layers}))
                for name, parameter in network.named_parameters():
                    parameter.requires_grad_(self.trained(name))
                objective: Any = self.objective(network)
                models = [value for value in vars(objective).values() if isinstance(value, nn.Module)]
                for one in models:
                    if isinstance(one, WorldModel):
                        one.checkpointing = trainer.sharding.checkpointing
                    if sharded and trainer.precision == "bf16":
                        to_bfloat16(one)
                batch = self.batch()

                def loss() -> Tensor:
                    with autocast(trainer):
                        return objective.loss(batch, torch.Generator(), step)[0]

                return traced(loss, [parameter for one in models for parameter in one.parameters()])

        return extrapolated(trace, self.model.num_layers, (3, 4))

    @cache  # noqa: B019 - a few trainings a process
    def micro_step(self, *, sharded: bool) -> Cost:
        """Memory of the largest micro-step, and the operations of a mean one."""
        turns = [self.turn(step, sharded=sharded) for step, _ in self.turns]
        for _, cost in self.compared().values():
            # It comes last in the forward pass, and is over when the backward pass begins.
            last, held = turns[-1], turns[-1].held + cost.activations
            forward, peak = max(last.forward, held), max(last.peak, held)
            turns[-1] = last._replace(forward=forward, peak=peak, flops=last.flops + cost.flops)
        shares = [turn.repeated(share) for turn, (_, share) in zip(turns, self.turns, strict=True)]
        cost = reduce(Cost.then, [*(cost for _, cost in self.before().values()), *shares])
        lengths = [latent_frame_count(n) / latent_frame_count(self.shape.frames) for n in self.clips.lengths]
        linear, square = (sum(n**power for n in lengths) / len(lengths) for power in (1, 2))
        return cost._replace(flops=linear * cost.flops, attention_flops=square * cost.attention_flops)

    def estimate(self, devices: int) -> Estimate:
        """Memory and operations on each of so many devices that share the training."""
        trainer, shards = self.trainer, min(self.trainer.sharding.shards or devices, devices)
        micro_steps = trainer.accumulation
        if trainer.global_batch is not None:
            micro_steps = -(-trainer.global_batch // (trainer.batch_size * devices))
        step = self.micro_step(sharded=shards > 1)
        trained, block = parameter_counts(self.model, self.trained)
        own, part = 4 * self.models * trained / shards, 4 * trained / shards
        summed = micro_steps == 1 or trainer.sharding.reduce_every_micro_step
        gradients = part if summed else 4 * trained
        alone = shards == micro_steps == 1 and self.model.num_layers <= _SMALL
        parts = {
            "weights": own,
            "moments": 2 * own,
            "average": part,
            **{name: size for name, (size, _) in (self.before() | self.compared()).items()},
            "frozen scores": self.scores * part,
            # Two blocks are gathered at a time, and the gradients of one are summed, in bfloat16 and float32.
            "gathered": 0 if shards == 1 else block * (2 * 2 + 2 + 4),
            "gradients": gradients,
            # With one micro-step on one device, gradients come as activations go.
            "activations": step.peak - gradients if alone else step.activations,
        }
        parts = {name: size for name, size in parts.items() if size}
        return Estimate(self.title, self.models * trained, parts, micro_steps * step.all_flops, trainer.steps)

    def fitting_setting(self, devices: int, memory: float) -> str:
        """The nearest setting with which this training would fit devices of ``memory`` bytes, in words."""
        changes = {"checkpointing": "block", "reduce_every_micro_step": True, "shards": None}
        sharding = self.trainer.sharding.model_copy(update=changes)
        block = replace(self, trainer=self.trainer.model_copy(update={"sharding": sharding}))
        for count in (devices * 2**power for power in range(11)):
            need = block.estimate(count)
            if need.fits(memory):
                wider = "" if count == devices else f" over {count} devices"
                summed = "" if count == 1 else ", reduce_every_micro_step: true"
                return f"trainer.sharding.checkpointing: block{summed}{wider} ({gigabytes(need.total)} GB a device)"
        return "shorter clips, devices of more memory, or a smaller model"


@dataclass(frozen=True)
class ClipFrames:
    """The pictures behind the latents of clips, and the models that read or write them.

    Attributes:
        tokenizer, teacher: their folders; published shapes stand for a missing one.
        grid, image_size: rows and columns of latents and of pictures.
    """

    tokenizer: Path | None
    teacher: Path | None
    grid: tuple[int, int]
    image_size: tuple[int, int]

    @classmethod
    def of(cls, tokenizer: Path | None, teacher: Path | None, image_size: tuple[int, int]) -> ClipFrames:
        """The latents that a tokenizer makes of pictures of a size."""
        with FakeTensorMode():
            space = tokenizer_outline(tokenizer).spatial_compression
        return cls(tokenizer, teacher, (image_size[0] // space, image_size[1] // space), image_size)


@cache
def encoding(source: ClipFrames, shape: ClipShape) -> tuple[int, Cost]:
    """Bytes of the tokenizer, and the cost of encoding clips and views one by one, as `FrameSource` does."""
    with FakeTensorMode(), torch.no_grad():
        codec = tokenizer_outline(source.tokenizer)

        def trace(latent_frames: int) -> Cost:
            video = torch.empty(1, 3, 4 * latent_frames - 3, *source.image_size)
            return traced(lambda: codec.encode(video))

        cost = extrapolated(trace, latent_frame_count(shape.frames), (3, 5))
        return weight_bytes(codec), cost.repeated(shape.clips * len(shape.views))


@cache
def _teaching(source: ClipFrames, shape: ClipShape) -> tuple[int, Cost]:
    """Bytes of the relational teacher, and its cost for the clips of a micro-batch, one by one."""
    with FakeTensorMode():
        network, features = teacher_outline(source.teacher)
        video = torch.empty(len(shape.views), 3, shape.frames, *source.image_size)
        return weight_bytes(network), traced(lambda: features(video)).repeated(shape.clips)


@cache
def _comparing(source: ClipFrames, shape: ClipShape, latent_frames: int, bfloat16: bool) -> tuple[int, Cost]:
    """Bytes of the tokenizer and LPIPS, and the cost of the perceptual term, its gradients too, view by view."""
    with FakeTensorMode():
        codec, network = tokenizer_outline(source.tokenizer), LPIPS().requires_grad_(False)
        if bfloat16:
            to_bfloat16(codec)
        distance = PerceptualLoss(codec, network, latent_frames)

        def trace(frames: int) -> Cost:
            size = (1, 1, codec.latent_channels, frames, *shape.grid)
            predicted, target = nn.Parameter(torch.empty(size)), torch.empty(size)
            return traced(lambda: distance(predicted, target), [predicted])

        cost = extrapolated(trace, latent_frame_count(shape.frames), (latent_frames + 1, latent_frames + 3))
        return weight_bytes(codec) + weight_bytes(network), cost.repeated(shape.clips * len(shape.views))


class _OutlinedSimilarities(ClipSimilarities):
    """A teacher that has answered already."""

    def __init__(self, config: RelationalConfig) -> None:
        self.config = config

    def similarities(
        self, clips: Sequence[Clip], views: Sequence[str], grid: tuple[int, int, int], frames: Tensor | None = None
    ) -> SimilarityMatrices:
        shape = bins, rows, columns = common_shape(self.config, grid)
        clip_views, cells = (len(clips), len(views)), rows * columns
        intra = torch.empty(*clip_views, bins - 1, cells, cells)
        return SimilarityMatrices(shape, intra, torch.empty(len(clips), len(views) - 1, bins, cells, cells))


def largest_batch(
    trainer: TrainerConfig, clips: ClipSampling, views: Sequence[str], grid: tuple[int, int]
) -> ClipShape:
    """The longest clips, in all views where steps are joint, else in one."""
    joint = clips.view_weights is None or JOINT in clips.view_weights
    count, views = (1, views) if joint else (clips.single_view_factor, views[:1])
    return ClipShape(count * trainer.batch_size, tuple(views), max(clips.lengths), grid)


def trainings(
    config: Stage1Config | Stage2Config | DistillConfig, model: WorldModelConfig, source: ClipFrames
) -> list[Training]:
    """The trainings of one step, in their order."""
    if isinstance(config, DistillConfig):
        return _distillation(config, model.model_copy(update={"towers": "generation"}), source)
    relational = config.relational if isinstance(config, Stage2Config) else None
    text = config.text.max_length if isinstance(config, Stage1Config) else 0
    shape = largest_batch(config.trainer, config.clips, model.views, source.grid)

    def objective(network: WorldModel) -> FlowMatchingObjective:
        term = None
        if relational is not None:
            term = RelationalTerm(relational, _OutlinedSimilarities(relational), network.config.num_layers)
            term.layer = max(1, network.config.num_layers // 2)  # it makes no difference which: all are held
        return FlowMatchingObjective(network, sigma=config.sigma, weighting=config.weighting, relational=term)

    def before() -> Frozen:
        frozen = {"tokenizer": encoding(source, shape)} if isinstance(config.input, FrameInput) else {}
        return frozen | ({"teacher": _teaching(source, shape)} if relational is not None else {})

    title = {"base": "base", "stage1": "stage I"}[config.kind] if isinstance(config, Stage1Config) else "stage II"
    return [
        Training(
            title, config.trainer, config.clips, model, shape, objective,
            lambda: shape.batch(model, maps=not text, text=text),
            trained=is_trained if text else lambda _: True, before=before,
        )
    ]  # fmt: skip


def _distillation(config: DistillConfig, model: WorldModelConfig, source: ClipFrames) -> list[Training]:
    first, regression, matching = config.teacher_forcing, config.trajectory_regression, config.distribution_matching
    mixed = config.clips.model_copy(
        update={"view_weights": first.view_weights, "single_view_factor": first.single_view_factor}
    )
    shapes = [
        largest_batch(one.trainer, clips, config.views, source.grid)
        for one, clips in ((first, mixed), (regression, config.clips), (matching, config.clips))
    ]

    def trajectory_batch(shape: ClipShape) -> TrajectoryBatch:
        plain = shape.batch(model)
        clips, views, channels, frames, *grid = plain.latents.shape
        nodes = torch.empty(clips, config.spec.steps + 1, views, channels, frames - 1, *grid)
        mask = torch.ones(clips, views, frames, *grid)
        return TrajectoryBatch(**vars(plain), nodes=nodes, history=plain.latents, mask=mask)

    def encoder(shape: ClipShape, used: bool) -> Frozen:
        if not isinstance(config.input, FrameInput):
            return {}
        size, cost = encoding(source, shape)
        return {"encoder": (size, cost if used else Cost())}  # trajectories keep the latents of their clips

    def compared(shape: ClipShape) -> Frozen:
        if config.lpips_weights is None:
            return {}
        return {"tokenizer": _comparing(source, shape, config.perceptual.latent_frames, config.perceptual.bfloat16)}

    asked = first.teacher_share > 0
    return [
        Training(
            "distill: teacher forcing", first.trainer, mixed, model, shapes[0],
            lambda network: TeacherForcingObjective(network, config, WorldModel(network.config) if asked else None),
            lambda: shapes[0].batch(model), scores=int(asked), before=lambda: encoder(shapes[0], used=True),
        ),
        Training(
            "distill: trajectory regression", regression.trainer, config.clips, model, shapes[1],
            lambda network: TrajectoryObjective(network, config, None), lambda: trajectory_batch(shapes[1]),
            before=lambda: encoder(shapes[1], used=False), compared=lambda: compared(shapes[1]),
        ),
        Training(
            "distill: distribution matching", matching.trainer, config.clips, model, shapes[2],
            lambda network: DistributionMatchingObjective(
                network, WorldModel(network.config), WorldModel(network.config), config, None
            ),
            lambda: trajectory_batch(shapes[2]), turns=((0, 1 - 1 / CYCLE), (CYCLE - 1, 1 / CYCLE)), models=2, scores=1,
            before=lambda: encoder(shapes[2], used=False), compared=lambda: compared(shapes[2]),
        ),
    ]  # fmt: skip


def trajectory_shard(config: DistillConfig, model: WorldModelConfig, source: ClipFrames) -> Estimate:
    """A shard of the teacher's trajectories, whose clips are made together; the teacher is whole on every device."""
    model, settings = model.model_copy(update={"towers": "generation"}), config.trajectory_regression
    clips = min(settings.trajectories.clips, settings.trajectories.clips_per_shard)
    shape = ClipShape(clips, tuple(config.views), max(config.clips.lengths), source.grid)
    trainer = settings.trainer.model_copy(update={"device": "cpu"})

    def trace(layers: int) -> Cost:
        with FakeTensorMode(), autocast(trainer):
            teacher = WorldModel(model.model_copy(update={"num_layers": layers})).requires_grad_(False)
            batch = shape.batch(model)
            return traced(
                lambda: teacher_trajectories(
                    teacher, batch.latents, maps_of(batch), torch.empty_like(batch.latents), views=batch.views,
                    spec=config.spec, substeps=(1,) * config.spec.steps,
                )
            )  # fmt: skip

    cost = extrapolated(trace, model.num_layers, (2, 3))
    # Each block takes all sub-steps, and one pass more that writes it into the cache.
    cost = cost.repeated((1 + sum(settings.trajectories.substeps)) / (1 + config.spec.steps))
    parameters, encoder = parameter_counts(model)[0], 0
    if isinstance(config.input, FrameInput):
        encoder, before = encoding(source, shape)
        cost = before.then(cost)
    parts = {"weights": 4 * parameters + encoder, "activations": cost.activations}
    steps = -(-settings.trajectories.clips // clips)
    return Estimate(f"distill: trajectories (a shard of {clips} clips)", parameters, parts, cost.all_flops, steps)


def device_memory(device: str) -> float | None:
    """Bytes of a card; None for a processor, whose memory the system shares out."""
    on_gpu = torch.device(device).type == "cuda"
    return float(torch.cuda.get_device_properties(device).total_memory) if on_gpu else None


def require_memory(config: StrictModel, inputs: Mapping[str, Path]) -> None:
    """Refuse a training that this process's card cannot hold, before anything is loaded.

    Raises:
        ConfigError: its parts in GB, and the setting that would fit.
    """
    if not isinstance(config, (Stage1Config, Stage2Config, DistillConfig)):
        return
    device = (config.teacher_forcing if isinstance(config, DistillConfig) else config).trainer.device
    memory, source = device_memory(device), _source(config, inputs)
    start = inputs.get({Stage1Config: "base", Stage2Config: "stage1", DistillConfig: "stage2"}[type(config)])
    if memory is None or source is None or (start is None and not isinstance(config, Stage1Config)):
        return  # the training itself names the input that is missing
    model = config.model if isinstance(config, Stage1Config) else WorldModelConfig()
    if start is not None:
        model = read_checkpoint_info(Path(start)).config
    if isinstance(config, Stage2Config):
        model = stage2_model_config(config, model)
    devices = int(os.environ.get("WORLD_SIZE", "1"))
    needs = [(one.estimate(devices), one) for one in trainings(config, model, source)]
    rows = [(need, "" if need.fits(memory) else one.fitting_setting(devices, memory)) for need, one in needs]
    if isinstance(config, DistillConfig):
        shard = trajectory_shard(config, model, source)
        rows.append((shard, "" if shard.fits(memory) else "fewer clips_per_shard"))
    for need, setting in rows:
        if setting:
            raise ConfigError(
                "This training does not fit the device's memory.",
                where=f"{need.title} on {device}",
                expected=f"at most {gigabytes(USABLE * memory)} GB",
                got=f"{gigabytes(need.total)} GB ({need.describe_parts()})",
                next_step=f"set {setting}; `worldline plan` shows every stage",
            )


def _source(config: Stage1Config | Stage2Config | DistillConfig, inputs: Mapping[str, Path]) -> ClipFrames | None:
    tokenizer, teacher = (Path(inputs[name]) if name in inputs else None for name in ("tokenizer", "teacher"))
    if isinstance(config.input, FrameInput):
        return None if tokenizer is None else ClipFrames.of(tokenizer, teacher, config.input.image_size)
    if "latents" not in inputs:
        return None
    latents = LatentStore.open(Path(inputs["latents"]))
    return ClipFrames(tokenizer, teacher, latents.latent_shape[1:], latents.image_size)
