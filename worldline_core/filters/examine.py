"""Everything the detectors say about one episode, as JSON: which of its frames may be used, or why none."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import DataError
from worldline_core.filters.filter_config import FilterConfig
from worldline_core.filters.inspect_episode import Finding, inspect
from worldline_core.filters.signals import measure
from worldline_core.filters.verdict import runs


def examine(config: FilterConfig, episodes: EpisodeSet, i: int) -> dict[str, Any]:
    """The verdict on row i: {"reason", "detail", "evidence", "findings"} of a dropped episode (reason is a code), or
    {"reason": None, "segments" (start, stop pairs), "stage1_ok", "stage2_reason", "findings"} of a kept one."""
    row = episodes.rows[i]
    try:
        episode = episodes.episode(i)
        thumbnails = {view: episodes.thumbnails(i, view) for view in row.views}
    except DataError as error:
        return _rejected("unreadable", str(error).replace(str(episodes.root), ""), {}, [])
    thresholds = config.for_source(row.source)
    if row.video_frames < thresholds.min_segment_frames:
        evidence = {"video_frames": row.video_frames, "threshold_frames": thresholds.min_segment_frames}
        return _rejected("too_short", "Fewer images than the shortest clip", evidence, [])
    findings = inspect(thresholds, measure(episode, thumbnails))
    origin = row.source if row.source in config.sources else "default"
    listed = [_finding_row(row.episode_id, finding, origin) for finding in findings]
    whole = [f for f in findings if f.stage == 1 and not f.verdict.passed]
    if whole:
        return _rejected(whole[0].verdict.reason, _detail(whole[0]), dict(whole[0].verdict.numbers), listed)
    cuts = _cuts(findings)
    bad = np.logical_or.reduce([flags for _, flags in cuts]) if cuts else np.zeros(row.video_frames, dtype=bool)
    segments = [(a, b) for a, b in runs(~bad) if b - a >= thresholds.min_segment_frames]
    if not segments:
        if not cuts:
            evidence = {"usable_frames": len(bad), "threshold_frames": thresholds.min_segment_frames}
            return _rejected("too_short", "Fewer usable images than the shortest clip", evidence, listed)
        blame = max(cuts, key=lambda cut: int(cut[1].sum()))[0]
        return _rejected(blame.verdict.reason, _detail(blame), dict(blame.verdict.numbers), listed)
    stage2 = next((f.verdict.reason for f in findings if f.stage == 2 and not f.verdict.passed), None)
    return {
        "reason": None,
        "segments": segments,
        "stage1_ok": row.primary_view in row.views,
        "stage2_reason": stage2,
        "findings": listed,
    }


def _cuts(findings: list[Finding]) -> list[tuple[Finding, np.ndarray]]:
    """The findings that cut frames out, with those frames.

    A view that is bad for most of the time bars the episode from Stage II, and Stage I does not look at it: no cut.
    """
    return [
        (finding, finding.verdict.bad_frames)
        for finding in findings
        if finding.verdict.bad_frames is not None and (finding.stage == 1 or finding.verdict.passed)
    ]


def _rejected(reason: str, detail: str, evidence: dict[str, Any], findings: list[dict[str, Any]]) -> dict[str, Any]:
    return {"reason": reason, "detail": detail, "evidence": evidence, "findings": findings}


def _detail(finding: Finding) -> str:
    where = f" in view {finding.view}" if finding.view else ""
    return f"Detector {finding.detector}{where}"


def _finding_row(episode_id: str, finding: Finding, thresholds: str) -> dict[str, Any]:
    """`thresholds`: the source whose own thresholds were used, or "default"; "cut" lists (start, stop) of cut frames."""
    verdict = finding.verdict
    numbers: dict[str, Any] = {**verdict.numbers, "thresholds": thresholds}
    cut = verdict.bad_frames if finding.stage == 1 or verdict.passed else None
    if cut is not None and cut.any():
        numbers["cut"] = runs(cut)
    return {
        "episode_id": episode_id,
        "detector": finding.detector,
        "view": finding.view,
        "stage": finding.stage,
        "passed": bool(verdict.passed),
        "cut_frames": 0 if cut is None else int(cut.sum()),
        "numbers": json.dumps(numbers, sort_keys=True),
    }
