"""Passes that are recorded once and replayed: equal to the plain ones, and fit for a CUDA graph."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import pytest
import torch
from pydantic import ValidationError
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from worldline_core.errors import ConfigError
from worldline_core.model.contracts import CAUSAL_SIGMAS, CausalSpec
from worldline_core.model.world_model import WorldModel
from worldline_core.rollout.captured import Captured, Run, run_now
from worldline_core.rollout.rollout_config import RolloutConfig
from worldline_core.rollout.samplers import BlockCausalSimulator, Noise, rollout_full_clip

SPEC = CausalSpec(block_size=2, sink_blocks=1, recent_blocks=1, sigmas=CAUSAL_SIGMAS)
RESIDUAL = {"prediction": "first_frame_residual", "view_embedding": True, "fps": 24.0}
BOTH = [{}, pytest.param(RESIDUAL, marks=pytest.mark.slow)]


def record_here(work: Callable[[], Sequence[Tensor]]) -> tuple[Callable[[], None], Sequence[Tensor]]:
    """What a CUDA graph does, on a CPU: the same work again, on the same buffers, its results in the same places."""
    results = [torch.full_like(value, torch.nan) for value in work()]

    def replay() -> None:
        for place, value in zip(results, work(), strict=True):
            place.copy_(value)

    return replay, results


def observation(seed: int, device: str = "cpu") -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    first = torch.randn(2, 3, 4, 4, 4, generator=generator)
    return first.to(device), torch.randn(2, 3, 9, 11, 4, 4, generator=generator).to(device)


def blocks(model: WorldModel, run: Run, seed: int, fps: float | None = None, device: str = "cpu") -> list[Tensor]:
    """Two rollouts of five blocks of which the second goes on from the first one's third block."""
    first, maps = observation(seed, device)
    simulator = BlockCausalSimulator(model, SPEC, noise=Noise([seed, seed + 1]), fps=fps, run=run)
    simulator.start(first, maps[:, :, :, :1])
    controls = maps[:, :, :, 1:].split(2, dim=3)
    found = [simulator.step(given) for given in controls[:3]]
    branch = simulator.fork([1], [seed + 5])
    found += [simulator.step(given) for given in controls[3:]]
    return [*found, *(branch.step(given[1:]) for given in controls[3:])]


@pytest.mark.parametrize("changes", BOTH, ids=["velocity", "residual"])
def test_replayed_blocks_are_the_same_bytes(make_model: Callable[..., WorldModel], changes: dict[str, Any]) -> None:
    model, other = (make_model(seed, **changes).requires_grad_(False) for seed in (0, 1))
    recordings: list[int] = []

    def record(work: Callable[[], Sequence[Tensor]]) -> tuple[Callable[[], None], Sequence[Tensor]]:
        recordings.append(1)
        return record_here(work)

    captured = Captured("cpu", record)
    rates = (None, 12.0, 30.0) if changes else (None,)
    for world, seed, fps in ((world, seed, fps) for world in (model, other) for seed in (3, 4) for fps in rates):
        plain, replayed = (blocks(world, run, seed, fps) for run in (run_now, captured))
        assert all(torch.equal(one, two) for one, two in zip(plain, replayed, strict=True))
    # Of each model: windows of none, the first frame and the first frame with a block; what is replayed is recorded once.
    alike = 2 * len({fps is None for fps in rates})
    assert len(recordings) == alike * (3 + 2 + 1 + 1)


def test_replayed_steps_of_a_clip_are_the_same_bytes(make_model: Callable[..., WorldModel]) -> None:
    model, captured = make_model(**RESIDUAL).requires_grad_(False), Captured("cpu", record_here)
    for seed, fps in ((3, None), (4, 12.0), (5, 30.0)):
        first, maps = observation(seed)
        plain, replayed = (
            rollout_full_clip(model, first, maps, noise=Noise([seed, 9]), steps=3, fps=fps, run=run)
            for run in (run_now, captured)
        )
        assert torch.equal(plain, replayed)


class OnTheDevice(TorchDispatchMode):
    """Refuses what a graph cannot hold: tensors that come from the processor's memory."""

    _AS_NUMBERS = (torch.ops.prim.device.default, torch.ops.aten.lift_fresh.default, torch.ops.aten.fill_.Tensor)
    """Take a single value from the processor as a number, which a kernel's arguments hold: ``values[1:] = 2``."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        found = func(*args, **(kwargs or {}))
        values = tree_leaves((args, kwargs, found))
        here = [value for value in values if isinstance(value, Tensor) and value.device.type == "cpu"]
        if any(value.ndim or func not in self._AS_NUMBERS for value in here):
            raise AssertionError(f"{func} reads the processor's memory")
        return found


@pytest.mark.slow
@pytest.mark.parametrize("changes", [{}, RESIDUAL], ids=["velocity", "residual"])
def test_passes_take_nothing_from_the_processor(make_model: Callable[..., WorldModel], changes: dict[str, Any]) -> None:
    """On tensors of a GPU that have shapes and no values: what would wait for a value, or copy one, is an error."""

    def run(function: Any, cache: Any, *tensors: Any, **settings: Any) -> Sequence[Tensor]:
        with OnTheDevice():
            return function(cache, *tensors, **settings)

    config = make_model(**changes).config
    with FakeTensorMode():
        with torch.device("cuda"):
            model = WorldModel(config).requires_grad_(False)
        assert blocks(model, run, 0, 12.0 if changes else None, "cuda")[-1].shape == (1, 3, 4, 2, 4, 4)
        first, maps = observation(0, "cuda")
        rollout_full_clip(model, first, maps, noise=Noise([0, 1]), steps=2, run=run)
        with pytest.raises(AssertionError, match="reads the processor's memory"), OnTheDevice():
            torch.as_tensor(1.0, device="cuda")


def test_only_a_gpu_s_work_is_captured() -> None:
    with pytest.raises(ConfigError, match=r"(?s)Only a GPU's work.*got: cpu.*leave captured out"):
        Captured("cpu")
    with pytest.raises(
        ValidationError, match="captured needs the sampler full_clip or block_causal on the device cuda"
    ):
        RolloutConfig(captured=True)
    assert RolloutConfig(captured=True, device="cuda:0").captured
    assert "captured" not in RolloutConfig().model_dump()


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device is here")
def test_a_graph_replays_what_the_model_computes(make_model: Callable[..., WorldModel]) -> None:
    model, captured = make_model(**RESIDUAL).requires_grad_(False).to("cuda"), Captured("cuda")
    for seed in (3, 4):
        for plain, replayed in zip(
            *(blocks(model, run, seed, 12.0, "cuda") for run in (run_now, captured)), strict=True
        ):
            torch.testing.assert_close(replayed, plain, rtol=1e-4, atol=1e-4)
        first, maps = observation(seed, "cuda")
        plain, replayed = (
            rollout_full_clip(model, first, maps, noise=Noise([seed, 9]), steps=3, run=run)
            for run in (run_now, captured)
        )
        torch.testing.assert_close(replayed, plain, rtol=1e-4, atol=1e-4)
