"""Block-causal attention and the key/value cache: causality, equality with the full pass, constant cost."""

import pytest
import torch

from worldline_core.errors import DataError
from worldline_core.model.block_causal_attention import CachedAttention, KVCache, TeacherForcingAttention, block_bounds
from worldline_core.model.layers import rotate
from worldline_core.model.world_model_config import CausalSpec

BLOCK = 2
FRAMES = 7
SPEC = CausalSpec(block_size=BLOCK, sink_blocks=1, recent_blocks=3, anchor_blocks=None, sigmas=(1.0, 0.0))


NETWORKS = [{}, {"prediction": "first_frame_residual"}, {"network": "wan"}]


@pytest.fixture(scope="module", params=NETWORKS, ids=str)
def model(request, make_model):
    return make_model(**request.param).requires_grad_(False)


def clip(frames=FRAMES, batch=2):
    generator = torch.Generator().manual_seed(1)
    noisy, clean = torch.randn(2, batch, 3, 4, frames, 4, 4, generator=generator)
    maps = torch.randn(batch, 3, 9, frames, 4, 4, generator=generator)
    sigma = torch.rand(batch, (frames - 1) // BLOCK, generator=generator) * 0.8 + 0.1
    return noisy, clean, maps, sigma


def frames_of(values, start, stop):
    return values[..., start:stop, :, :]


WINDOWS = [(1, 0), (1, 1), (2, 1), (1, 2), (3, 2), (1, 9)]
"""Sink and recent blocks; clips of `test_every_block_...` have seven blocks after the observed frame."""


def one_block_at_a_time(queries, keys, values, by, sizes, spec):
    """The sequence ``[clean blocks 0..k-1, noisy blocks 1..k]`` by its definition: a block, its window, a dense mask."""
    blocks, history = range(len(sizes)), sum(sizes[:-1])
    owner = torch.cat([torch.full((size,), block) for block, size in zip(blocks, sizes, strict=True)])
    clean, mixed = owner[:history], []
    for noisy, block in [(False, block) for block in blocks[:-1]] + [(True, block) for block in blocks[1:]]:
        own = torch.nonzero(owner == block).flatten() + (history - sizes[0] if noisy else 0)
        visible = {*range(spec.sink_blocks), *range(block - spec.recent_blocks, block)}
        seen = torch.tensor([i for i in range(history) if int(clean[i]) < block and int(clean[i]) in visible])
        seen = torch.cat((seen.long(), own))
        angles = (by[0][: len(seen)], by[1][: len(seen)])
        own_angles = (angles[0][-len(own) :], angles[1][-len(own) :])
        scores = rotate(queries[..., own, :], own_angles) @ rotate(keys[..., seen, :], angles).mT
        found = torch.softmax(scores / queries.shape[-1] ** 0.5, dim=-1) @ values[..., seen, :]
        mixed.append(found.transpose(1, 2).flatten(2))
    return torch.cat(mixed, dim=1)


@pytest.mark.parametrize("window", WINDOWS)
def test_attention_of_alike_blocks_together_equals_one_block_at_a_time(window):
    spec = SPEC.model_copy(update={"sink_blocks": window[0], "recent_blocks": window[1]})
    sizes = [3, *[6] * 7]
    length = sum(sizes[:-1]) + sum(sizes[1:])
    generator = torch.Generator().manual_seed(2)
    queries = torch.randn(2, 4, length, 12, generator=generator)
    keys, values = torch.randn(2, 2, 2, length, 12, generator=generator)
    angles = torch.randn(sum(sizes), 6, generator=generator).repeat(1, 2)
    by = (angles.cos(), angles.sin())
    together = TeacherForcingAttention(by, tuple(sizes), *window)(0, queries, keys, values, None)
    every_head = (keys.repeat_interleave(2, dim=1), values.repeat_interleave(2, dim=1))
    torch.testing.assert_close(together, one_block_at_a_time(queries, *every_head, by, sizes, spec))


def blockwise(model, spec, given, rates=None):
    """The velocities as a rollout over the same clean history computes them, and its cache; alike in joint passes."""
    noisy, clean, maps, sigma = given
    (cache, found), (other, joint) = ((KVCache(spec.sink_blocks, spec.recent_blocks, rates), []) for _ in range(2))
    for block, (start, stop) in enumerate(block_bounds(noisy.shape[3], BLOCK)):
        own = frames_of(maps, start, stop)
        if block:
            step = (frames_of(noisy, start, stop), sigma[:, block - 1])
            found.append(model.forward_block(*step, cache, action_maps=own))
            joint.append(model.write_and_forward_block(written, *step, other, clean_maps=drawn, action_maps=own))
        written, drawn = frames_of(clean, start, stop), own
        model.write_block(written, cache, action_maps=drawn)
    model.write_block(written, other, action_maps=drawn)
    torch.testing.assert_close(torch.cat(joint, dim=3), torch.cat(found, dim=3), rtol=1e-5, atol=1e-5)
    assert other.nbytes == cache.nbytes
    return torch.cat(found, dim=3), cache


@pytest.mark.parametrize(
    ("window", "fps", "changes"),
    [
        *((window, None, {"prediction": "first_frame_residual"}) for window in WINDOWS),
        *((window, (8.0, 20.0), {}) for window in WINDOWS[1:3]),
        *((window, None, {"network": "wan"}) for window in WINDOWS[1:3]),
    ],
)
def test_every_block_of_a_long_clip_sees_what_the_cache_shows_it(make_model, window, fps, changes):
    model = make_model(3, fps=None if fps is None else 30.0, **changes).requires_grad_(False)
    spec = SPEC.model_copy(update={"sink_blocks": window[0], "recent_blocks": window[1]})
    noisy, clean, maps, sigma = given = clip(1 + 7 * BLOCK)
    rates = None if fps is None else torch.tensor(fps)
    velocity = model.forward_teacher_forcing(noisy, clean, sigma, action_maps=maps, spec=spec, fps=rates)
    cached, _ = blockwise(model, spec, given, rates)
    torch.testing.assert_close(frames_of(velocity, 1, 1 + 7 * BLOCK), cached, rtol=1e-5, atol=1e-5)
    everything = spec.model_copy(update={"recent_blocks": 7})
    unlimited = model.forward_teacher_forcing(noisy, clean, sigma, action_maps=maps, spec=everything, fps=rates)
    assert torch.allclose(unlimited, velocity, atol=1e-3) == (sum(window) >= 7)


@pytest.mark.parametrize("network", ["mixture", "wan"])
def test_a_pass_that_is_computed_again_reads_the_window_it_read_first(make_model, network):
    """Activation checkpointing runs the layers once more, when later blocks are already in the cache."""
    model, gradients = make_model(network=network), []
    _, clean, _, sigma = clip()
    for model.checkpointing in ("none", "block"):
        cache = KVCache(1, 1)
        model.write_block(frames_of(clean, 0, 1), cache)
        velocity = model.forward_block(frames_of(clean, 1, 3), sigma[:, 0], cache)
        for start in (1, 3):
            model.write_block(frames_of(clean, start, start + 2), cache)
        gradients.append(torch.autograd.grad(velocity.square().sum(), list(model.layers.parameters())))
    assert all(torch.equal(plain, again) for plain, again in zip(*gradients, strict=True))


def test_future_frames_and_actions_leave_past_blocks_unchanged(model):
    noisy, clean, maps, sigma = clip()
    before = model.forward_teacher_forcing(noisy, clean, sigma, action_maps=maps, spec=SPEC)
    for values in (noisy, clean, maps):
        values[..., 3:, :, :] += 1.0
    sigma[:, 1:] *= 0.5
    after = model.forward_teacher_forcing(noisy, clean, sigma, action_maps=maps, spec=SPEC)
    assert torch.equal(frames_of(before, 0, 3), frames_of(after, 0, 3))
    assert bool((frames_of(before, 3, 5) - frames_of(after, 3, 5)).abs().amax() > 1e-3)
    assert not frames_of(before, 0, 1).any()
    # Nor does a noisy block see its own clean frames.
    before = after
    clean[..., 3:5, :, :] += 1.0
    after = model.forward_teacher_forcing(noisy, clean, sigma, action_maps=maps, spec=SPEC)
    assert torch.equal(frames_of(before, 1, 5), frames_of(after, 1, 5))
    assert not torch.allclose(frames_of(before, 5, 7), frames_of(after, 5, 7))


def test_the_write_pass_is_the_conditioned_form_and_not_sigma_zero(make_model):
    """The write pass adds no time embedding; a noisy pass at sigma 0 does. Wan's clean frames have time 0."""
    (_, clean, _, _), model = clip(), make_model()
    observed, block = frames_of(clean, 0, 1), frames_of(clean, 1, 3)
    cache = KVCache(1, 3)
    model.write_block(observed, cache)
    model.write_block(block, cache)
    written = cache.window.blocks[1].layers[1][0]
    other = KVCache(1, 3)
    model.write_block(observed, other)
    seen = []
    attend = CachedAttention.__call__

    def watch(self, layer, queries, keys, *rest):
        seen.append(keys)
        return attend(self, layer, queries, keys, *rest)  # type: ignore[arg-type]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(CachedAttention, "__call__", watch)
        model.forward_block(block, 0.0, other)
    assert seen[1].shape == written.shape
    assert not torch.allclose(seen[1], written)


def test_the_window_keeps_the_sink_and_the_recent_blocks_and_never_leaves_the_trained_positions(model):
    cache, sizes = KVCache(sink_blocks=1, recent_blocks=2), []
    for block in range(12):
        latents = torch.full((1, 3, 4, BLOCK if block else 1, 4, 4), float(block))
        model.write_block(latents, cache)
        sizes.append((cache.frames, cache.nbytes))
    assert max(frames for frames, _ in sizes) == 1 + 2 * BLOCK
    assert len(set(sizes[3:])) == 1
    model.forward_block(latents, 0.5, cache)  # a step reads the window rotated and joined, and remembers it
    assert cache.nbytes == 2 * sizes[-1][1]
    first = KVCache(1, 2)
    model.write_block(torch.zeros(1, 3, 4, 1, 4, 4), first)
    assert torch.equal(cache.window.blocks[0].layers[0][0], first.window.blocks[0].layers[0][0])


@pytest.mark.usefixtures("unchecked_shapes")
def test_misuse_is_refused(model):
    noisy, clean, maps, sigma = clip()
    with pytest.raises(DataError, match="one sigma per block"):
        model.forward_teacher_forcing(noisy, clean, sigma[:, :1], action_maps=maps, spec=SPEC)
    with pytest.raises(DataError, match="Latents have the wrong shape"):
        model.write_block(clean[0], KVCache(1, 3))
