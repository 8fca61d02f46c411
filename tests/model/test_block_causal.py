"""Block-causal attention and the key/value cache: causality, equality with the full pass, constant cost."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from worldline_core.errors import DataError
from worldline_core.model.block_causal_attention import CachedAttention, KVCache, TeacherForcingAttention, block_bounds
from worldline_core.model.layers import Rotation, rotate
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import CausalSpec

BLOCK = 2
FRAMES = 7
SPEC = CausalSpec(block_size=BLOCK, sink_blocks=1, recent_blocks=3, anchor_blocks=None, sigmas=(1.0, 0.0))


@pytest.fixture(scope="module", params=["velocity", "first_frame_residual"])
def model(request: pytest.FixtureRequest, make_model: Callable[..., WorldModel]) -> WorldModel:
    return make_model(prediction=request.param).requires_grad_(False)


def clip(frames: int = FRAMES, batch: int = 2) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    noisy, clean = torch.randn(2, batch, 3, 4, frames, 4, 4, generator=generator)
    maps = torch.randn(batch, 3, 9, frames, 4, 4, generator=generator)
    sigma = torch.rand(batch, (frames - 1) // BLOCK, generator=generator) * 0.8 + 0.1
    return noisy, clean, maps, sigma


def frames_of(values: torch.Tensor, start: int, stop: int) -> torch.Tensor:
    return values[..., start:stop, :, :]


WINDOWS = [(1, 0), (1, 1), (2, 1), (1, 2), (3, 2), (1, 9)]
"""Sink and recent blocks; clips of `test_every_block_...` have seven blocks after the observed frame."""


def one_block_at_a_time(
    queries: torch.Tensor, keys: torch.Tensor, values: torch.Tensor, by: Rotation, sizes: list[int], spec: CausalSpec
) -> torch.Tensor:
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
def test_attention_of_alike_blocks_together_equals_one_block_at_a_time(window: tuple[int, int]) -> None:
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


@pytest.mark.parametrize("window", WINDOWS)
@pytest.mark.parametrize("fps", [None, (8.0, 20.0)])
def test_every_block_of_a_long_clip_sees_what_the_cache_shows_it(
    make_model: Callable[..., WorldModel], window: tuple[int, int], fps: tuple[float, float] | None
) -> None:
    model = make_model(3, fps=None if fps is None else 30.0).requires_grad_(False)
    spec = SPEC.model_copy(update={"sink_blocks": window[0], "recent_blocks": window[1]})
    noisy, clean, maps, sigma = clip(1 + 7 * BLOCK)
    rates = None if fps is None else torch.tensor(fps)
    velocity = model.forward_teacher_forcing(noisy, clean, sigma, action_maps=maps, spec=spec, fps=rates)
    cache = KVCache(spec.sink_blocks, spec.recent_blocks, rates)
    for block, (start, stop) in enumerate(block_bounds(1 + 7 * BLOCK, BLOCK)):
        own = frames_of(maps, start, stop)
        if block:
            cached = model.forward_block(frames_of(noisy, start, stop), sigma[:, block - 1], cache, action_maps=own)
            torch.testing.assert_close(frames_of(velocity, start, stop), cached, rtol=1e-5, atol=1e-5)
        model.write_block(frames_of(clean, start, stop), cache, action_maps=own)
    everything = spec.model_copy(update={"recent_blocks": 7})
    unlimited = model.forward_teacher_forcing(noisy, clean, sigma, action_maps=maps, spec=everything, fps=rates)
    assert torch.allclose(unlimited, velocity, atol=1e-3) == (sum(window) >= 7)


def test_a_pass_that_is_computed_again_reads_the_window_it_read_first(make_model: Callable[..., WorldModel]) -> None:
    """Activation checkpointing runs the layers once more, when later blocks are already in the cache."""
    model, gradients = make_model(), []
    _, clean, _, sigma = clip()
    for model.checkpointing in ("none", "block"):
        cache = KVCache(1, 1)
        model.write_block(frames_of(clean, 0, 1), cache)
        velocity = model.forward_block(frames_of(clean, 1, 3), sigma[:, 0], cache)
        for start in (1, 3):
            model.write_block(frames_of(clean, start, start + 2), cache)
        gradients.append(torch.autograd.grad(velocity.square().sum(), list(model.layers.parameters())))
    for plain, again in zip(*gradients, strict=True):
        assert torch.equal(plain, again)


def test_future_frames_and_actions_leave_past_blocks_unchanged(model: WorldModel) -> None:
    noisy, clean, maps, sigma = clip()
    before = model.forward_teacher_forcing(noisy, clean, sigma, action_maps=maps, spec=SPEC)
    noisy[..., 3:, :, :] += 1.0
    clean[..., 3:, :, :] += 1.0
    maps[..., 3:, :, :] -= 1.0
    sigma[:, 1:] *= 0.5
    after = model.forward_teacher_forcing(noisy, clean, sigma, action_maps=maps, spec=SPEC)
    assert torch.equal(frames_of(before, 0, 3), frames_of(after, 0, 3))
    assert bool((frames_of(before, 3, 5) - frames_of(after, 3, 5)).abs().amax() > 1e-3)
    assert bool((frames_of(before, 0, 1) == 0).all())


def test_a_noisy_block_does_not_see_its_own_clean_frames(model: WorldModel) -> None:
    noisy, clean, maps, sigma = clip()
    before = model.forward_teacher_forcing(noisy, clean, sigma, action_maps=maps, spec=SPEC)
    clean[..., 3:5, :, :] += 1.0
    after = model.forward_teacher_forcing(noisy, clean, sigma, action_maps=maps, spec=SPEC)
    assert torch.equal(frames_of(before, 1, 5), frames_of(after, 1, 5))
    assert not torch.allclose(frames_of(before, 5, 7), frames_of(after, 5, 7))


def test_cached_passes_equal_the_full_block_causal_pass(model: WorldModel) -> None:
    noisy, clean, maps, sigma = clip()
    full = model.forward_teacher_forcing(noisy, clean, sigma, action_maps=maps, spec=SPEC)
    cache = KVCache(sink_blocks=1, recent_blocks=3)
    for block, (start, stop) in enumerate(block_bounds(FRAMES, BLOCK)):
        own = frames_of(maps, start, stop)
        if block:
            cached = model.forward_block(frames_of(noisy, start, stop), sigma[:, block - 1], cache, action_maps=own)
            torch.testing.assert_close(cached, frames_of(full, start, stop), rtol=1e-5, atol=1e-5)
        model.write_block(frames_of(clean, start, stop), cache, action_maps=own)
    assert cache.frames == FRAMES


def test_the_write_pass_is_the_conditioned_form_and_not_sigma_zero(model: WorldModel) -> None:
    """What a block leaves in the cache has no time embedding, which a noisy pass at sigma 0 has."""
    _, clean, _, _ = clip()
    observed, block = frames_of(clean, 0, 1), frames_of(clean, 1, 3)
    cache = KVCache(1, 3)
    model.write_block(observed, cache)
    model.write_block(block, cache)
    written = cache.window.blocks[1].layers[1][0]
    other = KVCache(1, 3)
    model.write_block(observed, other)
    seen = []
    attend = CachedAttention.__call__

    def watch(self: CachedAttention, layer: int, queries: torch.Tensor, keys: torch.Tensor, *rest: object) -> object:
        seen.append(keys)
        return attend(self, layer, queries, keys, *rest)  # type: ignore[arg-type]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(CachedAttention, "__call__", watch)
        model.forward_block(block, 0.0, other)
    assert seen[1].shape == written.shape
    assert not torch.allclose(seen[1], written)


def test_the_window_keeps_the_sink_and_the_recent_blocks_and_never_leaves_the_trained_positions(
    model: WorldModel,
) -> None:
    cache = KVCache(sink_blocks=1, recent_blocks=2)
    sizes = []
    for block in range(12):
        frames = 1 if block == 0 else BLOCK
        latents = torch.full((1, 3, 4, frames, 4, 4), float(block))
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
def test_misuse_is_refused(model: WorldModel) -> None:
    noisy, clean, maps, sigma = clip()
    with pytest.raises(DataError, match="one sigma per block"):
        model.forward_teacher_forcing(noisy, clean, sigma[:, :1], action_maps=maps, spec=SPEC)
    with pytest.raises(DataError, match="Latents have the wrong shape"):
        model.write_block(clean[0], KVCache(1, 3))
