"""Sources that hold nothing, or of which a part is missing: all that is wrong is said at once."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.data import test_source_robomind as robomind
from tests.data import test_source_robotwin as robotwin
from tests.data import test_source_unitree_h5 as unitree
from tests.data.curating import run
from tests.data.published_lerobot import FRAMES, write_droid
from tests.data.test_lerobot import DATA, edit
from worldline_core.data.video.encoder import encode_video
from worldline_core.errors import DataError


def videos(folder: Path, seed: int) -> dict[str, Any]:
    folder.mkdir()
    frames = np.random.default_rng(seed).integers(0, 255, (6, 16, 24, 3), dtype=np.uint8)
    encode_video(folder / "one.mp4", frames, 5)
    return {"kind": "video_folder", "path": str(folder)}


def test_patterns_that_include_nothing_are_an_error(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"(?s)None of.*is included.*include: two\*.*1 episodes: good-one"):
        run(tmp_path, {**videos(tmp_path / "good", 0), "include": ["two*"]})


KINDS = {
    "agibot_gesim": {"fps": 30},
    "agibot_world": {},
    "droid_annotation": {},
    "enerverse_ac": {"fps": 30},
    "episode_set": {},
    "lerobot_v3": {"embodiment": "none", "angle_unit": "rad", "views": {"top": "head"}},
    "lerobot_v21": {"embodiment": "none", "angle_unit": "rad", "views": {"top": "head"}, "collection": True},
    "mcap": {},
    "robomind": {"layout": "h5_franka_3rgb", "fps": 30, "gripper_state": {"closed": 1, "open": 0}},
    "robotwin": {"fps": 16},
    "unitree_h5": {
        "robot": "g1_dex1", "embodiment": "none", "fps": 30, "views": {"head": "top"},
        "gripper_state": {"closed": 0, "open": 5}, "gripper_command": {"closed": 0, "open": 5},
    },
    "video_folder": {},
}  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_a_source_without_episodes_is_an_error(tmp_path: Path, kind: str) -> None:
    (tmp_path / "empty").mkdir()
    empty = {"kind": kind, "path": str(tmp_path / "empty"), "name": "emptied", **KINDS[kind]}
    said = r"(?s)holds no episode.*source emptied.*expected: \S"
    if kind in ("lerobot_v3", "episode_set"):
        said = "empty/(meta/info.json|index.parquet)"
    elif kind == "lerobot_v21":
        said += r".*meta/info\.json"
    with pytest.raises(DataError, match=said):
        run(tmp_path, videos(tmp_path / "good", 0), empty)


def droid(root: Path) -> dict[str, Any]:
    write_droid(root)
    columns = {"feature": "observation.state", "columns": ["joint_*"]}
    gripper = {"feature": "observation.state", "columns": ["gripper"], "closed": 1, "open": 0}
    views = {"exterior_1_left": "head", "exterior_2_left": "exterior_2", "wrist_left": "right_wrist"}
    return {
        "kind": "lerobot_v3", "path": str(root), "embodiment": "none", "angle_unit": "rad",
        "views": {f"observation.images.{name}": view for name, view in views.items()},
        "arms": [{"name": "right", "state": {"joints": columns, "gripper": gripper}}],
    }  # fmt: skip


def test_videos_of_a_camera_and_rows_of_the_table_are_missing(tmp_path: Path) -> None:
    source = droid(tmp_path / "raw")
    (tmp_path / "raw/videos/observation.images.exterior_2_left/chunk-000/file-000.mp4").unlink()
    edit(tmp_path / "raw" / DATA, lambda table: table.slice(0, 2 * FRAMES - 1))
    with pytest.raises(DataError, match="2 quarantined") as refused:
        run(tmp_path, source)
    first, second = str(refused.value).split("raw-000001 (length_mismatch): 2 things are wrong")
    assert "raw-000000 (missing_file)" in first
    for said in (f"expected: {FRAMES} rows", "missing_file: ", "observation.images.exterior_2_left"):
        assert said in second
    counts, curated = run(tmp_path / "available", source, views="available")
    assert counts["reasons"] == {"length_mismatch": 1}
    assert curated.rows[0].views == ("head", "right_wrist")
    assert "exterior_2_left" in curated.quarantine()[0].detail  # it lacks that as well


@pytest.mark.parametrize("kind", ["robomind", "robotwin", "unitree transitions", "unitree hdf5"])
def test_a_camera_that_a_file_lacks_costs_its_view_alone(tmp_path: Path, kind: str) -> None:
    root = tmp_path / "raw"
    if kind == "robomind":
        robomind.write_franka(root)
        source = {"kind": kind, "path": str(root), "views": {"head": "camera_top"}, **KINDS[kind], "fps": 10}
    elif kind == "robotwin":
        robotwin.write_episode(root)
        source = robotwin.settings(root, views={"head": "head_camera"})
    else:
        (unitree.write_transitions if kind.endswith("transitions") else unitree.write_hdf5)(root)
        source = unitree.settings(root, views={"head": "cam_left_high"})
    source["views"] |= {"left_wrist": "gone", "right_wrist": "gone_too"}
    with pytest.raises(DataError, match=r"(?s)2 things are wrong.*gone.*gone_too"):
        run(tmp_path, source)
    _, curated = run(tmp_path / "available", source, views="available")
    assert curated.rows[0].views == ("head",)
    with pytest.raises(DataError, match="gone"):  # no view is left
        run(tmp_path / "none", source | {"views": {"head": "gone"}}, views="available")


def test_unknown_fields_of_both_templates_are_said_at_once(tmp_path: Path) -> None:
    source = droid(tmp_path / "raw")
    info = tmp_path / "raw/meta/info.json"
    content = json.loads(info.read_text())
    content |= {"data_path": "data/{chunk}.parquet", "video_path": "videos/{video_key}/{shard}.mp4"}
    info.write_text(json.dumps(content))
    with pytest.raises(DataError, match=r"(?s)4 things are wrong.*got: .*\{shard\}.*got: data/\{chunk\}\.parquet"):
        run(tmp_path, source, views="available")


def test_what_the_contract_refuses_is_said_at_once(tmp_path: Path) -> None:
    source = droid(tmp_path / "raw")
    for name in ("exterior_1_left", "wrist_left"):
        (tmp_path / f"raw/videos/observation.images.{name}/chunk-000/file-000.mp4").unlink()
    # so101 has six state columns, not eight.
    with pytest.raises(DataError, match=r"(?s)2 length_mismatch.*3 things are wrong") as refused:
        run(tmp_path, source | {"embodiment": "so101"})
    for fault in ("State has another size than the embodiment", "exterior_1_left", "wrist_left"):
        assert fault in str(refused.value)
