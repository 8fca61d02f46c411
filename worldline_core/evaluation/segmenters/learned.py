"""The learned segmenter, a small U-Net on single frames, and the step train_segmenter, which fits it to masks of head views: exact
ones, or kinematic ones where a recording has none.

It sees neither points nor other frames: what it marks in a predicted video is what that video shows. Training frames are augmented to
look like unseen scenes and like predicted frames; masks follow the geometry only.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, cast

import numpy as np
import torch
from jaxtyping import Float
from pydantic import BaseModel, Field
from safetensors.torch import save
from torch import Tensor, nn
from torch.nn import functional

from worldline_core.actions.episode_tracks import ActionTracks
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.video.frames import VideoFrames
from worldline_core.errors import DataError
from worldline_core.evaluation.augmentation import change_colours, degrade, mix_ghosts, move, uniform
from worldline_core.evaluation.evaluation_config import SegmenterConfig
from worldline_core.evaluation.metrics import frames_to_unit
from worldline_core.evaluation.recordings import HEAD
from worldline_core.evaluation.segmenters.kinematic_masks import kinematic_masks
from worldline_core.evaluation.small_network import WEIGHTS_FILE, load_network
from worldline_core.geometry.cameras import ImageTransform
from worldline_core.processor import bfloat16_by_default
from worldline_core.store.artifact_files import read_json_lines
from worldline_core.store.atomic import write_bytes_atomic, write_json_atomic
from worldline_core.training.trainer import Objective, ParameterGroup, step_generator, train

DESCRIPTION_FILE = "segmenter.json"
_BATCH = 64
_BATCH_ON_CPU = 8  # what a layer writes stays in the processor's cache: half the time of 32
_GROUPS = 8


class UNet(nn.Module):
    """Encoder and decoder with skip connections; ``widths``: channels at full, half, ... resolution, multiples of 8."""

    def __init__(self, widths: tuple[int, ...] = (8, 24, 48, 96)) -> None:
        super().__init__()
        self.widths = widths
        self.encoder = nn.ModuleList(
            _double_convolution(cin, cout) for cin, cout in zip((3, *widths[:-1]), widths, strict=True)
        )
        self.decoder = nn.ModuleList(
            _double_convolution(coarse + fine, fine) for fine, coarse in itertools.pairwise(widths)
        )
        self.head = nn.Conv2d(widths[0], 1, 1)

    @property
    def stride(self) -> int:
        """Frames are padded to a multiple of this."""
        return 2 ** (len(self.widths) - 1)

    def forward(self, frames: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n h w"]:
        """Logits; intensities in [0, 1]. Any size: padded by repetition, cut again."""
        height, width = frames.shape[-2:]
        padding = (0, -width % self.stride, 0, -height % self.stride)
        features = functional.pad(2.0 * frames - 1.0, padding, mode="replicate")
        skips: list[Tensor] = []
        for level, block in enumerate(self.encoder):
            features = block(features if level == 0 else functional.max_pool2d(features, 2))
            skips.append(features)
        for level in reversed(range(len(self.decoder))):
            features = functional.interpolate(features, scale_factor=2, mode="bilinear", align_corners=False)
            features = self.decoder[level](torch.cat([features, skips[level]], dim=1))
        return cast(Tensor, self.head(features))[:, 0, :height, :width]


class _GroupNorm(nn.GroupNorm):
    """Group norm, in bfloat16 in contiguous memory format: a CPU takes 15 times as long in channels-last (as the convolutions run)."""

    def forward(self, input: Tensor) -> Tensor:  # noqa: A002 - the base class's name
        if input.dtype == torch.float32:
            return super().forward(input)
        return super().forward(input.contiguous()).contiguous(memory_format=torch.channels_last)


def _double_convolution(cin: int, cout: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(cin, cout, 3, padding=1, bias=False),
        _GroupNorm(_GROUPS, cout),
        nn.SiLU(),
        nn.Conv2d(cout, cout, 3, padding=1, bias=False),
        _GroupNorm(_GROUPS, cout),
        nn.SiLU(),
    )


class _Described(BaseModel):
    widths: tuple[Annotated[int, Field(ge=_GROUPS, le=1 << 16, multiple_of=_GROUPS)], ...] = Field(
        min_length=1, max_length=16
    )
    threshold: float = Field(gt=0, lt=1)


class LearnedSegmenter:
    """A trained U-Net; a pixel whose probability exceeds ``threshold`` is robot."""

    name = "learned"
    follows = False

    def __init__(self, network: UNet, threshold: float = 0.5) -> None:
        cast(Any, network).to(memory_format=torch.channels_last)
        self.network = network.eval().requires_grad_(False)
        self.threshold = threshold

    @property
    def description(self) -> str:
        count = sum(parameter.numel() for parameter in self.network.parameters())
        return f"U-Net on single frames, {count / 1e6:.2f} M parameters, trained on masks of training recordings"

    @torch.no_grad()
    def segment(self, video: np.ndarray, points: np.ndarray | None = None) -> np.ndarray:
        """Bool masks (n, h, w) of uint8 frames (n, h, w, 3); ``points`` are not used."""
        device = next(self.network.parameters()).device
        batch = _BATCH_ON_CPU if device.type == "cpu" else _BATCH
        masks = []
        for start in range(0, len(video), batch):
            frames = torch.from_numpy(video[start : start + batch].copy()).to(device)
            frames = frames_to_unit(frames).contiguous(memory_format=torch.channels_last)
            with torch.autocast(device.type, torch.bfloat16, enabled=bfloat16_by_default({"device": device.type})):
                logits = self.network(frames)
            masks.append((torch.sigmoid(logits.float()) > self.threshold).cpu().numpy())
        return np.concatenate(masks) if masks else np.zeros(video.shape[:3], dtype=bool)

    def stream(self) -> Callable[[np.ndarray, np.ndarray | None], np.ndarray]:
        return self.segment

    @classmethod
    def load(cls, folder: Path) -> LearnedSegmenter:
        """Open a trained segmenter. Raises: ArtifactError, as `load_network`."""
        network, described = load_network(
            folder, DESCRIPTION_FILE, _Described, lambda found: UNet(found.widths), noun="segmenter",
            next_step="run train_segmenter, or use artifacts/shipped/models/segmenter",
        )  # fmt: skip
        return cls(network, described.threshold)


def save_segmenter(folder: Path, widths: tuple[int, ...], state: Mapping[str, Tensor], facts: dict[str, Any]) -> None:
    """Write a segmenter in half precision."""
    halves = {name: value.detach().cpu().to(torch.float16).contiguous() for name, value in state.items()}
    write_bytes_atomic(folder / WEIGHTS_FILE, save(halves))
    description = {"kind": "learned", "widths": list(widths), "threshold": 0.5, **facts}
    write_json_atomic(folder / DESCRIPTION_FILE, description)


@dataclass(frozen=True)
class MaskedVideo:
    """Head frames, uint8 (n, h, w, 3), and their robot masks, bool (n, h, w)."""

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
    """Train on the head views of the training split; evaluate_video shows the accuracy on others.

    Inputs: episodes, and tracks for kinematic labels. Output: model.safetensors, segmenter.json, metrics.jsonl (the loss
    of every step).

    Raises: DataError when no training episode has masks.
    """
    episodes = EpisodeSet.open(inputs["episodes"])
    tracks = ActionTracks.open(inputs["tracks"]) if config.labels == "kinematic" else None
    rows = episodes.select(split="train")
    videos = [video for row in rows if (video := _load(episodes, tracks, row, config.frame_stride, config.image_size))]
    if not videos:
        raise DataError(
            "No training episode has robot masks, or a head camera to draw the robot with", where=episodes.root,
            next_step="estimate the head camera (worldline calibrate estimate), or set train_segmenter to null",
        )  # fmt: skip
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
    save_segmenter(output, config.widths, result.average, {"training": config.model_dump(mode="json")})
    losses = [row["loss"] for row in read_json_lines(output / "metrics.jsonl")]
    return {
        "found": len(episodes),
        "kept": len(videos),
        "left_out": {"in other splits": len(episodes) - len(rows), "without masks": len(rows) - len(videos)},
        "videos": len(videos),
        "steps": config.steps,
        "final_loss": float(np.mean(losses[-50:])),
    }


def _load(
    episodes: EpisodeSet, tracks: ActionTracks | None, index: int, stride: int, size: tuple[int, int] | None
) -> MaskedVideo | None:
    """Every ``stride``-th head frame of a row and its masks, or None where it has none."""
    row = episodes.rows[index]
    if HEAD not in row.views:
        return None
    exact = episodes.robot_masks(index, HEAD)
    drawn = tracks.tracks(row.episode_id) if exact is None and tracks is not None and row.episode_id in tracks else None
    recorded = VideoFrames(episodes.clip(index, HEAD), stride)
    resized = ImageTransform.of((recorded.shape[1], recorded.shape[2])).fitted(size)
    known = None if exact is None else exact[::stride]
    frames, masks = [], []
    for start, part in zip(itertools.count(0, _BATCH), itertools.batched(recorded, _BATCH), strict=False):
        piece, places = np.stack(part), np.arange(start, start + len(part))
        if known is not None:
            own = np.stack(list(known[start : start + len(part)]))
        else:
            own = None if drawn is None else kinematic_masks(drawn, HEAD, places * stride, piece)
        if own is None:
            return None
        frames.append(resized.frames(piece))
        masks.append(resized.masks(own))
    return MaskedVideo(row.episode_id, np.concatenate(frames), np.concatenate(masks))


def augment(
    frames: Float[Tensor, "n 3 h w"],
    ghosts: Float[Tensor, "n 3 h w"],
    masks: Float[Tensor, "n h w"],
    generator: torch.Generator,
) -> tuple[Float[Tensor, "n 3 h w"], Float[Tensor, "n h w"]]:
    """Random geometry, colours and degradation; ``ghosts`` are other frames of the same videos. Intensities [0, 1]."""
    frames = mix_ghosts(frames, ghosts, generator)
    moved = move(torch.cat([frames, masks[:, None]], dim=1), generator, mirror=True)
    frames, masks = moved[:, :3], (moved[:, 3] > 0.5).to(masks.dtype)
    frames = change_colours(frames, generator)
    frames = degrade(frames, generator)
    noise = torch.randn(frames.shape, generator=generator) * uniform(frames, 0.0, 0.03, generator)
    return (frames + noise).clamp(0, 1), masks
