"""The calibration doctor as a detector: no usual mistake explains the recording better than what it says of itself.

An explained mistake condemns the episode for Stage II as well: its evidence names the configuration line that repairs
the source, and nothing is repaired silently.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Literal

import numpy as np

from worldline_core.calibration.config import CalibrationDoctorConfig
from worldline_core.calibration.diagnosis import Diagnosis
from worldline_core.calibration.doctor import bad_terms, diagnose
from worldline_core.data.episode import Episode
from worldline_core.errors import UnavailableError
from worldline_core.filters.verdict import Verdict, runs
from worldline_core.geometry.embodiment import embodiment_names, load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics


class FilterDoctorConfig(CalibrationDoctorConfig):
    """As the doctor's, but other readings are tried only where the recorded one looks bad."""

    search: Literal["always", "when_suspicious"] = "when_suspicious"


_UNEXPLAINED = "calibration_unexplained"


def detect_mistake(
    episode: Episode, gray: Mapping[str, np.ndarray], bad_frames: np.ndarray, config: CalibrationDoctorConfig
) -> Verdict:
    """Whether the recording's calibration is consistent; if not, the explanation and the line that repairs it.

    Args:
        gray: by view, uint8 (n, h, w).
        bad_frames: bool (n,), frames that other detectors dropped; the longest stretch without any is judged.
    """
    stretches = runs(~bad_frames)
    if not stretches:
        return Verdict(_UNEXPLAINED, True, {"verdict": "too_little_evidence"})
    start, stop = max(stretches, key=lambda stretch: stretch[1] - stretch[0])
    if (start, stop) != (0, len(bad_frames)):
        episode = episode.cut(start, stop)
        gray = {view: images[start:stop] for view, images in gray.items()}
    diagnosis = diagnose(episode, gray, kinematics_of(episode), config)
    return Verdict(
        _reason(diagnosis), diagnosis.verdict in ("consistent", "too_little_evidence"), _numbers(diagnosis, config)
    )


def _reason(diagnosis: Diagnosis) -> str:
    if diagnosis.verdict != "explained":
        return _UNEXPLAINED
    lags = all(field.endswith("lag_frames") for field in diagnosis.best.conventions.departures)
    return "time_alignment" if lags else "calibration"


def _numbers(diagnosis: Diagnosis, config: CalibrationDoctorConfig) -> dict[str, float | int | str | None]:
    numbers: dict[str, float | int | str | None] = {
        "verdict": diagnosis.verdict,
        "mistake": diagnosis.best.mistake,
        "score_as_recorded": diagnosis.none.score,
        "threshold_margin": config.min_margin,
    }
    if diagnosis.verdict == "explained":
        numbers |= {"score_repaired": diagnosis.best.score, "config": "; ".join(diagnosis.best.config_lines)}
    if diagnosis.verdict == "unexplained":
        bad = bad_terms(diagnosis.none, config)
        numbers |= {"bad": ", ".join(sorted(bad, key=lambda name: bad[name]))}
    return numbers


def kinematics_of(episode: Episode) -> ArmKinematics | None:
    """Of the episode's embodiment; None where it is unknown, its description is not here, or it is of another layout."""
    kinematics = _load(episode.embodiment) if episode.embodiment in embodiment_names() else None
    if kinematics is None:
        return None
    embodiment, poses = kinematics.embodiment, episode.T_base_ee
    if poses is not None and poses.shape[1] != len(embodiment.arms):
        return None
    fits = episode.state_kind != "joints" or episode.state.shape[1] == embodiment.state_size
    return kinematics if fits else None


@lru_cache(maxsize=16)
def _load(name: str) -> ArmKinematics | None:
    try:
        return ArmKinematics(load_embodiment(name))
    except UnavailableError:  # the doctor then judges recorded tool poses without a stated mount
        return None
