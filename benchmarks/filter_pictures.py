"""The pictures of docs/filters.md: for each filter a clip that it cuts, made from a shipped recording.

Run: `python benchmarks/filter_pictures.py [--output docs/pictures/filters]`. The faults are injected (tools/labelled_clips.py).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from tools.corrupted.conventions import corrupt
from tools.labelled_clips import FAULTS, Clip
from tools.thumbnails import view_thumbnails
from worldline_core.actions.action_tracks import compute_tracks
from worldline_core.actions.overlays import draw_overlay
from worldline_core.data.episodes.conventions import RecordedConventions
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.filters.filter import inspect
from worldline_core.filters.filter_config import FilterConfig
from worldline_core.filters.signals import measure
from worldline_core.filters.verdict import Finding
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.pictures import ClipStrip, clip_strip, evenly_spaced, jpeg_bytes
from worldline_core.store.atomic import write_bytes_atomic

ROOT = Path(__file__).resolve().parents[1]
MOMENTS = 8
# Recording, seed, and the curve that shows the fault.
CASES: dict[str, tuple[str, int, str]] = {
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


def picture(name: str, clip: Clip, curve: str) -> np.ndarray:
    """The clip's strip with what the filters, at their defaults, find in it."""
    thumbnails = {view: view_thumbnails(images, clip.episode.fps) for view, images in clip.frames.items()}
    findings = inspect(FilterConfig(), measure(clip.episode, thumbnails))
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
    """The frames with the tools drawn where the recording says that they are: there these faults show."""
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=ROOT / "docs" / "pictures" / "filters")
    parser.add_argument("--only", default="", help="names separated by commas")
    arguments = parser.parse_args()
    episodes = EpisodeSet.open(ROOT / "artifacts" / "shipped" / "recordings")

    def recorded(name: str) -> Clip:
        i = episodes.position(name)
        masks = {view: episodes.robot_masks(i, view) for view in episodes.rows[i].views}
        frames = {view: episodes.frames(i, view) for view in episodes.rows[i].views}
        return Clip(episodes.episode(i), frames, {view: np.asarray(m) for view, m in masks.items() if m is not None})

    only = {name for name in arguments.only.split(",") if name}
    makers: dict[str, Callable[[], np.ndarray]] = {
        name: lambda name=name, case=case: picture(
            name, FAULTS[name](recorded(case[0]), np.random.default_rng(case[1])), case[2]
        )
        for name, case in CASES.items()
    }

    def wrong_calibration() -> np.ndarray:
        clip = recorded("ur5e_silver-test-s1-00002")
        episode = corrupt(clip.episode, RecordedConventions(extrinsics="base_to_camera"))
        return picture(
            "calibration", replace(clip, episode=episode, fault="calibration", severity="inverse camera poses"), ""
        )

    makers["calibration"] = wrong_calibration
    for name, make in makers.items():
        if not only or name in only:
            path = arguments.output / f"{name}.jpg"
            write_bytes_atomic(path, jpeg_bytes(make(), quality=84))
            print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
