"""LeRobot's own dataset classes beside the reader and writer of this project, job by job.

Run: `python benchmarks/lerobot_classes.py [--episodes 20]` (needs the dev group). Each job runs in a process of its own;
seconds are of processor time, helpers included; memory is the largest resident size of the process. The results, and what
was decided from them, are in docs/episode_set.md.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

FPS, FRAMES, SIZE = 10, 40, (120, 160)
VIEWS = ("head", "left_wrist", "right_wrist")
KILLED_AFTER = 12
Result = dict[str, Any]


def episode_arrays(number: int) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """State (N, 14) float32 and images by view, uint8 (N, H, W, 3); the number decides everything."""
    random = np.random.default_rng(number)
    state = random.uniform(0, 1, (1, 14)) * np.linspace(0, 1, FRAMES)[:, None]
    images = {}
    for view in VIEWS:
        patches = random.integers(0, 255, (6, 8, 3), dtype=np.uint8)
        still = patches.repeat(SIZE[0] // 6, axis=0).repeat(SIZE[1] // 8, axis=1)
        images[view] = np.stack([np.roll(still, 2 * frame, axis=1) for frame in range(FRAMES)])
    return state.astype(np.float32), images


# Ours ----------------------------------------------------------------------------------------------------------------


def import_ours(folder: Path, episodes: int) -> Result:
    import worldline_core.data.lerobot.dataset
    import worldline_core.data.lerobot.v3_writer  # noqa: F401

    return {}


def write_ours(folder: Path, episodes: int, kill: bool = False) -> Result:
    from worldline_core.data.episodes.episode import Episode
    from worldline_core.data.episodes.episode_set_writer import EpisodeSetWriter

    writer = EpisodeSetWriter(folder / "set", fps=FPS)
    for number in range(episodes):
        if kill and number == KILLED_AFTER:
            os.kill(os.getpid(), signal.SIGKILL)
        if not writer.has(f"e{number:04d}"):
            state, images = episode_arrays(number)
            writer.add(
                Episode(
                    episode_id=f"e{number:04d}",
                    source="benchmark",
                    embodiment="robot",
                    scene="scene",
                    task_family="unknown",
                    instruction="lift the block",
                    outcome="success",
                    split="train",
                    fps=FPS,
                    state=state,
                    action=state,
                    timestamps=np.arange(FRAMES) / FPS,
                ),
                images,
            )
    writer.close()
    shutil.copytree(folder / "set" / "datasets" / "robot", folder / "dataset")
    return {}


def read_ours(folder: Path, episodes: int) -> Result:
    from worldline_core.data.lerobot.dataset import LeRobotV3Dataset

    before = _seconds()
    dataset = LeRobotV3Dataset(folder / "dataset")
    rows = sum(
        len(dataset.column(int(index), name))
        for index in dataset.episodes.indices
        for name in ("observation.state", "action", "timestamp")
    )
    columns_s = _seconds() - before
    for index in dataset.episodes.indices:
        dataset.frames(int(index), "observation.images.head", [FRAMES // 2])
    return {"rows": rows // 3, "columns_s": columns_s}


def convert_ours(folder: Path, episodes: int) -> Result:
    """Nothing is converted: v2.1 is read as it is."""
    from worldline_core.data.lerobot.dataset import LeRobotV21Dataset

    dataset = LeRobotV21Dataset(next((folder / "v21").glob("*")))
    for index in dataset.episodes.indices:
        for name in ("observation.state", "action", "timestamp"):
            dataset.column(int(index), name)
    return {}


def open_hostile_ours(folder: Path, episodes: int) -> Result:
    from worldline_core.data.lerobot.dataset import LeRobotV3Dataset

    dataset = LeRobotV3Dataset(folder / "dataset")
    dataset.column(0, "action")
    return {"frames": list(dataset.frames(0, "observation.images.head", [0]).shape)}


# LeRobot's -----------------------------------------------------------------------------------------------------------


def import_lerobot(folder: Path, episodes: int) -> Result:
    import lerobot.datasets.lerobot_dataset  # noqa: F401

    return {}


def write_lerobot(folder: Path, episodes: int, kill: bool = False, resume: bool = False) -> Result:
    from lerobot.configs.video import RGBEncoderConfig
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    vector = {"dtype": "float32", "shape": (14,), "names": [f"joint_{n}" for n in range(14)]}
    picture = {"dtype": "video", "shape": (*SIZE, 3), "names": ["height", "width", "channels"]}
    features = {"observation.state": vector, "action": vector} | {f"observation.images.{v}": picture for v in VIEWS}
    encoder = RGBEncoderConfig(vcodec="h264", crf=18, preset="slow")  # as ours
    root = folder / "dataset"
    if resume:
        dataset = LeRobotDataset.resume("local/benchmark", root=root, rgb_encoder=encoder)
    else:
        dataset = LeRobotDataset.create("local/benchmark", FPS, features, root=root, rgb_encoder=encoder)
    for number in range(dataset.num_episodes, episodes):
        if kill and number == KILLED_AFTER:
            os.kill(os.getpid(), signal.SIGKILL)
        state, images = episode_arrays(number)
        for frame in range(FRAMES):
            dataset.add_frame(
                {"observation.state": state[frame], "action": state[frame], "task": "lift the block"}
                | {f"observation.images.{view}": images[view][frame] for view in VIEWS}
            )
        dataset.save_episode(parallel_encoding=False)
    dataset.finalize()
    return {}


def read_lerobot(folder: Path, episodes: int) -> Result:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    before = _seconds()
    dataset = LeRobotDataset("local/benchmark", root=folder / "dataset", video_backend="pyav")
    columns = dataset.hf_dataset.with_format("numpy")
    rows = min(len(np.asarray(columns[name])) for name in ("observation.state", "action", "timestamp"))
    columns_s = _seconds() - before
    for index in range(dataset.num_episodes):
        dataset[index * FRAMES + FRAMES // 2]  # decodes every view: LeRobot offers no other way
    return {"rows": rows, "columns_s": columns_s}


def convert_lerobot(folder: Path, episodes: int) -> Result:
    from lerobot.scripts.convert_dataset_v21_to_v30 import convert_dataset

    convert_dataset("local/benchmark", root=next((folder / "v21").glob("*")), push_to_hub=False)
    return {}


def open_hostile_lerobot(folder: Path, episodes: int) -> Result:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset("local/benchmark", root=folder / "dataset", video_backend="pyav")
    return {"frames": list(dataset[0]["observation.images.head"].shape)}


JOBS: dict[str, Callable[..., Result]] = {
    f"{what} {who}": job
    for who, jobs in {
        "ours": (import_ours, write_ours, read_ours, convert_ours, open_hostile_ours),
        "lerobot": (import_lerobot, write_lerobot, read_lerobot, convert_lerobot, open_hostile_lerobot),
    }.items()
    for what, job in zip(("import", "write", "read", "convert", "hostile"), jobs, strict=True)
}


# Hostile metadata ----------------------------------------------------------------------------------------------------


def _video_outside(root: Path) -> None:
    """The template of videos leads out of the folder, to a file that is there."""
    shutil.copytree(root / "videos", root.parent / "elsewhere")
    info = json.loads((root / "meta/info.json").read_text())
    info["video_path"] = "../elsewhere/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
    (root / "meta/info.json").write_text(json.dumps(info))


def _data_outside(root: Path) -> None:
    """The table of frames is a link out of the folder."""
    table = next((root / "data").rglob("*.parquet"))
    shutil.move(table, root.parent / "elsewhere.parquet")
    table.symlink_to(root.parent / "elsewhere.parquet")


def _huge_count(root: Path) -> None:
    """The list of episodes claims 10^12 rows for the first one."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = next((root / "meta/episodes").rglob("*.parquet"))
    table = pq.read_table(path)
    for name in ("length", "dataset_to_index"):
        values = table[name].to_pylist()
        table = table.set_column(table.column_names.index(name), name, pa.array([10**12, *values[1:]]))
    pq.write_table(table, path)


def _pipe(root: Path) -> None:
    """A video is a pipe that nobody writes to."""
    path = next((root / "videos/observation.images.head").rglob("*.mp4"))
    path.unlink()
    os.mkfifo(path)


HOSTILE: dict[str, Callable[[Path], None]] = {
    "video template leads out of the folder": _video_outside,
    "table of frames is a link out of the folder": _data_outside,
    "an episode claims 10^12 frames": _huge_count,
    "a video is a pipe": _pipe,
}


# The table -----------------------------------------------------------------------------------------------------------


def _seconds() -> float:
    own, children = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return own.ru_utime + own.ru_stime + children.ru_utime + children.ru_stime


def measured(job: str, folder: Path, episodes: int, *flags: str, timeout: int = 1800) -> Result:
    """Run a job in a fresh process; "failed" says how it ended where it did."""
    project = str(Path(__file__).parents[1])
    offline = {"HF_HUB_OFFLINE": "1", "HF_DATASETS_CACHE": str(folder / "cache")}
    environment = {**os.environ, **offline, "OMP_NUM_THREADS": "1", "PYTHONPATH": project}
    # -P: this folder has a module `tokenizers`, as has one of LeRobot's dependencies.
    command = [
        sys.executable,
        "-P",
        __file__,
        "--job",
        job,
        "--folder",
        str(folder),
        "--episodes",
        str(episodes),
        *flags,
    ]
    start = time.monotonic()
    try:
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=timeout, check=False)
    except subprocess.TimeoutExpired:
        return {"failed": f"hung (ended after {timeout} s)", "wall_s": time.monotonic() - start}
    if done.returncode:
        raised = [line for line in done.stderr.splitlines() if re.match(r"[\w.]+: ", line)]
        said = raised[-1].rsplit(".", 1)[-1] if raised else f"exit {done.returncode}"
        return {"failed": said[:100], "wall_s": time.monotonic() - start}
    return json.loads(done.stdout.strip().splitlines()[-1]) | {"wall_s": time.monotonic() - start}


def digests(root: Path) -> dict[str, str]:
    """File -> digest."""
    from worldline_core.store.artifact_files import digest_file

    return {str(path.relative_to(root)): digest_file(path) for path in sorted(root.rglob("*")) if path.is_file()}


def installed(requirements: Iterable[str]) -> dict[str, float]:
    """Package -> MB on disk, of everything that these requirements bring."""
    from packaging.requirements import Requirement

    found: dict[str, float] = {}
    seen: set[tuple[str, str]] = set()
    waiting = [(Requirement(text), extra) for text in requirements for extra in ("", *Requirement(text).extras)]
    while waiting:
        requirement, extra = waiting.pop()
        name = re.sub(r"[-_.]+", "-", requirement.name).lower()
        if (name, extra) in seen:
            continue
        seen.add((name, extra))
        try:
            package = importlib.metadata.distribution(name)
        except importlib.metadata.PackageNotFoundError:
            continue
        found[name] = sum(file.size or 0 for file in package.files or ()) / 1e6
        for text in package.requires or ():
            needed = Requirement(text)
            if needed.marker is None or needed.marker.evaluate({"extra": extra}):
                waiting += [(needed, further) for further in ("", *needed.extras)]
    return found


def weight_lines() -> list[str]:
    """What LeRobot adds to an installation of this project."""
    import tomllib

    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
    without = installed(project["dependencies"])
    added = {name: size for name, size in installed(["lerobot[dataset]"]).items() if name not in without}
    largest = sorted(added, key=lambda name: -added[name])[:8]
    return [
        f"dependencies: {len(added)} packages more ({sum(added.values()):.0f} MB on top of {sum(without.values()):.0f} MB)",
        "  the largest: " + ", ".join(f"{name} {added[name]:.0f} MB" for name in largest),
    ]


def write_v21(folder: Path, episodes: int) -> None:
    """A dataset of version 2.1 at folder/set, with all that LeRobot's conversion asks for."""
    from tools.corrupted import lerobot_v21

    folder.mkdir()
    lerobot_v21.write(folder / "set", episodes, 0, np.random.default_rng(0))
    meta = folder / "set" / "meta"
    info = json.loads((meta / "info.json").read_text())
    (meta / "info.json").write_text(json.dumps(info | {"total_chunks": 1, "total_videos": 2 * episodes}))
    vector = {name: [0.0] * 14 for name in ("min", "max", "mean", "std")} | {"count": [24]}
    stats = {"observation.state": vector, "action": vector}
    lines = [json.dumps({"episode_index": number, "stats": stats}) for number in range(episodes)]
    (meta / "episodes_stats.jsonl").write_text("\n".join(lines))


def line(what: str, ours: str, lerobot: str) -> str:
    return f"{what:<46} {ours:<36} {lerobot}"


def cost(result: Result) -> str:
    if "failed" in result:
        return result["failed"]
    return f"{result['cpu_s']:.1f} s ({result['wall_s']:.1f} s by the clock), {result['rss_mb']:.0f} MB"


def compare(work: Path, episodes: int) -> None:
    print(line("", "ours", "LeRobot's classes"), flush=True)
    both = ("ours", "lerobot")

    def row(what: str, found: dict[str, str]) -> None:
        print(line(what, found["ours"], found["lerobot"]), flush=True)

    row("import", {who: cost(measured(f"import {who}", work, 0)) for who in both})
    for who in both:
        for turn in ("a", "b", "killed"):
            (work / who / turn).mkdir(parents=True)
    row(
        f"write {episodes} episodes x 3 views",
        {w: cost(measured(f"write {w}", work / w / "a", episodes)) for w in both},
    )
    differing = {}
    for who in both:
        measured(f"write {who}", work / who / "b", episodes)
        first, second = (digests(work / who / turn / "dataset") for turn in ("a", "b"))
        changed = sorted({name.split("/")[0] for name in first.keys() | second if first.get(name) != second.get(name)})
        size = sum(path.stat().st_size for path in (work / who / "a" / "dataset").rglob("*") if path.is_file())
        differing[who] = (
            f"{'same bytes' if not changed else 'other bytes in ' + ', '.join(changed)}; {size / 1e6:.1f} MB"
        )
    row("written twice", differing)
    resumed = {}
    for who, flags in (("ours", ()), ("lerobot", ("--resume",))):
        folder = work / who / "killed"
        measured(f"write {who}", folder, episodes, "--kill")
        again = measured(f"write {who}", folder, episodes, *flags)
        same = digests(folder / "dataset") == digests(work / who / "a" / "dataset") if "failed" not in again else False
        resumed[who] = again.get("failed") or ("continued, same bytes" if same else "continued, other bytes")
    row(f"killed after {KILLED_AFTER} episodes, then continued", resumed)
    read = {who: measured(f"read {who}", work / who / "a", episodes) for who in both}
    row(
        "read states, actions and times of all frames",
        {w: f"{read[w].get('columns_s', np.nan):.2f} s after the import" for w in both},
    )
    row("  and one frame of each episode", {who: cost(read[who]) for who in both})
    for who in both:
        write_v21(work / who / "v21", episodes)
    row("read v2.1 / convert it to v3", {who: cost(measured(f"convert {who}", work / who, episodes)) for who in both})
    for what, damage in HOSTILE.items():
        found = {}
        for who in both:
            folder = work / who / re.sub(r"\W+", "_", what)
            shutil.copytree(work / who / "a" / "dataset", folder / "dataset")
            damage(folder / "dataset")
            result = measured(f"hostile {who}", folder, episodes, timeout=240)
            found[who] = result.get("failed") or f"read: {result['frames']}"
        row(what, found)
    print("\n".join(weight_lines()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--job", choices=sorted(JOBS))
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--kill", action="store_true")
    parser.add_argument("--resume", action="store_true")
    arguments = parser.parse_args()
    if arguments.job is None:
        with tempfile.TemporaryDirectory() as work:
            compare(Path(work), arguments.episodes)
        return
    flags = {name: True for name in ("kill", "resume") if getattr(arguments, name)}
    result = JOBS[arguments.job](arguments.folder, arguments.episodes, **flags)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(json.dumps(result | {"cpu_s": _seconds(), "rss_mb": memory}))


if __name__ == "__main__":
    main()
