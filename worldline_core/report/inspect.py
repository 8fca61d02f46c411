"""Inspection of an artifact: what it is and its counts; and, by `inspect_pictures`, a sheet, a video, a recording.

Works on every kind: EpisodeSet, Quarantine, ActionTracks, Latents, Checkpoint, RolloutSet, Scores, Report.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from worldline_core.store.artifact_files import kind_of, read_json, read_rows


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
        ArtifactError: the folder is of no known kind.
        DataError: there is no such episode, or its controls cannot be projected.
        ConfigError: a picture was asked for of a kind that has none.
    """
    from worldline_core.report.inspect_pictures import PicturesWanted, write_pictures

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
    wanted = PicturesWanted(episode_id, video, rerun, page)
    written, notes = write_pictures(kind, folder, output or folder / "run", episodes, wanted)
    return Inspection(kind, [*lines, *notes], written)


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
