"""The training loop of every model that is trained here: optimiser, averages, metrics, and a state to continue from.

A model states its parameters, its objective and its batches; see `train`. With torchrun, several processes share every
step and every weight (`processes.py`).
"""

from __future__ import annotations

import hashlib
import json
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import torch
from safetensors.torch import save
from torch import Tensor, nn

from worldline_core.errors import ConfigError, StoppedError, TrainingError
from worldline_core.progress import Progress
from worldline_core.store.atomic import write_bytes_atomic
from worldline_core.training.optimizers import clip_gradients, make_optimizer, set_learning_rate, update_weights
from worldline_core.training.processes import (
    BatchPlan,
    average_values,
    processes,
    reduce_gradients,
    reporting_lost_processes,
    whole,
)
from worldline_core.training.training_config import OptimizerConfig, TrainerConfig
from worldline_core.training.training_state import (
    PROBE_LOG,
    ExponentialAverage,
    MetricsLog,
    RunningMeans,
    TrainingStates,
    identity_digests,
    nan_to_null,
    newest_state,
)


@dataclass(frozen=True)
class ParameterGroup:
    """Parameters that share a learning-rate multiplier; ``averaged``: whether their moving average is wanted."""

    name: str
    parameters: Mapping[str, nn.Parameter]
    multiplier: float = 1.0
    averaged: bool = True


def trained_groups(*groups: ParameterGroup) -> list[ParameterGroup]:
    """The groups, without parameters that are not trained; groups that are then empty are left out."""
    trained = [
        replace(group, parameters={name: value for name, value in group.parameters.items() if value.requires_grad})
        for group in groups
    ]
    return [group for group in trained if group.parameters]


class NamedBatch(Protocol):
    """A batch names its examples, so that they can be counted and an error can say which they were."""

    @property
    def names(self) -> Sequence[str]: ...


class Objective[BatchT: NamedBatch](Protocol):
    """Loss of a training. Objectives that train all groups at once, without a state, inherit what follows `loss`."""

    def loss(self, batch: BatchT, generator: torch.Generator, step: int) -> tuple[Tensor, dict[str, float]]:
        """The loss of one micro-batch, and values to log beside it."""
        ...

    def trained_group(self, step: int) -> str | None:
        """The parameter group that ``step`` trains, where groups take turns; None: all of them."""
        del step
        return None

    def end_step(self, values: Mapping[str, float]) -> None:
        """Take note of a step's mean values over its micro-steps and all processes."""
        del values

    def state(self) -> dict[str, Any]:
        """JSON values that change from step to step (loss scales): saved with the run."""
        return {}

    def load_state(self, state: dict[str, Any]) -> None:
        """Continue from saved values."""
        del state


class Probe(Protocol):
    """A measurement of the averaged weights that takes its share of the run's time, and is always made after the last step."""

    def due(self, seconds: float) -> bool:
        """True when it is to be made, so many seconds after the run began or continued."""
        ...

    def measure(self, step: int) -> dict[str, float]:
        """Values to log. Raises: TrainingError: the run is to end."""
        ...


@dataclass(frozen=True)
class TrainingResult:
    """Averaged weights of the trained parameters, the last metrics, and the steps taken."""

    average: dict[str, Tensor]
    metrics: dict[str, float]
    steps: int


def learning_rate_factor(config: OptimizerConfig, step: int, fraction: float) -> float:
    """Factor on the base rate at ``step`` (0-based), before which ``fraction`` of the run was done."""
    warmup = min(1.0, (step + 1) / config.warmup_steps) if config.warmup_steps else 1.0
    return warmup * (min(1.0, (1 - fraction) / config.decay) if config.decay else 1.0)


def step_generator(seed: int, index: int, device: str) -> torch.Generator:
    """The random stream of one micro-step: it depends on (seed, index) only, so nothing has to be carried over."""
    digest = hashlib.blake2b(f"{seed}/{index}".encode(), digest_size=8).digest()
    return torch.Generator(device).manual_seed(int.from_bytes(digest) >> 1)


def autocast(config: TrainerConfig) -> AbstractContextManager[object]:
    """bf16 matrix products where the config asks for them; weights and optimiser stay in float32."""
    if config.precision == "fp32":
        return nullcontext()
    return torch.autocast(torch.device(config.device).type, dtype=torch.bfloat16)


def held_out_losses[BatchT](
    config: TrainerConfig,
    load: Callable[[int], BatchT],
    losses: Callable[[BatchT, torch.Generator], Mapping[str, float]],
    seed: int,
) -> dict[str, float]:
    """Mean of ``losses`` over the first ``validation_batches`` that ``load`` gives, each time with the same noise."""
    means = RunningMeans()
    for index in range(config.validation_batches):
        batch = load(index)
        with autocast(config):
            means.add(losses(batch, step_generator(seed, index, config.device)))
    return means.values()


def batch_plan(config: TrainerConfig, output: Path) -> BatchPlan:
    """Distribution of a run's micro-batches: from its saved state, else from the configuration.

    Raises: ConfigError: they cannot be shared out evenly. ArtifactError: the saved state is damaged.
    """
    state = newest_state(output)
    if state is not None:
        return BatchPlan.of(state["micro_batches"], state["drawn_together"])
    if config.global_batch is None:
        return BatchPlan.of(config.accumulation * processes()[1])
    # Drawn as one, whatever the number of processes: all have clips of one length at a time, and the same clips.
    per_step = config.global_batch // config.batch_size
    return BatchPlan.of(per_step, per_step)


@contextmanager
def stop_requests() -> Iterator[Callable[[], bool]]:
    """A function that tells whether a scheduler has asked to stop (SIGTERM); outside of the main thread never."""
    received: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    before = signal.signal(signal.SIGTERM, lambda number, _frame: received.append(number))
    try:
        yield lambda: bool(received)
    finally:
        signal.signal(signal.SIGTERM, before)


def train[BatchT: NamedBatch](
    config: TrainerConfig,
    *,
    groups: Sequence[ParameterGroup],
    objective: Objective[BatchT],
    load: Callable[[int], BatchT],
    validate: Callable[[], dict[str, float]] | None = None,
    probe: Probe | None = None,
    output: Path,
    identity: Mapping[str, Any],
    title: str,
    schedule: Callable[[int], float] | None = None,
    models: Sequence[nn.Module] = (),
) -> TrainingResult:
    """Train for ``config.steps`` or ``config.minutes``; called again with the same ``output``, it continues from the last
    saved state, with the steps or the time that are left.

    On a CPU the result of so many steps does not depend on where it was interrupted; with other processes sums have another
    order. Minutes count the steps alone, not validation.

    Args:
        load: number of this process's micro-step to batch (a pure function; `BatchPlan` says which clips it has).
        validate: measures held-out losses; called with the averaged weights in the model.
        probe: measures the averaged weights after the last step, and before where its share of the time allows: the clock decides
            when, so its values are logged under ``run/``, and those after the last step among the metrics.
        output: ``metrics.jsonl`` is written here, the state to continue from and timings under ``run/``.
        identity: JSON values that name this run (config, start, clips); a state of another run is refused.
        schedule: factor on the base learning rate per step (0-based); by default `learning_rate_factor`.
        models: the trained models, where processes share them (`place_model`).

    Raises:
        TrainingError: if a loss or the gradient is not finite, a state cannot be written, or another process has ended.
        ArtifactError: if a saved state is damaged or belongs to another run.
        StoppedError: the run was asked to stop (SIGTERM); its state is saved.
    """
    if not any(group.parameters for group in groups):
        raise ConfigError("There is nothing to train.", where=title, expected="at least one trainable parameter")
    run = TrainingRun(config, groups, objective, load, models, output, title)
    settings, states, average = config.optimizer, run.states, run.average
    digests = identity_digests(identity)
    done, seconds, best = 0, 0.0, math.inf
    means, last = RunningMeans(), dict[str, float]()
    if (facts := states.load(digests)) is not None:
        done, seconds, last = facts["step"], facts["seconds"], facts["last"]
        means, average.updates = RunningMeans(facts["means"]), facts["updates"]
        best = math.inf if facts["best"] is None else facts["best"]
        objective.load_state(facts["objective"])
    rank, world_size = processes()
    names = ("metrics.jsonl", "run/timings.jsonl", PROBE_LOG)
    log, timings, probed = (MetricsLog(output / name, done) for name in names)
    began = saved_at = time.monotonic()
    seen = 0
    length = config.steps or round(60 * (config.minutes or 0))
    progress = Progress(title, length, "step" if config.steps else "second", done=done, shown=rank == 0)
    with progress, stop_requests() as stop_requested, reporting_lost_processes(title), states:
        while (fraction := config.fraction(done, seconds)) < 1:
            factor = schedule(done) if schedule else learning_rate_factor(settings, done, fraction)
            for slot, group in zip(run.optimizer.param_groups, groups, strict=True):
                set_learning_rate(slot, settings.learning_rate * group.multiplier * factor)
            step_began = time.monotonic()
            values, size = run.step(done)
            if config.minutes:  # clocks differ from process to process
                seconds += average_values({"seconds": time.monotonic() - step_began})["seconds"]
            means.add(values)
            done += 1
            seen += size * world_size
            ended = config.fraction(done, seconds) >= 1
            if done % config.log_every == 0 or ended:
                current, means = means.values(), RunningMeans()
                last = {**last, **current}
                elapsed = time.monotonic() - began
                log.add({"step": done, "learning_rate": settings.learning_rate * factor, **current})
                timings.add({"step": done, "seconds": elapsed, "clips_per_second": seen / elapsed})
            score = math.inf
            if validate is not None and (ended or (config.validate_every and done % config.validate_every == 0)):
                with average.swapped(), torch.no_grad():
                    scores = average_values({f"validation/{key}": value for key, value in validate().items()})
                log.add({"step": done, **scores})
                run.require_finite_scores(scores, done)
                last = {**last, **scores}
                score = scores.get(f"validation/{config.saving.best}", math.inf)
            if probe is not None and (ended or average_values({"due": probe.due(time.monotonic() - began)})["due"]):
                with average.swapped(), torch.no_grad():
                    found = probe.measure(done)
                probed.add({"step": done, **found})
                if ended:
                    last = {**last, **found}
            advanced = 1 if config.steps else round(min(seconds, length)) - progress.done
            progress.advance(advanced, clips=size * world_size, loss=last.get("loss", values["loss"]))
            better, best = score < best, min(best, score)
            # Signals, too, differ from process to process: what one decides, all do.
            failure = states.collect()
            pause = max(config.save_every_seconds, states.seconds / config.saving.share)
            late = rank == 0 and not states.busy and time.monotonic() - saved_at >= pause
            asked = average_values({"save": late, "stop": stop_requested(), "failed": failure is not None})
            if asked["failed"]:
                raise states.failed(failure)
            by_steps = config.save_every_steps and done % config.save_every_steps == 0
            if by_steps or better or asked["save"] or asked["stop"] or ended:
                saved_at = time.monotonic()
                states.save(
                    {
                        "step": done,
                        "seconds": seconds,
                        "identity": digests,
                        "micro_batches": run.plan.per_step,
                        "drawn_together": run.plan.together,
                        "updates": average.updates,
                        "objective": objective.state(),
                        **nan_to_null({"score": score, "best": best}),
                        "means": means.state(),
                        "last": last,
                    }
                )
            if asked["stop"] and not ended:
                raise StoppedError(
                    "The training was asked to stop.",
                    where=f"{title}, after step {done}, {100 * config.fraction(done, seconds):.3g} % of the run",
                    next_step=f"the same command continues from the state in {states.folder}",
                )
    averaged = [name for group in groups if group.averaged for name in group.parameters]
    return TrainingResult(dict(zip(averaged, average.average.values(), strict=True)), last, done)


@dataclass(eq=False)
class TrainingRun[BatchT: NamedBatch]:
    """The parts of a run, and its optimiser step."""

    config: TrainerConfig
    groups: Sequence[ParameterGroup]
    objective: Objective[BatchT]
    load: Callable[[int], BatchT]
    models: Sequence[nn.Module]
    output: Path
    title: str

    def __post_init__(self) -> None:
        config, groups = self.config, self.groups
        self.plan = batch_plan(config, self.output)
        self.optimizer = make_optimizer(config, [list(group.parameters.values()) for group in groups])
        named = {group.name: {f"{group.name}/{key}": p for key, p in group.parameters.items()} for group in groups}
        averaged = {key: p for group in groups if group.averaged for key, p in named[group.name].items()}
        self.average = ExponentialAverage(averaged, config.ema_decay, on_host=config.average == "host")
        parameters = {key: p for group in named.values() for key, p in group.items()}
        self.states = TrainingStates(self.output, config.saving, parameters, self.average, self.optimizer)

    def step(self, step: int) -> tuple[dict[str, float], int]:
        """One optimiser step: mean metrics of its micro-steps over all processes, examples of this process."""
        config, plan = self.config, self.plan
        trained = self.objective.trained_group(step)
        turn = [group for group in self.groups if trained in (None, group.name)]
        totals: dict[str, float] = {}
        size, kept = 0, ""
        for part in range(plan.accumulation):
            index = step * plan.accumulation + part
            batch = self.load(index)
            size += len(batch.names)
            generator = step_generator(config.seed, plan.number(index), config.device)
            reduce_gradients(self.models, now=config.sharding.reduce_every_micro_step or part + 1 == plan.accumulation)
            with autocast(config):
                loss, values = self.objective.loss(batch, generator, step)
            if not kept and not math.isfinite(loss.item()):
                path = keep_batch(self.output, batch, step=step, micro_batch=plan.number(index), seed=config.seed)
                kept = f"clips {', '.join(batch.names)} (the batch is kept in {path})"
            (loss / plan.accumulation).backward()
            for key, value in {"loss": loss.item(), **values}.items():
                totals[key] = totals.get(key, 0.0) + value / plan.accumulation
        totals = average_values(totals)
        if not math.isfinite(totals["loss"]):
            raise TrainingError(
                "The loss is not finite.",
                where=f"{self.title}, step {step}, {kept or 'clips of another process, which names them'}",
                expected="a finite loss",
                got=totals["loss"],
                next_step=f"lower the learning rate, or look at these clips; {self.states.last_good()}",
            )
        norm = clip_gradients(
            [parameter for group in turn for parameter in group.parameters.values()], config.optimizer.clip_norm
        )
        totals["gradient_norm"] = float(whole(norm))
        if not math.isfinite(totals["gradient_norm"]):
            raise TrainingError(
                "The gradient is not finite.",
                where=f"{self.title}, step {step}",
                got=totals["gradient_norm"],
                next_step=f"lower the learning rate or the clipping norm; {self.states.last_good()}",
            )
        update_weights(self.optimizer, config, step)
        if any(group.averaged for group in turn):
            self.average.update()
        self.objective.end_step(totals)
        return totals, size

    def require_finite_scores(self, scores: Mapping[str, float], done: int) -> None:
        bad = {name: value for name, value in scores.items() if not math.isfinite(value)}
        if bad:
            raise TrainingError(
                "A held-out loss is not finite.",
                where=f"{self.title}, step {done}, {', '.join(bad)}",
                expected="finite numbers of the averaged weights",
                got=bad,
                next_step=f"look at the held-out clips, or lower the learning rate; {self.states.last_good()}",
            )


def keep_batch(output: Path, batch: object, **facts: int) -> Path:
    """Keep a batch whose loss is not finite, so that it can be looked at and tried again.

    Args:
        facts: step, number of the micro-batch and seed: they decide its noise (`step_generator`).
    """
    path = output / "run" / "replay" / f"step-{facts['step']:09d}-micro-batch-{facts['micro_batch']}.safetensors"
    tensors = {name: value.cpu().contiguous() for name, value in vars(batch).items() if isinstance(value, Tensor)}
    others = {name: str(value) for name, value in vars(batch).items() if name not in tensors}
    write_bytes_atomic(path, save(tensors, metadata={"facts": json.dumps({**facts, **others})}))
    return path
