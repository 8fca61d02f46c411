"""Sources whose folder is a URL give the same set, to the byte, as the same folder on this machine."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import fsspec
import pytest
import yaml

from tests.data.curating import preset, run
from tests.data.published_lerobot import HEIGHT, WIDTH, write_robocoin
from tests.data.published_robomind import GRIPPER, write_franka
from worldline_core.store.artifact_files import digest_folder

POSE = [[1.0, 0, 0, 0.1], [0, 0, 1.0, -0.4], [0, -1.0, 0, 1.3], [0, 0, 0, 1.0]]
CAMERA = {"width": WIDTH, "height": HEIGHT, "K": [[60.0, 0, 63.5], [0, 60.0, 35.5], [0, 0, 1]], "T": POSE}


def robocoin(root: Path) -> dict[str, Any]:
    write_robocoin(root / "one", episodes=2)
    camera = {**CAMERA, "maps": "camera_to_base", "axes": "opencv"}
    (root / "one/meta/calibration.yaml").write_text(yaml.safe_dump({"views": {"head": camera}}))
    return preset("robocoin", root, calibration="meta/calibration.yaml")


def robomind(root: Path) -> dict[str, Any]:
    write_franka(root)
    (root / "instr.csv").write_text("task,instruction\nbread_in_basket,take the bread\n")
    declared = {"layout": "h5_franka_3rgb", "fps": 10, "gripper_state": GRIPPER, "instructions": "instr.csv"}
    return {"kind": "robomind", **declared}


@pytest.mark.parametrize("make", [robocoin, robomind])
@pytest.mark.usefixtures("reading_in_this_process")  # which alone has a file system in memory
def test_a_source_in_an_object_store(tmp_path: Path, make: Callable[[Path], dict[str, Any]]) -> None:
    root = tmp_path / "raw"
    root.mkdir()
    source, bucket = make(root), f"/{make.__name__}"
    fsspec.filesystem("memory").put(f"{root}/", f"{bucket}/", recursive=True)
    digests = set()
    for number, path in enumerate((str(root), f"memory:/{bucket}")):
        counts, curated = run(tmp_path / str(number), {**source, "path": path, "name": "same"})
        assert counts["quarantined"] == 0
        digests.add(digest_folder(curated.root))
    assert len(digests) == 1
