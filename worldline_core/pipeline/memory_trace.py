"""Bytes held and operations done by a computation, from the shapes of its tensors alone.

torch's MemTracker gives the same bytes within 0.4 % for a single pass, but refuses modules that are called several times before a
backward pass, as the tokenizers and Stage III do.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterable, Mapping
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor, nn
from torch._guards import detect_fake_mode
from torch._subclasses.fake_tensor import FakeTensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import flop_registry, sdpa_backward_flop_count, sdpa_flop_count

_META = torch.device("meta")
WHOLE = 8
"""Most layers of a model that is traced as it is."""
SHALLOW = (4, 5)
"""Depths that the line of a deeper model goes through: with fewer layers its worst moment can be another one."""


class Held(NamedTuple):
    """Most bytes held at once until the loss is there, and from then on, without gradients of parameters; operations of both."""

    forward: float
    backward: float
    operations: float = 0.0


class _Result(NamedTuple):
    """What an operation returns: a value, one of its arguments, or a tensor like ``like``, on an argument's storage or its own."""

    value: Any = None
    argument: int | None = None
    like: tuple[torch.Size, tuple[int, ...], torch.dtype, int, torch.device] | None = None


class _Known(NamedTuple):
    results: list[_Result]
    form: type | None
    """Of several results; None: a single one."""
    operations: float


class _Tracker(TorchDispatchMode):
    """Follows the storages that a computation allocates and frees, and counts its operations.

    Decisions that depend on values (a loss is finite, a text is padded) see 0.5, 1 or True. What an operation returns for tensors of
    some shapes is kept for the next time, which costs a third of what FakeTensorMode's own memory of it does.
    """

    _known: ClassVar[dict[tuple[Any, ...], _Known]] = {}

    def __init__(self) -> None:
        super().__init__()
        self.live = self.most = 0
        self.operations = 0.0
        self._shapes: Any = detect_fake_mode()
        self._followed: dict[int, weakref.ref[torch.UntypedStorage]] = {}
        self._fields: dict[torch.device, dict[str, Any]] = {}

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False  # nothing is compiled here, and the guard against it takes a tenth of the time

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        if func is torch.ops.prim.device.default:
            return args[0].fake_device
        if func is torch.ops.aten._local_scalar_dense.default:
            return True if args[0].dtype == torch.bool else 0.5 if args[0].is_floating_point() else 1
        given: list[FakeTensor] = []
        key: list[Any] = [func]
        repeatable = _describe((*args, *(kwargs or {}).items()), given, key) and torch.Tag.inplace_view not in func.tags
        if (known := self._known.get(tuple(key)) if repeatable else None) is not None:
            self.operations += known.operations
            values = [self._again(result, given) for result in known.results]
            return values[0] if known.form is None else known.form(values)
        returned = func(*args, **(kwargs or {}))
        form = type(returned) if isinstance(returned, tuple | list) else None
        results = [self._result(value, given) for value in (returned if form else (returned,))]
        known = _Known(results, form, _operations(func, args, kwargs or {}, returned))
        self.operations += known.operations
        if repeatable:
            self._known[tuple(key)] = known
        return returned

    def _result(self, value: Any, given: list[FakeTensor]) -> _Result:
        if not isinstance(value, FakeTensor):
            return _Result(value)
        if (same := next((n for n, tensor in enumerate(given) if tensor is value), None)) is not None:
            return _Result(argument=same)
        key = value.untyped_storage()._cdata
        shared = next((n for n, tensor in enumerate(given) if tensor.untyped_storage()._cdata == key), None)
        if shared is None:
            self._follow(value.untyped_storage())
        like = (value.shape, value.stride(), value.dtype, int(value.storage_offset()), value.fake_device)
        return _Result(argument=shared, like=like)

    def _again(self, result: _Result, given: list[FakeTensor]) -> Any:
        if result.like is None:
            return result.value if result.argument is None else given[result.argument]
        shape, stride, dtype, offset, device = result.like
        # What FakeTensor's own constructor does, in a third of its time.
        with torch._C._DisableTorchDispatch():
            tensor = torch.empty_strided(shape, stride, dtype=dtype, device=_META)
            if result.argument is not None:
                tensor.set_(given[result.argument].untyped_storage(), offset, shape, stride)
            fake = Tensor._make_subclass(
                FakeTensor, tensor, False, dispatch_device=True, device_for_backend_keys=device
            )
        if device not in self._fields:
            self._fields[device] = vars(FakeTensor(self._shapes, tensor, device))
        vars(fake).update(self._fields[device])
        if result.argument is None:
            self._follow(fake.untyped_storage())
        return fake

    def _follow(self, storage: torch.UntypedStorage) -> None:
        key, size = storage._cdata, storage.nbytes()
        if key not in self._followed:
            self.live += size
            self.most = max(self.most, self.live)
            self._followed[key] = weakref.ref(storage, lambda _: self._freed(key, size))

    def _freed(self, key: int, size: int) -> None:
        del self._followed[key]
        self.live -= size


def _describe(values: Iterable[Any], given: list[FakeTensor], key: list[Any]) -> bool:
    """Append tensors to ``given``, and to ``key`` what the result depends on; False where that is more than shapes."""
    for value in values:
        if isinstance(value, FakeTensor):
            given.append(value)
            key.append((value.dtype, value.shape, value.stride(), value.storage_offset(), value.fake_device))
        elif isinstance(value, list | tuple):
            key.append(len(value))
            if not _describe(value, given, key):
                return False
        elif isinstance(value, Tensor):
            return False
        else:
            key.append((type(value), value))
    return True


def _operations(func: Any, args: tuple[Any, ...], kwargs: Mapping[str, Any], returned: Any) -> float:
    """Multiplications and additions of products of matrices, convolutions and attention."""
    packet = func._overloadpacket
    if packet is torch.ops.aten._scaled_dot_product_flash_attention_for_cpu:
        return sdpa_flop_count(*(value.shape for value in args[:3]))
    if packet is torch.ops.aten._scaled_dot_product_flash_attention_for_cpu_backward:
        return sdpa_backward_flop_count(*(value.shape for value in args[:4]))
    count = flop_registry.get(packet)
    return 0.0 if count is None else count(*args, **kwargs, out_val=returned)


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
