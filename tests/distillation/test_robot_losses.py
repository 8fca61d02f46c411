"""Robot-focused losses: area normalisation, wrist weight, nothing outside of the mask."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from worldline_core.distillation.auxiliary_losses import (
    auxiliary_losses,
    boundary_loss,
    robot_motion_loss,
    robot_reconstruction_loss,
    view_weights,
)
from worldline_core.distillation.distill_config import AuxiliaryWeights

VIEWS = ("head", "left_wrist", "right_wrist")
SHAPE = (2, 3, 4, 5, 4, 6)


def zeros() -> torch.Tensor:
    return torch.zeros(SHAPE)


def full_mask() -> torch.Tensor:
    return torch.ones(2, 3, 5, 4, 6)


def test_wrist_views_weigh_twice() -> None:
    assert view_weights(VIEWS).tolist() == [1.0, 2.0, 2.0]


def test_loss_does_not_depend_on_the_area_of_the_mask() -> None:
    weights = view_weights(VIEWS)
    small = torch.zeros(2, 3, 5, 4, 6)
    small[..., 1, 2] = 1
    for mask in (small, full_mask()):
        assert robot_reconstruction_loss(zeros() + 0.5, zeros(), mask, weights).item() == pytest.approx(0.25)


def test_errors_outside_of_the_mask_cost_nothing() -> None:
    mask = full_mask()
    mask[..., 2:, :] = 0
    predicted = zeros()
    predicted[..., 2:, :] = torch.randn(*SHAPE[:-2], 2, 6)
    weights = view_weights(VIEWS)
    assert robot_reconstruction_loss(predicted, zeros(), mask, weights).item() == 0
    assert robot_motion_loss(predicted, zeros(), mask, weights).item() == 0
    predicted[0, 0, 0, 0, 0, 0] = 1.0
    assert robot_reconstruction_loss(predicted, zeros(), mask, weights).item() > 0


def test_an_error_in_a_wrist_view_costs_twice_that_of_the_head_view() -> None:
    weights = view_weights(VIEWS)
    losses = []
    for view in range(3):
        predicted = zeros()
        predicted[:, view] = 1.0
        losses.append(robot_reconstruction_loss(predicted, zeros(), full_mask(), weights).item())
    assert losses == pytest.approx([0.2, 0.4, 0.4])


def test_views_without_a_robot_take_no_part() -> None:
    mask = full_mask()
    mask[:, 1:] = 0
    predicted = zeros() + 1.0
    assert robot_reconstruction_loss(predicted, zeros(), mask, view_weights(VIEWS)).item() == pytest.approx(1.0)
    predicted.requires_grad_()
    nothing = robot_reconstruction_loss(predicted, zeros(), torch.zeros_like(mask), view_weights(VIEWS))
    nothing.backward()
    assert nothing.item() == 0
    assert not bool(predicted.grad.any())


def test_motion_loss_sees_temporal_differences_only() -> None:
    weights = view_weights(VIEWS)
    constant_offset = zeros() + 3.0
    assert robot_motion_loss(constant_offset, zeros(), full_mask(), weights).item() == 0
    moving = torch.arange(5.0).reshape(1, 1, 1, 5, 1, 1).expand(SHAPE)
    assert robot_motion_loss(moving, zeros(), full_mask(), weights).item() == pytest.approx(1.0)
    one_frame = moving[..., :1, :, :]
    assert robot_motion_loss(one_frame, one_frame + 1, full_mask()[:, :, :1], weights).item() == 0


def test_motion_counts_where_the_robot_is_in_either_frame() -> None:
    mask = torch.zeros(2, 3, 5, 4, 6)
    mask[:, :, 0] = 1
    moving = zeros()
    moving[:, :, :, 1] = 1.0
    # The only differences with the robot in one of their frames are those between frames 0 and 1.
    assert robot_motion_loss(moving, zeros(), mask, view_weights(VIEWS)).item() == pytest.approx(1.0)


def test_boundary_loss_looks_at_the_steps_between_blocks() -> None:
    target = zeros()
    inside = zeros()
    inside[:, :, :, 2] += 1.0
    inside[:, :, :, 1] += 1.0
    # Frames 1 and 2 are one block: the steps into it (0 to 1) and out of it (2 to 3) are wrong by one each.
    assert boundary_loss(inside, target, block_size=2).item() == pytest.approx(1.0)
    within = zeros()
    within[:, :, :, 4] += 1.0
    assert boundary_loss(within, target, block_size=2).item() == 0


def test_auxiliaries_are_weighted_as_configured() -> None:
    predicted, target = zeros() + 1.0, zeros()
    batch = SimpleNamespace(views=VIEWS, mask=full_mask())
    only_robot = AuxiliaryWeights(anchor=0, boundary=0, lpips=0, robot=0.5, robot_motion=0)
    total, terms = auxiliary_losses(predicted, target, batch, 2, only_robot)
    assert set(terms) == {"robot"}
    assert total.item() == pytest.approx(0.5)
    total, terms = auxiliary_losses(predicted, target, batch, 2, AuxiliaryWeights(), lambda a, b: (a - b).abs().mean())
    assert set(terms) == {"anchor", "boundary", "lpips", "robot", "robot_motion"}
    assert total.item() == pytest.approx(0.005 + 0.0 + 0.005 + 0.005)


def test_paper_weights_are_the_defaults() -> None:
    weights = AuxiliaryWeights()
    assert (weights.anchor, weights.boundary, weights.lpips) == (0.005, 0.05, 0.005)
    assert (weights.robot, weights.robot_motion) == (0.005, 0.1)
