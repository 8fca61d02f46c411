"""The train_tokenizer step: fit the bases of the patch tokenizer, then train its convolutional decoder; or train a small
decoder for the latents of an existing tokenizer.

Decoders learn on exact and on disturbed codes, because a world model's predicted codes are not exact.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
import torch.nn.functional as F
from einops import rearrange, repeat
from jaxtyping import Float, UInt8
from torch import Tensor

from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import ConfigError
from worldline_core.model.small_decoder import SmallDecoder, SmallDecoderConfig, windows
from worldline_core.model.tokenizers import (
    DESCRIPTION,
    PatchTokenizer,
    Refinement,
    VideoTokenizer,
    fit_patch_tokenizer,
    load_tokenizer,
    tokenizer_fingerprint,
)
from worldline_core.store.atomic import write_json_atomic
from worldline_core.training.clip_source import load_views
from worldline_core.training.trainer import Objective, ParameterGroup, step_generator, train
from worldline_core.training.training_config import TokenizerConfig

Views = Sequence[tuple[str, Tensor]]
"""Names, episode/view, and uint8 (3, n, h, w) frames of videos that are held in memory."""
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


@dataclass(frozen=True)
class DrawnClip:
    """A clip that a step learns from: its frames, three of its groups of frames, and in [-1, 1] the first frame and theirs."""

    name: str
    frames: UInt8[Tensor, "3 n h w"]
    groups: np.ndarray
    picked: Float[Tensor, "3 t h w"]


def drawn_clips(views: Views, config: TokenizerConfig, step: int, temporal: int = 4) -> Iterator[DrawnClip]:
    """Clips of one step, a function of the step."""
    generator = np.random.default_rng((config.seed, 1, step))
    for _ in range(config.batch_size):
        name, video = views[int(generator.integers(len(views)))]
        count = video.shape[1]
        groups = min((count - 1) // temporal, (config.clip_frames - 1) // temporal)
        start = int(generator.integers(count - groups * temporal))
        picked = np.sort(generator.integers(groups, size=3))
        frames = video[:, start : start + 1 + groups * temporal]
        index = [0, *(1 + group * temporal + k for group in picked for k in range(temporal))]
        yield DrawnClip(name, frames, picked, to_video(frames[:, index]))


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

    ``given``: what the disturbed codes alone decode to, or the windows of these codes that a small decoder sees.
    ``observed``: the first frames, or None to do without.
    """

    names: tuple[str, ...]
    video: Float[Tensor, "b 3 t h w"]
    given: Tensor
    observed: Float[Tensor, "b 3 h w"] | None


@torch.no_grad()
def decoder_batch(
    tokenizer: VideoTokenizer, views: Views, config: TokenizerConfig, step: int, *, small: bool = False
) -> DecoderBatch:
    """Clips of one step, coded and disturbed, for a patch tokenizer's own decoder or a small one; a function of the step."""
    clips = list(drawn_clips(views, config, step, tokenizer.temporal_compression))
    video = torch.stack([clip.picked for clip in clips]).to(config.device)
    generator = step_generator(config.seed, step, config.device)
    if small or not isinstance(tokenizer, PatchTokenizer):
        pieces = []
        for clip in clips:  # each whole: an encoder may look further back than a group
            codes = tokenizer.encode(to_video(clip.frames[None].to(config.device)))
            pieces.append(windows(disturb(codes, config.disturbance, generator))[0, [0, *(1 + clip.groups)]])
        given = torch.stack(pieces)
    else:
        given = tokenizer.decode_linear(disturb(tokenizer.encode(video), config.disturbance, generator))
    dropped = bool(torch.rand((), generator=generator, device=config.device) < config.reference_dropout)
    return DecoderBatch(tuple(clip.name for clip in clips), video, given, None if dropped else video[:, :, 0])


def decode_windows(
    decoder: SmallDecoder, given: Float[Tensor, "b n window h_l w_l"], observed: Float[Tensor, "b 3 h w"] | None
) -> Float[Tensor, "b 3 t h w"]:
    """Frames of windows, the first of which is that of a clip's first frame."""
    count = given.shape[1]
    reference = None if observed is None else repeat(observed, "b c h w -> (b n) c h w", n=count)
    groups = decoder(rearrange(given, "b n window h w -> (b n) window h w"), reference)
    groups = rearrange(groups, "(b n) g c h w -> b n g c h w", n=count)
    frames = torch.cat((groups[:, 0, :1], rearrange(groups[:, 1:], "b n g c h w -> b (n g) c h w")), dim=1)
    return rearrange(frames, "b t c h w -> b c t h w")


def edge_strength(video: Float[Tensor, "b 3 t h w"]) -> Float[Tensor, "n 1 y x"]:
    """Mean size of the Laplacian of each colour within 4 x 4 pixels, for each frame but the first.

    The picture is averaged over 2 x 2 pixels before, which takes out what alternates from pixel to pixel: a decoder gains
    nothing by drawing dots where it does not know the edge. A grey picture does not show the edges of small coloured things.
    """
    colours = rearrange(video[:, :, 1:], "b c t h w -> (b t c) 1 h w")
    laplacian = video.new_tensor([[0.0, 1.0, 0.0], [1.0, -4.0, 1.0], [0.0, 1.0, 0.0]])
    return F.avg_pool2d(F.conv2d(F.avg_pool2d(colours, 2, stride=1), laplacian[None, None]).abs(), 4, stride=2)


class DecoderObjective(Objective[DecoderBatch]):
    """L1 and L2 on pixels, L1 on their differences between neighbours, heavier where the scene has changed; and L1 on the
    strength of edges, wherever they are: an edge whose place is uncertain is not drawn weaker.

    Args:
        decode: of what a batch gives and the observed frames, or None, the frames.
        edge_weight: of the last term.
    """

    def __init__(self, decode: Callable[[Tensor, Tensor | None], Tensor], edge_weight: float) -> None:
        self.decode, self.edge_weight = decode, edge_weight

    def loss(self, batch: DecoderBatch, generator: torch.Generator, step: int) -> tuple[Tensor, dict[str, float]]:
        """Loss of one batch."""
        del generator, step
        video = batch.video
        decoded = self.decode(batch.given, batch.observed).float()
        weight = 1.0 + 3.0 * ((video - video[:, :, :1]).abs().amax(dim=1, keepdim=True) > 0.1).float()
        error = (decoded - video) * weight
        edges_h = (error[..., 1:, :] - error[..., :-1, :]).abs().mean()
        edges_w = (error[..., 1:] - error[..., :-1]).abs().mean()
        loss = error.abs().mean() + error.square().mean() + 0.5 * (edges_h + edges_w)
        return loss + self.edge_weight * (edge_strength(decoded) - edge_strength(video)).abs().mean(), {}


def train_decoder(
    decoder: Refinement | SmallDecoder, tokenizer: VideoTokenizer, views: Views, config: TokenizerConfig, output: Path
) -> None:
    """Train a decoder of a tokenizer's latents in place (its average is kept): a patch tokenizer's own, or a small one, which
    leaves the tokenizer as it is. Continues from ``output/run`` if training was cut short.

    Raises:
        TrainingError: the loss or the gradient is not finite.
    """
    begun: dict[str, Any] = {"episodes": [name for name, _ in views]}
    if small := isinstance(decoder, SmallDecoder):
        decode, begun["decoder"] = partial(decode_windows, decoder), decoder.config.model_dump(mode="json")
    else:
        own = cast("PatchTokenizer", tokenizer)
        decode, begun["encoder"], begun["start"] = own.refine, own.encoder_digest, own.weights_sha256
    decoder.train().requires_grad_(True)
    if config.steps:
        result = train(
            config.trainer,
            groups=[ParameterGroup("decoder", dict(decoder.named_parameters()))],
            objective=DecoderObjective(decode, config.edge_weight),
            load=partial(decoder_batch, tokenizer, views, config, small=small),
            output=output,
            identity={"config": config.model_dump(mode="json"), **begun},
            title="tokenizer",
            schedule=config.schedule,
        )
        decoder.load_state_dict(result.average)
    decoder.eval().requires_grad_(False)


def fitted_clips(config: TokenizerConfig, views: Views) -> Iterator[Float[Tensor, "1 3 t h w"]]:
    """Clips that linear parts are fitted to."""
    generator = np.random.default_rng(config.seed)
    for _ in range(config.fit_clips):
        _, frames = views[int(generator.integers(len(views)))]
        length = min(config.clip_frames, 1 + (frames.shape[1] - 1) // 4 * 4)
        start = int(generator.integers(frames.shape[1] - length + 1))
        yield to_video(frames[None, :, start : start + length])


def _fitted(config: TokenizerConfig, views: Views, folder: Path) -> PatchTokenizer:
    """Bases fitted now, or by the call that was interrupted (eigenvectors are not the same bits on another machine)."""
    if not (folder / DESCRIPTION).is_file():
        fit_patch_tokenizer(
            fitted_clips(config, views),
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
def reconstruction_metrics(
    tokenizer: VideoTokenizer, videos: list[Tensor], frames: int, device: str = "cpu"
) -> dict[str, float]:
    """PSNR of the decoders and of copying the first frame, over all pixels and over pixels that changed."""
    sums: dict[str, float] = {}
    for video in videos:
        clip = clip_of(video, frames, tokenizer.temporal_compression).to(device)
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
    ``inputs["encoder"]``, any tokenizer, only a small decoder of its latents is trained and written
    (``decoder.safetensors``, ``decoder.json``), and what the tokenizer's own decoder reaches is measured beside it.
    With ``inputs["start"]``, a patch tokenizer, its decoder is trained further; its codes, and models of them, stay valid.

    Writes ``tokenizer.safetensors``, ``tokenizer.json``, ``metrics.jsonl`` (the losses) and ``metrics.json`` into
    ``output``; an interrupted call continues where it stopped and ends with the same bytes.

    Returns:
        reconstruction metrics on held-out scenes; {"found", "kept", "left_out"} count the episodes.

    Raises:
        ConfigError: both ``encoder`` and ``start`` are given.
    """
    if {"encoder", "start"} <= inputs.keys():
        raise ConfigError(
            "Two decoders to train are given",
            expected="encoder (a small decoder) or start (the tokenizer's own)",
            got="both",
        )
    encoder = load_tokenizer(Path(inputs["encoder"]), config.device) if "encoder" in inputs else None
    episodes = EpisodeSet.open(inputs["episodes"])
    rows = episodes.rows
    chosen = select_episodes(episodes, config.splits, config.max_episodes, config.seed)
    views = load_views(episodes, chosen, config.image_size, _SHORTEST)
    metadata = {
        "config": config.model_dump(mode="json"),
        "training_episodes": len(chosen),
        "training_views": len(views),
    }
    measured: dict[str, VideoTokenizer]
    if encoder is not None:
        name = tokenizer_fingerprint(encoder, Path(inputs["encoder"]))
        size = {"width": config.refinement_width, "depth": config.refinement_depth}
        torch.manual_seed(config.seed)
        decoder = SmallDecoder(SmallDecoderConfig.of(encoder, name, **size), encoder).to(config.device)
        decoder.fit(fitted_clips(config, views))
        train_decoder(decoder, encoder, views, config, output)
        decoder.save(output, metadata)
        measured = {"held_out": SmallDecoder.load(output, encoder, name, config.device), "own_decoder": encoder}
    else:
        if "start" in inputs:
            tokenizer = PatchTokenizer.load(Path(inputs["start"]))
        else:
            tokenizer = _fitted(config, views, output / BASES)
            torch.manual_seed(config.seed)
            tokenizer.refinement = Refinement(
                tokenizer.temporal_compression, config.refinement_width, config.refinement_depth
            )
        train_decoder(tokenizer.to(config.device).refinement, tokenizer, views, config, output)
        tokenizer.save(output, metadata)
        measured = {"held_out": PatchTokenizer.load(output).to(config.device)}
    if "held_out" in inputs:
        episodes = EpisodeSet.open(inputs["held_out"])
    held_out = select_episodes(episodes, config.held_out_splits, config.held_out_episodes, config.seed)
    metrics: dict[str, Any] = dict(metadata)
    if held_out:
        videos = [video for _, video in load_views(episodes, held_out, config.image_size, _SHORTEST)]
        metrics["held_out_episodes"] = len(held_out)
        for name, codec in measured.items():
            metrics[name] = reconstruction_metrics(codec, videos, config.clip_frames, config.device)
    write_json_atomic(output / "metrics.json", metrics)
    fitting = sum(row.split in config.splits for row in rows)
    used = len({name.rpartition("/")[0] for name, _ in views})
    left_out = {
        "in other splits": len(rows) - fitting,
        "beyond max_episodes": fitting - len(chosen),
        f"shorter than {_SHORTEST} frames": len(chosen) - used,
    }
    return {**metrics, "found": len(rows), "kept": used, "left_out": left_out}
