"""The small frozen video encoder of the embedded default: a masked-video transformer trained on the recordings.

It reads 64 x 96 video in tubelets (the first frame alone, then groups of four frames, as the tokenizer does) and is
trained by masked prediction: a part of the tubelets is hidden, and their normalised pixels are predicted from the
rest. Its features are the normalised outputs of its last four blocks, concatenated, as with the full-size teacher.
"""

from __future__ import annotations

import json
from pathlib import Path

import torch
from einops import rearrange
from jaxtyping import Bool, Float
from pydantic import Field, ValidationError
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn import functional

from worldline_core.config.base import StrictModel
from worldline_core.errors import CheckpointError, DataError

DESCRIPTION, WEIGHTS = "teacher.json", "teacher.safetensors"
FORMAT = "worldline.small_video_teacher"
TUBELET, BLOCKS = 4, 4


class SmallTeacherShape(StrictModel):
    """Size of the encoder. ``patch`` is the side of a tubelet in pixels of ``image_size`` (height, width)."""

    image_size: tuple[int, int] = (64, 96)
    patch: int = Field(default=16, ge=2)
    max_groups: int = Field(default=33, ge=2, description="longest clip in latent frames")
    hidden_size: int = Field(default=128, ge=8)
    num_layers: int = Field(default=6, ge=BLOCKS)
    num_heads: int = Field(default=4, ge=1)


class SmallVideoTeacher(nn.Module):
    """Masked-video encoder with features for relational regularisation."""

    name = "small video teacher"

    def __init__(self, shape: SmallTeacherShape) -> None:
        super().__init__()
        self.shape = shape
        self.grid = (shape.image_size[0] // shape.patch, shape.image_size[1] // shape.patch)
        values = 3 * TUBELET * shape.patch**2
        width = shape.hidden_size
        self.embed = nn.Linear(values, width)
        self.position = nn.Parameter(torch.zeros(self.grid[0] * self.grid[1], width))
        self.time = nn.Parameter(torch.zeros(shape.max_groups, width))
        self.mask_token = nn.Parameter(torch.zeros(width))
        self.blocks = nn.ModuleList(
            nn.TransformerEncoderLayer(
                width,
                shape.num_heads,
                4 * width,
                dropout=0.0,
                activation="gelu",
                batch_first=True,
                norm_first=True,
            )
            for _ in range(shape.num_layers)
        )
        self.norm = nn.LayerNorm(width)
        self.head = nn.Linear(width, values)

    def initialise(self, generator: torch.Generator) -> None:
        """Weights for training: deterministic in the generator."""
        for parameter in self.parameters():
            if parameter.ndim > 1:
                nn.init.normal_(parameter, 0.0, 0.02, generator=generator)

    def tubelets(self, frames: Float[Tensor, "b 3 t h w"]) -> Float[Tensor, "b t2 n p"]:
        """Pixels of every tubelet; the first frame is repeated to fill its own.

        Raises:
            DataError: if the clip does not have 4 k + 1 frames, or more than the encoder has positions for.
        """
        batch, _, length = frames.shape[:3]
        if (length - 1) % TUBELET or 1 + (length - 1) // TUBELET > self.shape.max_groups:
            raise DataError(
                "The teacher cannot read a clip of this length.",
                expected=f"4 k + 1 frames, at most {1 + TUBELET * (self.shape.max_groups - 1)}",
                got=length,
            )
        if tuple(frames.shape[-2:]) != self.shape.image_size:
            flat = rearrange(frames, "b c t h w -> (b t) c h w")
            flat = functional.interpolate(flat, self.shape.image_size, mode="area")
            frames = rearrange(flat, "(b t) c h w -> b c t h w", b=batch)
        frames = torch.cat([frames[:, :, :1].expand(-1, -1, TUBELET - 1, -1, -1), frames], dim=2)
        size = self.shape.patch
        return rearrange(frames, "b c (t k) (h p) (w q) -> b t (h w) (c k p q)", k=TUBELET, p=size, q=size)

    def encode(
        self, tubelets: Float[Tensor, "b t n p"], hidden: Bool[Tensor, "b t n"] | None = None
    ) -> list[Float[Tensor, "b m d"]]:
        """Outputs of the last four blocks."""
        tokens = self.embed(tubelets * 2 - 1)
        if hidden is not None:
            tokens = torch.where(hidden[..., None], self.mask_token.to(tokens.dtype), tokens)
        tokens = tokens + self.position + self.time[: tokens.shape[1], None]
        tokens = rearrange(tokens, "b t n d -> b (t n) d")
        outputs: list[Tensor] = []
        for block in self.blocks:
            tokens = block(tokens)
            outputs.append(tokens)
        return outputs[-BLOCKS:]

    def masked_loss(self, frames: Float[Tensor, "b 3 t h w"], hidden: Bool[Tensor, "b t n"]) -> Float[Tensor, ""]:
        """Squared error of the hidden tubelets' pixels.

        The target is the change against the clip's first frame, scaled by its deviation over the clip: predicting it
        takes knowing what moves, not what the table looks like.
        """
        tubelets = self.tubelets(frames)
        tokens = self.encode(tubelets, hidden)[-1]
        predicted = rearrange(self.head(self.norm(tokens)), "b (t n) p -> b t n p", t=tubelets.shape[1])
        target = tubelets - tubelets[:, :1]
        target = target / (target.flatten(1).std(dim=1) + 0.02)[:, None, None, None]
        error = ((predicted.float() - target) ** 2).mean(dim=-1)
        return error[hidden].mean()

    @torch.no_grad()
    def features(self, frames: Float[Tensor, "b 3 t h w"]) -> Float[Tensor, "b t2 h2 w2 d"]:
        """Concatenated, normalised outputs of the last four blocks; frames in [0, 1]."""
        device = self.embed.weight.device
        outputs = self.encode(self.tubelets(frames.to(device)))
        normalised = torch.cat([functional.layer_norm(output.float(), output.shape[-1:]) for output in outputs], dim=-1)
        return rearrange(normalised, "b (t h w) d -> b t h w d", h=self.grid[0], w=self.grid[1])


def load_small_teacher(folder: Path) -> SmallVideoTeacher:
    """Read a trained small teacher, frozen.

    Raises:
        CheckpointError: if the folder does not hold one.
    """
    path = folder / DESCRIPTION
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        shape = SmallTeacherShape.model_validate(content["shape"])
        tensors = load_file(folder / WEIGHTS)
    except (OSError, json.JSONDecodeError, KeyError, TypeError, ValidationError, SafetensorError) as error:
        raise CheckpointError("The small teacher cannot be read.", where=folder, got=repr(error)) from error
    if content.get("format") != FORMAT:
        raise CheckpointError("Not a small teacher.", where=path, expected=FORMAT, got=content.get("format"))
    teacher = SmallVideoTeacher(shape)
    try:
        teacher.load_state_dict({name: tensor.float() for name, tensor in tensors.items()})
    except RuntimeError as error:
        raise CheckpointError("The teacher's weights do not fit.", where=folder / WEIGHTS, got=error) from error
    return teacher.eval().requires_grad_(False)
