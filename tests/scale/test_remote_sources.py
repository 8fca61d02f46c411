"""Every kind of source gives the same bytes from a folder and from a location that is none (fsspec's memory)."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from upath import UPath

from worldline_core.data.curation.curate import curate
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.mcap.exported import write_episode_mcap
from worldline_core.store.artifact_files import digest_folder

DATA_TESTS = Path(__file__).parents[1] / "data"


def writers(name: str) -> ModuleType:
    """A module of the tests of data: each writes a published layout with code of its own."""
    sys.path.insert(0, str(DATA_TESTS))
    try:
        spec = importlib.util.spec_from_file_location(f"remote_{name}", DATA_TESTS / f"{name}.py")
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(DATA_TESTS))
    return module


def robotwin(root: Path, sample: Any) -> dict[str, Any]:
    pytest.importorskip("h5py")
    for number in range(2):
        writers("test_source_robotwin").write_episode(root, number)
    return {"kind": "robotwin", "fps": 10.0}


def lerobot_v21(root: Path, sample: Any) -> dict[str, Any]:
    writers("published_lerobot").write_robocoin(root, 3)
    return {
        "kind": "lerobot_v21",
        "embodiment": "none",
        "angle_unit": "rad",
        "views": {"observation.images.cam_high_rgb": "head"},
        "grippers": {"left_gripper_open_scale": {"closed": 0, "open": 1}},
    }


def mcap(root: Path, sample: Any) -> dict[str, Any]:
    root.mkdir(parents=True)
    for number in range(2):
        episode, frames, masks = sample(number)
        write_episode_mcap(root / f"{number}.mcap", episode, frames, robot_masks=masks)
    (root / "cut.mcap").write_bytes((root / "0.mcap").read_bytes()[:3000])
    return {"kind": "mcap"}


def video_folder(root: Path, sample: Any) -> dict[str, Any]:
    module = writers("test_source_video_folder")
    module.write_video(root / "a" / "one.mp4", module.pictures(0))
    (root / "a" / "one.txt").write_text("stack the blocks")
    (root / "b.mp4").write_bytes(b"no video")
    return {"kind": "video_folder"}


@pytest.mark.usefixtures("reading_in_this_process")  # which alone has a file system in memory
@pytest.mark.parametrize("write", [robotwin, lerobot_v21, mcap, video_folder])
def test_the_same_bytes_from_a_folder_and_from_elsewhere(
    tmp_path: Path, sample: Callable[..., tuple], write: Callable[[Path, Any], dict[str, Any]]
) -> None:
    local = tmp_path / "recordings"
    settings = write(local, sample)
    remote = UPath(f"memory://{tmp_path.name}/recordings")
    files = [path for path in local.rglob("*") if path.is_file()]
    assert files
    for file in files:
        (remote / file.relative_to(local).as_posix()).parent.mkdir(parents=True, exist_ok=True)
        (remote / file.relative_to(local).as_posix()).write_bytes(file.read_bytes())

    def digest(path: object, name: str) -> tuple[dict[str, Any], str]:
        source = {**settings, "path": str(path), "name": "rec"}
        configured = CurateConfig.model_validate({"sources": [source], "min_frames": 1})
        counts = curate(configured, {}, tmp_path / name)
        return counts, digest_folder(tmp_path / name)

    counts, local_digest = digest(local, "local")
    assert counts["kept"] > 0
    assert digest(remote, "remote") == (counts, local_digest)
