"""Filtering: which curated episodes, and which of their frames, enter training. No data is copied: the new index points
into the curated set, row by row, with start and stop.

Stage I (action-free, one view) drops static, reset, corrupted and base-motion frames. Stage II (three views, actions)
needs in addition every required view, valid calibration, aligned clocks and a projection that agrees with the images.
An episode that only Stage II cannot use stays, with stage2_ok false and the reason.

A shard of filtering: the verdicts on some episodes of a set, wherever the shard is worked on.
"""

from __future__ import annotations

import json
import os
import time
import uuid
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import pyarrow as pa
from tqdm import tqdm

from worldline_core.data.episodes.episode_index import EpisodeRow, QuarantineRow, write_index, write_quarantine
from worldline_core.data.episodes.episode_parts import part_name
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.lerobot.v3 import write_table
from worldline_core.errors import DataError
from worldline_core.filters.examine import examine
from worldline_core.filters.filter_config import FilterConfig
from worldline_core.scale.mapping import (
    SerialMapper,
    ShardMapper,
    crash_evidence,
    cut,
    ends_the_run,
    portable_message,
    run_jobs,
)
from worldline_core.scale.shard_manifest import (
    InputRow,
    check_account,
    read_shard_manifests,
    write_merged_manifest,
    write_shard_manifest,
)
from worldline_core.store.atomic import write_json_atomic
from worldline_core.store.remote import UnreachableInputError, is_transient


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


FINDINGS_FILE = "findings.parquet"
_FINDINGS = pa.schema(
    [
        ("episode_id", pa.string()),
        ("detector", pa.string()),
        ("view", pa.string()),
        ("stage", pa.int64()),
        ("passed", pa.bool_()),
        ("cut_frames", pa.int64()),
        ("numbers", pa.string()),
    ]
)


def filter_episodes(
    config: FilterConfig, inputs: Mapping[str, Path], output: Path, mapper: ShardMapper | None = None
) -> dict[str, Any]:
    """Index the fit episodes and segments of inputs["episodes"] at `output`.

    Also writes quarantine.parquet (one row an episode that is dropped whole) and findings.parquet (every detector's
    numbers for every episode).

    Args:
        mapper: what does the shards, by default this process. The index does not depend on it.

    Returns:
        {"found", "kept", "quarantined", "reasons", "segments", "cut_frames", "stage1_ok", "stage2_ok",
        "stage2_reasons"}; kept + quarantined = found, in episodes.

    Raises: DataError when the input set is unreadable or nothing is left; UnreachableInputError when episodes could not
        be read for a reason that passes (what is done stays, the next call does the rest).
    """
    episodes = EpisodeSet.open(inputs["episodes"])
    _examine_all(config, episodes, output, mapper or SerialMapper())
    seen = read_shard_manifests(output)
    account: list[InputRow] = []
    rows: list[EpisodeRow] = []
    rejected: list[QuarantineRow] = []
    findings: list[dict[str, Any]] = []
    cut_frames = 0
    for i, row in enumerate(episodes.rows):
        path = verdict_path(output, row.episode_id)
        result = json.loads(path.read_text())
        account.append(seen.get(row.episode_id) or verdict_row(row.episode_id, row.source, result, path))
        findings += result["findings"]
        if result["reason"] is not None:
            evidence = json.dumps(result["evidence"], sort_keys=True)
            rejected.append(QuarantineRow(row.episode_id, row.source, result["reason"], result["detail"], evidence))
            continue
        cut_frames += row.num_frames - sum(stop - start for start, stop in result["segments"])
        dataset = os.path.relpath(episodes.dataset_path(i), output)
        rows += _segment_rows(row, Path(dataset).as_posix(), result)
    kept = {row.episode_id for row in episodes.rows} - {row.episode_id for row in rejected}
    check_account(len(episodes), kept, {row.episode_id for row in rejected}, account, output)
    write_merged_manifest(output, account)
    if not rows:
        raise DataError(
            "No episode passed the filters",
            where=str(inputs["episodes"]),
            got=", ".join(sorted({r.reason for r in rejected})),
            next_step="look at the numbers in quarantine.parquet and at the thresholds in filter",
        )
    write_table(output / FINDINGS_FILE, pa.Table.from_pylist(findings, schema=_FINDINGS))
    write_quarantine(output, rejected)
    write_index(output, rows)
    return {
        "found": len(episodes),
        "kept": len(kept),
        "quarantined": len(rejected),
        "reasons": _count(r.reason for r in rejected),
        "segments": len(rows),
        "cut_frames": cut_frames,
        "stage1_ok": sum(row.stage1_ok for row in rows),
        "stage2_ok": sum(row.stage2_ok for row in rows),
        "stage2_reasons": _count(row.stage2_reason for row in rows if row.stage2_reason is not None),
    }


def _examine_all(config: FilterConfig, episodes: EpisodeSet, output: Path, mapper: ShardMapper) -> None:
    """Write the verdict on every episode that has none yet."""
    run, text, folder = uuid.uuid4().hex, config.model_dump_json(), str(episodes.root)
    pieces = cut(range(len(episodes)), mapper.episodes_per_shard)
    shards = [FilterShard(n, run, text, folder, str(output), p[0], p[-1] + 1) for n, p in enumerate(pieces)]
    ids = [row.episode_id for row in episodes.rows]
    todo = [s for s in shards if not all(verdict_path(output, i).is_file() for i in ids[s.start : s.stop])]
    with tqdm(total=len(ids), desc="filter", unit="episode", disable=None) as progress:
        progress.update(len(ids) - sum(len(shard) for shard in todo))
        try:
            run_jobs(mapper, filter_shard, todo, done=progress.update, crashed=quarantine_crashed)
        finally:
            opened_set.cache_clear()


def _count(reasons: Any) -> dict[str, int]:
    counts: dict[str, int] = {}
    for reason in reasons:
        counts[reason] = counts.get(reason, 0) + 1
    return dict(sorted(counts.items()))


def _segment_rows(row: EpisodeRow, dataset: str, result: dict[str, Any]) -> list[EpisodeRow]:
    """One row a segment; a single segment keeps the episode's id."""
    segments = result["segments"]
    untouched = segments == [[0, row.video_frames]] and row.video_frames == row.num_frames
    rows = []
    for start, stop in segments:
        rows.append(
            replace(
                row,
                episode_id=row.episode_id if len(segments) == 1 else f"{row.episode_id}@{start:05d}",
                dataset=dataset,
                start=row.start + (0 if untouched else start),
                stop=row.start + (row.num_frames if untouched else stop),
                num_frames=stop - start,
                video_frames=stop - start,
                stage1_ok=bool(result["stage1_ok"]),
                stage2_ok=result["stage2_reason"] is None,
                stage2_reason=result["stage2_reason"],
            )
        )
    return rows
