"""What a block learns from in teacher forcing: the recording, or the model's own blocks and Stage II's prediction."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from pydantic import ValidationError

from worldline_core.distillation import causal_teacher_forcing
from worldline_core.distillation.causal_objective import maps_of, self_forced_rollout
from worldline_core.distillation.causal_teacher_forcing import TeacherForcingObjective
from worldline_core.distillation.distill_config import DistillConfig
from worldline_core.model.world_model import WorldModel
from worldline_core.pipeline.memory_estimate import Sources, Training, trainings
from worldline_core.training.clip_loader import Batch

VIEWS = ("head", "left_wrist", "right_wrist")
FRAMES = 7  # the observed latent frame and three blocks of two


def config_of(**teacher_forcing: Any) -> DistillConfig:
    return DistillConfig.model_validate(
        {
            "clips": {"lengths": [1 + 4 * (FRAMES - 1)]},
            "block_size": 2,
            "sigmas": [1.0, 0.0],
            "teacher_forcing": teacher_forcing,
            "trajectory_regression": {"trajectories": {"substeps": [1]}},
        }
    )


def batch_of() -> Batch:
    generator = torch.Generator().manual_seed(4)
    latents = torch.randn(2, 3, 4, FRAMES, 4, 4, generator=generator)
    maps = torch.randn(2, 3, 9, FRAMES, 4, 4, generator=generator)
    return Batch((), VIEWS, latents, maps, fps=torch.tensor([8.0, 30.0]))


@pytest.fixture
def shown(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What the loss is given."""
    given: dict[str, Any] = {}

    def loss(model: WorldModel, latents: torch.Tensor, maps: torch.Tensor, **named: Any) -> torch.Tensor:
        given.update(named, latents=latents)
        return latents.sum()

    monkeypatch.setattr(causal_teacher_forcing, "teacher_forcing_loss", loss)
    return given


def noise_of(batch: Batch) -> torch.Tensor:
    return torch.randn(batch.latents.shape, generator=torch.Generator().manual_seed(5))


def test_a_block_sees_what_the_model_itself_makes_of_the_blocks_before(
    make_model: Callable[..., WorldModel], shown: dict[str, Any]
) -> None:
    model, batch, settings = make_model(0, fps=15.0), batch_of(), config_of(history="generated")
    TeacherForcingObjective(model, settings).loss(batch, torch.Generator().manual_seed(5), 0)
    earlier = slice(0, FRAMES - 2)
    own = self_forced_rollout(
        model,
        batch.latents[..., :1, :, :],
        maps_of(batch)[..., earlier, :, :],
        noise_of(batch)[..., earlier, :, :],
        0,
        views=VIEWS,
        spec=settings.spec,
        fps=batch.fps,
        with_gradient=False,
    )
    torch.testing.assert_close(shown["history"][..., earlier, :, :], own)
    assert not shown["history"].requires_grad
    assert torch.equal(shown["latents"], batch.latents)


def test_stage2_says_in_part_what_blocks_of_clips_it_knows_should_become(
    make_model: Callable[..., WorldModel], shown: dict[str, Any]
) -> None:
    model, teacher, batch = make_model(0, fps=15.0), make_model(1, fps=15.0), batch_of()

    def target(**settings: Any) -> torch.Tensor:
        objective = TeacherForcingObjective(model, config_of(**settings), teacher)
        objective.loss(batch, torch.Generator().manual_seed(5), 0)
        return shown["latents"]

    state = torch.cat((batch.latents[..., :1, :, :], noise_of(batch)[..., 1:, :, :]), dim=3)
    velocity = teacher(state, torch.ones(2), action_maps=maps_of(batch), views=VIEWS, fps=batch.fps).velocity
    predicted = torch.cat((batch.latents[..., :1, :, :], (state - velocity)[..., 1:, :, :]), dim=3).detach()
    torch.testing.assert_close(target(teacher_share=1.0), predicted)
    torch.testing.assert_close(target(teacher_share=0.25), 0.75 * batch.latents + 0.25 * predicted)
    assert torch.equal(target(teacher_share=1.0, teacher_frames=4 * (FRAMES - 2) + 1), batch.latents)
    assert not any(parameter.requires_grad for parameter in teacher.parameters())


def test_the_teacher_is_in_the_memory_sheet(
    make_model: Callable[..., WorldModel], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Training, "activations", lambda *_args, **_named: 100)

    def planned(**settings: Any) -> Any:
        source = Sources(None, None, (32, 32), (4, 4))
        return trainings(config_of(**settings), make_model(0).config, source)[0].estimate(1)

    alone, taught = planned(), planned(teacher_share=0.5)
    assert "frozen scores" not in alone.parts
    assert taught.parts["frozen scores"] == 4 * taught.parameters


def test_noise_is_of_recorded_blocks() -> None:
    with pytest.raises(ValidationError, match="history_noise is of recorded blocks"):
        config_of(history="generated", history_noise=0.1)
