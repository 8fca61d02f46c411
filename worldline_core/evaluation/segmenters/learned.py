"""The learned segmenter: a small U-Net on single frames, one robot logit per pixel.

It sees neither points nor other frames, so it cannot know where the robot ought to be: what it marks in a predicted
video is what that video shows.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, cast

import numpy as np
import torch
from jaxtyping import Float
from pydantic import BaseModel, Field, ValidationError
from safetensors.torch import save
from torch import Tensor, nn
from torch.nn import functional

from worldline_core.errors import ArtifactError
from worldline_core.evaluation.metrics import frames_to_unit
from worldline_core.model.checkpoint import check_fit, fill
from worldline_core.model.weight_files import read_weights
from worldline_core.store.artifact_files import read_json
from worldline_core.store.atomic import write_bytes_atomic, write_json_atomic

WEIGHTS_FILE = "model.safetensors"
DESCRIPTION_FILE = "segmenter.json"
_BATCH = 64
_GROUPS = 8


class UNet(nn.Module):
    """Encoder and decoder with skip connections at full, half, quarter and eighth resolution.

    Args:
        widths: channels at each resolution, finest first; multiples of 8.
    """

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


def _double_convolution(cin: int, cout: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(cin, cout, 3, padding=1, bias=False),
        nn.GroupNorm(_GROUPS, cout),
        nn.SiLU(),
        nn.Conv2d(cout, cout, 3, padding=1, bias=False),
        nn.GroupNorm(_GROUPS, cout),
        nn.SiLU(),
    )


class _Described(BaseModel):
    """What of a description the network needs; trainings add what they did."""

    widths: tuple[Annotated[int, Field(ge=_GROUPS, le=1 << 16, multiple_of=_GROUPS)], ...] = Field(
        min_length=1, max_length=16
    )
    threshold: float = Field(gt=0, lt=1)


class LearnedSegmenter:
    """A trained U-Net; a pixel whose probability exceeds ``threshold`` is robot."""

    name = "learned"
    follows = False

    def __init__(self, network: UNet, threshold: float = 0.5) -> None:
        self.network = network.eval().requires_grad_(False)
        self.threshold = threshold

    @property
    def description(self) -> str:
        count = sum(parameter.numel() for parameter in self.network.parameters())
        return f"U-Net on single frames, {count / 1e6:.2f} M parameters, trained on exact masks of training recordings"

    @torch.no_grad()
    def segment(self, video: np.ndarray, points: np.ndarray | None = None) -> np.ndarray:
        """Bool masks (n, h, w) of uint8 frames (n, h, w, 3); ``points`` are not used."""
        device = next(self.network.parameters()).device
        masks = []
        for start in range(0, len(video), _BATCH):
            frames = torch.from_numpy(np.ascontiguousarray(video[start : start + _BATCH])).to(device)
            frames = frames_to_unit(frames)
            with torch.autocast(device.type, dtype=torch.bfloat16):
                logits = self.network(frames)
            masks.append((torch.sigmoid(logits.float()) > self.threshold).cpu().numpy())
        return np.concatenate(masks) if masks else np.zeros(video.shape[:3], dtype=bool)

    def stream(self) -> Callable[[np.ndarray, np.ndarray | None], np.ndarray]:
        """Every frame is masked by itself."""
        return self.segment

    @classmethod
    def load(cls, folder: Path) -> LearnedSegmenter:
        """Open a trained segmenter.

        Raises: ArtifactError for a missing or damaged folder, or weights of another network.
        """
        description_path, weights_path = folder / DESCRIPTION_FILE, folder / WEIGHTS_FILE
        missing = [path.name for path in (description_path, weights_path) if not path.is_file()]
        if missing:
            raise ArtifactError(
                "Not a trained segmenter",
                where=folder,
                expected=f"{DESCRIPTION_FILE} and {WEIGHTS_FILE}",
                got=f"missing {missing}",
                next_step="run train_segmenter, or use artifacts/shipped/models/segmenter",
            )
        try:
            described = _Described.model_validate(read_json(description_path))
            tensors = read_weights(weights_path, None)
            with torch.device("meta"):  # a description may ask for any size: only weights that are there take memory
                network = UNet(described.widths)
            check_fit({name: tuple(t.shape) for name, t in network.state_dict().items()}, tensors, weights_path)
            fill(network.to_empty(device="cpu"), tensors, where=weights_path, dtype=torch.float32)
        except (ArtifactError, ValidationError) as error:
            raise ArtifactError(
                "The segmenter cannot be read", where=folder, got=str(error), next_step="train it again"
            ) from error
        return cls(network, described.threshold)


def save_segmenter(
    folder: Path, widths: tuple[int, ...], state: dict[str, Tensor], description: dict[str, Any]
) -> None:
    """Write a segmenter in half precision; ``description`` needs a threshold."""
    halves = {name: value.detach().cpu().to(torch.float16).contiguous() for name, value in state.items()}
    write_bytes_atomic(folder / WEIGHTS_FILE, save(halves))
    write_json_atomic(folder / DESCRIPTION_FILE, {"kind": "learned", "widths": list(widths), **description})
