"""The perceptual auxiliary (L_LPIPS): distance of decoded frames in a pretrained network's features.

It needs the LPIPS weights in a local folder. Without them the term is off, and says so: a network with random weights
would be no perceptual distance.
"""

from __future__ import annotations

import inspect
from pathlib import Path

import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor

from worldline_core.evaluation.video.lpips import LPIPS, load_lpips
from worldline_core.model.tokenizer.base import VideoTokenizer


class PerceptualLoss:
    """Mean LPIPS of some decoded frames, differentiable in the predicted latents.

    Args:
        tokenizer: decodes latents; stays frozen.
        weights: folder of the LPIPS weights.
        latent_frames: how many latent frames, the last ones, are compared (decoding is the expensive part).

    Raises:
        UnavailableError: the folder lacks the weights.
    """

    def __init__(self, tokenizer: VideoTokenizer, weights: Path, latent_frames: int = 2, device: str = "cpu") -> None:
        self.tokenizer = tokenizer
        self.latent_frames = latent_frames
        self.network = load_lpips(weights).to(device)
        # The metric is declared free of gradients; the loss is the same function with them.
        self._distance = inspect.unwrap(LPIPS.forward)

    def __call__(
        self, predicted: Float[Tensor, "b v c t h w"], target: Float[Tensor, "b v c t h w"]
    ) -> Float[Tensor, ""]:
        """LPIPS between both clips, decoded from their observed frame on and cut to the last latent frames."""
        video = self._decode(predicted)
        with torch.no_grad():
            reference = self._decode(target)
        count = self.latent_frames * self.tokenizer.temporal_compression
        frames, references = (
            rearrange(clip[:, :, -count:] / 2 + 0.5, "n c t h w -> (n t) c h w").clamp(0, 1)
            for clip in (video, reference)
        )
        return self._distance(self.network, frames, references).mean()

    def _decode(self, latents: Tensor) -> Tensor:
        return self.tokenizer.decode(rearrange(latents.float(), "b v c t h w -> (b v) c t h w"))
