"""Training of the patch tokenizer: fit the bases, then train the convolutional decoder on clean and disturbed codes.

Bases of the patch tokenizer: principal components of static and of moving patches.

How well a tokenizer gives back what it coded.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import torch.nn.functional as F
from einops import rearrange
from pydantic import Field
from torch import Tensor
from tqdm import tqdm

from worldline_core.config import StrictModel
from worldline_core.errors import DataError, TrainingError
from worldline_core.model.patch_tokenizer import PatchTokenizer, PatchTokenizerConfig, Refinement
from worldline_core.model.video_tokenizer import DESCRIPTION, VideoTokenizer, frames_to_video
from worldline_core.store.atomic import atomic_path, write_json_atomic

if TYPE_CHECKING:
    from worldline_core.data.episodes.episode_set import EpisodeSet


@dataclass
class _Moments:
    static: Tensor
    motion: Tensor
    total: Tensor
    weight: float = 0.0


def fit_patch_tokenizer(
    clips: Iterable[Tensor],
    *,
    channels: int = 32,
    spatial: int = 8,
    temporal: int = 4,
    motion_weight: float = 4.0,
    whitening: float = 0.5,
    refinement_width: int = 48,
    refinement_depth: int = 2,
) -> PatchTokenizer:
    """Fit the linear part to clips ``(b, 3, 1 + k * temporal, h, w)`` in [-1, 1].

    Static and motion components lie in orthogonal subspaces, so the best ``channels`` of the two spectra together are
    the best basis of this form; how many are static follows from the data.

    Args:
        motion_weight: extra weight of patches that differ from the clip's first frame (arms and what they move).
        whitening: 0 divides all channels by one number, 1 each by its standard deviation, in between by that power of
            it. Always followed by one number, so that latents have unit variance over all channels of a group.

    Raises:
        DataError: there are no clips.
    """
    pixels = 3 * spatial**2
    moments = _Moments(
        torch.zeros(pixels, pixels, dtype=torch.float64),
        torch.zeros(temporal * pixels, temporal * pixels, dtype=torch.float64),
        torch.zeros(pixels, dtype=torch.float64),
    )
    for video in clips:
        _accumulate(moments, video.float(), spatial, temporal, motion_weight)
    if moments.weight == 0:
        raise DataError("No clips to fit the tokenizer to", next_step="check the selection of episodes")
    mean = moments.total / moments.weight
    static_values, static_vectors = torch.linalg.eigh(moments.static / moments.weight - torch.outer(mean, mean))
    motion_values, motion_vectors = torch.linalg.eigh(moments.motion / moments.weight)
    # A static vector stands for `temporal` equal frames: its energy in pixels is that many times its variance.
    energies = torch.cat((static_values.flip(0) * temporal, motion_values.flip(0)[: channels - 1]))
    chosen = torch.argsort(energies, descending=True)[:channels]
    static_count = int((chosen < pixels).sum())
    tokenizer = PatchTokenizer(
        PatchTokenizerConfig(
            static_channels=static_count,
            motion_channels=channels - static_count,
            spatial_compression=spatial,
            temporal_compression=temporal,
            refinement_width=refinement_width,
            refinement_depth=refinement_depth,
        )
    )
    static_basis = _signed(static_vectors.flip(1)[:, :static_count].T)
    motion_basis = _signed(motion_vectors.flip(1)[:, : channels - static_count].T)
    kept = torch.cat(
        (static_values.flip(0)[:static_count] * temporal, motion_values.flip(0)[: channels - static_count])
    )
    deviation = kept.clamp_min(1e-12).sqrt()
    scale = deviation**whitening
    scale = scale * ((deviation / scale) ** 2).mean().sqrt()
    scale[:static_count] /= temporal**0.5
    tokenizer.mean.copy_(mean)
    tokenizer.static_basis.copy_(static_basis)
    tokenizer.motion_basis.copy_(motion_basis)
    tokenizer.scale.copy_(scale)
    return tokenizer


def _accumulate(moments: _Moments, video: Tensor, spatial: int, temporal: int, motion_weight: float) -> None:
    patches = rearrange(video, "b c t (h p) (w q) -> b t (h w) (c p q)", p=spatial, q=spatial)
    groups = rearrange(patches[:, 1:], "b (n g) s d -> b n s g d", g=temporal)
    means = groups.mean(dim=3)
    change = (groups - rearrange(patches[:, 0], "b s d -> b 1 s 1 d")).abs().mean(dim=(3, 4))
    weights = 1.0 + motion_weight * (change > 0.05).float()
    flat = rearrange(means, "b n s d -> (b n s) d")
    weight = rearrange(weights, "b n s -> (b n s) 1")
    moments.static += ((flat * weight).T @ flat).double()
    moments.total += (flat * weight).sum(dim=0).double()
    moments.weight += float(weight.double().sum())
    moving = rearrange(groups - rearrange(means, "b n s d -> b n s 1 d"), "b n s g d -> (b n s) (g d)")
    moments.motion += ((moving * weight).T @ moving).double()


def _signed(basis: Tensor) -> Tensor:
    """Eigenvectors have no sign of their own; make the largest entry positive, so that equal data give equal bases."""
    largest = basis.gather(1, basis.abs().argmax(dim=1, keepdim=True))
    return basis * torch.where(largest < 0, -1.0, 1.0)


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


STATE = Path("run") / "decoder_state.pt"
BASES = Path("run") / "bases"


class TokenizerConfig(StrictModel):
    """Everything the shipped tokenizer depends on."""

    image_size: tuple[int, int] = (64, 96)
    channels: int = Field(default=32, ge=1)
    motion_weight: float = Field(default=4.0, ge=0)
    whitening: float = Field(default=0.5, ge=0, le=1)
    refinement_width: int = Field(default=48, ge=4)
    refinement_depth: int = Field(default=2, ge=1)
    splits: tuple[str, ...] = ("train",)
    held_out_splits: tuple[str, ...] = ("validation", "test")
    max_episodes: int | None = Field(default=None, ge=1)
    held_out_episodes: int = Field(default=12, ge=0)
    clip_frames: int = Field(default=33, ge=5)
    fit_clips: int = Field(default=600, ge=1)
    steps: int = Field(default=4000, ge=0)
    batch_size: int = Field(default=8, ge=1)
    """Clips a step; each gives its first frame and three groups of four frames."""
    learning_rate: float = Field(default=2e-3, gt=0)
    warmup_steps: int = Field(default=100, ge=0)
    average_decay: float = Field(default=0.998, ge=0, lt=1)
    reference_dropout: float = Field(default=0.1, ge=0, le=1)
    disturbance: float = Field(default=0.3, ge=0)
    """Largest standard deviation of the noise added to the codes of the groups (0 trains on exact codes only)."""
    seed: int = Field(default=0, ge=0)
    checkpoint_every: int = Field(default=500, ge=1)
    bfloat16: bool = True


def select_episodes(episodes: EpisodeSet, splits: tuple[str, ...], limit: int | None, seed: int) -> list[int]:
    """Positions of the episodes of ``splits``; a limit takes a random but reproducible choice."""
    chosen = [i for split in splits for i in episodes.select(split=split)]
    if limit is not None and limit < len(chosen):
        order = np.random.default_rng(seed).permutation(len(chosen))[:limit]
        chosen = sorted(chosen[int(i)] for i in order)
    return chosen


def load_views(episodes: EpisodeSet, chosen: list[int], image_size: tuple[int, int], minimum: int) -> list[Tensor]:
    """All views of the episodes as ``uint8 (3, N, H, W)`` at the training size, one entry a view."""
    videos: list[Tensor] = []
    for position in tqdm(chosen, desc="reading episodes", disable=None):
        for view in episodes.rows[position].views:
            frames = episodes.frames(position, view)
            if len(frames) >= minimum:
                video = frames_to_video(frames, image_size)
                videos.append(((video + 1.0) * 127.5).round().to(torch.uint8))
    if not videos:
        raise DataError("No episode is long enough to train the tokenizer on", expected=f">= {minimum} frames")
    return videos


def to_float(video: Tensor) -> Tensor:
    """uint8 to [-1, 1]."""
    return video.float() / 127.5 - 1.0


def fitting_clips(videos: list[Tensor], config: TokenizerConfig, temporal: int) -> Iterator[Tensor]:
    """Random clips, one at a time, as the fit consumes them."""
    generator = np.random.default_rng(config.seed)
    for _ in range(config.fit_clips):
        video = videos[int(generator.integers(len(videos)))]
        length = min(config.clip_frames, 1 + (video.shape[1] - 1) // temporal * temporal)
        start = int(generator.integers(video.shape[1] - length + 1))
        yield to_float(video[None, :, start : start + length])


def decoder_batch(videos: list[Tensor], config: TokenizerConfig, step: int, temporal: int = 4) -> Tensor:
    """Batch of one step: a first frame and three later groups of each clip, ``(b 3 13 h w)``; a function of the step."""
    generator = np.random.default_rng((config.seed, 1, step))
    batch = []
    for _ in range(config.batch_size):
        video = videos[int(generator.integers(len(videos)))]
        groups = min((video.shape[1] - 1) // temporal, (config.clip_frames - 1) // temporal)
        start = int(generator.integers(video.shape[1] - groups * temporal))
        picked = np.sort(generator.integers(groups, size=3))
        index = [start, *(start + 1 + group * temporal + k for group in picked for k in range(temporal))]
        batch.append(to_float(video[:, index]))
    return torch.stack(batch)


def disturb(latents: Tensor, amount: float, generator: torch.Generator) -> Tensor:
    """Codes as a world model might predict them: noisy or smoothed groups after an exact first frame."""
    batch, _, frames = latents.shape[:3]

    def rand(probability: float) -> Tensor:
        level = torch.rand(batch, 1, frames, 1, 1, generator=generator)
        return level * (torch.rand(batch, 1, frames, 1, 1, generator=generator) < probability)

    flat = rearrange(latents, "b c t h w -> (b t) c h w")
    blurred = F.avg_pool2d(F.pad(flat, (1, 1, 1, 1), mode="replicate"), 3, stride=1)
    blurred = rearrange(blurred, "(b t) c h w -> b c t h w", t=frames)
    smooth = rand(0.3 if amount > 0 else 0.0)
    disturbed = latents + smooth * (blurred - latents)
    disturbed = disturbed + amount * rand(0.7) * torch.randn(latents.shape, generator=generator)
    return torch.cat((latents[:, :, :1], disturbed[:, :, 1:]), dim=2)


def decoder_loss(tokenizer: PatchTokenizer, video: Tensor, config: TokenizerConfig, step: int) -> Tensor:
    """L1 on pixels and on their differences between neighbours, heavier where the scene has changed."""
    generator = torch.Generator().manual_seed(config.seed * 1_000_003 + step)
    with torch.no_grad():
        latents = disturb(tokenizer.encode(video), config.disturbance, generator)
        coarse = tokenizer.decode_linear(latents)
    dropped = bool(torch.rand((), generator=generator) < config.reference_dropout)
    with torch.autocast("cpu", torch.bfloat16, enabled=config.bfloat16):
        refined = tokenizer.refine(coarse, None if dropped else video[:, :, 0])
    weight = 1.0 + 3.0 * ((video - video[:, :, :1]).abs().amax(dim=1, keepdim=True) > 0.1).float()
    error = (refined.float() - video) * weight
    edges_h = (error[..., 1:, :] - error[..., :-1, :]).abs().mean()
    edges_w = (error[..., 1:] - error[..., :-1]).abs().mean()
    return error.abs().mean() + error.square().mean() + 0.5 * (edges_h + edges_w)


def train_decoder(tokenizer: PatchTokenizer, videos: list[Tensor], config: TokenizerConfig, output: Path) -> None:
    """Train the refinement network in place; continues from ``output/run`` if training was cut short.

    Raises:
        TrainingError: the loss is not finite.
    """
    network = tokenizer.refinement.train().requires_grad_(True)
    optimizer = torch.optim.AdamW(network.parameters(), lr=config.learning_rate, betas=(0.9, 0.99), weight_decay=1e-4)
    average = {name: value.detach().clone() for name, value in network.state_dict().items()}
    start = 0
    if (output / STATE).is_file():
        state = torch.load(output / STATE, weights_only=True)
        network.load_state_dict(state["network"])
        optimizer.load_state_dict(state["optimizer"])
        average, start = state["average"], int(state["step"])
    progress = tqdm(range(start, config.steps), initial=start, total=config.steps, desc="decoder", disable=None)
    for step in progress:
        warm = min(1.0, (step + 1) / max(config.warmup_steps, 1))
        for group in optimizer.param_groups:
            group["lr"] = config.learning_rate * warm * 0.5 * (1 + math.cos(math.pi * step / config.steps))
        loss = decoder_loss(tokenizer, decoder_batch(videos, config, step), config, step)
        if not bool(torch.isfinite(loss)):
            raise TrainingError(
                "The decoder's loss is not finite", where=f"step {step}", next_step="lower learning_rate"
            )
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        decay = min(config.average_decay, (1 + step) / (10 + step))
        for name, value in network.state_dict().items():
            average[name].lerp_(value.detach(), 1.0 - decay)
        if step % 50 == 0:
            progress.set_postfix(loss=f"{float(loss.detach()):.4f}")
        if (step + 1) % config.checkpoint_every == 0:
            _save_state(output / STATE, network, optimizer, average, step + 1)
    network.load_state_dict(average)
    network.eval().requires_grad_(False)


def _save_state(
    path: Path, network: torch.nn.Module, optimizer: torch.optim.Optimizer, average: Mapping[str, Tensor], step: int
) -> None:
    state = {
        "network": network.state_dict(),
        "optimizer": optimizer.state_dict(),
        "average": dict(average),
        "step": step,
    }
    with atomic_path(path) as temporary:
        torch.save(state, temporary)


def _fitted(config: TokenizerConfig, videos: list[Tensor], folder: Path) -> PatchTokenizer:
    """Bases fitted now, or by the call that was interrupted (eigenvectors are not the same bits on another machine)."""
    if not (folder / DESCRIPTION).is_file():
        fit_patch_tokenizer(
            fitting_clips(videos, config, 4),
            channels=config.channels,
            motion_weight=config.motion_weight,
            whitening=config.whitening,
            refinement_width=config.refinement_width,
            refinement_depth=config.refinement_depth,
        ).save(folder)
    return PatchTokenizer.load(folder)


def train_tokenizer(config: TokenizerConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """Fit, train and measure a patch tokenizer on ``inputs["episodes"]`` (an episode set).

    It is measured on the held-out splits of that set, or of ``inputs["held_out"]`` when that is given. With
    ``inputs["start"]``, a tokenizer, its bases are kept (latents stay valid) and its decoder is trained further.

    Writes ``tokenizer.safetensors``, ``tokenizer.json`` and ``metrics.json`` into ``output``; an interrupted call goes
    on where it stopped and ends with the same bytes.

    Returns:
        reconstruction metrics on held-out scenes.
    """
    from worldline_core.data.episodes.episode_set import EpisodeSet

    episodes = EpisodeSet.open(inputs["episodes"])
    chosen = select_episodes(episodes, config.splits, config.max_episodes, config.seed)
    videos = load_views(episodes, chosen, config.image_size, 5)
    if "start" in inputs:
        tokenizer = PatchTokenizer.load(Path(inputs["start"]))
    else:
        tokenizer = _fitted(config, videos, output / BASES)
        torch.manual_seed(config.seed)
        tokenizer.refinement = Refinement(
            tokenizer.temporal_compression, config.refinement_width, config.refinement_depth
        )
    train_decoder(tokenizer, videos, config, output)
    metadata = {
        "config": config.model_dump(mode="json"),
        "training_episodes": len(chosen),
        "training_views": len(videos),
    }
    tokenizer.save(output, metadata)
    if "held_out" in inputs:
        episodes = EpisodeSet.open(inputs["held_out"])
    held_out = select_episodes(episodes, config.held_out_splits, config.held_out_episodes, config.seed)
    metrics: dict[str, Any] = dict(metadata)
    if held_out:
        shipped = PatchTokenizer.load(output)
        metrics["held_out_episodes"] = len(held_out)
        metrics["held_out"] = reconstruction_metrics(
            shipped, load_views(episodes, held_out, config.image_size, 5), config.clip_frames
        )
    write_json_atomic(output / "metrics.json", metrics)
    return metrics
