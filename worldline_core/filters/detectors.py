"""Detectors of bad frames: faults of the pictures of a view, and of the motion of joints and base.

Corrupted: blank, noise, garbled by a damaged stream, or frozen while the robot moves. Blur: the variance of the Laplacian
(Pech-Pacheco et al. 2000) divided by the contrast of adjacent pixels of the small image, so that scene and gain cancel.
Base motion: of several measurements tried on labelled clips, the changed area alone keeps a driving base and large arms apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import cv2
import numpy as np

from worldline_core.filters.filter_config import (
    BaseMotionConfig,
    BlurConfig,
    CorruptedConfig,
    ExposureConfig,
    FilterConfig,
    JointMotionConfig,
    ResetConfig,
    StaticConfig,
)
from worldline_core.filters.signals import SPEED_WINDOW_S, PictureStatistics, Signals
from worldline_core.filters.verdict import Finding, Verdict, bad_frames, frame_verdict, long_runs, runs


def detect_dark(
    pictures: PictureStatistics, noise: np.ndarray, config: ExposureConfig, *, wrist: bool = False
) -> Verdict:
    """Images that are black or too dark to see anything in; noise (bool (n,)) is another fault, however dark."""
    least = config.min_bright_level_wrist if wrist else config.min_bright_level
    bad = (pictures.bright_level < least) & ~noise
    return frame_verdict("too_dark", bad.mean() <= config.max_bad_share, bad, {"bright_level": least})


def detect_overexposed(pictures: PictureStatistics, config: ExposureConfig, *, wrist: bool = False) -> Verdict:
    """Images in which much of the sensor is saturated."""
    most = config.max_white_share_wrist if wrist else config.max_white_share
    bad = pictures.white_share > most
    return frame_verdict("overexposed", bad.mean() <= config.max_bad_share, bad, {"white_share": most})


def relative_sharpness(sharpness: np.ndarray, detail: np.ndarray) -> np.ndarray:
    """(n,) sharpness relative to image detail, 1 at the episode's 75th percentile.

    Args:
        sharpness: (n,) measured every few frames and held in between.
        detail: (n,) of every frame.
    """
    measured = np.flatnonzero(np.diff(sharpness, prepend=-1.0) != 0)
    ratio = sharpness[measured] / np.maximum(detail[measured], 1e-3)
    usual = max(float(np.quantile(ratio, 0.75)), 1e-9)
    held = np.searchsorted(measured, np.arange(len(sharpness)), side="right") - 1
    return ratio[held] / usual


def detect_blur(
    sharpness: np.ndarray,
    pictures: PictureStatistics,
    unusable: np.ndarray,
    fps: float,
    config: BlurConfig,
    *,
    wrist: bool = False,
) -> Verdict:
    """Blurred stretches of one view.

    Args:
        sharpness: (n,).
        unusable: bool (n,) frames that other detectors dropped: the sharpness of noise or darkness is meaningless.
    """
    least = config.min_relative_wrist if wrist else config.min_relative
    relative = np.ones(len(sharpness))
    seen = ~unusable
    if seen.any():
        relative[seen] = relative_sharpness(sharpness[seen], pictures.detail[seen])
    blurred = ((relative < least) | (sharpness < config.min_sharpness)) & seen
    bad = long_runs(blurred, max(1.0, config.min_run_s * fps))
    thresholds = {"relative_sharpness": least, "sharpness": config.min_sharpness}
    return frame_verdict("blur", bad.mean() <= config.max_bad_share, bad, thresholds)


def frozen_frames(
    change: np.ndarray, tracks: np.ndarray, unreliable: np.ndarray, config: CorruptedConfig, *, wrist: bool = False
) -> np.ndarray:
    """bool (n,): runs of unchanged images during which the robot moved.

    The distance between its positions counts, not the length of its path: encoder noise adds up to a long path at rest.

    Args:
        change: (n,) mean absolute image change, frame i against i - 1 (0 for frame 0).
        tracks: (n, k, 3) positions [m] of k points that the view must show moving.
        unreliable: bool (n,) frames whose positions are wrong.
    """
    same = (change < config.max_frozen_change) & ~unreliable
    same[0] = False
    needed = config.min_frozen_motion_wrist_m if wrist else config.min_frozen_motion_m
    bad = np.zeros(len(change), dtype=bool)
    for start, stop in runs(same):
        if stop - start < config.min_frozen_frames or tracks.shape[1] == 0:
            continue
        during = tracks[start - 1 : stop] if not unreliable[start - 1] else tracks[start:stop]
        bad[start:stop] = np.linalg.norm(during.max(axis=0) - during.min(axis=0), axis=-1).max() >= needed
    return bad


def without_signal(pictures: PictureStatistics, config: CorruptedConfig) -> tuple[np.ndarray, np.ndarray]:
    """bool (n,) frames of nearly one grey level, and frames of noise."""
    blank = pictures.contrast < config.min_contrast
    return blank, (pictures.roughness > config.max_roughness) & ~blank


def garbled_frames(
    pictures: PictureStatistics, unusable: np.ndarray, fps: float, config: CorruptedConfig
) -> np.ndarray:
    """bool (n,): images with misplaced blocks, or with a part of a single grey level, for a short time.

    Args:
        unusable: bool (n,) frames in which something else is wrong.
    """
    bad = np.zeros(len(unusable), dtype=bool)
    longest = max(1, round(config.max_garbled_s * fps))
    # A part of a single grey level lowers the detail: the frames beside it must not be taken for the garbled ones.
    for values, rise in (
        (pictures.flat_share, config.max_flat_rise),
        (np.log(_relative_detail(pictures)), float(np.log(config.max_detail_rise))),
    ):
        steps = np.diff(values)
        steps[unusable[1:] | unusable[:-1] | bad[1:] | bad[:-1]] = 0
        steps[pictures.change[1:] < config.min_garbled_change] = 0
        bad |= _passing_rises(values, steps, rise, longest, unusable | bad)
    return bad


def _passing_rises(
    values: np.ndarray, steps: np.ndarray, rise: float, longest: int, unusable: np.ndarray
) -> np.ndarray:
    """bool (n,): short runs higher than the frames on both sides; at an end of the episode, than one side and the median.

    `steps`: (n - 1,) differences of values, 0 where no run may begin or end.
    """
    bad = np.zeros(len(values), dtype=bool)
    if unusable.all():
        return bad
    usual, last = float(np.median(values[~unusable])), len(values)
    for start in [0, *(np.flatnonzero(steps > rise) + 1).tolist()]:
        for stop in [*(np.flatnonzero(steps < -rise) + 1).tolist(), last]:
            at_end = start == 0 or stop == last
            if not 0 < stop - start <= (longest / 2 if at_end else longest) or unusable[start:stop].any():
                continue
            beside = [values[k] for k in (start - 1, stop) if 0 <= k < last] + ([usual] if at_end else [])
            if values[start:stop].min() > max(beside) + 0.8 * rise:
                bad[start:stop] = True
    return bad


def _relative_detail(pictures: PictureStatistics) -> np.ndarray:
    """(n,) detail over the squared mean level, which does not depend on brightness."""
    return np.maximum(pictures.detail, 1e-3) / np.maximum(pictures.mean, 1.0) ** 2


def detect_corrupted(
    pictures: PictureStatistics,
    tracks: np.ndarray,
    lost: np.ndarray,
    unreliable: np.ndarray,
    fps: float,
    config: CorruptedConfig,
    *,
    wrist: bool = False,
) -> Verdict:
    """Blank, noisy, garbled and frozen frames of one view.

    Args:
        tracks, unreliable: see `frozen_frames`.
        lost: bool (n,) frames that are too dark, overexposed or blurred; they are not counted again.
    """
    blank, noise = (flags & ~lost for flags in without_signal(pictures, config))
    # What a wrist camera sees changes its texture from frame to frame without a fault.
    garbled = np.zeros_like(blank) if wrist else garbled_frames(pictures, blank | noise | lost, fps, config)
    frozen = frozen_frames(pictures.change, tracks, unreliable, config, wrist=wrist)
    bad = blank | noise | garbled | frozen
    kinds = {"blank": blank, "noise": noise, "garbled": garbled, "frozen": frozen}
    return frame_verdict(
        "corrupted",
        bad.mean() <= config.max_bad_share,
        bad,
        {
            "image_change": config.max_frozen_change,
            "roughness": config.max_roughness,
            "relative_detail": float(np.median(_relative_detail(pictures))) * config.max_detail_rise,
            "flat_share": float(np.median(pictures.flat_share)) + config.max_flat_rise,
        },
        **{f"{kind}_frames": int(flags.sum()) for kind, flags in kinds.items()},
    )


PICTURE_FAULTS = ("too_dark", "overexposed", "blur", "corrupted")


def find_picture_faults(signals: Signals, config: FilterConfig, found: Sequence[Finding]) -> list[Finding]:
    """Checks every view, the primary one first, which alone decides for Stage I. A frame counts for its first fault."""
    primary, fps = signals.primary_view, signals.episode.fps
    unreliable = bad_frames(found, len(signals.gray[primary]), "joint_jump", "joint_speed", "joint_stuck")
    findings: list[Finding] = []
    for view in [primary, *(view for view in signals.gray if view != primary)]:
        stage = 1 if view == primary else 2
        pictures, wrist = signals.pictures[view], view.endswith("wrist")
        blank, noise = without_signal(pictures, config.corrupted)
        here = [
            Finding("too_dark", view, stage, detect_dark(pictures, noise, config.exposure, wrist=wrist)),
            Finding("overexposed", view, stage, detect_overexposed(pictures, config.exposure, wrist=wrist)),
        ]
        unusable = bad_frames(here, len(blank)) | blank | noise
        verdict = detect_blur(signals.sharpness[view], pictures, unusable, fps, config.blur, wrist=wrist)
        here.append(Finding("blur", view, stage, verdict))
        tracks, lost = signals.tracks(signals.arms_in(view)), bad_frames(here, len(blank))
        verdict = detect_corrupted(pictures, tracks, lost, unreliable, fps, config.corrupted, wrist=wrist)
        findings += [*here, Finding("corrupted", view, stage, verdict)]
    return findings


def detect_static(
    joint_speed: np.ndarray, gripper_speed: np.ndarray, image_change: np.ndarray, fps: float, config: StaticConfig
) -> Verdict:
    """Stretches in which neither the robot nor the image moves.

    Args:
        joint_speed: (n,) `range_speed` of the joints [rad/s] (or tools [m/s] where poses are recorded).
        gripper_speed: (n,) the same of the grippers, openings per second.
        image_change: (n,) mean absolute change of the coarse task-facing image, of 255.
    """
    still = (joint_speed < config.max_joint_speed_rad_s) & (gripper_speed < config.max_gripper_speed_per_s)
    # At either end half a window also covers the motion beside the stretch.
    half = max(1, round(SPEED_WINDOW_S * fps / 2))
    for start, stop in runs(still):
        still[max(0, start - half) : stop + half] = True
    still &= image_change < config.max_image_change
    bad = long_runs(still, config.min_run_s * fps)
    thresholds = {"joint_range_rad_s": config.max_joint_speed_rad_s, "coarse_image_change": config.max_image_change}
    return frame_verdict("static", not bad.all(), bad, thresholds)


def find_static(signals: Signals, config: FilterConfig, _: Sequence[Finding]) -> list[Finding]:
    """Looks for static stretches in the primary view."""
    view = signals.primary_view
    change = signals.pictures[view].coarse_change
    verdict = detect_static(signals.joint_speed, signals.gripper_speed, change, signals.episode.fps, config.static)
    return [Finding("static", view, 1, verdict)]


def return_home(
    joints: np.ndarray, fps: float, config: ResetConfig, commands: np.ndarray | None = None
) -> tuple[int, int] | None:
    """Frames (last before, first after) of the first return to the first pose, or None.

    Args:
        joints, commands: (n, j) [rad].
    """
    steps = np.abs(np.diff(joints, axis=0)).max(axis=1)
    from_home = np.abs(joints - joints[0]).max(axis=1)
    longest = min(max(1, round(config.max_return_s * fps)), len(steps))
    for i, j in _candidates(from_home, steps, longest, config):
        usual = _usual(np.concatenate([steps[:i], steps[j:]]))
        quick = (from_home[i] - from_home[j]) / (j - i) > _least(j - i, config) * usual
        if quick and not _broken_readings(joints, commands, i, j, usual):
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


_WINDOW = 4
"""Frames after which a reading that jumped does not count as having come back."""
_STILL_RAD = 0.03
"""Joints that are no further from their first positions have not moved: encoder noise is smaller."""


def _broken_readings(joints: np.ndarray, commands: np.ndarray | None, i: int, j: int, usual: float) -> bool:
    """True when the robot does not go home with its readings: only one of them, or few of those that are away, go home
    between the frames i and j; they jump back soon; they had jumped away and rested there; their commands stay away.

    Args:
        joints, commands: (n, j) [rad].
        usual: step of the episode [rad].
    """
    home = joints[0]
    before, after = np.abs(joints[[i, j]] - home)
    away = before > _STILL_RAD
    back = np.flatnonzero(away & (after <= 0.5 * before))
    if len(before) > 1 and len(back) <= max(1, away.sum() / 2):
        return True
    furthest = before.argmax()
    steps = np.abs(np.diff(joints[j : j + 1 + _WINDOW, furthest]))
    if (steps > max(0.5 * before[furthest], 2 * usual)).any():
        return True
    half = 0.5 * before[back]
    if all(_jumped_away(joints[: i + 1, k], max(least, 2 * usual)) for k, least in zip(back, half, strict=True)):
        return True
    if commands is None:
        return False
    followed = np.abs(commands[i] - joints[i])[back] <= half
    stay = np.abs(commands[j : j + 1 + _WINDOW] - home)[:, back].min(axis=0) > half
    return bool((followed & stay).all())


def _jumped_away(readings: np.ndarray, least: float) -> bool:
    """True when readings (n,) left their first value in one step of more than `least`, and then rested."""
    left = np.flatnonzero(np.abs(readings - readings[0]) <= least)[-1] + 1
    return len(readings) > left and bool(abs(readings[left] - readings[left - 1]) > least > np.ptp(readings[left:]))


def _usual(steps: np.ndarray) -> float:
    return float(np.percentile(steps, 90)) if len(steps) else 0.0


def _least(span: int, config: ResetConfig) -> float:
    return config.min_relative_step if span == 1 else config.min_relative_speed


def detect_reset(joints: np.ndarray, fps: float, config: ResetConfig, commands: np.ndarray | None = None) -> Verdict:
    """Frames from the first return to the first pose on; the attempt before it stays.

    Args:
        joints, commands: (n, j) joint positions [rad], without grippers.
    """
    found = return_home(joints, fps, config, commands)
    bad = np.zeros(len(joints), dtype=bool)
    if found is not None:
        bad[found[0] + 1 :] = True
    return frame_verdict("reset", True, bad, {"distance_from_home_rad": config.min_jump_rad})


_LARGE_STEPS = 2
"""A reading that jumps away and back makes two large steps; with a third it is motion."""


def jump_steps(joints: np.ndarray, config: JointMotionConfig) -> np.ndarray:
    """bool (n - 1, j): large steps among small ones.

    Args:
        joints: (n, j) [rad].
    """
    steps = np.abs(np.diff(joints, axis=0))
    jumps = np.zeros(steps.shape, dtype=bool)
    for i, joint in np.argwhere(steps > config.min_jump_rad):
        around = np.sort(steps[max(0, i - _WINDOW) : i + _WINDOW + 1, joint])
        others = around[: len(around) - _LARGE_STEPS]
        usual = float(others[-1]) if len(others) else 0.0
        jumps[i, joint] = steps[i, joint] > config.min_relative_step * usual
    return jumps


def detect_joint_jump(joints: np.ndarray, config: JointMotionConfig) -> Verdict:
    """Frames at which a reading jumps, and those between a jump and its way back, if that is soon or the reading rests.

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
            half = 0.5 * steps[first, joint]
            returned = abs(joints[second + 1, joint] - joints[first, joint]) < half
            if returned and (second - first <= _WINDOW or np.ptp(joints[first + 1 : second + 1, joint]) < half):
                bad[first + 1 : second + 1] = True
    return frame_verdict("joint_jump", True, bad, {"largest_step_rad": config.min_jump_rad})


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
    return frame_verdict("joint_speed", True, bad, {"joint_speed_rad_s": config.max_speed_rad_s})


_STUCK_S = 1.0


def detect_joint_stuck(joints: np.ndarray, commands: np.ndarray, fps: float, config: JointMotionConfig) -> Verdict:
    """Stretches in which a reading stays the same to the bit while its command moves further than a jump.

    Args:
        joints, commands: (n, j) [rad], without grippers.
    """
    bad = np.zeros(len(joints), dtype=bool)
    same = np.concatenate([np.zeros((1, joints.shape[1]), dtype=bool), np.diff(joints, axis=0) == 0])
    for joint in range(joints.shape[1]):
        for start, stop in runs(same[:, joint]):
            moved = float(np.ptp(commands[start - 1 : stop, joint]))
            if stop - start >= _STUCK_S * fps:
                bad[start:stop] |= moved > config.min_jump_rad
    return frame_verdict("joint_stuck", True, bad, {"commanded_rad": config.min_jump_rad})


def find_joint_faults(signals: Signals, config: FilterConfig, _: Sequence[Finding]) -> list[Finding]:
    """Resets first: what follows one is dropped, so that jumps and speeds after it do not count."""
    joints, fps = signals.joints, signals.episode.fps
    if joints is None or not joints.shape[1]:
        return []
    reset = Finding("reset", None, 1, detect_reset(joints, fps, config.reset, signals.commands))
    last = np.flatnonzero(~bad_frames([reset], len(joints)))[-1]
    held = joints[np.minimum(np.arange(len(joints)), last)]
    verdicts = [detect_joint_jump(held, config.joint_motion), detect_joint_speed(held, fps, config.joint_motion)]
    if signals.commands is not None:
        verdicts.append(detect_joint_stuck(joints, signals.commands, fps, config.joint_motion))
    return [reset, *(Finding(verdict.reason, None, 1, verdict) for verdict in verdicts)]


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
    medians = np.median(gray[:, ::2, ::2].reshape(count, -1), axis=1) + 1.0
    sampled = np.arange(0, count, max(1, round(_SAMPLE_S * fps)))

    def share(a: np.ndarray, b: np.ndarray) -> float:
        _, changed = cv2.threshold(cv2.absdiff(a, b), config.min_level_change, 255, cv2.THRESH_BINARY)
        return float((cv2.resize(changed, cells, interpolation=cv2.INTER_AREA) > 255 * _CELL_SHARE).mean())

    for i in sampled:
        before = min(max(0, i - lag // 2), count - 1 - lag)
        after = before + lag
        if not (usable[before] and usable[after]):
            continue
        area[i] = share(gray[before], gray[after])
        gain = float(medians[after] / medians[before])
        if area[i] > 0 and abs(gain - 1) > 0.03:
            area[i] = min(area[i], share(cv2.convertScaleAbs(gray[before], alpha=gain), gray[after]))
    return area[sampled[np.searchsorted(sampled, np.arange(count), side="right") - 1]]


def detect_base_motion(area: np.ndarray, fps: float, config: BaseMotionConfig) -> Verdict:
    """Stretches in which the whole picture moves.

    Args:
        area: (n,) from `changed_area` of a camera that is still in the base frame.
    """
    bad = long_runs(area > config.min_changed_area, config.min_run_s * fps, gap=0.25 * fps)
    passed = bad.mean() <= config.max_moving_share
    return frame_verdict("base_motion", passed, bad, {"changed_area": config.min_changed_area})


def find_base_motion(signals: Signals, config: FilterConfig, found: Sequence[Finding]) -> list[Finding]:
    """Looks for base motion in the primary view, unless its camera is known to move."""
    view = signals.primary_view
    camera = signals.episode.cameras.get(view)
    if camera is not None and camera.moving:
        return []
    unusable = bad_frames(found, len(signals.gray[view]), *PICTURE_FAULTS, view=view)
    area = changed_area(signals.gray[view], ~unusable, signals.episode.fps, config.base_motion)
    return [Finding("base_motion", view, 1, detect_base_motion(area, signals.episode.fps, config.base_motion))]
