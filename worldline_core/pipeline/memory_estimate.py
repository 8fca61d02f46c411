"""Memory and operations of a training, counted by running its own objective on tensors that have shapes and no values.

`worldline plan` prints these estimates (`size_sheet.py`), and a training's task refuses what its device cannot hold.
torch's own MemTracker gives the same figures within 0.4 % for a single pass, but refuses modules that are called several times
before a backward pass, as the tokenizers and Stage III do; operations are counted by the formulas of its FlopCounterMode.
"""

from __future__ import annotations

import math
import os
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode
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
"""Largest size (layers, latent frames) that is traced whole; presets for a CPU have no more layers, and so an exact peak."""
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
        forward, backward: most bytes until the loss is there, and from then on; gradients of parameters are not in them.
        held: bytes when the loss is there.
        gradients: bytes of the parameters' gradients at the end.
        peak: most bytes at once, gradients included.
        flops: floating-point operations, two for a multiplication and addition, except attention's.
        attention_flops: those of attention, which grow with the square of the tokens.
    """

    forward: float = 0.0
    backward: float = 0.0
    held: float = 0.0
    gradients: float = 0.0
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
        given = {tensor.untyped_storage()._cdata for tensor in _tensors((*args, *kwargs.values()))}
        for tensor in _tensors((result,)):
            if tensor.untyped_storage()._cdata not in given:  # else it is a view, or was changed in place
                self._follow(tensor.untyped_storage())
        return result

    def _follow(self, storage: torch.UntypedStorage) -> None:
        key, size = storage._cdata, storage.nbytes()
        if key in self._storages:
            return

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


def _tensors(values: Iterable[Any]) -> Iterator[Tensor]:
    for value in values:
        if isinstance(value, Tensor):
            yield value
        elif isinstance(value, (tuple, list)):
            yield from _tensors(value)


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
    return Cost(forward, tracker.most, held, tracker.gradients, tracker.peak, tracker.flops, tracker.attention_flops)


def extrapolated(trace: Callable[[int], Cost], size: int, traced_at: tuple[int, int]) -> Cost:
    """``trace(size)`` by a straight line through two smaller sizes (layers of a model, frames of a clip).

    The ``peak`` becomes the sum of activations and gradients, at most too high: where it lies depends on the size.
    """
    small, large = traced_at
    if size <= _SMALL:
        return trace(size)
    share = (size - small) / (large - small)
    line = Cost(*(a + (b - a) * share for a, b in zip(trace(small), trace(large), strict=True)))
    return line._replace(peak=line.activations + line.gradients)


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


@dataclass(frozen=True)
class ClipShape:
    """The micro-batch of one device.

    Attributes:
        clips, views: how many; frames: of every clip, as recorded; grid: rows and columns of a latent.
    """

    clips: int
    views: tuple[str, ...]
    frames: int
    grid: tuple[int, int]

    def tokens(self, model: WorldModelConfig) -> int:
        """Video tokens of one clip."""
        rows, columns = (size // model.patch_size for size in self.grid)
        return latent_frame_count(self.frames) * len(self.views) * rows * columns

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
    """What one stage takes on one device.

    Attributes:
        parameters: trained ones, or those of a model that only predicts.
        parts: bytes at the worst moment, by name; their sum is ``total``.
        flops: of one optimiser step, prediction or clip; steps: how many of these, where known.
        facts: other figures for the sheet, by name.
    """

    title: str
    parameters: int
    parts: Mapping[str, float]
    flops: float = 0.0
    steps: int | None = None
    facts: Mapping[str, Any] = field(default_factory=dict[str, Any])

    @property
    def total(self) -> float:
        return sum(self.parts.values())

    def fits(self, memory: float) -> bool:
        """Whether a device of so many bytes holds it."""
        return self.total <= USABLE * memory

    def describe_parts(self) -> str:
        return ", ".join(f"{name} {gigabytes(size)}" for name, size in self.parts.items())


def gigabytes(size: float) -> str:
    """Bytes as GB (10^9), short enough for a table."""
    value = size / 1e9
    return f"{value:.0f}" if value >= 100 else f"{value:.1f}" if value >= 0.1 else f"{value:.3f}"


def upper_bound(model: WorldModelConfig, shape: ClipShape, models: int = 1) -> float:
    """Cheap upper bound on the memory of a training of small pictures, several times what it takes.

    Args:
        models: world models that are held, trained or not.
    """
    width = 20 * model.hidden_size + 8 * model.num_heads * model.head_dim + 6 * model.intermediate_size
    activations = 4 * width * model.num_layers * shape.clips * shape.tokens(model)
    return 2 * models * (24 * parameter_counts(model)[0] + activations)


Frozen = dict[str, tuple[int, Cost]]
"""Bytes of models that are not trained, whole on every device, and the cost of what they compute for a micro-batch."""


@dataclass(frozen=True, eq=False)
class Training:
    """One training, by its configuration alone.

    Attributes:
        views, grid: of the model; rows and columns of its latents.
        objective, batch: what is minimised, and a micro-batch for it; both are made without values.
        trained: whether a parameter gets gradients, by its name.
        turns: steps of each kind that the training takes, and their share (distribution matching alternates).
        models, scores: world models that are trained, the first alone averaged, and those that are not.
        before: what encodes clips and asks the teacher, over when the model's own step begins.
        perceptual: what compares pictures at the end of the forward pass, in the last turn.
    """

    title: str
    trainer: TrainerConfig
    clips: ClipSampling
    model: WorldModelConfig
    views: tuple[str, ...]
    grid: tuple[int, int]
    objective: Callable[[WorldModel], Any]
    batch: Callable[[ClipShape], Batch]
    trained: Callable[[str], bool] = lambda _: True
    turns: Sequence[tuple[int, float]] = ((0, 1.0),)
    models: int = 1
    scores: int = 0
    before: Callable[[ClipShape], Frozen] = lambda _: {}
    perceptual: Callable[[ClipShape], Frozen] | None = None

    @property
    def shape(self) -> ClipShape:
        """The largest micro-batch: the longest clips, in all views where steps are joint, else in one."""
        joint = self.clips.view_weights is None or JOINT in self.clips.view_weights
        clips, views = (1, self.views) if joint else (self.clips.single_view_factor, self.views[:1])
        return ClipShape(clips * self.trainer.batch_size, views, max(self.clips.lengths), self.grid)

    @property
    def upper_bound(self) -> float:
        """Cheap upper bound on memory, with which most small models need no closer look."""
        shape, (rows, columns) = self.shape, self.grid
        # Decoding eight frames of a view keeps some hundreds of values for each of their pixels.
        pictures = 4000 * 8 * 256 * shape.clips * len(shape.views) * rows * columns if self.perceptual else 0
        return upper_bound(self.model, shape, self.models + self.scores) + 2 * pictures

    def micro_step(self, step: int, *, sharded: bool) -> Cost:
        """Cost of one micro-step: the loss and its backward pass."""
        trainer = self.trainer.model_copy(update={"device": "cpu"})  # tensors without values follow a CPU's paths
        half = sharded and trainer.precision == "bf16"

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
                    if half:
                        to_bfloat16(one)
                batch = self.batch(self.shape)

                def loss() -> Tensor:
                    with autocast(trainer):
                        return objective.loss(batch, torch.Generator(), step)[0]

                cost = traced(loss, [parameter for one in models for parameter in one.parameters()])
            return cost._replace(gradients=cost.gradients * (1 + half))  # summed in float32

        return extrapolated(trace, self.model.num_layers, (3, 4))

    def shards(self, devices: int) -> int:
        """Parts of every weight on so many devices."""
        return min(self.trainer.sharding.shards or devices, devices)

    def estimate(self, devices: int) -> Estimate:
        """Memory and operations on each of so many devices that share the training."""
        trainer, shards = self.trainer, self.shards(devices)
        micro_steps = trainer.accumulation
        if trainer.global_batch is not None:
            micro_steps = -(-trainer.global_batch // (trainer.batch_size * devices))
        before, step, flops = self._costs(shards > 1)
        trained, block = parameter_counts(self.model, self.trained)
        own, average = 4 * self.models * trained / shards, 4 * trained / shards
        frozen = {name: size for name, (size, _) in (self.before(self.shape) | self._compared()).items()}
        parts: dict[str, float] = {"weights": own, "moments": 2 * own, "average": average, **frozen}
        if torch.device(trainer.device).type == "cpu":
            parts["state being written"] = 3 * own + average  # elsewhere this copy lies in the host's memory
        parts["frozen scores"] = 4 * self.scores * trained / shards
        # Two blocks are gathered at a time, and the gradients of one are summed, in bfloat16 and float32.
        parts["gathered"] = 0 if shards == 1 else block * (2 * 2 + 2 + 4)
        if shards == 1 and micro_steps == 1:
            # Gradients come as activations go.
            during = {"gradients": step.gradients, "activations": step.peak - step.gradients}
        else:
            reduced = micro_steps == 1 or trainer.sharding.reduce_every_micro_step
            gradients = step.gradients / shards if reduced else step.gradients
            during = {"gradients": gradients, "activations": step.activations}
        if sum(during.values()) < before:
            during = {"encoding clips": before}
        parts = {name: size for name, size in (parts | during).items() if size}
        lengths = sorted({min(self.clips.lengths), max(self.clips.lengths)})
        tokens = {str(frames): replace(self.shape, frames=frames).tokens(self.model) for frames in lengths}
        facts = {"tokens of a clip": tokens, "bytes of a training state": 4 * trained * (3 * self.models + 1)}
        return Estimate(self.title, self.models * trained, parts, micro_steps * flops, trainer.steps, facts)

    def _compared(self) -> Frozen:
        return self.perceptual(self.shape) if self.perceptual else {}

    @cache  # noqa: B019 - a few trainings a process
    def _costs(self, sharded: bool) -> tuple[float, Cost, float]:
        """Most bytes before the model's own micro-step, its cost at its worst, and the mean operations of both."""
        first = Cost()
        for _, cost in self.before(self.shape).values():
            first = first.then(cost)
        turns = [self.micro_step(step, sharded=sharded) for step, _ in self.turns]
        for _, cost in self._compared().values():
            # It comes last in the forward pass, and is over when the backward pass begins.
            last, held = turns[-1], turns[-1].held + cost.activations
            changed = {"forward": max(last.forward, held), "peak": max(last.peak, held)}
            turns[-1] = last._replace(**changed, flops=last.flops + cost.flops)
        worst, mean = Cost(), first
        for (_, share), turn in zip(self.turns, turns, strict=True):
            worst, mean = worst.then(turn), mean.then(turn.repeated(share))
        lengths = [latent_frame_count(n) / latent_frame_count(self.shape.frames) for n in self.clips.lengths]
        linear, square = (sum(n**power for n in lengths) / len(lengths) for power in (1, 2))
        return first.activations, worst, linear * mean.flops + square * mean.attention_flops

    def fitting_setting(self, devices: int, memory: float) -> str:
        """The nearest setting with which this training would fit devices of ``memory`` bytes, in words."""
        sharding, shards = self.trainer.sharding, self.shards(devices)
        changes = {"checkpointing": "block", "reduce_every_micro_step": True, "shards": None}
        trainer = self.trainer.model_copy(update={"sharding": sharding.model_copy(update=changes)})
        block = replace(self, trainer=trainer)
        for count in (shards * 2**power for power in range(11)):
            need = block.estimate(count)
            if need.fits(memory):
                wider = "" if count == shards else f" over {count} devices"
                summed = "" if sharding.reduce_every_micro_step or count == 1 else ", reduce_every_micro_step: true"
                return f"trainer.sharding.checkpointing: block{summed}{wider} ({gigabytes(need.total)} GB a device)"
        for frames in sorted(set(self.clips.lengths), reverse=True)[1:]:
            shorter = replace(block, clips=self.clips.model_copy(update={"lengths": (frames,)}))
            if shorter.estimate(shards * 1024).fits(memory):
                return f"trainer.sharding.checkpointing: block, and clips of at most {frames} frames, over more devices"
        return "devices of more memory, or a smaller model"


def trainings(
    config: Stage1Config | Stage2Config | DistillConfig, model: WorldModelConfig, source: ClipFrames
) -> list[Training]:
    """The trainings of one step, in their order."""
    if isinstance(config, DistillConfig):
        return _distillation(config, model.model_copy(update={"towers": "generation"}), source)
    relational = config.relational if isinstance(config, Stage2Config) else None
    text = config.text.max_length if isinstance(config, Stage1Config) else 0

    def objective(network: WorldModel) -> FlowMatchingObjective:
        term = None
        if relational is not None:
            term = RelationalTerm(relational, _OutlinedSimilarities(relational), network.config.num_layers)
            term.layer = max(1, network.config.num_layers // 2)  # it makes no difference which: all are held
        return FlowMatchingObjective(network, sigma=config.sigma, weighting=config.weighting, relational=term)

    def before(shape: ClipShape) -> Frozen:
        frozen = {"tokenizer": encoding(source, shape)} if isinstance(config.input, FrameInput) else {}
        return frozen | ({"teacher": teaching(source, shape)} if relational is not None else {})

    titles = {"base": "base", "stage1": "stage I"}
    return [
        Training(
            titles[config.kind] if isinstance(config, Stage1Config) else "stage II", config.trainer, config.clips,
            model, model.views, source.grid, objective,
            lambda shape: shape.batch(model, maps=not text, text=text),
            trained=is_trained if text else lambda _: True, before=before,
        )
    ]  # fmt: skip


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


def _distillation(config: DistillConfig, model: WorldModelConfig, source: ClipFrames) -> list[Training]:
    first, regression, matching = config.teacher_forcing, config.trajectory_regression, config.distribution_matching
    asked = first.teacher_share > 0
    encodes = isinstance(config.input, FrameInput)

    def trajectory_batch(shape: ClipShape) -> TrajectoryBatch:
        plain = shape.batch(model)
        clips, views, channels, frames, *grid = plain.latents.shape
        nodes = torch.empty(clips, config.spec.steps + 1, views, channels, frames - 1, *grid)
        mask = torch.ones(clips, views, frames, *grid)
        return TrajectoryBatch(**vars(plain), nodes=nodes, history=plain.latents, mask=mask)

    def kept(shape: ClipShape) -> Frozen:
        # Trajectories keep the latents of their clips, so the encoder only lies there.
        return {"encoder": (encoding(source, shape)[0], Cost())} if encodes else {}

    def perceptual(shape: ClipShape) -> Frozen:
        return {"tokenizer": comparing(source, shape, config.perceptual.latent_frames, config.perceptual.bfloat16)}

    compared: dict[str, Any] = {} if config.lpips_weights is None else {"perceptual": perceptual}
    mixed = {"view_weights": first.view_weights, "single_view_factor": first.single_view_factor}
    of_model = model, tuple(config.views), source.grid
    return [
        Training(
            "distill: teacher forcing", first.trainer, config.clips.model_copy(update=mixed), *of_model,
            lambda network: TeacherForcingObjective(network, config, WorldModel(network.config) if asked else None),
            lambda shape: shape.batch(model), scores=int(asked),
            before=lambda shape: {"encoder": encoding(source, shape)} if encodes else {},
        ),
        Training(
            "distill: trajectory regression", regression.trainer, config.clips, *of_model,
            lambda network: TrajectoryObjective(network, config, None), trajectory_batch, before=kept, **compared,
        ),
        Training(
            "distill: distribution matching", matching.trainer, config.clips, *of_model,
            lambda network: DistributionMatchingObjective(
                network, WorldModel(network.config), WorldModel(network.config), config, None
            ),
            trajectory_batch, turns=((0, 1 - 1 / CYCLE), (CYCLE - 1, 1 / CYCLE)), models=2, scores=1, before=kept,
            **compared,
        ),
    ]  # fmt: skip


def trajectory_clips(config: DistillConfig, grid: tuple[int, int]) -> ClipShape:
    """The clips of one shard of the teacher's trajectories, which are made together."""
    settings = config.trajectory_regression.trajectories
    return ClipShape(
        min(settings.clips, settings.clips_per_shard), tuple(config.views), max(config.clips.lengths), grid
    )


def trajectory_shard(config: DistillConfig, model: WorldModelConfig, source: ClipFrames) -> Estimate:
    """A shard of the teacher's trajectories; the teacher lies whole on every device."""
    model, settings = model.model_copy(update={"towers": "generation"}), config.trajectory_regression
    trainer, shape = settings.trainer.model_copy(update={"device": "cpu"}), trajectory_clips(config, source.grid)

    def trace(layers: int) -> Cost:
        with FakeTensorMode():
            teacher = WorldModel(model.model_copy(update={"num_layers": layers})).requires_grad_(False)
            batch = shape.batch(model)

            def make() -> Tensor:
                with autocast(trainer):
                    return teacher_trajectories(
                        teacher, batch.latents, maps_of(batch), torch.empty_like(batch.latents), views=batch.views,
                        spec=config.spec, substeps=(1,) * config.spec.steps,
                    )  # fmt: skip

            return traced(make)

    cost = extrapolated(trace, model.num_layers, (2, 3))
    # Each block takes all sub-steps, and one pass more that writes it into the cache.
    cost = cost.repeated((1 + sum(settings.trajectories.substeps)) / (1 + config.spec.steps))
    parameters = parameter_counts(model)[0]
    weights = 4 * parameters
    if isinstance(config.input, FrameInput):
        size, before = encoding(source, shape)
        weights, cost = weights + size, before.then(cost)
    title = f"distill: trajectories (a shard of {shape.clips} clips)"
    latents = len(shape.views) * (latent_frame_count(shape.frames) - 1) * model.latent_channels * math.prod(shape.grid)
    kept = config.spec.steps + 1 + isinstance(config.input, FrameInput)
    facts = {"clips of a shard": shape.clips, "bytes stored": 2 * shape.clips * kept * latents}
    parts = {"weights": weights, "activations": cost.activations}
    return Estimate(title, parameters, parts, cost.all_flops, facts=facts)


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
def teaching(source: ClipFrames, shape: ClipShape) -> tuple[int, Cost]:
    """Bytes of the relational teacher, and its cost for the clips of a micro-batch, one by one."""
    with FakeTensorMode():
        network, features = teacher_outline(source.teacher)
        video = torch.empty(len(shape.views), 3, shape.frames, *source.image_size)
        return weight_bytes(network), traced(lambda: features(video)).repeated(shape.clips)


@cache
def comparing(source: ClipFrames, shape: ClipShape, latent_frames: int, bfloat16: bool) -> tuple[int, Cost]:
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


def device_memory(device: str, root: Path = Path("/")) -> float:
    """Bytes that a training may take: all of a card's, or what this machine has available.

    On a CPU: available memory (page cache included), or what the control group leaves where it is less; all of the
    machine's where the system does not report what is available (it is not Linux).

    Args:
        root: where ``proc`` and ``sys`` are mounted.
    """
    if torch.device(device).type == "cuda":
        return float(torch.cuda.get_device_properties(device).total_memory)
    meminfo, group = root / "proc/meminfo", root / "sys/fs/cgroup"
    if not meminfo.is_file():
        return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    available = 1024 * _numbers(meminfo)["MemAvailable:"]
    limit = group / "memory.max"
    if limit.is_file() and (most := limit.read_text(encoding="ascii").strip()) != "max":
        used, files = int((group / "memory.current").read_text(encoding="ascii")), _numbers(group / "memory.stat")
        available = min(available, int(most) - used + files["active_file"] + files["inactive_file"])
    return float(available)


def _numbers(path: Path) -> dict[str, int]:
    rows = (line.split() for line in path.read_text(encoding="ascii").splitlines())
    return {row[0]: int(row[1]) for row in rows}


def require_memory(config: StrictModel, inputs: Mapping[str, Path]) -> None:
    """Refuse a training that this process's device cannot hold, before anything is loaded.

    Where a cheap upper bound fits, as with every small preset, nothing is traced.

    Raises:
        ConfigError: its parts in GB, and the setting that would fit.
    """
    if not isinstance(config, (Stage1Config, Stage2Config, DistillConfig)) or not (source := _source(config, inputs)):
        return  # the training itself names the input that is missing
    start = inputs.get({Stage1Config: "base", Stage2Config: "stage1", DistillConfig: "stage2"}[type(config)])
    model = config.model if isinstance(config, Stage1Config) else None
    if start is not None:
        model = read_checkpoint_info(Path(start)).config
    if model is None:
        return
    if isinstance(config, Stage2Config):
        model = stage2_model_config(config, model)

    def check(bound: float, device: str, estimate: Callable[[], Estimate], setting: Callable[[float], str]) -> None:
        memory = device_memory(device)
        if bound < memory or (need := estimate()).fits(memory):
            return
        raise ConfigError(
            "This training does not fit the device's memory.",
            where=f"{need.title} on {device}",
            expected=f"at most {gigabytes(USABLE * memory)} GB",
            got=f"{gigabytes(need.total)} GB ({need.describe_parts()})",
            next_step=f"set {setting(memory)}; `worldline plan` shows every stage",
        )

    devices = int(os.environ.get("WORLD_SIZE", "1"))
    for one in trainings(config, model, source):
        setting = partial(one.fitting_setting, devices)
        check(one.upper_bound, one.trainer.device, partial(one.estimate, devices), setting)
    if isinstance(config, DistillConfig):
        bound, device = (
            upper_bound(model, trajectory_clips(config, source.grid)),
            config.trajectory_regression.trainer.device,
        )
        check(bound, device, partial(trajectory_shard, config, model, source), lambda _: "fewer clips_per_shard")


def _source(config: Stage1Config | Stage2Config | DistillConfig, inputs: Mapping[str, Path]) -> ClipFrames | None:
    tokenizer, teacher = (Path(inputs[name]) if name in inputs else None for name in ("tokenizer", "teacher"))
    if isinstance(config.input, FrameInput):
        return None if tokenizer is None else ClipFrames.of(tokenizer, teacher, config.input.image_size)
    if "latents" not in inputs:
        return None
    latents = LatentStore.open(Path(inputs["latents"]))
    return ClipFrames(tokenizer, teacher, latents.latent_shape[1:], latents.image_size)
