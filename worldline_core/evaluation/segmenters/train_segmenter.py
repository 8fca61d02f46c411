"""The step train_segmenter: the learned segmenter from exact masks of training recordings, head view.

Batches depend on the seed and the step number only, so a training that was interrupted continues as if it had not been.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from pydantic import Field

from worldline_core.config import StrictModel
from worldline_core.errors import DataError

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from worldline_core.data.episodes.episode_set import EpisodeSet
    from worldline_core.evaluation.segmenters.learned import UNet

HEAD = "head"
STATE_FILE = "state.safetensors"


class SegmenterConfig(StrictModel):
    """Size and training of the learned segmenter."""

    widths: tuple[int, ...] = Field(
        default=(8, 24, 48, 96), min_length=2, description="channels, finest resolution first; multiples of 8"
    )
    steps: int = Field(default=1000, ge=1)
    batch_size: int = Field(default=24, ge=1)
    learning_rate: float = Field(default=3e-3, gt=0)
    weight_decay: float = Field(default=1e-4, ge=0)
    average_decay: float = Field(default=0.995, ge=0, lt=1, description="of the moving average that is kept")
    image_size: tuple[int, int] | None = Field(
        default=None, description="(height, width) to resize to; none: as stored"
    )
    frame_stride: int = Field(default=2, ge=1, description="every n-th frame of a training episode is used")
    checkpoint_every: int = Field(default=200, ge=1)
    evaluate_splits: tuple[str, ...] = ("validation", "test", "ood_test")
    evaluate_frame_stride: int = Field(default=4, ge=1)
    threshold: float = Field(default=0.5, gt=0, lt=1)
    seed: int = Field(default=42, ge=0)


def train_segmenter(config: SegmenterConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """Train, then measure on other splits.

    Inputs: episodes; evaluation (another EpisodeSet to measure on, otherwise the same one).
    Output: model.safetensors, segmenter.json, losses.parquet.

    Raises: DataError when no training episode has exact masks.
    """
    import torch
    from tqdm import tqdm

    from worldline_core.data.episodes.episode_set import EpisodeSet
    from worldline_core.evaluation.segmenters.augmentation import augment
    from worldline_core.evaluation.segmenters.learned import UNet, save_segmenter

    episodes = EpisodeSet.open(inputs["episodes"])
    videos = _load_training(episodes, config)
    torch.manual_seed(config.seed)
    network = UNet(config.widths)
    cast(Any, network).to(memory_format=torch.channels_last)  # torch's annotations lack this overload
    optimizer = torch.optim.AdamW(network.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay)
    average = {name: value.detach().clone() for name, value in network.state_dict().items()}
    state_path = output / "run" / STATE_FILE
    start, losses = _resume(state_path, network, optimizer, average)

    for step in tqdm(
        range(start, config.steps), desc="train_segmenter", initial=start, total=config.steps, disable=None
    ):
        for group in optimizer.param_groups:
            group["lr"] = config.learning_rate * _schedule(step, config.steps)
        frames, masks = augment(*_batch(videos, config.batch_size, config.seed, step), _generator(config.seed, step))
        with torch.autocast("cpu", dtype=torch.bfloat16):
            logits = network(frames.contiguous(memory_format=torch.channels_last))
        loss = _loss(logits.float(), masks)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        losses.append(float(loss.detach()))
        decay = min(config.average_decay, (1 + step) / (10 + step))
        for name, value in network.state_dict().items():
            average[name].lerp_(value, 1 - decay)
        if (step + 1) % config.checkpoint_every == 0:
            _save_state(state_path, step + 1, losses, network, optimizer, average)

    _write_losses(output, losses)
    metrics = _measure(EpisodeSet.open(inputs.get("evaluation", inputs["episodes"])), config, average)
    description = {
        "threshold": config.threshold,
        "training": config.model_dump(mode="json"),
        "training_videos": len(videos),
        "parameters": sum(parameter.numel() for parameter in network.parameters()),
        "metrics": metrics,
    }
    save_segmenter(output, config.widths, average, description)
    return {"videos": len(videos), "steps": config.steps, "final_loss": float(np.mean(losses[-50:])), "iou": metrics}


def _load_training(episodes: EpisodeSet, config: SegmenterConfig) -> list[tuple[np.ndarray, np.ndarray]]:
    """Frames (n, h, w, 3) and masks (n, h, w) of each training episode that has exact masks."""
    videos = []
    for index in episodes.select(split="train"):
        video = _load(episodes, index, config.frame_stride, config.image_size)
        if video is not None:
            videos.append(video)
    if not videos:
        raise DataError(
            "No training episode has exact robot masks",
            where=episodes.root,
            expected="robot_masks.parquet in a dataset with training episodes",
            next_step="use the shipped recordings, record with masks, or use the colour segmenter",
        )
    return videos


def _load(
    episodes: EpisodeSet, index: int, stride: int, size: tuple[int, int] | None
) -> tuple[np.ndarray, np.ndarray] | None:
    """Every ``stride``-th head frame of a row and its exact masks, or None where it has no masks."""
    from worldline_core.data.video.decode import resize_frames, resize_masks

    masks = episodes.robot_masks(index, HEAD)
    if masks is None:
        return None
    return resize_frames(episodes.frames(index, HEAD)[::stride], size), resize_masks(masks[::stride], size)


def _batch(
    videos: list[tuple[np.ndarray, np.ndarray]], size: int, seed: int, step: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Frames, other frames of the same videos, masks."""
    import torch

    from worldline_core.evaluation.metrics import frames_to_unit

    generator = np.random.default_rng([seed, step])
    chosen = [videos[index] for index in generator.integers(0, len(videos), size)]
    at = [(generator.integers(0, len(frames)), generator.integers(0, len(frames))) for frames, _ in chosen]
    frames = np.stack([video[0][i] for video, (i, _) in zip(chosen, at, strict=True)])
    ghosts = np.stack([video[0][j] for video, (_, j) in zip(chosen, at, strict=True)])
    masks = np.stack([video[1][i] for video, (i, _) in zip(chosen, at, strict=True)])
    return (
        frames_to_unit(torch.from_numpy(frames)),
        frames_to_unit(torch.from_numpy(ghosts)),
        torch.from_numpy(masks).float(),
    )


def _generator(seed: int, step: int) -> torch.Generator:
    import torch

    return torch.Generator().manual_seed(seed * 1_000_003 + step)


def _schedule(step: int, steps: int) -> float:
    """Linear warm-up over 5 % of the steps, then a half cosine to 1 %."""
    warmup = max(1, steps // 20)
    if step < warmup:
        return (step + 1) / warmup
    progress = (step - warmup) / max(1, steps - warmup)
    return 0.01 + 0.99 * 0.5 * (1 + float(np.cos(np.pi * progress)))


def _loss(logits: Tensor, masks: Tensor) -> Tensor:
    """Cross entropy plus soft Dice over the batch: the robot covers a small part of a frame."""
    from torch.nn import functional

    probability = logits.sigmoid()
    overlap = 2 * (probability * masks).sum() + 1
    dice = 1 - overlap / (probability.sum() + masks.sum() + 1)
    return functional.binary_cross_entropy_with_logits(logits, masks) + dice


def _save_state(
    path: Path,
    step: int,
    losses: list[float],
    network: UNet,
    optimizer: torch.optim.Optimizer,
    average: dict[str, Tensor],
) -> None:
    from safetensors.torch import save

    from worldline_core.store.atomic import write_bytes_atomic

    tensors = {f"network.{name}": value.contiguous() for name, value in network.state_dict().items()}
    tensors |= {f"average.{name}": value.contiguous() for name, value in average.items()}
    for index, moments in optimizer.state_dict()["state"].items():
        tensors |= {f"optimizer.{index}.{name}": value.contiguous() for name, value in moments.items()}
    write_bytes_atomic(path, save(tensors, metadata={"step": str(step), "losses": json.dumps(losses)}))


def _resume(
    path: Path, network: UNet, optimizer: torch.optim.Optimizer, average: dict[str, Tensor]
) -> tuple[int, list[float]]:
    """Load what an interrupted training left; (0, []) where there is nothing."""
    from safetensors import safe_open

    if not path.is_file():
        return 0, []
    with safe_open(path, framework="pt") as stream:
        metadata = stream.metadata()
        tensors = {name: stream.get_tensor(name) for name in stream.keys()}  # noqa: SIM118 (not a mapping)
    network.load_state_dict({name: tensors[f"network.{name}"] for name in network.state_dict()})
    for name in average:
        average[name] = tensors[f"average.{name}"]
    moments: dict[int, dict[str, Tensor]] = {}
    for name, value in tensors.items():
        if name.startswith("optimizer."):
            _, index, moment = name.split(".")
            moments.setdefault(int(index), {})[moment] = value
    optimizer.load_state_dict({"state": moments, "param_groups": optimizer.state_dict()["param_groups"]})
    return int(metadata["step"]), json.loads(metadata["losses"])


def _write_losses(output: Path, losses: list[float]) -> None:
    import pyarrow as pa

    from worldline_core.evaluation.scores import write_table

    rows = [{"step": step, "loss": loss} for step, loss in enumerate(losses)]
    write_table(output / "losses.parquet", rows, pa.schema([("step", pa.int32()), ("loss", pa.float64())]))


def _measure(episodes: EpisodeSet, config: SegmenterConfig, state: dict[str, Tensor]) -> dict[str, Any]:
    """Mean video IoU by split and embodiment, on sharp true frames and on degraded ones."""
    import torch

    from worldline_core.evaluation.metrics import frames_to_unit, video_iou
    from worldline_core.evaluation.segmenters.augmentation import degrade
    from worldline_core.evaluation.segmenters.learned import LearnedSegmenter, UNet

    network = UNet(config.widths)
    network.load_state_dict({name: value.to(torch.float16).float() for name, value in state.items()})
    segmenter = LearnedSegmenter(network, config.threshold)
    groups: dict[str, list[tuple[float, float]]] = {}
    for index in episodes.select(split=config.evaluate_splits):
        video = _load(episodes, index, config.evaluate_frame_stride, config.image_size)
        if video is None:
            continue
        frames, masks = video
        blurred = degrade(frames_to_unit(torch.from_numpy(frames)), _generator(config.seed, index))
        degraded = (blurred.clamp(0, 1) * 255).round().to(torch.uint8).permute(0, 2, 3, 1).numpy()
        sharp_iou = video_iou(masks, segmenter.segment(frames))
        degraded_iou = video_iou(masks, segmenter.segment(degraded))
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
