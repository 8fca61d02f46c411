"""Bytes held and operations done by a computation, from the shapes of its tensors alone.

torch's MemTracker gives the same bytes within 0.4 % for a single pass, but refuses modules that are called several times before a
backward pass, as the tokenizers and Stage III do.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor, nn
from torch._guards import detect_fake_mode
from torch._subclasses.fake_tensor import FakeTensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import flop_registry

WHOLE = 8
"""Most layers of a model that is traced as it is."""
SHALLOW = (2, 3)
"""Depths that the line of a deeper model goes through: with one layer its worst moment can be another one."""
_ATEN: Any = torch.ops.aten
_DEVICE: Any = torch.ops.prim.device.default
_FLASH = "_scaled_dot_product_flash_attention"
_COUNTS: dict[Any, Callable[..., int]] = flop_registry | {
    getattr(_ATEN, f"{_FLASH}_for_cpu{way}"): flop_registry[getattr(_ATEN, _FLASH + way)] for way in ("", "_backward")
}


class Held(NamedTuple):
    """Most bytes held at once until the loss is there, and from then on, without gradients of parameters; operations of both:
    multiplications and additions of products of matrices, convolutions and attention."""

    forward: float
    backward: float
    operations: float = 0.0


class _Tracker(TorchDispatchMode):
    """Follows the storages that a computation allocates and frees, and counts its operations.

    Decisions that depend on values (a loss is finite, a text is padded) see 0.5, 1 or True. How to make what an operation returns for
    tensors of some shapes is kept for the next time: tracing takes more than twice as long with FakeTensorMode's own memory.
    """

    _known: ClassVar[dict[Any, tuple[list[Callable[[_Tracker, list[FakeTensor]], Any]], bool, int]]] = {}

    def __init__(self) -> None:
        super().__init__()
        self.live = self.most = self.operations = 0
        mode: Any = detect_fake_mode()
        # Fields that FakeTensor's constructor gives to a tensor on a device; the constructor itself takes three times as long.
        self._fields = cache(lambda device: vars(FakeTensor(mode, torch.empty(0, device="meta"), device)))

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False  # nothing is compiled here, and the guard against it takes a tenth of the time

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        if func is _DEVICE:  # more than half of all calls
            return args[0].fake_device
        if func is _ATEN._local_scalar_dense.default:
            return True if args[0].dtype == torch.bool else 0.5 if args[0].is_floating_point() else 1
        kwargs, given = kwargs or {}, list[FakeTensor]()
        key = func, _described((*args, *kwargs.items()), given)
        if (known := self._known.get(key)) is not None:
            makers, several, operations = known
            self.operations += operations
            values = [make(self, given) for make in makers]
            return values if several else values[0]
        returned = func(*args, **kwargs)
        several, count = isinstance(returned, list | tuple), _COUNTS.get(func._overloadpacket)
        makers = [self._maker(value, given) for value in (returned if several else (returned,))]
        operations = 0 if count is None else count(*args, **kwargs, out_val=returned)
        self.operations += operations
        if torch.Tag.inplace_view not in func.tags:
            self._known[key] = makers, several, operations
        return returned

    def _maker(self, value: Any, given: list[FakeTensor]) -> Callable[[_Tracker, list[FakeTensor]], Any]:
        """Return a function that makes a result again: a value that is no tensor, an argument, a view of one, or a new tensor."""
        if not isinstance(value, FakeTensor):
            return lambda *_: value
        if (same := next((n for n, one in enumerate(given) if one is value), None)) is not None:
            return lambda _, given: given[same]
        storage = value.untyped_storage()._cdata
        shared = next((n for n, one in enumerate(given) if one.untyped_storage()._cdata == storage), None)
        if shared is None:
            self._hold(value.untyped_storage())
        shape, stride, offset, dtype = value.shape, value.stride(), value.storage_offset(), value.dtype
        device = value.fake_device

        def make(tracker: _Tracker, given: list[FakeTensor]) -> FakeTensor:
            with torch._C._DisableTorchDispatch():
                tensor = torch.empty_strided(shape, stride, dtype=dtype, device="meta")
                if shared is not None:
                    tensor.set_(given[shared].untyped_storage(), offset, shape, stride)
                made = Tensor._make_subclass(
                    FakeTensor, tensor, False, dispatch_device=True, device_for_backend_keys=device
                )
            vars(made).update(tracker._fields(device))
            if shared is None:
                tracker._hold(made.untyped_storage())
            return made

        return make

    def _hold(self, storage: torch.UntypedStorage) -> None:
        self._add(storage.nbytes())
        weakref.finalize(storage, self._add, -storage.nbytes())

    def _add(self, size: int) -> None:
        self.live += size
        self.most = max(self.most, self.live)


def _described(value: Any, given: list[FakeTensor]) -> Any:
    """Key of an argument: all that an operation's result depends on. Its tensors are appended to ``given``."""
    if isinstance(value, FakeTensor):
        given.append(value)
        return value.dtype, value.shape, value.stride(), value.storage_offset(), value.fake_device
    if isinstance(value, list | tuple):
        return tuple(_described(one, given) for one in value)
    return type(value), value


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


def extrapolated(
    figures: Callable[[int], Mapping[str, float]], layers: int, shallow: tuple[int, int]
) -> dict[str, float]:
    """Return ``figures(layers)``. A deep model's are extrapolated by a straight line through two adjacent shallow depths, because
    its layers are equal."""
    if layers <= WHOLE:
        return {**figures(layers)}
    first, second = (figures(depth) for depth in shallow)
    return {name: value + (second[name] - value) * (layers - shallow[0]) for name, value in first.items()}
