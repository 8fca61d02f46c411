"""The train_segmenter step: the learned segmenter from exact masks of training recordings, head view.

Training frames are augmented to look like unseen scenes and like predicted frames. A predicted frame has passed a lossy
tokenizer and an imperfect model: it is blurred, blocky, and shows faint copies of a moving arm. Masks follow the
geometry only.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.video.frames import VideoFrames
from worldline_core.errors import DataError
from worldline_core.evaluation.evaluation_config import SegmenterConfig
from worldline_core.evaluation.metrics import frames_to_unit, video_iou
from worldline_core.evaluation.recordings import HEAD
from worldline_core.evaluation.segmenters.learned import LearnedSegmenter, UNet, save_segmenter
from worldline_core.geometry.cameras import ImageTransform
from worldline_core.store.artifact_files import read_json_lines
from worldline_core.training.trainer import Objective, ParameterGroup, step_generator, train

_BLOCK = 8


@dataclass(frozen=True)
class MaskedVideo:
    """Head frames, uint8 (n, h, w, 3), and their exact robot masks, bool (n, h, w)."""

    name: str
    frames: np.ndarray
    masks: np.ndarray


@dataclass(frozen=True)
class MaskBatch:
    """Single frames in [0, 1] and their masks, 1 where the robot is."""

    names: tuple[str, ...]
    frames: Float[Tensor, "b 3 h w"]
    masks: Float[Tensor, "b h w"]


class MaskObjective(Objective[MaskBatch]):
    """Cross entropy plus soft Dice over the batch: the robot covers a small part of a frame."""

    def __init__(self, network: UNet) -> None:
        self.network = network

    def loss(self, batch: MaskBatch, generator: torch.Generator, step: int) -> tuple[Tensor, dict[str, float]]:
        """Loss of one batch."""
        del generator, step
        logits = self.network(batch.frames.contiguous(memory_format=torch.channels_last)).float()
        probability = logits.sigmoid()
        overlap = 2 * (probability * batch.masks).sum() + 1
        dice = 1 - overlap / (probability.sum() + batch.masks.sum() + 1)
        return functional.binary_cross_entropy_with_logits(logits, batch.masks) + dice, {}


def mask_batch(videos: Sequence[MaskedVideo], config: SegmenterConfig, index: int) -> MaskBatch:
    """Augmented frames of one step: a pure function of the seed and the step."""
    random = np.random.default_rng([config.seed, index])
    chosen = [videos[number] for number in random.integers(0, len(videos), config.batch_size)]
    places = [(random.integers(0, len(video.frames)), random.integers(0, len(video.frames))) for video in chosen]
    frames = np.stack([video.frames[place] for video, (place, _) in zip(chosen, places, strict=True)])
    ghosts = np.stack([video.frames[other] for video, (_, other) in zip(chosen, places, strict=True)])
    masks = np.stack([video.masks[place] for video, (place, _) in zip(chosen, places, strict=True)])
    augmented = augment(
        frames_to_unit(torch.from_numpy(frames)),
        frames_to_unit(torch.from_numpy(ghosts)),
        torch.from_numpy(masks).float(),
        step_generator(config.seed, index, "cpu"),
    )
    return MaskBatch(tuple(video.name for video in chosen), *augmented)


def train_segmenter(config: SegmenterConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """Train, then measure on other splits.

    Inputs: episodes; evaluation (another EpisodeSet to measure on, otherwise the same one).
    Output: model.safetensors, segmenter.json, metrics.jsonl (the loss of every step).
    Returns counts of episodes, and IoU by split and embodiment.

    Raises: DataError when no training episode has exact masks.
    """
    episodes = EpisodeSet.open(inputs["episodes"])
    rows = episodes.select(split="train")
    videos = [video for row in rows if (video := _load(episodes, row, config.frame_stride, config.image_size))]
    if not videos:
        raise DataError(
            "No training episode has exact robot masks",
            where=episodes.root,
            expected="robot_masks.parquet in a dataset with training episodes",
            next_step="use the shipped recordings, record with masks, or use the colour segmenter",
        )
    torch.manual_seed(config.seed)
    network = UNet(config.widths)
    cast(Any, network).to(memory_format=torch.channels_last)  # torch's annotations lack this overload
    result = train(
        config.trainer,
        groups=[ParameterGroup("segmenter", dict(network.named_parameters()))],
        objective=MaskObjective(network),
        load=lambda index: mask_batch(videos, config, index),
        output=output,
        identity={"config": config.model_dump(mode="json"), "episodes": [video.name for video in videos]},
        title="segmenter",
        schedule=config.schedule,
    )
    metrics = _measure(EpisodeSet.open(inputs.get("evaluation", inputs["episodes"])), config, result.average)
    description = {
        "threshold": config.threshold,
        "training": config.model_dump(mode="json"),
        "training_videos": len(videos),
        "parameters": sum(parameter.numel() for parameter in network.parameters()),
        "metrics": metrics,
    }
    save_segmenter(output, config.widths, result.average, description)
    losses = [row["loss"] for row in read_json_lines(output / "metrics.jsonl")]
    return {
        "found": len(episodes),
        "kept": len(videos),
        "left_out": {"in other splits": len(episodes) - len(rows), "without exact masks": len(rows) - len(videos)},
        "videos": len(videos),
        "steps": config.steps,
        "final_loss": float(np.mean(losses[-50:])),
        "iou": metrics,
    }


def _load(episodes: EpisodeSet, index: int, stride: int, size: tuple[int, int] | None) -> MaskedVideo | None:
    """Every ``stride``-th head frame of a row and its exact masks, or None where it has no masks."""
    masks = episodes.robot_masks(index, HEAD)
    if masks is None:
        return None
    recorded = VideoFrames(episodes.clip(index, HEAD), stride)
    resized = ImageTransform.of((recorded.shape[1], recorded.shape[2])).fitted(size)
    frames = np.stack([resized.frames(frame[None])[0] for frame in recorded])
    fitted = np.stack([resized.masks(mask[None])[0] for mask in masks[::stride]])
    return MaskedVideo(episodes.rows[index].episode_id, frames, fitted)


def _measure(episodes: EpisodeSet, config: SegmenterConfig, state: Mapping[str, Tensor]) -> dict[str, Any]:
    """Mean video IoU by split and embodiment, on sharp true frames and on degraded ones."""
    network = UNet(config.widths)
    network.load_state_dict({name: value.to(torch.float16).float() for name, value in state.items()})
    segmenter = LearnedSegmenter(network, config.threshold)
    groups: dict[str, list[tuple[float, float]]] = {}
    for index in episodes.select(split=config.evaluate_splits):
        video = _load(episodes, index, config.evaluate_frame_stride, config.image_size)
        if video is None:
            continue
        generator = step_generator(config.seed, index, "cpu")
        blurred = degrade(frames_to_unit(torch.from_numpy(video.frames)), generator).clamp(0, 1)
        degraded = rearrange((blurred * 255).round().to(torch.uint8), "n c h w -> n h w c").numpy()
        sharp_iou = video_iou(video.masks, segmenter.segment(video.frames))
        degraded_iou = video_iou(video.masks, segmenter.segment(degraded))
        if sharp_iou is None or degraded_iou is None:
            continue
        row = episodes.rows[index]
        for group in (row.split, f"{row.split}/{row.embodiment}"):
            groups.setdefault(group, []).append((sharp_iou, degraded_iou))
    return {
        group: {
            "iou": round(float(np.mean([sharp for sharp, _ in values])), 4),
            "iou_degraded": round(float(np.mean([degraded for _, degraded in values])), 4),
            "videos": len(values),
        }
        for group, values in sorted(groups.items())
    }


def augment(
    frames: Float[Tensor, "n 3 h w"],
    ghosts: Float[Tensor, "n 3 h w"],
    masks: Float[Tensor, "n h w"],
    generator: torch.Generator,
) -> tuple[Float[Tensor, "n 3 h w"], Float[Tensor, "n h w"]]:
    """Random geometry, colours and degradation; ``ghosts`` are other frames of the same videos. Intensities [0, 1]."""
    frames = _mix_ghosts(frames, ghosts, generator)
    frames, masks = _geometry(frames, masks, generator)
    frames = _colours(frames, generator)
    frames = degrade(frames, generator)
    noise = torch.randn(frames.shape, generator=generator) * _uniform(frames, 0.0, 0.03, generator)
    return (frames + noise).clamp(0, 1), masks


def degrade(frames: Float[Tensor, "n 3 h w"], generator: torch.Generator) -> Float[Tensor, "n 3 h w"]:
    """Each frame by chance sharp, blurred, or rebuilt from few 8x8 cosine coefficients (as a patch tokenizer would)."""
    choice = torch.rand(len(frames), generator=generator)
    result = frames.clone()
    blurred, rebuilt = choice < 0.35, choice > 0.65
    if blurred.any():
        result[blurred] = _blur(frames[blurred], generator)
    if rebuilt.any():
        result[rebuilt] = _truncate_blocks(frames[rebuilt], generator)
    return result


def _uniform(frames: Tensor, low: float, high: float, generator: torch.Generator) -> Tensor:
    return low + (high - low) * torch.rand(len(frames), 1, 1, 1, generator=generator)


def _mix_ghosts(frames: Tensor, ghosts: Tensor, generator: torch.Generator) -> Tensor:
    """A quarter of the frames shows a faint second exposure."""
    strength = _uniform(frames, 0.0, 0.35, generator) * (torch.rand(len(frames), 1, 1, 1, generator=generator) < 0.25)
    return frames * (1 - strength) + ghosts * strength


def _geometry(frames: Tensor, masks: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Mirror, scale 0.85..1.2, shift 8 %, turn 6 degrees."""
    count, _, height, width = frames.shape
    draw = torch.rand(5, count, generator=generator)
    scale = 0.85 + 0.35 * draw[0]
    angle = (2 * draw[1] - 1) * math.radians(6)
    mirror = torch.where(draw[2] < 0.5, -1.0, 1.0)
    aspect = width / height
    cosine, sine = torch.cos(angle) / scale, torch.sin(angle) / scale
    # normalised coordinates: a turn in pixels needs the aspect ratio on its off-diagonal terms
    top = torch.stack([mirror * cosine, -sine / aspect, 0.16 * (draw[3] - 0.5)], dim=-1)
    bottom = torch.stack([mirror * sine * aspect, cosine, 0.16 * (draw[4] - 0.5)], dim=-1)
    grid = functional.affine_grid(torch.stack([top, bottom], dim=1), [count, 3, height, width], align_corners=False)
    frames = functional.grid_sample(frames, grid, mode="bilinear", padding_mode="reflection", align_corners=False)
    moved = functional.grid_sample(
        masks[:, None], grid, mode="bilinear", padding_mode="reflection", align_corners=False
    )
    return frames, (moved[:, 0] > 0.5).to(masks.dtype)


def _colours(frames: Tensor, generator: torch.Generator) -> Tensor:
    """Brightness, contrast, gamma, saturation, tint; one frame in eight has its channels permuted."""
    permuted = torch.rand(len(frames), generator=generator) < 0.125
    order = torch.randperm(3, generator=generator)
    frames = torch.where(permuted[:, None, None, None], frames[:, order], frames)
    frames = frames.clamp(min=1e-3) ** _uniform(frames, 0.7, 1.45, generator)
    grey = frames.mean(dim=1, keepdim=True)
    frames = grey + (frames - grey) * _uniform(frames, 0.4, 1.5, generator)
    middle = frames.mean(dim=(1, 2, 3), keepdim=True)
    frames = middle + (frames - middle) * _uniform(frames, 0.7, 1.35, generator)
    tint = 1 + 0.15 * (2 * torch.rand(len(frames), 3, 1, 1, generator=generator) - 1)
    return (frames * tint + _uniform(frames, -0.12, 0.12, generator)).clamp(0, 1)


def _blur(frames: Tensor, generator: torch.Generator) -> Tensor:
    """Gaussian blur, one sigma of 0.4..2 px for all of them."""
    sigma = 0.4 + 1.6 * float(torch.rand((), generator=generator))
    offsets = torch.arange(-4, 5, dtype=frames.dtype)
    kernel = torch.exp(-offsets.square() / (2 * sigma**2))
    kernel = kernel / kernel.sum()
    padded = functional.pad(frames, (4, 4, 4, 4), mode="replicate")
    rows = functional.conv2d(padded, kernel.view(1, 1, 9, 1).expand(3, 1, 9, 1), groups=3)
    return functional.conv2d(rows, kernel.view(1, 1, 1, 9).expand(3, 1, 1, 9), groups=3)


def _truncate_blocks(frames: Tensor, generator: torch.Generator) -> Tensor:
    """Keep the cosine coefficients (i, j) with i + j <= k of every 8x8 block, k = 1..4."""
    height, width = frames.shape[-2:]
    padded = functional.pad(frames, (0, -width % _BLOCK, 0, -height % _BLOCK), mode="replicate")
    index = torch.arange(_BLOCK, dtype=frames.dtype)
    basis = torch.cos(math.pi * (index[None] + 0.5) * index[:, None] / _BLOCK) * math.sqrt(2 / _BLOCK)
    basis[0] /= math.sqrt(2)
    limit = int(torch.randint(1, 5, (), generator=generator))
    kept = ((index[:, None] + index[None]) <= limit).to(frames.dtype)
    blocks = rearrange(padded, "n c (h p) (w q) -> n c h w p q", p=_BLOCK, q=_BLOCK)
    coefficients = torch.einsum("ip,nchwpq,jq->nchwij", basis, blocks, basis) * kept
    blocks = torch.einsum("ip,nchwij,jq->nchwpq", basis, coefficients, basis)
    return rearrange(blocks, "n c h w p q -> n c (h p) (w q)")[..., :height, :width]
