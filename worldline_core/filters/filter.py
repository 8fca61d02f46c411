"""Filtering: which curated episodes, and which of their frames, enter training. No data is copied: the new index points
into the curated set, row by row, with start and stop.

Stage I (action-free, one view) drops static, reset, corrupted and base-motion frames. Stage II (three views, actions)
needs in addition every required view, valid calibration, aligned clocks and a projection that agrees with the images.
An episode that only Stage II cannot use stays, with stage2_ok false and the reason.
"""

from __future__ import annotations

import json
import os
import uuid
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow as pa
from tqdm import tqdm

from worldline_core.data.episodes.episode_index import EpisodeRow, QuarantineRow, write_index, write_quarantine
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.lerobot.v3 import write_table
from worldline_core.errors import DataError
from worldline_core.filters.filter_config import FilterConfig
from worldline_core.filters.filter_shard import (
    FilterShard,
    filter_shard,
    opened_set,
    quarantine_crashed,
    verdict_path,
    verdict_row,
)
from worldline_core.scale.mapping import SerialMapper, ShardMapper, cut, run_jobs
from worldline_core.scale.shard_manifest import (
    InputRow,
    check_account,
    read_shard_manifests,
    write_merged_manifest,
)

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
