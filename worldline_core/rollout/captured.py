"""Passes of a model recorded once on a GPU and replayed as one CUDA graph.

A small model's kernels end sooner than Python launches the next ones; a graph launches all of a block's at once. What a graph
reads and writes stays at its place in memory: inputs are copied into buffers of its own, the window of the cache among them, and
results are copied out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from worldline_core.errors import ConfigError
from worldline_core.model.block_causal_attention import KVCache

Replay = Callable[[], None]
Passes = Callable[..., Sequence[Tensor]]
"""``passes(cache, *tensors, **settings)``: tensors of a cache (or None), tensors (or None), and settings that never change."""
Run = Callable[..., Sequence[Tensor]]
"""``run(passes, cache, *tensors, **settings)``: what these passes give."""


def run_now(passes: Passes, cache: KVCache | None, *tensors: Tensor | None, **settings: object) -> Sequence[Tensor]:
    """Run the passes without recording them."""
    return passes(cache, *tensors, **settings)


class Captured:
    """Runs passes from their recordings, one for every form of their inputs (shapes, window of the cache, settings).

    Args:
        record: called with a function that computes results from buffers; runs it, and returns a function that runs it
            again and the buffers of its results. CUDA graphs unless given.

    Raises:
        ConfigError: the device is no GPU.
    """

    def __init__(
        self,
        device: str,
        record: Callable[[Callable[[], Sequence[Tensor]]], tuple[Replay, Sequence[Tensor]]] | None = None,
    ) -> None:
        if record is None and torch.device(device).type != "cuda":
            raise ConfigError(
                "Only a GPU's work can be captured", where="captured", expected="device: cuda", got=device,
                next_step="leave captured out: a CPU runs the same passes without it",
            )  # fmt: skip
        self._record = record or CudaGraphs(device)
        self._recorded: dict[object, tuple[list[Tensor], Replay, Sequence[Tensor]]] = {}

    def __call__(
        self, passes: Passes, cache: KVCache | None, *tensors: Tensor | None, **settings: object
    ) -> Sequence[Tensor]:
        given, window = [], ()
        if cache is not None:
            cache.map(lambda tensor: given.append(tensor) or tensor)
            window = tuple(block.frames for block in cache.window.blocks)
        given += [tensor for tensor in tensors if tensor is not None]
        shapes = tuple((tuple(tensor.shape), tensor.dtype) for tensor in given)
        form = (passes, shapes, window, tuple(tensor is None for tensor in tensors), tuple(settings.items()))
        if form not in self._recorded:
            buffers = [tensor.clone() for tensor in given]
            places = iter(buffers)
            held = None if cache is None else cache.map(lambda _: next(places))
            inputs = [None if tensor is None else next(places) for tensor in tensors]

            def work() -> Sequence[Tensor]:
                # A window remembers its rotated keys: every run takes a new one over the same buffers.
                return passes(None if held is None else held.map(lambda tensor: tensor), *inputs, **settings)

            self._recorded[form] = (buffers, *self._record(work))
        buffers, replay, results = self._recorded[form]
        for buffer, tensor in zip(buffers, given, strict=True):
            buffer.copy_(tensor)
        replay()
        return [result.clone() for result in results]


class CudaGraphs:
    """Records work as CUDA graphs, which share the memory of what they compute in between: one runs at a time."""

    def __init__(self, device: str) -> None:
        self._device = torch.device(device)
        self._pool = torch.cuda.graph_pool_handle()

    def __call__(self, work: Callable[[], Sequence[Tensor]]) -> tuple[Replay, Sequence[Tensor]]:
        with torch.cuda.device(self._device):
            beside = torch.cuda.Stream()
            beside.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(beside):
                for _ in range(2):  # libraries choose kernels and take their workspaces at the first calls
                    work()
            torch.cuda.current_stream().wait_stream(beside)
            graph = torch.cuda.CUDAGraph()
            # Another thread may be decoding the block before: its calls must not end this recording.
            with torch.cuda.graph(graph, pool=self._pool, capture_error_mode="thread_local"):
                results = work()
        return graph.replay, results
