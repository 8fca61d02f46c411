"""A shard of filtering: the verdicts on some episodes of a set, wherever the shard is worked on."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from worldline_core.data.episodes.episode_parts import part_name
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.filters.examine import examine
from worldline_core.filters.filter_config import FilterConfig
from worldline_core.scale.crashes import crash_evidence, portable_message
from worldline_core.scale.mapping import ends_the_run
from worldline_core.scale.shard_manifest import InputRow, write_shard_manifest
from worldline_core.scale.transient import UnreachableInputError, is_transient
from worldline_core.store.atomic import write_json_atomic


@dataclass(frozen=True)
class FilterShard:
    """Plain values only: a shard is sent to other processes and machines, which share the folders.

    Attributes:
        run: names the call of `filter_episodes`, so that a set that one call opened does not serve the next.
        config: JSON of the FilterConfig.
        episodes: folder of the set.
        start, stop: positions in it.
    """

    number: int
    run: str
    config: str
    episodes: str
    output: str
    start: int
    stop: int

    @property
    def label(self) -> str:
        return f"filter shard {self.number}"

    def __len__(self) -> int:
        return self.stop - self.start

    def split(self) -> list[FilterShard]:
        return [replace(self, start=i, stop=i + 1) for i in range(self.start, self.stop)]


@lru_cache(maxsize=2)
def opened_set(run: str, folder: str) -> EpisodeSet:
    """A set, opened once for all shards of a run that this process works on."""
    del run  # part of the key only
    return EpisodeSet.open(Path(folder))


def filter_shard(shard: FilterShard) -> int:
    """Write the verdict on every episode of a shard that has none yet, and the shard's manifest.

    Returns: the number of episodes.

    Raises: UnreachableInputError when some could not be read for a reason that passes (all others are done).
    """
    config, output = FilterConfig.model_validate_json(shard.config), Path(shard.output)
    episodes = opened_set(shard.run, shard.episodes)
    rows: list[InputRow] = []
    unreachable: list[Exception] = []
    for i in range(shard.start, shard.stop):
        row = episodes.rows[i]
        path = verdict_path(output, row.episode_id)
        if path.is_file():
            continue
        clock, processor = time.perf_counter(), time.process_time()
        try:
            verdict = examine(config, episodes, i)
        except Exception as error:
            if is_transient(error):
                unreachable.append(error)
                continue
            if ends_the_run(error):
                raise
            verdict = _crashed(error, f"Examining ended with {type(error).__name__}: {portable_message(str(error))}")
        write_json_atomic(path, verdict)
        seconds, cpu_seconds = time.perf_counter() - clock, time.process_time() - processor
        rows.append(verdict_row(row.episode_id, row.source, verdict, path, seconds, cpu_seconds))
    if rows:
        write_shard_manifest(output, f"shard-{shard.start:08d}-{shard.stop:08d}", rows)
    if unreachable:
        raise UnreachableInputError(
            f"{len(unreachable)} of {len(shard)} episodes could not be read",
            where=shard.label,
            got=str(unreachable[0]).splitlines()[0],
        ) from unreachable[0]
    return len(shard)


def quarantine_crashed(shard: FilterShard, error: Exception) -> None:
    """The verdict on the one episode of a shard that ended its worker twice."""
    episodes = opened_set(shard.run, shard.episodes)
    path = verdict_path(Path(shard.output), episodes.rows[shard.start].episode_id)
    if not path.is_file():
        write_json_atomic(path, _crashed(error, "Examining this episode alone ended its process, twice"))


def verdict_path(output: Path, episode_id: str) -> Path:
    """Where the verdict on an episode is kept until the index is written."""
    return output / "run" / "verdicts" / f"{part_name(episode_id)}.json"


def verdict_row(
    episode_id: str,
    source: str,
    verdict: dict[str, Any],
    path: Path,
    seconds: float | None = None,
    cpu_seconds: float | None = None,
) -> InputRow:
    """The account of an episode."""
    status = "kept" if verdict["reason"] is None else "quarantined"
    return InputRow(episode_id, source, status, verdict["reason"], "", path.stat().st_size, seconds, cpu_seconds)


def _crashed(error: Exception, detail: str) -> dict[str, Any]:
    return {"reason": "crashed", "detail": detail, "evidence": crash_evidence(error), "findings": []}
