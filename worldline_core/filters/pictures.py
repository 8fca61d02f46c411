"""Faults of the images of a view: too dark, overexposed, blurred, or corrupted.

Blur: the variance of the Laplacian (Pech-Pacheco et al. 2000) depends on the scene. Divided by the contrast of adjacent
pixels of the small image, which blur of a few pixels leaves as it is, scene and gain cancel. Corrupted: blank, noise,
garbled by a damaged stream, or frozen while the robot moves.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from worldline_core.filters.filter_config import BlurConfig, CorruptedConfig, ExposureConfig, FilterConfig
from worldline_core.filters.signals import PictureStatistics, Signals
from worldline_core.filters.verdict import Curve, Finding, Verdict, bad_frames, long_runs, runs

PICTURE_FAULTS = ("too_dark", "overexposed", "blur", "corrupted")


def detect_dark(
    pictures: PictureStatistics, noise: np.ndarray, config: ExposureConfig, *, wrist: bool = False
) -> Verdict:
    """Images that are black or too dark to see anything in; noise (bool (n,)) is another fault, however dark."""
    least = config.min_bright_level_wrist if wrist else config.min_bright_level
    bad = (pictures.bright_level < least) & ~noise
    return Verdict(
        "too_dark",
        float(bad.mean()) <= config.max_bad_share,
        {
            "bad_share": float(bad.mean()),
            "lowest_bright_level": float(pictures.bright_level.min()),
            "threshold_bright_level": least,
        },
        bad,
        {"bright_level": Curve(pictures.bright_level, least)},
    )


def detect_overexposed(pictures: PictureStatistics, config: ExposureConfig, *, wrist: bool = False) -> Verdict:
    """Images in which much of the sensor is saturated."""
    most = config.max_white_share_wrist if wrist else config.max_white_share
    bad = pictures.white_share > most
    return Verdict(
        "overexposed",
        float(bad.mean()) <= config.max_bad_share,
        {
            "bad_share": float(bad.mean()),
            "largest_white_share": float(pictures.white_share.max()),
            "threshold_white_share": most,
        },
        bad,
        {"white_share": Curve(pictures.white_share, most)},
    )


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
    curves = {"relative_sharpness": Curve(relative, least), "sharpness": Curve(sharpness, config.min_sharpness)}
    decisive = sorted(curves, key=lambda name: -int((curves[name].values < curves[name].threshold)[bad].sum()))
    return Verdict(
        "blur",
        float(bad.mean()) <= config.max_bad_share,
        {
            "bad_share": float(bad.mean()),
            "median_sharpness": float(np.median(sharpness)),
            "lowest_relative_sharpness": float(relative.min()),
            "threshold_sharpness": config.min_sharpness,
            "threshold_relative": least,
        },
        bad,
        {name: curves[name] for name in decisive},
    )


def frozen_frames(
    change: np.ndarray, tracks: np.ndarray, unreliable: np.ndarray, config: CorruptedConfig, *, wrist: bool = False
) -> np.ndarray:
    """bool (n,): runs of unchanged images during which the robot moved.

    The distance between its positions counts, not the length of its path: encoder noise adds up to a long path at rest.

    Args:
        change: (n,) mean absolute image change, frame i against i - 1 (0 for frame 0).
        tracks: (n, k, 3) positions [m] of k points that the view must show moving.
        unreliable: bool (n,) frames whose positions are wrong.
        wrist: whether the view is that of a wrist camera.
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
        (np.log(relative_detail(pictures)), float(np.log(config.max_detail_rise))),
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


def relative_detail(pictures: PictureStatistics) -> np.ndarray:
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
    detail = relative_detail(pictures)
    usual = float(np.median(detail))
    return Verdict(
        "corrupted",
        float(bad.mean()) <= config.max_bad_share,
        {
            "bad_share": float(bad.mean()),
            "blank_frames": int(blank.sum()),
            "noise_frames": int(noise.sum()),
            "garbled_frames": int(garbled.sum()),
            "frozen_frames": int(frozen.sum()),
            "threshold_bad_share": config.max_bad_share,
        },
        bad,
        {
            "image_change": Curve(pictures.change, config.max_frozen_change),
            "roughness": Curve(pictures.roughness, config.max_roughness),
            "relative_detail": Curve(detail, usual * config.max_detail_rise),
            "flat_share": Curve(pictures.flat_share, float(np.median(pictures.flat_share)) + config.max_flat_rise),
        },
    )


def find_picture_faults(signals: Signals, config: FilterConfig, found: Sequence[Finding]) -> list[Finding]:
    """Checks every view, the primary one first, which alone decides for Stage I. A frame counts for its first fault."""
    primary, fps = signals.primary_view, signals.episode.fps
    unreliable = bad_frames(found, len(signals.gray[primary]), "joint_jump", "joint_speed")
    findings: list[Finding] = []
    for view in [primary, *(view for view in signals.gray if view != primary)]:
        stage = 1 if view == primary else 2
        pictures, wrist = signals.pictures[view], view.endswith("wrist")
        blank, noise = without_signal(pictures, config.corrupted)
        exposure = [
            Finding("too_dark", view, stage, detect_dark(pictures, noise, config.exposure, wrist=wrist)),
            Finding("overexposed", view, stage, detect_overexposed(pictures, config.exposure, wrist=wrist)),
        ]
        lost = bad_frames(exposure, len(pictures.mean))
        sharpness = signals.sharpness[view]
        verdict = detect_blur(sharpness, pictures, lost | blank | noise, fps, config.blur, wrist=wrist)
        blur = Finding("blur", view, stage, verdict)
        lost = bad_frames([*exposure, blur], len(lost))
        tracks = signals.tracks(signals.arms_in(view))
        verdict = detect_corrupted(pictures, tracks, lost, unreliable, fps, config.corrupted, wrist=wrist)
        findings += [*exposure, blur, Finding("corrupted", view, stage, verdict)]
    return findings
