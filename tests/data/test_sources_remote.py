"""Sources whose folder is a URL give the same set, to the byte, as the same folder on this machine."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import fsspec
import pytest
import yaml
from published_lerobot import HEIGHT, WIDTH, write_galaxea, write_robocoin, write_video

from worldline_core.data.curation.curate import curate
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.store.artifact_files import digest_folder

POSE = [[1.0, 0, 0, 0.1], [0, 0, 1.0, -0.4], [0, -1.0, 0, 1.3], [0, 0, 0, 1.0]]
CAMERA = {"width": WIDTH, "height": HEIGHT, "K": [[60.0, 0, 63.5], [0, 60.0, 35.5], [0, 0, 1]], "T": POSE}


def videos(root: Path) -> dict[str, Any]:
    write_video(root / "kitchen/one.mp4", [0, 1], 15)
    write_video(root / "two.mp4", [2], 15)
    (root / "kitchen/one.txt").write_text("wipe the table")
    return {"kind": "video_folder"}


def robocoin(root: Path) -> dict[str, Any]:
    write_robocoin(root / "one", episodes=2)
    camera = {**CAMERA, "maps": "camera_to_base", "axes": "opencv"}
    (root / "one/meta/calibration.yaml").write_text(yaml.safe_dump({"views": {"head": camera}}))
    return {**preset("robocoin"), "calibration": "meta/calibration.yaml"}


def galaxea(root: Path) -> dict[str, Any]:
    write_galaxea(root / "mirror")
    return preset("galaxea")


def robomind(root: Path) -> dict[str, Any]:
    pytest.importorskip("h5py", reason="the extra `hdf5` is not installed")
    from published_robomind import GRIPPER, write_franka

    write_franka(root)
    (root / "instr.csv").write_text("task,instruction\nbread_in_basket,take the bread\n")
    declared = {"layout": "h5_franka_3rgb", "fps": 10, "gripper_state": GRIPPER, "instructions": "instr.csv"}
    return {"kind": "robomind", **declared}


def preset(name: str) -> dict[str, Any]:
    file = Path(__file__).resolve().parents[2] / "configs/sources" / f"{name}.yaml"
    return yaml.safe_load(file.read_text())["curate"]["sources"][0]


@pytest.mark.parametrize("make", [videos, robocoin, galaxea, robomind])
@pytest.mark.usefixtures("reading_in_this_process")  # which alone has a file system in memory
def test_a_source_in_an_object_store(tmp_path: Path, make: Callable[[Path], dict[str, Any]]) -> None:
    root = tmp_path / "raw"
    root.mkdir()
    source = make(root)
    store = fsspec.filesystem("memory")
    bucket = f"/{make.__name__}"
    store.put(f"{root}/", f"{bucket}/", recursive=True)
    digests = []
    for number, path in enumerate((str(root), f"memory:/{bucket}")):
        config = CurateConfig.model_validate({"sources": [{**source, "path": path, "name": "same"}]})
        counts = curate(config, {}, tmp_path / f"out{number}")
        assert counts["kept"] >= 1
        assert counts["quarantined"] == 0
        digests.append(digest_folder(tmp_path / f"out{number}"))
    assert digests[0] == digests[1]
