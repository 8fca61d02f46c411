"""Training of the patch tokenizer: fit the bases, then train the convolutional decoder on clean and disturbed codes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812 - the customary name
from einops import rearrange
from pydantic import Field
from torch import Tensor
from tqdm import tqdm

from worldline_core.config.base import StrictModel
from worldline_core.errors import DataError, TrainingError
from worldline_core.model.tokenizer.base import DESCRIPTION
from worldline_core.model.tokenizer.fit import fit_patch_tokenizer
from worldline_core.model.tokenizer.measure import reconstruction_metrics
from worldline_core.model.tokenizer.patch import PatchTokenizer
from worldline_core.model.tokenizer.pixels import frames_to_video
from worldline_core.model.tokenizer.refinement import Refinement
from worldline_core.store.atomic import atomic_path, write_json_atomic

if TYPE_CHECKING:
    from worldline_core.data.episodes.episode_set import EpisodeSet

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
