"""The step import_rollouts: any folder of videos as a RolloutSet, so that any model appears in the same tables.

Files are named by a template (``{episode}_{view}.mp4``). Every file of the folder and every expected video is accounted for in
``files.parquet``: matched, unknown or missing. Counts, rates and sizes are compared with the recordings before anything is
written, and all problems are listed at once.
"""

from __future__ import annotations

import re
import shutil
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.guards.plain_files import UPRIGHT
from worldline_core.data.guards.source_paths import find_files, relative_name
from worldline_core.data.video.clip import VideoClip, frame_times, read_clip, shown_size, video_size
from worldline_core.errors import DataError
from worldline_core.progress import with_progress
from worldline_core.rollout.rollout_config import LAYOUTS, NAME_FIELD, ImportRolloutsConfig, VideoLayout
from worldline_core.rollout.rollout_set import RolloutSetWriter, video_path
from worldline_core.store.artifact_files import row_schema
from worldline_core.store.atomic import atomic_path

FILES = "files.parquet"
SUFFIXES = (".mp4", ".mov", ".mkv", ".webm", ".avi")
_MOST_PROBLEMS = 20
_RATE_TOLERANCE = 1e-3


@dataclass(frozen=True)
class ImportedFile:
    """Account of one file, or of one expected video without a file (``path`` is empty)."""

    path: str
    status: str
    episode_id: str
    view: str
    seed: int
    detail: str = ""


def import_rollouts(config: ImportRolloutsConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """Write the ``videos`` that show predictions of ``episodes`` as a RolloutSet.

    Frame k of a video shows recorded frame k; frame 0 is the observed one. Videos are copied as they are, unless they are cut,
    resized or in tiles.

    Returns:
        counts of files by status, of predictions and frames.

    Raises:
        DataError: files are unknown or missing, or their frame counts, rates or sizes are not those of the recordings.
    """
    folder, episodes = Path(inputs["videos"]), EpisodeSet.open(Path(inputs["episodes"]))
    files = _account(config, folder, episodes)
    matched = [file for file in files if file.status == "matched"]
    _refuse(config, folder, files)
    rates = {episodes.rows[episodes.position(file.episode_id)].fps for file in matched}
    if len(rates) != 1:
        raise DataError("The recordings of these videos have several rates", where=folder, got=sorted(rates))
    lengths = _check(config, folder, episodes, matched)
    with atomic_path(output / FILES) as temporary:
        rows = [asdict(file) for file in files]
        pq.write_table(pa.Table.from_pylist(rows, schema=row_schema(ImportedFile)), temporary)
    writer = RolloutSetWriter(output, config.method, rates.pop(), crf=0)
    for file in with_progress(matched, "import_rollouts", "video"):
        _write(config, folder, episodes, writer, file, lengths[file.path])
    writer.close()
    return {
        "method": config.method,
        "episodes": len({file.episode_id for file in matched}),
        "views": list(config.shown),
        "frames": sum(lengths.values()) * len(config.shown if config.tiles else (1,)),
        "files": dict(sorted(Counter(file.status for file in files).items())),
    }


def _account(config: ImportRolloutsConfig, folder: Path, episodes: EpisodeSet) -> list[ImportedFile]:
    """Every video file of the folder, and every expected video that has none."""
    known = {row.episode_id: row for row in episodes.rows}
    videos = [path for path in find_files(folder, "*") if path.suffix.lower() in SUFFIXES and path.is_file()]
    names = sorted(str(relative_name(path, folder)) for path in videos)
    pattern = _pattern(config)
    files: list[ImportedFile] = []
    taken: dict[tuple[str, str, int], str] = {}
    for name in names:
        found = pattern.fullmatch(name)
        if found is None:
            files.append(ImportedFile(name, "unknown", "", "", 0, "its name does not fit"))
            continue
        fields = found.groupdict()
        their_view, seed = fields.get("view") or "", int(fields.get("seed") or 0)
        episode = config.episode_id.replace("{episode}", fields["episode"])
        view = config.names.get(their_view, their_view)
        key, detail = (episode, view, seed), ""
        if episode not in known:
            detail = f"no episode {episode}"
        elif known[episode].split not in config.splits:
            detail = f"of the split {known[episode].split}"
        elif not config.tiles and view not in known[episode].views:
            detail = f"the recording has no view {view}"
        elif key in taken:
            detail = f"shows the same as {taken[key]}"
        taken.setdefault(key, name)
        files.append(ImportedFile(name, "unknown" if detail else "matched", episode, view, seed, detail))
    seeds = sorted({file.seed for file in files if file.status == "matched"}) or [0]
    there = {(file.episode_id, file.view, file.seed) for file in files if file.status == "matched"}
    wanted_views = ("",) if config.tiles else config.shown
    for row in episodes.rows:
        for view in wanted_views if row.split in config.splits else ():
            absent = [seed for seed in seeds if (row.episode_id, view, seed) not in there]
            if not view or view in row.views:
                files += [ImportedFile("", "missing", row.episode_id, view, seed, "no file") for seed in absent]
    return files


def _pattern(config: ImportRolloutsConfig) -> re.Pattern[str]:
    """The template of file names as a regular expression with the groups episode, view and seed."""
    fields = {
        "episode": r"(?P<episode>.+?)",
        "view": f"(?P<view>{'|'.join(map(re.escape, sorted(config.names, key=len, reverse=True)))})",
        "seed": r"(?P<seed>\d{1,9})",
    }
    position, pattern = 0, ""
    for part in NAME_FIELD.finditer(config.name):
        pattern += re.escape(config.name[position : part.start()]) + (r"[^/]*" if part[2] else fields[part[1]])
        position = part.end()
    return re.compile(pattern + re.escape(config.name[position:]))


def _refuse(config: ImportRolloutsConfig, folder: Path, files: Sequence[ImportedFile]) -> None:
    """Raises: DataError for unknown and missing files that are refused, or when none matches."""
    refused = [f for f in files if f.status != "matched" and getattr(config, f.status) == "refuse"]
    counts = Counter(file.status for file in files)
    if refused or not counts["matched"]:
        lines = [f"{f.status}: {f.path or f'{f.episode_id} {f.view} seed {f.seed}'} ({f.detail})" for f in refused]
        raise DataError(
            "The folder's videos are not those of the recordings",
            where=folder,
            expected=f"{config.name}: {', '.join(config.shown)} of every episode of {config.splits}",
            got=f"{dict(counts)}\n    " + "\n    ".join(_some(lines)),
            next_step="correct name, views or episode_id; or report what is missing or unknown: "
            "missing=report, unknown=report",
        )  # fmt: skip


def _check(
    config: ImportRolloutsConfig, folder: Path, episodes: EpisodeSet, matched: Sequence[ImportedFile]
) -> dict[str, int]:
    """Frames that are kept of each file.

    Raises: DataError that lists every file whose frames, rate or size are not the recording's.
    """
    problems: list[str] = []
    lengths: dict[str, int] = {}
    per_prediction: dict[tuple[str, int], set[int]] = defaultdict(set)
    grid = (1, 1) if config.tiles is None else (len(config.tiles), len(config.tiles[0]))
    layout = None if config.layout is None else LAYOUTS[config.layout]
    for file in matched:
        position = episodes.position(file.episode_id)
        row = episodes.rows[position]
        rate, (height, width, _) = video_size(folder / file.path)[2], shown_size(folder / file.path)
        count = len(frame_times(folder / file.path))
        lengths[file.path] = count
        per_prediction[file.episode_id, file.seed].add(count)
        if abs((config.fps or rate) / row.fps - 1) > _RATE_TOLERANCE:
            problems.append(f"{file.path}: {config.fps or rate:g} frames per second, the recording has {row.fps:g}")
        if layout is not None:
            problems += _departures(layout, file.path, rate, count, row.video_frames, (height, width))
        if not 2 <= count <= row.video_frames:
            problems.append(f"{file.path}: {count} frames, the recording has {row.video_frames}")
        if height % grid[0] or width % grid[1]:
            problems.append(f"{file.path}: {height} x {width} pixels do not divide into {grid[0]} x {grid[1]} tiles")
            continue
        size, recorded = (height // grid[0], width // grid[1]), _recorded_size(episodes, position)
        if size != recorded and not config.resize:
            problems.append(f"{file.path}: pictures of {size}, the recording's are {recorded}")
    for (episode, seed), counts in per_prediction.items():
        if len(counts) > 1:
            problems.append(f"{episode}, seed {seed}: views of {sorted(counts)} frames")
    if problems:
        raise DataError(
            "Videos and recordings do not fit together",
            where=folder,
            expected="the recording's rate, no more frames than it has, its picture size, equal lengths of all views",
            got=f"{len(problems)} problems\n    " + "\n    ".join(_some(problems)),
            next_step="curate the recordings at the videos' rate (curate.fps), state the true rate as fps, "
            "or bring pictures to size with resize=true",
        )
    return lengths


def _departures(
    layout: VideoLayout, name: str, rate: float, count: int, recorded: int, size: tuple[int, int]
) -> Iterator[str]:
    """Differences of a video from its layout."""
    if layout.fps is not None and abs(rate / layout.fps - 1) > _RATE_TOLERANCE:
        yield f"{name}: {rate:g} frames per second, the layout has {layout.fps:g}"
    frames = recorded if layout.frames == "whole" else layout.frames
    if frames is not None and count != frames:
        what = "as its recording" if layout.frames == "whole" else "in this layout"
        yield f"{name}: {count} frames, a video has {frames} {what}"
    if layout.size is not None:
        height, width = layout.size
        if size[0] < height or size[0] * width != size[1] * height:
            yield f"{name}: {size[1]} x {size[0]} pixels, the layout has {width} x {height}, or more in these proportions"


def _recorded_size(episodes: EpisodeSet, position: int) -> tuple[int, int]:
    height, width, _ = video_size(episodes.clip(position, episodes.rows[position].views[0]).path)
    return height, width


def _write(
    config: ImportRolloutsConfig,
    folder: Path,
    episodes: EpisodeSet,
    writer: RolloutSetWriter,
    file: ImportedFile,
    count: int,
) -> None:
    """Write one file's views; every frame is decoded."""
    path, position = folder / file.path, episodes.position(file.episode_id)
    height, width, orientation = shown_size(path)
    size = _recorded_size(episodes, position)
    views = config.shown if config.tiles else (file.view,)
    clip = VideoClip.whole_file(path, count, writer.fps)
    pictures = (picture.rgb for picture in read_clip(clip))
    if config.tiles is None and (height, width, orientation) == (*size, UPRIGHT):
        with atomic_path(writer.root / video_path(file.episode_id, file.seed, file.view)) as temporary:
            shutil.copyfile(path, temporary)
        writer.register(file.episode_id, file.seed, file.view, count, size)
        for _ in pictures:
            pass
        return
    with writer.video(file.episode_id, file.seed, views, size) as add:
        for picture in pictures:
            add({view: part[None] for view, part in _parts(config, picture, file.view, size).items()})


def _parts(
    config: ImportRolloutsConfig, picture: np.ndarray, view: str, size: tuple[int, int]
) -> dict[str, np.ndarray]:
    """The views that a picture shows, at the recordings' size."""
    parts = {view: picture}
    if config.tiles is not None:
        height, width = picture.shape[0] // len(config.tiles), picture.shape[1] // len(config.tiles[0])
        parts = {
            config.names.get(tile, tile): picture[r * height : (r + 1) * height, c * width : (c + 1) * width]
            for r, row in enumerate(config.tiles)
            for c, tile in enumerate(row)
            if tile is not None
        }
    return {
        name: part if part.shape[:2] == size else cv2.resize(part, size[::-1], interpolation=cv2.INTER_AREA)
        for name, part in parts.items()
    }


def _some(lines: Sequence[str]) -> list[str]:
    more = len(lines) - _MOST_PROBLEMS
    return [*lines[:_MOST_PROBLEMS], *([f"and {more} more"] if more > 0 else [])]
