"""Inspection of an artifact: what it is, its counts, and a contact sheet to look at.

Works on every kind: EpisodeSet, Quarantine, ActionTracks, Latents, Checkpoint, RolloutSet, Scores, Report.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from worldline_core.errors import ArtifactError, DataError
from worldline_core.report.artifacts import read_json, read_rows, read_table

if TYPE_CHECKING:
    from worldline_core.exports.labels import Picture

SHEET_ROWS = 8


@dataclass(frozen=True)
class Inspection:
    """What was found: the kind, lines to print, and files that were written."""

    kind: str
    lines: list[str]
    written: list[Path] = field(default_factory=list)

    def __str__(self) -> str:
        written = [f"wrote {path}" for path in self.written]
        return "\n".join([self.kind, *(f"  {line}" for line in self.lines), *written])


def kind_of(folder: Path) -> str:
    """The kind of an artifact, told by its files.

    Raises:
        ArtifactError: the folder is not there, or is of no known kind.
    """
    if not folder.is_dir():
        raise ArtifactError("No such artifact folder", where=folder, next_step="give the folder of a finished artifact")
    if (folder / "scores.parquet").is_file():
        return "Scores"
    if (folder / "checkpoint.json").is_file():
        return "Checkpoint"
    if (folder / "index.html").is_file():
        return "Report"
    index = read_table(folder / "index.parquet")
    columns = set() if index is None else set(index.column_names)
    for kind, needed in (
        ("RolloutSet", {"episode_id", "method", "seed"}),
        ("EpisodeSet", {"episode_id", "dataset", "outcome"}),
        ("ActionTracks", {"episode_id", "arms", "shard"}),
        ("Latents", {"episode_id"}),
    ):
        if needed <= columns:
            return kind
    if (folder / "quarantine.parquet").is_file():
        return "Quarantine"
    raise ArtifactError(
        "Not an artifact of a known kind",
        where=folder,
        expected="index.parquet, scores.parquet, checkpoint.json, quarantine.parquet or index.html",
        got=", ".join(sorted(path.name for path in folder.iterdir())[:8]) or "an empty folder",
    )


def inspect(
    folder: Path, output: Path | None = None, *, episodes: Path | None = None, rerun: bool = False
) -> Inspection:
    """Describes an artifact and writes pictures of it.

    Args:
        folder: a finished artifact.
        output: where `contact_sheet.png` (and `<episode>.rrd`) are written; default: the artifact's own `run/`, which
            belongs to no digest.
        episodes: the EpisodeSet that tracks or predictions belong to, for pictures that need the recorded frames.
        rerun: also write a Rerun recording of the first episode.

    Raises:
        ArtifactError: the folder is of no known kind.
    """
    kind = kind_of(folder)
    describe: dict[str, Callable[[Path], list[str]]] = {
        "EpisodeSet": describe_episodes,
        "Quarantine": describe_quarantine,
        "ActionTracks": describe_index,
        "Latents": describe_index,
        "RolloutSet": describe_rollouts,
        "Scores": describe_scores,
        "Checkpoint": describe_checkpoint,
        "Report": describe_report,
    }
    lines = [*describe_manifest(folder), *describe[kind](folder)]
    target = output or folder / "run"
    written = write_pictures(kind, folder, target, episodes)
    if rerun:
        written += write_recording(kind, folder, target, episodes)
    return Inspection(kind, lines, written)


def describe_manifest(folder: Path) -> list[str]:
    """Step, digest and wall time where there is a manifest."""
    manifest = read_json(folder / "manifest.json")
    if not manifest:
        return []
    seconds = manifest.get("wall_seconds")
    took = f", {seconds:.1f} s" if isinstance(seconds, (int, float)) else ""
    return [
        f"step {manifest.get('step')}, version {manifest.get('version')}, digest {str(manifest.get('digest'))[:16]}{took}"
    ]


def counted(rows: list[dict[str, object]], key: str) -> str:
    """`key: a 3, b 2`, the most frequent first."""
    found = Counter(str(row.get(key)) for row in rows)
    return f"{key}: " + ", ".join(
        f"{name} {count}" for name, count in sorted(found.items(), key=lambda i: (-i[1], i[0]))
    )


def describe_episodes(folder: Path) -> list[str]:
    """Counts of an EpisodeSet and of its quarantine."""
    rows = read_rows(folder / "index.parquet")
    lines = [f"{len(rows)} episodes, {sum(row['num_frames'] for row in rows)} time steps"]
    lines += [counted(rows, key) for key in ("embodiment", "task_family", "outcome", "split", "source")]
    return lines + describe_quarantine(folder)


def describe_quarantine(folder: Path) -> list[str]:
    """Reasons and their counts."""
    rows = read_rows(folder / "quarantine.parquet")
    return [f"quarantine: {len(rows)}", *([counted(rows, "reason")] if rows else [])]


def describe_index(folder: Path) -> list[str]:
    """Counts of an index by episode."""
    rows = read_rows(folder / "index.parquet")
    keys = [key for key in ("embodiment", "controls") if rows and key in rows[0]]
    return [
        f"{len({row['episode_id'] for row in rows})} episodes",
        *[counted(rows, key) for key in keys],
        *describe_quarantine(folder),
    ]


def describe_rollouts(folder: Path) -> list[str]:
    """Method, episodes, seeds and views of predicted videos."""
    rows = read_rows(folder / "index.parquet")
    episodes = len({row["episode_id"] for row in rows})
    return [
        f"{len(rows)} predicted videos of {episodes} episodes",
        *[counted(rows, key) for key in ("method", "view", "seed")],
    ]


def describe_scores(folder: Path) -> list[str]:
    """Means by method and metric."""
    rows = read_rows(folder / "scores.parquet")
    values: dict[tuple[str, str, str], list[float]] = {}
    for row in rows:
        values.setdefault((str(row["split"]), str(row["metric"]), str(row["method"])), []).append(row["value"])
    lines = [
        f"{split:10s} {metric:28s} {method:28s} mean {np.mean(v):9.4f}  n {len(v)}"
        for (split, metric, method), v in sorted(values.items())
    ]
    return [f"{len(rows)} scores of {len({row['episode_id'] for row in rows})} trajectories", *lines]


def describe_checkpoint(folder: Path) -> list[str]:
    """Kind, size and contract of a checkpoint."""
    content = read_json(folder / "checkpoint.json")
    size = sum(path.stat().st_size for path in folder.glob("*.safetensors"))
    lines = [f"kind {content.get('kind')}, {size / 1e6:.1f} MB of tensors"]
    return lines + [
        f"{key}: {json.dumps(content[key], sort_keys=True)}"
        for key in ("action_contract", "metadata", "model")
        if key in content
    ]


def describe_report(folder: Path) -> list[str]:
    """Where to look."""
    media = list((folder / "media").iterdir()) if (folder / "media").is_dir() else []
    return [f"open {folder / 'index.html'} in a browser", f"{len(media)} pictures and videos"]


def write_pictures(kind: str, folder: Path, output: Path, episodes: Path | None) -> list[Path]:
    """The contact sheet of a kind that has pictures."""
    from worldline_core.exports.pictures import png_bytes
    from worldline_core.store.atomic import write_bytes_atomic

    makers: dict[str, Callable[[], Picture | None]] = {
        "EpisodeSet": lambda: episode_sheet(folder),
        "RolloutSet": lambda: rollout_sheet(folder),
        "ActionTracks": lambda: None if episodes is None else tracks_sheet(folder, episodes),
    }
    picture = makers[kind]() if kind in makers else None
    if picture is None:
        return []
    path = output / "contact_sheet.png"
    write_bytes_atomic(path, png_bytes(picture))
    return [path]


def episode_sheet(folder: Path) -> Picture | None:
    """Six moments of up to eight episodes, spread over embodiments and tasks."""
    from worldline_core.data.episode_set import EpisodeSet
    from worldline_core.exports.contact_sheet import SheetRow, contact_sheet, evenly_spaced
    from worldline_core.report.sections.data import one_of_each

    episodes = EpisodeSet.open(folder)
    rows: list[SheetRow] = []
    for index in one_of_each(read_rows(folder / "index.parquet"), SHEET_ROWS):
        row = episodes.rows[index]
        try:
            frames = np.asarray(episodes.frames(index, row.primary_view, evenly_spaced(row.video_frames, 6)))
        except DataError:
            continue
        rows.append(SheetRow(f"{row.embodiment}  ·  {row.instruction}  ·  {row.outcome}", frames, row.episode_id))
    return contact_sheet(rows) if rows else None


def rollout_sheet(folder: Path) -> Picture | None:
    """Six moments of up to eight predictions, head view first."""
    from worldline_core.exports.contact_sheet import SheetRow, contact_sheet, evenly_spaced
    from worldline_core.rollout.rollout_set import RolloutSet

    rollouts = RolloutSet.open(folder)
    views = {str(row["episode_id"]): str(row["view"]) for row in reversed(read_rows(folder / "index.parquet"))}
    rows: list[SheetRow] = []
    for episode_id in evenly_chosen(sorted(rollouts.episode_ids)):
        frames = np.asarray(rollouts.frames(episode_id, views[episode_id], rollouts.seeds(episode_id)[0]))
        rows.append(
            SheetRow(f"{rollouts.method}  ·  {episode_id}", frames[evenly_spaced(len(frames), 6)], views[episode_id])
        )
    return contact_sheet(rows) if rows else None


def tracks_sheet(folder: Path, episodes_folder: Path) -> Picture | None:
    """Action maps over the recorded frames of the first episode that both have."""
    from worldline_core.actions.tracks import ActionTracks
    from worldline_core.data.episode_set import EpisodeSet
    from worldline_core.report.sections.actions import overlay_sheet

    tracks, episodes = ActionTracks.open(folder), EpisodeSet.open(episodes_folder)
    for index, row in enumerate(episodes.rows):
        if row.episode_id in tracks:
            return overlay_sheet(episodes, index, tracks.tracks(row.episode_id))
    return None


def evenly_chosen(names: list[str]) -> list[str]:
    """Up to eight names, spread over the list."""
    if len(names) <= SHEET_ROWS:
        return names
    return [names[round(i)] for i in np.linspace(0, len(names) - 1, SHEET_ROWS)]


def write_recording(kind: str, folder: Path, output: Path, episodes_folder: Path | None) -> list[Path]:
    """A Rerun recording of the first episode of an EpisodeSet, or of the first prediction of a RolloutSet."""
    from worldline_core.data.episode_set import EpisodeSet
    from worldline_core.exports.rerun_recording import write_rerun_recording
    from worldline_core.exports.rollout import recording_content, safe_stem
    from worldline_core.rollout.rollout_set import RolloutSet

    source = folder if kind == "EpisodeSet" else episodes_folder
    if source is None or kind not in ("EpisodeSet", "RolloutSet"):
        return []
    episodes = EpisodeSet.open(source)
    rollouts = {} if kind == "EpisodeSet" else {(opened := RolloutSet.open(folder)).method: opened}
    first = (
        episodes.rows[0].episode_id if kind == "EpisodeSet" else sorted(next(iter(rollouts.values())).episode_ids)[0]
    )
    path = output / f"{safe_stem(first)}.rrd"
    write_rerun_recording(path, recording_content(rollouts, episodes, None, first))
    return [path]
