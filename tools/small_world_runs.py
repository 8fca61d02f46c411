"""Plans of what to train on the small world, and runs of a given number of seconds."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from pydantic import Field
from torch import Tensor
from torch._dynamo import config as compiler

from worldline_core.config import StrictModel
from worldline_core.errors import TrainingError
from worldline_core.model.world_model_config import WorldModelConfig
from worldline_core.training.exponential_average import ExponentialAverage
from worldline_core.training.trainer import ParameterGroup
from worldline_core.training.training_config import SigmaSampling


class Timed(StrictModel):
    """A run: its length, which leaves out compilation and measuring, and its peak learning rate."""

    seconds: float = Field(gt=0)
    batch: int = Field(ge=1)
    lr: float = Field(gt=0)


class TokenizerSettings(StrictModel):
    """`wait`: recordings, in the order of their files, that are waited for and fitted to."""

    seconds: float = Field(gt=0)
    channels: int = Field(default=32, ge=1)
    width: int = Field(default=48, ge=4)
    depth: int = Field(default=2, ge=1)
    wait: int = Field(default=600, ge=1)


class BaseSettings(Timed):
    """Text and the first frame to one view."""

    batch: int = Field(default=512, ge=1)
    lr: float = Field(default=2e-3, gt=0)


class Stage2Settings(Timed):
    """Controls and the first frames to three views.

    ``things``: extra weight of what the task moves, and of other things. ``decay``: the share of the time over which
    the learning rate falls to 0. ``poll``: take in recordings that come during the run.
    """

    batch: int = Field(default=256, ge=1)
    lr: float = Field(default=2e-3, gt=0)
    sigma: SigmaSampling = SigmaSampling(shift=3.0)
    motion: float = Field(default=1.0, ge=0)
    things: tuple[float, float] = (0.0, 0.0)
    action_dropout: float = Field(default=0.05, ge=0, lt=1)
    action_multiplier: float = Field(default=1.0, gt=0)
    decay: float = Field(default=0.35, gt=0, le=1)
    ema: float = Field(default=0.999, ge=0, lt=1)
    compile: bool = False
    poll: bool = True


class Stage2Plan(Stage2Settings):
    """``start``: from the base model in the output folder, or from nothing."""

    start: Literal["base", "scratch"] = "base"


class Variant(Stage2Settings):
    """Settings to compare; every variant starts from nothing."""

    model: WorldModelConfig = WorldModelConfig(prediction="first_frame_residual", first_frame_std=0.75)


class ForcingSettings(Timed):
    """Teacher forcing. ``history_noise``: largest standard deviation of noise on the clean blocks that a block sees."""

    batch: int = Field(default=192, ge=1)
    lr: float = Field(default=1e-3, gt=0)
    sigma: SigmaSampling = SigmaSampling(shift=5.0)
    history_noise: float = Field(default=0.0, ge=0)
    compile: bool = False


class RegressionSettings(Timed):
    """Trajectory regression, on trajectories of ``batches`` times ``clips`` clips."""

    batches: int = Field(default=16, ge=1)
    clips: int = Field(default=192, ge=3)
    batch: int = Field(default=96, ge=1)
    lr: float = Field(default=1e-4, gt=0)


class MatchingSettings(Timed):
    """Distribution matching; the fake score learns four times as fast."""

    batch: int = Field(default=48, ge=1)
    lr: float = Field(default=2e-5, gt=0)


class CausalSettings(StrictModel):
    """The three steps of Stage III, each from the one before.

    ``long_every``: every so many batches of the first two steps are a third as many cuts of 65 frames of long
    recordings, so that the model meets a window that moves; 0 does without them.
    """

    long_every: int = Field(default=4, ge=0)
    teacher_forcing: ForcingSettings
    trajectory_regression: RegressionSettings | None = None
    distribution_matching: MatchingSettings | None = None


class Plan(StrictModel):
    """What to train. ``model``: the model of the sections base and stage2, where they start from nothing."""

    model: WorldModelConfig = WorldModelConfig(prediction="first_frame_residual", first_frame_std=0.75)
    tokenizer: TokenizerSettings | None = None
    base: BaseSettings | None = None
    stage2: Stage2Plan | None = None
    causal: CausalSettings | None = None
    variants: dict[str, Variant] = Field(default_factory=dict)


def cosine(done: float) -> float:
    """Factor on the learning rate when a share of the time is over: half a cosine down to 0."""
    return 0.5 * (1 + math.cos(math.pi * done))


def plateau(done: float, last: float = 0.35) -> float:
    """Factor on the learning rate: 1, then down to 0 over the last share of the time."""
    return min(1.0, (1 - done) / last)


@dataclass(frozen=True, kw_only=True)
class Run:
    """AdamW for a number of seconds, after which the parameters hold their average.

    Attributes:
        warmup: steps over which the learning rate rises.
        schedule: factor on the learning rate as a function of the share of the time that is over.
        ema: decay of the average.
    """

    title: str
    groups: list[ParameterGroup]
    seconds: float
    lr: float
    warmup: int = 100
    schedule: Callable[[float], float] = plateau
    ema: float = 0.999
    betas: tuple[float, float] = (0.9, 0.95)
    weight_decay: float = 1e-6

    def train(self, loss_of: Callable[[int], Tensor], poll: Callable[[], None] | None = None) -> dict[str, float]:
        """Train on the loss of each step; steps, seconds and the last loss.

        Args:
            poll: called every eight seconds, to take in new recordings.

        Raises: TrainingError when the loss is not finite.
        """
        named = {f"{group.name}/{name}": p for group in self.groups for name, p in group.parameters.items()}
        optimizer = torch.optim.AdamW(
            [{"params": list(group.parameters.values())} for group in self.groups],
            betas=self.betas,
            weight_decay=self.weight_decay,
            fused=True,
        )
        average = ExponentialAverage(named, self.ema)
        losses: list[Tensor] = []
        started = polled = reported = time.monotonic()
        while (elapsed := time.monotonic() - started) < self.seconds:
            step = len(losses)
            factor = min(1.0, (step + 1) / self.warmup) * self.schedule(elapsed / self.seconds)
            for slot, group in zip(optimizer.param_groups, self.groups, strict=True):
                slot["lr"] = self.lr * group.multiplier * factor
            optimizer.zero_grad(set_to_none=True)
            loss = loss_of(step)
            loss.backward()
            torch.nn.utils.clip_grad_norm_(named.values(), 1.0)
            optimizer.step()
            average.update(step)
            losses.append(loss.detach())
            if poll is not None and time.monotonic() - polled > 8:
                poll()
                polled = time.monotonic()
            # Rarely: reading a loss waits for the device.
            if time.monotonic() - reported > 15:
                print(
                    f"{self.title}: step {step + 1}, {elapsed:.0f} s, loss {self._mean(losses[-50:]):.4f}", flush=True
                )
                reported = time.monotonic()
        last = self._mean(losses[-100:])
        with torch.no_grad():
            for name, parameter in named.items():
                parameter.copy_(average.average[name])
        return {"steps": len(losses), "seconds": round(time.monotonic() - started, 1), "loss": round(last, 5)}

    def _mean(self, losses: list[Tensor]) -> float:
        mean = float(torch.stack(losses).mean())
        if not math.isfinite(mean):
            raise TrainingError("The loss is not finite", where=self.title, next_step="lower the learning rate")
        return mean


def compile_now(title: str, loss_of: Callable[[int], Tensor], steps: tuple[int, ...]) -> None:
    """Take these steps for their shapes alone: compilation is not training time."""
    # Each model compiles the same code anew, and each shape does.
    compiler.recompile_limit = 64
    begun = time.monotonic()
    for step in steps:
        loss_of(step).backward()
    print(f"{title}: compiled in {time.monotonic() - begun:.0f} s", flush=True)
