"""Teacher trajectories, and regression on them: a perfect student costs nothing, and every part pulls the right way."""

import itertools

import pytest
import torch

from worldline_core.distillation.causal_objective import block_sigmas, frame_sigmas
from worldline_core.distillation.causal_teacher_forcing import teacher_forcing_loss
from worldline_core.distillation.distill_config import DistillConfig
from worldline_core.distillation.teacher_trajectories import (
    TrajectoryBatch,
    euler_nodes,
    substep_sigmas,
    teacher_trajectories,
)
from worldline_core.distillation.trajectory_regression import TrajectoryObjective, draw_nodes, node_of_each_block
from worldline_core.model.world_model_config import CAUSAL_SIGMAS as NODES
from worldline_core.training.training_config import LossWeighting, SigmaSampling


@pytest.mark.parametrize("substeps", [(1, 1, 1, 1), (2, 2, 3, 9)])
def test_euler_is_exact_on_a_straight_field(substeps):
    generator = torch.Generator().manual_seed(0)
    clean, noise = torch.randn(2, 3, 4, generator=generator, dtype=torch.float64)
    states = euler_nodes(lambda state, sigma: noise - clean, noise, substeps, NODES)
    assert len(states) == len(NODES)
    for sigma, state in zip(NODES, states, strict=True):
        torch.testing.assert_close(state, (1 - sigma) * clean + sigma * noise)


def test_finer_substeps_come_closer_to_the_true_flow():
    # dx/dsigma = x has the solution x(sigma) = x(1) exp(sigma - 1).
    noise = torch.ones(1, dtype=torch.float64)
    exact = torch.exp(torch.tensor(-1.0, dtype=torch.float64))
    found = [euler_nodes(lambda state, sigma: state, noise, (count,) * 4, NODES)[-1] for count in (1, 4, 16)]
    errors = [abs(end - exact).item() for end in found]
    assert errors[0] > 3 * errors[1] > 9 * errors[2] > 0


def test_substeps_end_on_the_nodes_and_descend():
    levels = substep_sigmas(5 / 8, 0.0, 5)
    assert (levels[0], levels[-1], len(levels)) == (5 / 8, 0.0, 6)
    assert all(a > b for a, b in itertools.pairwise(levels))
    # Two sub-steps of the whole range meet in the middle of the unshifted schedule: 5 / 6 at one half.
    assert substep_sigmas(1.0, 0.0, 2)[1] == pytest.approx(5 / 6)


def test_a_node_is_picked_for_each_block():
    nodes = torch.arange(5.0).reshape(1, 5, 1, 1, 1, 1, 1).expand(1, 5, 3, 4, 4, 2, 2)
    picked = node_of_each_block(nodes, torch.tensor([[3, 1]]), block_size=2)
    assert picked.shape == (1, 3, 4, 4, 2, 2)
    assert picked[0, 0, 0, :, 0, 0].tolist() == [3, 3, 1, 1]


def trajectories(model, clip, *, latents=None, maps=None):
    return teacher_trajectories(
        model, clip.latents if latents is None else latents, clip.maps if maps is None else maps, clip.noise,
        views=clip.views, spec=clip.spec, substeps=(1, 1, 1, 2),
    )  # fmt: skip


def test_trajectories_start_at_the_noise_and_are_repeatable(make_model, clip):
    model = make_model(0)
    nodes = trajectories(model, clip)
    assert nodes.shape == (2, 5, 3, 4, 4, 4, 4)
    assert torch.equal(nodes[:, 0], clip.noise[..., 1:, :, :])
    assert torch.equal(nodes, trajectories(model, clip))


@pytest.mark.parametrize(("name", "begins"), [("latents", 1), ("maps", 3)])
def test_the_history_is_the_recorded_one_and_nothing_later_reaches_a_block(make_model, clip, name, begins):
    model, other = make_model(0), getattr(clip, name).clone()
    other[..., begins : begins + 2, :, :] += 1.0
    nodes, changed = trajectories(model, clip), trajectories(model, clip, **{name: other})
    assert torch.equal(nodes[..., :2, :, :], changed[..., :2, :, :])
    assert not torch.allclose(nodes[:, -1, ..., 2:, :, :], changed[:, -1, ..., 2:, :, :])


def test_cached_nodes_agree_with_the_teacher_forcing_pass(make_model, clip):
    model = make_model(0)
    nodes = trajectories(model, clip)
    noisy = torch.cat((clip.latents[..., :1, :, :], clip.noise[..., 1:, :, :]), dim=3)
    with torch.no_grad():
        velocity = model.forward_teacher_forcing(
            noisy, clip.latents, torch.ones(2, 2), action_maps=clip.maps, spec=clip.spec, views=clip.views
        )
    first = noisy + (NODES[1] - NODES[0]) * velocity
    torch.testing.assert_close(nodes[:, 1], first[..., 1:, :, :], rtol=1e-4, atol=1e-5)


class StraightStudent:
    """A student that knows the straight path between `clean` and `noise`."""

    def __init__(self, clean, noise):
        self.answer = noise - clean

    def forward_teacher_forcing(self, noisy, clean, sigma, *, action_maps, spec, views, fps):
        velocity = self.answer.clone()
        velocity[..., :1, :, :] = 0
        return velocity


def straight_nodes(clean, noise):
    return torch.stack([((1 - s) * clean + s * noise)[..., 1:, :, :] for s in NODES], dim=1)


def loss_of(student, nodes, clip, index, **options):
    values = {"clips": {"lengths": [17]}, "block_size": 2, "trajectory_regression": options}
    config = DistillConfig.model_validate(values)
    batch = TrajectoryBatch((), clip.views, clip.latents, clip.maps, nodes=nodes, history=clip.latents, mask=clip.mask)
    return TrajectoryObjective(student, config, None).regression(batch, index)


@pytest.mark.parametrize("node", range(4))
def test_a_perfect_student_has_no_loss(clip, node):
    nodes = straight_nodes(clip.latents, clip.noise)
    index = torch.full((2, 2), node)
    total, _ = loss_of(StraightStudent(clip.latents, clip.noise), nodes, clip, index)
    assert total.item() == pytest.approx(0.0, abs=1e-6)
    _, wrong = loss_of(StraightStudent(clip.latents, clip.noise + 0.1), nodes, clip, index)
    sigma, step = NODES[node], NODES[node] - NODES[node + 1]
    assert wrong["next"].item() == pytest.approx(4 * (0.1 * step) ** 2, rel=1e-3)
    assert wrong["terminal"].item() == pytest.approx((0.1 * sigma) ** 2, rel=1e-3)


def test_parts_are_weighted(clip):
    nodes = straight_nodes(clip.latents, clip.noise)
    student = StraightStudent(clip.latents, clip.noise + 0.1)
    nothing = dict.fromkeys(("anchor", "boundary", "lpips", "robot", "robot_motion"), 0)
    options = {"next_weight": 3.0, "terminal_weight": 7.0, "auxiliary": nothing}
    total, terms = loss_of(student, nodes, clip, torch.full((2, 2), 3), **options)
    assert set(terms) == {"next", "terminal"}
    assert total.item() == pytest.approx((3 * terms["next"] + 7 * terms["terminal"]).item())


def test_every_node_is_drawn_and_every_block_has_its_noise_level():
    index = draw_nodes(64, 2, 4, torch.Generator().manual_seed(0))
    assert set(index.flatten().tolist()) == {0, 1, 2, 3}
    sigma = block_sigmas(SigmaSampling(), 8, 9, 4, torch.Generator().manual_seed(0))
    levels = frame_sigmas(sigma, 4)
    assert (sigma.shape, levels.shape) == ((8, 2), (8, 9))
    assert not torch.allclose(sigma[:, 0], sigma[:, 1])
    assert not levels[:, 0].any() and torch.equal(levels[:, 1:5], sigma[:, :1].expand(8, 4))


def test_teacher_forcing_trains_every_block_on_recorded_history(make_model, clip):
    model = make_model(0)

    def loss(latents, maps, history=None):
        return teacher_forcing_loss(
            model, latents, maps, history=history, views=clip.views, spec=clip.spec, sampling=SigmaSampling(),
            weighting=LossWeighting(), generator=torch.Generator().manual_seed(5),
        )  # fmt: skip

    value = loss(clip.latents, clip.maps)
    value.backward()
    assert all(p.grad is not None and bool(p.grad.isfinite().all()) for p in model.parameters())
    assert torch.equal(loss(clip.latents, clip.maps), value)
    changed = clip.latents.clone()
    changed[..., 1:3, :, :] += 0.5
    assert not torch.allclose(loss(clip.latents, clip.maps, history=changed), value)
