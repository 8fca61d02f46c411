from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import VIEWS
from worldline_core.training.clip_loader import Batch
from worldline_core.training.flow_matching import (
    FlowMatchingObjective,
    add_noise,
    flow_matching_loss,
    sample_sigmas,
    velocity_target,
)
from worldline_core.training.training_config import LossWeighting, SigmaSampling


def test_clips_are_placed_in_time_by_their_own_rates(
    make_model: Callable[..., WorldModel], clip: tuple[torch.Tensor, ...]
) -> None:
    sampling, weighting = SigmaSampling(), LossWeighting()

    def losses(model: WorldModel, *fps: float) -> list[float]:
        batch = Batch((), VIEWS, clip[0], fps=torch.tensor(fps) if fps else None)
        objective = FlowMatchingObjective(model, sigma=sampling, weighting=weighting)
        seed = torch.Generator().manual_seed
        return [objective.loss(batch, seed(0), 0)[0].item(), objective.validation_losses(batch, seed(0))["loss"]]

    with torch.no_grad():
        modulated, counted = make_model(fps=8.0), make_model()
        assert losses(modulated, 8.0, 8.0) == losses(modulated) != losses(modulated, 8.0, 2.0)
        assert losses(counted, 8.0, 2.0) == losses(counted)


@pytest.fixture
def clip() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    latents, noise = torch.randn(2, 2, 3, 4, 5, 2, 2, generator=generator)
    return latents, noise, torch.tensor([0.3, 0.8])


def test_noise_is_a_straight_line_and_spares_the_first_frame(clip: tuple[torch.Tensor, ...]) -> None:
    latents, noise, sigma = clip
    noisy = add_noise(latents, noise, sigma)
    assert torch.equal(noisy[:, :, :, 0], latents[:, :, :, 0])
    torch.testing.assert_close(noisy[1, :, :, 2], 0.2 * latents[1, :, :, 2] + 0.8 * noise[1, :, :, 2])
    # z = z_sigma - sigma v
    recovered = noisy[1] - 0.8 * velocity_target(latents, noise)[1]
    torch.testing.assert_close(recovered[:, :, 1:], latents[1, :, :, 1:])


@pytest.mark.parametrize("weighting", [LossWeighting(), LossWeighting(kind="sample", motion=2.0)])
def test_first_frame_carries_no_loss(clip: tuple[torch.Tensor, ...], weighting: LossWeighting) -> None:
    latents, noise, sigma = clip
    velocity = velocity_target(latents, noise)
    wrong_first = velocity.clone()
    wrong_first[:, :, :, 0] += 100
    assert flow_matching_loss(wrong_first, latents, noise, sigma, weighting).item() == 0.0
    wrong_later = velocity.clone()
    wrong_later[:, :, :, 1] += 1
    assert flow_matching_loss(wrong_later, latents, noise, sigma, weighting).item() > 0.01


def test_loss_is_the_mean_over_noisy_frames(clip: tuple[torch.Tensor, ...]) -> None:
    latents, noise, sigma = clip
    velocity = velocity_target(latents, noise) + 2.0
    assert flow_matching_loss(velocity, latents, noise, sigma, LossWeighting()).item() == pytest.approx(4.0, rel=1e-5)
    weighted = flow_matching_loss(velocity, latents, noise, sigma, LossWeighting(kind="sample"))
    assert weighted.item() == pytest.approx(4.0 * (0.3**2 + 0.8**2) / 2, rel=1e-5)


def test_weights_of_a_batch_count_its_errors(
    make_model: Callable[..., WorldModel], clip: tuple[torch.Tensor, ...]
) -> None:
    latents, noise, sigma = clip
    weights = torch.rand(latents[:, :, :1].shape)
    velocity = torch.zeros_like(latents)
    error = (velocity_target(latents, noise) ** 2 * weights)[:, :, :, 1:].mean()
    torch.testing.assert_close(
        flow_matching_loss(velocity, latents, noise, sigma, LossWeighting(), weights=weights), error
    )
    objective = FlowMatchingObjective(make_model(), sigma=SigmaSampling(), weighting=LossWeighting())
    with torch.no_grad():
        plain, doubled = (
            objective.loss(Batch((), VIEWS, latents, weights=given), torch.Generator().manual_seed(0), 0)[0]
            for given in (None, torch.full_like(weights, 2.0))
        )
    torch.testing.assert_close(doubled, 2 * plain)


def test_motion_weights_favour_what_moves_and_keep_the_mean(clip: tuple[torch.Tensor, ...]) -> None:
    latents, noise, sigma = clip
    latents = latents[:, :, :, :1].repeat(1, 1, 1, 5, 1, 1)
    latents[..., 0, 0] += torch.arange(5.0)
    weighting = LossWeighting(motion=4.0)
    uniform = flow_matching_loss(velocity_target(latents, noise) + 1.0, latents, noise, sigma, weighting)
    assert uniform.item() == pytest.approx(1.0, rel=1e-4)
    still, moving = (velocity_target(latents, noise) for _ in range(2))
    still[..., 1, 1] += 1.0
    moving[..., 0, 0] += 1.0
    losses = [flow_matching_loss(value, latents, noise, sigma, weighting).item() for value in (still, moving)]
    assert losses[1] > 3 * losses[0]


@pytest.mark.parametrize("kind", ["uniform", "logit_normal", "mode"])
def test_sigmas_are_levels_and_shift_moves_them_up(kind: str) -> None:
    plain, shifted = (
        sample_sigmas(
            SigmaSampling.model_validate({"kind": kind, "shift": shift}), 4000, torch.Generator().manual_seed(1)
        )
        for shift in (1.0, 5.0)
    )
    assert plain.min() > 0 and plain.max() <= 1
    assert shifted.mean() > plain.mean() + 0.15
