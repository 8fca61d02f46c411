"""Euler integration, whole-clip and block-causal sampling."""

import pytest
import torch
from pydantic import ValidationError

from worldline_core.errors import ConfigError, DataError
from worldline_core.model.world_model import WorldModelOutput
from worldline_core.model.world_model_config import CAUSAL_SIGMAS, CausalSpec
from worldline_core.rollout.samplers import (
    FULL_STEPS,
    BlockCausalSimulator,
    Noise,
    rollout_full_clip,
    shifted_sigmas,
    sigmas_causal,
)


@pytest.fixture(scope="module")
def model(make_model):
    return make_model().requires_grad_(False)


def observation(batch=2, frames=9):
    generator = torch.Generator().manual_seed(1)
    first = torch.randn(batch, 3, 4, 4, 4, generator=generator)
    return first, torch.randn(batch, 3, 9, frames, 4, 4, generator=generator)


SPEC = CausalSpec(block_size=4, sink_blocks=1, recent_blocks=3, anchor_blocks=None, sigmas=CAUSAL_SIGMAS)


def test_nodes_of_the_samplers():
    assert shifted_sigmas(4, 5.0) == pytest.approx(CAUSAL_SIGMAS)
    assert sigmas_causal(SPEC) == sigmas_causal(SPEC, 4) == CAUSAL_SIGMAS
    assert len(shifted_sigmas(FULL_STEPS)) == 36
    assert shifted_sigmas(2) == (1.0, 0.5, 0.0)
    assert sigmas_causal(SPEC, 2) == pytest.approx((1.0, 5 / 6, 0.0))
    with pytest.raises(ConfigError, match="at least one step"):
        shifted_sigmas(0)
    with pytest.raises(ValidationError, match="must fall from at most 1 to 0"):
        CausalSpec(block_size=4, sink_blocks=1, recent_blocks=3, anchor_blocks=None, sigmas=(1.0, 0.5, 0.5, 0.0))


class Oracle(torch.nn.Module):
    """Emits the exact velocity towards known latents."""

    def __init__(self, clean):
        super().__init__()
        self.clean = clean

    def forward(self, latents, sigma, **_):
        velocity = (latents - self.clean) / sigma.view(-1, 1, 1, 1, 1, 1)
        velocity[:, :, :, 0] = 0
        return WorldModelOutput(velocity, None)


def test_whole_clip_sampler_finds_what_the_velocity_points_to():
    first, maps = observation()
    clean = torch.randn(2, 3, 4, 9, 4, 4)
    clean[:, :, :, 0] = first
    predicted = rollout_full_clip(Oracle(clean), first, maps, noise=Noise([42, 43]), steps=5)
    torch.testing.assert_close(predicted, clean, rtol=1e-4, atol=1e-4)


def test_a_clip_is_predicted_alike_alone_and_in_a_batch(model):
    first, maps = observation()
    both = rollout_full_clip(model, first, maps, noise=Noise([42, 42]), steps=3)
    alone = rollout_full_clip(model, first[1:], maps[1:], noise=Noise([42]), steps=3)
    torch.testing.assert_close(both[1:], alone, rtol=1e-4, atol=1e-4)
    other = rollout_full_clip(model, first[1:], maps[1:], noise=Noise([43]), steps=3)
    assert not torch.allclose(alone, other, atol=1e-2)
    assert torch.equal(both[:, :, :, 0], first)


def roll(simulator, first, maps):
    simulator.start(first, maps[:, :, :, :1])
    return [simulator.step(maps[:, :, :, s : s + 4]) for s in range(1, maps.shape[3], 4)]


def test_block_causal_rollout_accepts_new_controls_and_never_looks_ahead(model):
    first, maps = observation(frames=13)
    changed = maps.clone()
    changed[:, :, :, 5:] *= -1
    before, after = (roll(BlockCausalSimulator(model, SPEC, noise=Noise([42, 43])), first, m) for m in (maps, changed))
    assert torch.equal(before[0], after[0])
    assert not torch.allclose(before[1], after[1], atol=1e-3)
    assert [block.shape for block in before] == [(2, 3, 4, 4, 4, 4)] * 3
    simulator = BlockCausalSimulator(model, SPEC, noise=Noise([42, 43]))
    roll(simulator, first, maps[:, :, :, :5])
    fork = simulator.fork()  # it goes on separately, as the original would
    assert torch.equal(fork.step(changed[:, :, :, 5:9]), after[1])
    assert torch.equal(simulator.step(maps[:, :, :, 5:9]), before[1])


def test_blocks_equal_the_full_block_causal_pass_at_every_step(model):
    first, maps = observation()
    simulator = BlockCausalSimulator(model, SPEC.model_copy(update={"sigmas": (1.0, 0.0)}), noise=Noise([42, 43]))
    blocks = roll(simulator, first, maps)
    noise = Noise([42, 43])
    noisy = torch.cat([first[:, :, :, None], *(noise.draw((3, 4, 4, 4, 4)) for _ in range(2))], dim=3)
    clean = torch.cat([first[:, :, :, None], *blocks], dim=3)
    velocity = model.forward_teacher_forcing(noisy, clean, torch.ones(2, 2), action_maps=maps, spec=SPEC)
    torch.testing.assert_close(noisy - velocity, clean, rtol=1e-4, atol=1e-4)


def test_rollouts_stand_in_time_by_the_rate_they_are_given(make_model):
    """A rate that is given counts like the config's own: by clip, by block, and in a fork."""
    first, maps = observation(batch=1)
    own, other = (make_model(fps=fps).requires_grad_(False) for fps in (20.0, 8.0))
    clips = [
        rollout_full_clip(model, first, maps, noise=Noise([42]), steps=2, fps=fps)
        for model, fps in ((own, None), (other, 20.0), (other, None))
    ]
    assert torch.equal(clips[0], clips[1])
    assert not torch.allclose(clips[1], clips[2], rtol=0, atol=1e-5)
    blocks = []
    for model, fps in ((own, None), (other, 20.0)):
        simulator = BlockCausalSimulator(model, SPEC, noise=Noise([42]), fps=fps)
        roll(simulator, first, maps)
        blocks.append(simulator.fork().step(maps[:, :, :, 1:5]))
    assert torch.equal(*blocks)


def test_misuse_is_refused(model):
    first, maps = observation()
    simulator = BlockCausalSimulator(model, SPEC, noise=Noise([42, 43]))
    with pytest.raises(DataError, match="has not been started"):
        simulator.step(maps[:, :, :, 1:5])
    simulator.start(first, maps[:, :, :, :1])
    with pytest.raises(DataError, match="Controls of one block"):
        simulator.step(maps)
