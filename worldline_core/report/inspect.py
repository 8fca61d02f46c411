"""Inspection of an artifact: what it is and its counts; and, by `inspect_pictures`, a sheet, a video, a recording.

Works on every kind: EpisodeSet, Quarantine, ActionTracks, Latents, Checkpoint, RolloutSet, Scores, Report.
"""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from worldline_core.errors import ConfigError
from worldline_core.report.inspect_pictures import PICTURED, write_pictures
from worldline_core.store.artifact_files import JsonObject, kind_of, read_json, read_rows

COUNTED = {
    "EpisodeSet": ("embodiment", "task_family", "outcome", "split", "source"),
    "ActionTracks": ("embodiment", "controls"),
    "Latents": ("embodiment", "controls"),
    "RolloutSet": ("method", "view", "seed"),
}
"""Columns of an index whose values are counted, by kind of artifact."""


@dataclass(frozen=True)
class Inspection:
    """What was found: the kind, lines to print, and files that were written."""

    kind: str
    lines: list[str]
    written: list[Path] = field(default_factory=list)

    def __str__(self) -> str:
        written = [f"wrote {path}" for path in self.written]
        return "\n".join([self.kind, *(f"  {line}" for line in self.lines), *written])


def inspect(
    folder: Path,
    output: Path | None = None,
    *,
    episodes: Path | None = None,
    episode_id: str | None = None,
    video: bool = False,
    rerun: bool = False,
    page: int | None = None,
) -> Inspection:
    """Describes an artifact and writes pictures of it.

    Args:
        folder: a finished artifact.
        output: where `contact_sheet.png`, `<episode>.mp4` and `<episode>.rrd` are written; default: the artifact's own
            `run/`, which belongs to no digest.
        episodes: the EpisodeSet that tracks or predictions belong to; default: the one that their manifest names.
        episode_id: the episode to show; default: a sheet of several, and the first one's video and recording.
        video: also write a video of one episode, all views side by side, with its controls drawn over them.
        rerun: also write a Rerun recording of one episode.
        page: also write `page/index.html`, to browse so many episodes (0: all) with their videos.

    Raises:
        ArtifactError: the folder is of no known kind, or the EpisodeSet that it belongs to is not known.
        DataError: there is no such episode, or its controls cannot be projected.
        ConfigError: a picture was asked for of a kind that has none.
    """
    kind = kind_of(folder)
    lines = [*describe_manifest(folder), *describe(kind, folder)]
    if kind in PICTURED:
        written, notes = write_pictures(
            kind, folder, output or folder / "run", episodes, episode_id, video=video, rerun=rerun, page=page
        )
        return Inspection(kind, [*lines, *notes], written)
    if video or rerun or episode_id is not None or page is not None:
        raise ConfigError("There are no pictures of this kind of artifact", expected=" | ".join(PICTURED), got=kind)
    return Inspection(kind, lines)


def describe_manifest(folder: Path) -> list[str]:
    """Step, digest and wall time where there is a manifest."""
    manifest = read_json(folder / "manifest.json")
    if not manifest:
        return []
    step, version, digest, seconds = (manifest.get(key) for key in ("step", "version", "digest", "wall_seconds"))
    took = f", {seconds:.1f} s" if isinstance(seconds, (int, float)) else ""
    return [f"step {step}, version {version}, digest {str(digest)[:16]}{took}"]


def describe(kind: str, folder: Path) -> list[str]:
    """What an artifact holds, in a few lines."""
    if kind == "Scores":
        return describe_scores(folder)
    if kind == "Checkpoint":
        content = read_json(folder / "checkpoint.json")
        size = sum(path.stat().st_size for path in folder.glob("*.safetensors"))
        known = [key for key in ("action_contract", "metadata", "model") if key in content]
        facts = [f"{key}: {json.dumps(content[key], sort_keys=True)}" for key in known]
        return [f"kind {content.get('kind')}, {size / 1e6:.1f} MB of tensors", *facts]
    if kind == "Report":
        media = len(list((folder / "media").glob("*")))
        return [f"open {folder / 'index.html'} in a browser", f"{media} pictures and videos"]
    rows, refused = read_rows(folder / "index.parquet"), read_rows(folder / "quarantine.parquet")
    lines = [counted(rows, key) for key in COUNTED.get(kind, ()) if rows and key in rows[0]]
    quarantine = [f"quarantine: {len(refused)}", *([counted(refused, "reason")] if refused else [])]
    episodes = len({row["episode_id"] for row in rows})
    if kind == "EpisodeSet":
        return [f"{len(rows)} episodes, {sum(row['num_frames'] for row in rows)} time steps", *lines, *quarantine]
    if kind == "RolloutSet":
        return [f"{len(rows)} predicted videos of {episodes} episodes", *lines]
    return quarantine if kind == "Quarantine" else [f"{episodes} episodes", *lines, *quarantine]


def counted(rows: list[JsonObject], key: str) -> str:
    """`key: a 3, b 2`, the most frequent first."""
    found = sorted(Counter(str(row[key]) for row in rows).items(), key=lambda item: (-item[1], item[0]))
    return f"{key}: " + ", ".join(f"{name} {count}" for name, count in found)


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
