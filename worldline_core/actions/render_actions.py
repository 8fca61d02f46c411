"""`render_actions`: the tracks of every episode of a set, counts of what was masked, and previews of the first few."""

from __future__ import annotations

import json
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from itertools import batched, islice
from pathlib import Path
from typing import Any, ClassVar

from worldline_core.actions.action_tracks import MissingActionsError, add_counts, compute_tracks
from worldline_core.actions.actions_config import RenderActionsConfig
from worldline_core.actions.episode_tracks import (
    ARRAYS,
    NO_CALIBRATION,
    SHARD_FILE,
    ActionTracks,
    EpisodeTracks,
    write_index,
    write_shard,
)
from worldline_core.actions.overlays import OverlayStyle, overlay_sheet
from worldline_core.data.episodes.episode import NO_EMBODIMENT
from worldline_core.data.episodes.episode_index import QuarantineRow, nothing_kept, write_quarantine
from worldline_core.data.episodes.episode_set import EpisodeSet, ShardFilesWork
from worldline_core.data.episodes.episode_set_writer import part_name
from worldline_core.errors import CalibrationError, ConfigError, DataError, UnavailableError
from worldline_core.geometry.kinematics import ArmKinematics, KinematicsByName
from worldline_core.pictures import evenly_spaced, png_bytes
from worldline_core.scale.account import InputRow, check_account, write_account
from worldline_core.scale.mapping import SerialMapper, ShardMapper, map_episodes, reading_input
from worldline_core.store.atomic import write_bytes_atomic, write_json_atomic
from worldline_core.store.remote import is_transient

_PREVIEW_MOMENTS = 4
_ACCOUNT = ("episode_id", "source", "status", "reason", "stored_bytes")


@dataclass(frozen=True, kw_only=True)
class ProjectedEpisode(InputRow):
    """Outcome for one episode.

    Attributes:
        tracks, counts: of an episode that is kept.
        rejection: of one that is not.
    """

    embodiment: str
    tracks: EpisodeTracks | None = None
    counts: dict[str, int] | None = None
    rejection: QuarantineRow | None = None


@dataclass(frozen=True)
class RenderWork(ShardFilesWork[ProjectedEpisode]):
    """Computes the tracks of each episode; a shard becomes one file of the artifact."""

    step: ClassVar[str] = "render_actions"
    doing: ClassVar[str] = "Projecting"
    shard_file = SHARD_FILE

    config: RenderActionsConfig

    @cached_property
    def _kinematics(self) -> KinematicsByName:
        return KinematicsByName(self.config.description_paths)

    def _kinematics_of(self, embodiment: str) -> ArmKinematics:
        if embodiment == NO_EMBODIMENT:
            raise ConfigError(
                "The robot of the recording has no description", got=f"embodiment: {NO_EMBODIMENT}",
                expected="a robot of `worldline embodiment list`",
                next_step="declare the robot and its arms in the source; without, Stage I alone learns from it",
            )  # fmt: skip
        return self._kinematics.get(embodiment)

    def do(self, episode: int) -> ProjectedEpisode:
        with reading_input(f"{self.folder}, episode {self.episodes.rows[episode].episode_id}"):
            recorded = self.episodes.episode(episode)
        try:
            controls = self.config.source
            needed = recorded.T_base_ee is None if controls == "state" else recorded.commanded
            tracks, counts = compute_tracks(
                recorded,
                self._kinematics_of(recorded.embodiment) if needed and recorded.state_kind == "joints" else None,
                controls=controls,
                without_mount=self.config.without_mount,
            )
        except (DataError, ConfigError, UnavailableError) as error:
            if is_transient(error):
                raise
            evidence = {"expected": str(error.expected), "got": str(error.got)}
            match error:
                case MissingActionsError():
                    reason = "missing_actions"
                case CalibrationError():
                    reason = NO_CALIBRATION
                case UnavailableError():
                    reason = "kinematics_unavailable"
                case ConfigError():
                    reason = "unknown_embodiment"
                case _:
                    reason = "invalid_controls"
            # Without the place: it may name a folder of this machine, and the row names the episode.
            said = DataError(error.what, expected=error.expected, got=error.got, next_step=error.next_step)
            return self._reject(episode, reason, str(said), evidence)
        row = self.episodes.rows[episode]
        return ProjectedEpisode(
            episode_id=row.episode_id,
            source=row.source,
            status="kept",
            stored_bytes=sum(getattr(tracks, name).nbytes for name in ARRAYS),
            embodiment=recorded.embodiment,
            tracks=tracks,
            counts=counts,
        )

    def quarantine_crashed(self, episode: int, detail: str, evidence: Mapping[str, Any]) -> ProjectedEpisode:
        return self._reject(episode, "crashed", detail, evidence)

    def finish_shard(self, number: int, results: Sequence[ProjectedEpisode]) -> None:
        """Write the tracks of a shard into one file; index rows, rejections, counts and account of its episodes into another."""
        counts: dict[str, list[dict[str, int]]] = {}
        for result in results:
            if result.counts is not None:
                counts.setdefault(result.embodiment, []).append(result.counts)
        rows = write_shard(self.output, number, [result.tracks for result in results if result.tracks is not None])
        summary = {
            "rows": rows,
            "rejected": [asdict(result.rejection) for result in results if result.rejection is not None],
            "counts": {name: add_counts(parts) for name, parts in counts.items()},
            "account": [{name: getattr(result, name) for name in _ACCOUNT} for result in results],
        }
        write_json_atomic(self.summary_path(number), summary)

    def _reject(self, position: int, reason: str, detail: str, evidence: Mapping[str, Any]) -> ProjectedEpisode:
        row = self.episodes.rows[position]
        numbers = json.dumps(dict(evidence), sort_keys=True)
        return ProjectedEpisode(
            episode_id=row.episode_id,
            source=row.source,
            status="quarantined",
            reason=reason,
            embodiment=row.embodiment,
            rejection=QuarantineRow(row.episode_id, row.source, reason, detail, numbers),
        )


def render_actions(
    config: RenderActionsConfig, inputs: Mapping[str, Path], output: Path, mapper: ShardMapper | None = None
) -> dict[str, Any]:
    """Compute the tracks of every episode of `inputs["episodes"]`.

    An episode whose tracks cannot be computed goes to `quarantine.parquet` with a reason; the rest goes on. Interrupted
    work continues with the shards that are not written.

    Args:
        mapper: what does the shards, by default this process. The tracks do not depend on it.

    Returns:
        Counts: episodes found, with tracks, quarantined; samples, and masked ones by cause
        (`count_samples`), of all episodes and by embodiment.

    Raises:
        ConfigError: no input `episodes`.
        DataError: no episode got tracks; the next call tries all of them again.
        UnreachableInputError: episodes could not be read for a reason that passes.
    """
    if "episodes" not in inputs:
        raise ConfigError("render_actions needs an EpisodeSet", expected="input episodes", got=sorted(inputs))
    work = RenderWork(output, inputs["episodes"], config)
    episodes = work.episodes
    pieces = list(batched(range(len(episodes)), config.episodes_per_shard))
    map_episodes(mapper or SerialMapper(), work, pieces)
    rows: list[dict[str, Any]] = []
    rejected: list[QuarantineRow] = []
    counts: dict[str, list[dict[str, int]]] = {}
    account: list[InputRow] = []
    for number in range(len(pieces)):
        shard = work.summary(number)
        rows += shard["rows"]
        rejected += [QuarantineRow(**row) for row in shard["rejected"]]
        account += [InputRow(**row) for row in shard["account"]]
        for embodiment, numbers in shard["counts"].items():
            counts.setdefault(embodiment, []).append(numbers)
    write_account(output, account)
    check_account(output, len(episodes), {row["episode_id"] for row in rows}, {row.episode_id for row in rejected})
    if not rows:
        shutil.rmtree(output / "run")  # what is missing may be outside of the set, as a kinematic description does
        next_step = "give what is missing; render_actions.source=state projects recorded tool poses without kinematics"
        raise nothing_kept("No episode got action tracks", output, rejected, next_step)
    write_index(output, rows, sigma_px_ref=config.sigma_px_ref)
    write_quarantine(output, rejected)
    _previews(config, episodes, ActionTracks.open(output), output)
    by_embodiment = {name: add_counts(parts) for name, parts in sorted(counts.items())}
    summary = {
        "found": len(episodes),
        "kept": len(rows),
        "quarantined": len(rejected),
        "samples": add_counts(list(by_embodiment.values())),
        "by_embodiment": by_embodiment,
        "quarantine_reasons": dict(sorted(Counter(row.reason for row in rejected).items())),
    }
    write_json_atomic(output / "summary.json", summary)
    return summary


def _previews(config: RenderActionsConfig, episodes: EpisodeSet, tracks: ActionTracks, output: Path) -> None:
    """Sheets of a few episodes under `previews/`: the first of each embodiment, then further ones."""
    usable = [i for i, row in enumerate(episodes.rows) if row.episode_id in tracks and row.video_frames > 0]
    firsts = {episodes.rows[i].embodiment: i for i in reversed(usable)}
    chosen = dict.fromkeys([*sorted(firsts.values()), *usable])
    for position in islice(chosen, config.previews):
        row = episodes.rows[position]
        found, title = tracks.tracks(row.episode_id), f"{row.episode_id}  ·  {row.embodiment}  ·  {row.instruction}"
        moments = evenly_spaced(min(found.num_frames, row.video_frames), _PREVIEW_MOMENTS)
        frames = {view: episodes.frames(position, view, moments) for view in row.views}
        sheet = overlay_sheet(frames, found, moments, style=OverlayStyle(config.sigma_px_ref), title=title)
        write_bytes_atomic(output / "previews" / f"{part_name(row.episode_id)}.png", png_bytes(sheet))
