"""Relational dynamics regularisation (paper, section "Relational Dynamics Regularization" and its appendix).

Student features (the output of a middle block) and features of a frozen video encoder are pooled to the same few
temporal bins and the same coarse grid; then not the features but their cosine-similarity matrices are compared:
adjacent bins of one view (intra), and the same bin of the head and one wrist view (cross).
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn import functional

from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.training.clip_loader import Batch
from worldline_core.training.clip_sampler import Clip
from worldline_core.training.training_config import RelationalConfig
from worldline_core.training.video_teacher import VideoTeacher


def common_shape(config: RelationalConfig, *grids: tuple[int, ...]) -> tuple[int, int, int]:
    """The finest (bins, rows, columns) that the config allows and every (t, h, w) of ``grids`` has."""
    bins, rows, columns = (min(sizes) for sizes in zip((config.bins, *config.grid), *grids, strict=True))
    return bins, rows, columns


def pool_features(features: Float[Tensor, "b v t h w d"], shape: tuple[int, int, int]) -> Float[Tensor, "b v bins n d"]:
    """Average over temporal bins and grid cells; tokens of a bin are rows-first."""
    views = features.shape[1]
    volume = rearrange(features.float(), "b v t h w d -> (b v) d t h w")
    pooled = functional.adaptive_avg_pool3d(volume, shape)
    return rearrange(pooled, "(b v) d t h w -> b v t (h w) d", v=views)


def similarity_matrix(
    first: Float[Tensor, "*batch n d"], second: Float[Tensor, "*batch m d"]
) -> Float[Tensor, "*batch n m"]:
    """Cosine similarities of all pairs of tokens: normalised F times normalised G transposed."""
    return functional.normalize(first, dim=-1) @ functional.normalize(second, dim=-1).transpose(-1, -2)


@dataclass(frozen=True)
class SimilarityMatrices:
    """Similarities of the teacher's tokens: half a megabyte a clip at full size, against a gigabyte of features.

    Attributes:
        shape: (bins, rows, columns) that features are pooled to.
        intra: between adjacent bins of each view.
        cross: between the head and each wrist view in the same bin (no wrists: an empty axis).
    """

    shape: tuple[int, int, int]
    intra: Float[Tensor, "b v s n n"]
    cross: Float[Tensor, "b w t n n"]


def similarity_matrices(features: Float[Tensor, "b v t h w d"], shape: tuple[int, int, int]) -> SimilarityMatrices:
    """Similarities within every view and between the head and every wrist, after pooling."""
    pooled = pool_features(features, shape)
    return SimilarityMatrices(
        shape,
        similarity_matrix(pooled[:, :, :-1], pooled[:, :, 1:]),
        similarity_matrix(pooled[:, :1].expand_as(pooled[:, 1:]), pooled[:, 1:]),
    )


def relational_losses(
    student: Float[Tensor, "b v t n d"], teacher: SimilarityMatrices, step: int
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """(intra, cross) L1 distances. The view goes round robin with the step; the wrist alternates left and right.

    The teacher is detached: gradients reach the student only. With a single view, the cross term is zero.
    """
    views = student.shape[1]
    view = step % views
    intra = similarity_matrix(student[:, view, :-1], student[:, view, 1:]) - teacher.intra[:, view].detach()
    intra = intra.abs().mean()
    if views == 1:
        return intra, intra.new_zeros(())
    wrist = step % (views - 1)
    cross = similarity_matrix(student[:, 0], student[:, 1 + wrist]) - teacher.cross[:, wrist].detach()
    return intra, cross.abs().mean()


class RelationalScales:
    """Loss scales that follow moving averages of L_FM / L_rel, so that each weighted term is a fixed part of L_FM.

    A step's scales come from the steps before it, so all its micro-steps have the same ones, on however many processes; the
    first step, which knows no ratio yet, measures alone.

    ``ratios``: the averages so far, which are part of the training state.
    """

    def __init__(self, config: RelationalConfig) -> None:
        self.config = config
        self.ratios: dict[str, float] = {}

    def at(self, step: int) -> tuple[float, float]:
        ramp = min(1.0, (step + 1) / self.config.ramp_steps) if self.config.ramp_steps else 1.0
        intra, cross = (self.ratios.get(name, 0.0) for name in ("intra", "cross"))
        config = self.config
        return (
            ramp * min(config.intra_cap, config.intra_ratio * intra),
            ramp * min(config.cross_cap, config.cross_ratio * cross),
        )

    def update(self, flow: float, intra: float, cross: float) -> None:
        """Take in a step's mean losses; a term that is zero was not there (clips of one view have no pairs of views)."""
        for name, value in (("intra", intra), ("cross", cross)):
            if value == 0:
                continue
            ratio = flow / max(value, 1e-6)
            before = self.ratios.get(name, ratio)
            self.ratios[name] = self.config.ema_decay * before + (1 - self.config.ema_decay) * ratio


class TeacherSimilarities:
    """The teacher's similarity matrices, computed from the recordings' frames and kept in memory."""

    def __init__(self, teacher: VideoTeacher, episodes: Path, config: RelationalConfig) -> None:
        self.teacher = teacher
        self.episodes = EpisodeSet.open(episodes)
        self.config = config
        self._cache: OrderedDict[tuple[Clip, tuple[str, ...]], SimilarityMatrices] = OrderedDict()

    def similarities(
        self,
        clips: Sequence[Clip],
        views: Sequence[str],
        grid: tuple[int, int, int],
        frames: UInt8[Tensor, "b v n height width 3"] | None = None,
    ) -> SimilarityMatrices:
        """Similarity matrices of every clip.

        Args:
            grid: the student's (t, h, w) of these clips.
            frames: frames of these clips where they are at hand.
        """
        given = [None] * len(clips) if frames is None else list(frames)
        each = [self._clip(clip, tuple(views), grid, read) for clip, read in zip(clips, given, strict=True)]
        # Half precision does not survive a concatenation under CPU autocast.
        with torch.autocast(each[0].intra.device.type, enabled=False):
            intra, cross = torch.cat([one.intra for one in each]), torch.cat([one.cross for one in each])
        return SimilarityMatrices(each[0].shape, intra, cross)

    def _clip(
        self,
        clip: Clip,
        views: tuple[str, ...],
        grid: tuple[int, int, int],
        frames: UInt8[Tensor, "v n height width 3"] | None,
    ) -> SimilarityMatrices:
        key = (replace(clip, vectors=()), views)
        if key in self._cache:
            self._cache.move_to_end(key)
            return self._cache[key]
        if frames is None:
            position = self.episodes.position(clip.episode_id)
            decoded = [self.episodes.frames(position, view, list(clip.frames)) for view in views]
            frames = torch.from_numpy(np.stack(decoded))
        video = rearrange(frames.float() / 255.0, "v t h w c -> v c t h w")
        features = self.teacher.features(video).to(torch.float16)
        matrices = similarity_matrices(features[None], common_shape(self.config, grid, features.shape[1:4]))
        if self.config.cached_clips:
            self._cache[key] = matrices
            if len(self._cache) > self.config.cached_clips:
                self._cache.popitem(last=False)
        return matrices


class RelationalTerm:
    """Weighted relational losses of a student's middle block, with running scales."""

    def __init__(self, config: RelationalConfig, teacher: TeacherSimilarities, num_layers: int) -> None:
        self.config = config
        self.teacher = teacher
        self.layer = config.student_layer or max(1, num_layers // 2)
        self.scales = RelationalScales(config)

    def targets(self, batch: Batch, grid: tuple[int, int, int]) -> SimilarityMatrices:
        """The teacher's matrices on the batch's device; ask for them before the student's activations fill the memory.

        Args:
            grid: the student's (t, h, w).
        """
        found = self.teacher.similarities(batch.clips, batch.views, grid, batch.frames)
        device = batch.latents.device
        return replace(found, intra=found.intra.to(device), cross=found.cross.to(device))

    def add(
        self, flow: Float[Tensor, ""], features: Float[Tensor, "b v t h w d"], targets: SimilarityMatrices, step: int
    ) -> tuple[Tensor, dict[str, float]]:
        """The flow-matching loss plus the weighted terms, and values to log."""
        intra, cross = relational_losses(pool_features(features, targets.shape), targets, step)
        scale_intra, scale_cross = self.scales.at(step)
        values = {
            "relational_intra": intra.item(),
            "relational_cross": cross.item(),
            "scale_intra": scale_intra,
            "scale_cross": scale_cross,
        }
        return flow + scale_intra * intra + scale_cross * cross, values
