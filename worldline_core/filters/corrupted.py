"""Corrupted images: blank, noise, garbage of a damaged stream, or frozen while the robot moves."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from worldline_core.config import StrictModel
from worldline_core.filters.signals import PictureStatistics
from worldline_core.filters.verdict import Curve, Verdict, runs


class CorruptedConfig(StrictModel):
    """Grey levels are of 255."""

    min_contrast: float = Field(
        default=4.0, gt=0, description="standard deviation over the image; less is a blank frame"
    )
    max_roughness: float = Field(
        default=0.5, gt=0, lt=1, description="1 - correlation of adjacent pixels; more is noise"
    )
    max_detail_rise: float = Field(
        default=1.42, gt=1, description="factor by which detail rises and falls at once; more is misplaced blocks"
    )
    max_flat_rise: float = Field(
        default=0.15, gt=0, lt=1, description="the same for the share of rows at an edge that have one grey level"
    )
    min_garbled_change: float = Field(
        default=6.0, ge=0, description="mean change with which garbage comes and goes; less is an arm that moves"
    )
    max_garbled_s: float = Field(default=1.25, gt=0, description="what stays longer is a scene that changed")
    max_frozen_change: float = Field(
        default=0.02,
        ge=0,
        description="mean absolute change below which frames are the same; a camera over a plain table shows 0.05",
    )
    min_frozen_motion_m: float = Field(
        default=0.05, gt=0, description="how far a tool gets during a freeze that makes it one"
    )
    min_frozen_motion_wrist_m: float = Field(
        default=0.2, gt=0, description="the same for a wrist camera, which may pass over a plain table without change"
    )
    min_frozen_frames: int = Field(default=4, ge=2)
    max_bad_share: float = Field(default=0.5, gt=0, le=1, description="more bad frames condemn the episode")


def frozen_frames(
    change: np.ndarray, tracks: np.ndarray, unreliable: np.ndarray, config: CorruptedConfig, *, wrist: bool = False
) -> np.ndarray:
    """bool (n,): runs of unchanged images during which the robot got on.

    How far it got counts, not how much it travelled: the noise of an encoder travels far in a long rest.

    Args:
        change: (n,) mean absolute image change, frame i against i - 1 (0 for frame 0).
        tracks: (n, k, 3) positions [m] of k things that the view must show moving.
        unreliable: bool (n,) frames whose positions are not to be believed.
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
    """bool (n,): pictures with misplaced blocks, or with a part of one grey level, that come and go from frame to frame.

    Args:
        unusable: bool (n,) frames in which something else is wrong.
    """
    bad = np.zeros(len(unusable), dtype=bool)
    longest = max(1, round(config.max_garbled_s * fps))
    # A part of one grey level takes detail away: the frames beside it must not be taken for the garbage.
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
    """bool (n,): runs that stand out from both neighbours at once; at an end of the episode, from one and from the rest.

    `steps`: (n - 1,) differences of values, 0 where nothing may begin or end.
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
    """(n,) detail over the squared mean level: more or less light leaves it as it is."""
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
        lost: bool (n,) frames that are too dark, overexposed or blurred; those are not counted here again.
    """
    blank, noise = (flags & ~lost for flags in without_signal(pictures, config))
    # What a wrist camera sees changes its texture from frame to frame without any fault.
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
            "largest_roughness": float(pictures.roughness.max()),
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
