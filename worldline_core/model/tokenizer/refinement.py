"""The convolutional decoder of the patch tokenizer: sharpens, and copies what still equals the observed frame."""

from __future__ import annotations

import torch
import torch.nn.functional as F  # noqa: N812 - the customary name
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn


class _Residual(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(width, width, 3, padding=1)
        self.second = nn.Conv2d(width, width, 3, padding=1)

    def forward(self, features: Tensor) -> Tensor:
        return features + self.second(F.gelu(self.first(F.gelu(features))))


class Refinement(nn.Module):
    """A two-level U-Net at half and quarter resolution over one group of frames.

    It sees the coarse frames of the group, the coarse first frame, and the observed first frame; where the group's
    coarse pixels equal the first frame's, the observed pixels can be taken over unchanged. Each output frame is
    ``mask * observed + (1 - mask) * (coarse + residual)``; the residual starts at zero.
    """

    def __init__(self, group: int, width: int, depth: int) -> None:
        super().__init__()
        self.group = group
        inner = 2 * width
        self.enter = nn.Conv2d((group + 2) * 12 + 1, width, 3, padding=1)
        self.fine_in = _Residual(width)
        self.down = nn.Conv2d(width, inner, 3, stride=2, padding=1)
        self.coarse = nn.Sequential(*[_Residual(inner) for _ in range(depth)])
        self.up = nn.Conv2d(inner, 4 * width, 1)
        self.fine_out = _Residual(width)
        self.leave = nn.Conv2d(width, group * 4 * 4, 3, padding=1)
        nn.init.zeros_(self.leave.weight)
        bias = torch.zeros(group, 4, 4)
        bias[:, 3] = -1.0
        self.leave.bias = nn.Parameter(bias.flatten())

    def forward(
        self,
        frames: Float[Tensor, "b g 3 h w"],
        first: Float[Tensor, "b 3 h w"],
        reference: Float[Tensor, "b 3 h w"],
        known: Tensor,
    ) -> Float[Tensor, "b g 3 h w"]:
        """Refined frames; ``known``, ``(b)``, is 1 where ``reference`` is the observed frame, 0 where it only stands in."""
        stacked = torch.cat((rearrange(frames, "b g c h w -> b (g c) h w"), first, reference), dim=1)
        folded = F.pixel_unshuffle(stacked, 2)
        flag = rearrange(known, "b -> b 1 1 1").expand(-1, 1, *folded.shape[-2:]).to(folded.dtype)
        features = self.fine_in(
            self.enter(torch.cat((folded, flag), dim=1).contiguous(memory_format=torch.channels_last))
        )
        deep = self.coarse(self.down(F.gelu(features)))
        features = features + F.pixel_shuffle(self.up(F.gelu(deep)), 2)
        out = self.leave(F.gelu(self.fine_out(features))).float()
        out = rearrange(out, "b (g k p q) h w -> b g k (h p) (w q)", g=self.group, p=2, q=2)
        mask = torch.sigmoid(out[:, :, 3:])
        return mask * rearrange(reference, "b c h w -> b 1 c h w") + (1 - mask) * (frames + out[:, :, :3])
