"""Auxiliary objectives of Stage III and their weights (appendix, "Score-Based Distribution Matching").

Axes: b clips, v views, c latent channels, t latent frames (the observed one first), h and w rows and columns.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from worldline_core.config.base import StrictModel
from worldline_core.distillation.robot_losses import robot_motion_loss, robot_reconstruction_loss, view_weights

PerceptualDistance = Callable[[Tensor, Tensor], Tensor]
"""Distance of two latent clips `b v c t h w` after decoding; see `perceptual.py`."""


class AuxiliaryWeights(StrictModel):
    """Weights of the auxiliaries; the defaults are the paper's. A weight of 0 turns its term off."""

    anchor: float = Field(default=0.005, ge=0)
    boundary: float = Field(default=0.05, ge=0)
    lpips: float = Field(default=0.005, ge=0)
    robot: float = Field(default=0.005, ge=0)
    robot_motion: float = Field(default=0.1, ge=0)
    wrist_view: float = Field(default=2.0, gt=0, description="weight of a wrist view against the head view")


def anchor_loss(predicted: Float[Tensor, "b v c t h w"], target: Float[Tensor, "b v c t h w"]) -> Float[Tensor, ""]:
    """L_anchor: mean squared distance from the target latents; keeps the student near known good clips."""
    return ((predicted - target) ** 2).mean()


def boundary_loss(
    predicted: Float[Tensor, "b v c t h w"], target: Float[Tensor, "b v c t h w"], block_size: int
) -> Float[Tensor, ""]:
    """L_boundary: squared error of the step across each block boundary.

    Boundaries are between latent frame 0 (observed) and the first block and between consecutive blocks: latent
    frames (0, 1), (n, n+1), (2n, 2n+1), ... for blocks of n frames.  The next block starts from independent noise,
    so only the cached history carries continuity; this term measures it where a jump would show.
    """
    step_predicted = (predicted[:, :, :, 1:] - predicted[:, :, :, :-1])[:, :, :, ::block_size]
    step_target = (target[:, :, :, 1:] - target[:, :, :, :-1])[:, :, :, ::block_size]
    return ((step_predicted - step_target) ** 2).mean()


def enabled_terms(weights: AuxiliaryWeights, *, perceptual: bool) -> tuple[str, ...]:
    """Names of the terms that :func:`auxiliary_losses` reports under these weights."""
    names = ("anchor", "boundary", "lpips", "robot", "robot_motion")
    return tuple(name for name in names if getattr(weights, name) and (perceptual or name != "lpips"))


@dataclass(frozen=True)
class AuxiliaryLosses:
    """Weighted sum of the auxiliaries and the plain value of each, for the metrics."""

    total: Tensor
    terms: dict[str, Tensor]


def auxiliary_losses(
    predicted: Float[Tensor, "b v c t h w"],
    target: Float[Tensor, "b v c t h w"],
    *,
    mask: Float[Tensor, "b v t h w"] | None,
    views: Sequence[str],
    block_size: int,
    weights: AuxiliaryWeights,
    perceptual: PerceptualDistance | None = None,
) -> AuxiliaryLosses:
    """All auxiliaries of `predicted` against `target`, observed frame included in both.

    `mask` may be None only where no robot term is wanted (both robot weights 0); `perceptual` None leaves LPIPS
    out, which the caller reports.
    """
    terms: dict[str, tuple[float, Tensor]] = {}
    if weights.anchor:
        terms["anchor"] = (weights.anchor, anchor_loss(predicted, target))
    if weights.boundary:
        terms["boundary"] = (weights.boundary, boundary_loss(predicted, target, block_size))
    if weights.lpips and perceptual is not None:
        terms["lpips"] = (weights.lpips, perceptual(predicted, target))
    if mask is not None and (weights.robot or weights.robot_motion):
        per_view = view_weights(views, weights.wrist_view).to(predicted)
        if weights.robot:
            terms["robot"] = (weights.robot, robot_reconstruction_loss(predicted, target, mask, per_view))
        if weights.robot_motion:
            terms["robot_motion"] = (
                weights.robot_motion,
                robot_motion_loss(predicted, target, mask, per_view),
            )
    total = (predicted * 0.0).sum()
    for weight, value in terms.values():
        total = total + weight * value
    return AuxiliaryLosses(total, {name: value.detach() for name, (_, value) in terms.items()})
