"""Formulas of metrics against other libraries, and the intervals of their means."""

import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from worldline_core.actions.tool_error import end_effector_error
from worldline_core.errors import DataError, UnavailableError
from worldline_core.evaluation.metrics import MAX_PSNR_DB, frame_iou, frames_to_unit, psnr, ssim
from worldline_core.evaluation.scores import bootstrap_mean, paired_difference
from worldline_core.model.lpips import BACKBONE_FILE, HEADS_FILE, load_lpips


@pytest.fixture
def pair():
    generator = np.random.default_rng(0)
    true = generator.integers(0, 256, (4, 32, 48, 3), dtype=np.uint8)
    true[1] = 130  # flat: variances vanish
    predicted = np.clip(true + generator.integers(-30, 31, true.shape), 0, 255).astype(np.uint8)
    predicted[2] = true[2]
    return predicted, true


def test_psnr_and_ssim_equal_scikit_image(pair):
    predicted, true = pair
    found = [metric(*(frames_to_unit(torch.from_numpy(x)) for x in pair)).numpy() for metric in (psnr, ssim)]
    for index in range(4):
        reference = structural_similarity(
            true[index], predicted[index], gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
            channel_axis=-1, data_range=255,
        )  # fmt: skip
        assert found[1][index] == pytest.approx(reference, abs=2e-5)
        # Of equal frames it ends at the rounding error of eight bits.
        equal = index == 2
        reference = MAX_PSNR_DB if equal else peak_signal_noise_ratio(true[index], predicted[index], data_range=255)
        assert found[0][index] == pytest.approx(reference, abs=1e-3)
    assert 58.9 < MAX_PSNR_DB < 59.0


def test_frames_of_other_size_are_refused():
    with pytest.raises(DataError, match="differ in shape"):
        psnr(torch.zeros(2, 3, 16, 16), torch.zeros(3, 3, 16, 16))
    with pytest.raises(DataError, match="smaller than the SSIM window"):
        ssim(torch.zeros(2, 3, 8, 16), torch.zeros(2, 3, 8, 16))


def test_lpips_without_weights_says_so(tmp_path):
    with pytest.raises(UnavailableError, match="LPIPS is not available"):
        load_lpips(None)
    with pytest.raises(UnavailableError, match=f"missing .*{HEADS_FILE}"):
        load_lpips(tmp_path)
    torch.save({"features.0.weight": torch.zeros(1)}, tmp_path / BACKBONE_FILE)
    torch.save({}, tmp_path / HEADS_FILE)
    with pytest.raises(UnavailableError, match="another network"):
        load_lpips(tmp_path)


def test_lpips_equals_torchmetrics_on_the_same_weights(tmp_path):
    """Checks the network, not its weights: torchmetrics gets the same random ones."""
    reference_module = pytest.importorskip("torchmetrics.functional.image.lpips")
    torch.manual_seed(0)
    reference = reference_module._LPIPS(pretrained=False, net="alex", pnet_rand=True)
    heads = {name: value.abs() for name, value in reference.state_dict().items() if name.startswith("lin")}
    reference.load_state_dict(heads, strict=False)
    numbers = iter(("0", "3", "6", "8", "10"))
    backbone = {}
    for module in reference.net.modules():
        if isinstance(module, torch.nn.Conv2d):
            number = next(numbers)
            backbone |= {f"features.{number}.weight": module.weight, f"features.{number}.bias": module.bias}
    torch.save(backbone, tmp_path / BACKBONE_FILE)
    torch.save({name: value for name, value in heads.items() if not name.startswith("lins")}, tmp_path / HEADS_FILE)
    a, b = torch.rand(2, 2, 3, 64, 96)
    expected = reference(a, b, normalize=True).flatten()
    assert torch.allclose(load_lpips(tmp_path)(a, b), expected, atol=1e-6)
    assert float(expected.min()) > 0


EMPTY = np.zeros((4, 6), dtype=bool)
LEFT = EMPTY.copy()
LEFT[:, :2] = True
MIDDLE = EMPTY.copy()
MIDDLE[:, 1:3] = True


def test_overlap_over_union_of_each_frame_that_shows_something():
    assert frame_iou(LEFT[None], MIDDLE[None])[0] == pytest.approx(1 / 3)
    assert frame_iou(np.stack([LEFT, LEFT, EMPTY]), np.stack([LEFT, EMPTY, LEFT])).tolist() == [1.0, 0.0, 0.0]
    assert np.isnan(frame_iou(EMPTY[None], EMPTY[None]))
    for true, predicted in ((LEFT[None], MIDDLE[None, :2]), (LEFT[None].astype(np.uint8), MIDDLE[None])):
        with pytest.raises(DataError, match="do not fit"):
            frame_iou(true, predicted)


def _video_with_patch(column):
    video = np.full((1, 64, 96, 3), 90, dtype=np.uint8)
    video[0, 21:40, column - 3 : column + 16] = np.random.default_rng(0).integers(0, 256, (19, 19, 3), dtype=np.uint8)
    return video


def test_end_effector_error_is_the_displacement_of_the_gripper():
    points = np.array([[[46.0, 30.0], [np.nan, np.nan]]])
    true = _video_with_patch(40)
    assert end_effector_error(true, true, points)[0, 0] == 0.0
    assert end_effector_error(true, _video_with_patch(47), points)[0, 0] == 7.0
    assert np.isnan(end_effector_error(true, true, points)[0, 1])
    noise = np.random.default_rng(1).integers(0, 256, (1, 64, 96, 3), dtype=np.uint8)
    assert end_effector_error(true, noise, points)[0, 0] == 16.0  # found nowhere: the search radius


def test_interval_covers_the_true_mean_about_as_often_as_it_says():
    generator = np.random.default_rng(0)
    samples = generator.normal(3.0, 2.0, (200, 40))
    intervals = [bootstrap_mean(values, resamples=300, seed=trial) for trial, values in enumerate(samples)]
    assert 0.88 <= np.mean([interval.low <= 3.0 <= interval.high for interval in intervals]) <= 0.99
    assert bootstrap_mean(samples[0], seed=5) == bootstrap_mean(samples[0], seed=5)
    assert bootstrap_mean(samples[0], seed=5) != bootstrap_mean(samples[0], seed=6)


def test_weights_make_the_mean_one_over_pairs_of_finite_values():
    # Two trajectories: one with three views of 1.0, one with a single view of 0.0.
    assert bootstrap_mean([1.0, 0.0], weights=[3, 1]).mean == pytest.approx(0.75)
    for values in ([1.0, float("nan")], []):
        with pytest.raises(DataError, match="finite"):
            bootstrap_mean(values)


def test_pairing_removes_what_is_hard_for_both():
    generator = np.random.default_rng(2)
    difficulty = {f"t{i}": float(generator.normal(0, 10)) for i in range(30)}
    better = {name: value + 1.0 for name, value in difficulty.items()}
    interval = paired_difference(better, difficulty)
    assert interval.mean == pytest.approx(1.0) and interval.low > 0.9
    # Common trajectories alone count.
    interval = paired_difference({"a": 1.0, "b": 5.0}, {"a": 0.5, "c": 9.0})
    assert (interval.mean, interval.count) == (0.5, 1)
    assert paired_difference({"a": 1.0}, {"b": 1.0}) is None
