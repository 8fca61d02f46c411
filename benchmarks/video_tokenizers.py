"""Which tokenizer for the embedded size: linear, linear with a decoder, or a small convolutional autoencoder.

``python -m benchmarks.video_tokenizers --episodes SET --tokenizer FOLDER --minutes 5`` trains a small
``AutoencoderKLWan`` for that long on the training episodes and prints reconstruction quality and time of each.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from worldline_core.model.patch_tokenizer import PatchTokenizer
from worldline_core.model.tokenizers import WanTokenizer
from worldline_core.model.video_tokenizer import VideoTokenizer
from worldline_core.training.frame_source import RecordedView, load_views
from worldline_core.training.train_tokenizer import clip_of, drawn_clips, reconstruction_metrics, select_episodes
from worldline_core.training.training_config import TokenizerConfig


def small_wan(latent_channels: int = 32) -> WanTokenizer:
    """A Wan autoencoder of about two million parameters: 8 x 8 in space, 4 in time."""
    from diffusers.models.autoencoders.autoencoder_kl_wan import AutoencoderKLWan

    vae = AutoencoderKLWan(
        base_dim=24,
        decoder_base_dim=32,
        z_dim=latent_channels,
        dim_mult=[1, 2, 2],
        num_res_blocks=1,
        temperal_downsample=[True, True],
        is_residual=True,
        in_channels=12,
        out_channels=12,
        patch_size=2,
        scale_factor_spatial=8,
        scale_factor_temporal=4,
        latents_mean=[0.0] * latent_channels,
        latents_std=[1.0] * latent_channels,
    )
    return WanTokenizer(vae)


def train_wan(tokenizer: WanTokenizer, views: list[RecordedView], config: TokenizerConfig, seconds: float) -> int:
    """Train on reconstruction alone for ``seconds``; returns the steps made."""
    optimizer = torch.optim.AdamW(tokenizer.parameters(), lr=config.learning_rate, betas=(0.9, 0.99))
    started, step = time.perf_counter(), 0
    while time.perf_counter() - started < seconds:
        video = torch.stack([clip.picked for clip in drawn_clips(views, config, step)])
        loss = (tokenizer.decode(tokenizer.encode(video)) - video).abs().mean()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(tokenizer.parameters(), 1.0)
        optimizer.step()
        step += 1
    return step


def milliseconds(tokenizer: VideoTokenizer, clip: Tensor, repeats: int = 5) -> tuple[float, float]:
    """Median wall time to encode and to decode one clip [ms]."""
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


def compare(
    patch: PatchTokenizer, wan: WanTokenizer, held_out: list[Tensor], frames: int
) -> dict[str, dict[str, float]]:
    """Metrics and milliseconds per clip (one view) of both tokenizers, and of the linear part alone."""
    clip = clip_of(held_out[0], frames, patch.temporal_compression)
    rows: dict[str, dict[str, float]] = {}
    tokenizers: dict[str, VideoTokenizer] = {"patch": patch, "wan": wan}
    for name, tokenizer in tokenizers.items():
        encode_ms, decode_ms = milliseconds(tokenizer, clip)
        rows[name] = reconstruction_metrics(tokenizer, held_out, frames)
        rows[name] |= {"encode_ms": round(encode_ms, 2), "decode_ms": round(decode_ms, 2)}
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    from worldline_core.data.episodes.episode_set import EpisodeSet

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=Path, required=True)
    parser.add_argument("--tokenizer", type=Path, required=True)
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--max-episodes", type=int, default=40)
    parser.add_argument("--held-out-split", default="validation")
    options = parser.parse_args(arguments)
    config = TokenizerConfig(max_episodes=options.max_episodes, batch_size=1)
    episodes = EpisodeSet.open(options.episodes)
    chosen = select_episodes(episodes, config.splits, config.max_episodes, config.seed)
    held_out = select_episodes(episodes, (options.held_out_split,), 4, config.seed)
    views = load_views(episodes, chosen, config.image_size, 5)
    torch.manual_seed(config.seed)
    wan = small_wan()
    steps = train_wan(wan, views, config, options.minutes * 60)
    rows = compare(
        PatchTokenizer.load(options.tokenizer),
        wan.eval().requires_grad_(False),
        [view.frames for view in load_views(episodes, held_out, config.image_size, 5)],
        config.clip_frames,
    )
    print(f"AutoencoderKLWan: {sum(p.numel() for p in wan.parameters()):,} parameters, {steps} steps")
    for name, metrics in rows.items():
        print(name, *(f"{key}={value}" for key, value in metrics.items()))


if __name__ == "__main__":
    main()
