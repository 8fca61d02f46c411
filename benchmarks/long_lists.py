"""Datasets with a million episodes: time and memory of listing them, and of looking one up.

Run: `python benchmarks/long_lists.py [--episodes 1000000]`. Each kind of list is read in a process of its own; memory is the
largest resident size above that of the process with its modules loaded. Seconds are of processor time.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from worldline_core.data.episodes.episode_index import EpisodeRow, read_index, write_index
from worldline_core.data.sources.lerobot import LeRobotSource
from worldline_core.data.sources.lerobot_columns import LeRobotSourceConfig

KINDS = ("lerobot_v21", "lerobot_v3", "index")
_INFO = {
    "fps": 30,
    "chunks_size": 1000,
    "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
    "video_path": "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4",
    "features": {"observation.images.top": {"dtype": "video", "shape": [480, 640, 3], "names": None}},
}


def write(folder: Path, kind: str, count: int) -> None:
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
    (meta / "info.json").write_text(json.dumps({**_INFO, "codebase_version": version}))
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
    """Largest resident size of this process; what getrusage says includes the parent's."""
    line = next(x for x in Path("/proc/self/status").read_text().splitlines() if x.startswith("VmHWM"))
    return int(line.split()[1]) / 1024


def read(folder: Path, kind: str, count: int) -> dict[str, float]:
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=1_000_000)
    parser.add_argument("--read", nargs=2, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.read:
        kind, folder = arguments.read
        print(json.dumps(read(Path(folder), kind, arguments.episodes)))
        return
    print("| list | episodes | listed in s | us to look one up | MB |\n|---|---:|---:|---:|---:|")
    for kind in KINDS:
        with tempfile.TemporaryDirectory() as folder:
            write(Path(folder), kind, arguments.episodes)
            command = [sys.executable, __file__, "--episodes", str(arguments.episodes), "--read", kind, folder]
            line = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
            print(
                f"| {kind} | {arguments.episodes:,} | {line['seconds']:.1f} | {line['lookup_us']:.0f} | "
                f"{line['megabytes']:.0f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
