"""Sharded weights, checkpointed blocks and compiled blocks save memory or time and give the same numbers."""

from collections.abc import Callable
from functools import partial

import pytest
import torch
from torch.testing._internal.distributed.fake_pg import FakeStore

from worldline_core.data.episodes.episode import VIEWS
from worldline_core.distillation.causal_objective import self_forced_rollout
from worldline_core.errors import ConfigError
from worldline_core.model.mixture import MixtureModel
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import CausalSpec
from worldline_core.training.processes import own_part, place_model
from worldline_core.training.training_config import ShardingConfig
from worldline_core.training.training_state import ExponentialAverage

SPEC = CausalSpec(block_size=2, sink_blocks=1, recent_blocks=1, anchor_blocks=None, sigmas=(1.0, 0.5, 0.0))

Make = Callable[..., WorldModel]


OWN = {"mixture": {"vocab_size": 20}, "wan": {}}
"""Networks, and what a small model of each needs besides."""


def sample(frames=7):
    generator = torch.Generator().manual_seed(1)
    latents, maps = (torch.randn(2, 3, channels, frames, 4, 6, generator=generator) for channels in (4, 9))
    return latents, maps, torch.rand(2, generator=generator) * 0.8 + 0.1


def clip_pass(model):
    latents, maps, sigma = sample()
    ids = torch.arange(12).reshape(2, 6)
    text = model.encode_text(ids if isinstance(model, MixtureModel) else ids[..., None].expand(2, 6, 10) / 10)
    return model(latents, sigma, action_maps=maps, text=text).velocity


def teacher_forcing_pass(model):
    latents, maps, _ = sample()
    sigma = torch.full((2, 3), 0.5)
    return model.forward_teacher_forcing(latents, latents, sigma, action_maps=maps, spec=SPEC, views=VIEWS)


def rollout_pass(model):
    """Blocks through a cache whose window moves on before the way back begins."""
    latents, maps, _ = sample(9)
    first = latents[..., :1, :, :]
    return self_forced_rollout(model, first, maps, latents, 1, views=VIEWS, spec=SPEC, with_gradient=True)


EXACT = {"rtol": 0, "atol": 0}
PASSES = [clip_pass, teacher_forcing_pass, rollout_pass]


def gradients(model, passing):
    """Gradients of a pass, and how often the first block ran."""
    calls = []
    feed_forward = model.layers[0].mlp_moe_gen.up_proj if isinstance(model, MixtureModel) else model.layers[0].ffn[0]
    feed_forward.register_forward_hook(lambda *_: calls.append(1))
    passing(model).square().mean().backward()
    return {name: value.grad for name, value in model.named_parameters() if value.grad is not None}, len(calls)


@pytest.mark.parametrize(
    ("network", "passing", "compiled"),
    [
        *((network, passing, False) for network in OWN for passing in PASSES),
        *(pytest.param("mixture", passing, True, marks=pytest.mark.slow) for passing in PASSES),
        pytest.param("wan", teacher_forcing_pass, True, marks=pytest.mark.slow),
    ],
)
def test_blocks_computed_again_and_compiled_ones_give_the_same_gradients(make_model, network, passing, compiled):
    make_small = partial(make_model, network=network, towers="both", **OWN[network])
    # In tests every function is wrapped to check its shapes, and each wrapper counts as compiling the same one again.
    torch._dynamo.reset()
    plain, once = gradients(make_small(), passing)
    config = ShardingConfig(compile=compiled, checkpointing="block")
    with torch._dynamo.config.patch(recompile_limit=100):
        found, twice = gradients(place_model(make_small(), config, precision="fp32", device="cpu"), passing)
    assert plain.keys() == found.keys()
    for name, value in plain.items():
        torch.testing.assert_close(found[name], value, **({"rtol": 1e-4, "atol": 1e-6} if compiled else EXACT))
    assert compiled or twice > once


@pytest.fixture
def group_of_64():
    """This process is the first of 64, the others answer nothing."""
    torch.distributed.init_process_group("fake", store=FakeStore(), rank=0, world_size=64)
    yield
    torch.distributed.destroy_process_group()


@pytest.mark.usefixtures("group_of_64")
@pytest.mark.parametrize(("shards", "own"), [(None, {}), (8, {}), (8, {"network": "wan", "head_dim": 32})])
def test_one_of_64_holds_a_64th_of_everything(make_model, shards, own):
    mixture = {"num_kv_heads": 1, "rope_sections": (16, 8, 8)}
    sizes = {"hidden_size": 64, "intermediate_size": 128, "head_dim": 64, "num_heads": 2}
    model = make_model(**sizes | (own or mixture))
    matrices = {name for name, value in model.named_parameters() if value.shape[0] % 64 == 0}
    whole = {name: value.numel() for name, value in model.named_parameters()}
    place_model(model, ShardingConfig(shards=shards), precision="bf16", device="cpu")
    named = dict(model.named_parameters())
    optimizer = torch.optim.AdamW(named.values(), fused=True)
    for parameter in named.values():
        parameter.grad = torch.zeros_like(parameter)
    optimizer.step()
    average = ExponentialAverage(named, 0.9).average
    parts = shards or 64
    assert sum(whole[name] for name in matrices) > 0.95 * sum(whole.values())
    for name in matrices:
        states = [optimizer.state[named[name]][key] for key in ("exp_avg", "exp_avg_sq")]
        for value in (named[name], average[name], *states):
            assert own_part(value).numel() * parts == whole[name]
    # What does not divide is shared out too, the first processes holding a row each.
    assert all(own_part(value).shape[0] <= -(-value.shape[0] // parts) for value in named.values())
    with pytest.raises(ConfigError, match=r"a divisor of 64, the number of processes[\s\S]*got: 7"):
        place_model(make_model(), ShardingConfig(shards=7), precision="fp32", device="cpu")
