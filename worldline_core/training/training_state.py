"""What a killed training run needs to continue bit by bit: weights, their average, optimizer moments, random state, log.

One safetensors file, replaced atomically, holds all but the log of metrics.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from worldline_core.errors import ArtifactError
from worldline_core.store.artifact_files import read_json_lines
from worldline_core.store.atomic import atomic_path, write_bytes_atomic


class MetricsLog:
    """JSON lines, each with a ``step``; lines later than the resumed step are dropped: they will be written again."""

    def __init__(self, path: Path, resume_step: int) -> None:
        self.path = path
        kept = [row for row in read_json_lines(path) if row["step"] <= resume_step]
        write_bytes_atomic(path, "".join(f"{json.dumps(row)}\n" for row in kept).encode())

    def add(self, row: Mapping[str, Any]) -> None:
        """Append one row."""
        with self.path.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(row, allow_nan=False) + "\n")


class ExponentialAverage:
    """Exponential moving average of named parameters; shipped checkpoints hold it.

    The decay rises with the number of updates, ``min(decay, (1 + n) / (10 + n))``, so that the random start is
    forgotten also in short runs.
    """

    def __init__(self, parameters: Mapping[str, nn.Parameter], decay: float) -> None:
        self.parameters = dict(parameters)
        self.decay = decay
        self.average = {name: parameter.detach().clone() for name, parameter in self.parameters.items()}

    @torch.no_grad()
    def update(self, updates: int) -> None:
        """Take in the current weights; ``updates`` counts earlier updates."""
        decay = min(self.decay, (1 + updates) / (10 + updates))
        for name, parameter in self.parameters.items():
            self.average[name].lerp_(parameter, 1 - decay)

    @contextmanager
    def swapped(self) -> Iterator[None]:
        """Within the context the model holds the average."""
        self._exchange()
        try:
            yield
        finally:
            self._exchange()

    @torch.no_grad()
    def _exchange(self) -> None:
        for name, parameter in self.parameters.items():
            current = parameter.detach().clone()
            parameter.copy_(self.average[name])
            self.average[name] = current

    def load(self, average: Mapping[str, Tensor]) -> None:
        """Continue from stored averages."""
        for name, value in self.average.items():
            value.copy_(average[name])


STATE_FILE = Path("run") / "training_state" / "state.safetensors"


def save_training_state(
    path: Path,
    parameters: Mapping[str, nn.Parameter],
    average: ExponentialAverage,
    optimizer: torch.optim.Optimizer,
    facts: Mapping[str, Any],
) -> None:
    """Write weights, averages, optimizer moments and the random state; ``facts`` (JSON) go into the file's header."""
    tensors: dict[str, Tensor] = {"random_state": torch.get_rng_state()}
    for name, parameter in parameters.items():
        tensors[f"weight/{name}"] = parameter.detach()
        tensors[f"average/{name}"] = average.average[name]
        for key, value in optimizer.state.get(parameter, {}).items():
            tensors[f"{key}/{name}"] = value
    with atomic_path(path) as temporary:
        save_file(
            {name: tensor.cpu().contiguous() for name, tensor in tensors.items()},
            temporary,
            metadata={"facts": json.dumps(facts)},
        )


def identity_digests(identity: Mapping[str, Any]) -> dict[str, str]:
    """Short digests of the JSON values that name a run, by name."""
    return {
        name: hashlib.sha256(json.dumps(value, sort_keys=True, default=str).encode()).hexdigest()[:16]
        for name, value in identity.items()
    }


@torch.no_grad()
def load_training_state(
    path: Path,
    parameters: Mapping[str, nn.Parameter],
    average: ExponentialAverage,
    optimizer: torch.optim.Optimizer,
    identity: Mapping[str, str],
) -> dict[str, Any]:
    """Fill everything from a state file and return its facts.

    Args:
        identity: digest of each thing that makes a run what it is (see `identity_digests`); the file's are compared.

    Raises:
        ArtifactError: if it is damaged, or belongs to a run with another configuration, model or other clips.
    """
    try:
        with safe_open(path, framework="pt") as stored:
            facts = json.loads((stored.metadata() or {})["facts"])
    except (SafetensorError, KeyError, json.JSONDecodeError) as error:
        raise ArtifactError(
            "The training state is damaged.",
            where=path,
            got=repr(error),
            next_step="delete it to start this run again",
        ) from error
    found = facts.get("identity", {})
    different = sorted(name for name in identity.keys() | found.keys() if identity.get(name) != found.get(name))
    if different:
        raise ArtifactError(
            "The training state belongs to another run.",
            where=path,
            expected={name: identity.get(name) for name in different},
            got={name: found.get(name) for name in different},
            next_step=f"give it the {', '.join(different)} that it began with, use another output folder, or delete "
            "this training state",
        )
    with safe_open(path, framework="pt") as stored:
        names = set(stored.keys())
        missing = [name for name in parameters if f"weight/{name}" not in names]
        if missing:
            raise ArtifactError("The training state lacks weights.", where=path, got=missing[:5])
        for name, parameter in parameters.items():
            parameter.copy_(stored.get_tensor(f"weight/{name}"))
            for key in ("step", "exp_avg", "exp_avg_sq"):
                if f"{key}/{name}" in names:
                    value = stored.get_tensor(f"{key}/{name}")
                    # Moments have the memory layout of their parameter.
                    target = torch.empty((), device=parameter.device) if key == "step" else torch.empty_like(parameter)
                    optimizer.state[parameter][key] = target.copy_(value)
        average.load({name: stored.get_tensor(f"average/{name}") for name in parameters})
        torch.set_rng_state(stored.get_tensor("random_state"))
    return facts
