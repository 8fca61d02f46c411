"""AdamW in the forms that a trainer's config asks for: moments in float32 or 8 bits, weights in float32 or bfloat16.

torchao's optimiser, an optional package, computes all but the form without any saving.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, cast

import torch
from torch import Tensor, nn

from worldline_core.errors import ConfigError, needing
from worldline_core.training.processes import processes
from worldline_core.training.training_config import TrainerConfig

BLOCK, SMALLEST = 256, 4096
"""Values that share a scale in 8-bit moments, and the smallest tensor whose moments are in 8 bits, as in the paper (2110.02861)."""


def in_eight_bits(parameter: Tensor) -> bool:
    """Returns whether 8-bit moments of a parameter are in 8 bits; those of small ones stay in float32."""
    return parameter.numel() >= SMALLEST and parameter.numel() % BLOCK == 0


def make_optimizer(config: TrainerConfig, groups: Sequence[Sequence[nn.Parameter]]) -> torch.optim.Optimizer:
    """AdamW for groups of parameters.

    Raises:
        ConfigError: several processes share a run whose form is for one.
        UnavailableError: torchao is not installed.
    """
    settings = config.optimizer
    parts: list[dict[str, Any]] = [{"params": list(group)} for group in groups]
    common: dict[str, Any] = {
        "lr": settings.learning_rate, "betas": settings.betas, "weight_decay": settings.weight_decay
    }  # fmt: skip
    if not _saves_memory(config):
        return torch.optim.AdamW(parts, fused=True, **common)
    adamw, moment = _torchao_classes()

    class AdamW(adamw):
        """With moments in float32 where they are not in 8 bits, whatever the dtype of the weights."""

        def _new_buffer(self, p: Tensor, signed: bool) -> Tensor:
            if settings.moments == "8bit" and in_eight_bits(p):
                return moment.zeros(p.shape, signed, BLOCK, p.device, dtype=torch.float32)
            return torch.zeros_like(p, dtype=torch.float32)

    return AdamW(parts, bf16_stochastic_round=config.weights == "bf16", **common)


@cache
def _torchao_classes() -> tuple[Any, Any]:
    """torchao's AdamW, and its moments in 8 bits with a quicker way to round on a CPU.

    Raises:
        UnavailableError: torchao is not installed.
    """
    with needing("one-gpu", "torchao", where="trainer.weights, trainer.optimizer.moments"):
        from torchao.optim import AdamW8bit
        from torchao.optim.quant_utils import scale_tensor
        from torchao.optim.subclass_8bit import OptimState8bit

    class Moment(OptimState8bit):
        pass

    copy = torch.ops.aten.copy_.default
    other_copy = Moment._ATEN_OP_TABLE[Moment][copy]

    @Moment.implements(copy)
    def _(func: Any, types: Any, args: tuple[Any, ...], kwargs: Any) -> Any:
        moment, values = args[0], args[1]
        if not isinstance(moment, Moment) or isinstance(values, OptimState8bit) or values.device.type != "cpu":
            return other_copy(func, types, args, kwargs)
        scaled, scale = scale_tensor(values, moment.block_size)
        # torchao's own search through the 256 values, for a GPU's compiler, takes a CPU 100 times as long as AdamW.
        moment.codes.copy_(_codes_of_halves(moment.signed).take(scaled.half().view(torch.int16).long() + 2**15))
        moment.scale.copy_(scale)
        return moment

    return AdamW8bit, Moment


@cache
def _codes_of_halves(signed: bool) -> Tensor:
    """Code of the nearest of 256 values, for each number in half precision in the order of its bits."""
    from torchao.optim.quant_utils import create_dynamic_map

    values = torch.tensor(create_dynamic_map(signed))
    halves = torch.arange(-(2**15), 2**15).to(torch.int16).view(torch.float16).float().nan_to_num(0)
    return torch.bucketize(halves, (values[1:] + values[:-1]) / 2, right=True).to(torch.uint8)


def empty_moments(optimizer: torch.optim.Optimizer, parameter: nn.Parameter) -> dict[str, Tensor]:
    """Return an optimiser's empty state of a parameter, to be filled from a saved one."""
    if isinstance(optimizer, torch.optim.AdamW):  # moments have the memory layout of their parameter
        zeros = {key: torch.zeros_like(parameter) for key in ("exp_avg", "exp_avg_sq")}
        return {"step": torch.zeros((), device=parameter.device), **zeros}
    buffer = cast("Any", optimizer)._new_buffer
    return {"step": torch.zeros(()), "exp_avg": buffer(parameter, True), "exp_avg_sq": buffer(parameter, False)}


def stored_parts(moment: Tensor) -> dict[str, Tensor]:
    """The tensors that a moment consists of, sharing its memory, by what is added to its name: codes and scales of one in 8 bits."""
    if not hasattr(moment, "codes"):
        return {"": moment}
    eight_bits = cast("Any", moment)
    return {".codes": eight_bits.codes, ".scale": eight_bits.scale}


def _saves_memory(config: TrainerConfig) -> bool:
    return config.weights == "bf16" or config.optimizer.moments == "8bit"


def require_one_process(config: TrainerConfig, others: Mapping[str, bool]) -> None:
    """Raises: ConfigError: several processes share a run that is set up to fit one card, by its trainer or ``others``."""
    asked = {
        "trainer.weights": config.weights == "bf16",
        "trainer.optimizer.moments": config.optimizer.moments == "8bit",
        "trainer.average": config.average == "host",
        **others,
    }
    if processes()[1] > 1 and any(asked.values()):
        raise ConfigError(
            "What saves memory on one card is not for several processes, which share weights and moments out",
            where=", ".join(name for name, wanted in asked.items() if wanted), expected="one process",
            got=f"{processes()[1]} processes", next_step="leave these settings out, or start the training without torchrun",
        )  # fmt: skip


def set_learning_rate(slot: dict[str, Any], rate: float) -> None:
    """Set the rate of an optimiser's parameter group."""
    if isinstance(slot["lr"], Tensor):
        slot["lr"].fill_(rate)
    else:
        slot["lr"] = rate


def clip_gradients(parameters: Sequence[nn.Parameter], most: float) -> Tensor:
    """Scale gradients whose common norm is above ``most`` down to it, and return the norm, in float32 whatever they are in."""
    gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
    if all(gradient.dtype == torch.float32 for gradient in gradients):
        return nn.utils.clip_grad_norm_(parameters, most)
    norms = [torch.linalg.vector_norm(gradient, dtype=torch.float32) for gradient in gradients]
    norm = torch.linalg.vector_norm(torch.stack(norms))
    nn.utils.clip_grads_with_norm_(parameters, most, norm)
    return norm


def update_weights(optimizer: torch.optim.Optimizer, config: TrainerConfig, step: int) -> None:
    """The optimiser's step; parameters without a gradient stay as they are. Then gradients make room.

    Weights in bfloat16 are rounded at random, by numbers that depend on the seed and the step alone.
    """
    if not _saves_memory(config):
        optimizer.step()
    else:
        device = torch.device(config.device)
        digest = hashlib.blake2b(f"rounding/{config.seed}/{step}".encode(), digest_size=8).digest()
        # Compiling takes a compiler and, on a CPU, longer than it saves.
        stance = "force_eager" if device.type == "cpu" else "default"
        with torch.random.fork_rng([] if device.type == "cpu" else [device]), torch.compiler.set_stance(stance):
            torch.manual_seed(int.from_bytes(digest) >> 1)
            cast("Any", optimizer).step()
    optimizer.zero_grad(set_to_none=True)
