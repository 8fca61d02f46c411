"""Kind of a folder of recordings, a look at it in a process with limits (the files are those of others), and samples of the
hub's datasets.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from worldline_core.data.guards.reader_process import ReaderLimits, read_limited
from worldline_core.data.guards.source_paths import AnyPath, fill_template, find_files, relative_name
from worldline_core.data.lerobot.dataset import DATA_PATH, VIDEO_PATH, LeRobotV3Dataset, LeRobotV21Dataset, read_info
from worldline_core.discovery.findings import Discovery, name_calibration, named, stated_licence
from worldline_core.discovery.lerobot import discover_collection, discover_lerobot
from worldline_core.discovery.mcap import discover_mcap
from worldline_core.discovery.recordings import (
    discover_agibot_world,
    discover_droid,
    discover_enerverse,
    discover_episode_set,
    discover_gesim,
    discover_robomind,
    discover_robotwin,
    discover_unitree,
    discover_videos,
)
from worldline_core.errors import DataError
from worldline_core.http_exchange import hub_snapshot

_HUB_ID = re.compile(r"(?:hf://datasets/)?([A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*)")
_META = ["meta/*", "README.md", "LICENSE*"]
_EPISODES = 3


@dataclass(frozen=True)
class HubDataset:
    """A snapshot in the hub's local cache, with all of `meta` and a few episodes; `command` fetches the others."""

    folder: Path
    command: str


def hub_id(text: str) -> str | None:
    """ORG/NAME, where the text names a dataset of the hub and no folder that is here."""
    match = _HUB_ID.fullmatch(text)
    return match[1] if match is not None and not Path(text).exists() else None


def fetch_sample(repo_id: str) -> HubDataset:
    """Fetch `meta` and some episodes of a LeRobotDataset.

    Raises: UnavailableError where the hub does not give it, and DataError where it is no LeRobotDataset.
    """
    folder = _snapshot(repo_id, _META)
    if not (folder / "meta" / "info.json").is_file():
        raise DataError(
            "Not a LeRobotDataset",
            where=f"{repo_id} on the hub",
            expected="meta/info.json",
            next_step=f"fetch it whole, and give its folder: hf download {repo_id} --repo-type dataset --local-dir FOLDER",
        )
    folder = _snapshot(repo_id, [*_META, *_sample_files(folder)], revision=folder.name)
    return HubDataset(folder, f"hf download {repo_id} --repo-type dataset --revision {folder.name}")


def fetch_dataset(repo_id: str) -> Path:
    """Fetch a whole dataset into the hub's local cache; what is there is not fetched again. Raises: UnavailableError as `fetch_sample`."""
    return _snapshot(repo_id, ["*"])


def _sample_files(folder: Path) -> list[str]:
    """Files of the first episodes."""
    info = read_info(folder)
    cameras = [key for key, feature in info.features.items() if feature.get("dtype") == "video"]
    files: list[str] = []
    if info.codebase_version == "v3.0":
        dataset = LeRobotV3Dataset(folder)
        for index in dataset.episodes.indices[:_EPISODES]:
            row = dataset.row(int(index))
            numbers = {name: int(row.get(f"data/{name}") or 0) for name in ("chunk_index", "file_index")}
            files.append(fill_template(info.data_path or DATA_PATH, **numbers))
            for key in cameras:
                numbers = {name: int(row.get(f"videos/{key}/{name}") or 0) for name in ("chunk_index", "file_index")}
                files.append(fill_template(info.video_path or VIDEO_PATH, video_key=key, **numbers))
    else:
        for index in map(int, LeRobotV21Dataset(folder).episodes.indices[:_EPISODES]):
            values = {"episode_chunk": index // info.chunks_size, "episode_index": index}
            files.append(fill_template(info.data_path or "", **values))
            files += [fill_template(info.video_path or "", video_key=key, **values) for key in cameras]
    return [re.sub(r"([*?\[])", r"[\1]", name) for name in dict.fromkeys(files)]


def _snapshot(repo_id: str, patterns: list[str], revision: str | None = None) -> Path:
    return hub_snapshot(repo_id, patterns, what="dataset", repo_type="dataset", revision=revision)


_ARCHIVES = (".zip", ".tar", ".gz", ".tgz", ".7z", ".zst")
_LOOKED_FOR = (
    "meta/info.json (LeRobot), *.mcap, proprio_stats.h5 or sample_*/demo_* bundles (AgiBot), trajectory.hdf5 (RoboMIND),"
    " episode*.hdf5 or transitions/*/*.h5 (Unitree, ALOHA, RoboTwin), annotation/*/*.json (DROID), index.parquet (EpisodeSet), or *.mp4"
)
_MOST_FILES = 200_000


def recognise(root: AnyPath) -> tuple[str, AnyPath]:
    """The kind of a folder, and the folder that holds it: one level may lie around it.

    Raises: DataError where there is nothing, or nothing that any reader knows; the message says what there is.
    """
    if not root.exists():
        raise DataError("No such folder", where=root, next_step="give a folder, or ORG/NAME of the Hugging Face hub")
    if not root.is_dir():
        if root.suffix == ".mcap":
            return "mcap", root
        raise DataError(
            "Not a folder",
            where=root,
            expected="a folder of recordings, or one MCAP file",
            next_step=f"give the folder: {root.parent}",
        )
    files = find_files(root, "*")
    if isinstance(root, Path):
        files = [path for path in files[:_MOST_FILES] if path.is_file()]
    names = [relative_name(path, root) for path in files]
    texts = [str(name) for name in names]

    def any_named(*wanted: str) -> bool:
        return any(name.name in wanted for name in names)

    if "index.parquet" in texts and "manifest.json" in texts:
        return "episode_set", root
    if found := [name for name in names if name.name == "info.json" and name.parent.name == "meta"]:
        inner = [root.joinpath(*name.parts[:-2]) for name in found]
        return ("lerobot", inner[0]) if len(inner) == 1 else ("lerobot_collection", root)
    if any(name.suffix in (".mcap", ".db3", ".bag") or name.name.endswith(".mcap.zst") for name in names):
        return "mcap", root
    if any(name.parts[0] in ("proprio_stats", "observations") and len(name.parts) >= 4 for name in names):
        return "agibot_world", root
    if any_named("proprio_stats.h5", "action.npy"):
        return "enerverse_ac", root
    if any_named("actions.npy", "state_joints_0.npy"):
        return "agibot_gesim", root
    if any_named("trajectory.hdf5"):
        return "robomind", root
    if any(name.suffix == ".h5" and name.parts[:-2] == ("transitions",) for name in names):
        return "unitree_h5", root
    if any(name.suffix == ".hdf5" and name.name.startswith("episode_") for name in names):
        return "unitree_h5", root
    if any(name.suffix == ".hdf5" and name.name.startswith("episode") and name.parent.name == "data" for name in names):
        return "robotwin", root
    if any(name.suffix == ".json" and len(name.parts) >= 3 and name.parts[-3] == "annotation" for name in names):
        return "droid_annotation", root
    if any(name.suffix.lower() == ".mp4" for name in names):
        return "video_folder", root
    archives = [text for text in texts if text.endswith(_ARCHIVES)]
    counted = Counter(name.suffix or "no suffix" for name in names)
    raise DataError(
        "Nothing here that a reader knows" if texts else "The folder is empty",
        where=root,
        expected=_LOOKED_FOR,
        got=", ".join(f"{count} {suffix}" for suffix, count in counted.most_common(6)) + f": {named(texts, 3)}"
        if texts
        else "no files",
        next_step=f"unpack {named(archives, 2)}"
        if archives
        else "give the folder of one dataset (docs/sources.md lists what is read)",
    )


_LOOKS: dict[str, Callable[[AnyPath], Discovery]] = {
    "episode_set": discover_episode_set,
    "lerobot": discover_lerobot,
    "lerobot_collection": discover_collection,
    "mcap": discover_mcap,
    "agibot_world": discover_agibot_world,
    "agibot_gesim": discover_gesim,
    "enerverse_ac": discover_enerverse,
    "robomind": discover_robomind,
    "unitree_h5": discover_unitree,
    "robotwin": discover_robotwin,
    "droid_annotation": discover_droid,
    "video_folder": discover_videos,
}


def discover(folder: Path) -> Discovery:
    """The folder's recordings, with evidence for every value.

    Raises: DataError where nothing in it is known, or nothing can be read; UnavailableError without h5py for HDF5 files.
    """
    return read_limited(ReaderLimits(), look, folder.absolute())


def look(folder: Path) -> Discovery:
    """`discover`, in this process."""
    kind, root = recognise(folder)
    found = _LOOKS[kind](root)
    says_itself = kind in ("episode_set", "lerobot", "lerobot_collection")
    if not says_itself and (licence := stated_licence(root if root.is_dir() else root.parent)) is not None:
        found.say(("license",), *licence)
    if kind in ("mcap", "robomind", "unitree_h5", "droid_annotation") and found.cameras == "none":
        name_calibration(found, root)
    return found
