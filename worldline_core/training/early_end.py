"""What ends a training before its last step: a scheduler that asks, or numbers that are not finite; and what is kept then."""

from __future__ import annotations

import json
import math
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from safetensors.torch import save
from torch import Tensor

from worldline_core.errors import TrainingError
from worldline_core.store.atomic import write_bytes_atomic
from worldline_core.training.training_state import TrainingStates


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
