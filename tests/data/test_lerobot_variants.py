"""LeRobot datasets that are good but unusual: images in the tables, grouped names, byte order marks, the Hub's cache."""

from __future__ import annotations

import io
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image
from published_lerobot import FRAMES, picture, wave, write_droid, write_robocoin
from test_lerobot_rows import DATA, EPISODES, edit, run, source, with_values

from worldline_core.data.sources.lerobot import flat_names
from worldline_core.errors import ConfigError, DataError
from worldline_core.store.artifact_files import digest_folder

HEAD = "observation.images.cam_high_rgb"
V21 = {"kind": "lerobot_v21", "arms": None, "views": {HEAD: "head"}}


def png(image: np.ndarray, kind: str = "PNG") -> bytes:
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, kind)
    return stream.getvalue()


def with_features(root: Path, change: Any, **keys: Any) -> None:
    path = root / "meta/info.json"
    info = json.loads(path.read_text())
    change(info["features"])
    path.write_text(json.dumps({**info, **keys}))


def as_images(root: Path, key: str, data: str, images: list[Any]) -> None:
    """A camera's pictures in the table, as LeRobot stores them with `use_videos=False`."""
    with_features(root, lambda features: features[key].update(dtype="image"))
    shutil.rmtree(root / "videos", ignore_errors=True)
    edit(root / data, lambda table: table.append_column(key, pa.array(images)))


@pytest.mark.parametrize("kind", ["PNG", "JPEG"])
def test_images_in_the_table_are_read(tmp_path: Path, kind: str) -> None:
    write_droid(tmp_path / "raw")
    shown = [picture(number + 1, frame) for number in range(2) for frame in range(FRAMES)]
    values = [{"bytes": png(image, kind), "path": f"frame-{n:06d}"} for n, image in enumerate(shown)]
    as_images(tmp_path / "raw", "observation.images.exterior_1_left", DATA, values)
    counts, curated = run(tmp_path, source(tmp_path / "raw"))
    assert counts["kept"] == 2
    for number in range(2):
        assert np.allclose(curated.episode(number).state, wave(8, number)[:, :7], atol=1e-6)
        stored = curated.frames(number, "head").astype(int)
        assert np.abs(stored - np.stack(shown[number * FRAMES : (number + 1) * FRAMES])).mean() < 6


def test_images_of_version_21_and_what_is_wrong_with_some(tmp_path: Path) -> None:
    write_robocoin(tmp_path / "raw", episodes=4)
    (tmp_path / "raw/frames").mkdir()
    (tmp_path / "raw/frames/a.png").write_bytes(png(picture(3, 0)))
    good = [{"bytes": png(picture(0, frame)), "path": None} for frame in range(FRAMES)]
    per_episode = [
        good,
        [{"bytes": None, "path": "frames/a.png"}, *good[1:]],
        [{"bytes": None, "path": "frames/gone.png"}, *good[1:]],
        [*good[:-1], {"bytes": b"no picture", "path": None}],
    ]
    for number, images in enumerate(per_episode):
        as_images(tmp_path / "raw", HEAD, f"data/chunk-000/episode_{number:06d}.parquet", images)
    counts, curated = run(tmp_path, source(tmp_path / "raw", **V21))
    assert (counts["kept"], counts["reasons"]) == (2, {"missing_file": 1, "unreadable": 1})
    assert np.abs(curated.frames(1, "head", [0])[0].astype(int) - picture(3, 0)).mean() < 6


@pytest.mark.parametrize(
    ("names", "flat"),
    [
        (["a", "b"], ["a", "b"]),
        ([["a"], ["b", "c"]], ["a", "b", "c"]),
        ({"motors": ["a", "b"]}, ["a", "b"]),
        ({"left_arm": ["l1", "l2"], "right_arm": ["r1"]}, ["l1", "l2", "r1"]),
        ({"left": ["j1", "j2"], "right": ["j1", "j2"]}, ["left/j1", "left/j2", "right/j1", "right/j2"]),
        ({"y": 1, "x": 0}, ["x", "y"]),
        (None, []),
        ("joint", []),
    ],
)
def test_names_in_groups_are_joined(names: Any, flat: list[str]) -> None:
    assert flat_names({"names": names}) == flat


def test_byte_order_marks_and_numbers_with_a_fraction_of_zero(tmp_path: Path) -> None:
    root = tmp_path / "raw"
    write_robocoin(root, episodes=2)
    with_features(root, lambda features: None, chunks_size=1000.0)
    listed = [{"episode_index": float(i), "tasks": ["push"], "length": float(FRAMES)} for i in range(2)]
    (root / "meta/episodes.jsonl").write_text("\n".join(map(json.dumps, listed)))
    for name in ("info.json", "tasks.jsonl", "episodes.jsonl"):
        path = root / "meta" / name
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    counts, curated = run(tmp_path, source(root, **V21))
    assert counts["kept"] == 2
    assert curated.rows[0].instruction == "move the bread"


@pytest.mark.parametrize(
    "line", ["null", "[]", "7", "{}", '"x"', '{"episode_index": true}', '{"episode_index": 1e400}']
)
def test_a_line_that_is_no_episode_is_one_message(tmp_path: Path, line: str) -> None:
    """Arrow's reader of JSON crashes on some of them."""
    write_robocoin(tmp_path / "raw", episodes=2)
    with (tmp_path / "raw/meta/episodes.jsonl").open("a") as file:
        file.write(f"\n{line}\n")
    with pytest.raises(DataError, match=r"numbers no episodes[\s\S]*episodes\.jsonl"):
        run(tmp_path, source(tmp_path / "raw", **V21))


@pytest.mark.parametrize("index", [float("nan"), None, 1e300, -1.0, 0.5])
def test_a_task_index_that_is_no_index_costs_its_episode(tmp_path: Path, index: float | None) -> None:
    write_droid(tmp_path / "raw")
    values = [index] * FRAMES + [0.0] * FRAMES
    edit(tmp_path / "raw" / DATA, lambda table: with_values(table, task_index=values))
    counts, _ = run(tmp_path, source(tmp_path / "raw"))
    assert (counts["kept"], set(counts["reasons"]) <= {"missing_column", "nan_state"}) == (1, True)


def test_lengths_in_version_3_may_be_floats_but_no_fractions(tmp_path: Path) -> None:
    write_droid(tmp_path / "raw")
    at = pq.read_table(tmp_path / "raw" / EPISODES).column_names.index("length")
    edit(
        tmp_path / "raw" / EPISODES,
        lambda table: table.set_column(at, "length", pa.array([float(FRAMES), FRAMES + 0.5])),
    )
    counts, curated = run(tmp_path, source(tmp_path / "raw"))
    assert (counts["kept"], counts["reasons"]) == (1, {"unreadable": 1})
    assert "a whole number" in curated.quarantine()[0].detail


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"codebase_version": "v1.6"}, r"got: v1\.6.*next step: convert"),
        ({"codebase_version": "v3.0"}, r"got: v3\.0.*next step: set kind: lerobot_v3"),
        ({"storage_format": "lance"}, r"storage_format: parquet.*got: lance.*next step: export"),
    ],
)
def test_other_formats_name_the_next_step(tmp_path: Path, keys: dict[str, Any], said: str) -> None:
    write_robocoin(tmp_path / "raw")
    with_features(tmp_path / "raw", lambda features: None, **keys)
    with pytest.raises(DataError, match=f"(?s){said}"):
        run(tmp_path, source(tmp_path / "raw", **V21))


def test_version_2_0_differs_in_its_statistics_alone(tmp_path: Path) -> None:
    write_robocoin(tmp_path / "raw")
    with_features(tmp_path / "raw", lambda features: None, codebase_version="v2.0")
    counts, curated = run(tmp_path, source(tmp_path / "raw", **V21))
    assert counts["kept"] == 1
    assert curated.episode(0).conventions["layout"] == "lerobot v2.0"


def test_a_dataset_that_does_not_fit_never_stops_the_collection(tmp_path: Path) -> None:
    for name in ("good", "other_cameras", "other_state", "lance"):
        write_robocoin(tmp_path / "raw" / name)
    with_features(tmp_path / "raw/other_cameras", lambda features: features.pop(HEAD))
    with_features(tmp_path / "raw/other_state", lambda features: features["observation.state"].update(names=None))
    with_features(tmp_path / "raw/lance", lambda features: None, storage_format="lance")
    arm = {
        "name": "right",
        "state": {"joints": {"feature": "observation.state", "columns": ["right_arm_joint_*_rad"]}},
    }
    declared = source(tmp_path / "raw", **(V21 | {"collection": True, "arms": [arm]}))
    counts, curated = run(tmp_path, declared)
    assert (counts["found"], counts["kept"], counts["quarantined"]) == (4, 1, 3)
    details = {row.episode_id: row.detail for row in curated.quarantine()}
    assert "no camera" in details["raw-other_cameras"]
    assert "no such column" in details["raw-other_state"]
    with pytest.raises(ConfigError, match="no camera"):
        run(tmp_path / "second", declared | {"views": {"observation.images.none": "head"}})


def test_a_camera_that_a_dataset_lacks_is_absent(tmp_path: Path) -> None:
    write_robocoin(tmp_path / "raw")
    views = {HEAD: "head", "observation.images.cam_left_wrist": "left_wrist"}
    declared = source(tmp_path / "raw", **(V21 | {"views": views}))
    with pytest.raises(DataError, match=r"(?s)missing_view.*no such camera.*cam_left_wrist.*cam_left_wrist_rgb"):
        run(tmp_path, declared)
    counts, curated = run(tmp_path / "available", declared, views="available")
    assert counts["kept"] == 1
    assert curated.rows[0].views == ("head",)


def test_all_that_a_configuration_asks_for_in_vain_is_one_message(tmp_path: Path) -> None:
    write_robocoin(tmp_path / "raw")
    wrong = {"views": {"none": "head"}, "grippers": {"finger": {"closed": 0, "open": 1}}, "success_column": "won"}
    with pytest.raises(ConfigError, match=r"(?s)no camera and no state column and no feature .*got: none; finger; won"):
        run(tmp_path, source(tmp_path / "raw", **(V21 | wrong)))


def test_pictures_of_an_unknown_robot_need_no_arms(tmp_path: Path) -> None:
    write_robocoin(tmp_path / "raw")
    counts, curated = run(
        tmp_path, source(tmp_path / "raw", **(V21 | {"embodiment": "none", "angle_unit": "range_m100_100"}))
    )
    assert counts["kept"] == 1
    assert (curated.episode(0).state_kind, curated.episode(0).state.shape) == ("none", (FRAMES, 0))


def cached(raw: Path, root: Path) -> Path:
    """A dataset as the Hub's cache keeps it: links of a snapshot to blobs; returns the snapshot."""
    snapshot, blobs = root / "datasets--a--b/snapshots/0123", root / "datasets--a--b/blobs"
    blobs.mkdir(parents=True)
    for number, file in enumerate(sorted(path for path in raw.rglob("*") if path.is_file())):
        shutil.copy(file, blobs / str(number))
        link = snapshot / file.relative_to(raw)
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(Path(*[".."] * (len(link.relative_to(snapshot).parts) + 1), "blobs", str(number)))
    return snapshot


def test_links_of_the_hubs_cache_are_followed_and_no_others(tmp_path: Path) -> None:
    write_droid(tmp_path / "raw")
    snapshot = cached(tmp_path / "raw", tmp_path / "hub")
    counts, _ = run(tmp_path, source(snapshot))
    assert counts["kept"] == 2
    assert digest_folder(snapshot) == digest_folder(tmp_path / "raw")
    write_robocoin(tmp_path / "old")
    counts, _ = run(tmp_path / "v21", source(cached(tmp_path / "old", tmp_path / "other"), **V21))
    assert counts["kept"] == 1
    # Into the blobs of another repository, beside them, or anywhere else: refused.
    for target in (tmp_path / "other/datasets--a--b/blobs/0", tmp_path / "raw" / DATA):
        (snapshot / DATA).unlink()
        (snapshot / DATA).symlink_to(target)
        with pytest.raises(DataError, match="path_traversal"):
            run(tmp_path / "second", source(snapshot))


@pytest.mark.parametrize("info", [True, False])
def test_all_missing_files_of_version_3_are_said_at_once(tmp_path: Path, info: bool) -> None:
    write_droid(tmp_path / "raw")
    for name in ("data", "videos", "meta/episodes"):
        shutil.rmtree(tmp_path / "raw" / name)
    (tmp_path / "raw/meta/tasks.parquet").unlink()
    if not info:
        (tmp_path / "raw/meta/info.json").unlink()
    said = r"(?s)tasks\.parquet.*meta/episodes.*data/.*videos/observation\.images\.exterior_1_left"
    with pytest.raises(DataError, match=said if info else said.replace("(?s)", r"(?s)info\.json.*")):
        run(tmp_path, source(tmp_path / "raw"))


@pytest.mark.slow
@pytest.mark.timeout(600)  # importing LeRobot alone takes minutes on a busy machine
def test_images_and_stale_file_numbers_as_lerobots_own_class_writes_and_reads_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("HF_DATASETS_CACHE", str(tmp_path / "cache"))
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    key, root = "observation.images.front", tmp_path / "raw"
    names = [f"joint_{i}" for i in range(7)]
    features = {
        key: {"dtype": "image", "shape": (72, 128, 3), "names": ["height", "width", "channels"]},
        "observation.state": {"dtype": "float32", "shape": (7,), "names": names},
        "action": {"dtype": "float32", "shape": (7,), "names": names},
    }
    written: Any = LeRobotDataset.create("local/raw", 15, features, root=root, use_videos=False)
    for number in range(2):
        for frame in range(FRAMES):
            state = wave(7, number)[frame].astype(np.float32)
            written.add_frame(
                {key: picture(number, frame), "observation.state": state, "action": state, "task": f"task {number}"}
            )
        written.save_episode()
    written.finalize()
    for path in (root / "meta/episodes").rglob("*.parquet"):
        table = pq.read_table(path)
        at = table.column_names.index("data/file_index")
        pq.write_table(table.set_column(at, "data/file_index", pa.array([5, 6])), path)
    opened: Any = LeRobotDataset("local/raw", root=root)
    counts, curated = run(tmp_path, source(root, views={key: "head"}))
    assert counts["kept"] == 2
    for number, frame in ((0, 0), (0, FRAMES - 1), (1, 0), (1, 5)):
        item = opened[number * FRAMES + frame]
        assert np.array_equal(curated.episode(number).state[frame], item["observation.state"].numpy())
        assert curated.rows[number].instruction == item["task"]
        shown = (item[key].permute(1, 2, 0).numpy() * 255).round().astype(int)
        assert np.abs(curated.frames(number, "head", [frame])[0].astype(int) - shown).mean() < 6
