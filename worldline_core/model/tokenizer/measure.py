"""How well a tokenizer gives back what it coded."""

from __future__ import annotations

import time

import torch
from torch import Tensor

from worldline_core.model.tokenizer.base import VideoTokenizer
from worldline_core.model.tokenizer.patch import PatchTokenizer


def peak_signal_to_noise(video: Tensor, other: Tensor) -> float:
    """PSNR in dB of videos in [-1, 1], ``(b 3 t h w)``: per frame, then averaged."""
    error = (video.clamp(-1, 1) - other.clamp(-1, 1)).square().mean(dim=(1, 3, 4)).clamp_min(1e-10)
    return float((10 * torch.log10(4.0 / error)).mean())


def clip_of(video: Tensor, frames: int, temporal: int) -> Tensor:
    """The first ``frames`` (or as many whole groups as there are) of ``uint8 (3, N, H, W)``, as ``(1 3 t h w)``."""
    length = 1 + (min(frames, video.shape[1]) - 1) // temporal * temporal
    return video[None, :, :length].float() / 127.5 - 1.0


@torch.no_grad()
def reconstruction_metrics(tokenizer: VideoTokenizer, videos: list[Tensor], frames: int) -> dict[str, float]:
    """PSNR of the decoders and of copying the first frame, over all pixels and over pixels that changed."""
    sums: dict[str, float] = {}
    for video in videos:
        clip = clip_of(video, frames, tokenizer.temporal_compression)
        latents = tokenizer.encode(clip)
        candidates = {
            "decoded": tokenizer.decode(latents),
            "decoded_with_reference": tokenizer.decode(latents, clip[:, :, 0]),
            "copy_first_frame": clip[:, :, :1].expand_as(clip),
        }
        if isinstance(tokenizer, PatchTokenizer):
            candidates["linear"] = tokenizer.decode_linear(latents)
        changed = ((clip - clip[:, :, :1]).abs().amax(dim=1, keepdim=True) > 0.1).float()
        for name, candidate in candidates.items():
            error = (clip - candidate.clamp(-1, 1)).square()
            sums[f"psnr/{name}"] = sums.get(f"psnr/{name}", 0.0) + peak_signal_to_noise(clip, candidate)
            inside = float((error * changed).sum() / (3 * changed.sum()).clamp_min(1))
            sums[f"changed_mse/{name}"] = sums.get(f"changed_mse/{name}", 0.0) + inside
        sums["latent_deviation"] = sums.get("latent_deviation", 0.0) + float(latents.square().mean().sqrt())
    return {name: round(total / len(videos), 5) for name, total in sorted(sums.items())}


def milliseconds(tokenizer: VideoTokenizer, clip: Tensor, repeats: int = 5) -> tuple[float, float]:
    """Median wall time to encode and to decode one clip."""
    with torch.no_grad():
        latents = tokenizer.encode(clip)
        tokenizer.decode(latents)
        times: list[list[float]] = [[], []]
        for _ in range(repeats):
            start = time.perf_counter()
            tokenizer.encode(clip)
            middle = time.perf_counter()
            tokenizer.decode(latents)
            times[0].append((middle - start) * 1e3)
            times[1].append((time.perf_counter() - middle) * 1e3)
    return sorted(times[0])[repeats // 2], sorted(times[1])[repeats // 2]
