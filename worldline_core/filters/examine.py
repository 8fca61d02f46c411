"""All detectors, applied to one episode: which of its frames may be used, or why none.

A detector is a function of the episode's signals, the thresholds and what was found before it; it gives its findings.
To add one, see docs/filters.md.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import DataError
from worldline_core.filters.alignment import find_lags, find_projection
from worldline_core.filters.base_motion import find_base_motion
from worldline_core.filters.calibration import find_calibration_faults, find_mistake
from worldline_core.filters.filter_config import FilterConfig
from worldline_core.filters.motion import find_joint_faults, find_static
from worldline_core.filters.pictures import find_picture_faults
from worldline_core.filters.signals import Signals, measure
from worldline_core.filters.verdict import Finding, Verdict, runs

type Detector = Callable[[Signals, FilterConfig, Sequence[Finding]], list[Finding]]


def find_missing_inputs(signals: Signals, config: FilterConfig, _: Sequence[Finding]) -> list[Finding]:
    """What Stage II needs besides clean frames: actions, required views with calibration, known tool poses."""
    if signals.episode.state_kind == "none":
        return [Finding("required_views", None, 2, Verdict("missing_actions", False))]
    arms = [arm.wrist_view for arm in signals.arms] or ["right_wrist"]
    findings: list[Finding] = []
    for view in config.required_views or ("head", *arms):
        reason = "missing_calibration" if view in signals.gray else "missing_view"
        passed = view in signals.gray and view in signals.episode.cameras
        findings.append(Finding("required_views", view, 2, Verdict(reason, passed)))
    if signals.T_base_tool is None:
        findings.append(Finding("required_views", None, 2, Verdict("missing_kinematics", False)))
    return findings


DETECTORS: tuple[Detector, ...] = (
    find_joint_faults,  # reset, joint_jump, joint_speed
    find_picture_faults,  # too_dark, overexposed, blur, corrupted, in each view
    find_static,
    find_base_motion,
    find_missing_inputs,  # required_views
    find_lags,  # image_lag, pose_lag: before calibration, since a lag also disturbs the hand-eye check
    find_calibration_faults,  # camera, hand_eye, fixed_camera
    find_projection,
    find_mistake,  # doctor
)
"""In this order: Stage I first. Of several findings that drop an episode the first one is its reason."""


def inspect(config: FilterConfig, signals: Signals) -> list[Finding]:
    """All findings about an episode. A mistake that the calibration doctor explains comes before what it explains."""
    findings: list[Finding] = []
    for detect in DETECTORS:
        findings += detect(signals, config, findings)
    doctor = findings[-1]
    if doctor.detector == "doctor" and doctor.verdict.numbers["verdict"] == "explained":
        explained = (i for i, f in enumerate(findings) if f.stage == 2 and f.detector != "required_views")
        findings.insert(next(explained), findings.pop())
    return findings


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

    A view other than the primary one that is mostly bad excludes the episode from Stage II instead: nothing is cut.
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
