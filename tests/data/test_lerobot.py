"""LeRobot datasets whose metadata contradict their files, and datasets that are good but unusual."""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image

from tests.data.curating import reasons, run
from tests.data.published_lerobot import FRAMES, picture, wave, write_droid, write_robocoin
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.sources.lerobot import flat_names
from worldline_core.errors import ConfigError, DataError
from worldline_core.store.artifact_files import digest_folder

DATA = "data/chunk-000/file-000.parquet"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
VIDEO = "videos/observation.images.exterior_1_left"
RATE = 15
HEAD = "observation.images.cam_high_rgb"


def source(root: Path, **changes: Any) -> dict[str, Any]:
    columns = {"feature": "observation.state", "columns": ["joint_*"]}
    return {
        "kind": "lerobot_v3", "path": str(root), "embodiment": "none", "angle_unit": "rad", "split": "test",
        "views": {"observation.images.exterior_1_left": "head"},
        "arms": [{"name": "right", "state": {"joints": columns}}], **changes,
    }  # fmt: skip


def v21(root: Path, **changes: Any) -> dict[str, Any]:
    return source(root, **{"kind": "lerobot_v21", "arms": None, "views": {HEAD: "head"}, **changes})


def edit(path: Path, change: Callable[[pa.Table], pa.Table]) -> None:
    pq.write_table(change(pq.read_table(path)), path)


def with_values(table: pa.Table, **columns: Any) -> pa.Table:
    for name, values in columns.items():
        at = table.column_names.index(name)
        table = table.set_column(at, name, pa.array(values))
    return table


def listed(**columns: Any) -> Callable[[pa.Table], pa.Table]:
    named = {name.replace("__", "/"): values for name, values in columns.items()}
    return lambda table: with_values(table, **named)


def assert_paired(curated: EpisodeSet) -> None:
    """The states and the pictures of every episode are those that were written under its number."""
    for position, row in enumerate(curated.rows):
        if not row.episode_id.startswith("raw-"):
            continue
        number = int(row.episode_id.rsplit("-", 1)[1])
        assert np.allclose(curated.episode(position).state, wave(8, number)[:, :7], atol=1e-6)
        for frame in (0, FRAMES - 1):
            shown = curated.frames(position, "head", [frame])[0].astype(int)
            assert np.abs(shown - picture(number + 1, frame)).mean() < 6  # its camera has the seeds 1 and 2


def without_first(table: pa.Table) -> pa.Table:
    return table.filter(pa.array(np.asarray(table["episode_index"]) != 0))


def second_first(table: pa.Table) -> pa.Table:
    return pa.concat_tables([table.slice(FRAMES), table.slice(0, FRAMES)])


def shuffled(table: pa.Table) -> pa.Table:
    return table.take(pa.array(np.random.default_rng(0).permutation(len(table))))


def in_two_files(**stale: Any) -> Callable[[Path], None]:
    """The second episode's rows in a file of their own, which the list does not name as it should."""

    def change(root: Path) -> None:
        table = pq.read_table(root / DATA)
        pq.write_table(table.slice(0, FRAMES), root / DATA)
        pq.write_table(table.slice(FRAMES), (root / DATA).with_name("file-001.parquet"))
        edit(root / EPISODES, listed(**stale))

    return change


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (lambda root: edit(root / DATA, second_first), 2),
        (lambda root: edit(root / DATA, shuffled), 2),
        (lambda root: edit(root / EPISODES, without_first), 1),
        (in_two_files(data__file_index=[0, 7]), 2),
        (in_two_files(data__file_index=[1, 0]), 2),
        (in_two_files(data__chunk_index=[3, 3]), 2),
    ],
)
def test_rows_are_found_by_their_numbers_in_whatever_file(tmp_path: Path, change: Any, found: int) -> None:
    write_droid(tmp_path / "raw")
    change(tmp_path / "raw")
    counts, curated = run(tmp_path, source(tmp_path / "raw"))
    assert (counts["found"], counts["kept"]) == (found, found)
    assert_paired(curated)


@pytest.mark.parametrize(
    ("file", "change", "said"),
    [
        (EPISODES, listed(dataset_from_index=[0, 0], dataset_to_index=[FRAMES, FRAMES]), "expected: index 0"),
        (EPISODES, listed(dataset_from_index=[FRAMES, 0], dataset_to_index=[2 * FRAMES, FRAMES]), "index 12"),
        (EPISODES, listed(dataset_to_index=[FRAMES, 2 * FRAMES - 1]), "dataset_to_index"),
        (DATA, listed(episode_index=[1] * FRAMES + [0] * FRAMES), "contradict"),
        (DATA, listed(index=[0] * 2 * FRAMES), "index"),
        (DATA, listed(frame_index=np.r_[1 : FRAMES + 1, 0:FRAMES]), "frame_index 0 in its row 0"),
        (DATA, listed(timestamp=np.r_[0:FRAMES, 3 : FRAMES + 3] / RATE), "timestamp 0 in its first row"),
    ],
)
def test_rows_that_contradict_the_episode_list_are_refused(tmp_path: Path, file: str, change: Any, said: str) -> None:
    write_droid(tmp_path / "raw")
    edit(tmp_path / "raw" / file, change)
    write_robocoin(tmp_path / "good")  # whose episode is kept
    counts, curated = run(tmp_path, source(tmp_path / "raw"), v21(tmp_path / "good"))
    assert set(counts["reasons"]) == {"length_mismatch"}
    assert said in curated.quarantine()[0].detail
    assert_paired(curated)


def test_a_file_of_another_episode_is_refused_in_v21(tmp_path: Path) -> None:
    write_robocoin(tmp_path / "raw", episodes=3)
    first, second, third = (tmp_path / f"raw/data/chunk-000/episode_{i:06d}.parquet" for i in range(3))
    contents = second.read_bytes(), first.read_bytes()
    for path, content in zip((first, second), contents, strict=True):
        path.write_bytes(content)
    edit(third, lambda table: table.take(pa.array([1, 0, *range(2, FRAMES)])))
    with pytest.raises(DataError, match=r"(?s)3 quarantined.*expected: episode_index 0.*got: episode_index 1"):
        run(tmp_path, v21(tmp_path / "raw"))


def window(start: tuple[float, float], stop: tuple[float, float]) -> Callable[[pa.Table], pa.Table]:
    times = {f"{VIDEO}/from_timestamp": np.divide(start, RATE), f"{VIDEO}/to_timestamp": np.divide(stop, RATE)}
    return lambda table: with_values(table, **times)


@pytest.mark.parametrize(
    ("change", "reason", "said"),
    [
        (window((0, 11), (12, 24)), "length_mismatch", "got: 13 frames"),
        (window((0, 13), (12, 24)), "length_mismatch", "got: 11 frames"),
        (window((0, 12), (12, 20)), "length_mismatch", "got: 8 frames"),
        (window((0, 12.4), (12, 24.4)), "wrong_fps", "start of the window"),
        (window((0, 11.7), (12, 23.7)), "wrong_fps", "0.30 of a frame late"),
        (window((0, 13), (12, 25)), "truncated_video", "11 frames"),
    ],
)
def test_a_video_window_that_does_not_fit_is_named(tmp_path: Path, change: Any, reason: str, said: str) -> None:
    write_droid(tmp_path / "raw")
    edit(tmp_path / "raw" / EPISODES, change)
    counts, curated = run(tmp_path, source(tmp_path / "raw"))
    assert_paired(curated)
    detail = curated.quarantine()[0].detail
    assert (counts["kept"], counts["reasons"]) == (1, {reason: 1}), detail
    assert said in detail


def test_windows_that_share_pictures_and_a_rate_that_the_video_leaves_are_refused(tmp_path: Path) -> None:
    write_droid(tmp_path / "raw")
    whole = (tmp_path / "raw" / EPISODES).read_bytes()
    edit(tmp_path / "raw" / EPISODES, window((1, 12), (13, 24)))
    with pytest.raises(DataError, match=r"(?s)2 quarantined.*windows of two episodes overlap.*and episode 1"):
        run(tmp_path, source(tmp_path / "raw"))
    (tmp_path / "raw" / EPISODES).write_bytes(whole)
    info = tmp_path / "raw/meta/info.json"
    info.write_text(json.dumps(json.loads(info.read_text()) | {"fps": 16}))
    with pytest.raises(DataError, match=r"(?s)2 quarantined.*fps"):
        run(tmp_path / "second", source(tmp_path / "raw"))


def png(image: np.ndarray, kind: str = "PNG") -> bytes:
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, kind)
    return stream.getvalue()


def with_info(root: Path, change: Callable[[Any], object] = lambda features: None, **keys: Any) -> None:
    path = root / "meta/info.json"
    info = json.loads(path.read_text())
    change(info["features"])
    path.write_text(json.dumps({**info, **keys}))


def as_images(root: Path, key: str, data: str, images: list[Any]) -> None:
    """A camera's pictures in the table, as LeRobot stores them with `use_videos=False`."""
    with_info(root, lambda features: features[key].update(dtype="image"))
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
    counts, curated = run(tmp_path, v21(tmp_path / "raw"))
    assert (counts["kept"], reasons(curated)) == (2, {"raw-000002": "missing_file", "raw-000003": "unreadable"})
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


def test_declared_units_and_what_single_episodes_lack(tmp_path: Path) -> None:
    raw = tmp_path / "raw"
    state = write_robocoin(raw, episodes=3)
    (raw / "data/chunk-000/episode_000001.parquet").unlink()
    edit(raw / "data/chunk-000/episode_000002.parquet", lambda table: table.slice(0, FRAMES - 1))
    grippers = {f"{arm}_gripper_open_scale": {"closed": 0.1, "open": 0.8} for arm in ("left", "right")}
    _, curated = run(tmp_path, v21(raw, angle_unit="deg", grippers=grippers))
    assert reasons(curated) == {"raw-000001": "missing_file", "raw-000002": "length_mismatch"}
    opening, episode = (state[:, 6] - 0.1) / 0.7, curated.episode(0)
    assert np.allclose(episode.state[:, :6], np.deg2rad(state[:, :6]), atol=1e-6)
    assert np.allclose(episode.state[:, 6], opening.clip(0, 1), atol=1e-6)
    # Both grippers open alike, in states and in actions.
    assert episode.conventions["gripper_overshoot"] == 4 * ((opening < 0) | (opening > 1)).sum()
    with pytest.raises(ValueError, match="angle_unit"):
        run(tmp_path, v21(raw, angle_unit=None))


def test_byte_order_marks_numbers_with_a_fraction_of_zero_and_version_2_0(tmp_path: Path) -> None:
    root = tmp_path / "raw"
    write_robocoin(root, episodes=2)
    with_info(root, chunks_size=1000.0, codebase_version="v2.0")
    listed = [{"episode_index": float(i), "tasks": ["push"], "length": float(FRAMES)} for i in range(2)]
    (root / "meta/episodes.jsonl").write_text("\n".join(map(json.dumps, listed)))
    for name in ("info.json", "tasks.jsonl", "episodes.jsonl"):
        path = root / "meta" / name
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    counts, curated = run(tmp_path, v21(root))
    assert counts["kept"] == 2
    assert curated.rows[0].instruction == "move the bread"
    assert curated.episode(0).conventions["layout"] == "lerobot v2.0"


@pytest.mark.parametrize("line", ["null", '{"episode_index": true}', '{"episode_index": 1e400}'])
def test_a_line_that_is_no_episode_is_one_message(tmp_path: Path, line: str) -> None:
    """Arrow's reader of JSON crashes on some of them."""
    write_robocoin(tmp_path / "raw", episodes=2)
    with (tmp_path / "raw/meta/episodes.jsonl").open("a") as file:
        file.write(f"\n{line}\n")
    with pytest.raises(DataError, match=r"numbers no episodes[\s\S]*episodes\.jsonl"):
        run(tmp_path, v21(tmp_path / "raw"))


@pytest.mark.parametrize(
    "tasks",
    [*([index] * FRAMES for index in (-1.0, float("nan"), None, 0.5)), [0] * (FRAMES - 1) + [2]],
)
def test_a_task_that_is_not_listed_costs_its_episode(tmp_path: Path, tasks: list[Any]) -> None:
    write_droid(tmp_path / "raw")
    edit(tmp_path / "raw" / DATA, listed(task_index=[0 if tasks[0] == 0 else 0.0] * FRAMES + tasks))
    counts, curated = run(tmp_path, source(tmp_path / "raw"))
    assert (counts["kept"], set(counts["reasons"]) <= {"missing_column", "nan_state"}) == (1, True)
    assert curated.rows[0].instruction == "put the pen in the cup"


def test_lengths_in_version_3_may_be_floats_but_no_fractions(tmp_path: Path) -> None:
    write_droid(tmp_path / "raw")
    edit(tmp_path / "raw" / EPISODES, listed(length=[float(FRAMES), FRAMES + 0.5]))
    counts, curated = run(tmp_path, source(tmp_path / "raw"))
    assert (counts["kept"], counts["reasons"]) == (1, {"unreadable": 1})
    assert "a whole number" in curated.quarantine()[0].detail


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"codebase_version": "v1.6"}, r"got: v1\.6.*next step: convert"),
        ({"codebase_version": "v3.0"}, r"got: v3\.0.*next step: set kind: lerobot_v3"),
        ({"storage_format": "lance"}, r"storage_format: parquet.*got: lance.*next step: export"),
        ({"codebase_version": "v4.0"}, r"expected: v2\.1.*got: v4\.0"),
    ],
)
def test_other_formats_name_the_next_step(tmp_path: Path, keys: dict[str, Any], said: str) -> None:
    write_robocoin(tmp_path / "raw")
    with_info(tmp_path / "raw", **keys)
    with pytest.raises(DataError, match=f"(?s){said}"):
        run(tmp_path, v21(tmp_path / "raw"))


def test_a_dataset_that_does_not_fit_never_stops_the_collection(tmp_path: Path) -> None:
    for name in ("good", "other_cameras", "other_state", "lance"):
        write_robocoin(tmp_path / "raw" / name)
    with_info(tmp_path / "raw/other_cameras", lambda features: features.pop(HEAD))
    with_info(tmp_path / "raw/other_state", lambda features: features["observation.state"].update(names=None))
    with_info(tmp_path / "raw/lance", storage_format="lance")
    joints = {"feature": "observation.state", "columns": ["right_arm_joint_*_rad"]}
    declared = v21(tmp_path / "raw", collection=True, arms=[{"name": "right", "state": {"joints": joints}}])
    counts, curated = run(tmp_path, declared)
    assert (counts["kept"], counts["quarantined"]) == (1, 3)
    details = {row.episode_id: row.detail for row in curated.quarantine()}
    assert "no camera" in details["raw-other_cameras"]
    assert "no such column" in details["raw-other_state"]
    with pytest.raises(ConfigError, match="no camera"):
        run(tmp_path / "second", declared | {"views": {"observation.images.none": "head"}})


def test_a_camera_that_a_dataset_lacks_is_absent(tmp_path: Path) -> None:
    write_robocoin(tmp_path / "raw")
    declared = v21(tmp_path / "raw", views={HEAD: "head", "observation.images.cam_left_wrist": "left_wrist"})
    with pytest.raises(DataError, match=r"(?s)missing_view.*no such camera.*cam_left_wrist.*cam_left_wrist_rgb"):
        run(tmp_path, declared)
    _, curated = run(tmp_path / "available", declared, views="available")
    assert curated.rows[0].views == ("head",)
    wrong = {"views": {"none": "head"}, "grippers": {"finger": {"closed": 0, "open": 1}}, "success_column": "won"}
    with pytest.raises(ConfigError, match=r"(?s)no camera and no state column and no feature .*got: none; finger; won"):
        run(tmp_path, v21(tmp_path / "raw", **wrong))


def test_pictures_of_an_unknown_robot_need_no_arms(tmp_path: Path) -> None:
    write_robocoin(tmp_path / "raw")
    _, curated = run(tmp_path, v21(tmp_path / "raw", embodiment="none", angle_unit="range_m100_100"))
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
    counts, _ = run(tmp_path / "v21", v21(cached(tmp_path / "old", tmp_path / "other")))
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
