"""The train_teacher step: the small video encoder of the embedded default learns from the training recordings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field
from safetensors.torch import save
from torch import Tensor

from worldline_core.config.base import StrictModel
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import DataError
from worldline_core.model.tokenizer.pixels import frames_to_video
from worldline_core.store.atomic import write_bytes_atomic, write_json_atomic
from worldline_core.training.clip_sampler import Clip
from worldline_core.training.small_teacher import (
    DESCRIPTION,
    FORMAT,
    TUBELET,
    WEIGHTS,
    SmallTeacherShape,
    SmallVideoTeacher,
)
from worldline_core.training.trainer import (
    OptimizerConfig,
    ParameterGroup,
    TrainerConfig,
    autocast,
    step_generator,
    train,
)

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
    """Clips of single views, RGB in [0, 1]."""

    clips: tuple[Clip, ...]
    frames: Float[Tensor, "b 3 t h w"]


class MaskedVideoObjective:
    """Predict hidden tubelets."""

    def __init__(self, teacher: SmallVideoTeacher, hidden: float) -> None:
        self.teacher = teacher
        self.hidden = hidden

    def loss(self, batch: FrameBatch, generator: torch.Generator, step: int) -> tuple[Tensor, dict[str, float]]:
        """Loss on one batch; the first frame is never hidden."""
        del step
        groups = 1 + (batch.frames.shape[2] - 1) // TUBELET
        tokens = self.teacher.grid[0] * self.teacher.grid[1]
        draws = torch.rand(len(batch.clips), groups, tokens, generator=generator, device=batch.frames.device)
        hidden = draws < self.hidden
        hidden[:, 0] = False
        return self.teacher.masked_loss(batch.frames, hidden), {}

    def state(self) -> dict[str, Any]:
        """Nothing changes from step to step."""
        return {}

    def load_state(self, state: dict[str, Any]) -> None:
        """Nothing to load."""
        del state


class FrameClips:
    """Recordings held in memory at the teacher's size, and deterministic batches from them."""

    def __init__(self, episodes: EpisodeSet, chosen: Sequence[int], config: TeacherConfig, seed: int) -> None:
        self.config = config
        self.seed = seed
        self.names: list[str] = []
        self.videos: list[np.ndarray] = []
        for position in chosen:
            row = episodes.rows[position]
            for view in row.views:
                video = frames_to_video(episodes.frames(position, view), config.shape.image_size)
                self.names.append(f"{row.episode_id}/{view}")
                self.videos.append(((video + 1) * 127.5).round().to(torch.uint8).numpy())

    def load(self, index: int) -> FrameBatch:
        """Batch ``index``: a pure function of the seed and the index."""
        random = np.random.Generator(np.random.Philox(key=[self.seed, index]))
        clips, frames = [], []
        for _ in range(self.config.trainer.batch_size):
            number = int(random.integers(len(self.videos)))
            start = int(random.integers(self.videos[number].shape[1] - self.config.clip_frames + 1))
            clips.append(Clip(self.names[number], start, self.config.clip_frames, 1))
            frames.append(self.videos[number][:, start : start + self.config.clip_frames])
        stacked = torch.from_numpy(np.stack(frames)).to(self.config.trainer.device)
        return FrameBatch(tuple(clips), stacked.float() / 255.0)


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
    training = FrameClips(episodes, chosen, config, config.trainer.seed)
    validation = FrameClips(episodes, held_out, config, VALIDATION_SEED)

    def validate() -> dict[str, float]:
        total = 0.0
        for index in range(config.trainer.validation_batches):
            generator = step_generator(VALIDATION_SEED, index, config.trainer.device)
            with autocast(config.trainer):
                total += objective.loss(validation.load(index), generator, 0)[0].item()
        return {"loss": total / max(1, config.trainer.validation_batches)}

    result = train(
        config.trainer,
        groups=[ParameterGroup("teacher", dict(teacher.named_parameters()))],
        objective=objective,
        load=training.load,
        validate=validate,
        output=output,
        identity={"config": config.model_dump(mode="json"), "episodes": training.names},
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
