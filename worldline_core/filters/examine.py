"""Everything the detectors say about one episode, as JSON: which of its frames may be used, or why none.

Apply every detector to one episode's signals.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from worldline_core.data.episodes.episode import CameraTrack
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import DataError
from worldline_core.filters.alignment import detect_image_lag, detect_pose_lag, detect_projection
from worldline_core.filters.base_motion import changed_area, detect_base_motion
from worldline_core.filters.calibration import detect_camera, detect_fixed_camera, detect_hand_eye, detect_mistake
from worldline_core.filters.corrupted import detect_corrupted, without_signal
from worldline_core.filters.exposure import detect_blur, detect_dark, detect_overexposed
from worldline_core.filters.filter_config import FilterConfig
from worldline_core.filters.motion import detect_joint_jump, detect_joint_speed, detect_reset, detect_static
from worldline_core.filters.signals import Signals, measure
from worldline_core.filters.verdict import Verdict, runs
from worldline_core.geometry.cameras import MIN_DEPTH_M, inside_image, project_points
from worldline_core.geometry.rotations import rotation_angle_deg
from worldline_core.geometry.transforms import rigid_inverse

if TYPE_CHECKING:
    from worldline_core.filters.filter_config import FilterConfig


# A wrist camera swings: turning by one radian shows about as much change as travelling this far.
_METRES_PER_RADIAN = 0.15


@dataclass(frozen=True)
class Finding:
    """A detector's verdict. `stage`: 1 when a failure drops the episode, 2 when it only excludes it from Stage II."""

    detector: str
    view: str | None
    stage: int
    verdict: Verdict


def inspect(config: FilterConfig, signals: Signals) -> list[Finding]:
    """All findings about an episode, Stage I detectors first."""
    findings = _stage1(config, signals)
    if signals.episode.state_kind == "none":
        return [*findings, Finding("required_views", None, 2, Verdict("missing_actions", False))]
    findings += _required(config, signals)
    if signals.T_base_tool is not None and signals.episode.cameras:
        # Clocks first: a lag also disturbs the hand-eye check, and is the better explanation.
        findings += _time_alignment(config, signals, signals.T_base_tool)
        findings += _calibration(config, signals, signals.T_base_tool)
        findings += _projection(config, signals, signals.T_base_tool)
        findings = _with_mistake(config, signals, findings)
    return findings


def _with_mistake(config: FilterConfig, signals: Signals, findings: list[Finding]) -> list[Finding]:
    """The findings with the calibration doctor's: before the other Stage II findings where it explains them."""
    num_frames = len(next(iter(signals.gray.values())))
    bad = np.zeros(num_frames, dtype=bool)
    for finding in findings:
        if finding.stage == 1 and not finding.verdict.passed:
            return findings  # the episode is dropped whole: its calibration is nobody's concern
        if finding.verdict.bad_frames is not None:
            bad |= finding.verdict.bad_frames
    verdict = detect_mistake(signals.episode, signals.gray, bad, config.doctor)
    found = Finding("doctor", None, 2, verdict)
    if verdict.numbers["verdict"] != "explained":
        return [*findings, found]
    first = next((i for i, f in enumerate(findings) if f.stage == 2 and f.detector != "required_views"), len(findings))
    return [*findings[:first], found, *findings[first:]]


def _arms_of(signals: Signals, view: str) -> tuple[int, ...]:
    """Arms whose motion a view must show: its own for a wrist view, all for any other."""
    own = tuple(i for i, arm in enumerate(signals.arms) if arm.wrist_view == view)
    return own or tuple(range(len(signals.arms)))


def _stage1(config: FilterConfig, signals: Signals) -> list[Finding]:
    episode = signals.episode
    primary = episode.primary_view if episode.primary_view in signals.gray else next(iter(signals.gray))
    findings: list[Finding] = []
    if signals.joints is not None and signals.joints.shape[1]:
        findings += _joint_findings(config, signals.joints, episode.fps)
    spoilt = np.zeros(len(signals.gray[primary]), dtype=bool)
    unreliable = np.logical_or.reduce([spoilt, *(_bad(f) for f in findings if f.detector != "reset")])
    for view in [primary, *(v for v in signals.gray if v != primary)]:
        found = _picture_findings(config, signals, view, 1 if view == primary else 2, unreliable)
        findings += found
        if view == primary:
            for finding in found:
                spoilt |= _bad(finding)
    pictures = signals.pictures[primary]
    static = detect_static(
        signals.joint_speed, signals.gripper_speed, pictures.coarse_change, episode.fps, config.static
    )
    findings.append(Finding("static", primary, 1, static))
    camera = episode.cameras.get(primary)
    if camera is None or not camera.moving:
        area = changed_area(signals.gray[primary], ~spoilt, episode.fps, config.base_motion)
        findings.append(Finding("base_motion", primary, 1, detect_base_motion(area, episode.fps, config.base_motion)))
    return findings


def _joint_findings(config: FilterConfig, joints: np.ndarray, fps: float) -> list[Finding]:
    """Resets first: what follows one is dropped, so its jump is not counted again."""
    reset = detect_reset(joints, fps, config.reset)
    frame = reset.numbers["reset_frame"]
    before = joints if frame is None else joints[: int(frame)]
    findings = [Finding("reset", None, 1, reset)]
    for name, verdict in (
        ("joint_jump", detect_joint_jump(before, config.joint_motion)),
        ("joint_speed", detect_joint_speed(before, fps, config.joint_motion)),
    ):
        missing = len(joints) - len(before)
        bad = np.concatenate([verdict.bad_frames, np.zeros(missing, bool)]) if verdict.bad_frames is not None else None
        findings.append(Finding(name, None, 1, replace(verdict, bad_frames=bad)))
    return findings


def _picture_findings(
    config: FilterConfig, signals: Signals, view: str, stage: int, unreliable: np.ndarray
) -> list[Finding]:
    """What is wrong with the pictures of one view; a frame is counted for the first reason only.

    `unreliable`: bool (n,) frames whose joint readings are wrong.
    """
    pictures, wrist = signals.pictures[view], view.endswith("wrist")
    dark = detect_dark(pictures, config.exposure, wrist=wrist)
    white = detect_overexposed(pictures, config.exposure, wrist=wrist)
    findings = [Finding("too_dark", view, stage, dark), Finding("overexposed", view, stage, white)]
    lost = _bad(findings[0]) | _bad(findings[1])
    blank, noise = without_signal(pictures, config.corrupted)
    fps = signals.episode.fps
    blur = detect_blur(signals.sharpness[view], pictures, lost | blank | noise, fps, config.blur, wrist=wrist)
    findings.append(Finding("blur", view, stage, blur))
    tracks = signals.tracks(_arms_of(signals, view))
    lost |= _bad(findings[-1])
    corrupted = detect_corrupted(pictures, tracks, lost, unreliable, fps, config.corrupted, wrist=wrist)
    return [*findings, Finding("corrupted", view, stage, corrupted)]


def _bad(finding: Finding) -> np.ndarray:
    bad = finding.verdict.bad_frames
    return np.zeros(0, dtype=bool) if bad is None else bad


def _required(config: FilterConfig, signals: Signals) -> list[Finding]:
    """Required views, their calibration, and known tool poses."""
    arms = [arm.wrist_view for arm in signals.arms] or ["right_wrist"]
    required = config.required_views or ("head", *arms)
    findings = []
    for view in required:
        reason = "missing_view" if view not in signals.gray else "missing_calibration"
        passed = view in signals.gray and view in signals.episode.cameras
        findings.append(Finding("required_views", view, 2, Verdict(reason, passed)))
    if signals.T_base_tool is None:
        findings.append(Finding("required_views", None, 2, Verdict("missing_kinematics", False)))
    return findings


def _wrist_cameras(signals: Signals) -> list[tuple[int, CameraTrack]]:
    cameras = signals.episode.cameras
    return [(i, cameras[arm.wrist_view]) for i, arm in enumerate(signals.arms) if arm.wrist_view in cameras]


def _calibration(config: FilterConfig, signals: Signals, T_base_tool: np.ndarray) -> list[Finding]:
    findings = []
    num_frames = len(T_base_tool)
    for view, camera in signals.episode.cameras.items():
        verdict = detect_camera(camera.K, camera.T_base_camera, camera.width, camera.height, config.calibration)
        findings.append(Finding("camera", view, 2, verdict))
    for i, camera in _wrist_cameras(signals):
        poses = camera.poses(np.arange(num_frames))
        if not camera.moving or not np.isfinite(poses).all():
            continue
        verdict = detect_hand_eye(T_base_tool[:, i], poses, signals.arms[i].T_tool_mount, config.calibration)
        findings.append(Finding("hand_eye", camera.view, 2, verdict))
    wrists = {arm.wrist_view for arm in signals.arms}
    for view, camera in signals.episode.cameras.items():
        if view not in wrists and camera.moving and np.isfinite(camera.T_base_camera).all():
            verdict = detect_fixed_camera(camera.T_base_camera[:num_frames], config.calibration)
            findings.append(Finding("fixed_camera", view, 2, verdict))
    return findings


def _time_alignment(config: FilterConfig, signals: Signals, T_base_tool: np.ndarray) -> list[Finding]:
    fps = signals.episode.fps
    relative = rigid_inverse(T_base_tool[:-1]) @ T_base_tool[1:]
    motion = np.linalg.norm(relative[..., :3, 3], axis=-1)
    motion = motion + _METRES_PER_RADIAN * np.radians(rotation_angle_deg(relative[..., :3, :3]))
    streams, changes = [], []
    for view, pictures in signals.pictures.items():
        arms = _arms_of(signals, view)
        if arms:
            streams.append(motion[:, list(arms)].max(axis=1))
            changes.append(pictures.change[1:])
    findings = []
    if streams:
        verdict = detect_image_lag(np.stack(streams, axis=1), np.stack(changes, axis=1), fps, config.time_alignment)
        findings.append(Finding("image_lag", None, 2, verdict))
    for i, camera in _wrist_cameras(signals):
        if camera.moving and np.isfinite(camera.T_base_camera).all():
            poses = camera.poses(np.arange(len(T_base_tool)))
            verdict = detect_pose_lag(T_base_tool[:, i], poses, fps, config.time_alignment)
            findings.append(Finding("pose_lag", camera.view, 2, verdict))
    return findings


def _projection(config: FilterConfig, signals: Signals, T_base_tool: np.ndarray) -> list[Finding]:
    view = signals.episode.primary_view
    camera = signals.episode.cameras.get(view)
    if camera is None or view not in signals.gray or not np.isfinite(camera.K).all():
        return []
    gray = signals.gray[view]
    camera = camera.resized(gray.shape[2], gray.shape[1])
    poses = camera.poses(np.arange(len(gray)))
    uvs, insides = [], []
    for arm in range(T_base_tool.shape[1]):
        uv, depth = project_points(T_base_tool[:, arm, :3, 3], camera.K, poses)
        uvs.append(uv)
        insides.append((depth > MIN_DEPTH_M) & inside_image(uv, (camera.height, camera.width)))
    verdict = detect_projection(gray, np.stack(uvs, axis=1), np.stack(insides, axis=1), config.projection)
    return [Finding("projection", view, 2, verdict)]


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
