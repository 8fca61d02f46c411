"""Curation and filtering of 480x640 recordings with three views at 30 fps: times real time, and where the time goes.

Run: `python benchmarks/curation.py [--episodes 12] [--seconds 10] [--crf 23] [--scaling 10,100] [--old-way] [--processes 2] [--output out.json]`.
The corpus is made from the shipped recordings: enlarged, slowed down to the wanted length, given texture and sensor
noise, and encoded by libx264 as cameras' recordings usually are (preset medium, B-frames); states and calibration
follow, so every filter runs. Figures are processor time (the machine may be shared), the floor is FFmpeg's plain decoding
of the same files in the same process, and the share of decoding is measured inside of the run by the profiler. Several
processes are timed by the clock as well, which means something on an idle machine only.
"""

from __future__ import annotations

import argparse
import cProfile
import json
import os
import pstats
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from worldline_core.data.curation.curate import curate
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.episodes.episode import CameraTrack, Episode
from worldline_core.data.episodes.episode_set import EpisodeSet, EpisodeSetWriter
from worldline_core.data.episodes.view_recording import RecordedView
from worldline_core.data.video.clip import VideoClip
from worldline_core.filters.filter import filter_episodes
from worldline_core.filters.filter_config import FilterConfig
from worldline_core.scale.mapping import Shard, TakeOutcome, do_shard
from worldline_core.store.atomic import write_json_atomic
from worldline_core.store.store import ArtifactStore

PROJECT = Path(__file__).resolve().parents[1]
RECORDINGS = PROJECT / "artifacts" / "shipped" / "recordings"
SIZE, FPS = (480, 640), 30.0
_TURNS = 3


def slowed(episode: Episode, count: int) -> tuple[Episode, np.ndarray]:
    """The episode with `count` frames at 30 fps, and where (n,) these lie between its own frames."""
    at = np.linspace(0, episode.num_frames - 1, count)

    def between(values: np.ndarray) -> np.ndarray:
        low = np.floor(at).astype(int)
        share = (at - low).reshape(-1, *[1] * (values.ndim - 1))
        return (values[low] * (1 - share) + values[np.minimum(low + 1, len(values) - 1)] * share).astype(values.dtype)

    def poses(track: np.ndarray) -> np.ndarray:
        result = np.tile(np.eye(4), (count, 1, 1))
        result[:, :3, 3] = between(track[:, :3, 3])
        result[:, :3, :3] = Slerp(np.arange(len(track)), Rotation.from_matrix(track[:, :3, :3]))(at).as_matrix()
        return result

    cameras = {}
    for view, camera in episode.cameras.items():
        track = camera.resized(SIZE[1], SIZE[0])
        moved = poses(track.T_base_camera) if track.moving else track.T_base_camera
        cameras[view] = CameraTrack(view, track.K, moved, SIZE[1], SIZE[0])
    return replace(
        episode,
        fps=FPS,
        state=between(episode.state),
        action=between(episode.action),
        timestamps=np.arange(count) / FPS,
        cameras=cameras,
        T_base_ee=None,
        gripper=None,
        video_frames=None,
    ), at


def write_clip(path: Path, frames: np.ndarray, at: np.ndarray, crf: int, preset: str, seed: int) -> None:
    """The frames at the places `at`, enlarged, with texture and sensor noise, as an ordinary H.264 mp4."""
    generator = np.random.default_rng(seed)
    texture = cv2.GaussianBlur(generator.normal(0, 30, (*SIZE, 1)).astype(np.float32), (0, 0), 1.5)[..., None]
    noise = [
        np.rint(texture + generator.normal(0, 4.5, (*SIZE, 1))).astype(np.int16).repeat(3, axis=2) for _ in range(16)
    ]
    large = [cv2.resize(frame, SIZE[::-1], interpolation=cv2.INTER_CUBIC) for frame in frames]
    with av.open(str(path), "w", format="mp4") as out:
        stream = out.add_stream("libx264", rate=int(FPS))
        stream.height, stream.width, stream.pix_fmt = *SIZE, "yuv420p"
        stream.options = {"crf": str(crf), "preset": preset, "threads": "1"}
        for number, place in enumerate(at):
            low = int(place)
            blended = cv2.addWeighted(
                large[low], 1 - (place - low), large[min(low + 1, len(large) - 1)], place - low, 0
            )
            image = np.asarray(cv2.add(blended, noise[number % len(noise)], dtype=cv2.CV_8U), dtype=np.uint8)
            out.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        out.mux(stream.encode(None))


def make_corpus(folder: Path, episodes: int, seconds: float, crf: int, preset: str) -> None:
    """An EpisodeSet whose videos are such clips, one file each."""
    recordings = EpisodeSet.open(RECORDINGS)
    usable = [i for i, row in enumerate(recordings.rows) if len(row.views) == 3 and row.split != "bank"]
    count = round(seconds * FPS)
    clips = folder.with_name(f"{folder.name}.clips")
    clips.mkdir(parents=True, exist_ok=True)
    with EpisodeSetWriter(folder) as writer:
        for number in range(episodes):
            source = usable[number % len(usable)]
            if number >= len(usable):
                raise SystemExit(f"at most {len(usable)} different episodes can be made")
            episode, at = slowed(recordings.episode(source), count)
            if writer.has(episode.episode_id):
                continue
            views = {}
            for k, view in enumerate(recordings.rows[source].views):
                path = clips / f"{number}.{view}.mp4"
                write_clip(path, recordings.frames(source, view), at, crf, preset, 10 * number + k)
                clip = VideoClip.whole_file(path, count, FPS)
                views[view] = RecordedView(lambda: iter(()), count, clip)
            writer.add(episode, views)
            for view in views:
                (clips / f"{number}.{view}.mp4").unlink()
    clips.rmdir()


def cpu() -> float:
    """Processor time of this process and of its children that ended."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def timed(work: Callable[[], Any]) -> tuple[float, Any]:
    start = cpu()
    result = work()
    return cpu() - start, result


def plain_decode(corpus: Path) -> int:
    """Decode every video of a set and look at none of it; returns the frames."""
    count = 0
    for path in sorted(corpus.rglob("*.mp4")):
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            stream.thread_type = "NONE"
            count += sum(1 for _ in container.decode(stream))
    return count


def configs(corpus: Path, mode: str) -> tuple[CurateConfig, FilterConfig]:
    curation = {"sources": [{"kind": "episode_set", "path": str(corpus)}], "video_mode": mode}
    return CurateConfig.model_validate(curation), FilterConfig()


def both_steps(corpus: Path, output: Path, mode: str = "auto") -> dict[str, Any]:
    """Curate and filter; returns their counts."""
    curation, filtering = configs(corpus, mode)
    found = curate(curation, {}, output / "curated")
    kept = filter_episodes(filtering, {"episodes": output / "curated"}, output / "filtered")
    return {"curate": found, "filter": kept}


def decoding_share(corpus: Path, output: Path) -> tuple[float, list[tuple[str, float]]]:
    """Share of processor time inside of FFmpeg's decoder during both steps, and the functions that cost most."""
    profiler = cProfile.Profile(time.process_time)
    profiler.enable()
    both_steps(corpus, output)
    profiler.disable()
    table: dict[Any, Any] = pstats.Stats(profiler).stats  # pyright: ignore[reportAttributeAccessIssue]
    own = {f"{Path(file).name}:{line} {name}": row[2] for (file, line, name), row in table.items()}
    total = sum(own.values())
    decoding = sum(value for name, value in own.items() if "decode" in name and "av." in name)
    costly = sorted(own.items(), key=lambda item: -item[1])[:25]
    return decoding / total, [(name, value / total) for name, value in costly]


def measure(corpus: Path, work: Path, *, old_way: bool) -> dict[str, Any]:
    """Everything about one corpus, in this process."""
    plain_decode(corpus)  # once unmeasured: files come from memory in each of the measurements
    both_steps(corpus, work / "warm")  # imports, kinematics, FFmpeg's tables
    floor = total = 0.0
    counts: dict[str, Any] = {}
    frames = 0
    for turn in range(_TURNS):  # in turns: what else the machine does then weighs on both
        took, frames = timed(lambda: plain_decode(corpus))
        floor += took / _TURNS
        took, counts = timed(lambda turn=turn: both_steps(corpus, work / f"turn{turn}"))
        total += took / _TURNS
    curation, filtering = configs(corpus, "auto")
    cost, _ = timed(lambda: curate(curation, {}, work / "again"))
    filter_cost, _ = timed(lambda: filter_episodes(filtering, {"episodes": work / "again"}, work / "again.filtered"))
    shutil.rmtree(work / "again" / "run")
    uncached, _ = timed(lambda: filter_episodes(filtering, {"episodes": work / "again"}, work / "uncached"))
    share, costly = decoding_share(corpus, work / "profiled")
    second = second_run(corpus, work / "store")
    seconds = frames / 3 / FPS
    result = {
        "frames": frames,
        "recorded_seconds": seconds,
        "ms_a_frame": {
            "floor: plain decoding": 1e3 * floor / frames,
            "curate and filter": 1e3 * total / frames,
            "curate": 1e3 * cost / frames,
            "filter": 1e3 * filter_cost / frames,
            "filter without cached thumbnails": 1e3 * uncached / frames,
        },
        "times_real_time_one_core": seconds / total,
        "times_real_time_two_cores": 2 * seconds / total,
        "decoding_share_by_floor": floor / total,
        "decoding_share_in_profile": share,
        "second_run_share": second,
        "counts": counts,
        "costly": costly,
    }
    if old_way:
        old, _ = timed(lambda: both_steps(corpus, work / "old", "encode"))
        result["ms_a_frame"]["decode, encode, decode again (video_mode: encode)"] = 1e3 * old / frames
        result["times_real_time_two_cores_encoding"] = 2 * seconds / old
    return result


def second_run(corpus: Path, root: Path) -> float:
    """Cost of finding both steps in the store, in shares of the run that filled it."""
    curation, filtering = configs(corpus, "auto")

    def once() -> None:
        store = ArtifactStore(root)
        curated = store.run("curate", 1, curate, curation, {"source.0": corpus})
        store.run("filter", 1, filter_episodes, filtering, {"episodes": curated.path})

    first, _ = timed(once)
    second, _ = timed(once)
    return second / first


class Processes:
    """Does shards in a plain pool of processes (`worldline_core.scale.mapping.ShardMapper`), without Prefect's own cost."""

    episodes_per_shard = 1

    def __init__(self, count: int) -> None:
        self.pool = ProcessPoolExecutor(count, mp_context=get_context("spawn"))

    def map(self, shards: Sequence[Shard[Any]], take: TakeOutcome, *, one_at_a_time: bool = False) -> None:
        del one_at_a_time
        for shard, _ in zip(shards, self.pool.map(do_shard, shards), strict=True):
            take(shard, None)


def in_processes(corpus: Path, work: Path, count: int) -> dict[str, float]:
    """Both steps mapped over processes that are up and warm: seconds by the clock, and times real time by it."""
    curation, filtering = configs(corpus, "auto")
    mapper = Processes(count)
    with mapper.pool:
        for name in ("warm", "timed"):
            start = time.perf_counter()
            curate(curation, {}, work / name / "curated", mapper)
            filter_episodes(filtering, {"episodes": work / name / "curated"}, work / name / "filtered", mapper)
            wall = time.perf_counter() - start
    seconds = sum(row.video_frames for row in EpisodeSet.open(corpus).rows) / FPS
    return {"processes": count, "wall_s": wall, "times_real_time_by_the_clock": seconds / wall}


def cost(corpus: Path, work: Path) -> list[float]:
    """Processor time [s] of both steps in this process, and its largest memory so far [MB]."""
    seconds, _ = timed(lambda: both_steps(corpus, work))
    return [seconds, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024]


def own_process(corpus: Path) -> dict[str, float]:
    """The cost in a fresh process."""
    code = (
        "import sys, json; from pathlib import Path; sys.path.insert(0, sys.argv[1]); import curation;"
        "print(json.dumps(curation.cost(Path(sys.argv[2]), Path(sys.argv[3]))))"
    )
    with tempfile.TemporaryDirectory() as work:
        arguments = [sys.executable, "-c", code, str(Path(__file__).parent), str(corpus), work]
        printed = subprocess.run(arguments, check=True, stdout=subprocess.PIPE, text=True).stdout
    seconds, megabytes = json.loads(printed.splitlines()[-1])
    return {"cpu_s": seconds, "peak_mb": megabytes}


def scaling(folder: Path, sizes: list[int], seconds: float) -> dict[str, Any]:
    """Time and memory over the number of episodes, each in a process of its own."""
    rows = {}
    for size in sizes:
        corpus = folder / f"scaling-{size}-{seconds}"
        if not corpus.is_dir():
            make_corpus(corpus, size, seconds, 23, "veryfast")
        rows[str(size)] = own_process(corpus)
    few, many = rows[str(sizes[0])], rows[str(sizes[-1])]
    return {
        "episodes": rows,
        "episodes_ratio": sizes[-1] / sizes[0],
        "time_ratio": many["cpu_s"] / few["cpu_s"],
        "memory_ratio": many["peak_mb"] / few["peak_mb"],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--episodes", type=int, default=12, help="0: leave this part out")
    parser.add_argument("--seconds", type=float, default=10.0, help="length of an episode")
    parser.add_argument(
        "--crf", type=int, default=23, help="x264's quality: 23 gives 0.7 Mbit/s a view, 22 1.3, 21 2.6, 16 13"
    )
    parser.add_argument("--corpus", type=Path, help="where corpora are kept for the next time")
    parser.add_argument("--scaling", default="", help="numbers of episodes, for example 10,100")
    parser.add_argument("--scaling-seconds", type=float, default=4.0, help="length of these episodes")
    parser.add_argument("--old-way", action="store_true", help="also encode everything and decode it again")
    parser.add_argument("--processes", type=int, default=0, help="also mapped over so many processes")
    parser.add_argument("--output", type=Path)
    given = parser.parse_args()
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as scratch:
        folder = given.corpus or Path(scratch) / "corpora"
        folder.mkdir(parents=True, exist_ok=True)
        corpus = folder / f"corpus-{given.episodes}-{given.seconds}-crf{given.crf}"
        result: dict[str, Any] = {}
        if given.episodes and not corpus.is_dir():
            make_corpus(corpus, given.episodes, given.seconds, given.crf, "medium")
        if given.episodes:
            result = measure(corpus, Path(scratch) / "work", old_way=given.old_way)
            result["video_bytes_a_frame"] = sum(p.stat().st_size for p in corpus.rglob("*.mp4")) / result["frames"]
            print(json.dumps(result, indent=1), flush=True)
        if given.processes and given.episodes:
            result["processes"] = in_processes(corpus, Path(scratch) / "processes", given.processes)
        if given.scaling:
            result["scaling"] = scaling(folder, [int(n) for n in given.scaling.split(",")], given.scaling_seconds)
    print(json.dumps({name: result[name] for name in ("processes", "scaling") if name in result}, indent=1))
    if given.output is not None:
        write_json_atomic(given.output, result)


if __name__ == "__main__":
    main()
