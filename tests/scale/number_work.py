"""Work that behaves badly, for the tests of what maps it. In a module of its own, so that workers can import it."""

from __future__ import annotations

import os
import signal
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from worldline_core.scale.account import InputRow
from worldline_core.scale.mapping import EpisodeWork


@dataclass(frozen=True)
class NumberWork(EpisodeWork[int, InputRow]):
    """Writes a file per number. 13 kills the process, 7 is unforeseen, 5 is reached at the third attempt, 3 never."""

    step: ClassVar[str] = "numbers"
    doing: ClassVar[str] = "Squaring"

    def remaining(self, number: int, episodes: Sequence[int]) -> list[int]:
        return [value for value in episodes if not self._path(value).exists()]

    def do(self, episode: int) -> InputRow:
        with (self.output / "log.txt").open("a") as log:
            log.write(f"{episode} {os.getpid()}\n")
        if episode == 13:
            os.kill(os.getpid(), signal.SIGKILL)
        if episode == 7:
            raise ZeroDivisionError("seven")
        if episode == 3 or (episode == 5 and attempts(self.output, 5) < 3):
            raise ConnectionResetError("the store hung up")
        return self._write(episode, str(episode * episode), None)

    def quarantine_crashed(self, episode: int, detail: str, evidence: Mapping[str, Any]) -> InputRow:
        return self._write(episode, detail, "crashed")

    def _path(self, value: int) -> Path:
        return self.output / str(value)

    def _write(self, value: int, text: str, reason: str | None) -> InputRow:
        self._path(value).write_text(text)
        return InputRow(
            episode_id=str(value), source="numbers", status="quarantined" if reason else "kept", reason=reason
        )


@dataclass(frozen=True)
class NumberFileWork(NumberWork):
    """Writes a file per shard: the ids and reasons of its numbers."""

    def remaining(self, number: int, episodes: Sequence[int]) -> Sequence[int]:
        return () if self._path(-number - 1).exists() else episodes

    def finish_shard(self, number: int, results: Sequence[InputRow]) -> None:
        self._path(-number - 1).write_text(" ".join(f"{row.episode_id}:{row.status}" for row in results))


def attempts(folder: Path, value: int) -> int:
    """Return how often a number was begun."""
    return [line.split()[0] for line in (folder / "log.txt").read_text().splitlines()].count(str(value))
