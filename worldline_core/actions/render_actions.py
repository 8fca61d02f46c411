"""`render_actions`: tracks of every episode of a set, counts of what was masked, and previews of the first few."""

from __future__ import annotations

import json
import uuid
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from tqdm import tqdm

from worldline_core.actions.render_config import RenderActionsConfig
from worldline_core.actions.render_shard import RenderShard, note_crash, opened, render_shard, result_path
from worldline_core.actions.track_counts import TrackCounts, add_counts
from worldline_core.actions.tracks import ActionTracks, shard_name, write_index
from worldline_core.data.episodes.episode_index import QuarantineRow, write_quarantine
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import ConfigError, DataError
from worldline_core.exports.contact_sheet import evenly_spaced
from worldline_core.exports.overlay_views import overlay_sheet, write_overlay_video
from worldline_core.exports.overlays import OverlayStyle
from worldline_core.exports.pictures import png_bytes
from worldline_core.scale.mapping import SerialMapper, ShardMapper, cut, run_jobs
from worldline_core.store.atomic import write_bytes_atomic, write_json_atomic

__all__ = ["RenderActionsConfig", "render_actions"]


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
