"""Motion of the robot: static stretches, resets, joint readings that no arm can make, and a base that drives.

Static: neither the robot nor the image moves. Reset: the robot returns to where it began at once, as when two attempts
were recorded into one file. Joint readings: jumps, and speeds beyond what the motors reach. Base motion: nearly the whole
picture changes; arms, however large, sweep over a part of it within half a second. Of several measurements tried on
labelled clips (flow across edges, dense flow with a robust fit of one global motion, the changed area), the changed area
alone keeps the two apart where the arms carry most of the texture: see docs/filters.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np

from worldline_core.filters.filter_config import (
    BaseMotionConfig,
    FilterConfig,
    JointMotionConfig,
    ResetConfig,
    StaticConfig,
)
from worldline_core.filters.pictures import PICTURE_FAULTS
from worldline_core.filters.signals import SPEED_WINDOW_S, Signals
from worldline_core.filters.verdict import Curve, Finding, Numbers, Verdict, bad_frames, long_runs, runs


def detect_static(
    joint_speed: np.ndarray, gripper_speed: np.ndarray, image_change: np.ndarray, fps: float, config: StaticConfig
) -> Verdict:
    """Frames of static stretches.

    Args:
        joint_speed: (n,) `range_speed` of the joints [rad/s] (or tools [m/s] where poses are recorded).
        gripper_speed: (n,) the same of the grippers, openings per second.
        image_change: (n,) mean absolute change of the coarse task-facing image, of 255.
    """
    still = (joint_speed < config.max_joint_speed_rad_s) & (gripper_speed < config.max_gripper_speed_per_s)
    # At either end half a window also covers the motion beside the stretch.
    still = _widened(still, max(1, round(SPEED_WINDOW_S * fps / 2)))
    still &= image_change < config.max_image_change
    bad = long_runs(still, config.min_run_s * fps)
    return Verdict(
        "static",
        not bad.all(),
        {
            "static_share": float(bad.mean()),
            "longest_still_s": max((stop - start for start, stop in runs(still)), default=0) / fps,
            "threshold_run_s": config.min_run_s,
        },
        bad,
        {
            "joint_range_rad_s": Curve(joint_speed, config.max_joint_speed_rad_s),
            "coarse_image_change": Curve(image_change, config.max_image_change),
        },
    )


def _widened(flags: np.ndarray, by: int) -> np.ndarray:
    wide = flags.copy()
    for start, stop in runs(flags):
        wide[max(0, start - by) : stop + by] = True
    return wide


def return_home(joints: np.ndarray, fps: float, config: ResetConfig) -> tuple[int, int] | None:
    """Frames (last before, first after) of the first return to the first pose, or None.

    Args:
        joints: (n, j) [rad].
    """
    steps = np.abs(np.diff(joints, axis=0)).max(axis=1)
    from_home = np.abs(joints - joints[0]).max(axis=1)
    longest = min(max(1, round(config.max_return_s * fps)), len(steps))
    for i, j in _candidates(from_home, steps, longest, config):
        usual = _usual(np.concatenate([steps[:i], steps[j:]]))
        quick = (from_home[i] - from_home[j]) / (j - i) > _least(j - i, config) * usual
        if quick and not _one_reading_alone(joints[[0, i, j]]):
            # The return may have begun before the part of it that leads straight home.
            begin = i
            while begin > max(j - longest, 0) and steps[begin - 1] > usual:
                begin -= 1
            return begin, j
    return None


def _candidates(from_home: np.ndarray, steps: np.ndarray, longest: int, config: ResetConfig) -> list[tuple[int, int]]:
    """Pairs of frames between which the robot returns home at a speed that may be unusual; earliest first, then shortest."""
    ordered = np.sort(steps)
    pairs: list[tuple[int, int]] = []
    for span in range(1, longest + 1):
        # The slowest steps alone give a lower bound of the usual speed.
        least = _least(span, config) * _usual(ordered[: len(ordered) - span])
        before, after = from_home[:-span], from_home[span:]
        home = (before > config.min_jump_rad) & (after < config.home_share * before)
        quick = (before - after >= config.min_jump_rad) & ((before - after) / span > least)
        pairs += [(int(i), int(i) + span) for i in np.flatnonzero(home & quick)]
    return sorted(pairs, key=lambda pair: (pair[1], -pair[0]))


_STILL_RAD = 0.03
"""Joints that are no further from their first positions have not moved: encoder noise is smaller."""


def _one_reading_alone(joints: np.ndarray) -> bool:
    """True when no other joint goes home with the one that was furthest away: a broken reading, not the robot.

    Args:
        joints: (3, j) [rad] at the first frame, before the return and after it.
    """
    before, after = np.abs(joints[1:] - joints[0])
    others = np.arange(len(before)) != before.argmax()
    away = before[others].max(initial=0.0)
    came_home = away > _STILL_RAD and after[others].max(initial=0.0) <= 0.5 * away
    return bool(others.any() and not came_home)


def _usual(steps: np.ndarray) -> float:
    return float(np.percentile(steps, 90)) if len(steps) else 0.0


def _least(span: int, config: ResetConfig) -> float:
    return config.min_relative_step if span == 1 else config.min_relative_speed


def detect_reset(joints: np.ndarray, fps: float, config: ResetConfig) -> Verdict:
    """Frames from the first return to the first pose on.

    Args:
        joints: (n, j) joint positions [rad], without grippers.
    """
    from_home = np.abs(joints - joints[0]).max(axis=1)
    found = return_home(joints, fps, config)
    bad = np.zeros(len(joints), dtype=bool)
    if found is not None:
        bad[found[0] + 1 :] = True
    return Verdict(
        "reset",
        True,  # the attempt before the return stays, if it is long enough
        {
            "reset_frame": None if found is None else found[0] + 1,
            "way_home_rad": None if found is None else float(from_home[found[0]] - from_home[found[1]]),
            "way_home_s": None if found is None else (found[1] - found[0]) / fps,
            "threshold_return_s": config.max_return_s,
        },
        bad,
        {"distance_from_home_rad": Curve(from_home, config.min_jump_rad)},
    )


_WINDOW = 4
_LARGE_STEPS = 2
"""A reading that jumps away and back makes two large steps; with a third it is motion."""


def jump_steps(joints: np.ndarray, config: JointMotionConfig) -> np.ndarray:
    """bool (n - 1, j): large steps among small ones.

    Args:
        joints: (n, j) [rad].
    """
    steps = np.abs(np.diff(joints, axis=0))
    candidates = np.argwhere(steps > config.min_jump_rad)
    jumps = np.zeros(steps.shape, dtype=bool)
    for i, joint in candidates:
        around = np.sort(steps[max(0, i - _WINDOW) : i + _WINDOW + 1, joint])
        others = around[: len(around) - _LARGE_STEPS]
        usual = float(others[-1]) if len(others) else 0.0
        jumps[i, joint] = steps[i, joint] > config.min_relative_step * usual
    return jumps


def detect_joint_jump(joints: np.ndarray, config: JointMotionConfig) -> Verdict:
    """Frames at which a reading jumps, and those between a jump and its way back.

    Args:
        joints: (n, j) joint positions [rad], without grippers.
    """
    bad = np.zeros(len(joints), dtype=bool)
    steps = np.abs(np.diff(joints, axis=0))
    jumps = jump_steps(joints, config)
    for joint in np.flatnonzero(jumps.any(axis=0)):
        at = np.flatnonzero(jumps[:, joint])
        bad[at + 1] = True
        for first, second in pairwise(at):
            returned = abs(joints[second + 1, joint] - joints[first, joint]) < 0.5 * steps[first, joint]
            if returned and second - first <= _WINDOW:
                bad[first + 1 : second + 1] = True
    numbers: Numbers = {
        "jumps": int(jumps.sum()),
        "largest_jump_rad": float(steps[jumps].max(initial=0.0)),
        "threshold_jump_rad": config.min_jump_rad,
    }
    curve = np.concatenate([[0.0], steps.max(axis=1)])
    return Verdict("joint_jump", True, numbers, bad, {"largest_step_rad": Curve(curve, config.min_jump_rad)})


def detect_joint_speed(joints: np.ndarray, fps: float, config: JointMotionConfig) -> Verdict:
    """Stretches of two frames or more above the speed limit; a single step is left to the detector of jumps.

    Args:
        joints: (n, j) joint positions [rad], without grippers.
    """
    speed = np.abs(np.diff(joints, axis=0)).max(axis=1) * fps
    bad = np.zeros(len(joints), dtype=bool)
    jumps = jump_steps(joints, config).any(axis=1)
    for start, stop in runs((speed > config.max_speed_rad_s) & ~jumps):
        if stop - start >= 2:
            bad[start + 1 : stop + 1] = True
    return Verdict(
        "joint_speed",
        True,  # the rest of the episode stays, if it is long enough
        {
            "max_joint_speed_rad_s": float(speed.max(initial=0.0)),
            "threshold_rad_s": config.max_speed_rad_s,
        },
        bad,
        {"joint_speed_rad_s": Curve(np.concatenate([[0.0], speed]), config.max_speed_rad_s)},
    )


def find_joint_faults(signals: Signals, config: FilterConfig, _: Sequence[Finding]) -> list[Finding]:
    """Resets first: what follows one is dropped, so its jump is not counted again."""
    joints, fps = signals.joints, signals.episode.fps
    if joints is None or not joints.shape[1]:
        return []
    reset = detect_reset(joints, fps, config.reset)
    frame = reset.numbers["reset_frame"]
    before = joints if frame is None else joints[: int(frame)]
    findings = [Finding("reset", None, 1, reset)]
    for verdict in (
        detect_joint_jump(before, config.joint_motion),
        detect_joint_speed(before, fps, config.joint_motion),
    ):
        finding = Finding(verdict.reason, None, 1, verdict)
        bad = np.pad(bad_frames([finding], len(before)), (0, len(joints) - len(before)))
        findings.append(replace(finding, verdict=replace(verdict, bad_frames=bad)))
    return findings


def find_static(signals: Signals, config: FilterConfig, _: Sequence[Finding]) -> list[Finding]:
    """Looks for static stretches in the primary view."""
    view = signals.primary_view
    change = signals.pictures[view].coarse_change
    verdict = detect_static(signals.joint_speed, signals.gripper_speed, change, signals.episode.fps, config.static)
    return [Finding("static", view, 1, verdict)]


_CELL = 8
_CELL_SHARE = 0.1
"""A cell has changed when this share of its pixels has."""
_SAMPLE_S = 0.12


def changed_area(gray: np.ndarray, usable: np.ndarray, fps: float, config: BaseMotionConfig) -> np.ndarray:
    """(n,) share of cells that differ between half a lag before a frame and half a lag after it; 0 where unknown.

    A change of exposure is divided out where that explains more.

    Args:
        gray: uint8 (n, h, w).
        usable: bool (n,) frames whose pictures are in order.
    """
    count, height, width = gray.shape
    area = np.zeros(count)
    lag = max(1, round(config.lag_s * fps))
    if count <= lag:
        return area
    cells = (max(1, width // _CELL), max(1, height // _CELL))
    every = max(1, round(_SAMPLE_S * fps))
    medians = np.median(gray[:, ::2, ::2].reshape(count, -1), axis=1) + 1.0
    sampled = np.arange(0, count, every)
    for i in sampled:
        before = min(max(0, i - lag // 2), count - 1 - lag)
        after = before + lag
        if not (usable[before] and usable[after]):
            continue
        found = _share(gray[before], gray[after], cells, config.min_level_change)
        gain = float(medians[after] / medians[before])
        if found > 0 and abs(gain - 1) > 0.03:
            lit = cv2.convertScaleAbs(gray[before], alpha=gain)
            found = min(found, _share(lit, gray[after], cells, config.min_level_change))
        area[i] = found
    return area[sampled[np.searchsorted(sampled, np.arange(count), side="right") - 1]]


def _share(a: np.ndarray, b: np.ndarray, cells: tuple[int, int], min_level_change: float) -> float:
    _, changed = cv2.threshold(cv2.absdiff(a, b), min_level_change, 255, cv2.THRESH_BINARY)
    share = cv2.resize(changed, cells, interpolation=cv2.INTER_AREA)
    return float((share > 255 * _CELL_SHARE).mean())


def detect_base_motion(area: np.ndarray, fps: float, config: BaseMotionConfig) -> Verdict:
    """Stretches in which the whole picture moves.

    Args:
        area: (n,) from `changed_area` of a camera that stands still in the base frame.
    """
    bad = long_runs(area > config.min_changed_area, config.min_run_s * fps, gap=0.25 * fps)
    share = float(bad.mean())
    return Verdict(
        "base_motion",
        share <= config.max_moving_share,
        {
            "moving_share": share,
            "max_changed_area": float(area.max()),
            "threshold_changed_area": config.min_changed_area,
            "threshold_share": config.max_moving_share,
        },
        bad,
        {"changed_area": Curve(area, config.min_changed_area)},
    )


def find_base_motion(signals: Signals, config: FilterConfig, found: Sequence[Finding]) -> list[Finding]:
    """Looks for base motion in the primary view, unless its camera is known to move."""
    view = signals.primary_view
    camera = signals.episode.cameras.get(view)
    if camera is not None and camera.moving:
        return []
    unusable = bad_frames(found, len(signals.gray[view]), *PICTURE_FAULTS, view=view)
    area = changed_area(signals.gray[view], ~unusable, signals.episode.fps, config.base_motion)
    verdict = detect_base_motion(area, signals.episode.fps, config.base_motion)
    return [Finding("base_motion", view, 1, verdict)]
