"""Datasets of the Hugging Face hub: what says how they are read, and a few episodes to look at."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from worldline_core.data.guards.source_paths import fill_template
from worldline_core.data.lerobot.dataset import DATA_PATH, VIDEO_PATH, LeRobotV3Dataset, LeRobotV21Dataset, read_info
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
