"""Stage III, step 2: four-step trajectory regression (appendix, "Four-Step Trajectory Regression").

    L_traj = lambda_next sum_k ||z^(k+1) - z_T^(k+1)||^2 + lambda_terminal ||z^clean - z_T^clean||^2 + L_aux

The student starts at a node of the teacher's trajectory, takes one Euler step to the next node, and its clean
prediction is compared with the teacher's clean end. A node is drawn for every block of every clip, so the sum over
nodes is taken in expectation (times K); all blocks are trained in one teacher-forcing pass.
"""

from __future__ import annotations

import torch
from einops import rearrange
from jaxtyping import Float, Int
from torch import Tensor

from worldline_core.distillation.auxiliary_losses import PerceptualDistance, auxiliary_losses
from worldline_core.distillation.causal_objective import CausalObjective, frame_sigmas, maps_of, with_observed_frame
from worldline_core.distillation.distill_config import DistillConfig
from worldline_core.distillation.teacher_trajectories import TrajectoryBatch
from worldline_core.model.world_model import WorldModel
from worldline_core.training.flow_matching import broadcast_sigma


class TrajectoryObjective(CausalObjective[TrajectoryBatch]):
    """Regression of the teacher's trajectories."""

    def __init__(self, model: WorldModel, config: DistillConfig, perceptual: PerceptualDistance | None) -> None:
        super().__init__(model, config)
        self.perceptual = perceptual

    def loss(self, batch: TrajectoryBatch, generator: torch.Generator, step: int) -> tuple[Tensor, dict[str, float]]:
        """Trajectory loss of one batch, and its parts."""
        del step
        blocks = (batch.latents.shape[3] - 1) // self.spec.block_size
        total, terms = self.regression(batch, draw_nodes(len(batch.latents), blocks, self.spec.steps, generator))
        return total, {name: value.item() for name, value in terms.items()}

    def regression(
        self, batch: TrajectoryBatch, index: Int[Tensor, "b blocks"]
    ) -> tuple[Float[Tensor, ""], dict[str, Tensor]]:
        """Regression of the next node and of the clean end, plus the auxiliaries against the teacher's clean end.

        Returns:
            The weighted total, and its parts.

        Args:
            index: node of each block, see :func:`draw_nodes`.
        """
        spec, config, nodes = self.spec, self.config.trajectory_regression, batch.nodes
        first = batch.history[..., :1, :, :]
        levels = torch.tensor(spec.sigmas, device=nodes.device, dtype=nodes.dtype)
        state = with_observed_frame(first, node_of_each_block(nodes, index, spec.block_size))
        following = with_observed_frame(first, node_of_each_block(nodes, index + 1, spec.block_size))
        end = with_observed_frame(first, nodes[:, -1])
        sigma, sigma_next = levels[index], levels[index + 1]
        velocity = self.model.forward_teacher_forcing(
            state, batch.history, sigma, action_maps=maps_of(batch), spec=spec, views=batch.views, fps=batch.fps
        ).float()
        here = broadcast_sigma(frame_sigmas(sigma, spec.block_size))
        there = broadcast_sigma(frame_sigmas(sigma_next, spec.block_size))
        stepped = state + (there - here) * velocity
        predicted = state - here * velocity
        # Frame 0 is the observation in both: it adds nothing and is left out of the means.
        next_loss = spec.steps * ((stepped - following)[..., 1:, :, :] ** 2).mean()
        terminal_loss = ((predicted - end)[..., 1:, :, :] ** 2).mean()
        auxiliary, terms = auxiliary_losses(predicted, end, batch, spec.block_size, config.auxiliary, self.perceptual)
        total = config.next_weight * next_loss + config.terminal_weight * terminal_loss + auxiliary
        return total, {"next": next_loss.detach(), "terminal": terminal_loss.detach(), **terms}


def draw_nodes(clips: int, blocks: int, steps: int, generator: torch.Generator) -> Int[Tensor, "b blocks"]:
    """A noisy node, 0 (pure noise) to K - 1 (K = `steps`), for every block, all equally likely."""
    return torch.randint(steps, (clips, blocks), generator=generator, device=generator.device)


def node_of_each_block(
    nodes: Float[Tensor, "b k v c u h w"], index: Tensor, block_size: int
) -> Float[Tensor, "b v c u h w"]:
    """The state of every block at the node that `index` (b, blocks) names for it."""
    split = rearrange(nodes, "b k v c (n s) h w -> b n k v c s h w", s=block_size)
    clips = torch.arange(index.shape[0], device=index.device)[:, None]
    blocks = torch.arange(index.shape[1], device=index.device)[None, :]
    return rearrange(split[clips, blocks, index], "b n v c s h w -> b v c (n s) h w")
