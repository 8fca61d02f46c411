"""Relational dynamics regularisation (paper, section "Relational Dynamics Regularization" and its appendix).

Student features (the output of a middle block) and features of a frozen video encoder are pooled to the same few
temporal bins and the same coarse grid; then not the features but their cosine-similarity matrices are compared:
adjacent bins of one view (intra), and the same bin of the head and one wrist view (cross).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from einops import rearrange
from jaxtyping import Float
from pydantic import Field
from torch import Tensor
from torch.nn import functional

from worldline_core.config import StrictModel


class RelationalConfig(StrictModel):
    """Targets and caps of the two terms (paper: 0.03 and 0.005 of the flow-matching loss, caps 0.20 and 0.10).

    ``bins`` and ``grid`` are upper bounds: a clip with fewer latent frames gets one bin a frame, a coarser token grid
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


@dataclass(frozen=True)
class PoolingShape:
    """Bins and grid that student and teacher share."""

    bins: int
    rows: int
    columns: int

    @classmethod
    def common(cls, config: RelationalConfig, *shapes: tuple[int, int, int]) -> PoolingShape:
        """The finest pooling that the config allows and every (t, h, w) has."""
        return cls(
            min(config.bins, *(shape[0] for shape in shapes)),
            min(config.grid[0], *(shape[1] for shape in shapes)),
            min(config.grid[1], *(shape[2] for shape in shapes)),
        )


def pool_features(features: Float[Tensor, "b v t h w d"], shape: PoolingShape) -> Float[Tensor, "b v bins n d"]:
    """Average over temporal bins and grid cells; tokens of a bin are rows-first."""
    views = features.shape[1]
    volume = rearrange(features.float(), "b v t h w d -> (b v) d t h w")
    pooled = functional.adaptive_avg_pool3d(volume, (shape.bins, shape.rows, shape.columns))
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
    """Loss scales that follow moving averages of L_FM / L_rel, so that each weighted term is a fixed part of L_FM."""

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

    def state(self) -> dict[str, Any]:
        """For the training state."""
        return dict(self.ratios)

    def load_state(self, state: dict[str, Any]) -> None:
        """Continue from a training state."""
        self.ratios = {name: float(value) for name, value in state.items()}
