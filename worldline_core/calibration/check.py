"""`worldline calibrate check`: every episode of a source or a set diagnosed, pictured, and summed up.

Unlike action tracks, which let wrist cameras follow the kinematics, pictures use the camera poses *as recorded*. The arms'
outline is drawn into the head view: beside the arm it is the plainest sign of a wrong calibration.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch

from worldline_core.actions.action_tracks import project_tools, tracks_of_projection
from worldline_core.actions.episode_tracks import HEAD_VIEW, EpisodeTracks
from worldline_core.actions.overlays import OverlayStyle, draw_overlay, legend_strip
from worldline_core.actions.robot_masks import robot_capsules, tool_capsules
from worldline_core.calibration.calibration_doctor import diagnose
from worldline_core.calibration.camera_errors import SCALE, moved_camera
from worldline_core.calibration.diagnosis import Diagnosis, Explanation, SourceDiagnosis, VerdictName, diagnose_source
from worldline_core.config import apply_overrides, load_config, read_config
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.curation.recorded_episode import check_camera, check_times, check_values
from worldline_core.data.episodes.conventions import RecordedConventions, apply_conventions, frames_with_all
from worldline_core.data.episodes.episode import Episode
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.episodes.source import LoadedEpisode
from worldline_core.data.guards.reader_process import ReaderLimits
from worldline_core.data.guards.rejection import RejectedInputError, check_length
from worldline_core.data.guards.source_paths import safe_stem
from worldline_core.data.sources.open import GuardedSource, SourceConfig
from worldline_core.data.video.frames import Frames, MadeFrames
from worldline_core.errors import ConfigError, DataError, UnavailableError
from worldline_core.geometry.kinematics import ArmKinematics, KinematicsByName
from worldline_core.pages.page import render, words
from worldline_core.pictures import Picture, SheetRow, contact_sheet, draw_tag, evenly_spaced, jpeg_bytes
from worldline_core.progress import Progress
from worldline_core.scale.account import crash_evidence
from worldline_core.scale.mapping import ends_the_run
from worldline_core.store.artifact_files import verify_artifact
from worldline_core.store.atomic import write_bytes_atomic, write_json_atomic

OUTPUT_ROOT = Path("artifacts") / "calibration"
TILE_HEIGHT, MIN_WIDTH, MOMENTS = 256, 760, 3
SIGMA_PX_REF = 18.0
"""Wide enough to be seen at tile size, narrow enough to leave the gripper visible."""


@dataclass(frozen=True)
class EpisodeCheck:
    """A diagnosis; `reason`: the code where none could be made. `picture` is relative to the output folder."""

    episode_id: str
    source: str
    diagnosis: Diagnosis
    reason: str | None = None
    picture: str | None = None


@dataclass(frozen=True)
class CalibrationCheck:
    """All results, and the folder that they were written to."""

    episodes: tuple[EpisodeCheck, ...]
    sources: tuple[SourceDiagnosis, ...]
    output: Path

    @property
    def consistent(self) -> bool:
        """True if some episode is consistent by its pictures, and nothing is wrong with any other."""
        verdicts = {episode.diagnosis.verdict for episode in self.episodes}
        seen = any(episode.diagnosis.camera_errors for episode in self.episodes)
        sound = not verdicts & {"off", "explained", "unexplained", "unreadable", "not_judged"}
        together = all(s.verdict not in ("off", "explained", "mixed") for s in self.sources)
        return sound and seen and "consistent" in verdicts and together


@dataclass(frozen=True)
class ListedEpisode:
    """An episode to check, and what its source's configuration declares: conventions, and whether it names the robot."""

    episode_id: str
    source: str
    load: Callable[[], LoadedEpisode]
    config_prefix: str = "curate.sources[].conventions"
    declared: RecordedConventions = field(default_factory=RecordedConventions)
    declares_robot: bool = False


def repairing_lines(item: ListedEpisode, explanation: Explanation) -> tuple[str, ...]:
    """Lines for the source's configuration if the explanation holds; none where no line repairs the recording."""
    if explanation.other is not None:
        line = f"{item.config_prefix.removesuffix('conventions')}{': '.join(explanation.other)}"
        return (line,) if explanation.other[0] == "embodiment" and item.declares_robot else ()
    if not explanation.departures:
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
    for number, config in enumerate(sources):
        source, prefix = GuardedSource(config, limits), f"curate.sources[{number}].conventions"
        declares = prefix, config.conventions, "embodiment" in type(config).model_fields
        names = source.episode_ids()
        listed += [ListedEpisode(name, config.label, partial(source.load, name), *declares) for name in names]
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
    """Diagnoses episodes one after another and writes `diagnoses.json`, `index.html` and `pictures/<episode>.jpg`; one that cannot
    be read or judged is listed with its reason. Raises: OSError for a disk that cannot be written.
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
                checked.append(_without_diagnosis(item, "not_judged", "crashed", detail))
            progress.advance(verdict=checked[-1].diagnosis.verdict)
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
        arms, notes = _kinematics_of(episode, kinematics)
        found = diagnose(episode, frames, arms)
    except DataError as error:
        reason = error.reason if isinstance(error, RejectedInputError) else "unreadable"
        details = [f"{name} {value}" for name in ("expected", "got") if (value := getattr(error, name)) is not None]
        return _without_diagnosis(item, "unreadable", reason, "; ".join([error.what, *details]))
    picture: str | None = f"pictures/{safe_stem(episode.episode_id)}.jpg"
    try:
        write_bytes_atomic(output / picture, jpeg_bytes(diagnosis_picture(found, episode, frames, arms)))
    except DataError as error:
        picture, notes = None, (*notes, f"no picture: {error.what}")
    found = replace(found, notes=found.notes + notes, config_lines=repairing_lines(item, found.best))
    return EpisodeCheck(item.episode_id, item.source, found, picture=picture)


def _without_diagnosis(item: ListedEpisode, verdict: VerdictName, reason: str, detail: str) -> EpisodeCheck:
    why = " ".join(f"{reason}: {detail}".split())  # one line of the table
    return EpisodeCheck(item.episode_id, item.source, Diagnosis(verdict=verdict, notes=(why,)), reason)


def _kinematics_of(episode: Episode, kinematics: KinematicsByName) -> tuple[ArmKinematics | None, tuple[str, ...]]:
    """Kinematics of an episode's robot where it has as many arms as the recording; else None, and a note that says why."""
    try:
        built = kinematics.get(episode.embodiment)
    except (ConfigError, DataError, UnavailableError) as error:
        how = f" ({error.next_step})" if error.next_step else ""
        return None, (f"without kinematics of {episode.embodiment}: {error.what}{how}",)
    if episode.T_base_ee is None or episode.T_base_ee.shape[1] == len(built.embodiment.arms):
        return built, ()
    return None, (f"without kinematics of {episode.embodiment}: it has other arms than the recording",)


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
    first: dict[str, ListedEpisode] = {}
    for item in listed:
        first.setdefault(item.source, item)
    for source, item in first.items():
        diagnoses = [f.diagnosis for f in checked if f.source == source and f.reason is None]
        if len(diagnoses) > 1:
            summed = diagnose_source(source, diagnoses)
            yield replace(summed, config_lines=repairing_lines(item, summed.best))


def check_command(
    path: Path,
    *,
    artifact: bool = False,
    overrides: Sequence[str] = (),
    episodes: Sequence[str] = (),
    output: Path | None = None,
) -> CalibrationCheck:
    """Check some `episodes` (none: all) of a configuration file's sources or, with `artifact`, of an EpisodeSet's folder;
    `overrides` (`a.b=value`) change the file. Writes into `output`, by default `artifacts/calibration/<name of the file or folder>`.

    Raises: ConfigError for a mistake in the file, or a folder that is to be changed; DataError for a source that cannot be
        opened, or has no such episode; ArtifactError for a damaged EpisodeSet.
    """
    if artifact and overrides:
        raise ConfigError("--set changes a configuration file, and none is given", got=", ".join(overrides))
    listed, descriptions = (episodes_of_artifact(path), {}) if artifact else episodes_of_config(path, overrides)
    name = path.resolve().name if artifact else path.stem
    known = {item.episode_id for item in listed}
    if unknown := set(episodes) - known:
        expected = f"one of {len(known)} ids, such as {', '.join(sorted(known)[:3])}"
        raise DataError("No such episode", expected=expected, got=", ".join(sorted(unknown)))
    chosen = [item for item in listed if not episodes or item.episode_id in episodes]
    return check_calibration(chosen, output or OUTPUT_ROOT / name, descriptions=descriptions)


# Texts and pages


def verdict_text(found: Diagnosis) -> str:
    """The verdict: what explains it, the cameras that are off or what could have gone unseen, and the views that nothing judges."""
    said = words(found.verdict)
    if found.verdict == "off":
        said = f"off: {', '.join(map(str, found.off))}"
    elif found.verdict == "explained":
        said = f"explained by {found.best.text}"
    elif found.verdict == "mixed":
        said = "mixed: its episodes were not written the same way, no line is right for all of them"
    elif found.verdict == "consistent" and found.camera_errors:
        # How far the robot may be from its place in the picture; of a wrist camera, by how much it may be turned.
        shown = [(e.view, e.kinds[-1] if e.shown is not None else e.kinds[0]) for e in found.camera_errors]
        said += f" within {', '.join(f'{kind.bound:.1f} {kind.unit} ({view})' for view, kind in shown)}"
    elif found.verdict == "consistent":
        said += " by its poses, but no picture says within what"
    return f"{said}; not judged: {', '.join(found.not_judged)}" if found.not_judged else said


def table_text(check: CalibrationCheck) -> str:
    """A line for each episode, with what its source's conclusion does not say, and the conclusions."""
    together = {found.source: found for found in check.sources}
    width = max((len(episode.episode_id) for episode in check.episodes), default=0)
    lines = []
    for episode in check.episodes:
        own, summed = episode.diagnosis, together.get(episode.source)
        lines.append(f"{episode.episode_id:<{width}}  {verdict_text(own)}")
        told = own.verdict in ("consistent", "off", "too_little_evidence")
        if summed is None or (not told and (own.verdict, own.config_lines) != (summed.verdict, summed.config_lines)):
            lines += detail_lines(own)
    return "\n".join([*lines, "", *conclusion_lines(check), "", f"pictures: {check.output / 'index.html'}"])


def detail_lines(found: Diagnosis) -> list[str]:
    """Notes, what comes nearest, and what repairs it in the configuration of the source."""
    lines = [f"note: {note}" for note in found.notes] + [f"near: {near}" for near in found.nearest]
    return [f"    {line}" for line in (*lines, *found.config_lines)]


def conclusion_lines(check: CalibrationCheck) -> list[str]:
    """Numbers of episodes by verdict, then the conclusion over each source."""
    counts = Counter(episode.diagnosis.verdict for episode in check.episodes)
    parts = [f"{counts[name]} {words(name)}" for name in get_args(VerdictName) if counts[name]]
    lines = [f"{len(check.episodes)} episodes: {', '.join(parts)}"]
    for found in check.sources:
        lines += ["", f"source {found.source}, {found.num_episodes} episodes together: {verdict_text(found)}"]
        for error in found.camera_errors:
            bounds = [f"{each.kind} {each.bound:.1f} {each.unit}" for each in error.kinds]
            lines.append(f"    {error.view} within: {', '.join(bounds)}")
            if error.contradicting:
                lines.append(f"    {error.view}: {error.contradicting} of {error.episodes} episodes say otherwise")
        lines += [f"    {view} not judged: {why}" for view, why in found.not_judged.items()]
        lines += detail_lines(found)
    return lines


def as_json(check: CalibrationCheck) -> dict[str, Any]:
    """Verdicts, bounds and lines of all episodes and sources in plain values."""
    names = ("episode_id", "source", "reason", "picture")
    episodes = [
        {name: getattr(each, name) for name in names} | _diagnosis_json(each.diagnosis) for each in check.episodes
    ]
    sources = [{"source": s.source, "num_episodes": s.num_episodes} | _diagnosis_json(s) for s in check.sources]
    return {"consistent": check.consistent, "episodes": episodes, "sources": sources}


def _diagnosis_json(found: Diagnosis) -> dict[str, Any]:
    bounds = [
        {"view": e.view, "off": e in found.off, "kind": each.kind, "unit": each.unit, "bound": each.bound}
        for e in found.camera_errors
        for each in e.kinds
    ]
    names = ("verdict", "notes", "nearest", "not_judged", "config_lines")
    plain = {name: getattr(found, name) for name in names}
    return {**plain, "mistake": found.best.mistake, "camera_errors": bounds}


def page(check: CalibrationCheck) -> str:
    """The page: conclusions first, then a picture of each episode, the worst first."""
    order = get_args(VerdictName)
    episodes = sorted(check.episodes, key=lambda e: (order.index(e.diagnosis.verdict), e.episode_id))
    return render(
        "calibration/check_page.html",
        title="Calibration check",
        subtitle=f"{len(episodes)} episodes, judged by what they show.",
        episodes=episodes,
        verdict_text=verdict_text,
        conclusions="\n".join(conclusion_lines(check)),
    )


# Pictures


def diagnosis_picture(
    diagnosis: Diagnosis, recorded: Episode, frames: Mapping[str, Frames], kinematics: ArmKinematics | None
) -> Picture:
    """One picture per episode: left as recorded, right as repaired, the same frames on both sides.

    Raises: DataError when nothing can be drawn in any view.
    """
    conventions, sides = diagnosis.best.conventions, {f"{recorded.episode_id}, as recorded": recorded}
    after = f"repaired ({verdict_text(diagnosis)})"
    if conventions.departures:
        sides[after] = apply_conventions(recorded, conventions)
    elif diagnosis.verdict == "off":
        cameras = {e.view: moved_camera(recorded.cameras[e.view], e.estimate / SCALE) for e in diagnosis.off}
        sides[after] = replace(recorded, cameras={**recorded.cameras, **cameras})
    rows: dict[str, list[SheetRow]] = {title: [] for title in sides}
    arms: Sequence[str] = ()
    for view in (view for view in frames if view in recorded.cameras):
        tracks = [recorded_tracks(episode, view, kinematics) for episode in sides.values()]
        # Image m belongs to state m as recorded, and to state m - lag of the repaired episode.
        lags = (0, frames_with_all(recorded.num_frames, conventions)[0] + conventions.image_lag(view))[: len(sides)]
        both = list(zip(tracks, lags, strict=True))
        common = [n for n in range(len(frames[view])) if all(0 <= n - lag < each.num_frames for each, lag in both)]
        chosen = [common[i] for i in evenly_spaced(len(common), 2 * MOMENTS // len(sides))]
        if not chosen:
            continue
        arms = tracks[0].arms
        style = OverlayStyle(SIGMA_PX_REF, heat=0.5, outline=view == HEAD_VIEW)
        shown = {n: image for n, image in enumerate(islice(frames[view], max(chosen) + 1)) if n in chosen}
        for title, (each, lag) in zip(sides, both, strict=True):
            tiles = [
                draw_tag(
                    draw_overlay(image, each, n - lag, view, tile_height=TILE_HEIGHT, style=style),
                    f"frame {n}",
                    size_px=11,
                )
                for n, image in shown.items()
            ]
            rows[title].append(SheetRow(words(view), np.stack(tiles)))
    if not any(rows.values()):
        expected = "a calibrated view with images"
        raise DataError("Nothing to draw", where=f"episode {recorded.episode_id}", expected=expected)
    sheets = [contact_sheet(r, tile_height=TILE_HEIGHT, title=t, min_width=MIN_WIDTH) for t, r in rows.items()]
    body = np.concatenate(sheets, axis=1)
    return np.concatenate([body, legend_strip(arms, body.shape[1], outline=HEAD_VIEW in frames)])


def recorded_tracks(episode: Episode, view: str, kinematics: ArmKinematics | None) -> EpisodeTracks:
    """The state's tools in one view with K and camera poses as the episode has them."""
    camera = episode.cameras[view]
    if episode.T_base_ee is not None:
        tools = torch.tensor(episode.T_base_ee, dtype=torch.float64)
        gripper = torch.zeros(tools.shape[:2]) if episode.gripper is None else torch.tensor(episode.gripper)
        capsules, radii = tool_capsules(tools)
    elif kinematics is not None and episode.state_kind == "joints":
        state = np.array(episode.state, dtype=np.float64)
        links = kinematics.link_poses(state)
        tools, gripper = kinematics.tools_of(links), kinematics.gripper(state)
        capsules, radii = robot_capsules(kinematics, links)
    else:
        expected = "recorded tool poses, or joints and kinematics"
        raise DataError("No tools to draw", where=f"episode {episode.episode_id}", expected=expected)
    poses = torch.tensor(camera.poses(np.arange(episode.num_frames)), dtype=torch.float64)[:, None]
    K = torch.tensor(camera.K, dtype=torch.float64)[None]
    size, count = (camera.height, camera.width), tools.shape[1]
    return tracks_of_projection(
        episode, project_tools(tools, gripper.double(), K, poses, size), tools, poses, K, capsules, radii,
        views=(view,),
        arms=("left", "right") if count == 2 else ("right",) if count == 1 else tuple(f"arm{i}" for i in range(count)),
        image_size=size,
        controls="state",
        camera_motion=("recorded",),
    )  # fmt: skip
