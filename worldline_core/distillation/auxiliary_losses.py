"""Auxiliary objectives of Stage III and their weights (appendix, "Score-Based Distribution Matching").

Perceptual: LPIPS of decoded frames. It needs the LPIPS weights in a local folder; without them the term is off and says
so, for a network with random weights would be no perceptual distance.

Robot-focused: few-step students spend their capacity on the static background. These two terms look only at the robot:
an L2 distance on its latents and an L1 distance on their temporal differences, each divided by the area of the mask, so
that a distant robot counts as much as a near one; the wrist views count twice. The masks come from the capsules stored
with the action tracks; they weigh losses only, no model ever receives them.

Axes: b clips, v views, c latent channels, t latent frames (the observed one first), h and w latent rows and columns.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, cast

import numpy as np
import torch
from einops import rearrange, reduce
from jaxtyping import Float
from torch import Tensor

from worldline_core.actions.episode_tracks import HEAD_VIEW, EpisodeTracks, drawn_size
from worldline_core.actions.robot_masks import kinematic_robot_masks
from worldline_core.distillation.distill_config import AuxiliaryWeights
from worldline_core.geometry.tensor_transforms import is_rigid, valid_intrinsics
from worldline_core.model.lpips import LPIPS
from worldline_core.model.tokenizers import VideoTokenizer


class PerceptualLoss:
    """Mean LPIPS of some decoded frames, differentiable in the predicted latents of these frames.

    Decoding holds far more than the model itself: gradients are computed at once, for one view after the other, so that
    never more than one view's activations are there.

    Args:
        tokenizer: decodes latents; stays frozen.
        network: LPIPS with its weights.
        latent_frames: how many latent frames, the last ones, are compared.
    """

    def __init__(self, tokenizer: VideoTokenizer, network: LPIPS, latent_frames: int = 2) -> None:
        self.tokenizer = tokenizer
        self.latent_frames = latent_frames
        self.network = network

    def __call__(
        self, predicted: Float[Tensor, "b v c t h w"], target: Float[Tensor, "b v c t h w"]
    ) -> Float[Tensor, ""]:
        """LPIPS between the last latent frames of both clips, decoded with the causal context that they need.

        That context is decoded without gradients: they reach the compared latent frames alone.
        """
        return cast("Tensor", _ViewByView.apply(predicted, target, self._of_view))

    def _of_view(self, predicted: Float[Tensor, "1 c t h w"], target: Float[Tensor, "1 c t h w"]) -> Float[Tensor, ""]:
        with torch.no_grad():
            reference = self._decode(target)
        return self.network(self._decode(predicted), reference).mean()

    def _decode(self, latents: Float[Tensor, "1 c t h w"]) -> Float[Tensor, "frames 3 height width"]:
        context = max(1, latents.shape[2] - self.latent_frames)  # the observed frame is never compared
        decoder = self.tokenizer.decoder()
        with torch.no_grad():
            decoder(latents[:, :, :context])
        video = decoder(latents[:, :, context:])
        return rearrange(video / 2 + 0.5, "n c t h w -> (n t) c h w").clamp(0, 1)


class _ViewByView(torch.autograd.Function):
    """Mean of a distance over clips and views, its gradient computed together with its value."""

    @staticmethod
    def forward(ctx: Any, predicted: Tensor, target: Tensor, distance: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
        total = predicted.new_zeros((), dtype=torch.float32)
        gradient = torch.zeros_like(predicted, dtype=torch.float32)
        pairs = predicted.shape[0] * predicted.shape[1]
        for clip in range(predicted.shape[0]):
            for view in range(predicted.shape[1]):
                leaf = predicted[clip, view][None].detach().float()
                with torch.set_grad_enabled(ctx.needs_input_grad[0]):
                    value = distance(leaf.requires_grad_(), target[clip, view][None].float())
                    if ctx.needs_input_grad[0]:
                        gradient[clip, view] = torch.autograd.grad(value, leaf)[0][0] / pairs
                total += value.detach() / pairs
        ctx.save_for_backward(gradient.to(predicted.dtype))
        return total

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:
        return gradients[0] * ctx.saved_tensors[0], None, None


def view_weights(views: Sequence[str]) -> Float[Tensor, " v"]:
    """Weight of each view: 1 for the head, 2 for every other one (appendix)."""
    return torch.tensor([1.0 if view == HEAD_VIEW else 2.0 for view in views])


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


PerceptualDistance = Callable[[Tensor, Tensor], Tensor]
"""Distance of two latent clips `b v c t h w` after decoding; see :class:`PerceptualLoss`."""


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


def auxiliary_losses(
    predicted: Float[Tensor, "b v c t h w"],
    target: Float[Tensor, "b v c t h w"],
    mask: Float[Tensor, "b v t h w"],
    views: Sequence[str],
    block_size: int,
    weights: AuxiliaryWeights,
    perceptual: PerceptualDistance | None = None,
) -> tuple[Float[Tensor, ""], dict[str, Tensor]]:
    """Weighted sum of all auxiliaries of `predicted` against `target`, and the plain value of each for the metrics.

    Both clips hold the observed frame; `mask` is where the robot is in `views`. `perceptual` None leaves LPIPS out, which the caller reports.
    """
    per_view = view_weights(views).to(predicted)
    terms: dict[str, tuple[float, Tensor]] = {}
    if weights.anchor:
        terms["anchor"] = (weights.anchor, anchor_loss(predicted, target))
    if weights.boundary:
        terms["boundary"] = (weights.boundary, boundary_loss(predicted, target, block_size))
    if weights.lpips and perceptual is not None:
        terms["lpips"] = (weights.lpips, perceptual(predicted, target))
    if weights.robot:
        terms["robot"] = (weights.robot, robot_reconstruction_loss(predicted, target, mask, per_view))
    if weights.robot_motion:
        terms["robot_motion"] = (weights.robot_motion, robot_motion_loss(predicted, target, mask, per_view))
    total = (predicted * 0.0).sum()
    for weight, value in terms.values():
        total = total + weight * value
    return total, {name: value.detach() for name, (_, value) in terms.items()}


def clip_robot_masks(
    clips: Sequence[EpisodeTracks], views: Sequence[str], grid_size: tuple[int, int]
) -> Float[Tensor, "b v t h w"]:
    """Masks (0 or 1) of clips of equal length, one for each latent frame.

    A view without a valid calibration shows no robot: its mask is empty, and the losses leave it out.

    Args:
        clips: tracks cut to every RGB frame of each clip (4 k + 1 frames).
        grid_size: (rows, columns) of the latents.

    Raises:
        ConfigError: the clips do not fit the tokenizer.
    """
    parts = max(1, *(len(clip.capsule_radii) for clip in clips))
    order = [[clip.views.index(view) for view in views] for clip in clips]
    capsules = np.stack([_padded(clip.capsules, 1, parts) for clip in clips])
    radii = np.stack([_padded(clip.capsule_radii, 0, parts) for clip in clips])
    K = torch.from_numpy(np.stack([clip.K[index] for clip, index in zip(clips, order, strict=True)]))
    cameras = torch.from_numpy(
        np.stack([clip.T_base_camera[:, index] for clip, index in zip(clips, order, strict=True)])
    )
    calibrated = valid_intrinsics(K) & is_rigid(cameras).all(dim=1)
    identity = torch.eye(4, dtype=K.dtype)
    K = torch.where(calibrated[..., None, None], K, identity[:3, :3])
    cameras = torch.where(calibrated[:, None, :, None, None], cameras, identity)
    masks = kinematic_robot_masks(
        torch.from_numpy(capsules), torch.from_numpy(radii), K, cameras, drawn_size(clips), grid_size
    )
    return masks * calibrated[:, :, None, None, None].to(masks)


def _padded(array: np.ndarray, axis: int, size: int) -> np.ndarray:
    """Zeros at the end of `axis`: a capsule of radius 0 covers nothing."""
    widths = [(0, 0)] * array.ndim
    widths[axis] = (0, size - array.shape[axis])
    return np.pad(array, widths)
