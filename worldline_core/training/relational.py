"""Relational dynamics regularisation (paper, section "Relational Dynamics Regularization" and its appendix).

Student features (the output of a middle block) and features of a frozen video encoder are pooled to the same few
temporal bins and the same coarse grid; then not the features but their cosine-similarity matrices are compared:
adjacent bins of one view (intra), and the same bin of the head and one wrist view (cross).
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float, UInt8
from pydantic import Field
from torch import Tensor
from torch.nn import functional

from worldline_core.config import StrictModel
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.training.clip_loader import Batch
from worldline_core.training.clip_source import Clip
from worldline_core.training.trainer import average_values
from worldline_core.training.video_teacher import VideoTeacher


class RelationalConfig(StrictModel):
    """Targets and caps of the two terms (paper: 0.03 and 0.005 of the flow-matching loss, caps 0.20 and 0.10).

    ``bins`` and ``grid`` are upper bounds: a clip with fewer latent frames gets one bin per frame, a coarser token grid
    (of student or teacher, whichever is coarser) is not blown up.
    """

    intra_ratio: float = Field(default=0.03, ge=0)
    cross_ratio: float = Field(default=0.005, ge=0)
    intra_cap: float = Field(default=0.20, ge=0)
    cross_cap: float = Field(default=0.10, ge=0)
    ramp_steps: int = Field(default=250, ge=0)
    ema_decay: float = Field(default=0.99, ge=0, lt=1)
    bins: int = Field(default=8, ge=2)
    grid: tuple[int, int] = (8, 8)
    student_layer: int | None = Field(default=None, ge=1, description="None: the middle block")
    cached_clips: int = Field(default=20000, ge=0, description="clips whose teacher features stay in memory")


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


def relation(first: Float[Tensor, "*batch n d"], second: Float[Tensor, "*batch m d"]) -> Float[Tensor, "*batch n m"]:
    """Cosine similarities of all pairs of tokens: R(F, G) = normalised F times normalised G transposed."""
    return functional.normalize(first, dim=-1) @ functional.normalize(second, dim=-1).transpose(-1, -2)


def intra_relations(pooled: Float[Tensor, "b v t n d"], view: int) -> Float[Tensor, "b s n n"]:
    """Relations between adjacent bins of one view."""
    return relation(pooled[:, view, :-1], pooled[:, view, 1:])


def cross_relations(pooled: Float[Tensor, "b v t n d"], wrist: int) -> Float[Tensor, "b t n n"]:
    """Relations between the head view (0) and a wrist view in the same bin."""
    return relation(pooled[:, 0], pooled[:, wrist])


def relational_losses(
    student: Float[Tensor, "b v t n d"], teacher: Float[Tensor, "b v t n e"], step: int
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """(intra, cross) L1 distances. The view goes round robin with the step; the wrist alternates left and right.

    The teacher is detached: gradients reach the student only. With a single view, the cross term is zero.
    """
    views = student.shape[1]
    teacher = teacher.detach()
    view = step % views
    intra = (intra_relations(student, view) - intra_relations(teacher, view)).abs().mean()
    if views == 1:
        return intra, intra.new_zeros(())
    wrist = 1 + step % (views - 1)
    cross = (cross_relations(student, wrist) - cross_relations(teacher, wrist)).abs().mean()
    return intra, cross


class RelationalScales:
    """Loss scales that follow moving averages of L_FM / L_rel, so that each weighted term is a fixed part of L_FM.

    ``ratios``: the averages so far, which are part of the training state.
    """

    def __init__(self, config: RelationalConfig) -> None:
        self.config = config
        self.ratios: dict[str, float] = {}

    def update(self, flow: float, intra: float, cross: float, step: int) -> tuple[float, float]:
        """Scales (intra, cross) at ``step``, after taking in this step's losses."""
        ramp = min(1.0, (step + 1) / self.config.ramp_steps) if self.config.ramp_steps else 1.0
        terms = (
            ("intra", intra, self.config.intra_ratio, self.config.intra_cap),
            ("cross", cross, self.config.cross_ratio, self.config.cross_cap),
        )
        scales: list[float] = []
        for name, value, target, cap in terms:
            ratio = flow / max(value, 1e-6)
            before = self.ratios.get(name, ratio)
            self.ratios[name] = self.config.ema_decay * before + (1 - self.config.ema_decay) * ratio
            scales.append(ramp * min(cap, target * self.ratios[name]))
        return scales[0], scales[1]


class TeacherFeatures:
    """Teacher features of clips, from the recordings' frames, kept in memory (half precision)."""

    def __init__(self, teacher: VideoTeacher, episodes: Path, *, cached_clips: int) -> None:
        self.teacher = teacher
        self.episodes = EpisodeSet.open(episodes)
        self.cached_clips = cached_clips
        self._cache: OrderedDict[tuple[Clip, tuple[str, ...]], Tensor] = OrderedDict()

    def features(
        self, clips: Sequence[Clip], views: Sequence[str], frames: UInt8[Tensor, "b v n height width 3"] | None = None
    ) -> Float[Tensor, "b v t h w d"]:
        """Features of every clip and view.

        Args:
            frames: of these clips, where they are read already; else they are decoded here, at the size of the recording.
        """
        given = [None] * len(clips) if frames is None else list(frames)
        # Half precision does not survive a stack under CPU autocast.
        return torch.stack([self._clip(c, tuple(views), f).float() for c, f in zip(clips, given, strict=True)])

    def _clip(
        self, clip: Clip, views: tuple[str, ...], frames: UInt8[Tensor, "v n height width 3"] | None
    ) -> Float[Tensor, "v t h w d"]:
        key = (clip, views)
        if key in self._cache:
            self._cache.move_to_end(key)
            return self._cache[key]
        if frames is None:
            position = self.episodes.position(clip.episode_id)
            decoded = [self.episodes.frames(position, view, list(clip.frames)) for view in views]
            frames = torch.from_numpy(np.stack(decoded))
        video = rearrange(frames.float() / 255.0, "v t h w c -> v c t h w")
        features = self.teacher.features(video).to("cpu", torch.float16)
        # Computed and cached values must be the same bits, so that a resumed run equals an undisturbed one.
        if self.cached_clips:
            self._cache[key] = features
            if len(self._cache) > self.cached_clips:
                self._cache.popitem(last=False)
        return features


class RelationalTerm:
    """Teacher features, student layer and running scales of the relational terms."""

    def __init__(self, config: RelationalConfig, teacher: TeacherFeatures, num_layers: int) -> None:
        self.config = config
        self.teacher = teacher
        self.layer = config.student_layer or max(1, num_layers // 2)
        self.scales = RelationalScales(config)

    def add(
        self, flow: Float[Tensor, ""], features: Float[Tensor, "b v t h w d"], batch: Batch, step: int
    ) -> tuple[Tensor, dict[str, float]]:
        """The flow-matching loss plus the weighted relational terms."""
        taught = self.teacher.features(batch.clips, batch.views, batch.frames).to(features.device)
        shape = common_shape(self.config, features.shape[2:5], taught.shape[2:5])
        intra, cross = relational_losses(pool_features(features, shape), pool_features(taught, shape), step)
        # Over all processes, so that their scales stay equal and one saved state is everyone's.
        seen = average_values({"flow": flow.item(), "intra": intra.item(), "cross": cross.item()})
        scale_intra, scale_cross = self.scales.update(seen["flow"], seen["intra"], seen["cross"], step)
        values = {
            "relational_intra": intra.item(),
            "relational_cross": cross.item(),
            "scale_intra": scale_intra,
            "scale_cross": scale_cross,
        }
        return flow + scale_intra * intra + scale_cross * cross, values
