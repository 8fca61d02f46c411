"""Settings of training: noise, loss, loop, and the config of each training step. Without torch."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from worldline_core.config import ImageSize, StrictModel
from worldline_core.model.world_model_config import MixtureConfig, NetworkConfig, TextConfig
from worldline_core.processor import bfloat16_by_default
from worldline_core.training.clip_config import ClipInput, ClipSampling, LatentInput


class SigmaSampling(StrictModel):
    """Distribution of the noise level during training.

    ``uniform``: u ~ U(0, 1). ``logit_normal``: u = sigmoid(mean + std n). ``mode``: the "waver" map of Cosmos3 video
    training, u -> 1 - u - scale (cos^2(pi u / 2) - 1 + u). Then ``shift`` moves mass to high noise:
    sigma = shift u / (1 + (shift - 1) u).
    """

    kind: Literal["uniform", "logit_normal", "mode"] = "uniform"
    mean: float = 0.0
    std: float = Field(default=1.0, gt=0)
    mode_scale: float = Field(default=1.29, ge=-1, le=1.75)
    shift: float = Field(default=1.0, gt=0)


NonNegative = Annotated[float, Field(ge=0)]


class LossWeighting(StrictModel):
    """Weights of the squared velocity error.

    ``kind``: "velocity" leaves it as it is (the paper's objective); "sample" multiplies it by sigma^2, which is the
    squared error of the predicted clean latents (stable for models that predict the sample).
    ``motion``: extra weight of latent positions that differ from the clip's first frame: the weight is
    ``1 + motion * min(m / mean(m), motion_cap)`` with m the mean absolute change over channels, renormalised to
    mean one, so that a small model spends its capacity on what moves. 0 (the default) is the paper's objective.
    ``things``: extra weight of cells full of what the task moves, and of other things; needs the exact masks of recorded
    worlds. (0, 0) is the paper's objective.
    """

    kind: Literal["velocity", "sample"] = "velocity"
    motion: float = Field(default=0.0, ge=0)
    motion_cap: float = Field(default=5.0, gt=0)
    things: tuple[NonNegative, NonNegative] = (0.0, 0.0)


class ShardingConfig(StrictModel):
    """Sharding, recomputation and compilation of a model. None of it changes what is learnt.

    Attributes:
        shards: parts of every weight; None: as many as there are processes. With fewer, groups of this many processes
            hold one copy each, and gradients are summed over the copies: 8 on nodes of 8 GPUs keeps gathering within a
            node.
        checkpointing: "block" keeps the input of every transformer block and computes the block again on the way back.
        compile: torch.compile for the projections and the feed-forward half of each block.
        reduce_every_micro_step: sum gradients over processes after every micro-step, not once a step: with accumulation
            this saves a whole copy of the gradients on every device, and costs communication.
    """

    shards: int | None = Field(default=None, ge=1)
    checkpointing: Literal["none", "block"] = "none"
    compile: bool = False
    reduce_every_micro_step: bool = False


class SavingConfig(StrictModel):
    """Schedule of saved states besides ``save_every_steps``, and the ones that stay.

    Attributes:
        share: of the run's time that saving may take at most: after a save of 30 s the next begins 10 minutes later at
            0.05 (and never sooner than ``save_every_seconds``).
        keep: so many of the latest states stay.
        best: also keep the state at which this held-out loss was lowest ("loss", "rollout_error").
    """

    share: float = Field(default=0.05, gt=0, le=1)
    keep: int = Field(default=1, ge=1)
    best: str | None = None


class OptimizerConfig(StrictModel):
    """AdamW with linear warm-up, a plateau, and a linear decay to 0 over the last share ``decay`` of the run.

    ``moments``: "8bit" holds both moments in 8 bits, in blocks of 256 values with a scale each (torchao), for a quarter of the memory.
    """

    learning_rate: float = Field(default=1e-3, gt=0)
    betas: tuple[float, float] = (0.9, 0.95)
    weight_decay: float = Field(default=1e-6, ge=0)
    warmup_steps: int = Field(default=100, ge=0)
    decay: float = Field(default=0.0, ge=0, le=1)
    clip_norm: float = Field(default=1.0, gt=0)
    moments: Literal["fp32", "8bit"] = "fp32"


class TrainerConfig(StrictModel):
    """Length, batch and bookkeeping of a run.

    ``steps`` or ``minutes``: how long it trains; minutes are of its steps, without validation.
    ``batch_size`` counts examples per device and micro-step, ``accumulation`` micro-steps per device and step.
    ``global_batch`` fixes the examples of a step over all devices instead: how many micro-steps each takes follows from
    it, and the run learns the same on 8 or 64 devices.
    ``precision``: of what is computed; weights that are not trained are held in it, too. The default is bf16, or
    fp32 on a processor without native bfloat16. ``weights``: of the blocks' trained matrices,
    and so of their gradients; "bf16" rounds each update up or down at random, so that small ones are not lost.
    ``average``: where the moving average is, always in float32; "host" keeps it off the card.
    """

    steps: int | None = Field(default=None, ge=1)
    minutes: float | None = Field(default=None, gt=0)
    batch_size: int = Field(default=8, ge=1)
    accumulation: int = Field(default=1, ge=1)
    seed: int = Field(default=0, ge=0)
    optimizer: OptimizerConfig = OptimizerConfig()
    ema_decay: float = Field(default=0.999, ge=0, lt=1)
    weights: Literal["fp32", "bf16"] = "fp32"
    average: Literal["device", "host"] = "device"
    device: str = "cpu"
    precision: Literal["fp32", "bf16"] = Field(
        default_factory=lambda given: "bf16" if bfloat16_by_default(given) else "fp32"
    )
    log_every: int = Field(default=20, ge=1)
    validate_every: int = Field(default=0, ge=0, description="0: only after the last step")
    validation_batches: int = Field(default=4, ge=0)
    save_every_seconds: float = Field(default=20.0, ge=0)
    save_every_steps: int = Field(default=0, ge=0, description="0: by time only")
    global_batch: int | None = Field(default=None, ge=1)
    sharding: ShardingConfig = ShardingConfig()
    saving: SavingConfig = SavingConfig()

    @model_validator(mode="after")
    def _one_length_and_whole_micro_batches(self) -> Self:
        if (self.steps is None) == (self.minutes is None):
            raise ValueError("give steps or minutes, one of the two")
        if self.global_batch is not None and self.global_batch % self.batch_size:
            raise ValueError(f"global_batch ({self.global_batch}) must be a multiple of batch_size ({self.batch_size})")
        if self.global_batch is not None and self.accumulation != 1:
            raise ValueError("accumulation follows from global_batch and the number of processes: give one of the two")
        if self.weights == "bf16" and self.precision == "fp32":
            raise ValueError("weights in bf16 are computed with in bf16: set precision to bf16, or weights to fp32")
        return self

    def fraction(self, step: int, seconds: float) -> float:
        """Share of the run that is done after so many steps, which took so many seconds."""
        return step / self.steps if self.steps else seconds / (60 * (self.minutes or 1))


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
    cached_clips: int = Field(default=20000, ge=0, description="clips whose similarity matrices stay in memory")


class ActionFollowingConfig(StrictModel):
    """Measurement while a model trains: how far its tools are from where held-out controls put them.

    ``clips``: held-out clips in which a tool moves. ``seconds``: after which the picture is looked at. ``steps``: Euler steps of a
    Stage II model. ``share``: of the run's time that measuring may take; the last step is always measured.
    ``stop_when_ignored``: steps from which on a model whose controls make no difference ends the run.
    """

    clips: int = Field(default=16, ge=4)
    seconds: float = Field(default=1.0, gt=0)
    steps: int = Field(default=4, ge=1)
    share: float = Field(default=0.05, gt=0, le=1)
    stop_when_ignored: int | None = Field(default=None, ge=1)


class LoRAConfig(StrictModel):
    """Adapters in place of full fine-tuning: ``W + scale B A`` with ``rank`` columns of B and rows of A, on attention and feed-forward
    of the video tower. Action branches and view embedding are trained in full, everything else stays as it is.
    """

    rank: int = Field(default=16, ge=1)
    scale: float = Field(default=2.0, gt=0)


class MergeAdapterConfig(StrictModel):
    """Nothing to set: an adapter says what it becomes."""


class StageConfig(StrictModel):
    """Settings that both stages share: clips, loss and run.

    ``input``: ``{kind: latents}`` reads what encode_latents cached; ``{kind: frames, ...}`` reads the recordings' frames
    and encodes them during training.
    ``outcomes``: only episodes that ended so (``[success]``); None takes all. No outcome reaches the model either way.
    ``lora``: train adapters alone; null: all weights.
    """

    trainer: TrainerConfig
    input: ClipInput = LatentInput()
    clips: ClipSampling = ClipSampling()
    splits: tuple[str, ...] = ("train",)
    validation_splits: tuple[str, ...] = ("validation",)
    outcomes: tuple[str, ...] | None = Field(default=None, min_length=1)
    sigma: SigmaSampling = Field(default_factory=SigmaSampling)
    weighting: LossWeighting = Field(default_factory=LossWeighting)
    lora: LoRAConfig | None = None


class Stage1Config(StageConfig):
    """``model`` describes a model that starts from scratch; with the input ``base``, that checkpoint's own is used.

    ``text_tower``: "frozen" leaves it as it is in ``base``; so does "stored", which keeps its keys and values of every prompt in the
    machine's memory instead of it (for few prompts).
    """

    kind: Literal["base", "stage1"] = "stage1"
    model: NetworkConfig = Field(default_factory=lambda: MixtureConfig.model_validate({}))
    clips: ClipSampling = ClipSampling(view_weights={"primary": 1.0})
    text: TextConfig = TextConfig()
    text_dropout: float = Field(default=0.1, ge=0, le=1)
    text_tower: Literal["trained", "frozen", "stored"] = "trained"

    @model_validator(mode="after")
    def _adapters_leave_the_text(self) -> Self:
        if self.lora is not None and self.text_tower == "trained":
            raise ValueError(
                "lora adapts the video tower: set text_tower to frozen, or to stored where prompts are few"
            )
        if self.text.kind == self.text_tower == "stored":
            raise ValueError("text_tower stored is for a tower that reads texts; a model of stored embeddings has none")
        return self

    def weights_read(self) -> Mapping[str, Path | None]:
        return self.text.files_read()


class Stage2Config(StageConfig):
    """Starts from a base or Stage I checkpoint, or goes on with a Stage II checkpoint.

    ``action_multiplier``: learning-rate multiplier of the zero-initialised action branch (66 at full size).
    ``action_frames``: control frames whose maps a latent frame takes: its own (1, the paper's), or all 4 of its interval,
    for grippers that close faster than a latent frame. Those that the start does not know begin with weights of zero.
    ``relational``: null trains without these terms. How wide the maps' Gaussian is, the action tracks say.
    ``native_size``: the model also takes control vectors, padded to this size, by FiLM in every layer, for views whose camera is
    not known. ``vector_share``: how often a view with a camera takes the vector instead of the map; 1: always, and the model has no
    maps (the paper's ablation).
    ``action_following``: needs the input tokenizer; null measures nothing.
    """

    action_multiplier: float = Field(default=66.0, gt=0)
    action_dropout: float = Field(default=0.0, ge=0, lt=1)
    action_frames: Literal[1, 4] = 1
    relational: RelationalConfig | None = RelationalConfig()
    native_size: int | None = Field(default=None, ge=1)
    vector_share: float = Field(default=0.3, gt=0, le=1)
    action_following: ActionFollowingConfig | None = None


BLOCKS = 4


class SmallTeacherShape(StrictModel):
    """Size of the encoder. ``patch`` is the side of a tubelet in pixels of ``image_size`` (height, width)."""

    image_size: ImageSize = (64, 96)
    patch: int = Field(default=16, ge=2)
    max_groups: int = Field(default=33, ge=2, description="longest clip in latent frames")
    hidden_size: int = Field(default=128, ge=8)
    num_layers: int = Field(default=6, ge=BLOCKS)
    num_heads: int = Field(default=4, ge=1)


class TeacherConfig(StrictModel):
    """Masked-video training. ``hidden``: share of tubelets that are hidden (the first frame stays visible)."""

    shape: SmallTeacherShape = SmallTeacherShape()
    trainer: TrainerConfig = TrainerConfig(
        steps=600, batch_size=12, ema_decay=0.99, optimizer=OptimizerConfig(learning_rate=1e-3, decay=1 / 3)
    )
    splits: tuple[str, ...] = ("train",)
    max_episodes: int = Field(default=120, ge=2)
    held_out_episodes: int = Field(default=8, ge=1)
    clip_frames: int = Field(default=17, ge=5)
    hidden: float = Field(default=0.75, gt=0, lt=1)


class TokenizerConfig(StrictModel):
    """Everything the shipped tokenizer depends on.

    ``refinement_width`` and ``refinement_depth`` are also the size of a small decoder for the latents of an ``encoder``;
    ``channels``, ``motion_weight``, ``whitening`` and ``fit_clips`` have no meaning then.
    """

    image_size: ImageSize = (64, 96)
    channels: int = Field(default=32, ge=1)
    motion_weight: float = Field(default=4.0, ge=0)
    whitening: float = Field(default=0.5, ge=0, le=1)
    refinement_width: int = Field(default=48, ge=4)
    refinement_depth: int = Field(default=2, ge=1)
    splits: tuple[str, ...] = ("train",)
    held_out_splits: tuple[str, ...] = ("validation", "test")
    max_episodes: int | None = Field(default=None, ge=1)
    held_out_episodes: int = Field(default=12, ge=0)
    clip_frames: int = Field(default=33, ge=5)
    fit_clips: int = Field(default=600, ge=1)
    steps: int = Field(default=4000, ge=0)
    batch_size: int = Field(default=8, ge=1)
    """Clips per step; each gives its first frame and three groups of four frames."""
    learning_rate: float = Field(default=2e-3, gt=0)
    warmup_steps: int = Field(default=100, ge=0)
    average_decay: float = Field(default=0.998, ge=0, lt=1)
    reference_dropout: float = Field(default=0.1, ge=0, le=1)
    disturbance: float = Field(default=0.3, ge=0)
    """Largest standard deviation of the noise added to the codes of the groups (0 trains on exact codes only)."""
    edge_weight: float = Field(default=10.0, ge=0)
    """Weight of the difference between the strength of decoded and true edges, which keeps uncertain ones sharp."""
    seed: int = Field(default=0, ge=0)
    checkpoint_every: int = Field(default=500, ge=1)
    device: str = "cpu"
    bfloat16: bool = Field(default_factory=bfloat16_by_default)

    @property
    def trainer(self) -> TrainerConfig:
        """The training loop of the decoder."""
        return TrainerConfig(
            steps=self.steps,
            batch_size=self.batch_size,
            seed=self.seed,
            optimizer=OptimizerConfig(learning_rate=self.learning_rate, betas=(0.9, 0.99), weight_decay=1e-4),
            ema_decay=self.average_decay,
            precision="bf16" if self.bfloat16 else "fp32",
            device=self.device,
            save_every_steps=self.checkpoint_every,
        )

    def schedule(self, step: int) -> float:
        """Factor on the learning rate: a linear warm-up times a half cosine down to 0."""
        warm = min(1.0, (step + 1) / max(self.warmup_steps, 1))
        return warm * 0.5 * (1 + math.cos(math.pi * step / self.steps))
