"""Filtering: which curated episodes, and which of their frames, enter training. No data is copied: the new index points
into the curated set, row by row, with start and stop.

Stage I (action-free, one view) drops static, reset, corrupted and base-motion frames. Stage II (three views, actions)
needs in addition every required view, valid calibration, aligned clocks and a projection that agrees with the images.
An episode that only Stage II cannot use stays, with stage2_ok false and the reason.
"""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import batched
from pathlib import Path
from typing import Any, ClassVar

import pyarrow as pa

from worldline_core.data.episodes.episode_index import EpisodeRow, QuarantineRow, write_index, write_quarantine
from worldline_core.data.episodes.episode_parts import part_name
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import DataError
from worldline_core.filters.examine import examine
from worldline_core.filters.filter_config import FilterConfig
from worldline_core.scale.account import InputRow, check_account, write_account
from worldline_core.scale.mapping import EpisodeWork, SerialMapper, ShardMapper, map_episodes
from worldline_core.store.atomic import write_json_atomic, write_table_atomic

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

    Also writes quarantine.parquet (one row per episode that is dropped whole) and findings.parquet (every detector's
    numbers for every episode).

    Args:
        mapper: what does the shards, by default this process. The index does not depend on it.

    Returns:
        {"found", "kept", "quarantined", "reasons", "segments", "cut_frames", "stage1_ok", "stage2_ok",
        "stage2_reasons"}; kept + quarantined = found, in episodes.

    Raises: DataError when the input set is unreadable or nothing is left; UnreachableInputError when episodes could not
        be read for a reason that passes (what is done stays, the next call does the rest).
    """
    mapper = mapper or SerialMapper()
    work = FilterWork(output, config, inputs["episodes"])
    episodes = work.episodes
    map_episodes(mapper, work, list(batched(range(len(episodes)), mapper.episodes_per_shard)))
    account: list[InputRow] = []
    rows: list[EpisodeRow] = []
    rejected: list[QuarantineRow] = []
    findings: list[dict[str, Any]] = []
    cut_frames = 0
    for i, row in enumerate(episodes.rows):
        result = work.verdict(i)
        account.append(work.row(i, result))
        findings += result["findings"]
        if result["reason"] is not None:
            evidence = json.dumps(result["evidence"], sort_keys=True)
            rejected.append(QuarantineRow(row.episode_id, row.source, result["reason"], result["detail"], evidence))
            continue
        cut_frames += row.num_frames - sum(stop - start for start, stop in result["segments"])
        dataset = os.path.relpath(episodes.dataset_path(i), output)
        rows += _segment_rows(row, Path(dataset).as_posix(), result)
    kept = {row.episode_id for row in episodes.rows} - {row.episode_id for row in rejected}
    write_account(output, account)
    check_account(output, len(episodes), kept, {row.episode_id for row in rejected})
    if not rows:
        raise DataError(
            "No episode passed the filters",
            where=str(inputs["episodes"]),
            got=", ".join(sorted({r.reason for r in rejected})),
            next_step="look at the numbers in quarantine.parquet and at the thresholds in filter",
        )
    write_table_atomic(output / FINDINGS_FILE, pa.Table.from_pylist(findings, schema=_FINDINGS))
    write_quarantine(output, rejected)
    write_index(output, rows)
    return {
        "found": len(episodes),
        "kept": len(kept),
        "quarantined": len(rejected),
        "reasons": dict(sorted(Counter(row.reason for row in rejected).items())),
        "segments": len(rows),
        "cut_frames": cut_frames,
        "stage1_ok": sum(row.stage1_ok for row in rows),
        "stage2_ok": sum(row.stage2_ok for row in rows),
        "stage2_reasons": dict(sorted(Counter(row.stage2_reason for row in rows if row.stage2_reason).items())),
    }


@dataclass(frozen=True)
class FilterWork(EpisodeWork[int, InputRow]):
    """Writes the verdict on each episode, named by its position in the set.

    Attributes:
        folder: of the set.
    """

    step: ClassVar[str] = "filter"
    doing: ClassVar[str] = "Examining"

    config: FilterConfig
    folder: Path

    @cached_property
    def episodes(self) -> EpisodeSet:
        return EpisodeSet.open(self.folder)

    def remaining(self, number: int, episodes: Sequence[int]) -> list[int]:
        del number
        return [position for position in episodes if not self._path(position).is_file()]

    def do(self, episode: int) -> InputRow:
        return self._keep(episode, examine(self.config, self.episodes, episode))

    def quarantine_crashed(self, episode: int, detail: str, evidence: Mapping[str, Any]) -> InputRow:
        return self._keep(episode, {"reason": "crashed", "detail": detail, "evidence": evidence, "findings": []})

    def verdict(self, position: int) -> dict[str, Any]:
        """What `examine` said of an episode."""
        return json.loads(self._path(position).read_text())

    def row(self, position: int, verdict: Mapping[str, Any]) -> InputRow:
        """The account of an episode."""
        row, reason = self.episodes.rows[position], verdict["reason"]
        return InputRow(
            episode_id=row.episode_id,
            source=row.source,
            status="kept" if reason is None else "quarantined",
            reason=reason,
            stored_bytes=self._path(position).stat().st_size,
        )

    def _keep(self, position: int, verdict: dict[str, Any]) -> InputRow:
        write_json_atomic(self._path(position), verdict)
        return self.row(position, verdict)

    def _path(self, position: int) -> Path:
        """Where the verdict on an episode is kept until the index is written."""
        return self.output / "run" / "verdicts" / f"{part_name(self.episodes.rows[position].episode_id)}.json"


def _segment_rows(row: EpisodeRow, dataset: str, result: dict[str, Any]) -> list[EpisodeRow]:
    """One row per segment; a single segment keeps the episode's id."""
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
