"""A small U-Net: one RGB frame in, one robot logit a pixel out."""

from __future__ import annotations

import itertools
from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

_GROUPS = 8


class UNet(nn.Module):
    """Encoder and decoder with skip connections at full, half, quarter and eighth resolution.

    Args:
        widths: channels at each resolution, finest first; multiples of 8.
    """

    def __init__(self, widths: tuple[int, ...] = (8, 24, 48, 96)) -> None:
        super().__init__()
        self.widths = widths
        self.encoder = nn.ModuleList(
            _double_convolution(cin, cout) for cin, cout in zip((3, *widths[:-1]), widths, strict=True)
        )
        self.decoder = nn.ModuleList(
            _double_convolution(coarse + fine, fine) for fine, coarse in itertools.pairwise(widths)
        )
        self.head = nn.Conv2d(widths[0], 1, 1)

    @property
    def stride(self) -> int:
        """Frames are padded to a multiple of this."""
        return 2 ** (len(self.widths) - 1)

    def forward(self, frames: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n h w"]:
        """Logits; intensities in [0, 1]. Any size: padded by repetition, cut again."""
        height, width = frames.shape[-2:]
        padding = (0, -width % self.stride, 0, -height % self.stride)
        features = functional.pad(2.0 * frames - 1.0, padding, mode="replicate")
        skips: list[Tensor] = []
        for level, block in enumerate(self.encoder):
            features = block(features if level == 0 else functional.max_pool2d(features, 2))
            skips.append(features)
        for level in reversed(range(len(self.decoder))):
            features = functional.interpolate(features, scale_factor=2, mode="bilinear", align_corners=False)
            features = self.decoder[level](torch.cat([features, skips[level]], dim=1))
        return cast(Tensor, self.head(features))[:, 0, :height, :width]


def _double_convolution(cin: int, cout: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(cin, cout, 3, padding=1, bias=False),
        nn.GroupNorm(_GROUPS, cout),
        nn.SiLU(),
        nn.Conv2d(cout, cout, 3, padding=1, bias=False),
        nn.GroupNorm(_GROUPS, cout),
        nn.SiLU(),
    )
