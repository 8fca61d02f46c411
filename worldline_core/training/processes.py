"""The processes that share a training: what they agree on, and one model over all of them.

Weights, gradients, moments and averages are held in parts (FSDP2): every process of a shard group holds one part of each
parameter and gathers a block only while it computes with it (`torch.distributed.fsdp.fully_shard`). With fewer parts than
processes, several groups hold copies (HSDP).
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from functools import cache
from typing import TYPE_CHECKING, Literal, cast

import torch
from torch import Tensor, nn

from worldline_core.errors import ConfigError, TrainingError
from worldline_core.model.layers import TextContext
from worldline_core.model.tokenizers import require_device
from worldline_core.model.world_model import WorldModel, WorldModelOutput
from worldline_core.training.training_config import ShardingConfig

if TYPE_CHECKING:
    from torch.distributed.device_mesh import DeviceMesh
    from torch.distributed.tensor import DTensor

# Longer than one process needs for what it does alone while the others wait: a shard of trajectories, a checkpoint.
_PROCESS_TIMEOUT = timedelta(hours=1)


def join_processes(device: str) -> None:
    """Join the processes that torchrun has started to share a run; nothing happens where this one is alone.

    Call it before anything is moved to ``device``: on GPUs it makes "cuda" this process's own card. Tensors on GPUs go
    through NCCL; numbers to agree on, and states that are being written, go through gloo.

    Raises: UnavailableError: there is no such device.
    """
    require_device(device)
    if int(os.environ.get("WORLD_SIZE", "1")) > 1 and not torch.distributed.is_initialized():
        on_gpu = torch.device(device).type == "cuda"
        if on_gpu:
            torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", "0")))
        torch.distributed.init_process_group("cpu:gloo,cuda:nccl" if on_gpu else "gloo", timeout=_PROCESS_TIMEOUT)


def processes() -> tuple[int, int]:
    """(rank, number) of the processes that share this run; (0, 1) where this one is alone."""
    if not torch.distributed.is_initialized():
        return 0, 1
    return torch.distributed.get_rank(), torch.distributed.get_world_size()


def wait_for_all() -> None:
    """Return once every process has called this; at once when there is only one."""
    if torch.distributed.is_initialized():
        torch.distributed.barrier()


def average_values(values: Mapping[str, float]) -> dict[str, float]:
    """Mean of every number over the processes, the same on all of them; they must name the same numbers."""
    if not torch.distributed.is_initialized():
        return dict(values)
    names = sorted(values)
    numbers = torch.tensor([values[name] for name in names], dtype=torch.float64)
    torch.distributed.all_reduce(numbers)
    numbers /= torch.distributed.get_world_size()
    return dict(zip(names, numbers.tolist(), strict=True))


def another_process_ended(error: BaseException | None) -> bool:
    """Returns whether an error means that another process cannot be reached any more."""
    return isinstance(error, torch.distributed.DistError) or (isinstance(error, RuntimeError) and "gloo" in str(error))


@contextmanager
def reporting_lost_processes(where: str) -> Iterator[None]:
    """Say in plain words that another process has ended, where its silence shows as an error of the network.

    Raises:
        TrainingError: another process cannot be reached any more.
    """
    try:
        yield
    except RuntimeError as error:
        if processes()[1] == 1 or not another_process_ended(error):
            raise
        raise TrainingError(
            "Another process of this training has ended or cannot be reached.",
            where=f"{where}, process {processes()[0]} of {processes()[1]}",
            expected="all processes to take every step together",
            got=str(error).splitlines()[0],
            next_step="look for the first error among the messages of the other processes (torchrun names the process "
            "that failed); the same command continues from the last saved state",
        ) from error


@dataclass(frozen=True)
class BatchPlan:
    """Distribution of a training's micro-batches over processes, whose number may change when it continues.

    A step has ``per_step`` micro-batches, whatever the number of processes. Micro-batch number m of the run decides its
    clips and its noise. ``together`` neighbours are drawn as one batch (clips of one length), as many as there were
    processes when the run began, so that processes side by side have equal work.
    """

    per_step: int
    together: int
    rank: int = 0
    world_size: int = 1

    @classmethod
    def of(cls, wanted: int, together: int | None = None) -> BatchPlan:
        """The plan for these processes.

        Raises:
            ConfigError: the micro-batches of a step cannot be shared out evenly.
        """
        rank, world_size = processes()
        if wanted % world_size:
            counts = [str(count) for count in range(1, wanted + 1) if wanted % count == 0]
            raise ConfigError(
                "The micro-batches of a step cannot be shared out evenly among these processes.",
                where="trainer.global_batch, or the number of processes that the run began with",
                expected=f"a number of processes that divides {wanted} micro-batches: {', '.join(counts)}",
                got=f"{world_size} processes",
                next_step="start as many processes as divide it, or choose another global_batch or batch_size",
            )
        return cls(wanted, together or world_size, rank, world_size)

    @property
    def accumulation(self) -> int:
        """Micro-batches of a step that this process takes one after the other."""
        return self.per_step // self.world_size

    def number(self, index: int) -> int:
        """Number in the whole run of this process's ``index``-th micro-batch."""
        return index * self.world_size + self.rank

    def drawn(self, index: int) -> tuple[int, int]:
        """(number of the draw, place within it) of this process's ``index``-th micro-batch."""
        return divmod(self.number(index), self.together)


ALONE = BatchPlan(1, 1)
"""One process, one micro-batch a step."""


def device_mesh(config: ShardingConfig, device: str) -> DeviceMesh:
    """The processes as one shard group, or as (copies, shards).

    Raises:
        ConfigError: the processes do not divide into groups of this size.
    """
    from torch.distributed.device_mesh import init_device_mesh

    world_size = processes()[1]
    shards = config.shards or world_size
    if world_size % shards:
        raise ConfigError(
            "The processes do not divide into shard groups.",
            where="trainer.sharding.shards",
            expected=f"a divisor of {world_size}, the number of processes",
            got=shards,
            next_step="leave it out to shard over all processes, or give the number of GPUs of a node",
        )
    kind = torch.device(device).type
    if shards == world_size:
        return init_device_mesh(kind, (world_size,), mesh_dim_names=("shard",))
    return init_device_mesh(kind, (world_size // shards, shards), mesh_dim_names=("copy", "shard"))


def weight_dtype(
    name: str, parameter: Tensor, precision: Literal["fp32", "bf16"], weights: Literal["fp32", "bf16"] = "fp32"
) -> torch.dtype:
    """Dtype in which a process alone holds a weight, by its name; ``weights``: of trained matrices.

    Matrices of blocks and of the text embedding are nearly all that there is. Their products in bfloat16 give the same from weights
    that were rounded before, so what is not trained is.
    """
    half = precision == "bf16" and parameter.ndim > 1 and name.startswith(("layers.", "embed_tokens."))
    return torch.bfloat16 if half and (weights == "bf16" or not parameter.requires_grad) else torch.float32


def hold_weights(
    model: WorldModel, precision: Literal["fp32", "bf16"], weights: Literal["fp32", "bf16"] = "fp32"
) -> WorldModel:
    """Give a model that a process has alone its weights as `weight_dtype` says, each where it is."""
    for name, parameter in model.named_parameters():
        parameter.data = parameter.data.to(weight_dtype(name, parameter, precision, weights))
    return model


def place_model(
    model: WorldModel,
    config: ShardingConfig,
    *,
    precision: Literal["fp32", "bf16"],
    device: str,
    weights: Literal["fp32", "bf16"] = "fp32",
) -> WorldModel:
    """Put a model on its device, in parts where processes share the run, with what the configuration asks for.

    The first process's weights are handed out; on the others the model may be empty (`load_checkpoint`). Call it before
    the parameters are given to an optimiser: sharding replaces them. A process alone holds them as `weight_dtype` says. Weights,
    gradients and moments of several stay in float32; with "bf16" blocks are gathered and computed in bfloat16, and gradients are summed in float32. The time
    embedding is computed in float32, as Cosmos3 does.

    Raises:
        ConfigError: the processes do not divide into groups of ``config.shards``.
        TrainingError: another process has ended.
    """
    model.checkpointing = config.checkpointing
    if config.compile:
        model.compile_blocks()
    if processes()[1] == 1:
        return hold_weights(model, precision, weights).to(
            device
        )  # cast first: the device never holds more than it keeps
    from torch.distributed.checkpoint.state_dict import StateDictOptions, set_model_state_dict
    from torch.distributed.fsdp import MixedPrecisionPolicy, fully_shard, register_fsdp_forward_method

    _register_outputs()
    read = model.state_dict() if processes()[0] == 0 else {}
    model.to("meta")
    mesh = device_mesh(config, device)
    plain = MixedPrecisionPolicy(cast_forward_inputs=False)
    half = torch.bfloat16 if precision == "bf16" else None
    policy = MixedPrecisionPolicy(param_dtype=half, reduce_dtype=torch.float32, cast_forward_inputs=False)
    fully_shard(model.time_embedder, mesh=mesh, mp_policy=plain)
    for layer in model.layers:
        fully_shard(layer, mesh=mesh, mp_policy=policy)
        for name in model.layer_passes:
            register_fsdp_forward_method(layer, name)
    # Freed after every pass: averages are swapped in for validation, and a copy kept from before would be stale.
    fully_shard(model, mesh=mesh, mp_policy=policy, reshard_after_forward=True)
    for name in ("encode_text", "forward_block", "write_block", "forward_teacher_forcing"):
        register_fsdp_forward_method(model, name)
    model.to_empty(device=device)
    with reporting_lost_processes("handing out the weights"):
        # Tensor by tensor: no device ever holds the whole model.
        options = StateDictOptions(full_state_dict=True, broadcast_from_rank0=True)
        set_model_state_dict(model, read, options=options)
    return model


@cache
def _register_outputs() -> None:
    """Let FSDP find the tensors in what the model returns: on their way back it gathers the weights again."""
    for kind in (TextContext, WorldModelOutput):
        torch.export.register_dataclass(kind)


def reduce_gradients(models: Iterable[nn.Module], now: bool) -> None:
    """Set whether the next backward pass of sharded models sums gradients over the processes, or keeps them until one does."""
    from torch.distributed.fsdp import FSDPModule

    for model in models:
        if isinstance(model, FSDPModule):
            model.set_requires_gradient_sync(now)


def own_part(tensor: Tensor) -> Tensor:
    """The part of a tensor that this process holds, sharing its memory; all of it where it is not sharded."""
    # Not isinstance: importing DTensor takes half a second, which a process alone need not spend.
    return cast("DTensor", tensor).to_local() if hasattr(tensor, "to_local") else tensor


def whole(tensor: Tensor) -> Tensor:
    """All of a tensor, gathered from the processes that hold its parts; they all must call it."""
    return cast("DTensor", tensor).full_tensor() if hasattr(tensor, "full_tensor") else tensor


@torch.no_grad()
def gathered(tensors: Mapping[str, Tensor], dtype: torch.dtype | None = None) -> dict[str, Tensor]:
    """Whole tensors on the first process's host memory, and nothing on the others; all processes must call it.

    Args:
        dtype: cast floating-point numbers, each tensor by itself, so that the whole never exists in another precision.
    """
    kept: dict[str, Tensor] = {}
    for name, tensor in sorted(tensors.items()):
        value = whole(tensor)
        if processes()[0] == 0:
            kept[name] = value.detach().to("cpu", dtype)
    return kept
