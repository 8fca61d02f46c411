"""`render_actions`: tracks of every episode of a set, counts of what was masked, and previews of the first few.

What `render_actions` projects, and how much it draws.

A shard of `render_actions`: the tracks of some episodes, in one file, wherever the shard is worked on.
"""

from __future__ import annotations

import json
import uuid
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

from pydantic import Field
from tqdm import tqdm

from worldline_core.actions.action_maps import SIGMA_PX_REFERENCE
from worldline_core.actions.action_tracks import compute_tracks
from worldline_core.actions.episode_tracks import ActionTracks, EpisodeTracks, shard_name, write_index, write_shard
from worldline_core.actions.overlay_views import overlay_sheet, write_overlay_video
from worldline_core.actions.overlays import OverlayStyle
from worldline_core.actions.tool_projection import TrackCounts, add_counts
from worldline_core.config import StrictModel
from worldline_core.data.episodes.episode import Episode
from worldline_core.data.episodes.episode_index import EpisodeRow, QuarantineRow, write_quarantine
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import CalibrationError, ConfigError, DataError, UnavailableError, WorldLineError
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.pictures.contact_sheet import evenly_spaced
from worldline_core.pictures.labels import png_bytes
from worldline_core.scale.mapping import (
    SerialMapper,
    ShardMapper,
    crash_evidence,
    cut,
    ends_the_run,
    portable_message,
    run_jobs,
)
from worldline_core.store.atomic import write_bytes_atomic, write_json_atomic
from worldline_core.store.remote import is_transient


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


@dataclass(frozen=True)
class RenderShard:
    """Plain values only: a shard is sent to other processes and machines, which share the folders.

    Attributes:
        run: names the call of `render_actions`, so that a set that one call opened does not serve the next.
        config: JSON of the RenderActionsConfig.
        episodes: folder of the set.
        start, stop: positions in it.
        probe: the tracks are computed and dropped, to find out which episode ends the process.
    """

    number: int
    run: str
    config: str
    episodes: str
    output: str
    start: int
    stop: int
    probe: bool = False

    @property
    def label(self) -> str:
        return f"render_actions shard {self.number}"

    def __len__(self) -> int:
        return self.stop - self.start

    def split(self) -> list[RenderShard]:
        return [replace(self, start=i, stop=i + 1, probe=True) for i in range(self.start, self.stop)]


@dataclass
class _Result:
    tracks: list[EpisodeTracks] = field(default_factory=list)
    rejected: list[dict[str, str]] = field(default_factory=list)
    counts: dict[str, list[TrackCounts]] = field(default_factory=dict)

    def reject(self, row: EpisodeRow, reason: str, detail: str, evidence: Mapping[str, Any]) -> None:
        self.rejected.append(
            {
                "episode_id": row.episode_id,
                "source": row.source,
                "reason": reason,
                "detail": detail,
                "evidence": json.dumps(dict(evidence), sort_keys=True),
            }
        )


@lru_cache(maxsize=2)
def opened(run: str, folder: str, config: str) -> tuple[EpisodeSet, KinematicsByName]:
    """A set and the kinematics of its robots, once for all shards of a run that this process works on."""
    del run  # part of the key only
    return EpisodeSet.open(Path(folder)), KinematicsByName(RenderActionsConfig.model_validate_json(config))


def result_path(output: Path, number: int) -> Path:
    """Where the index rows, rejections and counts of a shard are kept until the index is written."""
    return output / "run" / f"shard-{number:05d}.json"


def _crash_path(output: Path, position: int) -> Path:
    return output / "run" / "crashed" / f"{position:08d}.json"


class KinematicsByName:
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


def render_shard(shard: RenderShard) -> int:
    """Tracks of some episodes into one file, and what is known of them into another beside it.

    Returns: the number of episodes.
    """
    output = Path(shard.output)
    done = result_path(output, shard.number)
    if shard.probe or not (done.is_file() and (output / shard_name(shard.number)).is_file()):
        result = _computed(shard)
        if not shard.probe:
            rows = write_shard(output, shard.number, result.tracks)
            counts = {name: add_counts(c) for name, c in result.counts.items()}
            write_json_atomic(done, {"rows": rows, "rejected": result.rejected, "counts": counts})
    return len(shard)


def note_crash(shard: RenderShard, error: Exception) -> None:
    """Remember the one episode of a shard that ended its worker twice: its shard is then made without it."""
    write_json_atomic(_crash_path(Path(shard.output), shard.start), crash_evidence(error))


def _computed(shard: RenderShard) -> _Result:
    config, output = RenderActionsConfig.model_validate_json(shard.config), Path(shard.output)
    episodes, kinematics = opened(shard.run, shard.episodes, shard.config)
    result = _Result()
    for position in range(shard.start, shard.stop):
        row = episodes.rows[position]
        crash = _crash_path(output, position)
        if crash.is_file():
            detail = "Projecting this episode alone ended its process, twice"
            result.reject(row, "crashed", detail, json.loads(crash.read_text()))
            continue
        try:
            episode = episodes.episode(position)
            if episode.state_kind == "none":
                # A plain video: there is nothing to project. It is counted with the others that have no tracks.
                detail = "Recording has no states and no actions"
                result.reject(row, "missing_actions", detail, {"state_kind": "none"})
                continue
            built = kinematics.get(episode.embodiment) if _needs_kinematics(episode) else None
            computed, numbers = compute_tracks(
                episode, built, controls=config.source, without_mount=config.without_mount
            )
        except (DataError, ConfigError, UnavailableError) as error:
            if is_transient(error):
                raise
            result.reject(row, _reason(error), error.what, {"expected": str(error.expected), "got": str(error.got)})
            continue
        except Exception as error:
            if is_transient(error) or ends_the_run(error):
                raise
            detail = f"Projecting ended with {type(error).__name__}: {portable_message(str(error))}"
            result.reject(row, "crashed", detail, crash_evidence(error))
            continue
        result.tracks.append(computed)
        result.counts.setdefault(episode.embodiment, []).append(numbers)
    return result


def _needs_kinematics(episode: Episode) -> bool:
    return episode.T_base_ee is None


def render_actions(
    config: RenderActionsConfig, inputs: Mapping[str, Path], output: Path, mapper: ShardMapper | None = None
) -> dict[str, Any]:
    """Compute the tracks of every episode of `inputs["episodes"]`.

    An episode whose tracks cannot be computed goes to `quarantine.parquet` with a reason; the rest goes on. Interrupted
    work continues with the shards that are not written.

    Args:
        mapper: what does the shards, by default this process. The tracks do not depend on it.

    Returns:
        Counts: episodes found, with tracks, quarantined; samples, masked ones by cause, and gripper overshoot by arm
        (`TrackCounts`), of all episodes and by embodiment.

    Raises:
        ConfigError: no input `episodes`.
        UnreachableInputError: episodes could not be read for a reason that passes.
    """
    if "episodes" not in inputs:
        raise ConfigError("render_actions needs an EpisodeSet", expected="input episodes", got=sorted(inputs))
    episodes = EpisodeSet.open(inputs["episodes"])
    shards = _compute_all(config, episodes, output, mapper or SerialMapper())
    rows: list[dict[str, Any]] = []
    rejected: list[QuarantineRow] = []
    counts: dict[str, list[TrackCounts]] = {}
    for shard in shards:
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


def _compute_all(
    config: RenderActionsConfig, episodes: EpisodeSet, output: Path, mapper: ShardMapper
) -> Iterator[dict[str, Any]]:
    """Write every shard that is not there yet; yields what is known of each, in order."""
    run, text, folder = uuid.uuid4().hex, config.model_dump_json(), str(episodes.root)
    pieces = cut(range(len(episodes)), config.episodes_per_shard)
    shards = [RenderShard(n, run, text, folder, str(output), p[0], p[-1] + 1) for n, p in enumerate(pieces)]

    def unfinished() -> list[RenderShard]:
        return [s for s in shards if not (result_path(output, s.number).is_file() and _shard_file(output, s).is_file())]

    with tqdm(total=len(episodes), desc="tracks", unit="episode", disable=None) as progress:
        todo = unfinished()
        progress.update(len(episodes) - sum(map(len, todo)))
        try:
            run_jobs(mapper, render_shard, todo, done=progress.update, crashed=note_crash)
            # A shard with an episode that ends its process is made again, without that episode.
            run_jobs(mapper, render_shard, unfinished(), done=progress.update, crashed=note_crash)
        finally:
            opened.cache_clear()
    if left := unfinished():
        raise DataError(
            "Tracks of some episodes could not be computed",
            where=str(output),
            got=", ".join(shard.label for shard in left[:5]),
            next_step="run the step again; if it stays, look at the machine's memory",
        )
    for shard in shards:
        yield json.loads(result_path(output, shard.number).read_text(encoding="utf-8"))


def _shard_file(output: Path, shard: RenderShard) -> Path:
    return output / shard_name(shard.number)


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
