"""Jobs that behave badly, for the tests of what maps them. In a module of its own, so that workers can import it."""

from __future__ import annotations

import os
import signal
from dataclasses import dataclass, replace
from pathlib import Path


@dataclass(frozen=True)
class NumbersJob:
    number: int
    folder: str
    values: tuple[int, ...]

    @property
    def label(self) -> str:
        return f"numbers shard {self.number}"

    def __len__(self) -> int:
        return len(self.values)

    def split(self) -> list[NumbersJob]:
        return [replace(self, values=(value,)) for value in self.values]


def write_numbers(job: NumbersJob) -> int:
    """Write a file a number. 13 kills the process, 7 is unforeseen, 5 is reached at the third attempt, 3 never."""
    folder = Path(job.folder)
    for value in job.values:
        path = folder / str(value)
        if path.exists():
            continue
        with (folder / "log.txt").open("a") as log:
            log.write(f"{value} {os.getpid()}\n")
        if value == 13:
            os.kill(os.getpid(), signal.SIGKILL)
        if value == 7:
            raise ZeroDivisionError("seven")
        if value == 3 or (value == 5 and attempts(folder, 5) < 3):
            raise ConnectionResetError("the store hung up")
        path.write_text(str(value * value))
    return len(job.values)


def attempts(folder: Path, value: int) -> int:
    """How often a number was begun."""
    return [line.split()[0] for line in (folder / "log.txt").read_text().splitlines()].count(str(value))


def jobs_of(folder: Path, values: range | list[int], size: int) -> list[NumbersJob]:
    listed = list(values)
    pieces = [listed[start : start + size] for start in range(0, len(listed), size)]
    return [NumbersJob(number, str(folder), tuple(piece)) for number, piece in enumerate(pieces)]
