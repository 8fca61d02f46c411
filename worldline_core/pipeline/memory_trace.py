"""Bytes held and operations done by a computation, from the shapes of its tensors alone.

torch's MemTracker gives the same bytes within 0.4 % for a single pass, but refuses modules that are called several times before a
backward pass, as the tokenizers and Stage III do.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import torch
from torch import nn
from torch._subclasses.fake_tensor import FakeTensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import flop_registry

WHOLE = 8
"""Most layers of a model that is traced as it is."""
SHALLOW = (4, 5)
"""Depths that the line of a deeper model goes through: with fewer layers its worst moment can be another one."""
_ATEN = torch.ops.aten
_OPERATIONS: dict[Any, Callable[..., float]] = {
    **flop_registry,  # which knows a card's attention, but not a processor's
    _ATEN._scaled_dot_product_flash_attention_for_cpu: flop_registry[_ATEN._scaled_dot_product_flash_attention],
    _ATEN._scaled_dot_product_flash_attention_for_cpu_backward: flop_registry[
        _ATEN._scaled_dot_product_flash_attention_backward
    ],
}


class Held(NamedTuple):
    """Most bytes held at once until the loss is there, and from then on, without gradients of parameters; operations of both."""

    forward: float
    backward: float
    operations: float = 0.0


class _Tracker(TorchDispatchMode):
    """Follows the storages that a computation allocates and frees, and counts its operations.

    Decisions that depend on values (a loss is finite, a text is padded) see 0.5, 1 or True.
    """

    def __init__(self) -> None:
        super().__init__()
        self.live = self.most = 0
        self.operations = 0.0
        self._followed: set[int] = set()

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False  # nothing is compiled here, and the guard against it takes a tenth of the time

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        if func is torch.ops.prim.device.default:
            return args[0].fake_device
        if func is _ATEN._local_scalar_dense.default:
            return True if args[0].dtype == torch.bool else 0.5 if args[0].is_floating_point() else 1
        returned = func(*args, **(kwargs or {}))
        if (count := _OPERATIONS.get(func._overloadpacket)) is not None:
            self.operations += count(*args, **(kwargs or {}), out_val=returned)
        given = {storage._cdata for storage in _storages((*args, *(kwargs or {}).values()))}
        for storage in _storages(returned if isinstance(returned, tuple | list) else (returned,)):
            if storage._cdata not in self._followed and storage._cdata not in given:
                self._followed.add(storage._cdata)
                self.live += storage.nbytes()
                self.most = max(self.most, self.live)
                weakref.finalize(storage, self._freed, storage._cdata, storage.nbytes())
        return returned

    def _freed(self, key: int, size: int) -> None:
        self._followed.remove(key)
        self.live -= size


def _storages(values: Iterable[Any]) -> Iterator[torch.UntypedStorage]:
    """Storages of the tensors among values and lists of them."""
    for value in values:
        if isinstance(value, FakeTensor):
            yield value.untyped_storage()
        elif isinstance(value, list | tuple):
            yield from _storages(value)


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
    return Held(forward, tracker.most, tracker.operations)


def extrapolated(trace: Callable[[int], Held], layers: int) -> Held:
    """``trace(layers)``; of deep models by a straight line through two shallow ones, for layers are equal."""
    if layers <= WHOLE:
        return trace(layers)
    first, second = (trace(depth) for depth in SHALLOW)
    return Held(*(a + (b - a) * (layers - SHALLOW[0]) for a, b in zip(first, second, strict=True)))
