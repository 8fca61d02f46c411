"""Look at a folder of recordings, in a process with limits: the files are those of others."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from worldline_core.data.guards.reader_process import ReaderLimits, read_limited
from worldline_core.data.guards.source_paths import AnyPath
from worldline_core.discovery.findings import Discovery
from worldline_core.discovery.kinds import recognise
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
    return _LOOKS[kind](root)
