"""LPIPS (Zhang et al. 2018), AlexNet variant, from weights in a local folder. Never from random weights.

The folder holds the two files that the reference implementations download:
``alexnet-owt-7be5be79.pth`` (torchvision's ImageNet AlexNet) and ``alex.pth`` (the learned linear heads, as shipped
with the ``lpips`` and ``torchmetrics`` packages).
"""

from __future__ import annotations

from pathlib import Path

import torch
from einops import reduce
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from worldline_core.errors import UnavailableError

BACKBONE_FILE = "alexnet-owt-7be5be79.pth"
HEADS_FILE = "alex.pth"

# index in torchvision's AlexNet.features, in, out, kernel, stride, padding; "pool before" of the five taps
LAYERS = (
    ("0", 3, 64, 11, 4, 2, False),
    ("3", 64, 192, 5, 1, 2, True),
    ("6", 192, 384, 3, 1, 1, True),
    ("8", 384, 256, 3, 1, 1, False),
    ("10", 256, 256, 3, 1, 1, False),
)
_MEAN = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)


class LPIPS(nn.Module):
    """Perceptual distance of each frame pair; lower is closer."""

    mean: Tensor
    scale: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.convolutions = nn.ModuleList(
            nn.Conv2d(cin, cout, kernel, stride, padding) for _, cin, cout, kernel, stride, padding, _ in LAYERS
        )
        self.heads = nn.ModuleList(nn.Conv2d(cout, 1, 1, bias=False) for _, _, cout, *_ in LAYERS)
        self.register_buffer("mean", torch.tensor(_MEAN).view(1, 3, 1, 1))
        self.register_buffer("scale", torch.tensor(_SCALE).view(1, 3, 1, 1))

    def forward(self, predicted: Float[Tensor, "n 3 h w"], true: Float[Tensor, "n 3 h w"]) -> Float[Tensor, " n"]:
        """Distance of each pair; intensities in [0, 1]."""
        distance = torch.zeros(predicted.shape[0], device=predicted.device)
        a = (2 * predicted.float() - 1 - self.mean) / self.scale
        b = (2 * true.float() - 1 - self.mean) / self.scale
        for layer, convolution, head in zip(LAYERS, self.convolutions, self.heads, strict=True):
            if layer[-1]:
                a, b = functional.max_pool2d(a, 3, 2), functional.max_pool2d(b, 3, 2)
            a, b = functional.relu(convolution(a)), functional.relu(convolution(b))
            difference = (_unit(a) - _unit(b)).square()
            distance = distance + reduce(head(difference), "n 1 h w -> n", "mean")
        return distance


def load_lpips(folder: Path | None) -> LPIPS:
    """LPIPS with the weights of ``folder``.

    Raises:
        UnavailableError: without a folder, without one of its files, or with files of another network.
    """
    if folder is None:
        raise UnavailableError(
            "LPIPS is not available",
            expected=f"a folder with {BACKBONE_FILE} and {HEADS_FILE}",
            got="no folder configured",
            next_step="download both files on a machine with network access and set evaluate_video.lpips_weights",
        )
    missing = [name for name in (BACKBONE_FILE, HEADS_FILE) if not (folder / name).is_file()]
    if missing:
        raise UnavailableError(
            "LPIPS is not available", where=folder, expected=f"{BACKBONE_FILE}, {HEADS_FILE}", got=f"missing {missing}"
        )
    backbone = torch.load(folder / BACKBONE_FILE, map_location="cpu", weights_only=True)
    heads = torch.load(folder / HEADS_FILE, map_location="cpu", weights_only=True)
    state: dict[str, Tensor] = {}
    for index, layer in enumerate(LAYERS):
        sources = {
            f"convolutions.{index}.weight": (backbone, f"features.{layer[0]}.weight"),
            f"convolutions.{index}.bias": (backbone, f"features.{layer[0]}.bias"),
            f"heads.{index}.weight": (heads, f"lin{index}.model.1.weight"),
        }
        for name, (source, key) in sources.items():
            if key not in source:
                raise UnavailableError("LPIPS weights of another network", where=folder, expected=f"key {key}")
            state[name] = source[key]
    model = LPIPS()
    shapes = {name: tuple(value.shape) for name, value in model.named_parameters()}
    wrong = [name for name, shape in shapes.items() if tuple(state[name].shape) != shape]
    if wrong:
        raise UnavailableError("LPIPS weights of another network", where=folder, got=f"other shapes of {wrong}")
    model.load_state_dict(state, strict=False)  # the two normalisation constants are not part of the files
    return model.eval().requires_grad_(False)


def _unit(features: Tensor) -> Tensor:
    return features / (features.square().sum(dim=1, keepdim=True) + 1e-8).sqrt()
