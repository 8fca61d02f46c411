"""Weights are cast as they are read: no copy of a model in another precision ever exists."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch.profiler import ProfilerActivity, profile

from worldline_core.model.checkpoint import load_checkpoint, save_checkpoint


def most_bytes(recorded: profile) -> int:
    """Most bytes that the allocator had handed out at once."""
    results: Any = recorded.profiler.kineto_results if recorded.profiler is not None else None
    live = most = 0
    for _, size in sorted((e.start_ns(), e.nbytes()) for e in results.events() if e.name() == "[memory]"):
        live += size
        most = max(most, live)
    return most


def test_bfloat16_weights_are_read_without_a_copy_in_float32(tmp_path: Path, make_model: Callable) -> None:
    model = make_model(hidden_size=256, intermediate_size=1024, num_layers=4)
    save_checkpoint(tmp_path, model, kind="base", action_contract=None)
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as recorded:
        loaded, _ = load_checkpoint(tmp_path, dtype=torch.bfloat16)
    own = sum(parameter.nbytes for parameter in loaded.parameters())
    largest = max(parameter.numel() for parameter in loaded.parameters())
    mapped = (tmp_path / "model.safetensors").stat().st_size
    # Besides the weights and the mapped file: one weight at a time in float32, and its mask, to see whether it is finite.
    assert own <= most_bytes(recorded) <= own + mapped + 10 * largest
    assert mapped + 10 * largest < 2 * own  # a copy in float32 would not go unseen
    assert loaded.proj_in.weight.dtype == torch.bfloat16
    assert loaded.time_embedder.linear_1.weight.dtype == torch.float32
    stored = model.time_embedder.linear_1.weight.half().float()
    assert torch.equal(loaded.time_embedder.linear_1.weight, stored)
