"""Robot-focused losses: what the robot region of a predicted clip must reproduce (paper, Stage III).

Few-step students tend to spend their capacity on the static background.  These two terms look only at the
robot: an L2 distance on its latents and an L1 distance on their temporal differences, each divided by the area
of the mask so that a distant robot counts as much as a near one, the wrist views twice.

Axes: b clips, v views, c latent channels, t latent frames, h and w latent rows and columns.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from einops import reduce
from jaxtyping import Float
from torch import Tensor

from worldline_core.errors import ConfigError

HEAD_VIEW = "head"


def view_weights(views: Sequence[str], wrist_weight: float = 2.0) -> Float[Tensor, " v"]:
    """Weight of each view: 1 for the head, `wrist_weight` for every other one (appendix, 2 in the paper)."""
    if not views:
        raise ConfigError("the robot losses need at least one view", expected="a list of view names", got="[]")
    return torch.tensor([1.0 if view == HEAD_VIEW else wrist_weight for view in views])


def mask_normalised_mean(
    error: Float[Tensor, "b v t h w"], mask: Float[Tensor, "b v t h w"], weights: Float[Tensor, " v"]
) -> Float[Tensor, ""]:
    """Mean of `error` inside `mask` per clip and view, then the weighted mean over clips and views.

    A clip-view pair in which no robot is visible takes no part, with neither its error nor its weight; a batch
    without any robot costs exactly zero (and stays differentiable).
    """
    area = reduce(mask, "b v t h w -> b v", "sum")
    total = reduce(error * mask, "b v t h w -> b v", "sum")
    present = (area > 0).to(error.dtype) * weights.to(error)
    per_view = total / area.clamp_min(torch.finfo(area.dtype).eps)
    return (per_view * present).sum() / present.sum().clamp_min(1.0)


def robot_reconstruction_loss(
    predicted: Float[Tensor, "b v c t h w"],
    target: Float[Tensor, "b v c t h w"],
    mask: Float[Tensor, "b v t h w"],
    weights: Float[Tensor, " v"],
) -> Float[Tensor, ""]:
    """L_robot: squared error on the robot's latents (first term of L_RF), mean over channels and mask area."""
    error = reduce((predicted - target) ** 2, "b v c t h w -> b v t h w", "mean")
    return mask_normalised_mean(error, mask, weights)


def robot_motion_loss(
    predicted: Float[Tensor, "b v c t h w"],
    target: Float[Tensor, "b v c t h w"],
    mask: Float[Tensor, "b v t h w"],
    weights: Float[Tensor, " v"],
) -> Float[Tensor, ""]:
    """L_Δrobot: absolute error on the differences of neighbouring latent frames (second term of L_RF).

    A difference belongs to the robot when the robot covers the cell in either of its two frames: where it leaves
    matters as much as where it arrives.  A single frame has no difference and costs zero.
    """
    if predicted.shape[3] < 2:
        return (predicted * 0.0).sum()
    error = (predicted.diff(dim=3) - target.diff(dim=3)).abs()
    either = torch.maximum(mask[:, :, 1:], mask[:, :, :-1])
    return mask_normalised_mean(reduce(error, "b v c t h w -> b v t h w", "mean"), either, weights)
