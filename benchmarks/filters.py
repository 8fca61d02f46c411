"""How well the filters find injected faults: precision, recall and F1 of every reason, or the pictures of docs/filters.md.

    python benchmarks/filters.py [--part report|tuning] [--recordings FOLDER] [--clips 100] [--processes 2]
    python benchmarks/filters.py --pictures docs/pictures/filters [--faults blur,static]

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
from tools.corrupted.conventions import corrupt
from tools.labelled_clips import FAULTS, HARMLESS, Clip
from tools.thumbnails import view_thumbnails
from worldline_core.actions.action_tracks import compute_tracks
from worldline_core.actions.overlays import draw_overlay
from worldline_core.data.episodes.conventions import RecordedConventions
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.video.clip import decode_video
from worldline_core.data.video.encoder import encode_video
from worldline_core.filters.filter import inspect
from worldline_core.filters.filter_config import FilterConfig
from worldline_core.filters.signals import measure
from worldline_core.filters.verdict import Finding
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.pictures import ClipStrip, clip_strip, evenly_spaced, jpeg_bytes
from worldline_core.store.atomic import write_bytes_atomic

LARGEST, CRF, MOMENTS = 120, 23, 8
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

PICTURES: dict[str, tuple[str, int, str]] = {
    "static": ("ur5e_silver-test-s1-00002", 3, "coarse_image_change"),
    "reset": ("xarm7_white-test-s1-00001", 6, "distance_from_home_rad"),
    "frozen": ("ur5e_silver-test-s1-00003", 1, "image_change"),
    "broken_pictures": ("ur5e_silver-test-s1-00004", 1, "relative_detail"),
    "too_dark": ("xarm7_white-test-s1-00003", 4, "bright_level"),
    "overexposed": ("viperx_graphite-test-s1-00001", 2, "white_share"),
    "blur": ("ur5e_slate-test-s1-00000", 8, "relative_sharpness"),
    "base_motion": ("ur5e_silver-test-s1-00002", 0, "changed_area"),
    "joint_jump": ("xarm7_white-test-s1-00004", 2, "largest_step_rad"),
    "joint_speed": ("ur5e_slate-test-s1-00001", 3, "joint_speed_rad_s"),
    "late_states": ("ur5e_silver-test-s1-00002", 1, ""),
}
"""Recording, seed, and the curve that shows the fault."""


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


def print_tables(judged: list[Judged], misses: int) -> None:
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

    for item in [j for j in judged if mistaken(j)][:misses]:
        print(f"  {item.name}: got {', '.join(sorted(item.found)) or 'nothing'}; {item.where}")


def picture(name: str, clip: Clip, curve: str) -> np.ndarray:
    """Strip of the clip with the finding of the filters."""
    findings = findings_of(clip)
    frames = clip.frames[clip.episode.primary_view]
    if clip.fault in ("time_alignment", "calibration"):
        frames = with_tools(clip, frames)
    found = [f for f in findings if f.verdict.reason == clip.fault and not f.verdict.clean]
    if not found:
        raise SystemExit(f"{name}: the filters do not find {clip.fault} ({clip.severity}); choose another seed")
    best = found[0]
    cut = best.verdict.bad_frames
    count = len(frames)
    moments = moments_of(cut, count)
    shown = best.verdict.curves.get(curve)
    return clip_strip(
        ClipStrip(
            title(clip, best),
            numbers(best),
            frames[moments],
            moments,
            count,
            {clip.fault: np.ones(count, bool) if cut is None else cut},
            None if shown is None else (curve, shown.values[:count], shown.threshold),
        )
    )


def with_tools(clip: Clip, frames: np.ndarray) -> np.ndarray:
    """Frames with the tools drawn at their recorded places, where these faults show."""
    tracks, _ = compute_tracks(clip.episode, ArmKinematics(load_embodiment(clip.episode.embodiment)))
    view = clip.episode.primary_view
    drawn = [draw_overlay(frame, tracks, i, view, tile_height=128) for i, frame in enumerate(frames)]
    return np.stack(drawn)


def moments_of(cut: np.ndarray | None, count: int) -> list[int]:
    """Evenly spaced, half of them among the dropped frames where those are few."""
    if cut is None or cut.mean() > 0.3:
        return evenly_spaced(count, MOMENTS)
    inside, outside = np.flatnonzero(cut), np.flatnonzero(~cut)
    chosen = [inside[i] for i in evenly_spaced(len(inside), MOMENTS // 2)]
    chosen += [outside[i] for i in evenly_spaced(len(outside), MOMENTS - len(chosen))]
    return sorted(int(i) for i in chosen)


def title(clip: Clip, finding: Finding) -> str:
    verdict = finding.verdict
    what = "the whole episode is barred from Stage II" if verdict.bad_frames is None else "frames cut"
    if verdict.bad_frames is not None and not verdict.passed:
        what = "too many frames: the whole episode goes"
    return f"{verdict.reason}: {what}  ·  injected: {clip.severity}"


def numbers(finding: Finding) -> str:
    values = finding.verdict.numbers.items()
    return "   ".join(f"{k} {v:.3g}" if isinstance(v, float) else f"{k} {v}" for k, v in values if v is not None)


def write_pictures(output: Path, names: set[str]) -> None:
    episodes = EpisodeSet.open(RECORDINGS)
    for name in names:
        if name == "calibration":
            clip = recorded(episodes, episodes.position("ur5e_silver-test-s1-00002"))
            wrong = corrupt(clip.episode, RecordedConventions(extrinsics="base_to_camera"))
            clip = replace(clip, episode=wrong, fault="calibration", severity="inverse camera poses")
            drawn = picture(name, clip, "")
        else:
            recording, seed, curve = PICTURES[name]
            healthy = recorded(episodes, episodes.position(recording))
            drawn = picture(name, FAULTS[name](healthy, np.random.default_rng(seed)), curve)
        write_bytes_atomic(output / f"{name}.jpg", jpeg_bytes(drawn, quality=84))


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--part", choices=("report", "tuning"), default="report")
    parser.add_argument("--recordings", type=Path, default=RECORDINGS)
    parser.add_argument("--clips", type=int, default=100, help="of every fault; half as many of harmless changes")
    parser.add_argument("--faults", default="", help="only these, separated by commas")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--misses", type=int, default=20, help="how many mistakes to list")
    parser.add_argument("--pictures", type=Path, help="draw one clip of each fault into this folder instead")
    arguments = parser.parse_args()
    names = [name for name in arguments.faults.split(",") if name]
    if arguments.pictures is not None:
        write_pictures(arguments.pictures, set(names or (*PICTURES, "calibration")))
        return
    with ProcessPoolExecutor(arguments.processes, mp_context=get_context("spawn")) as pool:
        jobs = [
            pool.submit(judged_clips, arguments.recordings, arguments.part, name, arguments.clips, arguments.seed)
            for name in names or (*FAULTS, *HARMLESS, "clean")
        ]
        judged = [item for job in jobs for item in job.result()]
    print(f"part {arguments.part}, {len(judged)} clips, {cpu_seconds():.0f} s of processor time")
    print_tables(judged, arguments.misses)


if __name__ == "__main__":
    main()
