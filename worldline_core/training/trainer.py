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
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import torch
from safetensors.torch import save
from torch import Tensor, nn

from worldline_core.errors import ConfigError, StoppedError, TrainingError
from worldline_core.progress import Progress
from worldline_core.store.atomic import write_bytes_atomic
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
    ExponentialAverage,
    MetricsLog,
    TrainingStates,
    identity_digests,
    nan_to_null,
    newest_state,
    null_to_nan,
)


@dataclass(frozen=True)
class ParameterGroup:
    """Parameters that share a learning-rate multiplier; ``averaged``: whether their moving average is wanted."""

    name: str
    parameters: Mapping[str, nn.Parameter]
    multiplier: float = 1.0
    averaged: bool = True


class NamedBatch(Protocol):
    """A batch names its examples, so that they can be counted and an error can say which they were."""

    @property
    def names(self) -> Sequence[str]: ...


class Objective[BatchT: NamedBatch](Protocol):
    """What a training minimises. Objectives without a state of their own inherit what follows `loss`."""

    def loss(self, batch: BatchT, generator: torch.Generator, step: int) -> tuple[Tensor, dict[str, float]]:
        """The loss of one micro-batch, and values to log beside it."""
        ...

    def end_step(self, values: Mapping[str, float]) -> None:
        """Take note of a step's mean values over its micro-steps and all processes."""
        del values

    def state(self) -> dict[str, Any]:
        """JSON values that change from step to step (loss scales): saved with the run."""
        return {}

    def load_state(self, state: dict[str, Any]) -> None:
        """Continue from saved values."""
        del state


@dataclass(frozen=True)
class TrainingResult:
    """Averaged weights of the trained parameters, and the last metrics."""

    average: dict[str, Tensor]
    metrics: dict[str, float]


def learning_rate_factor(config: OptimizerConfig, step: int, steps: int) -> float:
    """Factor on the base rate at ``step`` (0-based) of ``steps``."""
    warmup = min(1.0, (step + 1) / config.warmup_steps) if config.warmup_steps else 1.0
    decay = min(1.0, (steps - step) / config.decay_steps) if config.decay_steps else 1.0
    return warmup * decay


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
    totals: dict[str, float] = {}
    for index in range(config.validation_batches):
        batch = load(index)
        with autocast(config):
            values = losses(batch, step_generator(seed, index, config.device))
        for key, value in values.items():
            totals[key] = totals.get(key, 0.0) + value / config.validation_batches
    return totals


def batch_plan(config: TrainerConfig, output: Path) -> BatchPlan:
    """How the micro-batches of a run are shared out: as its saved state says, or as the configuration asks for.

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
    """Whether a scheduler has asked to stop (SIGTERM), within the context; only the main thread can be told."""
    received: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    before = signal.signal(signal.SIGTERM, lambda number, _frame: received.append(number))
    try:
        yield lambda: bool(received)
    finally:
        signal.signal(signal.SIGTERM, before)


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


def require_finite(scores: Mapping[str, float], states: TrainingStates, where: str) -> None:
    """Refuse held-out losses that are not finite.

    Raises:
        TrainingError: one is not.
    """
    bad = {name: value for name, value in scores.items() if not math.isfinite(value)}
    if bad:
        raise TrainingError(
            "A held-out loss is not finite.",
            where=f"{where}, {', '.join(bad)}",
            expected="finite numbers of the averaged weights",
            got=bad,
            next_step=f"look at the held-out clips, or lower the learning rate; {states.last_good()}",
        )


@dataclass(frozen=True)
class _Run[BatchT: NamedBatch]:  # what every step needs
    config: TrainerConfig
    objective: Objective[BatchT]
    load: Callable[[int], BatchT]
    optimizer: torch.optim.Optimizer
    parameters: Mapping[str, nn.Parameter]
    models: Sequence[nn.Module]
    plan: BatchPlan
    states: TrainingStates
    title: str
    output: Path


def train[BatchT: NamedBatch](
    config: TrainerConfig,
    *,
    groups: Sequence[ParameterGroup],
    objective: Objective[BatchT],
    load: Callable[[int], BatchT],
    validate: Callable[[], dict[str, float]] | None = None,
    output: Path,
    identity: Mapping[str, Any],
    title: str,
    schedule: Callable[[int], float] | None = None,
    models: Sequence[nn.Module] = (),
) -> TrainingResult:
    """Train until ``config.steps``; called again with the same ``output``, it continues from the last saved state.

    On a CPU the result does not depend on where it was interrupted; with other processes sums have another order.

    Args:
        load: number of this process's micro-step to batch (a pure function; `BatchPlan` says which clips it has).
        validate: measures held-out losses; called with the averaged weights in the model.
        output: ``metrics.jsonl`` is written here, the state to continue from and timings under ``run/``.
        identity: JSON values that name this run (config, start, clips); a state of another run is refused.
        schedule: factor on the base learning rate per step (0-based); by default `learning_rate_factor`.
        models: the trained models, where processes share them (`place_model`).

    Raises:
        TrainingError: if a loss or the gradient is not finite, a state cannot be written, or another process has ended.
        ArtifactError: if a saved state is damaged or belongs to another run.
        StoppedError: the run was asked to stop (SIGTERM); its state is saved.
    """
    parameters = {f"{group.name}/{name}": value for group in groups for name, value in group.parameters.items()}
    if not parameters:
        raise ConfigError("There is nothing to train.", where=title, expected="at least one trainable parameter")
    settings = config.optimizer
    optimizer = torch.optim.AdamW(
        [{"params": list(group.parameters.values())} for group in groups],
        lr=settings.learning_rate,
        betas=settings.betas,
        weight_decay=settings.weight_decay,
        fused=True,
    )
    wanted = [f"{group.name}/{name}" for group in groups if group.averaged for name in group.parameters]
    average = ExponentialAverage({name: parameters[name] for name in wanted}, config.ema_decay)
    states = TrainingStates(output, config.saving, parameters, average, optimizer)
    plan = batch_plan(config, output)
    run = _Run(config, objective, load, optimizer, parameters, models, plan, states, title, output)
    digests = identity_digests(identity)
    first, sums, count, last, best = 0, dict[str, float](), 0, dict[str, float](), math.inf
    if (facts := states.load(digests)) is not None:
        first, sums, count, last = facts["step"], null_to_nan(facts["sums"]), facts["count"], null_to_nan(facts["last"])
        best = math.inf if facts["best"] is None else facts["best"]
        objective.load_state(facts["objective"])
    rank, world_size = processes()
    log = MetricsLog(output / "metrics.jsonl", first) if rank == 0 else None
    timings = MetricsLog(output / "run" / "timings.jsonl", first) if rank == 0 else None
    started = saved_at = time.monotonic()
    seen = 0
    progress = Progress(title, config.steps, "step", done=first, shown=rank == 0)
    with progress, stop_requests() as stop_requested, reporting_lost_processes(title), states:
        for step in range(first, config.steps):
            factor = schedule(step) if schedule else learning_rate_factor(settings, step, config.steps)
            for slot, group in zip(optimizer.param_groups, groups, strict=True):
                slot["lr"] = settings.learning_rate * group.multiplier * factor
            values, size = _step(run, step)
            average.update(step)
            seen += size * world_size
            sums = {key: sums.get(key, 0.0) + value for key, value in values.items()}
            count += 1
            done = step + 1
            if done % config.log_every == 0 or done == config.steps:
                last = {key: value / count for key, value in sums.items()}
                sums, count = {}, 0
                row = {"step": done, "learning_rate": settings.learning_rate * factor, **last}
                seconds = time.monotonic() - started
                if log is not None and timings is not None:
                    log.add(row)
                    timings.add({"step": done, "seconds": seconds, "clips_per_second": seen / seconds})
            due = config.validate_every and done % config.validate_every == 0
            score = math.inf
            if validate is not None and (due or done == config.steps):
                with average.swapped(), torch.no_grad():
                    scores = average_values({f"validation/{key}": value for key, value in validate().items()})
                if log is not None:
                    log.add({"step": done, **scores})
                require_finite(scores, states, f"{title}, step {done}")
                last = {**last, **scores}
                score = scores.get(f"validation/{config.saving.best}", math.inf)
            progress.advance(clips=size * world_size, loss=last.get("loss", values["loss"]))
            better, best = score < best, min(best, score)
            # Clocks and signals differ from process to process: what one decides, all do.
            failure = states.collect()
            pause = max(config.save_every_seconds, states.seconds / config.saving.share)
            late = rank == 0 and not states.busy and time.monotonic() - saved_at >= pause
            asked = average_values({"save": late, "stop": stop_requested(), "failed": failure is not None})
            if asked["failed"]:
                raise states.failed(failure)
            by_steps = config.save_every_steps and done % config.save_every_steps == 0
            if by_steps or better or asked["save"] or asked["stop"] or done == config.steps:
                saved_at = time.monotonic()
                states.save(
                    {
                        "step": done,
                        "identity": digests,
                        "micro_batches": plan.per_step,
                        "drawn_together": plan.together,
                        "count": count,
                        "objective": objective.state(),
                        **nan_to_null({"score": score, "best": best}),
                        "sums": nan_to_null(sums),
                        "last": nan_to_null(last),
                    }
                )
            if asked["stop"] and done < config.steps:
                raise StoppedError(
                    "The training was asked to stop.",
                    where=f"{title}, after step {done} of {config.steps}",
                    next_step=f"the same command continues from the state in {states.folder}",
                )
    names = [name for group in groups if group.averaged for name in group.parameters]
    return TrainingResult(dict(zip(names, average.average.values(), strict=True)), last)


def _step[BatchT: NamedBatch](run: _Run[BatchT], step: int) -> tuple[dict[str, float], int]:
    """One optimiser step: mean metrics of its micro-steps over all processes, examples of this process."""
    config, plan = run.config, run.plan
    run.optimizer.zero_grad(set_to_none=True)
    totals: dict[str, float] = {}
    size, saved = 0, ""
    for part in range(plan.accumulation):
        index = step * plan.accumulation + part
        batch = run.load(index)
        size += len(batch.names)
        generator = step_generator(config.seed, plan.number(index), config.device)
        reduce_gradients(run.models, now=config.sharding.reduce_every_micro_step or part + 1 == plan.accumulation)
        with autocast(config):
            loss, values = run.objective.loss(batch, generator, step)
        if not saved and not math.isfinite(loss.item()):
            kept = keep_batch(run.output, batch, step=step, micro_batch=plan.number(index), seed=config.seed)
            saved = f"clips {', '.join(batch.names)} (the batch is kept in {kept})"
        (loss / plan.accumulation).backward()
        for key, value in {"loss": loss.item(), **values}.items():
            totals[key] = totals.get(key, 0.0) + value / plan.accumulation
    totals = average_values(totals)
    if not math.isfinite(totals["loss"]):
        raise TrainingError(
            "The loss is not finite.",
            where=f"{run.title}, step {step}, {saved or 'clips of another process, which names them'}",
            expected="a finite loss",
            got=totals["loss"],
            next_step=f"lower the learning rate, or look at these clips; {run.states.last_good()}",
        )
    norm = nn.utils.clip_grad_norm_(run.parameters.values(), config.optimizer.clip_norm)
    totals["gradient_norm"] = float(whole(norm))
    if not math.isfinite(totals["gradient_norm"]):
        raise TrainingError(
            "The gradient is not finite.",
            where=f"{run.title}, step {step}",
            got=totals["gradient_norm"],
            next_step=f"lower the learning rate or the clipping norm; {run.states.last_good()}",
        )
    run.optimizer.step()
    run.objective.end_step(totals)
    return totals, size
