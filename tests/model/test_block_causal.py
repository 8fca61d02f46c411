"""Block-causal attention and the key/value cache: causality, equality with the full pass, constant cost."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from worldline_core.errors import ConfigError, DataError
from worldline_core.model.block_causal_attention import (
    CachedAttention,
    CachedBlock,
    KVCache,
    TeacherForcingAttention,
    block_bounds,
)
from worldline_core.model.layers import grouped_attention
from worldline_core.model.rope import rotate, rotation
from worldline_core.model.world_model import WorldModel

BLOCK = 2
FRAMES = 7


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


def teacher_forcing_mask(bounds: list[tuple[int, int]], tokens_per_frame: int) -> torch.Tensor:
    """Dense mask (True: may attend) of the sequence ``[clean blocks 0..k-1, noisy blocks 1..k]``."""
    sizes = [(stop - start) * tokens_per_frame for start, stop in bounds]
    clean = torch.cat([torch.full((size,), i) for i, size in enumerate(sizes[:-1])])
    noisy = torch.cat([torch.full((size,), i) for i, size in enumerate(sizes) if i > 0])
    clean_to_clean = clean[:, None] >= clean[None, :]
    clean_to_noisy = torch.zeros(len(clean), len(noisy), dtype=torch.bool)
    noisy_to_clean = noisy[:, None] > clean[None, :]
    noisy_to_noisy = noisy[:, None] == noisy[None, :]
    return torch.cat(
        (torch.cat((clean_to_clean, clean_to_noisy), dim=1), torch.cat((noisy_to_clean, noisy_to_noisy), dim=1))
    )


def test_blocks_of_a_clip() -> None:
    assert block_bounds(9, 4) == [(0, 1), (1, 5), (5, 9)]
    with pytest.raises(DataError, match="does not divide into blocks"):
        block_bounds(8, 4)


def test_the_window_keeps_the_sink_and_the_recent_blocks() -> None:
    cache = KVCache(sink_blocks=1, recent_blocks=3)
    for number, kept in enumerate(([0], [0, 1], [0, 1, 2], [0, 1, 2, 3], [0, 2, 3, 4], [0, 3, 4, 5])):
        cache.append(CachedBlock(10**number, {}))
        assert cache.frames == sum(10**block for block in kept)


def test_blockwise_attention_equals_the_dense_mask(model: WorldModel) -> None:
    bounds = block_bounds(FRAMES, BLOCK)
    length = (FRAMES - BLOCK + FRAMES - 1) * 3
    generator = torch.Generator().manual_seed(2)
    queries = torch.randn(2, 4, length, 12, generator=generator)
    keys, values = torch.randn(2, 2, 2, length, 12, generator=generator)
    by = rotation(model.config, torch.randn(3, length, generator=generator))
    sizes = tuple((stop - start) * 3 for start, stop in bounds)
    blockwise = TeacherForcingAttention(by, sizes)(0, queries, keys, values, None)
    mask = teacher_forcing_mask(bounds, 3)
    dense = grouped_attention(rotate(queries, by), rotate(keys, by), values, mask[None, None])
    torch.testing.assert_close(blockwise, dense, rtol=1e-5, atol=1e-5)
    reference = torch.nn.functional.scaled_dot_product_attention(
        rotate(queries, by),
        rotate(keys, by).repeat_interleave(2, dim=1),
        values.repeat_interleave(2, dim=1),
        attn_mask=mask,
    )
    torch.testing.assert_close(dense, reference.transpose(1, 2).flatten(2), rtol=1e-5, atol=1e-5)


def test_clean_half_of_the_mask_is_block_causal() -> None:
    block_of = torch.tensor([0, 0, 1, 1, 1, 1])
    mask = teacher_forcing_mask(block_bounds(5, 2), 2)
    assert torch.equal(mask[:6, :6], block_of[:, None] >= block_of[None, :])


def test_future_frames_and_actions_leave_past_blocks_unchanged(model: WorldModel) -> None:
    noisy, clean, maps, sigma = clip()
    before = model.forward_teacher_forcing(noisy, clean, sigma, action_maps=maps, block_size=BLOCK)
    noisy[..., 3:, :, :] += 1.0
    clean[..., 3:, :, :] += 1.0
    maps[..., 3:, :, :] -= 1.0
    sigma[:, 1:] *= 0.5
    after = model.forward_teacher_forcing(noisy, clean, sigma, action_maps=maps, block_size=BLOCK)
    assert torch.equal(frames_of(before, 0, 3), frames_of(after, 0, 3))
    assert bool((frames_of(before, 3, 5) - frames_of(after, 3, 5)).abs().amax() > 1e-3)
    assert bool((frames_of(before, 0, 1) == 0).all())


def test_a_noisy_block_does_not_see_its_own_clean_frames(model: WorldModel) -> None:
    noisy, clean, maps, sigma = clip()
    before = model.forward_teacher_forcing(noisy, clean, sigma, action_maps=maps, block_size=BLOCK)
    clean[..., 3:5, :, :] += 1.0
    after = model.forward_teacher_forcing(noisy, clean, sigma, action_maps=maps, block_size=BLOCK)
    assert torch.equal(frames_of(before, 1, 5), frames_of(after, 1, 5))
    assert not torch.allclose(frames_of(before, 5, 7), frames_of(after, 5, 7))


def test_cached_passes_equal_the_full_block_causal_pass(model: WorldModel) -> None:
    noisy, clean, maps, sigma = clip()
    full = model.forward_teacher_forcing(noisy, clean, sigma, action_maps=maps, block_size=BLOCK)
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
    written = cache._blocks[1].layers[1][0]
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
    first = KVCache(1, 2)
    model.write_block(torch.zeros(1, 3, 4, 1, 4, 4), first)
    assert torch.equal(cache._blocks[0].layers[0][0], first._blocks[0].layers[0][0])


def test_a_long_rollout_with_the_window_equals_a_fresh_cache_with_the_same_blocks(model: WorldModel) -> None:
    """After eviction the rest is read exactly as if the evicted block had never been there."""
    rolled, fresh = KVCache(1, 1), KVCache(1, 1)
    _, clean, _, sigma = clip()
    for start, stop in ((0, 1), (1, 3), (3, 5)):
        model.write_block(frames_of(clean, start, stop), rolled)
    fresh._blocks, fresh.reference = list(rolled._blocks), rolled.reference
    block = frames_of(clean, 5, 7)
    assert torch.equal(model.forward_block(block, sigma[:, 0], rolled), model.forward_block(block, sigma[:, 0], fresh))


def test_copies_of_a_cache_go_on_separately(model: WorldModel) -> None:
    cache = KVCache(1, 3)
    model.write_block(torch.zeros(1, 3, 4, 1, 4, 4), cache)
    other = cache.copy()
    model.write_block(torch.ones(1, 3, 4, BLOCK, 4, 4), other)
    assert (cache.frames, other.frames) == (1, 1 + BLOCK)


@pytest.mark.usefixtures("unchecked_shapes")
def test_misuse_is_refused(model: WorldModel) -> None:
    noisy, clean, maps, sigma = clip()
    with pytest.raises(DataError, match="one sigma per block"):
        model.forward_teacher_forcing(noisy, clean, sigma[:, :1], action_maps=maps, block_size=BLOCK)
    with pytest.raises(ConfigError, match="at least the observed frame"):
        KVCache(sink_blocks=0, recent_blocks=3)
    with pytest.raises(DataError, match="Latents have the wrong shape"):
        model.write_block(clean[0], KVCache(1, 3))
