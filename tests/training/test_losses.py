"""Flow matching, its weights and preconditioning, and the relational terms beside it."""

import dataclasses
from collections import OrderedDict

import numpy as np
import pytest
import torch

from worldline_core.errors import DataError
from worldline_core.model.layers import preconditioned_velocity
from worldline_core.model.world_model_config import VIEWS
from worldline_core.training import relational
from worldline_core.training.clip_loader import Batch
from worldline_core.training.clip_sampler import Clip, ClipRow
from worldline_core.training.flow_matching import (
    FlowMatchingObjective,
    add_noise,
    flow_matching_loss,
    sample_sigmas,
    velocity_target,
)
from worldline_core.training.object_weights import ObjectWeights, object_weights
from worldline_core.training.training_config import LossWeighting, RelationalConfig, SigmaSampling


def test_clips_are_placed_in_time_by_their_own_rates(make_model, clip):
    sampling, weighting = SigmaSampling(), LossWeighting()

    def losses(model, *fps):
        batch = Batch((), VIEWS, clip[0], fps=torch.tensor(fps) if fps else None)
        objective = FlowMatchingObjective(model, sigma=sampling, weighting=weighting)
        seed = torch.Generator().manual_seed
        return [objective.loss(batch, seed(0), 0)[0].item(), objective.validation_losses(batch, seed(0))["loss"]]

    with torch.no_grad():
        modulated, counted = make_model(fps=8.0), make_model()
        assert losses(modulated, 8.0, 8.0) == losses(modulated) != losses(modulated, 8.0, 2.0)
        assert losses(counted, 8.0, 2.0) == losses(counted)


@pytest.fixture
def clip():
    generator = torch.Generator().manual_seed(0)
    latents, noise = torch.randn(2, 2, 3, 4, 5, 2, 2, generator=generator)
    return latents, noise, torch.tensor([0.3, 0.8])


def test_noise_is_a_straight_line_and_spares_the_first_frame(clip):
    latents, noise, sigma = clip
    noisy = add_noise(latents, noise, sigma)
    assert torch.equal(noisy[:, :, :, 0], latents[:, :, :, 0])
    torch.testing.assert_close(noisy[1, :, :, 2], 0.2 * latents[1, :, :, 2] + 0.8 * noise[1, :, :, 2])
    # z = z_sigma - sigma v
    recovered = noisy[1] - 0.8 * velocity_target(latents, noise)[1]
    torch.testing.assert_close(recovered[:, :, 1:], latents[1, :, :, 1:])


def loss_of(clip, error, weights=None, **weighting):
    latents, noise, sigma = clip
    velocity = velocity_target(latents, noise) + error
    return flow_matching_loss(velocity, latents, noise, sigma, LossWeighting(**weighting), weights=weights).item()


def test_loss_is_the_mean_over_noisy_frames(clip):
    for kind, expected in (("velocity", 4.0), ("sample", 4.0 * (0.3**2 + 0.8**2) / 2)):
        assert loss_of(clip, 2.0, kind=kind) == pytest.approx(expected, rel=1e-5)
    error = torch.zeros_like(clip[0])
    for weighting in ({}, {"kind": "sample", "motion": 2.0}):
        error[:, :, :, 0], error[:, :, :, 1] = 100, 0
        assert loss_of(clip, error, **weighting) == 0.0
        error[:, :, :, 1] = 1
        assert loss_of(clip, error, **weighting) > 0.01


def test_weights_of_a_batch_count_its_errors(make_model, clip):
    weights = torch.rand(clip[0][:, :, :1].shape)
    assert loss_of(clip, 2.0, weights) == pytest.approx(4 * weights[:, :, :, 1:].mean().item(), rel=1e-5)
    objective = FlowMatchingObjective(make_model(), sigma=SigmaSampling(), weighting=LossWeighting())
    with torch.no_grad():
        plain, doubled = (
            objective.loss(Batch((), VIEWS, clip[0], weights=given), torch.Generator().manual_seed(0), 0)[0]
            for given in (None, torch.full_like(weights, 2.0))
        )
    torch.testing.assert_close(doubled, 2 * plain)


def test_motion_weights_favour_what_moves_and_keep_the_mean(clip):
    latents = clip[0][:, :, :, :1].repeat(1, 1, 1, 5, 1, 1)
    latents[..., 0, 0] += torch.arange(5.0)
    moving = (latents, *clip[1:])
    assert loss_of(moving, 1.0, motion=4.0) == pytest.approx(1.0, rel=1e-4)
    where_it_moves, elsewhere = torch.tensor([[1.0, 0.0], [0.0, 0.0]]), torch.tensor([[0.0, 0.0], [0.0, 1.0]])
    assert loss_of(moving, where_it_moves, motion=4.0) > 3 * loss_of(moving, elsewhere, motion=4.0)


@pytest.mark.parametrize("kind", ["uniform", "logit_normal", "mode"])
def test_sigmas_are_levels_and_shift_moves_them_up(kind):
    samplings = (SigmaSampling(kind=kind, shift=shift) for shift in (1.0, 5.0))
    plain, shifted = (sample_sigmas(sampling, 4000, torch.Generator().manual_seed(1)) for sampling in samplings)
    assert plain.min() > 0 and plain.max() <= 1
    assert shifted.mean() > plain.mean() + 0.15


class Masks:
    """An episode of 9 frames of 16 x 24 pixels: from frame 6 on the moved thing (1) fills the first cell of a 2 x 3 grid."""

    root = "here"

    def __init__(self):
        self.labels = np.zeros((9, 16, 24), np.uint8)
        self.labels[6:, :8, :8] = 1
        self.labels[:, 8:, 16:20] = 3  # half of the last cell, always

    def position(self, episode_id):
        return 0

    def thing_labels(self, position, view):
        return self.labels


def test_cells_of_things_count_more_where_they_are_or_were():
    masks, clips = Masks(), ((Clip("a", 0, 9, 1),), [("head",)])
    weights = ObjectWeights(masks, (2, 3), 3.0, 0.5)(*clips)
    assert weights.shape == (1, 1, 1, 3, 2, 3)
    raw = torch.ones(3, 2, 3)
    raw[2, 0, 0] = 4.0  # the latent frame of frames 5 to 8 takes the largest share of them
    raw[:, 1, 2] = 1 + 0.5 * (127 / 255) ** 0.5
    assert torch.allclose(weights[0, 0, 0], raw / raw[1:].mean(), atol=2e-3)
    assert weights[:, :, :, 1:].mean() == pytest.approx(1, abs=1e-6)
    rows = [ClipRow("a", 9, ("head", "top"), "s", "r", "train", "", "head")]
    clips = (Clip("a", 0, 5, 1), Clip("a", 0, 5, 2), Clip("a", 4, 5, 1)), [("top", "head")] * 3
    found = [ObjectWeights(masks, (2, 3), 3.0, 0.5, resident=kept)(*clips) for kept in (rows, None)]
    assert torch.equal(*found) and found[0].shape == (3, 2, 1, 2, 2, 3)
    with pytest.raises(DataError, match=r"(?s)not of every frame.*a, view head"):
        ObjectWeights(masks, (2, 3), 3.0, 0.5, resident=[dataclasses.replace(rows[0], num_frames=10)])
    masks.labels = None
    for kept in (rows, None):
        with pytest.raises(DataError, match=r"(?s)a, view (head|top).*weighting.things"):
            ObjectWeights(masks, (2, 3), 1.0, 0.0, resident=kept)(*clips)
    # What was there at the start counts later.
    shares = torch.zeros(1, 1, 2, 3, 1, 2)
    shares[0, 0, 0, 0, 0, 0] = 1.0
    weights = object_weights(shares, 3.0, 0.0)[0, 0, 0, :, 0]
    assert torch.allclose(weights[:, 0] / weights[:, 1], torch.full((3,), 4.0))


STD = 0.75


@pytest.mark.parametrize("sigma", [0.01, 0.3, 0.8, 1.0])
def test_a_silent_head_gives_the_posterior_mean_of_a_gaussian(sigma):
    generator = torch.Generator().manual_seed(0)
    reference = torch.full((200_000,), 0.4, dtype=torch.float64)
    clean = reference + STD * torch.randn(200_000, generator=generator, dtype=torch.float64)
    noisy = (1 - sigma) * clean + sigma * torch.randn(200_000, generator=generator, dtype=torch.float64)
    level = torch.tensor(sigma, dtype=torch.float64)
    guess = noisy - sigma * preconditioned_velocity(torch.zeros_like(noisy), noisy, level, reference, STD)
    error = clean - guess
    # The posterior mean leaves an error that is uncorrelated with the observation and has the posterior's deviation.
    assert (error * (noisy - noisy.mean())).mean().item() == pytest.approx(0.0, abs=3e-3)
    deviation = sigma * STD / ((1 - sigma) ** 2 * STD**2 + sigma**2) ** 0.5
    assert error.std().item() == pytest.approx(deviation, rel=0.02)
    # One unit of the head moves the clean latents by one posterior deviation.
    moved = noisy - sigma * preconditioned_velocity(torch.ones_like(noisy), noisy, level, reference, STD)
    torch.testing.assert_close(moved - guess, torch.full_like(guess, deviation))


def features(seed, size=6, requires_grad=False):
    return torch.randn(2, 3, 4, 5, size, generator=torch.Generator().manual_seed(seed), requires_grad=requires_grad)


def matrices(pooled):
    """SimilarityMatrices of pooled features: four bins of five cells."""
    return relational.similarity_matrices(pooled[:, :, :, :, None], (4, 5, 1))


def test_equal_features_have_no_loss_and_rotated_ones_neither():
    student = features(0)
    rotation = torch.linalg.qr(torch.randn(6, 6, generator=torch.Generator().manual_seed(9)))[0]
    for teacher in (student, 3.0 * student, student @ rotation):
        terms = relational.relational_losses(student, matrices(teacher), 1)
        assert [term.item() for term in terms] == pytest.approx([0.0, 0.0], abs=1e-6)
    assert relational.relational_losses(student, matrices(features(1)), 1)[0].item() > 0.1


def test_views_go_round_robin_the_wrist_alternates_and_gradients_reach_the_student_only():
    teacher = features(1, size=9, requires_grad=True)
    for step in range(6):
        for term, views in enumerate(([step % 3], [0, 1 + step % 2])):
            student = features(0, requires_grad=True)
            relational.relational_losses(student, matrices(teacher), step)[term].backward()
            assert [view for view in range(3) if student.grad[:, view].abs().sum() > 0] == views
    one = relational.relational_losses(features(0)[:, :1], matrices(teacher[:, :1]), 5)
    assert one[1].item() == 0.0  # one view has no cross term
    assert teacher.grad is None


def test_both_sides_are_pooled_to_the_coarser_grid_and_at_most_eight_bins():
    assert relational.common_shape(RelationalConfig(), (9, 4, 6), (17, 24, 24)) == (8, 4, 6)
    assert relational.common_shape(RelationalConfig(), (5, 15, 20), (17, 24, 24)) == (5, 8, 8)
    student = torch.arange(2 * 9 * 4 * 6, dtype=torch.float32).reshape(1, 2, 9, 4, 6, 1)
    pooled = relational.pool_features(student, (3, 2, 3))
    assert pooled.shape == (1, 2, 3, 6, 1)
    assert pooled[0, 1, 0, 0, 0].item() == pytest.approx(student[0, 1, :3, :2, :2].mean().item())


def test_scales_hold_the_weighted_terms_at_their_share_within_caps_and_ramp():
    scales = relational.RelationalScales(RelationalConfig(ramp_steps=250, ema_decay=0.9))
    assert scales.at(0) == (0.0, 0.0)  # no ratio is known yet
    intra = cross = 0.0
    for step in range(300):
        intra, cross = scales.at(step)
        scales.update(1.0, 0.5, 0.25)
        if step == 124:
            assert intra == pytest.approx(0.5 * 0.03 / 0.5)
    assert intra * 0.5 == pytest.approx(0.03)
    assert cross * 0.25 == pytest.approx(0.005)
    resumed = relational.RelationalScales(scales.config)
    resumed.ratios = dict(scales.ratios)
    for one in (scales, resumed):
        one.update(2.0, 0.5, 0.25)
    assert resumed.at(300) == scales.at(300)
    capped = relational.RelationalScales(RelationalConfig(ramp_steps=0))
    capped.update(1.0, 1e-3, 1e-3)
    assert capped.at(1) == (0.20, 0.10)
    # A step on one view leaves the scale of pairs of views.
    scales = relational.RelationalScales(RelationalConfig(ramp_steps=0))
    scales.update(1.0, 0.5, 0.25)
    intra, cross = scales.at(1)
    scales.update(2.0, 0.5, 0.0)
    assert scales.at(2)[0] > intra and scales.at(2)[1] == cross


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_a_batch_of_cached_similarities_is_what_was_kept_under_autocast(dtype):
    source = relational.TeacherSimilarities.__new__(relational.TeacherSimilarities)
    clips = [Clip("a", 0, 5, 1), Clip("b", 0, 5, 1)]
    with torch.autocast("cpu", torch.bfloat16, enabled=dtype == torch.bfloat16):
        kept = [relational.similarity_matrices(torch.randn(1, 1, 2, 4, 6, 8), (2, 2, 3)) for _ in clips]
        source._cache = OrderedDict(zip([(clip, ("head",)) for clip in clips], kept, strict=True))
        result = source.similarities(clips, ("head",), (2, 4, 6))
    assert result.intra.dtype == dtype
    assert torch.equal(result.intra[1], kept[1].intra[0])
