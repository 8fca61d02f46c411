"""The step import_rollouts: any folder of videos as a RolloutSet, so that any model appears in the same tables.

The files are named by a template (``{episode}_{view}.mp4``) or listed in an index (CSV). Every file of the folder
and every video that is expected is accounted for in ``files.parquet``: matched, unknown or missing. Counts, rates and sizes
are compared with the recordings before anything is written, and all that is wrong is said at once.
"""

from __future__ import annotations

import csv
import io
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
from pydantic import Field

from worldline_core.config import StrictModel, validate
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.guards.plain_files import read_text
from worldline_core.data.guards.source_paths import find_files, inside, relative_name
from worldline_core.data.video.clip import VideoClip, frame_times, read_clip, video_size
from worldline_core.errors import DataError
from worldline_core.progress import with_progress
from worldline_core.rollout.rollout_config import NAME_FIELD, ImportRolloutsConfig
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


class _IndexRow(StrictModel):
    path: str
    episode: str
    view: str = ""
    seed: int = Field(default=0, ge=0)


def import_rollouts(config: ImportRolloutsConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """Write the ``videos`` that show predictions of ``episodes`` as a RolloutSet.

    Frame k of a video shows recorded frame k; frame 0 is the observed one. Videos are copied as they are, unless they are cut,
    resized or in tiles.

    Returns:
        counts of files by status, of predictions and frames, and the lowest PSNR [dB] between a video's first frame and the
        recorded one: low where files and episodes are confused.

    Raises:
        ConfigError: a row of the index lacks a field, or has an unknown one.
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
    writer = RolloutSetWriter(output, config.method, rates.pop(), crf=config.crf)
    nearest = [
        _write(config, folder, episodes, writer, file, lengths[file.path])
        for file in with_progress(matched, "import_rollouts", "video")
    ]
    writer.close()
    return {
        "method": config.method,
        "episodes": len({file.episode_id for file in matched}),
        "views": list(config.shown),
        "frames": sum(lengths.values()) * len(config.shown if config.tiles else (1,)),
        "files": dict(sorted(Counter(file.status for file in files).items())),
        "lowest_first_frame_psnr": min(nearest),
    }


def _account(config: ImportRolloutsConfig, folder: Path, episodes: EpisodeSet) -> list[ImportedFile]:
    """Every video file of the folder, and every expected video that has none."""
    known = {row.episode_id: row for row in episodes.rows}
    found = [path for path in find_files(folder, "*") if path.suffix.lower() in SUFFIXES and path.is_file()]
    names = [str(relative_name(path, folder)) for path in found]
    listed = dict(_listed(config, folder)) if config.index is not None else dict(_named(config, names))
    files: list[ImportedFile] = []
    taken: dict[tuple[str, str, int], str] = {}
    for name in sorted({*names, *listed}):
        row = listed.get(name)
        if row is None:
            files.append(
                ImportedFile(name, "unknown", "", "", 0, "not listed" if config.index else "its name does not fit")
            )
            continue
        episode, view = config.episode_prefix + row.episode, config.names.get(row.view, row.view)
        key, detail = (episode, view, row.seed), ""
        if name not in names:
            detail = "listed, but not there"
        elif episode not in known:
            detail = f"no episode {episode}"
        elif known[episode].split not in config.splits:
            detail = f"of the split {known[episode].split}"
        elif not config.tiles and (view not in config.shown or view not in known[episode].views):
            detail = f"the recording has no view {row.view or 'without a name'}"
        elif key in taken:
            detail = f"shows the same as {taken[key]}"
        status = "missing" if name not in names else "unknown" if detail else "matched"
        taken.setdefault(key, name)
        files.append(ImportedFile(name, status, episode, view, row.seed, detail))
    seeds = sorted({file.seed for file in files if file.status == "matched"}) or [0]
    there = {(file.episode_id, file.view, file.seed) for file in files if file.status == "matched"}
    wanted_views = ("",) if config.tiles else config.shown
    for row in episodes.rows:
        for view in wanted_views if row.split in config.splits else ():
            absent = [seed for seed in seeds if (row.episode_id, view, seed) not in there]
            if not view or view in row.views:
                files += [ImportedFile("", "missing", row.episode_id, view, seed, "no file") for seed in absent]
    return files


def _named(config: ImportRolloutsConfig, names: Sequence[str]) -> Iterator[tuple[str, _IndexRow]]:
    """Files whose name fits the template."""
    fields = {
        "episode": r"(?P<episode>.+?)",
        "view": f"(?P<view>{'|'.join(map(re.escape, sorted(config.names, key=len, reverse=True)))})",
        "seed": r"(?P<seed>\d{1,9})",
    }
    position, pattern = 0, ""
    for part in NAME_FIELD.finditer(config.name):
        pattern += re.escape(config.name[position : part.start()]) + (r"[^/]*" if part[2] else fields[part[1]])
        position = part.end()
    compiled = re.compile(pattern + re.escape(config.name[position:]))
    for name in names:
        if found := compiled.fullmatch(name):
            groups = found.groupdict()
            yield (
                name,
                _IndexRow(
                    path=name,
                    episode=groups["episode"],
                    view=groups.get("view") or "",
                    seed=int(groups.get("seed") or 0),
                ),
            )


def _listed(config: ImportRolloutsConfig, folder: Path) -> Iterator[tuple[str, _IndexRow]]:
    """Files of the index (CSV).

    Raises: DataError when it lists a file twice; ConfigError for a row with unknown or missing fields.
    """
    path = inside(folder, config.index or "")
    rows = csv.DictReader(io.StringIO(read_text(path, encoding="utf-8-sig"), newline=""))
    seen: set[str] = set()
    for number, values in enumerate(rows, start=1):
        row = validate(
            _IndexRow,
            {key: value for key, value in values.items() if value not in ("", None)},
            where=f"{path}, row {number}",
        )
        name = str(relative_name(inside(folder, row.path), folder))
        if name in seen:
            raise DataError("The index lists a file twice", where=f"{path}, row {number}", got=name)
        seen.add(name)
        yield name, row


def _refuse(config: ImportRolloutsConfig, folder: Path, files: Sequence[ImportedFile]) -> None:
    """Raises: DataError for unknown and missing files that are refused, or when none matches."""
    refused = [f for f in files if f.status != "matched" and getattr(config, f.status) == "refuse"]
    counts = Counter(file.status for file in files)
    if refused or not counts["matched"]:
        lines = [f"{f.status}: {f.path or f'{f.episode_id} {f.view} seed {f.seed}'} ({f.detail})" for f in refused]
        raise DataError(
            "The folder's videos are not those of the recordings",
            where=folder,
            expected=f"{config.index or config.name}: {', '.join(config.shown)} of every episode of {config.splits}",
            got=f"{dict(counts)}\n    " + "\n    ".join(_some(lines)),
            next_step="correct name, index, views or episode_prefix; or report what is missing or unknown: "
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
    for file in matched:
        position = episodes.position(file.episode_id)
        row = episodes.rows[position]
        height, width, rate = video_size(folder / file.path)
        count = len(frame_times(folder / file.path))
        kept = count if config.num_frames is None else min(count, config.num_frames)
        lengths[file.path] = kept
        per_prediction[file.episode_id, file.seed].add(kept)
        if abs((config.fps or rate) / row.fps - 1) > _RATE_TOLERANCE:
            problems.append(f"{file.path}: {config.fps or rate:g} frames per second, the recording has {row.fps:g}")
        if not 2 <= kept <= row.video_frames:
            problems.append(f"{file.path}: {kept} frames, the recording has {row.video_frames}")
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
            "cut with num_frames, or bring pictures to size with resize=true",
        )
    return lengths


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
) -> float:
    """Write one file's views; the lowest PSNR [dB] of their first frames against the recorded ones."""
    path, position = folder / file.path, episodes.position(file.episode_id)
    height, width, _ = video_size(path)
    size = _recorded_size(episodes, position)
    views = config.shown if config.tiles else (file.view,)
    clip = VideoClip.whole_file(path, len(frame_times(path)), writer.fps)
    pictures = (picture.rgb for picture in read_clip(clip))
    first = next(pictures)
    if config.tiles is None and (height, width) == size and count == clip.num_frames:
        with atomic_path(writer.root / video_path(file.episode_id, file.seed, file.view)) as temporary:
            shutil.copyfile(path, temporary)
        writer.register(file.episode_id, file.seed, file.view, count, size)
        for _ in pictures:  # every frame can be decoded
            pass
        seen = {file.view: first}
    else:
        seen = _parts(config, first, file.view, size)
        with writer.video(file.episode_id, file.seed, views, size) as add:
            add({view: part[None] for view, part in seen.items()})
            for number, picture in enumerate(pictures, start=1):
                if number < count:
                    add({view: part[None] for view, part in _parts(config, picture, file.view, size).items()})
    recorded = {view: episodes.frames(position, view, [0])[0] for view in seen if view in episodes.rows[position].views}
    return min(_psnr(seen[view], frame) for view, frame in recorded.items())


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


def _psnr(first: np.ndarray, second: np.ndarray) -> float:
    error = float(np.mean((first.astype(np.float64) - second.astype(np.float64)) ** 2))
    return float(10 * np.log10(255.0**2 / max(error, 1e-2)))


def _some(lines: Sequence[str]) -> list[str]:
    more = len(lines) - _MOST_PROBLEMS
    return [*lines[:_MOST_PROBLEMS], *([f"and {more} more"] if more > 0 else [])]
