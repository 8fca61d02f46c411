"""Attention of one layer of a teacher-forced pass in four forms, and projections one by one beside fused ones.

    python benchmarks/attention.py [--device cuda] [--dtype bfloat16] [--views 3] [--key-heads 8]

- alike: what the model does, one call for all blocks with windows of one length;
- loop: one call a block;
- mask: one call with the dense mask of the whole sequence (small size);
- flex: FlexAttention with the block mask, compiled (on a GPU only).

Sizes: the small world (65 frames, batch 6), and the full size (129 frames at 480 x 640, 900 tokens a latent frame of three
views, head size 128, four query heads to a key head), of which a CPU takes one view and one key head by default.
"""

from __future__ import annotations

import argparse
import itertools
import json
import time
from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from worldline_core.model.block_causal_attention import TeacherForcingAttention, window_bounds
from worldline_core.model.layers import grouped_attention
from worldline_core.model.rope import rotate

SINK, RECENT, BLOCK = 1, 3, 4


def seconds(work: Callable[[], object], device: str, repeats: int) -> float:
    """Least processor seconds of a few runs (on a GPU wall seconds): a busy machine does not stretch them."""
    work()
    times = []
    for _ in range(repeats):
        if device == "cuda":
            torch.cuda.synchronize()
        clock = time.process_time if device == "cpu" else time.perf_counter
        start = clock()
        work()
        if device == "cuda":
            torch.cuda.synchronize()
        times.append(clock() - start)
    return min(times)


class Pass:
    """One layer's queries, keys and values of ``[clean blocks 0..k-1, noisy blocks 1..k]``."""

    def __init__(
        self, options: argparse.Namespace, batch: int, frames: int, per_frame: int, heads: int, shared: int, size: int
    ) -> None:
        make = {"device": options.device, "dtype": options.dtype}
        self.sizes = (per_frame, *[BLOCK * per_frame] * ((frames - 1) // BLOCK))
        length = sum(self.sizes[:-1]) + sum(self.sizes[1:])
        self.queries = torch.randn(batch, heads, length, size, **make)
        self.keys, self.values = torch.randn(2, batch, shared, length, size, **make)
        angles = torch.randn(sum(self.sizes), size, device=options.device)
        self.by = (angles.cos(), angles.sin())
        index = torch.arange(len(self.sizes), device=options.device)
        block_of = torch.repeat_interleave(index, torch.tensor(self.sizes, device=options.device))
        self.block = torch.cat((block_of[: sum(self.sizes[:-1])], block_of[self.sizes[0] :]))
        self.noisy = torch.arange(length, device=options.device) >= sum(self.sizes[:-1])

    def visible(self, query: Tensor, key: Tensor) -> Tensor:
        """Whether token ``query`` sees token ``key``."""
        own, other = self.block[query], self.block[key]
        window = ~self.noisy[key] & (other < own) & ((other < SINK) | (other >= own - RECENT))
        return window | ((own == other) & (self.noisy[query] == self.noisy[key]))

    def alike(self) -> Tensor:
        return TeacherForcingAttention(self.by, self.sizes, SINK, RECENT)(0, self.queries, self.keys, self.values, None)

    def loop(self) -> Tensor:
        starts, mixed = [0, *itertools.accumulate(self.sizes)], []
        clean = [(block, starts[block]) for block in range(len(self.sizes) - 1)]
        noisy = [(block, starts[-2] - self.sizes[0] + starts[block]) for block in range(1, len(self.sizes))]
        for block, start in clean + noisy:
            sink, recent = window_bounds(block, SINK, RECENT)
            own = slice(start, start + self.sizes[block])
            parts = (slice(0, starts[sink]), slice(starts[recent], starts[block]), own)
            keys, values = (torch.cat([t[..., part, :] for part in parts], dim=-2) for t in (self.keys, self.values))
            stop = keys.shape[-2]
            rows = (self.by[0][stop - self.sizes[block] : stop], self.by[1][stop - self.sizes[block] : stop])
            keys = rotate(keys, (self.by[0][:stop], self.by[1][:stop]))
            mixed.append(grouped_attention(rotate(self.queries[..., own, :], rows), keys, values))
        return torch.cat(mixed, dim=1)

    def masked(self, mask: Tensor) -> Tensor:
        """As long as `alike`'s, but for the sink's positions, which one set of rotated keys cannot hold."""
        return grouped_attention(self.queries, self.keys, self.values, mask)


def flexible(given: Pass) -> Callable[[], object]:
    from torch.nn.attention.flex_attention import create_block_mask, flex_attention

    def rule(_batch: Tensor, _head: Tensor, query: Tensor, key: Tensor) -> Tensor:
        return given.visible(query, key)

    length = given.queries.shape[2]
    mask = create_block_mask(rule, None, None, length, length, device=given.queries.device.type)
    compiled = torch.compile(flex_attention)
    return lambda: compiled(given.queries, given.keys, given.values, block_mask=mask, enable_gqa=True)


def compared(given: Pass, options: argparse.Namespace, *, dense: bool) -> dict[str, float]:
    difference = float((given.alike().float() - given.loop().float()).abs().max())
    found = {
        name: seconds(work, options.device, options.repeats)
        for name, work in (("alike", given.alike), ("loop", given.loop))
    }
    if dense:
        index = torch.arange(given.queries.shape[2], device=options.device)
        mask = given.visible(index[:, None], index[None, :])[None, None]
        found["mask"] = seconds(lambda: given.masked(mask), options.device, options.repeats)
    if options.device == "cuda":
        found["flex"] = seconds(flexible(given), options.device, options.repeats)
    return (
        found
        | {f"{name}_over_alike": value / found["alike"] for name, value in found.items()}
        | {"alike_less_loop": difference}
    )


def projections(options: argparse.Namespace, tokens: int, width: int, outputs: tuple[int, ...]) -> dict[str, float]:
    """Queries, keys and values (or gate and up) of some tokens: a product each, and one product."""
    make = {"device": options.device, "dtype": options.dtype}
    inputs = torch.randn(tokens, width, **make)
    weights = [torch.randn(size, width, **make) for size in outputs]
    fused = torch.cat(weights)
    apart = seconds(lambda: [F.linear(inputs, weight) for weight in weights], options.device, 3 * options.repeats)
    together = seconds(lambda: F.linear(inputs, fused).split(outputs, dim=-1), options.device, 3 * options.repeats)
    return {"apart": apart, "fused": together, "apart_over_fused": apart / together}


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"))
    parser.add_argument("--dtype", default="float32", choices=("float32", "bfloat16"))
    parser.add_argument("--views", type=int, help="of the full size (default: 3 on a GPU, 1 on a CPU)")
    parser.add_argument("--key-heads", type=int, help="of the full size (default: 8 on a GPU, 1 on a CPU)")
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    options.dtype = getattr(torch, options.dtype)
    on_gpu = options.device == "cuda"
    views, shared = options.views or (3 if on_gpu else 1), options.key_heads or (8 if on_gpu else 1)
    small = Pass(options, 6, 17, 72, 3, 1, 64)
    full = Pass(options, 1, 33, 300 * views, 4 * shared, shared, 128)
    figures = {
        "small": compared(small, options, dense=True),
        "full": compared(full, options, dense=False),
        "small_qkv_of_a_block": projections(options, 288, 192, (192, 64, 64)),
        "small_gate_up_of_a_block": projections(options, 288, 192, (576, 576)),
        "full_qkv_of_a_block": projections(options, 1200 * views, 4096, (4096, 1024, 1024)),
    }
    print(json.dumps(figures, indent=1))


if __name__ == "__main__":
    main()
