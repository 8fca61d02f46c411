"""The train_tokenizer step: fit the bases of the patch tokenizer, then train its convolutional decoder.

The decoder learns on exact and on disturbed codes, because a world model's predicted codes are not exact.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Float
from torch import Tensor

from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.model.patch_tokenizer import DESCRIPTION, PatchTokenizer, Refinement, fit_patch_tokenizer
from worldline_core.model.video_tokenizer import VideoTokenizer
from worldline_core.store.atomic import write_json_atomic
from worldline_core.training.frame_source import RecordedView, load_views
from worldline_core.training.trainer import Objective, ParameterGroup, step_generator, train
from worldline_core.training.training_config import TokenizerConfig

BASES = Path("run") / "bases"
_SHORTEST = 5  # frames: a first frame and one group


def select_episodes(episodes: EpisodeSet, splits: tuple[str, ...], limit: int | None, seed: int) -> list[int]:
    """Positions of the episodes of ``splits``; a limit takes a random but reproducible choice."""
    chosen = [i for split in splits for i in episodes.select(split=split)]
    if limit is not None and limit < len(chosen):
        order = np.random.default_rng(seed).permutation(len(chosen))[:limit]
        chosen = sorted(chosen[int(i)] for i in order)
    return chosen


def to_video(frames: Tensor) -> Tensor:
    """uint8 to [-1, 1]."""
    return frames.float() / 127.5 - 1.0


def video_batch(
    views: Sequence[RecordedView], config: TokenizerConfig, step: int, temporal: int = 4
) -> tuple[tuple[str, ...], Float[Tensor, "b 3 t h w"]]:
    """Names and clips of one step, a function of the step: a first frame and three later groups of each clip."""
    generator = np.random.default_rng((config.seed, 1, step))
    names, batch = [], []
    for _ in range(config.batch_size):
        view = views[int(generator.integers(len(views)))]
        count = view.frames.shape[1]
        groups = min((count - 1) // temporal, (config.clip_frames - 1) // temporal)
        start = int(generator.integers(count - groups * temporal))
        picked = np.sort(generator.integers(groups, size=3))
        index = [start, *(start + 1 + group * temporal + k for group in picked for k in range(temporal))]
        names.append(view.name)
        batch.append(to_video(view.frames[:, index]))
    return tuple(names), torch.stack(batch)


def disturb(latents: Tensor, amount: float, generator: torch.Generator) -> Tensor:
    """Codes as a world model might predict them: noisy or smoothed groups after an exact first frame."""
    batch, _, frames = latents.shape[:3]
    device = generator.device

    def rand(probability: float) -> Tensor:
        level = torch.rand(batch, 1, frames, 1, 1, generator=generator, device=device)
        return level * (torch.rand(batch, 1, frames, 1, 1, generator=generator, device=device) < probability)

    flat = rearrange(latents, "b c t h w -> (b t) c h w")
    blurred = F.avg_pool2d(F.pad(flat, (1, 1, 1, 1), mode="replicate"), 3, stride=1)
    blurred = rearrange(blurred, "(b t) c h w -> b c t h w", t=frames)
    smooth = rand(0.3 if amount > 0 else 0.0)
    disturbed = latents + smooth * (blurred - latents)
    disturbed = disturbed + amount * rand(0.7) * torch.randn(latents.shape, generator=generator, device=device)
    return torch.cat((latents[:, :, :1], disturbed[:, :, 1:]), dim=2)


@dataclass(frozen=True)
class DecoderBatch:
    """Clips of single views in [-1, 1], and what the decoder is given to reconstruct them.

    ``coarse``: what the disturbed codes alone decode to. ``observed``: the first frames, or None to do without.
    """

    names: tuple[str, ...]
    video: Float[Tensor, "b 3 t h w"]
    coarse: Float[Tensor, "b 3 t h w"]
    observed: Float[Tensor, "b 3 h w"] | None


@torch.no_grad()
def decoder_batch(
    tokenizer: PatchTokenizer, views: Sequence[RecordedView], config: TokenizerConfig, step: int
) -> DecoderBatch:
    """Clips of one step, coded, disturbed and decoded without the convolutional decoder; a function of the step."""
    names, video = video_batch(views, config, step, tokenizer.temporal_compression)
    generator = step_generator(config.seed, step, "cpu")
    coarse = tokenizer.decode_linear(disturb(tokenizer.encode(video), config.disturbance, generator))
    dropped = bool(torch.rand((), generator=generator) < config.reference_dropout)
    return DecoderBatch(names, video, coarse, None if dropped else video[:, :, 0])


class DecoderObjective(Objective[DecoderBatch]):
    """L1 and L2 on pixels, L1 on their differences between neighbours, heavier where the scene has changed."""

    def __init__(self, tokenizer: PatchTokenizer) -> None:
        self.tokenizer = tokenizer

    def loss(self, batch: DecoderBatch, generator: torch.Generator, step: int) -> tuple[Tensor, dict[str, float]]:
        """Loss of one batch."""
        del generator, step
        video = batch.video
        refined = self.tokenizer.refine(batch.coarse, batch.observed)
        weight = 1.0 + 3.0 * ((video - video[:, :, :1]).abs().amax(dim=1, keepdim=True) > 0.1).float()
        error = (refined.float() - video) * weight
        edges_h = (error[..., 1:, :] - error[..., :-1, :]).abs().mean()
        edges_w = (error[..., 1:] - error[..., :-1]).abs().mean()
        return error.abs().mean() + error.square().mean() + 0.5 * (edges_h + edges_w), {}


def train_decoder(
    tokenizer: PatchTokenizer, views: Sequence[RecordedView], config: TokenizerConfig, output: Path, start: str = ""
) -> None:
    """Train the decoder in place (its average is kept); continues from ``output/run`` if training was cut short.

    Args:
        start: digest of the tokenizer that is trained further, if any: a state of another start is refused.

    Raises:
        TrainingError: the loss or the gradient is not finite.
    """
    decoder = tokenizer.refinement.train().requires_grad_(True)
    if config.steps:
        result = train(
            config.trainer,
            groups=[ParameterGroup("decoder", dict(decoder.named_parameters()))],
            objective=DecoderObjective(tokenizer),
            load=lambda index: decoder_batch(tokenizer, views, config, index),
            output=output,
            identity={
                "config": config.model_dump(mode="json"),
                "encoder": tokenizer.encoder_digest,
                "start": start,
                "episodes": [view.name for view in views],
            },
            title="tokenizer",
            schedule=config.schedule,
        )
        decoder.load_state_dict(result.average)
    decoder.eval().requires_grad_(False)


def _fitted(config: TokenizerConfig, views: Sequence[RecordedView], folder: Path) -> PatchTokenizer:
    """Bases fitted now, or by the call that was interrupted (eigenvectors are not the same bits on another machine)."""

    def clips() -> Iterator[Tensor]:
        generator = np.random.default_rng(config.seed)
        for _ in range(config.fit_clips):
            frames = views[int(generator.integers(len(views)))].frames
            length = min(config.clip_frames, 1 + (frames.shape[1] - 1) // 4 * 4)
            start = int(generator.integers(frames.shape[1] - length + 1))
            yield to_video(frames[None, :, start : start + length])

    if not (folder / DESCRIPTION).is_file():
        fit_patch_tokenizer(
            clips(),
            channels=config.channels,
            motion_weight=config.motion_weight,
            whitening=config.whitening,
            refinement_width=config.refinement_width,
            refinement_depth=config.refinement_depth,
        ).save(folder)
    return PatchTokenizer.load(folder)


def clip_of(video: Tensor, frames: int, temporal: int) -> Tensor:
    """The first ``frames`` (or as many whole groups as there are) of ``uint8 (3, N, H, W)``, as ``(1 3 t h w)``."""
    length = 1 + (min(frames, video.shape[1]) - 1) // temporal * temporal
    return to_video(video[None, :, :length])


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
            per_frame = error.mean(dim=(1, 3, 4)).clamp_min(1e-10)
            sums[f"psnr/{name}"] = sums.get(f"psnr/{name}", 0.0) + float((10 * torch.log10(4.0 / per_frame)).mean())
            inside = float((error * changed).sum() / (3 * changed.sum()).clamp_min(1))
            sums[f"changed_mse/{name}"] = sums.get(f"changed_mse/{name}", 0.0) + inside
        sums["latent_deviation"] = sums.get("latent_deviation", 0.0) + float(latents.square().mean().sqrt())
    return {name: round(total / len(videos), 5) for name, total in sorted(sums.items())}


def train_tokenizer(config: TokenizerConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """Fit, train and measure a patch tokenizer on ``inputs["episodes"]`` (an EpisodeSet).

    It is measured on the held-out splits of that set, or of ``inputs["held_out"]`` when that is given. With
    ``inputs["start"]``, a tokenizer, its bases are kept (latents stay valid) and its decoder is trained further.

    Writes ``tokenizer.safetensors``, ``tokenizer.json``, ``metrics.jsonl`` (the losses) and ``metrics.json`` into
    ``output``; an interrupted call continues where it stopped and ends with the same bytes.

    Returns:
        reconstruction metrics on held-out scenes; {"found", "kept", "left_out"} count the episodes.
    """
    episodes = EpisodeSet.open(inputs["episodes"])
    rows = episodes.rows
    chosen = select_episodes(episodes, config.splits, config.max_episodes, config.seed)
    views = load_views(episodes, chosen, config.image_size, _SHORTEST)
    if "start" in inputs:
        tokenizer = PatchTokenizer.load(Path(inputs["start"]))
        start = tokenizer.weights_sha256
    else:
        start = ""
        tokenizer = _fitted(config, views, output / BASES)
        torch.manual_seed(config.seed)
        tokenizer.refinement = Refinement(
            tokenizer.temporal_compression, config.refinement_width, config.refinement_depth
        )
    train_decoder(tokenizer, views, config, output, start)
    metadata = {
        "config": config.model_dump(mode="json"),
        "training_episodes": len(chosen),
        "training_views": len(views),
    }
    tokenizer.save(output, metadata)
    if "held_out" in inputs:
        episodes = EpisodeSet.open(inputs["held_out"])
    held_out = select_episodes(episodes, config.held_out_splits, config.held_out_episodes, config.seed)
    metrics: dict[str, Any] = dict(metadata)
    if held_out:
        videos = [view.frames for view in load_views(episodes, held_out, config.image_size, _SHORTEST)]
        metrics["held_out_episodes"] = len(held_out)
        metrics["held_out"] = reconstruction_metrics(PatchTokenizer.load(output), videos, config.clip_frames)
    write_json_atomic(output / "metrics.json", metrics)
    fitting = sum(row.split in config.splits for row in rows)
    used = len({view.name.rpartition("/")[0] for view in views})
    left_out = {
        "in other splits": len(rows) - fitting,
        "beyond max_episodes": fitting - len(chosen),
        f"shorter than {_SHORTEST} frames": len(chosen) - used,
    }
    return {**metrics, "found": len(rows), "kept": used, "left_out": left_out}
