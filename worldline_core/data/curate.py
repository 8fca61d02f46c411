"""Curation: recordings of several formats in, one EpisodeSet out; every input is kept or quarantined with a reason."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field
from tqdm import tqdm

from worldline_core.config.base import StrictModel
from worldline_core.data.curate_checks import (
    check_camera,
    check_joints,
    check_split,
    check_times,
    check_values,
    stride_to,
)
from worldline_core.data.episode import Episode, Split
from worldline_core.data.episode_index import read_index, read_quarantine
from worldline_core.data.episode_parts import part_name
from worldline_core.data.episode_set_writer import EpisodeSetWriter
from worldline_core.data.rejection import RejectedInputError
from worldline_core.data.resize import Fit, fitted
from worldline_core.data.sources.agibot_gesim import AgibotGesimSource, AgibotGesimSourceConfig
from worldline_core.data.sources.agibot_world import AgibotWorldSource, AgibotWorldSourceConfig
from worldline_core.data.sources.base import EpisodeSource, LoadedEpisode
from worldline_core.data.sources.droid_annotation import DroidAnnotationSource, DroidAnnotationSourceConfig
from worldline_core.data.sources.episode_set import EpisodeSetSource, EpisodeSetSourceConfig
from worldline_core.data.sources.lerobot import LeRobotSource, LeRobotSourceConfig
from worldline_core.data.sources.mcap import McapSource, McapSourceConfig
from worldline_core.data.sources.repaired import RepairedSource
from worldline_core.data.sources.robotwin import RobotwinSource, RobotwinSourceConfig
from worldline_core.data.undistort import PinholeSource
from worldline_core.data.video import PixelFormat
from worldline_core.errors import CalibrationError, DataError
from worldline_core.store.atomic import write_bytes_atomic

SourceConfig = Annotated[
    EpisodeSetSourceConfig
    | LeRobotSourceConfig
    | AgibotGesimSourceConfig
    | AgibotWorldSourceConfig
    | DroidAnnotationSourceConfig
    | McapSourceConfig
    | RobotwinSourceConfig,
    Field(discriminator="kind"),
]


class CurateConfig(StrictModel):
    """What to read and what every kept episode will look like."""

    sources: tuple[SourceConfig, ...] = Field(min_length=1)
    image_size: tuple[int, int] | None = Field(
        default=None, description="(height, width) of all images; null keeps each size"
    )
    fit: Fit = Field(default="stretch", description="how images come to that size; letterbox and crop keep the aspect")
    fps: float | None = Field(default=None, gt=0, description="rate of all episodes; null keeps each rate")
    views: tuple[str, ...] | None = Field(default=None, description="views to keep, in this order; null keeps all")
    primary_view: str | None = Field(
        default=None, description="task-facing view for single-view training; null keeps the source's"
    )
    splits: dict[str, Split] = Field(
        default={}, description="scene name pattern -> split, first match wins; else the source's"
    )
    require_calibration: bool = Field(default=False, description="quarantine episodes with an uncalibrated view")
    min_frames: int = Field(default=2, ge=1)
    joint_tolerance_rad: float = Field(default=0.05, ge=0)
    time_tolerance_frames: float = Field(
        default=0.25, gt=0, description="largest distance of a frame from its rate's grid"
    )
    video_crf: int = Field(default=10, ge=0, le=51)
    video_preset: str = "veryfast"
    pixel_format: PixelFormat = Field(
        default="yuv444p",
        description="full colour: at 64x96 yuv420p costs 9 dB at the same file size; few browsers play it",
    )


@dataclass(frozen=True)
class _Input:
    """One listed episode: the id it gets in the set, and where it is read from."""

    identity: str
    source: EpisodeSource
    label: str
    root: Path
    listed_id: str
    repeated: bool


def open_source(config: SourceConfig, root: Path) -> EpisodeSource:
    """The reader of a configured source: it repairs what the configuration declares as departing from the contract, and
    takes out lens distortion.

    Raises: DataError when the folder is missing or not of that kind.
    """
    if not root.exists():
        raise DataError("Source folder is missing", where=str(root), next_step="check curate.sources[].path")
    source = _reader(config, root)
    return PinholeSource(RepairedSource(source, config.conventions) if config.conventions.departures else source)


def _reader(config: SourceConfig, root: Path) -> EpisodeSource:
    match config:
        case EpisodeSetSourceConfig():
            return EpisodeSetSource(config, root)
        case LeRobotSourceConfig():
            return LeRobotSource(config, root)
        case AgibotGesimSourceConfig():
            return AgibotGesimSource(config, root)
        case AgibotWorldSourceConfig():
            return AgibotWorldSource(config, root)
        case DroidAnnotationSourceConfig():
            return DroidAnnotationSource(config, root)
        case McapSourceConfig():
            return McapSource(config, root)
        case RobotwinSourceConfig():
            return RobotwinSource(config, root)


def curate(config: CurateConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """Read all sources into an EpisodeSet at `output`.

    Args:
        inputs: "source.<n>" -> folder of sources[n]; a source that is not named is read from its configured path.

    Returns:
        {"found", "kept", "quarantined", "reasons", "splits"}; kept + quarantined = found.

    Raises: DataError when a source cannot be opened, nothing is kept, or a scene is both in training and in test;
        ConfigError when recordings for evaluation only are assigned to training.
    """
    listed = _list_inputs(config, inputs)
    if EpisodeSetWriter.finished(output):
        return _counts(output, len(listed))
    writer = EpisodeSetWriter(
        output,
        fps=config.fps,
        image_size=config.image_size,
        video_crf=config.video_crf,
        video_preset=config.video_preset,
        pixel_format=config.pixel_format,
    )
    for item in tqdm(listed, desc="curate", unit="episode", disable=None):
        if not writer.has(item.identity):
            _process(config, item, writer, output)
    _quarantine_duplicates(listed, writer, output)
    _check_scenes_disjoint(writer)
    writer.close()
    return _counts(output, len(listed))


def _list_inputs(config: CurateConfig, inputs: Mapping[str, Path]) -> list[_Input]:
    listed: list[_Input] = []
    seen: set[str] = set()
    for number, source_config in enumerate(config.sources):
        root = inputs.get(f"source.{number}", source_config.path)
        source = open_source(source_config, root)
        for episode_id in filter(source_config.includes, source.episode_ids()):
            repeated = episode_id in seen
            identity = f"{episode_id}#source.{number}" if repeated else episode_id
            seen.add(identity)
            listed.append(_Input(identity, source, source_config.label, root, episode_id, repeated))
    return listed


def _process(config: CurateConfig, item: _Input, writer: EpisodeSetWriter, output: Path) -> None:
    """Keep or quarantine one episode."""
    try:
        if item.repeated:
            raise RejectedInputError(
                "duplicate_id", "Another source has an episode of this id", where=item.label, got=item.listed_id
            )
        loaded = item.source.load(item.listed_id)
        _check(config, loaded)
        episode, frames, masks, fingerprint = _prepare(config, loaded)
        write_bytes_atomic(_fingerprint_path(output, item.identity), fingerprint.encode())
        writer.add(episode, frames, masks or None)
    except RejectedInputError as error:
        writer.quarantine(item.identity, item.label, error.reason, _portable(error, item), error.evidence)
    except CalibrationError as error:
        writer.quarantine(item.identity, item.label, "invalid_extrinsics", _portable(error, item), {})
    except DataError as error:
        writer.quarantine(item.identity, item.label, "unreadable", _portable(error, item), {})


def _portable(error: DataError, item: _Input) -> str:
    """The message with paths counted from the source's folder: a set must not depend on where its sources lay."""
    text = str(error)
    for root in (item.root.resolve(), item.root):
        text = text.replace(f"{root}/", "").replace(str(root), item.label)
    return text


def _check(config: CurateConfig, loaded: LoadedEpisode) -> None:
    episode = loaded.episode
    check_values(episode)
    check_times(episode, config.time_tolerance_frames)
    check_joints(episode, config.joint_tolerance_rad)
    for camera in episode.cameras.values():
        check_camera(episode, camera)
    missing = [view for view in config.views or () if view not in loaded.views]
    if missing:
        raise RejectedInputError(
            "missing_view",
            "Episode lacks a view",
            where=f"episode {episode.episode_id}",
            expected=", ".join(missing),
            got=", ".join(loaded.views),
            evidence={"missing": missing, "found": list(loaded.views)},
        )
    uncalibrated = [view for view in config.views or loaded.views if view not in episode.cameras]
    if config.require_calibration and uncalibrated:
        raise RejectedInputError(
            "missing_calibration",
            "View has no calibration",
            where=f"episode {episode.episode_id}",
            expected="K and T_base_camera of each view",
            got="none for " + ", ".join(uncalibrated),
            evidence={"views": uncalibrated},
        )


def _prepare(
    config: CurateConfig, loaded: LoadedEpisode
) -> tuple[Episode, dict[str, np.ndarray], dict[str, np.ndarray], str]:
    """The episode at the wanted rate and size: (episode, frames, masks, fingerprint of the recorded content)."""
    step = stride_to(loaded.episode, config.fps)
    views = config.views or loaded.views
    source_frames = {view: loaded.frames(view) for view in views}
    for view, images in source_frames.items():
        if len(images) != loaded.episode.num_video_frames:
            raise RejectedInputError(
                "length_mismatch",
                "Video and states differ in length",
                where=f"episode {loaded.episode.episode_id}, view {view}",
                expected=f"{loaded.episode.num_video_frames} frames",
                got=f"{len(images)} frames",
                evidence={"states": loaded.episode.num_video_frames, "frames": len(images)},
            )
    fingerprint = _fingerprint(loaded.episode, source_frames)
    episode = loaded.episode if step == 1 else loaded.episode.cut(0, loaded.episode.num_frames, step)
    if episode.num_frames < config.min_frames:
        raise RejectedInputError(
            "too_short",
            "Episode has too few frames",
            where=f"episode {episode.episode_id}",
            expected=f"at least {config.min_frames}",
            got=episode.num_frames,
            evidence={"frames": episode.num_frames},
        )
    fits = {view: fitted(images.shape[1:3], config.image_size, config.fit) for view, images in source_frames.items()}
    frames = {view: fits[view].frames(images[::step]) for view, images in source_frames.items()}
    masks: dict[str, np.ndarray] = {}
    for view in views:
        mask = loaded.robot_masks(view)
        if mask is not None:
            masks[view] = fits[view].masks(mask[::step])
    cameras = {view: episode.cameras[view].transformed(fits[view]) for view in views if view in episode.cameras}
    split = next((s for pattern, s in config.splits.items() if fnmatchcase(episode.scene, pattern)), episode.split)
    prepared = replace(
        episode,
        fps=config.fps or episode.fps,
        timestamps=np.arange(episode.num_frames) / (config.fps or episode.fps),
        cameras=cameras,
        split=split,
        primary_view=config.primary_view or episode.primary_view,
    )
    check_split(prepared)
    return prepared, frames, masks, fingerprint


def _fingerprint(episode: Episode, frames: Mapping[str, np.ndarray]) -> str:
    digest = hashlib.sha256()
    for array in (episode.state, episode.action, *(frames[view] for view in sorted(frames))):
        digest.update(str((array.shape, array.dtype.str)).encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _fingerprint_path(output: Path, identity: str) -> Path:
    return output / "run" / "fingerprints" / f"{part_name(identity)}.txt"


def _quarantine_duplicates(listed: list[_Input], writer: EpisodeSetWriter, output: Path) -> None:
    """Of episodes with the same content the first listed is kept."""
    kept_ids = {part["episode_id"] for part in writer.kept()}
    first: dict[str, str] = {}
    for item in listed:
        if item.identity not in kept_ids:
            continue
        original = first.setdefault(_fingerprint_path(output, item.identity).read_text(), item.identity)
        if original != item.identity:
            writer.quarantine(
                item.identity,
                item.label,
                "duplicate",
                f"Same frames, states and actions as episode {original}",
                {"duplicate_of": original},
            )
            writer.discard(item.identity)


def _check_scenes_disjoint(writer: EpisodeSetWriter) -> None:
    """Raises: DataError when a scene that is trained or validated on is also tested on."""
    scenes: dict[str, set[str]] = {}
    for part in writer.kept():
        scenes.setdefault(part["split"], set()).add(part["scene"])
    for learning in ("train", "validation"):
        for testing in ("test", "ood_test"):
            shared = sorted(scenes.get(learning, set()) & scenes.get(testing, set()))
            if shared:
                raise DataError(
                    f"Scenes are both in {learning} and in {testing}",
                    where="curate.splits",
                    expected="disjoint scenes",
                    got=", ".join(shared[:10]) + (" ..." if len(shared) > 10 else ""),
                    next_step="give each scene one split",
                )


def _counts(output: Path, found: int) -> dict[str, Any]:
    rows, rejected = read_index(output), read_quarantine(output)
    if len(rows) + len(rejected) != found:
        raise DataError(
            "Inputs were lost between sources and set",
            where=str(output),
            expected=f"kept + quarantined = {found}",
            got=f"{len(rows)} + {len(rejected)}",
            next_step="remove the unfinished folder and curate again",
        )
    reasons: dict[str, int] = {}
    for rejection in rejected:
        reasons[rejection.reason] = reasons.get(rejection.reason, 0) + 1
    splits: dict[str, int] = {}
    for row in rows:
        splits[row.split] = splits.get(row.split, 0) + 1
    return {
        "found": found,
        "kept": len(rows),
        "quarantined": len(rejected),
        "reasons": dict(sorted(reasons.items())),
        "splits": dict(sorted(splits.items())),
    }
