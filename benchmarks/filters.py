"""How well the filters find what they are for, on labelled clips: precision, recall and F1 of every reason.

Run: `python benchmarks/filters.py [--part report|tuning] [--recordings FOLDER] [--clips 100] [--processes 2] [--output out.json]`.
Each clip is a healthy shipped recording with one fault injected at a random severity (tools/labelled_clips.py), or with
a change that is none; the clean recordings are negatives as well. Spoiled views are compressed again (H.264) as
curation does. `--part tuning` are the recordings of scenes 0 to 11, `--part report` those of scenes 12 to 15, `--recordings`
another set with exact robot masks than the shipped one (of which 120 are taken). Thresholds are chosen on tuning parts.

Of a clip every reason that any detector gives counts, whether it cuts frames, drops the episode or bars it from Stage II.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
from collections import Counter, defaultdict
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from tools.labelled_clips import FAULTS, HARMLESS, Clip
from tools.thumbnails import view_thumbnails
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.video.encoder import encode_video
from worldline_core.data.video.frame_decoder import decode_video
from worldline_core.filters.filter import inspect
from worldline_core.filters.filter_config import FilterConfig
from worldline_core.filters.signals import measure
from worldline_core.filters.verdict import Finding
from worldline_core.store.atomic import write_json_atomic

RECORDINGS = Path(__file__).resolve().parents[1] / "artifacts" / "shipped" / "recordings"
LARGEST = 120
TUNING_SCENES = {f"scene_{number:02d}" for number in range(12)}
REASONS = (
    "static",
    "reset",
    "corrupted",
    "base_motion",
    "time_alignment",
    "too_dark",
    "overexposed",
    "blur",
    "joint_jump",
    "joint_speed",
)
CALIBRATION = ("calibration", "calibration_unexplained", "projection")


@dataclass(frozen=True)
class Judged:
    """What was injected into a clip, and what the filters said.

    Attributes:
        name: of the fault, of the harmless change, or "clean". truth: the reason that is right, "" for none.
        found: reasons given. overlap: frames (both, labelled, found) of the right reason, where frames are cut.
    """

    name: str
    truth: str
    found: frozenset[str]
    overlap: tuple[int, int, int] | None
    where: str


@lru_cache(maxsize=1)
def healthy_clips(root: Path, part: str) -> list[Clip]:
    """The healthy recordings of the part's scenes, at most LARGEST of them, evenly spaced."""
    episodes = EpisodeSet.open(root)
    known = root / "injected_defects.json"
    defects = json.loads(known.read_text()) if known.is_file() else {}
    healthy = [
        (i, row)
        for i, row in enumerate(episodes.rows)
        if row.episode_id not in defects and (row.scene in TUNING_SCENES) == (part == "tuning")
    ]
    clips = []
    for i, row in healthy[:: -(-len(healthy) // LARGEST)]:
        masks = {view: episodes.robot_masks(i, view) for view in row.views}
        frames = {view: episodes.frames(i, view) for view in row.views}
        clips.append(
            Clip(episodes.episode(i), frames, {view: np.asarray(m) for view, m in masks.items() if m is not None})
        )
    return clips


def compressed(clip: Clip, healthy: Clip, crf: int, folder: Path) -> Clip:
    """The clip with every view that differs from the recording's encoded and decoded again."""
    frames = dict(clip.frames)
    for view, images in clip.frames.items():
        if images is not healthy.frames[view]:
            path = folder / f"{view}.mp4"
            encode_video(path, images, clip.episode.fps, crf=crf, preset="veryfast")
            frames[view] = decode_video(path)
    return replace(clip, frames=frames)


def judge(name: str, clip: Clip, config: FilterConfig) -> Judged:
    """What the filters say about a clip."""
    thumbnails = {view: view_thumbnails(images, clip.episode.fps) for view, images in clip.frames.items()}
    findings = inspect(config, measure(clip.episode, thumbnails))
    found = frozenset(f.verdict.reason for f in findings if not f.verdict.clean)
    severity = f"{clip.episode.episode_id}: {clip.severity}"
    return Judged(name, clip.fault, found, frame_overlap(clip, findings), severity)


def frame_overlap(clip: Clip, findings: list[Finding]) -> tuple[int, int, int] | None:
    """Frames found and labelled, labelled, and found, of the clip's own reason."""
    cuts = [
        f.verdict.bad_frames for f in findings if f.verdict.reason == clip.fault and f.verdict.bad_frames is not None
    ]
    if clip.bad is None or not cuts:
        return None
    cut = np.logical_or.reduce(cuts)
    return int((cut & clip.bad).sum()), int(clip.bad.sum()), int(cut.sum())


@dataclass(frozen=True)
class Job:
    """Some clips of one fault or harmless change, or ("clean") all healthy recordings."""

    recordings: Path
    part: str
    name: str
    clips: int
    crf: int
    seed: int


def judged_clips(job: Job) -> list[Judged]:
    """What the filters, at their defaults, say about the clips of a job."""
    recordings, config = healthy_clips(job.recordings, job.part), FilterConfig()
    if job.name == "clean":
        return [judge("clean", clip, config) for clip in recordings]
    changes = {**FAULTS, **HARMLESS}
    number = list(changes).index(job.name)
    found = []
    with tempfile.TemporaryDirectory() as folder:
        for n in range(job.clips):
            healthy = recordings[n % len(recordings)]
            random = np.random.default_rng([job.seed, number, n])
            clip = compressed(changes[job.name](healthy, random), healthy, job.crf, Path(folder))
            found.append(judge(job.name, clip, config))
    return found


def scores(judged: list[Judged]) -> dict[str, dict[str, Any]]:
    """By reason: positives, precision, recall, F1 over all clips, and of frames where frames are cut."""
    table = {}
    for reason in REASONS:
        right = sum(j.truth == reason and reason in j.found for j in judged)
        positives = sum(j.truth == reason for j in judged)
        named = sum(reason in j.found for j in judged)
        if not positives:
            continue
        precision, recall = right / max(named, 1), right / positives
        overlaps = [j.overlap for j in judged if j.truth == reason and j.overlap is not None]
        both, labelled, cut = np.sum(overlaps, axis=0) if overlaps else (0, 0, 0)
        table[reason] = {
            "positives": positives,
            "precision": precision,
            "recall": recall,
            "f1": 2 * precision * recall / max(precision + recall, 1e-9),
            "frame_recall": float(both / labelled) if labelled else None,
            "frame_precision": float(both / cut) if cut else None,
        }
    return table


def print_tables(judged: list[Judged], misses: int) -> None:
    print(f"\n{'reason':16s} {'clips':>6s} {'precision':>9s} {'recall':>7s} {'F1':>6s} | frames: recall precision")
    for reason, row in scores(judged).items():
        frames = [f"{row[key]:.3f}" if row[key] is not None else "-" for key in ("frame_recall", "frame_precision")]
        print(
            f"{reason:16s} {row['positives']:6.0f} {row['precision']:9.3f} {row['recall']:7.3f} {row['f1']:6.3f} |"
            f" {frames[0]:>14s} {frames[1]:>9s}"
        )
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    for item in judged:
        counts[item.name]["clips"] += 1
        for reason in item.found or {"nothing"}:
            counts[item.name][reason] += 1
    columns = ["clips", "nothing", *REASONS, *CALIBRATION]
    print("\nconfusion: of the clips with a fault (rows), how many got a reason (columns)")
    print(" " * 16 + "".join(f"{c[:11]:>12s}" for c in columns))
    for name, row in counts.items():
        print(f"{name:16s}" + "".join(f"{row[c] or '.':>12}" for c in columns))
    wrong = [j for j in judged if (j.truth not in j.found if j.truth else bool(set(REASONS) & j.found))]
    wrong += [j for j in judged if j.truth and (set(REASONS) & j.found) - {j.truth} and j not in wrong]
    for item in wrong[:misses]:
        print(f"  {item.name}: got {', '.join(sorted(item.found)) or 'nothing'}; {item.where}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--part", choices=("report", "tuning"), default="report")
    parser.add_argument("--recordings", type=Path, default=RECORDINGS)
    parser.add_argument("--clips", type=int, default=100, help="of every fault; half as many of harmless changes")
    parser.add_argument("--crf", type=int, default=23, help="of the compression after the injection")
    parser.add_argument("--faults", default="", help="only these, separated by commas")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--misses", type=int, default=20, help="how many mistakes to list")
    parser.add_argument("--output", type=Path)
    arguments = parser.parse_args()
    names = arguments.faults.split(",") if arguments.faults else [*FAULTS, *HARMLESS, "clean"]
    jobs = [
        Job(
            arguments.recordings,
            arguments.part,
            name,
            arguments.clips // (2 if name in HARMLESS else 1),
            arguments.crf,
            arguments.seed,
        )
        for name in names
    ]
    if arguments.processes == 1:
        results = [judged_clips(job) for job in jobs]
    else:
        with ProcessPoolExecutor(arguments.processes, mp_context=get_context("spawn")) as pool:
            results = []
            for job, result in zip(jobs, pool.map(judged_clips, jobs), strict=True):
                given = Counter(reason for item in result for reason in item.found or {"nothing"})
                print(f"{job.name}: {len(result)} clips; {dict(given.most_common())}", flush=True)
                results.append(result)
    judged = [item for result in results for item in result]
    used = os.times()
    print(f"part {arguments.part}, {len(judged)} clips, {sum(used[:4]):.0f} s of processor time")
    print_tables(judged, arguments.misses)
    if arguments.output:
        rows = [{"name": j.name, "truth": j.truth, "found": sorted(j.found), "where": j.where} for j in judged]
        write_json_atomic(arguments.output, {"part": arguments.part, "scores": scores(judged), "clips": rows})


if __name__ == "__main__":
    main()
