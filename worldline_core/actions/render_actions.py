"""`render_actions`: tracks of every episode of a set, counts of what was masked, and previews of the first few."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import Field
from tqdm import tqdm

from worldline_core.actions.action_maps import SIGMA_PX_REFERENCE
from worldline_core.actions.action_tracks import compute_tracks
from worldline_core.actions.episode_tracks import EpisodeTracks
from worldline_core.actions.track_counts import TrackCounts, add_counts
from worldline_core.actions.tracks import ActionTracks, shard_name, write_index, write_shard
from worldline_core.config import StrictModel
from worldline_core.data.episode import Episode
from worldline_core.data.episode_index import QuarantineRow, write_quarantine
from worldline_core.data.episode_set import EpisodeSet
from worldline_core.errors import CalibrationError, ConfigError, DataError, UnavailableError, WorldLineError
from worldline_core.exports.contact_sheet import evenly_spaced
from worldline_core.exports.overlay_views import overlay_sheet, write_overlay_video
from worldline_core.exports.overlays import OverlayStyle
from worldline_core.exports.pictures import png_bytes
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.store.atomic import write_bytes_atomic, write_json_atomic


class RenderActionsConfig(StrictModel):
    """What is projected, and how much is drawn.

    Attributes:
        source: `action` projects the commands (what a simulator is driven by), `state` the measured joints.
        without_mount: what wrist cameras without a known mount follow.
        description_paths: by embodiment, a kinematic description that is the user's own file.
        preview_height: of one view in the previews, pixels; small frames are enlarged by a whole factor up to it.
        sigma_px_ref: of the heat in the previews, pixels on the 384 x 512 reference canvas.
    """

    source: Literal["action", "state"] = "action"
    without_mount: Literal["recorded", "first_frame_mount"] = "recorded"
    description_paths: dict[str, str] = Field(default_factory=dict)
    previews: int = Field(3, ge=0)
    preview_height: int = Field(256, ge=32)
    preview_rows: int = Field(4, ge=1)
    sigma_px_ref: float = Field(SIGMA_PX_REFERENCE, gt=0)
    episodes_per_shard: int = Field(256, ge=1)


def render_actions(config: RenderActionsConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """Compute the tracks of every episode of `inputs["episodes"]`.

    An episode whose tracks cannot be computed goes to `quarantine.parquet` with a reason; the rest goes on. Interrupted
    work continues at the first shard that is not written.

    Returns:
        Counts: episodes found, with tracks, quarantined; samples, masked ones by cause, and gripper overshoot by arm
        (`TrackCounts`), of all episodes and by embodiment.

    Raises:
        ConfigError: no input `episodes`.
    """
    if "episodes" not in inputs:
        raise ConfigError("render_actions needs an EpisodeSet", expected="input episodes", got=sorted(inputs))
    episodes = EpisodeSet.open(inputs["episodes"])
    kinematics = _KinematicsByName(config)
    rows: list[dict[str, Any]] = []
    rejected: list[QuarantineRow] = []
    counts: dict[str, list[TrackCounts]] = {}
    for number, start in enumerate(tqdm(range(0, len(episodes), config.episodes_per_shard), "tracks", disable=None)):
        positions = range(start, min(start + config.episodes_per_shard, len(episodes)))
        shard = _shard(config, episodes, positions, number, kinematics, output)
        rows += shard["rows"]
        rejected += [QuarantineRow(**row) for row in shard["rejected"]]
        for embodiment, numbers in shard["counts"].items():
            counts.setdefault(embodiment, []).append(numbers)
    write_index(output, rows)
    write_quarantine(output, rejected)
    _previews(config, episodes, ActionTracks.open(output), output)
    by_embodiment = {name: add_counts(parts) for name, parts in sorted(counts.items())}
    summary = {
        "found": len(episodes),
        "kept": len(rows),
        "quarantined": len(rejected),
        "samples": add_counts(list(by_embodiment.values())),
        "by_embodiment": by_embodiment,
        "camera_motion": _camera_motion(rows),
        "quarantine_reasons": dict(sorted(Counter(row.reason for row in rejected).items())),
    }
    write_json_atomic(output / "summary.json", summary)
    return summary


class _KinematicsByName:
    """Kinematics of each embodiment, built once; a failure is remembered, not repeated."""

    def __init__(self, config: RenderActionsConfig) -> None:
        self.config = config
        self._built: dict[str, ArmKinematics | WorldLineError] = {}

    def get(self, name: str) -> ArmKinematics:
        if name not in self._built:
            try:
                embodiment = load_embodiment(name, self.config.description_paths.get(name))
                self._built[name] = ArmKinematics(embodiment)
            except (ConfigError, DataError, UnavailableError) as error:
                self._built[name] = error
        result = self._built[name]
        if isinstance(result, WorldLineError):
            raise result
        return result


def _reason(error: WorldLineError) -> str:
    if isinstance(error, CalibrationError):
        return "no_calibration"
    if isinstance(error, UnavailableError):
        return "kinematics_unavailable"
    return "unknown_embodiment" if isinstance(error, ConfigError) else "invalid_controls"


def _shard(
    config: RenderActionsConfig,
    episodes: EpisodeSet,
    positions: range,
    number: int,
    kinematics: _KinematicsByName,
    output: Path,
) -> dict[str, Any]:
    """Tracks of some episodes into one shard: index rows, rejected episodes, counts (remembered for a restart)."""
    done = output / "run" / f"shard-{number:05d}.json"
    if done.is_file() and (output / shard_name(number)).is_file():
        return json.loads(done.read_text(encoding="utf-8"))
    tracks: list[EpisodeTracks] = []
    rejected: list[dict[str, str]] = []
    counts: dict[str, list[TrackCounts]] = {}
    for position in positions:
        row = episodes.rows[position]
        try:
            episode = episodes.episode(position)
            built = kinematics.get(episode.embodiment) if _needs_kinematics(episode) else None
            computed, numbers = compute_tracks(
                episode, built, controls=config.source, without_mount=config.without_mount
            )
        except (DataError, ConfigError, UnavailableError) as error:
            evidence = {"expected": str(error.expected), "got": str(error.got)}
            rejected.append(
                {
                    "episode_id": row.episode_id,
                    "source": row.source,
                    "reason": _reason(error),
                    "detail": error.what,
                    "evidence": json.dumps(evidence, sort_keys=True),
                }
            )
            continue
        tracks.append(computed)
        counts.setdefault(episode.embodiment, []).append(numbers)
    rows = write_shard(output, number, tracks)
    result = {"rows": rows, "rejected": rejected, "counts": {name: add_counts(c) for name, c in counts.items()}}
    write_json_atomic(done, result)
    return result


def _needs_kinematics(episode: Episode) -> bool:
    return episode.T_base_ee is None


def _camera_motion(rows: list[dict[str, Any]]) -> dict[str, dict[str, int]]:
    """By view, how many episodes take the camera's poses from where."""
    motion: dict[str, Counter[str]] = {}
    for row in rows:
        for view, kind in zip(row["views"], row["camera_motion"], strict=True):
            motion.setdefault(view, Counter()).update([kind])
    return {view: dict(sorted(counted.items())) for view, counted in sorted(motion.items())}


def _preview_positions(config: RenderActionsConfig, episodes: EpisodeSet, tracks: ActionTracks) -> list[int]:
    """The first episodes of different embodiments, then further ones, up to the wanted number."""
    usable = [i for i, row in enumerate(episodes.rows) if row.episode_id in tracks and row.video_frames > 0]
    firsts = {episodes.rows[i].embodiment: i for i in reversed(usable)}
    chosen = sorted(firsts.values())
    chosen += [i for i in usable if i not in chosen]
    return chosen[: config.previews]


def _previews(config: RenderActionsConfig, episodes: EpisodeSet, tracks: ActionTracks, output: Path) -> None:
    """Overlay video and contact sheet of a few episodes, under `previews/`."""
    folder = output / "previews"
    for position in _preview_positions(config, episodes, tracks):
        row = episodes.rows[position]
        name = row.episode_id.replace("/", "_")
        sheet_path, video_path = folder / f"{name}.png", folder / f"{name}.mp4"
        if sheet_path.is_file() and video_path.is_file():
            continue
        frames = {view: episodes.frames(position, view) for view in row.views}
        found, height = tracks.tracks(row.episode_id), config.preview_height
        style, title = OverlayStyle(config.sigma_px_ref), f"{row.embodiment}  ·  {row.instruction}"
        write_overlay_video(video_path, frames, found, row.fps, tile_height=height, style=style, title=title)
        moments = evenly_spaced(min(found.num_frames, row.video_frames), config.preview_rows)
        chosen = {view: images[moments] for view, images in frames.items()}
        title = f"{row.episode_id}  ·  {title}"
        sheet = overlay_sheet(chosen, found, moments, tile_height=height, style=style, title=title)
        write_bytes_atomic(sheet_path, png_bytes(sheet))
