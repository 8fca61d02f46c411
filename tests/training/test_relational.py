from __future__ import annotations

from collections import OrderedDict
from typing import Any, cast

import pytest
import torch

from worldline_core.training.clip_sampler import Clip
from worldline_core.training.relational import (
    RelationalScales,
    SimilarityMatrices,
    TeacherSimilarities,
    common_shape,
    pool_features,
    relational_losses,
    similarity_matrices,
)
from worldline_core.training.training_config import RelationalConfig


def features(seed: int, size: int = 6, requires_grad: bool = False) -> torch.Tensor:
    return torch.randn(2, 3, 4, 5, size, generator=torch.Generator().manual_seed(seed), requires_grad=requires_grad)


def matrices(pooled: torch.Tensor) -> SimilarityMatrices:
    """SimilarityMatrices of pooled features: four bins of five cells."""
    return similarity_matrices(pooled[:, :, :, :, None], (4, 5, 1))


def test_equal_features_have_no_loss_and_rotated_ones_neither() -> None:
    student = features(0)
    rotation = torch.linalg.qr(torch.randn(6, 6, generator=torch.Generator().manual_seed(9)))[0]
    for teacher in (student, 3.0 * student, student @ rotation):
        intra, cross = relational_losses(student, matrices(teacher), 1)
        assert intra.item() == pytest.approx(0.0, abs=1e-6)
        assert cross.item() == pytest.approx(0.0, abs=1e-6)
    assert relational_losses(student, matrices(features(1)), 1)[0].item() > 0.1


def test_gradients_reach_the_student_only() -> None:
    student, teacher = features(0, requires_grad=True), features(1, size=9, requires_grad=True)
    intra, cross = relational_losses(student, matrices(teacher), 0)
    (intra + cross).backward()
    assert student.grad.abs().sum() > 0
    assert teacher.grad is None


def test_views_go_round_robin_and_the_wrist_alternates() -> None:
    teacher = features(1)
    for step in range(6):
        student = features(0, requires_grad=True)
        relational_losses(student, matrices(teacher), step)[0].backward()
        touched = [view for view in range(3) if student.grad[:, view].abs().sum() > 0]
        assert touched == [step % 3]
        student = features(0, requires_grad=True)
        relational_losses(student, matrices(teacher), step)[1].backward()
        assert [view for view in range(3) if student.grad[:, view].abs().sum() > 0] == [0, 1 + step % 2]


def test_one_view_has_no_cross_term() -> None:
    student, teacher = features(0)[:, :1], features(1)[:, :1]
    assert relational_losses(student, matrices(teacher), 5)[1].item() == 0.0


def test_both_sides_are_pooled_to_the_coarser_grid_and_at_most_eight_bins() -> None:
    shape = common_shape(RelationalConfig(), (9, 4, 6), (17, 24, 24))
    assert shape == (8, 4, 6)
    assert common_shape(RelationalConfig(), (5, 15, 20), (17, 24, 24)) == (5, 8, 8)
    student = torch.arange(2 * 9 * 4 * 6, dtype=torch.float32).reshape(1, 2, 9, 4, 6, 1)
    pooled = pool_features(student, (3, 2, 3))
    assert pooled.shape == (1, 2, 3, 6, 1)
    assert pooled[0, 1, 0, 0, 0].item() == pytest.approx(student[0, 1, :3, :2, :2].mean().item())


def test_scales_hold_the_weighted_terms_at_their_share_within_caps_and_ramp() -> None:
    scales = RelationalScales(RelationalConfig(ramp_steps=250, ema_decay=0.9))
    assert scales.at(0) == (0.0, 0.0)  # no ratio is known yet
    intra = cross = 0.0
    for step in range(300):
        intra, cross = scales.at(step)
        scales.update(1.0, 0.5, 0.25)
        if step == 124:
            assert intra == pytest.approx(0.5 * 0.03 / 0.5)
    assert intra * 0.5 == pytest.approx(0.03)
    assert cross * 0.25 == pytest.approx(0.005)
    resumed = RelationalScales(scales.config)
    resumed.ratios = dict(scales.ratios)
    for one in (scales, resumed):
        one.update(2.0, 0.5, 0.25)
    assert resumed.at(300) == scales.at(300)
    capped = RelationalScales(RelationalConfig(ramp_steps=0))
    capped.update(1.0, 1e-3, 1e-3)
    assert capped.at(1) == (0.20, 0.10)


def test_a_step_on_one_view_leaves_the_scale_of_pairs_of_views() -> None:
    scales = RelationalScales(RelationalConfig(ramp_steps=0))
    scales.update(1.0, 0.5, 0.25)
    intra, cross = scales.at(1)
    scales.update(2.0, 0.5, 0.0)
    assert scales.at(2)[0] > intra
    assert scales.at(2)[1] == cross


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_a_batch_of_cached_similarities_is_what_was_kept_under_autocast(dtype: torch.dtype) -> None:
    source = TeacherSimilarities.__new__(TeacherSimilarities)
    clips = [Clip("a", 0, 5, 1), Clip("b", 0, 5, 1)]
    with torch.autocast("cpu", torch.bfloat16, enabled=dtype == torch.bfloat16):
        stored = {(clip, ("head",)): similarity_matrices(torch.randn(1, 1, 2, 4, 6, 8), (2, 2, 3)) for clip in clips}
        cast("Any", source)._cache = OrderedDict(stored)
        result = source.similarities(clips, ("head",), (2, 4, 6))
    assert result.intra.dtype == dtype
    assert torch.equal(result.intra[1], stored[clips[1], ("head",)].intra[0])
