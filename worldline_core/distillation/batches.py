"""Batches of trajectory clips: the teacher's nodes and robot masks beside the recorded latents and action maps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from worldline_core.distillation.auxiliary_losses import clip_robot_masks
from worldline_core.distillation.distill_config import DistillConfig
from worldline_core.distillation.teacher_trajectories import TrajectoryStore, teacher_trajectories, with_observed_frame
from worldline_core.errors import ConfigError
from worldline_core.model.world_model import WorldModel
from worldline_core.training.clip_loader import Batch, ClipLoader
from worldline_core.training.clip_sampler import ClipSampler
from worldline_core.training.clip_source import Clip, ClipBatch
from worldline_core.training.trainer import TrainerConfig, autocast, step_generator


@dataclass(frozen=True)
class Trajectories:
    """What distillation adds to a batch; `clean` is the history the teacher saw, observed frame included."""

    nodes: Float[Tensor, "b k v c u h w"]
    clean: Float[Tensor, "b v c t h w"]
    mask: Float[Tensor, "b v t h w"]


@dataclass(frozen=True)
class TrajectoryBatch(Batch):
    """A batch with the teacher's trajectories of its clips."""

    trajectories: Trajectories | None = None


def parts_of(batch: Batch) -> tuple[Trajectories, Float[Tensor, "b v a t h w"]]:
    """Trajectories and action maps of a batch.

    Raises:
        ConfigError: the batch lacks one of them.
    """
    trajectories = batch.trajectories if isinstance(batch, TrajectoryBatch) else None
    if trajectories is None:
        raise ConfigError("A batch without teacher trajectories", expected="a batch of TrajectoryLoader")
    return trajectories, maps_of(batch)


def maps_of(batch: Batch) -> Float[Tensor, "b v a t h w"]:
    """Action maps of a batch.

    Raises:
        ConfigError: there are none.
    """
    if batch.action_maps is None:
        raise ConfigError("Distillation needs action maps", next_step="give the action tracks to the clip loader")
    return batch.action_maps


class TrajectoryLoader:
    """Draws trajectories at random; what a step sees depends on (seed, step) alone.

    Args:
        generated_history: whether the teacher saw its own clean blocks before each block (else the recorded ones).
    """

    def __init__(
        self,
        store: TrajectoryStore,
        loader: ClipLoader,
        *,
        batch_size: int,
        seed: int,
        generated_history: bool,
        rank: int = 0,
        world_size: int = 1,
    ) -> None:
        self.store = store
        self.loader = loader
        self.batch_size = batch_size
        self.seed = seed
        self.generated_history = generated_history
        self.rank = rank
        self.world_size = world_size
        # A batch has one shape, so its clips have one length: a group is drawn by its size, then clips within it.
        lengths = [clip.num_frames for clip in store.clips(range(len(store)))]
        self._groups = [
            [row for row, length in enumerate(lengths) if length == wanted] for wanted in sorted(set(lengths))
        ]
        self._shares = np.array([len(group) for group in self._groups]) / len(store)

    def load(self, index: int) -> TrajectoryBatch:
        """The batch of micro-step `index` (of this rank)."""
        random = np.random.Generator(np.random.Philox(key=[self.seed, index]))
        group = self._groups[int(random.choice(len(self._groups), p=self._shares))]
        draws = random.integers(len(group), size=self.batch_size * self.world_size)
        rows = [group[int(draw)] for draw in draws[self.rank * self.batch_size : (self.rank + 1) * self.batch_size]]
        batch = self.loader.load(ClipBatch(self.store.clips(rows), None))
        nodes = self.store.nodes(rows).to(self.loader.device)
        clean = batch.latents
        if self.generated_history:
            clean = with_observed_frame(clean[..., :1, :, :], nodes[:, -1])
        trajectories = Trajectories(nodes, clean, self.store.masks(rows).to(self.loader.device))
        return TrajectoryBatch(batch.clips, batch.views, batch.latents, batch.action_maps, trajectories=trajectories)


def robot_masks(loader: ClipLoader, clips: Sequence[Clip], views: Sequence[str]) -> Float[Tensor, "b v t h w"]:
    """Robot masks of some clips from their action tracks.

    Raises:
        ConfigError: the loader has no action tracks.
    """
    if loader.tracks is None:
        raise ConfigError("Robot masks come from action tracks", next_step="give the tracks to the clip loader")
    cut = []
    for clip in clips:
        frames = np.arange(clip.num_frames) * clip.stride + clip.start
        cut.append(loader.tracks.tracks(clip.episode_id).clip(frames))
    _, rows, columns = loader.store.latent_shape
    return clip_robot_masks(cut, views, (rows, columns))


class TrajectoryMaker:
    """Makes the shards of the trajectory store: clips by sampler, noise by seed, nodes by the frozen teacher."""

    def __init__(
        self,
        config: DistillConfig,
        trainer: TrainerConfig,
        teacher: WorldModel,
        loader: ClipLoader,
        sampler: ClipSampler,
    ) -> None:
        self.config = config
        self.trainer = trainer
        self.teacher = teacher.eval().requires_grad_(False)
        self.loader = loader
        self.sampler = sampler

    def __call__(self, number: int) -> tuple[Sequence[Clip], Tensor, Tensor]:
        """Clips, nodes and masks of shard `number`."""
        settings = self.config.trajectory_regression.trajectories
        batch = self.loader.load(self.sampler.clips(number))
        generator = step_generator(settings.seed, number, self.trainer.device)
        noise = torch.randn(batch.latents.shape, generator=generator, device=batch.latents.device)
        with autocast(self.trainer):
            nodes = teacher_trajectories(
                self.teacher,
                batch.latents,
                maps_of(batch),
                noise,
                views=batch.views,
                block_size=self.config.block_size,
                window=self.config.window,
                substeps=settings.substeps,
                generated_history=settings.history == "generated",
            )
        return batch.clips, nodes, robot_masks(self.loader, batch.clips, batch.views)
