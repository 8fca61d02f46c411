"""Trajectory regression: a perfect student costs nothing, and every part pulls the right way."""

from __future__ import annotations

import pytest
import torch

from worldline_core.distillation.causal_objective import block_sigmas, frame_sigmas
from worldline_core.distillation.causal_teacher_forcing import teacher_forcing_loss
from worldline_core.distillation.distill_config import DistillConfig
from worldline_core.distillation.teacher_trajectories import TrajectoryBatch
from worldline_core.distillation.trajectory_regression import TrajectoryObjective, draw_nodes
from worldline_core.model.world_model_config import CAUSAL_SIGMAS as NODES
from worldline_core.training.training_config import LossWeighting, SigmaSampling


class StraightStudent:
    """A student that knows the straight path between `clean` and `noise`."""

    def __init__(self, clean: torch.Tensor, noise: torch.Tensor) -> None:
        self.answer = noise - clean

    def forward_teacher_forcing(self, noisy, clean, sigma, *, action_maps, spec, views, fps):
        velocity = self.answer.clone()
        velocity[..., :1, :, :] = 0
        return velocity


def straight_nodes(clean: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
    return torch.stack([((1 - s) * clean + s * noise)[..., 1:, :, :] for s in NODES], dim=1)


def loss_of(student, nodes, clip, index, **options):
    config = DistillConfig.model_validate(
        {"clips": {"lengths": [17]}, "block_size": 2, "trajectory_regression": options}
    )
    batch = TrajectoryBatch((), clip.views, clip.latents, clip.maps, nodes=nodes, history=clip.latents, mask=clip.mask)
    return TrajectoryObjective(student, config, None).regression(batch, index)


@pytest.mark.parametrize("node", range(4))
def test_a_perfect_student_has_no_loss(clip, node: int) -> None:
    nodes = straight_nodes(clip.latents, clip.noise)
    index = torch.full((2, 2), node)
    total, _ = loss_of(StraightStudent(clip.latents, clip.noise), nodes, clip, index)
    assert total.item() == pytest.approx(0.0, abs=1e-6)
    _, wrong = loss_of(StraightStudent(clip.latents, clip.noise + 0.1), nodes, clip, index)
    sigma, step = NODES[node], NODES[node] - NODES[node + 1]
    assert wrong["next"].item() == pytest.approx(4 * (0.1 * step) ** 2, rel=1e-3)
    assert wrong["terminal"].item() == pytest.approx((0.1 * sigma) ** 2, rel=1e-3)


def test_parts_are_weighted(clip) -> None:
    nodes = straight_nodes(clip.latents, clip.noise)
    student = StraightStudent(clip.latents, clip.noise + 0.1)
    nothing = dict.fromkeys(("anchor", "boundary", "lpips", "robot", "robot_motion"), 0)
    options = {"next_weight": 3.0, "terminal_weight": 7.0, "auxiliary": nothing}
    total, terms = loss_of(student, nodes, clip, torch.full((2, 2), 3), **options)
    assert set(terms) == {"next", "terminal"}
    assert total.item() == pytest.approx((3 * terms["next"] + 7 * terms["terminal"]).item())


def test_training_on_trajectories_lowers_the_loss(make_model, clip) -> None:
    student = make_model(3)
    nodes = straight_nodes(clip.latents, clip.noise)
    optimiser = torch.optim.AdamW(student.parameters(), lr=1e-2)
    index = torch.tensor([[0, 1], [2, 3]])
    losses = []
    for _ in range(40):
        loss, _ = loss_of(student, nodes, clip, index)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert losses[-1] < 0.8 * losses[0]


def test_every_node_is_drawn() -> None:
    index = draw_nodes(64, 2, 4, torch.Generator().manual_seed(0))
    assert sorted(set(index.flatten().tolist())) == [0, 1, 2, 3]


def test_noise_levels_of_teacher_forcing() -> None:
    sigma = block_sigmas(SigmaSampling(), 8, 9, 4, torch.Generator().manual_seed(0))
    assert sigma.shape == (8, 2)
    assert not torch.allclose(sigma[:, 0], sigma[:, 1])
    levels = frame_sigmas(sigma, 4)
    assert levels.shape == (8, 9)
    assert bool((levels[:, 0] == 0).all())
    assert torch.equal(levels[:, 1:5], sigma[:, :1].expand(8, 4))


def test_teacher_forcing_trains_every_block_on_recorded_history(make_model, clip) -> None:
    model = make_model(0)

    def loss(latents, maps, history=None) -> torch.Tensor:
        return teacher_forcing_loss(
            model,
            latents,
            maps,
            history=history,
            views=clip.views,
            spec=clip.spec,
            sampling=SigmaSampling(),
            weighting=LossWeighting(),
            generator=torch.Generator().manual_seed(5),
        )

    value = loss(clip.latents, clip.maps)
    value.backward()
    assert all(p.grad is not None and bool(p.grad.isfinite().all()) for p in model.parameters())
    assert torch.equal(loss(clip.latents, clip.maps), value)
    changed = clip.latents.clone()
    changed[..., 1:3, :, :] += 0.5
    assert not torch.allclose(loss(clip.latents, clip.maps, history=changed), value)
