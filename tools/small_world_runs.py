"""Plans of what to train on the small world: runs of steps, each for a number of seconds, with one seed or several."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import ClassVar, Literal, Self

from pydantic import Field, model_validator

from worldline_core.config import StrictModel
from worldline_core.distillation.distill_config import CYCLE
from worldline_core.errors import ConfigError
from worldline_core.model.world_model_config import CAUSAL_SIGMAS, VIEWS, WorldModelConfig
from worldline_core.training.training_config import OptimizerConfig, SavingConfig, SigmaSampling, TrainerConfig


class Timed(StrictModel):
    """A step's length and peak learning rate.

    ``seconds`` leave out compilation and measuring: what an optimiser step takes is measured once, before the first run
    with these settings, and all runs with them take as many steps. ``steps``: so many instead.
    ``decay``: share of the steps over which the learning rate falls to 0.
    """

    seconds: float | None = Field(default=None, gt=0)
    steps: int | None = Field(default=None, ge=1)
    batch: int = Field(ge=1)
    lr: float = Field(gt=0)
    betas: ClassVar[tuple[float, float]] = (0.9, 0.95)
    weight_decay: ClassVar[float] = 1e-6
    decay: float = Field(default=0.35, ge=0, le=1)
    ema: float = Field(default=0.999, ge=0, lt=1)
    warmup: int = Field(default=100, ge=0)

    @model_validator(mode="after")
    def _one_length(self) -> Self:
        if (self.seconds is None) == (self.steps is None):
            raise ValueError("give seconds or steps, one of the two")
        return self

    def trainer(self, steps: int, seed: int, device: str, log_every: int = 5 * CYCLE) -> TrainerConfig:
        """The training loop of so many steps."""
        return TrainerConfig(
            steps=steps,
            batch_size=self.batch,
            seed=seed,
            device=device,
            ema_decay=self.ema,
            log_every=log_every,
            optimizer=OptimizerConfig(
                learning_rate=self.lr,
                betas=self.betas,
                weight_decay=self.weight_decay,
                warmup_steps=self.warmup,
                decay=self.decay,
            ),
            saving=SavingConfig(share=0.03),
        )


class TokenizerSettings(Timed):
    """``episodes``: recordings, in the order of their files, that it is fitted to."""

    betas: ClassVar[tuple[float, float]] = (0.9, 0.99)
    weight_decay: ClassVar[float] = 1e-4
    batch: int = Field(default=96, ge=1)
    lr: float = Field(default=2e-3, gt=0)
    ema: float = Field(default=0.998, ge=0, lt=1)
    channels: int = Field(default=32, ge=1)
    width: int = Field(default=48, ge=4)
    depth: int = Field(default=2, ge=1)
    episodes: int = Field(default=600, ge=1)

    def factor(self, step: int, steps: int) -> float:
        """Factor on the learning rate: a warm-up times half a cosine down to 0."""
        return min(1.0, (step + 1) / max(self.warmup, 1)) * 0.5 * (1 + math.cos(math.pi * step / steps))


class BaseSettings(Timed):
    """Text and the first frame to one view: what Stage I learns, from nothing."""

    batch: int = Field(default=512, ge=1)
    lr: float = Field(default=2e-3, gt=0)


class Stage2Settings(Timed):
    """Controls and the first frames to the views.

    ``things``: extra weight of what the task moves, and of other things.
    ``outcomes``: only recordings that ended so (``[success]``); None takes all.
    ``action_frames``: control frames whose maps a latent frame takes: its own, or all four of its interval.
    ``native_size``: control vectors, padded to this size, by FiLM in every layer instead of maps (32 holds all bodies').
    ``relational``: the relational terms, with the shipped video teacher.
    """

    batch: int = Field(default=256, ge=1)
    lr: float = Field(default=2e-3, gt=0)
    sigma: SigmaSampling = SigmaSampling(shift=3.0)
    motion: float = Field(default=1.0, ge=0)
    things: tuple[float, float] = (0.0, 0.0)
    action_dropout: float = Field(default=0.05, ge=0, lt=1)
    action_multiplier: float = Field(default=1.0, gt=0)
    compile: bool = False
    views: tuple[str, ...] = VIEWS
    outcomes: tuple[str, ...] | None = Field(default=None, min_length=1)
    # Left out of dumps at its default: what was trained before it existed keeps its name.
    action_frames: Literal[1, 4] = Field(default=1, exclude_if=lambda value: value == 1)
    native_size: int | None = Field(default=None, ge=16, le=32)
    relational: bool = False

    @model_validator(mode="after")
    def _known_views_and_controls(self) -> Self:
        if not set(self.views) <= set(VIEWS) or "head" not in self.views:
            raise ValueError(f"views: some of {', '.join(VIEWS)}, the head view among them, not {self.views}")
        if self.native_size is not None and self.action_frames != 1:
            raise ValueError("action_frames: control vectors are those of one frame; leave it out with native_size")
        return self


class ForcingSettings(Timed):
    """Teacher forcing. ``things``: as in Stage II. ``history_noise``: largest standard deviation of noise on the clean blocks that a block sees.

    ``long_every``: every so many batches are a third as many cuts of 65 frames of long recordings, so that the model meets
    a window that moves; 0 does without them.
    ``sigmas``: nodes of the sampler, saved with the model; (1, 0) is one step a block.
    ``history``: what a block sees before it, the recorded blocks or the model's own, as in a rollout.
    ``teacher``: Stage II model; ``teacher_share`` of what a block of a short clip should become is its one-step prediction,
    which knows the later controls too, the rest the recording. None: the recording alone.
    ``validate_every``: every so many steps, and after the last, ``metrics.jsonl`` gets the error of the averaged weights'
    rollouts on up to 120 validation recordings, where there are any; 0: after the last alone.
    """

    batch: int = Field(default=192, ge=3)
    lr: float = Field(default=1e-3, gt=0)
    sigma: SigmaSampling = SigmaSampling(shift=5.0)
    things: tuple[float, float] = (0.0, 0.0)
    history_noise: float = Field(default=0.0, ge=0)
    long_every: int = Field(default=4, ge=0)
    sigmas: tuple[float, ...] = CAUSAL_SIGMAS
    history: Literal["recorded", "generated"] = "recorded"
    teacher: Path | None = None
    teacher_share: float = Field(default=0.5, gt=0, le=1)
    validate_every: int = Field(default=0, ge=0)
    compile: bool = False

    @model_validator(mode="after")
    def _noise_on_recorded_blocks(self) -> Self:
        if self.history == "generated" and self.history_noise:
            raise ValueError(
                "history_noise: the model's own blocks are not exact anyway; with history: generated it is 0"
            )
        return self

    def trainer(self, steps: int, seed: int, device: str, log_every: int = 5 * CYCLE) -> TrainerConfig:
        loop = super().trainer(steps, seed, device, log_every)
        return loop.model_copy(update={"validate_every": self.validate_every})


class RegressionSettings(Timed):
    """Trajectory regression, on trajectories of ``batches`` times ``clips`` clips; ``long_every`` of these are long."""

    batches: int = Field(default=16, ge=1)
    clips: int = Field(default=192, ge=3)
    batch: int = Field(default=96, ge=1)
    lr: float = Field(default=1e-4, gt=0)
    ema: float = Field(default=0.99, ge=0, lt=1)
    warmup: int = Field(default=20, ge=0)
    long_every: int = Field(default=4, ge=0)


class MatchingSettings(Timed):
    """Distribution matching; the fake score learns four times as fast."""

    betas: ClassVar[tuple[float, float]] = (0.0, 0.999)
    batch: int = Field(default=48, ge=1)
    lr: float = Field(default=2e-5, gt=0)
    decay: float = Field(default=0.0, ge=0, le=1)
    ema: float = Field(default=0.99, ge=0, lt=1)
    warmup: int = Field(default=12, ge=0)


class RunPlan(StrictModel):
    """A run: its steps, each from the one before. ``start``: checkpoint that the first starts from; None: nothing."""

    start: Path | None = None
    model: WorldModelConfig | None = None
    base: BaseSettings | None = None
    stage2: Stage2Settings | None = None
    teacher_forcing: ForcingSettings | None = None
    trajectory_regression: RegressionSettings | None = None
    distribution_matching: MatchingSettings | None = None

    def steps(self) -> dict[str, Timed]:
        """Settings of the steps that the run has, in their order."""
        return {name: value for name in STEPS if (value := getattr(self, name)) is not None}


STEPS = ("base", "stage2", "teacher_forcing", "trajectory_regression", "distribution_matching")


class MeasureSettings(StrictModel):
    """``splits``: recordings to measure with. ``samplers``: Euler steps and shift, of Stage II models; the first counts."""

    splits: dict[str, int] = Field(default={"test": 300}, min_length=1)
    samplers: tuple[tuple[int, float], ...] = Field(default=((1, 1.0),), min_length=1)


class Plan(StrictModel):
    """What to train and to measure.

    ``model``: of runs that begin with nothing and name no other. ``seeds``: every run is made with each.
    ``reference``: the run that the others are compared with; None: the first.
    """

    model: WorldModelConfig = WorldModelConfig(prediction="first_frame_residual", first_frame_std=0.75)
    tokenizer: TokenizerSettings | None = None
    seeds: tuple[int, ...] = Field(default=(0,), min_length=1)
    reference: str | None = None
    measure: MeasureSettings = MeasureSettings()
    runs: dict[str, RunPlan] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _known_reference(self) -> Self:
        if self.reference is not None and self.reference not in self.runs:
            raise ValueError(f"reference: one of {', '.join(self.runs)}, not {self.reference}")
        return self

    def of_seeds(self, chosen: Sequence[int] | None) -> Plan:
        """The same with some of its seeds alone; None: all. Raises: ConfigError for a seed that it does not have."""
        if unknown := sorted(set(chosen or ()) - set(self.seeds)):
            raise ConfigError("The plan has no such seed", where="--seeds", expected=self.seeds, got=unknown)
        return self if chosen is None else self.model_copy(update={"seeds": tuple(chosen)})

    @property
    def relational(self) -> bool:
        """Whether a run needs the video teacher."""
        return any(run.stage2 is not None and run.stage2.relational for run in self.runs.values())


def key_of(values: Mapping[str, object]) -> str:
    """Short digest of JSON values."""
    return hashlib.sha256(json.dumps(values, sort_keys=True, default=str).encode()).hexdigest()[:12]
