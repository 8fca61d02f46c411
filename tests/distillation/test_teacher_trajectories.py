"""Teacher trajectories: the nodes, the sub-steps, and the history each block sees."""

from __future__ import annotations

import itertools

import pytest
import torch

from worldline_core.distillation.teacher_trajectories import euler_nodes, substep_sigmas, teacher_trajectories
from worldline_core.distillation.trajectory_regression import node_of_each_block
from worldline_core.model.world_model_config import CAUSAL_SIGMAS as NODES


@pytest.mark.parametrize("substeps", [(1, 1, 1, 1), (2, 2, 3, 9)])
def test_euler_is_exact_on_a_straight_field(substeps: tuple[int, ...]) -> None:
    generator = torch.Generator().manual_seed(0)
    clean, noise = torch.randn(2, 3, 4, generator=generator, dtype=torch.float64)
    states = euler_nodes(lambda state, sigma: noise - clean, noise, substeps, NODES)
    assert len(states) == len(NODES)
    for sigma, state in zip(NODES, states, strict=True):
        torch.testing.assert_close(state, (1 - sigma) * clean + sigma * noise)


def test_finer_substeps_come_closer_to_the_true_flow() -> None:
    # dx/dsigma = x has the solution x(sigma) = x(1) exp(sigma - 1).
    noise = torch.ones(1, dtype=torch.float64)
    exact = torch.exp(torch.tensor(-1.0, dtype=torch.float64))
    errors = [
        abs(euler_nodes(lambda state, sigma: state, noise, (count,) * 4, NODES)[-1] - exact).item()
        for count in (1, 4, 16)
    ]
    assert errors[0] > 3 * errors[1] > 9 * errors[2] > 0


def test_substeps_end_on_the_nodes_and_descend() -> None:
    levels = substep_sigmas(5 / 8, 0.0, 5)
    assert (levels[0], levels[-1], len(levels)) == (5 / 8, 0.0, 6)
    assert all(a > b for a, b in itertools.pairwise(levels))
    # Two sub-steps of the whole range meet in the middle of the unshifted schedule: 5 / 6 at one half.
    assert substep_sigmas(1.0, 0.0, 2)[1] == pytest.approx(5 / 6)


def test_a_node_is_picked_for_each_block() -> None:
    nodes = torch.arange(5.0).reshape(1, 5, 1, 1, 1, 1, 1).expand(1, 5, 3, 4, 4, 2, 2)
    picked = node_of_each_block(nodes, torch.tensor([[3, 1]]), block_size=2)
    assert picked.shape == (1, 3, 4, 4, 2, 2)
    assert picked[0, 0, 0, :, 0, 0].tolist() == [3, 3, 1, 1]


def trajectories(model, clip, **options):
    return teacher_trajectories(
        model,
        options.pop("latents", clip.latents),
        options.pop("maps", clip.maps),
        clip.noise,
        views=clip.views,
        spec=clip.spec,
        substeps=(1, 1, 1, 2),
        **options,
    )


def test_trajectories_start_at_the_noise_and_are_repeatable(make_model, clip) -> None:
    model = make_model(0)
    nodes = trajectories(model, clip)
    assert nodes.shape == (2, 5, 3, 4, 4, 4, 4)
    assert torch.equal(nodes[:, 0], clip.noise[..., 1:, :, :])
    assert torch.equal(nodes, trajectories(model, clip))


def test_the_history_is_the_recorded_one(make_model, clip) -> None:
    model = make_model(0)
    other = clip.latents.clone()
    other[..., 1:3, :, :] += 1.0
    nodes, changed = trajectories(model, clip), trajectories(model, clip, latents=other)
    assert torch.equal(nodes[..., :2, :, :], changed[..., :2, :, :])
    assert not torch.allclose(nodes[:, -1, ..., 2:, :, :], changed[:, -1, ..., 2:, :, :])


def test_later_controls_do_not_reach_earlier_blocks(make_model, clip) -> None:
    model = make_model(0)
    maps = clip.maps.clone()
    maps[..., 3:, :, :] += 1.0
    before, after = trajectories(model, clip), trajectories(model, clip, maps=maps)
    assert torch.equal(before[..., :2, :, :], after[..., :2, :, :])
    assert not torch.allclose(before[:, -1, ..., 2:, :, :], after[:, -1, ..., 2:, :, :])


def test_cached_nodes_agree_with_the_teacher_forcing_pass(make_model, clip) -> None:
    model = make_model(0)
    nodes = trajectories(model, clip)
    noisy = torch.cat((clip.latents[..., :1, :, :], clip.noise[..., 1:, :, :]), dim=3)
    with torch.no_grad():
        velocity = model.forward_teacher_forcing(
            noisy, clip.latents, torch.ones(2, 2), action_maps=clip.maps, spec=clip.spec, views=clip.views
        )
    first = noisy + (NODES[1] - NODES[0]) * velocity
    torch.testing.assert_close(nodes[:, 1], first[..., 1:, :, :], rtol=1e-4, atol=1e-5)
