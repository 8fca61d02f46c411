import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from worldline_core.errors import DataError, UnavailableError
from worldline_core.evaluation.metrics import MAX_PSNR_DB, frames_to_unit, psnr, ssim
from worldline_core.model.lpips import BACKBONE_FILE, HEADS_FILE, load_lpips


@pytest.fixture
def pair() -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(0)
    true = generator.integers(0, 256, (4, 32, 48, 3), dtype=np.uint8)
    true[1] = 130  # flat: variances vanish
    noise = generator.integers(-30, 31, true.shape)
    predicted = np.clip(true.astype(int) + noise, 0, 255).astype(np.uint8)
    predicted[2] = true[2]
    return predicted, true


def test_psnr_equals_scikit_image(pair):
    predicted, true = pair
    ours = psnr(*(frames_to_unit(torch.from_numpy(x)) for x in pair)).numpy()
    for index in (0, 1, 3):
        reference = peak_signal_noise_ratio(true[index], predicted[index], data_range=255)
        assert ours[index] == pytest.approx(reference, abs=1e-3)


def test_psnr_of_equal_frames_ends_at_the_rounding_error_of_eight_bits(pair):
    ours = psnr(*(frames_to_unit(torch.from_numpy(x)) for x in pair)).numpy()
    assert ours[2] == pytest.approx(MAX_PSNR_DB, abs=1e-3)
    assert 58.9 < MAX_PSNR_DB < 59.0


def test_ssim_equals_scikit_image(pair):
    predicted, true = pair
    ours = ssim(*(frames_to_unit(torch.from_numpy(x)) for x in pair)).numpy()
    for index in range(4):
        reference = structural_similarity(
            true[index], predicted[index], gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
            channel_axis=-1, data_range=255,
        )  # fmt: skip
        assert ours[index] == pytest.approx(reference, abs=2e-5)


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


def test_lpips_with_weights_of_another_network_says_so(tmp_path):
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
