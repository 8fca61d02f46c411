"""Export of one episode with its predictions: a Rerun recording, MCAP files, or side-by-side videos."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from worldline_core.actions.action_maps import SIGMA_PX_REFERENCE
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.errors import ConfigError, DataError
from worldline_core.exports.rerun_recording import RecordingContent, write_rerun_recording
from worldline_core.pictures.side_by_side import write_side_by_side

if TYPE_CHECKING:
    from worldline_core.actions.episode_tracks import EpisodeTracks
    from worldline_core.actions.track_store import ActionTracks
    from worldline_core.data.episodes.episode_set import EpisodeSet
    from worldline_core.rollout.rollout_set import RolloutSet

Format = Literal["mp4", "rrd", "mcap"]
FORMATS: tuple[str, ...] = ("mp4", "rrd", "mcap")


def export_rollout(
    rollout_sets: RolloutSet | Mapping[str, RolloutSet],
    episode_set: EpisodeSet,
    tracks: ActionTracks | None,
    episode_id: str,
    output: Path,
    formats: Sequence[str] = FORMATS,
    *,
    name: str | None = None,
) -> list[Path]:
    """Writes an episode's predictions below `output` and returns the files.

    Args:
        rollout_sets: one set, or several by method name.
        tracks: action tracks for tool poses and heat maps; left out when None.
        formats: `mp4` (one side-by-side video a view), `rrd` (one recording with everything), `mcap` (one a method).
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
    content = recording_content(having, episode_set, found, episode_id)
    stem = name or safe_stem(episode_id)
    output.mkdir(parents=True, exist_ok=True)
    written: list[Path] = []
    if "mp4" in formats:
        written += write_videos(content, output, stem)
    if "rrd" in formats:
        path = output / f"{stem}.rrd"
        write_rerun_recording(path, content)
        written.append(path)
    if "mcap" in formats:
        from worldline_core.exports.mcap_recording import write_mcap_recordings

        written += write_mcap_recordings(content, output, stem)
    return written


def recording_content(
    rollouts: Mapping[str, RolloutSet],
    episode_set: EpisodeSet,
    tracks: EpisodeTracks | None,
    episode_id: str,
    *,
    sigma_px_ref: float = SIGMA_PX_REFERENCE,
) -> RecordingContent:
    """Gathers the frames, predictions and tracks of one episode."""
    index = episode_set.position(episode_id)
    episode = episode_set.episode(index)
    views = [view for view in VIEWS if view in episode_set.rows[index].views]
    predicted: dict[str, dict[str, np.ndarray]] = {}
    for method, rollout in rollouts.items():
        seed = rollout.seeds(episode_id)[0]
        predicted[method] = {view: np.asarray(rollout.frames(episode_id, view, seed)) for view in views}
    true_frames = {view: np.asarray(episode_set.frames(index, view)) for view in views}
    names = episode.state_names or ()
    return RecordingContent(episode, true_frames, predicted, tracks, names, sigma_px_ref)


def write_videos(content: RecordingContent, output: Path, stem: str) -> list[Path]:
    """One side-by-side video a view: truth, then every method."""
    written: list[Path] = []
    for view, frames in content.true_frames.items():
        columns = {"true": frames} | {
            method: views[view] for method, views in content.predicted_frames.items() if view in views
        }
        made = write_side_by_side(output / f"{stem}_{view}.mp4", columns, content.episode.fps)
        written += [made.video, made.poster]
    return written


def safe_stem(episode_id: str) -> str:
    """An episode's id as the beginning of a file name."""
    return "".join(c if c.isalnum() or c in "-_" else "_" for c in episode_id)
