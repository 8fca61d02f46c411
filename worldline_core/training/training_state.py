"""State of a training run to continue after a kill: weights, their average, optimiser moments, random state, log.

States are written by `torch.distributed.checkpoint` while training goes on, each process its own parts, as safetensors
and JSON: its usual storage keeps an index that is a pickle, which runs code when it is read, so the storage that knows
safetensors alone is used. ``run/training_state/step-<N>/`` holds a state; its ``state.json`` is written last.
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
import shutil
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Self, cast

import torch
from safetensors import SafetensorError
from torch import Tensor, nn

from worldline_core.config import cache_relevant_config
from worldline_core.errors import ArtifactError, TrainingError
from worldline_core.store.artifact_files import read_json_lines
from worldline_core.store.atomic import write_bytes_atomic, write_json_atomic
from worldline_core.training.optimizers import empty_moments, stored_parts
from worldline_core.training.processes import another_process_ended, own_part, processes, wait_for_all
from worldline_core.training.training_config import SavingConfig

logger = logging.getLogger(__name__)

STATES = Path("run") / "training_state"
PROBE_LOG = Path("run") / "action_following.jsonl"
INDEX = "state.json"
_FILE_BYTES = 2**31
"""Tensors are put together into files of about this size: a file is held in memory a second time while it is written."""


def nan_to_null(values: Mapping[str, float]) -> dict[str, float | None]:
    """Metrics for JSON, with null for values that are not finite."""
    return {name: value if math.isfinite(value) else None for name, value in values.items()}


class RunningMeans:
    """Means of named values, each over the times that it was added.

    Args:
        state: what `state` returned.
    """

    def __init__(self, state: Mapping[str, tuple[float, int]] | None = None) -> None:
        self._totals = dict(state or {})

    def add(self, values: Mapping[str, float]) -> None:
        for name, value in values.items():
            total, count = self._totals.get(name, (0.0, 0))
            self._totals[name] = (total + value, count + 1)

    def values(self) -> dict[str, float]:
        return {name: total / count for name, (total, count) in sorted(self._totals.items())}

    def state(self) -> dict[str, tuple[float, int]]:
        return dict(self._totals)


class MetricsLog:
    """JSON lines, each with a ``step``, which the first process alone writes; lines later than the resumed step are dropped: they
    will be written again.
    """

    def __init__(self, path: Path, resume_step: int) -> None:
        self.path, self._writes = path, processes()[0] == 0
        if self._writes and path.is_file():
            kept = [row for row in read_json_lines(path) if row["step"] <= resume_step]
            write_bytes_atomic(path, "".join(f"{json.dumps(row)}\n" for row in kept).encode())

    def add(self, row: Mapping[str, float]) -> None:
        if self._writes:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps(nan_to_null(row), allow_nan=False) + "\n")


def identity_digests(identity: Mapping[str, Any]) -> dict[str, str]:
    """Short digests of the JSON values that name a run, by name. How it is shared out and saved is no part of it."""
    return {
        name: hashlib.sha256(
            json.dumps(cache_relevant_config(value), sort_keys=True, default=str).encode()
        ).hexdigest()[:16]
        for name, value in identity.items()
    }


def newest_state(output: Path) -> dict[str, Any] | None:
    """Facts of the newest whole state below ``output``, with its ``folder``; None where there is none.

    Raises:
        ArtifactError: its description is damaged.
    """
    whole = sorted((output / STATES).glob(f"step-*/{INDEX}"))
    if not whole:
        return None
    try:
        facts = json.loads(whole[-1].read_text(encoding="utf-8"))
        return {**facts, "folder": whole[-1].parent, "sizes": dict(facts["sizes"]), "step": int(facts["step"])}
    except (ValueError, KeyError, TypeError) as error:
        raise _damaged(whole[-1], repr(error)) from error


def _damaged(where: Path, got: object) -> ArtifactError:
    return ArtifactError(
        "The training state is damaged.",
        where=where,
        got=got,
        next_step="delete its folder: the run goes on from an earlier state, or starts again where there is none",
    )


SLICE_VALUES = 2**20


def in_slices(*tensors: Tensor) -> Iterator[tuple[Tensor, ...]]:
    """Tensors of one shape, cut alike along their first axis into parts of about `SLICE_VALUES` values.

    A whole large matrix in another type is fresh memory for each copy, which costs several times the sum.
    """
    first = tensors[0]
    if first.ndim == 0:
        return iter([tensors])
    rows = max(1, SLICE_VALUES * len(first) // max(1, first.numel()))
    return zip(*(tensor.split(rows) for tensor in tensors), strict=True)


class HostCopies:
    """Copies tensors to the machine's memory, one at a time, into one pinned buffer: fresh memory for each costs more than the copy.

    Args:
        tensors: all that will be copied.
    """

    def __init__(self, tensors: Sequence[Tensor]) -> None:
        size, pinned = max((t.nbytes for t in tensors), default=0), any(t.is_cuda for t in tensors)
        self._buffer = torch.empty(size, dtype=torch.uint8, pin_memory=pinned)

    def __call__(self, tensor: Tensor) -> Tensor:
        """The copy, valid until the next one."""
        return self._buffer[: tensor.nbytes].view(tensor.dtype).view(tensor.shape).copy_(tensor)


class ExponentialAverage:
    """Exponential moving average of named parameters, in float32; shipped checkpoints hold it. Sharded where they are.

    The decay rises with the number n of updates, ``min(decay, (1 + n) / (10 + n))``, so that the random start is
    forgotten also in short runs.

    Args:
        on_host: keep it in the machine's memory, not on the parameters' device.
    """

    def __init__(self, parameters: Mapping[str, nn.Parameter], decay: float, *, on_host: bool = False) -> None:
        self.parameters = dict(parameters)
        self.decay = decay
        self.updates = 0
        self.average = {
            name: parameter.detach().to("cpu" if on_host else parameter.device, torch.float32, copy=True)
            for name, parameter in self.parameters.items()
        }
        self._fetch = HostCopies([*map(own_part, self.parameters.values())]) if on_host else own_part

    @torch.no_grad()
    def update(self) -> None:
        decay = min(self.decay, (1 + self.updates) / (10 + self.updates))
        self.updates += 1
        for name, parameter in self.parameters.items():
            average = own_part(self.average[name])
            for part, weights in in_slices(average, self._fetch(own_part(parameter))):
                part.lerp_(weights.to(average.dtype), 1 - decay)

    @contextmanager
    def swapped(self) -> Iterator[None]:
        """Within the context the model holds the average; its weights wait beside it."""
        with torch.no_grad():
            kept = {
                name: own_part(parameter).detach().to(own_part(self.average[name]).device, copy=True)
                for name, parameter in self.parameters.items()
            }
        self._fill(self.average)
        try:
            yield
        finally:
            self._fill(kept)

    @torch.no_grad()
    def _fill(self, values: Mapping[str, Tensor]) -> None:
        for name, parameter in self.parameters.items():
            own_part(parameter).copy_(own_part(values[name]))


class TrainingStates:
    """The states of one run: written while training goes on, read when it continues.

    Args:
        output: folder of the run.
    """

    def __init__(
        self,
        output: Path,
        config: SavingConfig,
        parameters: Mapping[str, nn.Parameter],
        average: ExponentialAverage,
        optimizer: torch.optim.Optimizer,
    ) -> None:
        self.output = output
        self.folder = output / STATES
        self.config = config
        self.parameters = parameters
        self.average = average
        self.optimizer = optimizer
        self.seconds = 0.0
        """Duration of the last save."""
        self._writing: Future[float] | None = None
        self._rank, world_size = processes()
        self._alone = world_size == 1
        # Said at every save and load by a process that is alone on purpose.
        warnings.filterwarnings("ignore", "torch.distributed is disabled, unavailable or uninitialized")
        # States are written beside training, so their messages need a channel of their own.
        group = None if self._alone else torch.distributed.new_group(backend="gloo")
        self._group = cast("torch.distributed.ProcessGroup | None", group)

    def load(self, identity: Mapping[str, str]) -> dict[str, Any] | None:
        """Fill everything from the newest state and return its facts; None where there is no state.

        Args:
            identity: digest of each thing that makes a run what it is (see `identity_digests`); the state's are compared.

        Raises:
            ArtifactError: it is damaged, or belongs to a run with another configuration, model or other clips.
        """
        facts = newest_state(self.output)
        wait_for_all()
        if self._rank == 0:
            for folder in self.folder.glob("step-*"):
                if not (folder / INDEX).is_file():
                    shutil.rmtree(folder)
        if facts is None:
            return None
        folder, found = facts["folder"], facts.get("identity", {})
        different = sorted(name for name in identity.keys() | found.keys() if identity.get(name) != found.get(name))
        if different:
            raise ArtifactError(
                "The training state belongs to another run.",
                where=folder,
                expected={name: identity.get(name) for name in different},
                got={name: found.get(name) for name in different},
                next_step=f"give it the {', '.join(different)} that it began with, use another output folder, or "
                "delete this training state",
            )
        sizes = {path.name: path.stat().st_size for path in folder.glob("*.safetensors")}
        for name, size in facts["sizes"].items():
            if sizes.get(name) != size:
                raise _damaged(folder / name, f"{sizes[name]} bytes, not {size}" if name in sizes else "no such file")
        self._read(folder)
        return facts

    @torch.no_grad()
    def _read(self, folder: Path) -> None:
        from torch.distributed.checkpoint.api import CheckpointException
        from torch.distributed.checkpoint.hf_storage import HuggingFaceStorageReader
        from torch.distributed.checkpoint.state_dict_loader import load

        try:
            reader = HuggingFaceStorageReader(str(folder))
            stored = reader.read_metadata().state_dict_metadata
            for name, parameter in self.parameters.items():
                if f"step/{name}" in stored:
                    self.optimizer.state[parameter] = empty_moments(self.optimizer, parameter)
            tensors = self._tensors()
            load(tensors, storage_reader=reader, process_group=self._group, no_dist=self._alone)
        except (CheckpointException, SafetensorError, KeyError, ValueError, RuntimeError) as error:
            raise _damaged(folder, repr(error)) from error
        torch.set_rng_state(tensors["random_state"])

    def save(self, facts: Mapping[str, Any]) -> None:
        """Begin to write a state; training may go on at once. ``facts`` are JSON values with the ``step``.

        Raises:
            TrainingError: the state before it could not be written.
        """
        from torch.distributed.checkpoint.hf_storage import HuggingFaceStorageWriter
        from torch.distributed.checkpoint.logger import _dcp_logger
        from torch.distributed.checkpoint.state_dict_saver import async_save

        _dcp_logger.setLevel(logging.INFO)  # at DEBUG it describes every tensor twice
        if (failure := self.collect(wait=True)) is not None:
            raise self.failed(failure)
        begun = time.monotonic()
        folder = self.folder / f"step-{facts['step']:09d}"
        tensors = self._tensors()
        writer = HuggingFaceStorageWriter(
            str(folder), fqn_to_index_mapping=_files(tensors), save_distributed=True, thread_count=1
        )
        done = async_save(tensors, storage_writer=writer, process_group=self._group, no_dist=self._alone)
        self._writing = writing = Future[float]()

        def describe(done: Future[Any]) -> None:
            """In the thread that has written this process's part: the first process's ends when all parts are there."""
            try:
                done.result()
                if self._rank == 0:
                    sizes = {path.name: path.stat().st_size for path in folder.glob("*.safetensors")}
                    write_json_atomic(folder / INDEX, {**facts, "sizes": sizes})
                    self._prune()
                writing.set_result(time.monotonic() - begun)
            except BaseException as error:  # noqa: BLE001 - handed to whoever collects it
                if self._rank == 0:
                    shutil.rmtree(folder, ignore_errors=True)
                writing.set_exception(error)

        cast("Future[Any]", done).add_done_callback(describe)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Wait for what is being written.

        Raises:
            TrainingError: it could not be written, and nothing else has ended the run.
        """
        failure = self.collect(wait=True)
        if failure is not None and error is None:
            raise self.failed(failure)
        if failure is not None:
            logger.warning("%s", self.failed(failure))

    def failed(self, error: BaseException | None) -> TrainingError:
        """Error for a state that could not be written."""
        from torch.distributed.checkpoint.api import CheckpointException

        if isinstance(error, CheckpointException):
            error = next(iter(error.failures.values()))[0]
        ended = error is None or another_process_ended(error)
        return TrainingError(
            "The training state could not be written.",
            where=self.folder,
            expected="every process to write its part" if ended else "room for a state beside the one before it",
            got=repr(error) if error else "another process could not write its part",
            next_step=f"{'' if ended else 'free some space, then '}give the same command again; {self.last_good()}",
        )

    def last_good(self) -> str:
        """Text that names a run's last good state; waits for a state that is being written."""
        self.collect(wait=True)
        state = newest_state(self.output)
        return f"the last good state is {state['folder']}" if state else "no state had been saved before"

    @property
    def busy(self) -> bool:
        return self._writing is not None and not self._writing.done()

    def collect(self, *, wait: bool = False) -> BaseException | None:
        """Error of the last write (``wait``: waits for it), or None."""
        if self._writing is None or not (wait or self._writing.done()):
            return None
        writing, self._writing = self._writing, None
        error = writing.exception()
        if error is None:
            self.seconds = writing.result()
        return error

    def _prune(self) -> None:
        whole = [path.parent for path in sorted(self.folder.glob(f"step-*/{INDEX}"))]
        kept = set(whole[-self.config.keep :])
        if self.config.best is not None:
            scores = {folder: json.loads((folder / INDEX).read_text(encoding="utf-8"))["score"] for folder in whole}
            measured = [folder for folder in whole if scores[folder] is not None]
            kept |= {min(measured, key=lambda folder: scores[folder])} if measured else set()
        for folder in set(whole) - kept:
            (folder / INDEX).unlink()  # first: without it, what a kill leaves of the folder counts as no state
            shutil.rmtree(folder)

    def _tensors(self) -> dict[str, Tensor]:
        tensors: dict[str, Tensor] = {"random_state": torch.get_rng_state()}
        for name, parameter in self.parameters.items():
            tensors[f"weight/{name}"] = parameter.detach()
            if name in self.average.average:
                tensors[f"average/{name}"] = self.average.average[name]
            for key, value in self.optimizer.state.get(parameter, {}).items():
                for part, tensor in stored_parts(value).items():
                    tensors[f"{key}{part}/{name}"] = tensor
        return tensors


def _files(tensors: Mapping[str, Tensor]) -> dict[str, int]:
    """Number of the file, from 1, that each tensor goes to."""
    numbers: dict[str, int] = {}
    total = 0
    for name, tensor in tensors.items():
        part = own_part(tensor)
        total += part.numel() * part.element_size()
        numbers[name] = 1 + total // _FILE_BYTES
    return numbers
