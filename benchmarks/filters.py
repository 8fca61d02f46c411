"""Detection of injected faults by the filters: precision, recall and F1 of every reason.

    python benchmarks/filters.py [--part report|tuning] [--recordings FOLDER] [--clips 100] [--processes 2]

Each clip is a healthy recording with one fault injected at a random severity (tools/labelled_clips.py), or with a harmless
change; the clean recordings are negatives as well. Spoiled views are compressed again (H.264) as curation does. `--part
tuning` takes the recordings of scenes 0 to 11, on which thresholds are chosen, `--part report` those of scenes 12 to 15;
`--recordings` takes another set with exact robot masks (120 of it). Every reason that any detector gives to a clip
counts, whether it cuts frames, drops the episode or bars it from Stage II.
"""

from __future__ import annotations

import json
import tempfile
from collections import Counter, defaultdict
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from benchmarks.harness import RECORDINGS, command_line, cpu_seconds, print_table
from tools.labelled_clips import FAULTS, HARMLESS, Clip, view_thumbnails
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.video.clip import decode_video
from worldline_core.data.video.encoder import encode_video
from worldline_core.filters.filter import inspect
from worldline_core.filters.filter_config import FilterConfig
from worldline_core.filters.signals import measure
from worldline_core.filters.verdict import Finding

LARGEST, CRF, MOST_MISTAKES = 120, 23, 20
TUNING_SCENES = {f"scene_{number:02d}" for number in range(12)}
REASONS = (
    "static", "reset", "corrupted", "base_motion", "time_alignment", "too_dark", "overexposed", "blur", "joint_jump",
    "joint_speed",
)  # fmt: skip
CALIBRATION = ("calibration", "calibration_unexplained", "projection")


@dataclass(frozen=True)
class Judged:
    """Injected fault and verdict of the filters for one clip.

    Attributes:
        name: the fault, the harmless change, or "clean". truth: the right reason, "" for none.
        found: reasons given. overlap: frames (both, labelled, found) of the right reason, where frames are cut.
    """

    name: str
    truth: str
    found: frozenset[str]
    overlap: tuple[int, int, int] | None
    where: str


def recorded(episodes: EpisodeSet, i: int) -> Clip:
    views = episodes.rows[i].views
    masks = {view: episodes.robot_masks(i, view) for view in views}
    frames = {view: episodes.frames(i, view) for view in views}
    return Clip(episodes.episode(i), frames, {view: np.asarray(m) for view, m in masks.items() if m is not None})


@lru_cache(maxsize=1)
def healthy_clips(root: Path, part: str) -> list[Clip]:
    """Healthy recordings of the part's scenes, at most LARGEST of them, evenly spaced."""
    episodes = EpisodeSet.open(root)
    known = root / "injected_defects.json"
    defects = json.loads(known.read_text()) if known.is_file() else {}
    healthy = [
        i
        for i, row in enumerate(episodes.rows)
        if row.episode_id not in defects and (row.scene in TUNING_SCENES) == (part == "tuning")
    ]
    return [recorded(episodes, i) for i in healthy[:: -(-len(healthy) // LARGEST)]]


def compressed(clip: Clip, healthy: Clip, folder: Path) -> Clip:
    """The clip with every view that differs from the recording's encoded and decoded again."""
    frames = dict(clip.frames)
    for view, images in clip.frames.items():
        if images is not healthy.frames[view]:
            path = folder / f"{view}.mp4"
            encode_video(path, images, clip.episode.fps, crf=CRF, preset="veryfast")
            frames[view] = decode_video(path)
    return replace(clip, frames=frames)


def findings_of(clip: Clip) -> list[Finding]:
    """Findings of the filters with their defaults."""
    thumbnails = {view: view_thumbnails(images, clip.episode.fps) for view, images in clip.frames.items()}
    return inspect(FilterConfig(), measure(clip.episode, thumbnails))


def judge(name: str, clip: Clip) -> Judged:
    findings = findings_of(clip)
    found = frozenset(f.verdict.reason for f in findings if not f.verdict.clean)
    where = f"{clip.episode.episode_id}: {clip.severity}"
    return Judged(name, clip.fault, found, frame_overlap(clip, findings), where)


def frame_overlap(clip: Clip, findings: list[Finding]) -> tuple[int, int, int] | None:
    """Frames found and labelled, labelled, and found, of the clip's own reason."""
    cuts = [
        f.verdict.bad_frames for f in findings if f.verdict.reason == clip.fault and f.verdict.bad_frames is not None
    ]
    if clip.bad is None or not cuts:
        return None
    cut = np.logical_or.reduce(cuts)
    return int((cut & clip.bad).sum()), int(clip.bad.sum()), int(cut.sum())


def judged_clips(recordings: Path, part: str, name: str, clips: int, seed: int) -> list[Judged]:
    """Verdicts on clips of one fault or harmless change, or ("clean") on all healthy recordings."""
    healthy = healthy_clips(recordings, part)
    if name == "clean":
        return [judge("clean", clip) for clip in healthy]
    changes = {**FAULTS, **HARMLESS}
    found = []
    with tempfile.TemporaryDirectory() as folder:
        for n in range(clips // (2 if name in HARMLESS else 1)):
            original = healthy[n % len(healthy)]
            random = np.random.default_rng([seed, list(changes).index(name), n])
            found.append(judge(name, compressed(changes[name](original, random), original, Path(folder))))
    return found


def scores(judged: list[Judged]) -> Iterator[tuple[str | int | float, ...]]:
    """Rows by reason: positives, precision, recall, F1 over all clips, and of frames where frames are cut."""
    for reason in REASONS:
        right = sum(j.truth == reason and reason in j.found for j in judged)
        positives = sum(j.truth == reason for j in judged)
        if not positives:
            continue
        precision, recall = right / max(sum(reason in j.found for j in judged), 1), right / positives
        overlaps = [j.overlap for j in judged if j.truth == reason and j.overlap is not None]
        both, labelled, cut = np.sum(overlaps, axis=0) if overlaps else (0, 0, 0)
        of_frames = (f"{both / labelled:.3f}", f"{both / cut:.3f}") if labelled else ("", "")
        yield reason, positives, precision, recall, 2 * precision * recall / max(precision + recall, 1e-9), *of_frames


def print_tables(judged: list[Judged]) -> None:
    print_table(("reason", "clips", "precision", "recall", "F1", "frames: recall", "precision"), scores(judged))
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    for item in judged:
        counts[item.name]["clips"] += 1
        counts[item.name].update(item.found or {"nothing"})
    columns = ["clips", "nothing", *REASONS, *CALIBRATION]
    print_table(("fault", *columns), ((name, *(row[c] or "" for c in columns)) for name, row in counts.items()))

    def mistaken(j: Judged) -> bool:
        given = set(REASONS) & j.found
        return given != {j.truth} if j.truth else bool(given)

    for item in [j for j in judged if mistaken(j)][:MOST_MISTAKES]:
        print(f"  {item.name}: got {', '.join(sorted(item.found)) or 'nothing'}; {item.where}")


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--part", choices=("report", "tuning"), default="report")
    parser.add_argument("--recordings", type=Path, default=RECORDINGS)
    parser.add_argument("--clips", type=int, default=100, help="of every fault; half as many of harmless changes")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--processes", type=int, default=1)
    arguments = parser.parse_args()
    with ProcessPoolExecutor(arguments.processes, mp_context=get_context("spawn")) as pool:
        jobs = [
            pool.submit(judged_clips, arguments.recordings, arguments.part, name, arguments.clips, arguments.seed)
            for name in (*FAULTS, *HARMLESS, "clean")
        ]
        judged = [item for job in jobs for item in job.result()]
    print(f"part {arguments.part}, {len(judged)} clips, {cpu_seconds():.0f} s of processor time")
    print_tables(judged)


if __name__ == "__main__":
    main()
