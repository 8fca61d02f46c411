"""Distribution matching and the auxiliary losses beside it: who receives which gradient."""

import pytest
import torch
from einops import repeat

from worldline_core.data.episodes.episode import VIEWS
from worldline_core.distillation import distribution_matching
from worldline_core.distillation.auxiliary_losses import (
    PerceptualLoss,
    auxiliary_losses,
    boundary_loss,
    robot_motion_loss,
    robot_reconstruction_loss,
    view_weights,
)
from worldline_core.distillation.causal_objective import self_forced_rollout
from worldline_core.distillation.distill import _perceptual
from worldline_core.distillation.distill_config import AuxiliaryWeights, DistillConfig
from worldline_core.errors import ConfigError
from worldline_core.model.lpips import load_lpips
from worldline_core.model.tokenizers import PatchTokenizer, PatchTokenizerConfig, WanTokenizer
from worldline_core.rehearsal.outside_models import small_wan_autoencoder
from worldline_core.rollout.samplers import BlockCausalSimulator, Noise
from worldline_core.training.clip_loader import Batch
from worldline_core.training.training_config import LossWeighting


def gaussian_score(mean):
    """Velocity of data that is a single point: x0 is `mean`, so v = (x_t - mean) / sigma."""

    def velocity(noisy, levels):
        answer = torch.zeros_like(noisy)
        answer[..., 1:, :, :] = (noisy - mean)[..., 1:, :, :] / levels[:, None, None, 1:, None, None]
        return answer

    return velocity


def levels_of(sigma):
    """The same noise in every frame but the observed one."""
    return torch.cat((torch.zeros(2, 1), torch.full((2, 4), sigma)), dim=1)


def rollout(model, clip, exit_step=3, *, spec=None, noise=None, with_gradient=False):
    return self_forced_rollout(
        model, clip.latents[..., :1, :, :], clip.maps, clip.noise if noise is None else noise, exit_step, views=clip.views,
        spec=spec or clip.spec, with_gradient=with_gradient,
    )  # fmt: skip


def test_the_student_target_lies_towards_the_real_score_and_away_from_the_fake(clip):
    generated = clip.latents.clone().requires_grad_()
    real_mean, fake_mean = clip.latents + 1.0, clip.latents - 1.0
    scores = gaussian_score(real_mean), gaussian_score(fake_mean)
    gradient = distribution_matching.distribution_gradient(*scores, generated, clip.noise, levels_of(0.5))
    # (x - (z + 1)) / s - (x - (z - 1)) / s = -2 / s
    torch.testing.assert_close(gradient[..., 1:, :, :], torch.full_like(gradient[..., 1:, :, :], -4.0))
    assert not bool(gradient[..., :1, :, :].any())
    distribution_matching.distribution_matching_loss(generated, gradient).backward()
    step = -generated.grad[..., 1:, :, :]
    assert bool((step > 0).all())  # descending the loss moves every value up, to the mean of the real score
    assert not bool(generated.grad[..., :1, :, :].any())
    # Equal scores leave the student alone.
    score, generated = gaussian_score(clip.latents), clip.latents.clone().requires_grad_()
    gradient = distribution_matching.distribution_gradient(score, score, generated, clip.noise, levels_of(0.3))
    loss = distribution_matching.distribution_matching_loss(generated, gradient)
    loss.backward()
    assert loss.item() == 0 and not generated.grad.any()


@pytest.mark.parametrize("prediction", ["velocity", "first_frame_residual"])
def test_a_student_update_reaches_the_student_alone(make_model, clip, prediction):
    kind = {} if prediction == "velocity" else {"prediction": prediction, "first_frame_std": 0.5}
    student, real, fake = (make_model(seed, **kind) for seed in range(3))
    generated = rollout(student, clip, 1, with_gradient=True)
    batch = Batch((), clip.views, clip.latents, clip.maps)
    scores = distribution_matching.full_clip_score(real, batch), distribution_matching.full_clip_score(fake, batch)
    gradient = distribution_matching.distribution_gradient(*scores, generated, clip.noise, levels_of(0.6))
    loss = distribution_matching.distribution_matching_loss(generated, gradient)
    loss.backward()
    assert bool(loss.isfinite())
    assert all(parameter.grad is None for model in (real, fake) for parameter in model.parameters())
    assert any(bool(parameter.grad.any()) for parameter in student.parameters() if parameter.grad is not None)


def test_a_fake_score_update_reaches_the_fake_score_alone(make_model, clip):
    student, fake = make_model(0), make_model(2)
    generated = rollout(student, clip)
    assert not generated.requires_grad
    score = distribution_matching.full_clip_score(fake, Batch((), clip.views, clip.latents, clip.maps))
    distribution_matching.fake_score_loss(
        score, generated, clip.noise.flip(0), levels_of(0.6), LossWeighting()
    ).backward()
    assert all(parameter.grad is None for parameter in student.parameters())
    assert all(parameter.grad is not None for parameter in fake.parameters())


def test_only_the_exit_pass_carries_a_gradient(make_model, clip):
    student = make_model(0)
    calls = []
    original = student._run

    def watched(*args, **kwargs):
        calls.append(torch.is_grad_enabled())
        return original(*args, **kwargs)

    student._run = watched
    rollout(student, clip, 2, with_gradient=True)
    # observed frame; block 1: nodes 0, 1, then the exit; its cache write; block 2: nodes 0, 1, exit (not cached)
    assert calls == [False, False, False, True, False, False, False, True]


def test_no_gradient_flows_through_the_cache(make_model, clip):
    student = make_model(0)
    noise = clip.noise.clone().requires_grad_()
    generated = rollout(student, clip, 0, noise=noise, with_gradient=True)
    generated[..., 3:, :, :].sum().backward()
    assert bool(noise.grad[..., 3:, :, :].any())
    assert not bool(noise.grad[..., 1:3, :, :].any())


@pytest.mark.parametrize("recent_blocks", [3, 0])
def test_rollout_equals_the_block_causal_sampler(make_model, make_spec, clip, recent_blocks):
    student, spec = make_model(0), make_spec(recent_blocks=recent_blocks)
    simulator = BlockCausalSimulator(student, spec, noise=Noise([1, 2]), views=clip.views)
    simulator.start(clip.latents[:, :, :, 0], clip.maps[:, :, :, :1])
    predicted = [simulator.step(clip.maps[..., start : start + 2, :, :]) for start in (1, 3)]
    same_noise = Noise([1, 2])
    drawn = [same_noise.draw((3, 4, 2, 4, 4)) for _ in predicted]
    generated = rollout(student, clip, spec=spec, noise=torch.cat((clip.noise[..., :1, :, :], *drawn), dim=3))
    torch.testing.assert_close(generated[..., 1:, :, :], torch.cat(predicted, dim=3), rtol=1e-4, atol=1e-4)


ZEROS, WEIGHTS, BOTH = (
    torch.zeros(2, 3, 4, 5, 4, 6),
    view_weights(VIEWS),
    (robot_reconstruction_loss, robot_motion_loss),
)
MASK = torch.ones(2, 3, 5, 4, 6)


def changed(values, where, value):
    out = values.clone()
    out[where] = value
    return out


def loss(kind, predicted, mask=MASK):
    return kind(predicted, ZEROS, mask, WEIGHTS)


def test_a_loss_is_of_the_area_of_the_mask_alone_and_twice_in_wrist_views():
    small = changed(torch.zeros_like(MASK), (..., 1, 2), 1)
    for mask in (small, MASK):
        assert loss(robot_reconstruction_loss, ZEROS + 0.5, mask).item() == pytest.approx(0.25)
    outside = changed(ZEROS, (..., slice(2, None), slice(None)), torch.randn(2, 3, 4, 5, 2, 6))
    mask = changed(MASK, (..., slice(2, None), slice(None)), 0)
    for kind in BOTH:
        assert loss(kind, outside, mask).item() == 0
        assert loss(kind, changed(outside, (0, 0, 0, 0, 0, 0), 1.0), mask).item() > 0
    assert WEIGHTS.tolist() == [1.0, 2.0, 2.0]
    found = [loss(robot_reconstruction_loss, changed(ZEROS, (slice(None), view), 1.0)).item() for view in range(3)]
    assert found == pytest.approx([0.2, 0.4, 0.4])


def test_views_without_a_robot_take_no_part():
    mask = changed(MASK, (slice(None), slice(1, None)), 0)
    predicted = (ZEROS + 1.0).requires_grad_()
    assert loss(robot_reconstruction_loss, predicted, mask).item() == pytest.approx(1.0)
    nothing = loss(robot_reconstruction_loss, predicted, torch.zeros_like(mask))
    nothing.backward()
    assert nothing.item() == 0 and not predicted.grad.any()


def test_motion_loss_sees_temporal_differences_only():
    assert loss(robot_motion_loss, ZEROS + 3.0).item() == 0
    moving = ZEROS + torch.arange(5.0).reshape(1, 1, 1, 5, 1, 1)
    assert loss(robot_motion_loss, moving).item() == pytest.approx(1.0)
    one_frame = moving[..., :1, :, :]
    assert robot_motion_loss(one_frame, one_frame + 1, MASK[:, :, :1], WEIGHTS).item() == 0
    # It counts where the robot is in either frame: here between frames 0 and 1 alone.
    first = changed(torch.zeros_like(MASK), (slice(None), slice(None), 0), 1)
    assert loss(
        robot_motion_loss, changed(ZEROS, (..., 1, slice(None), slice(None)), 1.0), first
    ).item() == pytest.approx(1)


def test_boundary_loss_looks_at_the_steps_between_blocks():
    # Frames 1 and 2 are one block: the steps into it (0 to 1) and out of it (2 to 3) are wrong by one each.
    for frames, expected in ((slice(1, 3), 1.0), (slice(4, 5), 0.0)):
        predicted = changed(ZEROS, (..., frames, slice(None), slice(None)), 1.0)
        assert boundary_loss(predicted, ZEROS, block_size=2).item() == pytest.approx(expected)


def test_auxiliaries_are_weighted_as_configured():
    only_robot = AuxiliaryWeights(anchor=0, boundary=0, lpips=0, robot=0.5, robot_motion=0)
    every = {"anchor", "boundary", "lpips", "robot", "robot_motion"}
    for weights, perceptual, names, expected in (
        (only_robot, (), {"robot"}, 0.5),
        (AuxiliaryWeights(), (lambda a, b: (a - b).abs().mean(),), every, 0.005 + 0.0 + 0.005 + 0.005),
    ):
        total, terms = auxiliary_losses(ZEROS + 1.0, ZEROS, MASK, VIEWS, 2, weights, *perceptual)
        assert set(terms) == names
        assert total.item() == pytest.approx(expected)


ALEXNET = {0: (64, 3, 11), 3: (192, 64, 5), 6: (384, 192, 3), 8: (256, 384, 3), 10: (256, 256, 3)}


class NearestTokenizer:
    """Decodes the first three channels of a latent to blocks of constant colour."""

    latent_channels = 4
    spatial_compression = 16
    temporal_compression = 4

    def encode(self, video):
        raise NotImplementedError

    def decode(self, latents, reference=None):
        frames = torch.cat((latents[:, :3, :1], latents[:, :3, 1:].repeat_interleave(4, dim=2)), dim=2)
        return repeat(frames, "b c t h w -> b c t (h p) (w q)", p=16, q=16).tanh()

    def decoder(self, reference=None):
        known = []

        def decode(latents):
            frames = self.decode(torch.cat((*known, latents), dim=2))[:, :, len(known) :]
            known[:] = [latents[:, :, :1]]
            return frames

        return decode


@pytest.fixture
def weights(tmp_path):
    """Files in the layout of the published ones; the values are arbitrary, which is enough to test the loss around them."""
    generator = torch.Generator().manual_seed(0)
    backbone, heads = {}, {}
    for number, (index, (channels, inputs, size)) in enumerate(ALEXNET.items()):
        shape = (channels, inputs, size, size)
        backbone[f"features.{index}.weight"] = torch.randn(shape, generator=generator) * (inputs * size**2) ** -0.5
        backbone[f"features.{index}.bias"] = torch.zeros(channels)
        heads[f"lin{number}.model.1.weight"] = torch.rand(1, channels, 1, 1, generator=generator)
    torch.save(backbone, tmp_path / "alexnet-owt-7be5be79.pth")
    torch.save(heads, tmp_path / "alex.pth")
    return tmp_path


def test_equal_clips_cost_nothing_and_gradients_reach_the_compared_frames(weights):
    loss = PerceptualLoss(NearestTokenizer(), load_lpips(weights), latent_frames=2)
    target = torch.randn(1, 2, 4, 5, 4, 4, generator=torch.Generator().manual_seed(1))
    assert loss(target, target).item() == 0
    predicted = (target + 0.5).requires_grad_()
    value = loss(predicted, target)
    value.backward()
    assert value.item() > 0
    assert bool(predicted.grad[:, :, :3, 3:].any())
    assert not bool(predicted.grad[:, :, :, :3].any())
    assert all(parameter.grad is None for parameter in loss.network.parameters())


@pytest.mark.parametrize("kind", ["patch", pytest.param("wan", marks=pytest.mark.slow)])
def test_the_end_of_a_clip_is_compared_as_the_whole_decoded_clip_shows_it(weights, kind):
    """Also with an autoencoder whose frames depend on all frames before them."""
    torch.manual_seed(0)
    if kind == "patch":
        tokenizer = PatchTokenizer(PatchTokenizerConfig(static_channels=4, motion_channels=2, refinement_width=8))
        for basis in (tokenizer.static_basis, tokenizer.motion_basis):
            basis.normal_()
        tokenizer.requires_grad_(False)
    else:
        tokenizer = WanTokenizer(small_wan_autoencoder().requires_grad_(False))
    side, views, frames = (8, 2, 5) if kind == "patch" else (3, 1, 4)  # 64 and 48 pixels
    predicted, target = torch.randn(2, 1, views, tokenizer.latent_channels, frames, side, side).unbind(0)
    network = load_lpips(weights)
    predicted.requires_grad_()

    def decoded(clip):
        video = tokenizer.decode(clip.flatten(0, 1))[:, :, -8:] / 2 + 0.5
        return video.permute(0, 2, 1, 3, 4).flatten(0, 1).clamp(0, 1)

    expected = network(decoded(predicted), decoded(target)).mean()
    (wanted,) = torch.autograd.grad(expected, predicted)
    value = PerceptualLoss(tokenizer, network)(predicted, target)
    torch.testing.assert_close(value.detach(), expected.detach())
    (gradient,) = torch.autograd.grad(3 * value, predicted)
    torch.testing.assert_close(gradient[:, :, :, -2:], 3 * wanted[:, :, :, -2:])
    assert not bool(gradient[:, :, :, :-2].any())
    with torch.no_grad():
        torch.testing.assert_close(PerceptualLoss(tokenizer, network)(predicted, target), expected.detach())


@pytest.mark.slow
def test_decoding_in_bfloat16_costs_little_accuracy(weights):
    torch.manual_seed(0)
    vae, network = small_wan_autoencoder().requires_grad_(False), load_lpips(weights)
    predicted, target = torch.randn(2, 1, 1, 48, 3, 4, 4).unbind(0)
    found = []
    for dtype in (torch.float32, torch.bfloat16):
        leaf = predicted.clone().requires_grad_()
        with torch.autocast("cpu", torch.bfloat16):
            value = PerceptualLoss(WanTokenizer(vae.to(dtype)), network, latent_frames=1)(leaf, target)
        value.backward()
        found += [value.detach(), leaf.grad[:, :, :, -1].flatten()]
    torch.testing.assert_close(found[2], found[0], rtol=0.05, atol=0)
    assert torch.nn.functional.cosine_similarity(found[1], found[3], dim=0) > 0.95


def test_only_the_wan_autoencoder_decodes_in_bfloat16(weights, project_root):
    config = DistillConfig.model_validate({"lpips_weights": weights, "perceptual": {"bfloat16": True}})
    tokenizer = project_root / "artifacts" / "shipped" / "models" / "tokenizer"
    with pytest.raises(ConfigError, match=r"Only the Wan autoencoder[\s\S]*perceptual.bfloat16[\s\S]*PatchTokenizer"):
        _perceptual(config, tokenizer, "cpu")
