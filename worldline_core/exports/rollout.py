"""Export of one episode with its predictions: side-by-side videos, a Rerun recording, MCAP files."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from worldline_core.actions.action_tracks import compute_tracks
from worldline_core.actions.actions_config import SIGMA_PX_REFERENCE
from worldline_core.actions.episode_tracks import ActionTracks, EpisodeTracks
from worldline_core.data.episodes.episode import VIEWS, Episode
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.guards.source_paths import safe_stem
from worldline_core.data.mcap.exported import Encoding, write_rollout_mcap
from worldline_core.data.video.frames import MadeFrames, VideoFrames
from worldline_core.errors import ConfigError, DataError
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.pictures import write_side_by_side
from worldline_core.rollout.rollout_set import RolloutSet

if TYPE_CHECKING:
    from worldline_core.exports.rerun_recording import RecordingContent

MCAP_FORMATS: dict[str, Encoding] = {"mcap": "protobuf", "mcap-ros2": "ros2"}
FORMATS = ("mp4", "rrd", *MCAP_FORMATS)


def mcap_file(folder: Path, stem: str, wanted: str) -> Path:
    """`<stem>.mcap` or `<stem>.ros2.mcap`."""
    return folder / f"{stem}{wanted.removeprefix('mcap').replace('-', '.')}.mcap"


def export_rollout(
    rollout_sets: RolloutSet | Mapping[str, RolloutSet],
    episode_set: EpisodeSet,
    tracks: ActionTracks | None,
    episode_id: str,
    output: Path,
    formats: Sequence[str] = ("mp4", "rrd", "mcap"),
    *,
    name: str | None = None,
) -> list[Path]:
    """Write an episode's predictions below `output` and return the files.

    Args:
        rollout_sets: one set, or several by method name.
        tracks: action tracks for tool poses and heat maps; left out when None.
        formats: `mp4` (one side-by-side video per view), `rrd` (one recording with everything), `mcap`
            and `mcap-ros2` (one per method).
        name: beginning of the file names (default: the episode's id).

    Raises:
        ConfigError: an unknown format.
        DataError: no set predicted this episode, or the set does not hold it.
    """
    unknown = [wanted for wanted in formats if wanted not in FORMATS]
    if unknown:
        raise ConfigError("Unknown export format", expected=", ".join(FORMATS), got=", ".join(unknown))
    sets = dict(rollout_sets) if isinstance(rollout_sets, Mapping) else {rollout_sets.method: rollout_sets}
    having = {method: item for method, item in sets.items() if episode_id in item.episode_ids}
    if not having:
        raise DataError(
            "No prediction of this episode", where=episode_id, expected="an episode of the RolloutSet",
            got=", ".join(sets) or "no RolloutSet", next_step="list what was predicted with `worldline inspect <folder>`",
        )  # fmt: skip
    found = None if tracks is None else tracks.tracks(episode_id)
    sigma_px_ref = SIGMA_PX_REFERENCE if tracks is None else tracks.sigma_px_ref
    content = recording_content(having, episode_set, found, episode_id, sigma_px_ref=sigma_px_ref)
    stem = name or safe_stem(episode_id)
    output.mkdir(parents=True, exist_ok=True)
    written: list[Path] = []
    if "mp4" in formats:
        for view, frames in content.true_frames.items():
            predicted = {method: views[view] for method, views in content.predicted_frames.items() if view in views}
            made = write_side_by_side(output / f"{stem}_{view}.mp4", {"true": frames, **predicted}, content.episode.fps)
            written += [made.video, made.poster]
    if "rrd" in formats:
        from worldline_core.exports.rerun_recording import write_rerun_recording  # imports Rerun

        written.append(output / f"{stem}.rrd")
        write_rerun_recording(written[-1], content)
    for wanted in (each for each in MCAP_FORMATS if each in formats):
        written += write_mcap_recordings(content, output, stem, wanted)
    return written


def shown_tracks(episode: Episode) -> EpisodeTracks:
    """Tracks of an episode as pictures show them: its recorded tool poses, else those of its commands, else of its state.

    Raises: DataError, ConfigError, UnavailableError: they cannot be computed.
    """
    if episode.T_base_ee is not None:
        return compute_tracks(episode, None, controls="state")[0]
    kinematics = ArmKinematics(load_embodiment(episode.embodiment))
    return compute_tracks(episode, kinematics, controls="action" if episode.commanded else "state")[0]


def recording_content(
    rollouts: Mapping[str, RolloutSet],
    episode_set: EpisodeSet,
    tracks: EpisodeTracks | None,
    episode_id: str,
    *,
    sigma_px_ref: float = SIGMA_PX_REFERENCE,
) -> RecordingContent:
    """Gather the frames, predictions and tracks of one episode."""
    from worldline_core.exports.rerun_recording import RecordingContent

    index = episode_set.position(episode_id)
    episode = episode_set.episode(index)
    views = [view for view in VIEWS if view in episode_set.rows[index].views]
    predicted = {
        method: {
            view: VideoFrames(rollout.clip(episode_id, view)) for view in views if view in rollout.views(episode_id)
        }
        for method, rollout in rollouts.items()
    }
    true_frames = {view: VideoFrames(episode_set.clip(index, view)) for view in views}
    return RecordingContent(episode, true_frames, predicted, tracks, episode.state_names or (), sigma_px_ref)


def write_mcap_recordings(content: RecordingContent, output: Path, stem: str, wanted: str = "mcap") -> list[Path]:
    """Write `<stem>_<method>` as a format of `MCAP_FORMATS` for every method, with cameras and commanded tool poses, and return the files.

    Calibration follows the frames' size; poses are cut to the prediction's length.
    """
    episode = content.episode
    written: list[Path] = []
    for method, views in content.predicted_frames.items():
        count = min(len(frames) for frames in views.values())
        cameras = {
            view: episode.cameras[view].resized(frames.shape[2], frames.shape[1]).cut(0, count)
            for view, frames in views.items()
            if view in episode.cameras
        }
        facts = {"method": method} | {
            name: getattr(episode, name) for name in ("episode_id", "embodiment", "instruction")
        }
        written.append(mcap_file(output, f"{stem}_{safe_stem(method)}", wanted))
        write_rollout_mcap(
            written[-1],
            {view: MadeFrames(frames.__iter__, frames.shape, np.uint8)[:count] for view, frames in views.items()},
            episode.fps,
            metadata={key: json.dumps(value) for key, value in facts.items()},
            cameras=cameras,
            T_base_ee=None if content.tracks is None else content.tracks.T_base_tool[:count],
            encoding=MCAP_FORMATS[wanted],
        )
    return written
