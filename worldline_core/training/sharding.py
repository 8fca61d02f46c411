"""One model over many processes: its weights, gradients, moments and averages in parts (FSDP2), and what saves memory.

Every process of a shard group holds one part of each parameter and gathers a block only while it computes with it
(`torch.distributed.fsdp.fully_shard`). With fewer parts than processes, several groups hold copies (HSDP).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache
from typing import TYPE_CHECKING, Literal, cast

import torch
from torch import Tensor, nn

from worldline_core.errors import ConfigError
from worldline_core.model.layers import TextContext
from worldline_core.model.world_model import WorldModel, WorldModelOutput
from worldline_core.training.processes import processes, reporting_lost_processes
from worldline_core.training.training_config import ShardingConfig

if TYPE_CHECKING:
    from torch.distributed.device_mesh import DeviceMesh
    from torch.distributed.tensor import DTensor


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


def place_model(
    model: WorldModel, config: ShardingConfig, *, precision: Literal["fp32", "bf16"], device: str
) -> WorldModel:
    """Put a model on its device, in parts where processes share the run, with what the configuration asks for.

    The first process's weights are handed out; on the others the model may be empty (`load_checkpoint`). Call it before
    the parameters are given to an optimiser: sharding replaces them. Weights, gradients and moments stay
    in float32; with "bf16" blocks are gathered and computed in bfloat16, and gradients are summed in float32. The time
    embedding is computed in float32, as Cosmos3 does.

    Raises:
        ConfigError: the processes do not divide into groups of ``config.shards``.
        TrainingError: another process has ended.
    """
    model.checkpointing = config.checkpointing
    if config.compile:
        model.compile_blocks()
    if processes()[1] == 1:
        return model.to(device)
    from torch.distributed.checkpoint.state_dict import StateDictOptions, set_model_state_dict
    from torch.distributed.fsdp import MixedPrecisionPolicy, fully_shard, register_fsdp_forward_method

    _register_outputs()
    weights = model.state_dict() if processes()[0] == 0 else {}
    model.to("meta")
    mesh = device_mesh(config, device)
    plain = MixedPrecisionPolicy(cast_forward_inputs=False)
    half = torch.bfloat16 if precision == "bf16" else None
    policy = MixedPrecisionPolicy(param_dtype=half, reduce_dtype=torch.float32, cast_forward_inputs=False)
    fully_shard(model.time_embedder, mesh=mesh, mp_policy=plain)
    for layer in model.layers:
        fully_shard(layer, mesh=mesh, mp_policy=policy)
        register_fsdp_forward_method(layer, "understand")
    # Freed after every pass: averages are swapped in for validation, and a copy kept from before would be stale.
    fully_shard(model, mesh=mesh, mp_policy=policy, reshard_after_forward=True)
    for name in ("encode_text", "forward_block", "write_block", "forward_teacher_forcing"):
        register_fsdp_forward_method(model, name)
    model.to_empty(device=device)
    with reporting_lost_processes("handing out the weights"):
        # Tensor by tensor: no device ever holds the whole model.
        options = StateDictOptions(full_state_dict=True, broadcast_from_rank0=True)
        set_model_state_dict(model, weights, options=options)
    return model


@cache
def _register_outputs() -> None:
    """Let FSDP find the tensors in what the model returns: on their way back it gathers the weights again."""
    for kind in (TextContext, WorldModelOutput):
        torch.export.register_dataclass(kind)


def reduce_gradients(models: Iterable[nn.Module], now: bool) -> None:
    """Whether the next backward pass of sharded models sums gradients over the processes, or keeps them until one does."""
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
