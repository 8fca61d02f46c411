"""The small frozen video encoder of the embedded default, and the train_teacher step that trains it on the recordings.

A masked-video transformer: it reads 64 x 96 video in tubelets (the first frame alone, then groups of four frames, as the
tokenizer does); part of the tubelets is hidden, and their normalised pixels are predicted from the rest. Its features are
the normalised outputs of its last four blocks, concatenated, as with the full-size teacher.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Bool, Float
from pydantic import Field, ValidationError
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor, nn
from torch.nn import functional

from worldline_core.config import StrictModel
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import CheckpointError, DataError
from worldline_core.store.atomic import write_bytes_atomic, write_json_atomic
from worldline_core.training.recorded_views import RecordedView, load_views
from worldline_core.training.trainer import (
    Objective,
    OptimizerConfig,
    ParameterGroup,
    TrainerConfig,
    autocast,
    step_generator,
    train,
)

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

    def masked_loss(self, frames: Float[Tensor, "b 3 t h w"], hidden: Bool[Tensor, "b bins n"]) -> Float[Tensor, ""]:
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


VALIDATION_SEED = 30_000


class TeacherConfig(StrictModel):
    """Masked-video training. ``hidden``: share of tubelets that are hidden (the first frame stays visible)."""

    shape: SmallTeacherShape = SmallTeacherShape()
    trainer: TrainerConfig = TrainerConfig(
        steps=600,
        batch_size=12,
        ema_decay=0.99,
        optimizer=OptimizerConfig(learning_rate=1e-3, decay_steps=200),
    )
    splits: tuple[str, ...] = ("train",)
    max_episodes: int = Field(default=120, ge=2)
    held_out_episodes: int = Field(default=8, ge=1)
    clip_frames: int = Field(default=17, ge=5)
    hidden: float = Field(default=0.75, gt=0, lt=1)


@dataclass(frozen=True)
class FrameBatch:
    """Clips of single views (episode/view), RGB in [0, 1]."""

    names: tuple[str, ...]
    frames: Float[Tensor, "b 3 t h w"]


class MaskedVideoObjective(Objective[FrameBatch]):
    """Predict hidden tubelets."""

    def __init__(self, teacher: SmallVideoTeacher, hidden: float) -> None:
        self.teacher = teacher
        self.hidden = hidden

    def loss(self, batch: FrameBatch, generator: torch.Generator, step: int) -> tuple[Tensor, dict[str, float]]:
        """Loss on one batch; the first frame is never hidden."""
        del step
        groups = 1 + (batch.frames.shape[2] - 1) // TUBELET
        tokens = self.teacher.grid[0] * self.teacher.grid[1]
        draws = torch.rand(len(batch.names), groups, tokens, generator=generator, device=batch.frames.device)
        hidden = draws < self.hidden
        hidden[:, 0] = False
        return self.teacher.masked_loss(batch.frames, hidden), {}


def teacher_batch(views: Sequence[RecordedView], config: TeacherConfig, seed: int, index: int) -> FrameBatch:
    """Batch ``index``: a pure function of the seed and the index."""
    random = np.random.Generator(np.random.Philox(key=[seed, index]))
    names, frames = [], []
    for _ in range(config.trainer.batch_size):
        view = views[int(random.integers(len(views)))]
        start = int(random.integers(view.frames.shape[1] - config.clip_frames + 1))
        names.append(view.name)
        frames.append(view.frames[:, start : start + config.clip_frames])
    return FrameBatch(tuple(names), torch.stack(frames).to(config.trainer.device).float() / 255.0)


def train_teacher(config: TeacherConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """Train on ``inputs['episodes']`` (training splits only) and write the frozen teacher.

    Raises:
        DataError: if there are not enough episodes.
    """
    torch.manual_seed(config.trainer.seed)
    episodes = EpisodeSet.open(Path(inputs["episodes"]))
    fitting = [i for i in episodes.select(split=config.splits) if episodes.rows[i].video_frames >= config.clip_frames]
    order = np.random.default_rng(config.trainer.seed).permutation(len(fitting))
    held_out_count = min(config.held_out_episodes, len(fitting) // 4)
    if len(fitting) < 2 or held_out_count < 1:
        raise DataError(
            "There are too few episodes to train a teacher.",
            where=inputs["episodes"],
            expected=f"4 or more in {config.splits}, of {config.clip_frames} frames or more",
            got=len(fitting),
        )
    held_out = sorted(fitting[i] for i in order[:held_out_count])
    chosen = sorted(fitting[i] for i in order[held_out_count : held_out_count + config.max_episodes])
    teacher = SmallVideoTeacher(config.shape)
    teacher.initialise(torch.Generator().manual_seed(config.trainer.seed))
    teacher.to(config.trainer.device).train()
    objective = MaskedVideoObjective(teacher, config.hidden)
    training = load_views(episodes, chosen, config.shape.image_size, config.clip_frames)
    validation = load_views(episodes, held_out, config.shape.image_size, config.clip_frames)

    def validate() -> dict[str, float]:
        total = 0.0
        for index in range(config.trainer.validation_batches):
            generator = step_generator(VALIDATION_SEED, index, config.trainer.device)
            with autocast(config.trainer):
                batch = teacher_batch(validation, config, VALIDATION_SEED, index)
                total += objective.loss(batch, generator, 0)[0].item()
        return {"loss": total / max(1, config.trainer.validation_batches)}

    result = train(
        config.trainer,
        groups=[ParameterGroup("teacher", dict(teacher.named_parameters()))],
        objective=objective,
        load=lambda index: teacher_batch(training, config, config.trainer.seed, index),
        validate=validate,
        output=output,
        identity={"config": config.model_dump(mode="json"), "episodes": [view.name for view in training]},
        title="teacher",
    )
    weights = {name: value.to("cpu", torch.float16).contiguous() for name, value in sorted(result.average.items())}
    write_bytes_atomic(output / WEIGHTS, save(weights))
    write_json_atomic(
        output / DESCRIPTION,
        {
            "format": FORMAT,
            "shape": config.shape.model_dump(mode="json"),
            "training": "masked video prediction",
            "episodes": len(chosen),
            "steps": config.trainer.steps,
            "seed": config.trainer.seed,
            "metrics": result.metrics,
        },
    )
    parameters = sum(value.numel() for value in teacher.parameters())
    return {
        "episodes": len(chosen),
        "steps": config.trainer.steps,
        "parameters": parameters,
        **result.metrics,
    }
