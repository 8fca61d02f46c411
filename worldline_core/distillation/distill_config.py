"""Configuration of Stage III: the clips, and one section for each of its three steps."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Literal, Self, get_args

from pydantic import Field, model_validator

from worldline_core.actions.actions_config import TEMPORAL_FACTOR
from worldline_core.config import StrictModel
from worldline_core.model.world_model_config import CAUSAL_SIGMAS, CausalSpec
from worldline_core.training.clip_config import JOINT, SUBSET, ClipInput, ClipSampling, LatentInput
from worldline_core.training.training_config import (
    ActionFollowingConfig,
    LoRAConfig,
    LossWeighting,
    OptimizerConfig,
    SigmaSampling,
    TrainerConfig,
)

DistillStep = Literal["teacher_forcing", "trajectory_regression", "distribution_matching"]
STEPS: tuple[DistillStep, ...] = get_args(DistillStep)
CYCLE = 6
"""Iterations of one cycle of distribution matching: five updates of the fake score, then one of the student."""


class PerceptualConfig(StrictModel):
    """Decoding of frames for the perceptual term.

    ``latent_frames``: how many latent frames, the last ones, are compared. ``bfloat16``: decode with weights in bfloat16
    (the Wan autoencoder alone), for half the memory.
    """

    latent_frames: int = Field(default=2, ge=1)
    bfloat16: bool = False


class AuxiliaryWeights(StrictModel):
    """Weights of the auxiliaries; the defaults are the paper's. A weight of 0 turns its term off."""

    anchor: float = Field(default=0.005, ge=0)
    boundary: float = Field(default=0.05, ge=0)
    lpips: float = Field(default=0.005, ge=0)
    robot: float = Field(default=0.005, ge=0)
    robot_motion: float = Field(default=0.1, ge=0)


class WindowConfig(StrictModel):
    """Finished blocks that stay visible: the first ones and the most recent ones (one and three in the paper).

    ``anchor_blocks``: after so many predicted blocks a rollout begins anew at its own last picture (None, the paper: never).
    No more than the longest clip has: then a rollout is never in a state that training does not have.
    """

    sink_blocks: int = Field(default=1, ge=1)
    recent_blocks: int = Field(default=3, ge=0)
    anchor_blocks: int | None = Field(default=None, ge=1)


class TeacherForcingConfig(StrictModel):
    """Step 1.

    ``history``: what a block sees before it, the recorded blocks (the paper) or the model's own, as in a rollout.
    ``history_noise``: largest standard deviation of noise on recorded blocks, drawn for each clip (0 in the paper).
    ``teacher_share``: of what a block should become, the share that the Stage II model predicts of the whole clip in one
    step; the rest is the recording (the paper: all). ``teacher_frames``: longest clip that it is asked about, the longest
    it was trained on; None: all.
    ``view_weights``: None: as ``clips`` of the whole distillation; otherwise what a step trains on is drawn by these weights
    ("joint", "subset" or the name of a view), and a step on one view takes ``single_view_factor`` times the clips: cheap
    where compute is short.
    """

    trainer: TrainerConfig = TrainerConfig(steps=2000, optimizer=OptimizerConfig(learning_rate=3e-4))
    sigma: SigmaSampling = SigmaSampling(shift=2.0)
    weighting: LossWeighting = LossWeighting()
    history: Literal["recorded", "generated"] = "recorded"
    history_noise: float = Field(default=0.0, ge=0)
    teacher_share: float = Field(default=0.0, ge=0, le=1)
    teacher_frames: int | None = Field(default=None, ge=1 + TEMPORAL_FACTOR)
    view_weights: dict[str, float] | None = None
    single_view_factor: int = Field(default=1, ge=1)

    @model_validator(mode="after")
    def _noise_on_recorded_blocks(self) -> Self:
        if self.history == "generated" and self.history_noise:
            raise ValueError("history_noise is of recorded blocks; with history: generated it is 0")
        return self


class TrajectoriesConfig(StrictModel):
    """The offline trajectories of the frozen causal teacher.

    ``substeps``: Euler steps of the teacher between neighbouring nodes; 1 everywhere is the plain few-step sampler.
    """

    clips: int = Field(default=512, ge=1)
    clips_per_shard: int = Field(default=16, ge=1)
    substeps: tuple[int, ...] = (2, 2, 3, 9)
    seed: int = Field(default=1, ge=0)


class TrajectoryRegressionConfig(StrictModel):
    """Step 2. Weights of the next node and of the clean end as in the paper."""

    trainer: TrainerConfig = TrainerConfig(steps=1000, optimizer=OptimizerConfig(learning_rate=2e-4))
    trajectories: TrajectoriesConfig = TrajectoriesConfig()
    next_weight: float = Field(default=1.0, ge=0)
    terminal_weight: float = Field(default=0.5, ge=0)
    auxiliary: AuxiliaryWeights = AuxiliaryWeights()


class DistributionMatchingConfig(StrictModel):
    """Step 3.

    ``fake_score_rate``: learning rate of the fake score as a multiple of the student's.
    ``target``: what the auxiliaries compare with: the clean end of the teacher's trajectory from the same noise (the
    paper), or the recorded clip (fresh noise each time).
    """

    trainer: TrainerConfig = TrainerConfig(
        steps=600, log_every=30, optimizer=OptimizerConfig(learning_rate=2e-5, betas=(0.0, 0.999), warmup_steps=12)
    )
    fake_score_rate: float = Field(default=4.0, gt=0)
    sigma: SigmaSampling = SigmaSampling(shift=5.0)
    sigma_range: tuple[float, float] = (0.02, 0.98)
    weighting: LossWeighting = LossWeighting()
    target: Literal["teacher", "recorded"] = "teacher"
    auxiliary: AuxiliaryWeights = AuxiliaryWeights()

    @model_validator(mode="after")
    def _rising_range(self) -> Self:
        if not 0 < self.sigma_range[0] < self.sigma_range[1] <= 1:
            raise ValueError(f"sigma_range {self.sigma_range} must rise within (0, 1]")
        return self


class DistillConfig(StrictModel):
    """Stage III. What it trains, the model keeps: ``spec`` is saved with it and read by everything that rolls it out.

    ``block_size`` counts latent frames (4 in the paper: 16 video frames). ``sigmas``: nodes of the few-step sampler.
    ``input``: ``{kind: latents}`` reads what encode_latents cached; ``{kind: frames, ...}`` the recordings' frames, which
    are encoded when the teacher sees them; the trajectories keep the latents of their clips.
    ``last_step``: those after it are left out. Teacher forcing alone makes a good model of one step a block, ``sigmas: [1, 0]``
    (docs/experiments.md).
    ``action_following``: measured in each of the three steps; null measures nothing.
    ``lora``: each step trains adapters on the model before it, and distribution matching also on the score that follows the student,
    which then shares its other weights with the real score; null: all weights.
    """

    input: ClipInput = LatentInput()
    clips: ClipSampling = ClipSampling()
    splits: list[str] = Field(default=["train"], min_length=1)
    validation_splits: list[str] = Field(default=["validation"])
    views: list[str] = Field(default=["head", "left_wrist", "right_wrist"], min_length=1)
    block_size: int = Field(default=4, ge=1)
    window: WindowConfig = WindowConfig()
    sigmas: tuple[float, ...] = CAUSAL_SIGMAS
    last_step: DistillStep = "distribution_matching"
    action_following: ActionFollowingConfig | None = None
    lora: LoRAConfig | None = None
    teacher_forcing: TeacherForcingConfig = TeacherForcingConfig()
    trajectory_regression: TrajectoryRegressionConfig = TrajectoryRegressionConfig()
    distribution_matching: DistributionMatchingConfig = DistributionMatchingConfig()
    perceptual: PerceptualConfig = PerceptualConfig()
    lpips_weights: Path | None = Field(default=None, description="folder of the LPIPS weights; None: that term is off")

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if not {JOINT, SUBSET} >= (self.clips.view_weights or {}).keys():
            raise ValueError(
                "clips.view_weights: distillation clips hold all views (joint) or some (subset); set "
                "teacher_forcing.view_weights for the first step alone"
            )
        span = TEMPORAL_FACTOR * self.block_size
        odd = [length for length in self.clips.lengths if length <= span or (length - 1) % span]
        if odd:
            raise ValueError(
                f"clips.lengths {odd}: clips are one observed frame and whole blocks, 1 + k * {span} frames"
            )
        blocks = (max(self.clips.lengths) - 1) // span
        if (self.window.anchor_blocks or 0) > blocks:
            raise ValueError(
                f"window.anchor_blocks {self.window.anchor_blocks}: the longest clip has {blocks} blocks; train on longer clips"
            )
        steps, substeps = self.spec.steps, self.trajectory_regression.trajectories.substeps
        if len(substeps) != steps and self.last_step != "teacher_forcing":
            raise ValueError(f"trajectories.substeps {substeps}: one number per interval of sigmas is needed, {steps}")
        return self

    def weights_read(self) -> Mapping[str, Path | None]:
        return {"lpips": self.lpips_weights}

    @property
    def trainers(self) -> dict[DistillStep, TrainerConfig]:
        """The training of each step, up to the last one."""
        return {name: getattr(self, name).trainer for name in STEPS[: STEPS.index(self.last_step) + 1]}

    @property
    def first_clips(self) -> ClipSampling:
        first = self.teacher_forcing
        weights = first.view_weights or self.clips.view_weights
        mixed = {"view_weights": weights, "single_view_factor": first.single_view_factor}
        return self.clips.model_copy(update=mixed)

    @property
    def spec(self) -> CausalSpec:
        """Blocks, window and nodes of the distilled model.

        Of recent blocks it keeps no more than the longest clip has: it has never seen what is further back.
        """
        earlier_blocks = (max(self.clips.lengths) - 1) // (TEMPORAL_FACTOR * self.block_size) - 1
        return CausalSpec(
            block_size=self.block_size,
            sink_blocks=self.window.sink_blocks,
            recent_blocks=min(self.window.recent_blocks, earlier_blocks),
            anchor_blocks=self.window.anchor_blocks,
            sigmas=self.sigmas,
        )
