"""The train_teacher step: the small video teacher of the embedded default, trained on the recordings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from safetensors.torch import save
from torch import Tensor

from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import DataError
from worldline_core.store.atomic import write_bytes_atomic, write_json_atomic
from worldline_core.training.frame_source import RecordedView, load_views
from worldline_core.training.trainer import Objective, ParameterGroup, held_out_losses, train
from worldline_core.training.training_config import TeacherConfig
from worldline_core.training.video_teacher import DESCRIPTION, FORMAT, TUBELET, WEIGHTS, SmallVideoTeacher

VALIDATION_SEED = 30_000


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
    """Train on ``inputs['episodes']`` (training splits only), write the frozen teacher, and count the episodes.

    Raises:
        DataError: if there are not enough episodes.
    """
    torch.manual_seed(config.trainer.seed)
    episodes = EpisodeSet.open(Path(inputs["episodes"]))
    in_splits = episodes.select(split=config.splits)
    fitting = [i for i in in_splits if episodes.rows[i].video_frames >= config.clip_frames]
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

    result = train(
        config.trainer,
        groups=[ParameterGroup("teacher", dict(teacher.named_parameters()))],
        objective=objective,
        load=lambda index: teacher_batch(training, config, config.trainer.seed, index),
        validate=lambda: held_out_losses(
            config.trainer,
            lambda index: teacher_batch(validation, config, VALIDATION_SEED, index),
            lambda batch, generator: {"loss": objective.loss(batch, generator, 0)[0].item()},
            VALIDATION_SEED,
        ),
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
    left_out = {
        "in other splits": len(episodes) - len(in_splits),
        f"shorter than {config.clip_frames} frames": len(in_splits) - len(fitting),
        "held out to measure on": len(held_out),
        "beyond max_episodes": len(fitting) - len(held_out) - len(chosen),
    }
    return {
        "found": len(episodes),
        "kept": len(chosen),
        "left_out": left_out,
        "episodes": len(chosen),
        "steps": config.trainer.steps,
        "parameters": parameters,
        **result.metrics,
    }
