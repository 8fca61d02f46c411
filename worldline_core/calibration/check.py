"""`worldline calibrate check`: every episode of a source or a set diagnosed, pictured, and summed up.

Writes `diagnoses.json`, `index.html` and `pictures/<episode>.jpg` into one folder. Nothing is repaired here: the
result is a line for the source's configuration.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from tqdm import tqdm

from worldline_core.calibration.check_page import page
from worldline_core.calibration.check_report import as_json
from worldline_core.calibration.diagnosis import Diagnosis
from worldline_core.calibration.doctor import diagnose, diagnose_set
from worldline_core.calibration.findings import CalibrationCheck, Finding, SetFinding
from worldline_core.calibration.listing import ListedEpisode, repairing_lines
from worldline_core.calibration.pictures import diagnosis_picture
from worldline_core.data.curation.checks import check_camera, check_times, check_values
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.sources.base import LoadedEpisode
from worldline_core.errors import ConfigError, DataError, UnavailableError
from worldline_core.exports.pictures import jpeg_bytes
from worldline_core.exports.rollout import safe_stem
from worldline_core.store.atomic import write_bytes_atomic, write_json_atomic

if TYPE_CHECKING:
    from worldline_core.data.episodes.episode import Episode
    from worldline_core.geometry.kinematics import ArmKinematics

TIME_TOLERANCE_FRAMES = 0.25


class _Kinematics:
    """Kinematics by embodiment, built once; None, with the reason, where there are none."""

    def __init__(self, descriptions: dict[str, str]) -> None:
        self._descriptions = descriptions
        self._built: dict[str, tuple[ArmKinematics | None, str]] = {}

    def of(self, episode: Episode) -> tuple[ArmKinematics | None, str]:
        """Kinematics of an episode's robot, where it has as many arms as the recording."""
        built, note = self._get(episode.embodiment)
        poses = episode.T_base_ee
        if built is None or poses is None or poses.shape[1] == len(built.embodiment.arms):
            return built, note
        return None, f"without kinematics of {episode.embodiment}: it has other arms than the recording"

    def _get(self, name: str) -> tuple[ArmKinematics | None, str]:
        from worldline_core.geometry.embodiment import load_embodiment
        from worldline_core.geometry.kinematics import ArmKinematics

        if name not in self._built:
            try:
                self._built[name] = (ArmKinematics(load_embodiment(name, self._descriptions.get(name))), "")
            except (ConfigError, DataError, UnavailableError) as error:
                self._built[name] = (None, f"without kinematics of {name}: {error.what}")
        return self._built[name]


def check_calibration(
    listed: Sequence[ListedEpisode],
    output: Path,
    *,
    descriptions: dict[str, str] | None = None,
    pictures: bool = True,
) -> CalibrationCheck:
    """Diagnose episodes one after another and write what was found.

    An episode that cannot be read is listed with its reason; the others are not touched by it.

    Raises:
        DataError: there are no episodes to check.
    """
    if not listed:
        raise DataError("There are no episodes to check", next_step="see the source's path and its `include` patterns")
    kinematics = _Kinematics(descriptions or {})
    findings: list[Finding] = []
    with tqdm(listed, "calibrate check", unit="episode", disable=None) as progress:
        for item in progress:
            findings.append(_check_one(item, output, kinematics, pictures))
            progress.set_postfix_str(findings[-1].verdict)
    check = CalibrationCheck(tuple(findings), tuple(_sum_up(listed, findings)), output)
    write_json_atomic(output / "diagnoses.json", as_json(check))
    write_bytes_atomic(output / "index.html", page(check).encode())
    return check


def _check_one(item: ListedEpisode, output: Path, kinematics: _Kinematics, pictures: bool) -> Finding:
    try:
        loaded = item.load()
        episode = loaded.episode
        check_values(episode)
        check_times(episode, TIME_TOLERANCE_FRAMES)
        for camera in episode.cameras.values():
            check_camera(episode, camera)
        frames = {view: _images(loaded, view) for view in loaded.views}
        arms, note = kinematics.of(episode)
        notes = (note,) if note else ()
        diagnosis = diagnose(episode, frames, arms)
    except RejectedInputError as error:
        return Finding(item.episode_id, item.source, None, error.reason, _one_line(error))
    except DataError as error:
        return Finding(item.episode_id, item.source, None, "unreadable", _one_line(error))
    lines: tuple[str, ...] = ()
    try:
        lines = repairing_lines(item, diagnosis.best)
    except ConfigError as error:
        notes = (*notes, f"{error.what}: {error.next_step}")
    picture: str | None = None
    if pictures:
        try:
            picture = _write_picture(output, diagnosis, episode, frames, arms)
        except DataError as error:
            notes = (*notes, f"no picture: {error.what}")
    return Finding(item.episode_id, item.source, diagnosis, None, "", lines, picture, notes)


def _images(loaded: LoadedEpisode, view: str) -> np.ndarray:
    images = np.asarray(loaded.frames(view))
    expected = loaded.episode.num_video_frames
    if len(images) != expected:
        raise RejectedInputError(
            "length_mismatch",
            "Video and states differ in length",
            where=f"episode {loaded.episode.episode_id}, view {view}",
            expected=f"{expected} frames",
            got=f"{len(images)} frames",
            evidence={"states": expected, "frames": len(images)},
        )
    return images


def _one_line(error: DataError) -> str:
    details = (("expected", error.expected), ("got", error.got))
    return "; ".join([error.what, *(f"{name} {value}" for name, value in details if value is not None)])


def _write_picture(
    output: Path,
    diagnosis: Diagnosis,
    episode: Episode,
    frames: dict[str, np.ndarray],
    kinematics: ArmKinematics | None,
) -> str:
    name = f"pictures/{safe_stem(diagnosis.episode_id)}.jpg"
    picture = diagnosis_picture(diagnosis, episode, frames, kinematics)
    write_bytes_atomic(output / name, jpeg_bytes(picture))
    return name


def _sum_up(listed: Sequence[ListedEpisode], findings: Sequence[Finding]) -> Iterator[SetFinding]:
    """A conclusion for each source that more than one episode could be diagnosed of."""
    for source in dict.fromkeys(item.source for item in listed):
        of_source = next(item for item in listed if item.source == source)
        diagnoses = [f.diagnosis for f in findings if f.source == source and f.diagnosis is not None]
        if len(diagnoses) < 2:
            continue
        summed = diagnose_set(source, diagnoses)
        try:
            yield SetFinding(summed, repairing_lines(of_source, summed.best))
        except ConfigError as error:
            notes = (*summed.notes, f"{error.what}: {error.next_step}")
            yield SetFinding(replace(summed, notes=notes), ())
