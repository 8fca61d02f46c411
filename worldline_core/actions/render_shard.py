"""A shard of `render_actions`: the tracks of some episodes, in one file, wherever the shard is worked on."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from worldline_core.actions.action_tracks import compute_tracks
from worldline_core.actions.episode_tracks import EpisodeTracks
from worldline_core.actions.render_config import RenderActionsConfig
from worldline_core.actions.track_counts import TrackCounts, add_counts
from worldline_core.actions.tracks import shard_name, write_shard
from worldline_core.data.episodes.episode import Episode
from worldline_core.data.episodes.episode_index import EpisodeRow
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import CalibrationError, ConfigError, DataError, UnavailableError, WorldLineError
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.scale.crashes import crash_evidence, portable_message
from worldline_core.scale.mapping import ends_the_run
from worldline_core.scale.transient import is_transient
from worldline_core.store.atomic import write_json_atomic


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
