"""Configuration of the evaluation steps and of the segmenter's training; imports no torch."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, field_validator, model_validator

from worldline_core.config import ImageSize, StrictModel
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.evaluation.metric_registry import METRICS, ON_REQUEST
from worldline_core.processor import processor_has_bfloat16
from worldline_core.training.training_config import OptimizerConfig, TrainerConfig
from worldline_core.untrusted_text import carries_credentials


class VLMConfig(StrictModel):
    """A local Qwen3-VL folder, or a server whose key is in an environment variable."""

    weights: Path | None = Field(default=None, description="local Qwen3-VL folder")
    url: str | None = Field(default=None, description="OpenAI-compatible server, up to and with /v1")
    model: str = Field(default="Qwen/Qwen3-VL-8B-Instruct", description="the server's name of the model")
    api_key_variable: str = "OPENAI_API_KEY"
    timeout_s: float = Field(default=120.0, gt=0, description="for a whole answer")
    attempts: int = Field(default=3, ge=1)

    @field_validator("url")
    @classmethod
    def _no_credentials(cls, url: str | None) -> str | None:
        if url is not None and carries_credentials(url):
            raise ValueError("the address carries a password or a key, which would be written into manifests")
        return url


SegmenterName = Literal["learned", "colour", "sam3"]


class _NetworkTraining(StrictModel):
    """Training of a small network of the evaluation."""

    WEIGHT_DECAY: ClassVar[float] = 1e-4

    steps: int = Field(default=1000, ge=1)
    batch_size: int = Field(default=24, ge=1)
    learning_rate: float = Field(default=3e-3, gt=0)
    checkpoint_every: int = Field(default=200, ge=1)
    seed: int = Field(default=42, ge=0)
    bfloat16: bool = Field(default_factory=processor_has_bfloat16, description="compute in mixed precision")

    @property
    def trainer(self) -> TrainerConfig:
        """The training loop; every step's loss is logged."""
        return TrainerConfig(
            steps=self.steps,
            batch_size=self.batch_size,
            seed=self.seed,
            optimizer=OptimizerConfig(
                learning_rate=self.learning_rate, betas=(0.9, 0.999), weight_decay=self.WEIGHT_DECAY
            ),
            ema_decay=0.995,
            precision="bf16" if self.bfloat16 else "fp32",
            log_every=1,
            save_every_steps=self.checkpoint_every,
        )

    def schedule(self, step: int) -> float:
        """Factor on the learning rate: linear warm-up over 5 % of the steps, then a half cosine to 1 %."""
        warmup = max(1, self.steps // 20)
        if step < warmup:
            return (step + 1) / warmup
        progress = (step - warmup) / max(1, self.steps - warmup)
        return 0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * progress))


class SegmenterConfig(_NetworkTraining):
    """Size and training of the learned segmenter."""

    labels: Literal["exact", "kinematic"] = Field(
        default="exact",
        description="masks to learn: exact ones; kinematic: also of episodes without, where the head camera is known",
    )
    widths: tuple[int, ...] = Field(
        default=(8, 24, 48, 96), min_length=2, description="channels, finest resolution first; multiples of 8"
    )
    image_size: ImageSize | None = Field(default=None, description="(height, width) to resize to; none: as stored")
    frame_stride: int = Field(default=2, ge=1, description="every n-th frame of a training episode is used")


class JudgeConfig(_NetworkTraining):
    """Size, training and calibration of the learned judge."""

    WEIGHT_DECAY: ClassVar[float] = 0.05

    image_size: ImageSize = Field(default=(64, 96), description="(height, width) of what it sees: that of predictions")
    widths: tuple[int, ...] = Field(
        default=(32, 64, 96, 128), min_length=1, description="channels, from half resolution on; multiples of 8"
    )
    steps: int = Field(default=3000, ge=1)
    learning_rate: float = Field(default=1e-3, gt=0)
    disturbance: float = Field(
        default=0.3,
        ge=0,
        description="noise on the codes of frames that pass the input tokenizer, as of train_tokenizer",
    )
    least_right: float = Field(
        default=0.97, gt=0.5, le=1, description="of the verdicts on validation recordings outside of the undecided band"
    )

    @property
    def trainer(self) -> TrainerConfig:
        """The training loop; validation recordings are judged with every checkpoint."""
        return super().trainer.model_copy(update={"validate_every": self.checkpoint_every})


class VideoEvaluationConfig(StrictModel):
    """Views, segmenters and metrics of evaluate_video."""

    views: tuple[Literal["head", "left_wrist", "right_wrist"], ...] = VIEWS
    segmenters: tuple[SegmenterName, ...] = Field(
        default=("learned",), min_length=1, description="the first one names the metrics without a suffix"
    )
    sam3_weights: Path | None = Field(default=None, description="local folder of SAM 3 weights")
    lpips_weights: Path | None = Field(default=None, description="local folder of LPIPS weights; none: not available")
    metrics: tuple[str, ...] = Field(default=(), description="further metrics: " + ", ".join(ON_REQUEST))
    changed_controls: dict[str, dict[Literal["shuffled", "mirrored", "delayed"], str]] = Field(
        default={}, description="by method, the methods that are the same model under changed controls"
    )
    resamples: int = Field(default=2000, ge=100)
    seed: int = Field(default=42, ge=0)

    @field_validator("metrics")
    @classmethod
    def _known(cls, metrics: tuple[str, ...]) -> tuple[str, ...]:
        if not {*metrics} <= {*ON_REQUEST} or len({*metrics}) != len(metrics):
            raise ValueError(f"No metrics on request: expected some of {', '.join(ON_REQUEST)}, each once")
        return metrics

    def of_methods(self, methods: Collection[str]) -> Self:
        """The same for fewer methods: pairs of which one is not predicted are not compared."""
        pairs = {
            method: kept
            for method, changes in self.changed_controls.items()
            if method in methods and (kept := {c: other for c, other in changes.items() if other in methods})
        }
        return self.model_copy(update={"changed_controls": pairs})

    @model_validator(mode="after")
    def _pairs_are_compared(self) -> Self:
        compared = any(METRICS[name].needs == "changed_controls" for name in self.metrics)
        if self.changed_controls and not compared:
            raise ValueError(
                "changed_controls go with a metric that compares them: action_following, counterfactual_direction"
            )
        return self

    def weights_read(self) -> Mapping[str, Path | None]:
        return {
            "sam3": self.sam3_weights if "sam3" in self.segmenters else None,
            "lpips": self.lpips_weights,
        }


class TrustConfig(StrictModel):
    """Thresholds of the mark "do not trust" on verdicts."""

    novelty_level: float = Field(
        default=0.05, gt=0, lt=0.5, description="share of the training recordings whose own novelty is above 1"
    )
    least_trust: float = Field(
        default=0.6, ge=0, le=1, description="verdicts less likely to be right than this are marked"
    )
    compare_with: dict[str, str] = Field(
        default={}, description="by method, another one whose verdicts are compared: disagreement lowers trust"
    )


JudgeName = Literal["measured", "learned", "qwen3_vl", "openai"]


class _Judging(StrictModel):
    """The judge of predicted videos, or the selector among them, and the intervals of the results."""

    vlm: VLMConfig = VLMConfig()
    segmenter: SegmenterName = Field(default="learned", description="used by the measured judge or selector")
    sam3_weights: Path | None = None
    views: tuple[Literal["head", "left_wrist", "right_wrist"], ...] = VIEWS
    resamples: int = Field(default=2000, ge=100)
    seed: int = Field(default=42, ge=0)

    def _weights(self, judge: JudgeName) -> Mapping[str, Path | None]:
        return {
            "sam3": self.sam3_weights if judge == "measured" and self.segmenter == "sam3" else None,
            "vlm": self.vlm.weights if judge == "qwen3_vl" else None,
        }


class PolicyEvaluationConfig(_Judging):
    """Judge and trajectories of evaluate_policy."""

    judge: JudgeName = "measured"
    splits: tuple[str, ...] = ("test", "ood_test")
    balanced: bool = True
    compare_policies: bool = Field(
        default=False,
        description="sources of the episodes are policies: compare their recorded and predicted success rates",
    )
    trust: TrustConfig | None = Field(
        default=None,
        description="trust in each verdict; novelty is measured against the training splits of the episodes",
    )

    @model_validator(mode="after")
    def _all_attempts(self) -> PolicyEvaluationConfig:
        if self.compare_policies and self.balanced:
            raise ValueError("compare_policies needs every attempt: set balanced: false")
        return self

    def weights_read(self) -> Mapping[str, Path | None]:
        return self._weights(self.judge)


class PlanningConfig(_Judging):
    """Selector and budgets of evaluate_planning."""

    selector: JudgeName = "measured"
    budgets: tuple[Annotated[int, Field(ge=1)], ...] = Field(default=(2, 4, 8, 16, 24, 32), min_length=1)
    runs: int = Field(
        default=5, ge=1, description="orders of each bank's candidates; smaller budgets are prefixes of an order"
    )

    def weights_read(self) -> Mapping[str, Path | None]:
        return self._weights(self.selector)
