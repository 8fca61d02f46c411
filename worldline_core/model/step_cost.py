"""What a computation costs without doing it: bytes held at once, floating-point operations, the least time on a card.

The computation itself runs, on tensors that have shapes and no values. What it costs is therefore read from the code that
will run, not from formulas beside it. Attention is counted as the fused kernels do it: its scores are never stored.
"""

from __future__ import annotations

import weakref
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensor, FakeTensorMode, in_kernel_invocation_manager
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_iter
from torch.utils.flop_counter import flop_registry, sdpa_backward_flop_count, sdpa_flop_count

from worldline_core.model.checkpoint import SINGLE_PRECISION

_ATTENTION = torch.ops.aten._scaled_dot_product_flash_attention_for_cpu
_ATTENTION_BACKWARD = torch.ops.aten._scaled_dot_product_flash_attention_for_cpu_backward
_CPU = torch.device("cpu")
_TRACED_LAYERS = (4, 8)
"""Deeper models are traced at these depths: their layers are equal, so that everything is a straight line from there on."""
_TRACED_LAYERS_FORWARD = (2, 3)
"""The same without a way back: nothing but caches is held of a layer while the next one is computed."""


@dataclass(frozen=True)
class Card:
    """A processor by its data sheet. Attributes: operations per second (dense), bytes per second, bytes of memory."""

    flops: float
    bandwidth: float
    memory: float


CARDS = {
    "A100": Card(312e12, 2.0e12, 80e9),
    "H100": Card(989e12, 3.35e12, 80e9),
    "H200": Card(989e12, 4.8e12, 141e9),
    "B200": Card(2250e12, 8.0e12, 180e9),
}
"""bf16 without sparsity, SXM boards (NVIDIA data sheets)."""


@dataclass(frozen=True)
class StepCost:
    """What one computation costs.

    Attributes:
        activations: most bytes held at once of what it makes, gradients of parameters apart.
        kept: bytes held when the loss is there and the way back begins.
        gradients: bytes of the parameters' gradients at its end.
        peak: most bytes of both together.
        ahead, back: the part of ``activations`` until the loss is there, and from there on.
        products: how many matrix products, convolutions and attentions of (operations, bytes read and written) it does.
    """

    activations: float = 0.0
    kept: float = 0.0
    gradients: float = 0.0
    peak: float = 0.0
    ahead: float = 0.0
    back: float = 0.0
    products: Counter[tuple[float, float]] = field(default_factory=Counter[tuple[float, float]])

    @property
    def flops(self) -> float:
        """Floating-point operations, two a multiplication and addition."""
        return sum(count * flops for (flops, _), count in self.products.items())

    @property
    def bytes(self) -> float:
        """Bytes that the products read and write; everything else can be fused into them."""
        return sum(count * moved for (_, moved), count in self.products.items())

    def floor_seconds(self, card: Card) -> float:
        """Least time on a card: each product at its peak rate or at the memory's bandwidth, whichever takes longer."""
        return sum(
            count * max(flops / card.flops, moved / card.bandwidth) for (flops, moved), count in self.products.items()
        )

    def then(self, other: StepCost) -> StepCost:
        """Both, one after the other."""
        return StepCost(
            max(self.activations, other.activations),
            max(self.kept, other.kept),
            max(self.gradients, other.gradients),
            max(self.peak, other.peak),
            max(self.ahead, other.ahead),
            max(self.back, other.back),
            self.products + other.products,
        )

    def times(self, count: float) -> StepCost:
        """The same computation several times, one after the other."""
        products = Counter({key: value * count for key, value in self.products.items()})
        return replace(self, products=products)


class _Meter(TorchDispatchMode):
    """Follows the storages that a computation makes and lets go of, and counts its products.

    Decisions that depend on values (a loss is finite, a text is padded) see 0.5, 1 or True.
    """

    def __init__(self) -> None:
        super().__init__()
        self.live = self.gradients = self.activations = self.peak = 0
        self.products: Counter[tuple[float, float]] = Counter()
        self._storages: dict[int, weakref.ref[Any]] = {}

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        kwargs = kwargs or {}
        if func is torch.ops.prim.device.default:
            return args[0].device
        if func is torch.ops.aten._local_scalar_dense.default:
            return True if args[0].dtype == torch.bool else 0.5 if args[0].is_floating_point() else 1
        kind, mode = _kind(func), _mode_of(args)
        if mode is None or kind == "other":
            return self._done(func, args, kwargs)[0]
        if kind == "views":
            with in_kernel_invocation_manager(mode):
                found = func(*args, **kwargs)
            one = isinstance(found, Tensor)
            return FakeTensor(mode, found, _CPU) if one else [FakeTensor(mode, part, _CPU) for part in found]
        try:
            key = func, _looks(args), _looks(tuple(kwargs.items()))
            outcome = _OUTCOMES.get(key)
        except (_HasValueError, TypeError):  # TypeError: an argument that cannot be looked up
            return self._done(func, args, kwargs)[0]
        if outcome is not None:
            return self._repeated(outcome, mode)
        result, product = self._done(func, args, kwargs)
        parts = result if isinstance(result, (list, tuple)) else [result]
        own = {id(part.untyped_storage()) for part in parts if _has_its_own_storage(part)}
        if len(own - {id(tensor.untyped_storage()) for tensor in _tensors((args, kwargs))}) == len(parts):
            looks = [(part.shape, part.stride(), part.dtype) for part in parts]
            _OUTCOMES[key] = _Outcome(product, looks, None if parts is not result else type(result))
        return result

    def _done(self, func: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> tuple[Any, tuple[float, float] | None]:
        """The result of an operation, followed, and the product that it is, if it is one."""
        result = func(*args, **kwargs)
        flops, product = _operations(func._overloadpacket, args, kwargs, result), None
        if flops:
            product = float(flops), float(sum(map(_nbytes, _tensors((args, kwargs, result)))))
            self.products[product] += 1
        given = {id(tensor.untyped_storage()) for tensor in _tensors((args, kwargs))}
        for tensor in _tensors(result):
            if id(tensor.untyped_storage()) not in given:  # else it is a view, or was changed in place
                self._follow(tensor)
        return result, product

    def _repeated(self, outcome: _Outcome, mode: FakeTensorMode) -> Any:
        """As `_done`, of an operation whose outcome is known."""
        if outcome.product is not None:
            self.products[outcome.product] += 1
        with torch._C._DisableTorchDispatch():
            made = [
                torch.empty_strided(shape, stride, dtype=dtype, device="meta") for shape, stride, dtype in outcome.looks
            ]
        tensors = [FakeTensor(mode, tensor, _CPU) for tensor in made]
        for tensor in tensors:
            self._follow(tensor)
        return tensors[0] if outcome.container is None else outcome.container(tensors)

    def _follow(self, tensor: Tensor) -> None:
        storage = tensor.untyped_storage()
        key, size = id(storage), storage.nbytes()
        if key in self._storages:
            return

        def freed(_: object) -> None:
            self.live -= size
            self._storages.pop(key, None)

        self._storages[key] = weakref.ref(storage, freed)
        self.live += size
        self.activations = max(self.activations, self.live)
        self.peak = max(self.peak, self.live + self.gradients)

    def is_gradient(self, parameter: Tensor) -> None:
        """Count a parameter's new gradient as such."""
        if parameter.grad is None:
            return
        storage = parameter.grad.untyped_storage()
        if self._storages.pop(id(storage), None) is not None:
            self.live -= storage.nbytes()
            self.gradients += storage.nbytes()


class _HasValueError(Exception):
    """A tensor is known by more than its shape."""


@dataclass(frozen=True)
class _Outcome:
    """What an operation makes of arguments that look so: shape, strides and dtype of each new tensor."""

    product: tuple[float, float] | None
    looks: list[tuple[torch.Size, tuple[int, ...], torch.dtype]]
    container: type | None


_OUTCOMES: dict[Any, _Outcome] = {}
"""Layers and steps repeat the same operations thousands of times: torch works out what they make once."""


@cache
def _kind(func: Any) -> Literal["makes", "views", "other"]:
    """Whether an operation's results are new tensors, share their argument's storage, or it does anything else."""
    schema = getattr(func, "_schema", None)
    if schema is None or schema.is_mutable:
        return "other"
    shared = func is torch.ops.aten._unsafe_view.default or any(one.alias_info is not None for one in schema.returns)
    return "views" if shared else "makes"


def _mode_of(args: tuple[Any, ...]) -> FakeTensorMode | None:
    """The mode of the first argument, where that is a tensor, or several, without values."""
    first = args[0] if args else None
    first = first[0] if isinstance(first, (list, tuple)) and first else first
    return first.fake_mode if type(first) is FakeTensor and first.constant is None else None


def _looks(value: Any) -> Any:
    """All that the outcome of an operation depends on.

    Raises: _HasValueError for a tensor that torch remembers a value of, or that may stand for a number.
    """
    if type(value) is FakeTensor:
        if value.ndim == 0 or value.constant is not None:
            raise _HasValueError
        return value.shape, value.stride(), value.dtype
    if isinstance(value, Tensor):
        raise _HasValueError
    return tuple(map(_looks, value)) if isinstance(value, (list, tuple)) else (type(value), value)


def _has_its_own_storage(value: Any) -> bool:
    return type(value) is FakeTensor and value.constant is None and value.untyped_storage().nbytes() == _nbytes(value)


def _operations(packet: Any, args: Any, kwargs: Any, result: Any) -> float:
    if packet == _ATTENTION:
        return sdpa_flop_count(*(tensor.shape for tensor in args[:3]))
    if packet == _ATTENTION_BACKWARD:
        return sdpa_backward_flop_count(*(tensor.shape for tensor in args[:4]))
    return flop_registry[packet](*args, **kwargs, out_val=result) if packet in flop_registry else 0


def _tensors(tree: Any) -> Iterator[Tensor]:
    return (leaf for leaf in tree_iter(tree) if isinstance(leaf, Tensor))


def _nbytes(tensor: Tensor) -> int:
    return tensor.numel() * tensor.element_size()


@contextmanager
def without_values() -> Iterator[None]:
    """Within it, tensors and modules take no memory: they have shapes, dtypes and the paths of a CPU, and no values."""
    with FakeTensorMode():
        yield


def cost_of(work: Callable[[], Tensor | None], parameters: Iterable[nn.Parameter] = ()) -> StepCost:
    """What ``work`` costs; with `parameters`, and the backward pass of the loss that it returns.

    Call it within `without_values`; what exists before (the weights) is not counted.
    """
    meter = _Meter()
    hooks = [one.register_post_accumulate_grad_hook(meter.is_gradient) for one in parameters if one.requires_grad]
    with meter:
        loss = work()
        kept, ahead, meter.activations = meter.live, meter.activations, meter.live
        if hooks and loss is not None:
            loss.backward()
    for hook in hooks:
        hook.remove()
    back = meter.activations
    return StepCost(max(ahead, back), kept, meter.gradients, meter.peak, ahead, back, meter.products)


def cost_at_depth(trace: Callable[[int], StepCost], layers: int, *, forward_only: bool = False) -> StepCost:
    """What ``trace(layers)`` would give; deep models are traced at two small depths, and the line is continued.

    Their ``peak`` is the sum of both parts, which is at most too high: where it lies between them depends on the depth.
    """
    shallow, deep = _TRACED_LAYERS_FORWARD if forward_only else _TRACED_LAYERS
    if layers <= deep:
        return trace(layers)
    first, second = trace(shallow), trace(deep)
    share = (layers - shallow) / (deep - shallow)

    def line(a: float, b: float) -> float:
        return a + (b - a) * share

    keys = first.products.keys() | second.products.keys()
    products = Counter({key: line(first.products[key], second.products[key]) for key in keys})
    # Shallow models may hold most before the loss is there, deep ones after: each of the two is a line.
    ahead, back = line(first.ahead, second.ahead), line(first.back, second.back)
    activations, gradients = max(ahead, back), line(first.gradients, second.gradients)
    kept = line(first.kept, second.kept)
    return StepCost(activations, kept, gradients, activations + gradients, ahead, back, products)


def in_bfloat16(model: nn.Module) -> None:
    """Give a model weights in bfloat16, but for those that stay in float32, as shards and rollouts have them."""
    for name, module in model.named_modules():
        for key, value in list(module.named_parameters(recurse=False)):
            if not f"{name}.".startswith(SINGLE_PRECISION):
                module.register_parameter(key, nn.Parameter(value.detach().bfloat16(), value.requires_grad))
