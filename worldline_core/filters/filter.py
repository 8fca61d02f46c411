"""Filtering: which curated episodes, and which of their frames, enter training. No data is copied: the new index points
into the curated set, row by row, with start and stop.

Stage I (action-free, one view) drops static, reset, corrupted and base-motion frames. Stage II (three views, actions)
needs in addition every required view, valid calibration, aligned clocks and a projection that agrees with the images.
An episode that only Stage II cannot use stays, with stage2_ok false and the reason.

A detector is a function of the episode's signals, the thresholds and what was found before it; docs/filters.md says how to
add one.
"""

from __future__ import annotations

import json
import logging
import os
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import batched
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
import pyarrow as pa
from pydantic import Field

from worldline_core.config import StrictModel
from worldline_core.data.episodes.episode_index import (
    EpisodeRow,
    QuarantineRow,
    nothing_kept,
    write_index,
    write_quarantine,
)
from worldline_core.data.episodes.episode_set import EpisodeSet, EpisodeSetWork
from worldline_core.data.episodes.episode_set_writer import EMBODIMENTS_FOLDER, copy_embodiments, part_name
from worldline_core.errors import DataError
from worldline_core.filters.calibration import find_calibration_faults, find_lags, find_mistake, find_projection
from worldline_core.filters.detectors import find_base_motion, find_joint_faults, find_picture_faults, find_static
from worldline_core.filters.filter_config import FilterConfig
from worldline_core.filters.signals import Signals, measure
from worldline_core.filters.verdict import Finding, Verdict, runs
from worldline_core.scale.account import InputRow, check_account, crash_evidence, write_account
from worldline_core.scale.mapping import SerialMapper, ShardMapper, ends_the_run, map_episodes, reading_input
from worldline_core.store.artifact_files import row_schema
from worldline_core.store.atomic import write_json_atomic, write_table_atomic

logger = logging.getLogger(__name__)
FINDINGS_FILE = "findings.parquet"


@dataclass(frozen=True)
class FindingRow:
    """One row of findings.parquet.

    Attributes:
        numbers: JSON: what was measured, its thresholds, whose thresholds these are, and "cut", the (start, stop) of cut
            frames.
    """

    episode_id: str
    detector: str
    view: str | None
    stage: int
    passed: bool
    cut_frames: int
    numbers: str


type Detector = Callable[[Signals, FilterConfig, Sequence[Finding]], list[Finding]]


def find_missing_inputs(signals: Signals, config: FilterConfig, _: Sequence[Finding]) -> list[Finding]:
    """Checks for what Stage II needs besides clean frames: actions, the required views, a camera, known tool poses."""
    if signals.episode.state_kind == "none":
        return [Finding("required_views", None, 2, Verdict("missing_actions", False))]
    findings: list[Finding] = []
    for view in config.required_views:
        reason = "missing_calibration" if view in signals.gray else "missing_view"
        passed = view in signals.gray and view in signals.episode.cameras
        findings.append(Finding("required_views", view, 2, Verdict(reason, passed)))
    calibrated = bool(signals.gray.keys() & signals.episode.cameras.keys())
    findings.append(Finding("required_views", None, 2, Verdict("missing_calibration", calibrated)))
    if signals.T_base_tool is None:
        findings.append(Finding("required_views", None, 2, Verdict("missing_kinematics", False)))
    return findings


JUDGEMENTS: tuple[Detector, ...] = (
    find_lags,  # image_lag, pose_lag: before calibration, since a lag also disturbs the hand-eye check
    find_calibration_faults,  # camera, hand_eye, fixed_camera
    find_projection,
    find_mistake,  # doctor
)
"""For Stage II, by estimates from poses and pictures: one that fails is recorded, and costs the episode nothing."""
DETECTORS: tuple[Detector, ...] = (
    find_joint_faults,  # reset, joint_jump, joint_speed, joint_stuck
    find_picture_faults,  # too_dark, overexposed, blur, corrupted, in each view
    find_static,
    find_base_motion,
    find_missing_inputs,  # required_views
    *JUDGEMENTS,
)
"""In this order: Stage I first. Of several findings that drop an episode the first one is its reason."""


_NUMBERS = (DataError, ValueError, ArithmeticError, cv2.error)
"""Errors that judging unusual numbers may raise (numpy's LinAlgError is a ValueError); another one is a mistake in the code."""


def inspect(config: FilterConfig, signals: Signals) -> list[Finding]:
    """All findings about an episode. A mistake that the calibration doctor explains comes before what it explains."""
    findings: list[Finding] = []
    for detect in DETECTORS:
        try:
            findings += detect(signals, config, findings)
        except _NUMBERS as error:
            if detect not in JUDGEMENTS or ends_the_run(error):
                raise
            evidence = {name: str(value) for name, value in crash_evidence(error).items()}
            logger.warning("%s: %s failed: %s", signals.episode.episode_id, detect.__name__, evidence["message"])
            name = detect.__name__.removeprefix("find_")
            findings.append(Finding(name, None, 2, Verdict("not_judged", True, {"verdict": "not_judged", **evidence})))
    doctor = findings[-1]
    if doctor.detector == "doctor" and doctor.verdict.numbers["verdict"] == "explained":
        explained = (i for i, f in enumerate(findings) if f.stage == 2 and f.detector != "required_views")
        findings.insert(next(explained), findings.pop())
    return findings


class EpisodeVerdict(StrictModel):
    """Decision of the filters on one episode.

    Attributes:
        reason: code, with detail and evidence, of an episode that is dropped whole; None of one that is kept.
        segments: (start, stop) of the frames that are kept.
        stage2_reason: why a kept episode is not for Stage II.
        findings: rows of findings.parquet.
    """

    reason: str | None = None
    detail: str = ""
    evidence: dict[str, Any] = Field(default_factory=dict)
    segments: tuple[tuple[int, int], ...] = ()
    stage1_ok: bool = True
    stage2_reason: str | None = None
    findings: tuple[FindingRow, ...] = ()


def examine(config: FilterConfig, episodes: EpisodeSet, i: int) -> EpisodeVerdict:
    """The verdict on row i of a set.

    Raises: ArtifactError when what the set holds of it cannot be read.
    """
    row = episodes.rows[i]
    with reading_input(f"{episodes.root}, episode {row.episode_id}"):
        episode = episodes.episode(i)
        thumbnails = {view: episodes.thumbnails(i, view) for view in row.views}
    thresholds = config.for_source(row.source)
    shortest = thresholds.min_segment_frames
    if row.video_frames < shortest:
        evidence = {"video_frames": row.video_frames, "threshold_frames": shortest}
        return EpisodeVerdict(reason="too_short", detail="Fewer images than the shortest clip", evidence=evidence)
    findings = inspect(thresholds, measure(episode, thumbnails))
    origin = row.source if row.source in config.sources else "default"
    listed = tuple(_finding_row(row.episode_id, finding, origin) for finding in findings)
    cuts = [(finding, flags) for finding in findings if (flags := _cut_frames(finding)) is not None]
    bad = np.logical_or.reduce([np.zeros(row.video_frames, dtype=bool), *(flags for _, flags in cuts)])
    segments = tuple((a, b) for a, b in runs(~bad) if b - a >= shortest)
    blame = next((f for f in findings if f.stage == 1 and not f.verdict.passed), None)
    if blame is None and not segments:
        blame = max(cuts, key=lambda cut: int(cut[1].sum()))[0]
    if blame is not None:
        where = f" in view {blame.view}" if blame.view else ""
        return EpisodeVerdict(
            reason=blame.verdict.reason,
            detail=f"Detector {blame.detector}{where}",
            evidence=dict(blame.verdict.numbers),
            findings=listed,
        )
    return EpisodeVerdict(
        segments=segments,
        stage1_ok=row.primary_view in row.views,
        stage2_reason=next((f.verdict.reason for f in findings if f.stage == 2 and not f.verdict.passed), None),
        findings=listed,
    )


def _cut_frames(finding: Finding) -> np.ndarray | None:
    """bool (n,) frames that a finding cuts out.

    A view other than the primary one that is mostly bad excludes the episode from Stage II instead: nothing is cut.
    """
    return finding.verdict.bad_frames if finding.stage == 1 or finding.verdict.passed else None


def _finding_row(episode_id: str, finding: Finding, thresholds: str) -> FindingRow:
    """`thresholds`: the source whose own thresholds were used, or "default"."""
    verdict, cut = finding.verdict, _cut_frames(finding)
    numbers: dict[str, Any] = {**verdict.numbers, "thresholds": thresholds}
    if cut is not None and cut.any():
        numbers["cut"] = runs(cut)
    return FindingRow(
        episode_id,
        finding.detector,
        finding.view,
        finding.stage,
        passed=bool(verdict.passed),
        cut_frames=0 if cut is None else int(cut.sum()),
        numbers=json.dumps(numbers, sort_keys=True),
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
    work = FilterWork(output, inputs["episodes"], config)
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
        findings += [asdict(row) for row in result.findings]
        if result.reason is not None:
            evidence = json.dumps(result.evidence, sort_keys=True)
            rejected.append(QuarantineRow(row.episode_id, row.source, result.reason, result.detail, evidence))
            continue
        cut_frames += row.num_frames - sum(stop - start for start, stop in result.segments)
        dataset = os.path.relpath(episodes.dataset_path(i), output)
        rows += _segment_rows(row, Path(dataset).as_posix(), result)
    kept = {row.episode_id for row in episodes.rows} - {row.episode_id for row in rejected}
    write_account(output, account)
    check_account(output, len(episodes), kept, {row.episode_id for row in rejected})
    if not rows:
        next_step = "look at the numbers in the table and at the thresholds in filter"
        raise nothing_kept("No episode passed the filters", output, rejected, next_step)
    write_table_atomic(output / FINDINGS_FILE, pa.Table.from_pylist(findings, schema=row_schema(FindingRow)))
    copy_embodiments((row.embodiment for row in rows), output / EMBODIMENTS_FOLDER)
    write_quarantine(output, rejected)
    write_index(output, rows)
    fit = Counter(row.stage2_reason for row in rows)
    reasons = ", ".join(f"{reason} {count}" for reason, count in sorted((r, n) for r, n in fit.items() if r))
    uncalibrated = "; those without a camera take the commands themselves" if fit["missing_calibration"] else ""
    logger.info("fit for Stage II: %d of %d%s%s", fit[None], len(rows), reasons and f" ({reasons})", uncalibrated)
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
class FilterWork(EpisodeSetWork[InputRow]):
    """Writes the verdict on each episode."""

    step: ClassVar[str] = "filter"
    doing: ClassVar[str] = "Examining"

    config: FilterConfig

    def remaining(self, number: int, episodes: Sequence[int]) -> list[int]:
        del number
        return [position for position in episodes if not self._path(position).is_file()]

    def do(self, episode: int) -> InputRow:
        return self._keep(episode, examine(self.config, self.episodes, episode))

    def quarantine_crashed(self, episode: int, detail: str, evidence: Mapping[str, Any]) -> InputRow:
        return self._keep(episode, EpisodeVerdict(reason="crashed", detail=detail, evidence=dict(evidence)))

    def verdict(self, position: int) -> EpisodeVerdict:
        """Returns the stored verdict on an episode."""
        return EpisodeVerdict.model_validate(json.loads(self._path(position).read_text()))

    def row(self, position: int, verdict: EpisodeVerdict) -> InputRow:
        """The account of an episode."""
        row = self.episodes.rows[position]
        return InputRow(
            episode_id=row.episode_id,
            source=row.source,
            status="kept" if verdict.reason is None else "quarantined",
            reason=verdict.reason,
            stored_bytes=self._path(position).stat().st_size,
        )

    def _keep(self, position: int, verdict: EpisodeVerdict) -> InputRow:
        write_json_atomic(self._path(position), verdict.model_dump())
        return self.row(position, verdict)

    def _path(self, position: int) -> Path:
        """Path of the verdict on an episode until the index is written."""
        return self.output / "run" / "verdicts" / f"{part_name(self.episodes.rows[position].episode_id)}.json"


def _segment_rows(row: EpisodeRow, dataset: str, verdict: EpisodeVerdict) -> list[EpisodeRow]:
    """One row per segment; a single segment keeps the episode's id."""
    return [
        replace(
            row,
            episode_id=row.episode_id if len(verdict.segments) == 1 else f"{row.episode_id}@{start:05d}",
            dataset=dataset,
            start=row.start + start,
            stop=row.start + stop,
            num_frames=stop - start,
            video_frames=stop - start,
            stage1_ok=verdict.stage1_ok,
            stage2_ok=verdict.stage2_reason is None,
            stage2_reason=verdict.stage2_reason,
        )
        for start, stop in verdict.segments
    ]
