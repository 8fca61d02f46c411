"""Distribution matching: direction of the gradient, who receives it, the schedule, and the student's own rollouts."""

from __future__ import annotations

import pytest
import torch

from worldline_core.distillation.causal_objective import self_forced_rollout
from worldline_core.distillation.distribution_matching import (
    DistributionMatchingObjective,
    distribution_gradient,
    distribution_matching_loss,
    fake_score_loss,
    full_clip_score,
)
from worldline_core.errors import ConfigError
from worldline_core.model.block_causal_attention import KVCache
from worldline_core.rollout.samplers import BlockCausalSimulator, Noise
from worldline_core.training.clip_loader import Batch
from worldline_core.training.training_config import LossWeighting


def gaussian_score(mean: torch.Tensor):
    """Velocity of data that is a single point: x0 is `mean`, so v = (x_t - mean) / sigma."""

    def velocity(noisy: torch.Tensor, levels: torch.Tensor) -> torch.Tensor:
        answer = torch.zeros_like(noisy)
        answer[..., 1:, :, :] = (noisy - mean)[..., 1:, :, :] / levels[:, None, None, 1:, None, None]
        return answer

    return velocity


def levels_of(sigma: float) -> torch.Tensor:
    """The same noise in every frame but the observed one."""
    return torch.cat((torch.zeros(2, 1), torch.full((2, 4), sigma)), dim=1)


def rollout(model, clip, exit_step: int = 3, **options):
    return self_forced_rollout(
        model,
        clip.latents[..., :1, :, :],
        options.pop("maps", clip.maps),
        options.pop("noise", clip.noise),
        exit_step,
        views=clip.views,
        spec=clip.spec,
        with_gradient=options.pop("with_gradient", False),
    )


def test_five_fake_score_updates_then_one_of_the_student() -> None:
    objective = DistributionMatchingObjective.__new__(DistributionMatchingObjective)
    assert [objective.trained_group(i) for i in range(12)] == (["fake"] * 5 + ["student"]) * 2


def test_the_student_target_lies_towards_the_real_score_and_away_from_the_fake(clip) -> None:
    generated = clip.latents.clone().requires_grad_()
    real_mean, fake_mean = clip.latents + 1.0, clip.latents - 1.0
    gradient = distribution_gradient(
        gaussian_score(real_mean), gaussian_score(fake_mean), generated, clip.noise, levels_of(0.5)
    )
    # (x - (z + 1)) / s - (x - (z - 1)) / s = -2 / s
    torch.testing.assert_close(gradient[..., 1:, :, :], torch.full_like(gradient[..., 1:, :, :], -4.0))
    assert not bool(gradient[..., :1, :, :].any())
    distribution_matching_loss(generated, gradient).backward()
    step = -generated.grad[..., 1:, :, :]
    assert bool((step > 0).all())  # descending the loss moves every value up, to the mean of the real score
    assert not bool(generated.grad[..., :1, :, :].any())


def test_equal_scores_leave_the_student_alone(clip) -> None:
    generated = clip.latents.clone().requires_grad_()
    score = gaussian_score(clip.latents)
    gradient = distribution_gradient(score, score, generated, clip.noise, levels_of(0.3))
    loss = distribution_matching_loss(generated, gradient)
    loss.backward()
    assert loss.item() == 0
    assert not bool(generated.grad.any())


@pytest.mark.parametrize("prediction", ["velocity", "first_frame_residual"])
def test_a_student_update_reaches_the_student_alone(make_model, clip, prediction: str) -> None:
    kind = {} if prediction == "velocity" else {"prediction": prediction, "first_frame_std": 0.5}
    student, real, fake = (make_model(seed, **kind) for seed in range(3))
    generated = rollout(student, clip, 1, with_gradient=True)
    batch = Batch((), clip.views, clip.latents, clip.maps)
    scores = full_clip_score(real, batch), full_clip_score(fake, batch)
    gradient = distribution_gradient(*scores, generated, clip.noise, levels_of(0.6))
    loss = distribution_matching_loss(generated, gradient)
    loss.backward()
    assert bool(loss.isfinite())
    assert all(parameter.grad is None for model in (real, fake) for parameter in model.parameters())
    assert any(bool(parameter.grad.any()) for parameter in student.parameters() if parameter.grad is not None)


def test_a_fake_score_update_reaches_the_fake_score_alone(make_model, clip) -> None:
    student, fake = make_model(0), make_model(2)
    generated = rollout(student, clip)
    assert not generated.requires_grad
    score = full_clip_score(fake, Batch((), clip.views, clip.latents, clip.maps))
    fake_score_loss(score, generated, clip.noise.flip(0), levels_of(0.6), LossWeighting()).backward()
    assert all(parameter.grad is None for parameter in student.parameters())
    assert all(parameter.grad is not None for parameter in fake.parameters())


def test_only_the_exit_pass_carries_a_gradient(make_model, clip) -> None:
    student = make_model(0)
    calls: list[bool] = []
    original = student._run

    def watched(*args, **kwargs):
        calls.append(torch.is_grad_enabled())
        return original(*args, **kwargs)

    student._run = watched
    rollout(student, clip, 2, with_gradient=True)
    # observed frame; block 1: nodes 0, 1, then the exit; its cache write; block 2: nodes 0, 1, exit (not cached)
    assert calls == [False, False, False, True, False, False, False, True]


def test_no_gradient_flows_through_the_cache(make_model, clip) -> None:
    student = make_model(0)
    noise = clip.noise.clone().requires_grad_()
    generated = rollout(student, clip, 0, noise=noise, with_gradient=True)
    generated[..., 3:, :, :].sum().backward()
    assert bool(noise.grad[..., 3:, :, :].any())
    assert not bool(noise.grad[..., 1:3, :, :].any())


def test_the_rollout_is_causal(make_model, clip) -> None:
    student = make_model(0)
    maps, noise = clip.maps.clone(), clip.noise.clone()
    maps[..., 3:, :, :] += 1.0
    noise[..., 3:, :, :] += 1.0
    before, after = rollout(student, clip), rollout(student, clip, maps=maps, noise=noise)
    assert torch.equal(before[..., :3, :, :], after[..., :3, :, :])
    assert not torch.allclose(before[..., 3:, :, :], after[..., 3:, :, :])


def test_memory_of_the_history_does_not_grow_with_the_rollout(make_model, clip) -> None:
    model, cache = make_model(0), KVCache(1, 2)
    model.write_block(clip.latents[..., :1, :, :], cache, action_maps=clip.maps[..., :1, :, :])
    sizes = []
    for _ in range(6):
        model.write_block(clip.latents[..., 1:3, :, :], cache, action_maps=clip.maps[..., 1:3, :, :])
        sizes.append(cache.nbytes)
    assert sizes[0] < sizes[1] == sizes[2] == sizes[-1]


def test_an_exit_step_outside_of_the_schedule_is_refused(make_model, clip) -> None:
    with pytest.raises(ConfigError, match="No such exit step"):
        rollout(make_model(0), clip, 4)


@pytest.mark.parametrize("recent_blocks", [3, 0])
def test_rollout_equals_the_block_causal_sampler(make_model, make_spec, clip, recent_blocks: int) -> None:
    student, spec = make_model(0), make_spec(recent_blocks=recent_blocks)
    simulator = BlockCausalSimulator(student, spec, noise=Noise([1, 2]), views=clip.views)
    simulator.start(clip.latents[:, :, :, 0], clip.maps[:, :, :, :1])
    predicted = [simulator.step(clip.maps[..., start : start + 2, :, :]) for start in (1, 3)]
    same_noise = Noise([1, 2])
    drawn = [same_noise.draw((3, 4, 2, 4, 4)) for _ in predicted]
    generated = self_forced_rollout(
        student,
        clip.latents[..., :1, :, :],
        clip.maps,
        torch.cat((clip.noise[..., :1, :, :], *drawn), dim=3),
        3,
        views=clip.views,
        spec=spec,
        with_gradient=False,
    )
    assert torch.equal(generated[..., 1:, :, :], torch.cat(predicted, dim=3))
