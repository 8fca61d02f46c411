"""Training sees what inference sees: every objective's pass over a long clip equals the rollout's cache, block by block."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
import torch
from pydantic import ValidationError

from worldline_core.distillation.causal_teacher_forcing import TeacherForcingObjective
from worldline_core.distillation.distill_config import DistillConfig
from worldline_core.distillation.teacher_trajectories import TrajectoryBatch
from worldline_core.distillation.trajectory_regression import TrajectoryObjective
from worldline_core.model.block_causal_attention import KVCache, block_bounds
from worldline_core.model.world_model import WorldModel

VIEWS = ("head", "left_wrist", "right_wrist")
FRAMES = 13  # the observed latent frame and six blocks of two; the window holds two blocks


def config_of() -> DistillConfig:
    return DistillConfig.model_validate(
        {
            "clips": {"lengths": [1 + 4 * (FRAMES - 1)]},
            "block_size": 2,
            "window": {"sink_blocks": 1, "recent_blocks": 1},
        }
    )


def batch_of(steps: int) -> TrajectoryBatch:
    generator = torch.Generator().manual_seed(4)
    latents = torch.randn(2, 3, 4, FRAMES, 4, 4, generator=generator)
    return TrajectoryBatch(
        clips=(),
        views=VIEWS,
        latents=latents,
        action_maps=torch.randn(2, 3, 9, FRAMES, 4, 4, generator=generator),
        fps=torch.tensor([8.0, 30.0]),
        nodes=torch.randn(2, steps + 1, 3, 4, FRAMES - 1, 4, 4, generator=generator),
        history=latents,
        mask=torch.zeros(2, 3, FRAMES, 4, 4),
    )


@torch.no_grad()
def blockwise(model: WorldModel, config: DistillConfig, given: Any) -> torch.Tensor:
    """The velocities of the same noisy blocks, as a rollout over the same clean history computes them."""
    noisy, clean, sigma, maps, _ = given
    cache, found = (
        KVCache(config.spec.sink_blocks, config.spec.recent_blocks, torch.tensor([8.0, 30.0])),
        [torch.zeros_like(noisy[..., :1, :, :])],
    )
    for block, (start, stop) in enumerate(block_bounds(FRAMES, 2)):
        own = maps[..., start:stop, :, :]
        if block:
            found.append(model.forward_block(noisy[..., start:stop, :, :], sigma[:, block - 1], cache, action_maps=own))
        model.write_block(clean[..., start:stop, :, :], cache, action_maps=own)
    return torch.cat(found, dim=3)


@pytest.mark.parametrize(
    "objective", [TeacherForcingObjective, partial(TrajectoryObjective, perceptual=None)], ids=["forcing", "regression"]
)
def test_an_objective_trains_on_what_a_rollout_sees(objective: Any, make_model: Callable[..., WorldModel]) -> None:
    config, model, seen = config_of(), make_model(0, fps=15.0), []

    def watched(*given: Any, **named: Any) -> torch.Tensor:
        velocity = WorldModel.forward_teacher_forcing(model, *given, **named)
        seen.append((*given, named["action_maps"], velocity))
        return velocity

    model.forward_teacher_forcing = watched  # type: ignore[method-assign]
    objective(model, config).loss(batch_of(config.spec.steps), torch.Generator().manual_seed(0), 5)
    (given,) = seen
    torch.testing.assert_close(given[-1], blockwise(model, config, given), rtol=1e-5, atol=1e-5)


def test_a_rollout_begins_anew_no_later_than_the_longest_trained_clip_ends() -> None:
    settings = {"clips": {"lengths": [33, 65]}, "window": {"anchor_blocks": 4}}
    assert DistillConfig.model_validate(settings).spec.anchor_blocks == 4
    with pytest.raises(ValidationError, match=r"anchor_blocks 4: the longest clip has 2 blocks"):
        DistillConfig.model_validate(settings | {"clips": {"lengths": [33]}})
