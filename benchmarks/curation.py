"""Curation: its speed beside plain decoding, how well it finds near duplicates, and datasets of a million episodes.

    python benchmarks/curation.py speed [--episodes 12] [--seconds 10] [--crf 23] [--old-way] [--processes 2]
    python benchmarks/curation.py duplicates [--scale 100000]
    python benchmarks/curation.py lists [--episodes 1000000]

- `speed`: curation and filtering of 480 x 640 recordings with three views at 30 fps, made from the shipped ones: enlarged,
  slowed down, given texture and sensor noise, and encoded by libx264 as cameras usually do (preset medium, B-frames);
  states and calibration follow, so that every filter runs. The floor is plain decoding of the same files in the same
  process. Processor time; `--processes` adds times by the clock, which need an idle machine.
- `duplicates`: every shipped recording copied in twelve ways. A copy counts as found when the search names its own
  original, with the states and from the images alone. Different episodes must not be found: the recordings among
  themselves, and the candidate banks, whose 32 candidates start from one state. The cost is that of synthetic
  fingerprints, 5 % of them copies, in scenes of 200 that share their background and a tenth of their state cells.
- `lists`: time and memory of listing episodes and of looking one up, each kind of list in a process of its own; memory is
  the largest resident size above that of the process with its modules loaded.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from scipy.spatial.transform import Rotation, Slerp

from benchmarks.harness import RECORDINGS, command_line, print_table, timed
from tools.thumbnails import view_thumbnails
from worldline_core.data.curation.curate import curate
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.curation.near_duplicates import find_near_duplicates
from worldline_core.data.episodes.episode import CameraTrack, Episode
from worldline_core.data.episodes.episode_index import EpisodeRow, read_index, write_index
from worldline_core.data.episodes.episode_set import EpisodeSet, EpisodeSetWriter
from worldline_core.data.episodes.fingerprint import MINHASHES, MOMENTS, Fingerprint, ViewPrint, fingerprint
from worldline_core.data.episodes.view_recording import RecordedView
from worldline_core.data.sources.lerobot import LeRobotSource, LeRobotSourceConfig
from worldline_core.data.video.clip import VideoClip
from worldline_core.data.video.encoder import encode_video
from worldline_core.data.video.frame_decoder import decode_video
from worldline_core.filters.filter import filter_episodes
from worldline_core.filters.filter_config import FilterConfig
from worldline_core.scale.mapping import Outcome, Shard, do_shard
from worldline_core.store.store import ArtifactStore

SIZE, FPS, TURNS = (480, 640), 30.0, 3
Frames = Mapping[str, np.ndarray]
Change = Callable[[Episode, Frames], tuple[Episode, Frames]]


# Speed


def slowed(episode: Episode, count: int) -> tuple[Episode, np.ndarray]:
    """The episode with `count` frames at 30 fps, and the position (n,) of each between its own frames."""
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


def write_clip(path: Path, frames: np.ndarray, at: np.ndarray, crf: int, seed: int) -> None:
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
        stream.options = {"crf": str(crf), "preset": "medium", "threads": "1"}
        for number, place in enumerate(at):
            low = int(place)
            blended = cv2.addWeighted(
                large[low], 1 - (place - low), large[min(low + 1, len(large) - 1)], place - low, 0
            )
            image = np.asarray(cv2.add(blended, noise[number % len(noise)], dtype=cv2.CV_8U), dtype=np.uint8)
            out.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        out.mux(stream.encode(None))


def make_corpus(folder: Path, episodes: int, seconds: float, crf: int) -> None:
    """An EpisodeSet whose videos are such clips, one file each."""
    recordings = EpisodeSet.open(RECORDINGS)
    usable = [i for i, row in enumerate(recordings.rows) if len(row.views) == 3 and row.split != "bank"]
    count = round(seconds * FPS)
    clips = folder.with_name(f"{folder.name}.clips")
    clips.mkdir(parents=True, exist_ok=True)
    with EpisodeSetWriter(folder) as writer:
        for number, source in enumerate(usable[:episodes]):
            episode, at = slowed(recordings.episode(source), count)
            views = {}
            for k, view in enumerate(recordings.rows[source].views):
                path = clips / f"{number}.{view}.mp4"
                write_clip(path, recordings.frames(source, view), at, crf, 10 * number + k)
                clip = VideoClip.whole_file(path, count, FPS)
                views[view] = RecordedView(lambda: iter(()), count, clip)
            writer.add(episode, views)
            for view in views:
                (clips / f"{number}.{view}.mp4").unlink()
    clips.rmdir()


def plain_decode(corpus: Path) -> int:
    """Decodes every video of a set; returns the number of frames."""
    count = 0
    for path in sorted(corpus.rglob("*.mp4")):
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            stream.thread_type = "NONE"
            count += sum(1 for _ in container.decode(stream))
    return count


def both_steps(corpus: Path, output: Path, mode: str = "auto", mapper: Processes | None = None) -> None:
    curate(curation_of(corpus, mode), {}, output / "curated", *([mapper] if mapper else []))
    filter_episodes(
        FilterConfig(), {"episodes": output / "curated"}, output / "filtered", *([mapper] if mapper else [])
    )


def curation_of(corpus: Path, mode: str = "auto") -> CurateConfig:
    return CurateConfig.model_validate({"sources": [{"kind": "episode_set", "path": str(corpus)}], "video_mode": mode})


class Processes:
    """Shard mapper over a plain pool of processes, without Prefect's own cost."""

    episodes_per_shard = 1

    def __init__(self, count: int) -> None:
        self.pool = ProcessPoolExecutor(count, mp_context=get_context("spawn"))

    def run(self, shards: Sequence[Shard[Any]], *, one_at_a_time: bool = False) -> Iterator[Outcome]:
        del one_at_a_time
        for shard, _ in zip(shards, self.pool.map(do_shard, shards), strict=True):
            yield shard, None


def processor_seconds(work: Callable[[], object]) -> float:
    return timed(work)[2]


def measure_speed(corpus: Path, work: Path, *, old_way: bool, processes: int) -> None:
    frames = plain_decode(corpus)  # unmeasured: files come from memory in each of the measurements
    both_steps(corpus, work / "warm")  # imports, kinematics, FFmpeg's tables
    floors, totals = [], []
    for turn in range(TURNS):  # in turns, so that a busy machine weighs on both
        floors.append(processor_seconds(lambda: plain_decode(corpus)))
        totals.append(processor_seconds(lambda turn=turn: both_steps(corpus, work / f"turn{turn}")))
    floor, total = sum(floors) / TURNS, sum(totals) / TURNS
    again = {"episodes": work / "again"}
    seconds = {
        "floor: plain decoding": floor,
        "curate and filter": total,
        "curate": processor_seconds(lambda: curate(curation_of(corpus), {}, work / "again")),
        "filter": processor_seconds(lambda: filter_episodes(FilterConfig(), again, work / "filtered")),
    }
    shutil.rmtree(work / "again" / "run")
    seconds["filter without cached thumbnails"] = processor_seconds(
        lambda: filter_episodes(FilterConfig(), again, work / "uncached")
    )
    if old_way:
        seconds["decode, encode, decode again (video_mode: encode)"] = processor_seconds(
            lambda: both_steps(corpus, work / "old", "encode")
        )
    print_table(("", "ms a frame", "over the floor"), ((w, 1e3 * s / frames, s / floor) for w, s in seconds.items()))
    recorded = frames / 3 / FPS
    size = sum(path.stat().st_size for path in corpus.rglob("*.mp4"))
    print(f"{size / frames / 1e3:.1f} kB a frame, {frames} frames; decoding is {100 * floor / total:.0f} % of the time")
    print(f"{2 * recorded / total:.1f} times real time on two cores; second run {100 * second_run(corpus, work):.1f} %")
    if processes:
        mapper = Processes(processes)
        with mapper.pool:
            both_steps(corpus, work / "mapped", mapper=mapper)
            _, wall, _ = timed(lambda: both_steps(corpus, work / "mapped again", mapper=mapper))
        print(f"{recorded / wall:.1f} times real time by the clock with {processes} processes")


def second_run(corpus: Path, work: Path) -> float:
    """Cost of finding both steps in the store, over that of the run that filled it."""

    def once() -> None:
        store = ArtifactStore(work / "store")
        curated = store.run("curate", 1, curate, curation_of(corpus), {"source.0": corpus})
        store.run("filter", 1, filter_episodes, FilterConfig(), {"episodes": curated.path})

    first = processor_seconds(once)
    return processor_seconds(once) / first


# Near duplicates


def printed(episode: Episode, frames: Frames) -> Fingerprint:
    thumbnails = {view: view_thumbnails(images, episode.fps) for view, images in frames.items()}
    return Fingerprint.from_json(fingerprint(episode, thumbnails))


def encoded(crf: int) -> Change:
    def change(episode: Episode, frames: Frames) -> tuple[Episode, Frames]:
        with tempfile.TemporaryDirectory() as folder:
            path, result = Path(folder) / "copy.mp4", {}
            for view, images in frames.items():
                encode_video(path, images, episode.fps, crf=crf, preset="veryfast", pixel_format="yuv420p")
                result[view] = decode_video(path)
        return episode, result

    return change


def resized(factor: float) -> Change:
    def one(image: np.ndarray) -> np.ndarray:
        size = [2 * round(factor * side / 2) for side in image.shape[1::-1]]
        return cv2.resize(image, size, interpolation=cv2.INTER_AREA)

    return lambda episode, frames: (episode, {v: np.stack([one(i) for i in x]) for v, x in frames.items()})


def brightened(gain: float, offset: float) -> Change:
    def one(images: np.ndarray) -> np.ndarray:
        return np.clip(images.astype(np.float32) * gain + offset, 0, 255).astype(np.uint8)

    return lambda episode, frames: (episode, {view: one(images) for view, images in frames.items()})


def trimmed(start: int, end: int) -> Change:
    def change(episode: Episode, frames: Frames) -> tuple[Episode, Frames]:
        stop = episode.num_frames - end
        return episode.cut(start, stop), {view: images[start:stop] for view, images in frames.items()}

    return change


def noisy(radians: float) -> Change:
    def change(episode: Episode, frames: Frames) -> tuple[Episode, Frames]:
        noise = np.random.default_rng(0).normal(0, radians, episode.state.shape)
        return replace(episode, state=episode.state + noise.astype(np.float32)), frames

    return change


def together(*changes: Change) -> Change:
    def change(episode: Episode, frames: Frames) -> tuple[Episode, Frames]:
        for each in changes:
            episode, frames = each(episode, frames)
        return episode, frames

    return change


CHANGES: dict[str, Change] = {
    "encoded again, crf 23": encoded(23),
    "encoded again, crf 32": encoded(32),
    "resized to 3/4": resized(0.75),
    "brighter (1.08 x + 6)": brightened(1.08, 6),
    "darker (0.9 x - 4)": brightened(0.9, -4),
    "2 of 33 frames cut at each end": trimmed(2, 2),
    "3 of 33 frames cut at each end": trimmed(3, 3),
    "4 of 33 frames cut at the start": trimmed(4, 0),
    "4 of 33 frames cut at the end": trimmed(0, 4),
    "states with noise of 1e-4 rad": noisy(1e-4),
    "states with noise of 1e-3 rad": noisy(1e-3),
    "3/4, crf 28, brighter, 2 + 1 frames cut": together(trimmed(2, 1), resized(0.75), encoded(28), brightened(1.08, 6)),
}


def without_states(seen: Fingerprint) -> Fingerprint:
    return replace(seen, motion=None)


def prints_of(root: Path) -> list[Fingerprint]:
    episodes = EpisodeSet.open(root)
    return [
        printed(episodes.episode(i), {view: episodes.frames(i, view) for view in row.views})
        for i, row in enumerate(episodes.rows)
    ]


def measure_copies(root: Path) -> None:
    episodes = EpisodeSet.open(root)
    originals: list[Fingerprint] = []
    copies: dict[str, list[Fingerprint]] = {name: [] for name in CHANGES}
    for i, row in enumerate(episodes.rows):
        episode, frames = episodes.episode(i), {view: episodes.frames(i, view) for view in row.views}
        originals.append(printed(episode, frames))
        for name, change in CHANGES.items():
            copies[name].append(printed(*change(episode, frames)))

    def share(changed: list[Fingerprint], *, states: bool) -> float:
        seen = [*originals, *changed]
        found = find_near_duplicates(seen if states else [without_states(s) for s in seen])
        return sum(f.position == f.original + len(originals) for f in found) / len(changed)

    shares = {n: (share(c, states=True), share(c, states=False)) for n, c in copies.items()}
    shares["all"] = tuple(np.mean(list(shares.values()), axis=0).tolist())
    columns = (f"copies of {len(originals)} recordings", "found with states, %", "from images alone, %")
    print_table(columns, ((name, 100 * both[0], 100 * both[1]) for name, both in shares.items()))


def measure_different(root: Path) -> tuple[str, int, int, int, int]:
    """Name, episodes, pairs, and how many are taken for duplicates with states and from images alone."""
    seen = prints_of(root)
    found = [len(find_near_duplicates(prints)) for prints in (seen, list(map(without_states, seen)))]
    return root.name, len(seen), len(seen) * (len(seen) - 1) // 2, found[0], found[1]


def flipped(words: np.ndarray, most: int, random: np.random.Generator) -> np.ndarray:
    result = words.copy()
    for place in range(len(result)):
        for bit in random.integers(0, 64, random.integers(0, most + 1)):
            result[place] ^= np.uint64(1) << np.uint64(bit)
    return result


def synthetic(count: int, random: np.random.Generator, *, states: bool) -> tuple[list[Fingerprint], dict[int, int]]:
    views = ("head", "left_wrist", "right_wrist")
    scenes = random.integers(0, 2**63, (max(1, count // 200), len(views)), dtype=np.uint64)
    shared = random.integers(0, 2**32, MINHASHES, dtype=np.uint32)
    prints: list[Fingerprint] = []
    copy_of: dict[int, int] = {}
    for position in range(count):
        original = int(random.integers(0, position + 1))
        if random.random() < 0.05 and original != position and original not in copy_of:
            seen, copy_of[position] = prints[original], original
            other = random.integers(0, 2**32, MINHASHES, dtype=np.uint32)
            motion = None if seen.motion is None else np.where(random.random(MINHASHES) < 0.2, other, seen.motion)
            looks = {
                view: ViewPrint(flipped(v.frames, 4, random), flipped(v.moving, 1, random), v.first)
                for view, v in seen.views.items()
            }
            seconds = seen.seconds + random.uniform(-0.5, 0.5)
            prints.append(Fingerprint(f"copy {position}", seconds, seen.layout, motion, looks))
            continue
        scene = scenes[random.integers(len(scenes))]
        motion = random.integers(0, 2**32, MINHASHES, dtype=np.uint32)
        motion = np.where(random.random(MINHASHES) < 0.1, shared, motion)
        moving = random.integers(0, 2**63, (2, len(views), MOMENTS), dtype=np.uint64)
        looks = {
            view: ViewPrint(
                flipped(np.repeat(scene[k], MOMENTS), 8, random), moving[0, k] & moving[1, k], np.repeat(scene[k], 4)
            )
            for k, view in enumerate(views)
        }
        seconds = float(random.gamma(9, 2))
        prints.append(Fingerprint(f"{position}", seconds, "joints/14", motion if states else None, looks))
    return prints, copy_of


def measure_cost(counts: Sequence[int]) -> Iterator[tuple[int, str, float, str, int]]:
    for states in (True, False):
        for count in counts:
            prints, copy_of = synthetic(count, np.random.default_rng(0), states=states)
            found, _, seconds = timed(lambda prints=prints: find_near_duplicates(prints))
            right = sum(copy_of.get(f.position) == f.original for f in found)
            name = "with states" if states else "images alone"
            yield count, name, seconds, f"{right} of {len(copy_of)}", len(found) - right


# Long lists

INFO = {
    "fps": 30,
    "chunks_size": 1000,
    "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
    "video_path": "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4",
    "features": {"observation.images.top": {"dtype": "video", "shape": [480, 640, 3], "names": None}},
}


def write_list(folder: Path, kind: str, count: int) -> None:
    if kind == "index":
        rows = [
            EpisodeRow(
                episode_id=f"episode-{n:07d}", dataset=f"datasets/robot-{n % 5}", episode_index=n, start=0, stop=900,
                num_frames=900, video_frames=900, fps=30.0, source="source", embodiment="ur5e_pair",
                scene=f"scene-{n % 5000}", task_family="lift", instruction=f"task {n % 3500}", outcome="success",
                split="train", views=("head", "left_wrist", "right_wrist"),
            )
            for n in range(count)
        ]  # fmt: skip
        write_index(folder, rows)
        return
    meta = folder / "meta"
    meta.mkdir(parents=True)
    version = {"lerobot_v21": "v2.1", "lerobot_v3": "v3.0"}[kind]
    (meta / "info.json").write_text(json.dumps({**INFO, "codebase_version": version}))
    if kind == "lerobot_v21":
        with (meta / "episodes.jsonl").open("w") as stream:
            for n in range(count):
                stream.write(json.dumps({"episode_index": n, "tasks": [f"do task {n % 3500}"], "length": 900}) + "\n")
        return
    numbers = pa.array(range(count))
    zeros = pa.array([0] * count)
    columns: dict[str, pa.Array] = {
        "episode_index": numbers,
        "tasks": pa.array([[f"do task {n % 3500}"] for n in range(count)]),
        "length": pa.array([900] * count),
        "data/chunk_index": zeros,
        "data/file_index": numbers,
        "dataset_from_index": pa.array(range(0, 900 * count, 900)),
        "dataset_to_index": pa.array(range(900, 900 * (count + 1), 900)),
    }
    for name in ("chunk_index", "file_index", "from_timestamp", "to_timestamp"):
        columns[f"videos/observation.images.top/{name}"] = zeros
    for name in ("min", "max", "mean", "std"):
        columns[f"stats/observation.state/{name}"] = pa.array([[0.5] * 14] * count)
    (meta / "episodes/chunk-000").mkdir(parents=True)
    pq.write_table(pa.table(columns), meta / "episodes/chunk-000/file-000.parquet")


def peak_megabytes() -> float:
    """Largest resident size of this process; getrusage would include the parent's."""
    line = next(x for x in Path("/proc/self/status").read_text().splitlines() if x.startswith("VmHWM"))
    return int(line.split()[1]) / 1024


def read_list(folder: Path, kind: str, count: int) -> dict[str, float]:
    before, start = peak_megabytes(), time.process_time()
    if kind == "index":
        found = len(read_index(folder))
        listed, start = time.process_time() - start, time.process_time()
        looked_up = 0.0
    else:
        config = LeRobotSourceConfig.model_validate(
            {
                "kind": kind,
                "path": str(folder),
                "embodiment": "ur5e_pair",
                "angle_unit": "rad",
                "views": {"observation.images.top": "head"},
            }
        )
        source = LeRobotSource(config, folder)
        found = len(source.episode_ids())
        listed, start = time.process_time() - start, time.process_time()
        for n in range(0, count, max(1, count // 1000)):
            if source._dataset.row(n)["episode_index"] != n:
                raise SystemExit(f"row {n} is another one")
        looked_up = (time.process_time() - start) / min(count, 1000)
    if found != count:
        raise SystemExit(f"{found} episodes instead of {count}")
    return {"seconds": listed, "lookup_us": 1e6 * looked_up, "megabytes": peak_megabytes() - before}


def measure_lists(count: int) -> Iterator[tuple[str, int, float, float, float]]:
    for kind in ("lerobot_v21", "lerobot_v3", "index"):
        with tempfile.TemporaryDirectory() as folder:
            write_list(Path(folder), kind, count)
            command = [sys.executable, __file__, "lists", "--episodes", str(count), "--read", kind, folder]
            line = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
        yield kind, count, line["seconds"], line["lookup_us"], line["megabytes"]


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("what", choices=("speed", "duplicates", "lists"))
    parser.add_argument("--episodes", type=int, help="default: 12 (speed), a million (lists)")
    parser.add_argument("--seconds", type=float, default=10.0, help="speed: length of an episode")
    parser.add_argument("--crf", type=int, default=23, help="speed: x264's quality; 23 gives 0.7 Mbit/s a view, 16 13")
    parser.add_argument("--old-way", action="store_true", help="speed: also encode everything and decode it again")
    parser.add_argument("--processes", type=int, default=0, help="speed: also mapped over this many processes")
    parser.add_argument("--recordings", type=Path, default=RECORDINGS, help="duplicates: recordings to copy")
    parser.add_argument("--scale", type=int, default=100_000, help="duplicates: most synthetic fingerprints")
    parser.add_argument("--read", nargs=2, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    banks = RECORDINGS.with_name("banks")
    if arguments.what == "speed":
        cv2.setNumThreads(1)
        with tempfile.TemporaryDirectory() as scratch:
            corpus = Path(scratch) / "corpus"
            make_corpus(corpus, arguments.episodes or 12, arguments.seconds, arguments.crf)
            measure_speed(corpus, Path(scratch), old_way=arguments.old_way, processes=arguments.processes)
    elif arguments.read:
        kind, folder = arguments.read
        print(json.dumps(read_list(Path(folder), kind, arguments.episodes)))
    elif arguments.what == "lists":
        rows = measure_lists(arguments.episodes or 1_000_000)
        print_table(("list", "episodes", "listed in s", "us to look one up", "MB"), rows)
    else:
        measure_copies(arguments.recordings)
        columns = ("different episodes", "count", "pairs", "taken for duplicates with states", "from images alone")
        print_table(columns, (measure_different(root) for root in (arguments.recordings, banks)))
        columns = ("synthetic fingerprints", "", "seconds", "copies found", "others")
        print_table(columns, measure_cost((arguments.scale // 10, arguments.scale)))


if __name__ == "__main__":
    main()
