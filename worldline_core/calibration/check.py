"""`worldline calibrate check`: every episode of a source or a set diagnosed, pictured, and summed up.

Writes `diagnoses.json`, `index.html` and `pictures/<episode>.jpg` into one folder. Nothing is repaired here.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from worldline_core.calibration.calibration_doctor import diagnose
from worldline_core.calibration.check_report import CalibrationCheck, EpisodeCheck, as_json, diagnosis_picture, page
from worldline_core.calibration.diagnosis import Explanation, SourceDiagnosis, diagnose_source
from worldline_core.config import apply_overrides, load_config, read_config
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.curation.recorded_episode import check_camera, check_times, check_values
from worldline_core.data.episodes.conventions import RecordedConventions
from worldline_core.data.episodes.episode import Episode
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.episodes.source import LoadedEpisode
from worldline_core.data.guards.reader_process import ReaderLimits
from worldline_core.data.guards.rejection import RejectedInputError, check_length
from worldline_core.data.guards.source_paths import safe_stem
from worldline_core.data.sources.open import GuardedSource, SourceConfig
from worldline_core.data.video.frames import MadeFrames
from worldline_core.errors import ConfigError, DataError, UnavailableError
from worldline_core.geometry.kinematics import ArmKinematics, KinematicsByName
from worldline_core.pictures import jpeg_bytes
from worldline_core.progress import Progress
from worldline_core.scale.account import crash_evidence
from worldline_core.scale.mapping import ends_the_run
from worldline_core.store.artifact_files import verify_artifact
from worldline_core.store.atomic import write_bytes_atomic, write_json_atomic

logger = logging.getLogger(__name__)

OUTPUT_ROOT = Path("artifacts") / "calibration"


@dataclass(frozen=True)
class ListedEpisode:
    """An episode to check, and the configuration of its source.

    Attributes:
        declared: conventions that the configuration declares already.
        declares_robot: whether the configuration names the robot, not the recording.
    """

    episode_id: str
    source: str
    load: Callable[[], LoadedEpisode]
    config_prefix: str = "curate.sources[].conventions"
    declared: RecordedConventions = field(default_factory=RecordedConventions)
    declares_robot: bool = False


def repairing_lines(item: ListedEpisode, explanation: Explanation) -> tuple[str, ...]:
    """Lines for the source's configuration if the explanation holds; none for the recording as written, or where no line
    repairs it."""
    if explanation.other is not None and explanation.other[0] == "embodiment" and item.declares_robot:
        return (f"{item.config_prefix.removesuffix('conventions')}{': '.join(explanation.other)}",)
    if explanation.other is not None or not explanation.departures:
        return ()
    if item.declared.departures:
        return (f"remove {item.config_prefix} and check again: beside them, {explanation.text} was found",)
    return explanation.conventions.config_lines(item.config_prefix)


def episodes_of_config(path: Path, overrides: Sequence[str]) -> tuple[list[ListedEpisode], dict[str, str]]:
    """The episodes of every source in a file's `curate` section, and its kinematic descriptions by embodiment."""
    values = apply_overrides(read_config(None, path), overrides)
    if not values.get("curate"):
        raise ConfigError("The file configures no source", where=path, expected="a section `curate` with `sources`")
    config = load_config(CurateConfig, path=path, overrides=overrides, section="curate")
    descriptions = (values.get("render_actions") or {}).get("description_paths") or {}
    files = {str(name): str(file) for name, file in descriptions.items()}
    return episodes_of_sources(config.sources, config.reader), files


def episodes_of_sources(sources: Iterable[SourceConfig], limits: ReaderLimits) -> list[ListedEpisode]:
    """The episodes of every source. One is first read through in a process with limits, then here."""
    listed: list[ListedEpisode] = []
    for number, source_config in enumerate(sources):
        source = GuardedSource(source_config, limits)
        prefix = f"curate.sources[{number}].conventions"
        declared, robot = source_config.conventions, "embodiment" in type(source_config).model_fields
        listed += [
            ListedEpisode(episode_id, source_config.label, partial(source.load, episode_id), prefix, declared, robot)
            for episode_id in source.episode_ids()
        ]
    return listed


def episodes_of_artifact(folder: Path) -> list[ListedEpisode]:
    """The episodes of an EpisodeSet, compared with its manifest."""
    verify_artifact(folder)
    episodes = EpisodeSet.open(folder)

    def load(position: int) -> LoadedEpisode:
        views = tuple(episodes.rows[position].views)
        clips = {view: episodes.clip(position, view) for view in views}
        return LoadedEpisode(episodes.episode(position), views, clips=clips)

    return [ListedEpisode(row.episode_id, row.source, partial(load, i)) for i, row in enumerate(episodes.rows)]


def check_calibration(
    listed: Sequence[ListedEpisode], output: Path, *, descriptions: Mapping[str, str] | None = None
) -> CalibrationCheck:
    """Diagnoses episodes one after another and writes the result; one that cannot be read or judged is listed with its reason.

    Raises:
        OSError: the disk is full or cannot be written, which no other episode would escape.
    """
    kinematics = KinematicsByName(descriptions or {})
    checked: list[EpisodeCheck] = []
    with Progress("calibrate check", len(listed), "episode") as progress:
        for item in listed:
            try:
                checked.append(_check_one(item, output, kinematics))
            except Exception as error:
                if ends_the_run(error):
                    raise
                evidence = crash_evidence(error)
                detail = f"{evidence['type']}: {evidence['message']} ({evidence['trace'][-1]}); report this bug"
                checked.append(EpisodeCheck(item.episode_id, item.source, None, "crashed", detail))
            progress.advance(verdict=checked[-1].verdict)
    check = CalibrationCheck(tuple(checked), tuple(_sum_up(listed, checked)), output)
    write_json_atomic(output / "diagnoses.json", as_json(check))
    write_bytes_atomic(output / "index.html", page(check).encode())
    return check


def _check_one(item: ListedEpisode, output: Path, kinematics: KinematicsByName) -> EpisodeCheck:
    try:
        loaded = item.load()
        episode = loaded.episode
        check_values(episode)
        check_times(episode)
        for camera in episode.cameras.values():
            check_camera(episode, camera)
        frames = {view: episode_images(loaded, view) for view in loaded.views}
        arms, note = _kinematics_of(episode, kinematics)
        notes = (note,) if note else ()
        diagnosis = diagnose(episode, frames, arms)
    except DataError as error:
        reason = error.reason if isinstance(error, RejectedInputError) else "unreadable"
        details = (("expected", error.expected), ("got", error.got))
        said = "; ".join([error.what, *(f"{name} {value}" for name, value in details if value is not None)])
        return EpisodeCheck(item.episode_id, item.source, None, reason, said)
    picture: str | None = f"pictures/{safe_stem(diagnosis.episode_id)}.jpg"
    try:
        write_bytes_atomic(output / picture, jpeg_bytes(diagnosis_picture(diagnosis, episode, frames, arms)))
    except DataError as error:
        picture, notes = None, (*notes, f"no picture: {error.what}")
    lines = repairing_lines(item, diagnosis.best)
    return EpisodeCheck(item.episode_id, item.source, diagnosis, config_lines=lines, picture=picture, notes=notes)


def _kinematics_of(episode: Episode, kinematics: KinematicsByName) -> tuple[ArmKinematics | None, str]:
    """Kinematics of an episode's robot where it has as many arms as the recording; else None, and why."""
    try:
        built = kinematics.get(episode.embodiment)
    except (ConfigError, DataError, UnavailableError) as error:
        how = f" ({error.next_step})" if error.next_step else ""
        return None, f"without kinematics of {episode.embodiment}: {error.what}{how}"
    if episode.T_base_ee is None or episode.T_base_ee.shape[1] == len(built.embodiment.arms):
        return built, ""
    return None, f"without kinematics of {episode.embodiment}: it has other arms than the recording"


def episode_images(loaded: LoadedEpisode, view: str) -> MadeFrames:
    """A view's pictures, read anew by each iteration: an episode may be too long for memory."""
    expected = loaded.episode.num_video_frames

    def counted() -> Iterator[np.ndarray]:
        found = 0
        for image in loaded.each_image(view):
            yield image
            found += 1
        where = f"episode {loaded.episode.episode_id}, view {view}"
        check_length("Video", where, states=expected, unit="frames", found=found)

    return MadeFrames(counted, (expected,), np.uint8)


def _sum_up(listed: Sequence[ListedEpisode], checked: Sequence[EpisodeCheck]) -> Iterator[SourceDiagnosis]:
    """A conclusion for each source that more than one episode could be diagnosed of."""
    for source in dict.fromkeys(item.source for item in listed):
        of_source = next(item for item in listed if item.source == source)
        diagnoses = [f.diagnosis for f in checked if f.source == source and f.diagnosis is not None]
        if len(diagnoses) < 2:
            continue
        summed = diagnose_source(source, diagnoses)
        yield replace(summed, config_lines=repairing_lines(of_source, summed.best))


def check_command(
    config: Path | None,
    artifact: Path | None,
    *,
    overrides: Sequence[str] = (),
    episodes: Sequence[str] = (),
    output: Path | None = None,
) -> CalibrationCheck:
    """Check the sources of a configuration file, or an EpisodeSet.

    Args:
        overrides: `a.b=value`, changes of the file.
        episodes: ids to look at; none: all.
        output: default `artifacts/calibration/<name of the file or folder>`.

    Raises:
        ConfigError: neither or both of file and folder are given, or the file has a mistake.
        DataError: the source cannot be opened, or has no such episode.
        ArtifactError: the EpisodeSet is damaged.
    """
    descriptions: dict[str, str] = {}
    if artifact is not None and config is None:
        if overrides:
            raise ConfigError("--set changes a configuration file, and none is given", got=", ".join(overrides))
        listed, name = episodes_of_artifact(artifact), artifact.resolve().name
    elif config is not None and artifact is None:
        (listed, descriptions), name = episodes_of_config(config, overrides), config.stem
    else:
        raise ConfigError("Give a source's configuration file or an EpisodeSet", got=f"{config}, {artifact}")
    known = {item.episode_id for item in listed}
    if unknown := set(episodes) - known:
        expected = f"one of {len(known)} ids, such as {', '.join(sorted(known)[:3])}"
        raise DataError("No such episode", expected=expected, got=", ".join(sorted(unknown)))
    chosen = [item for item in listed if not episodes or item.episode_id in episodes]
    return check_calibration(chosen, output or OUTPUT_ROOT / name, descriptions=descriptions)
