"""Which row and which pictures belong to which episode of a LeRobot dataset, where its metadata contradict its files."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.data.curating import run
from tests.data.published_lerobot import FRAMES, picture, wave, write_droid, write_robocoin
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import DataError

DATA = "data/chunk-000/file-000.parquet"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
VIDEO = "videos/observation.images.exterior_1_left"
RATE = 15
V21 = {"kind": "lerobot_v21", "arms": None, "views": {"observation.images.cam_high_rgb": "head"}}


def source(root: Path, **changes: Any) -> dict[str, Any]:
    columns = {"feature": "observation.state", "columns": ["joint_*"]}
    return {
        "kind": "lerobot_v3", "path": str(root), "embodiment": "none", "angle_unit": "rad", "split": "test",
        "views": {"observation.images.exterior_1_left": "head"},
        "arms": [{"name": "right", "state": {"joints": columns}}], **changes,
    }  # fmt: skip


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


@pytest.mark.parametrize(
    ("file", "change", "found"), [(DATA, second_first, 2), (DATA, shuffled, 2), (EPISODES, without_first, 1)]
)
def test_rows_are_found_by_their_numbers(tmp_path: Path, file: str, change: Any, found: int) -> None:
    write_droid(tmp_path / "raw")
    edit(tmp_path / "raw" / file, change)
    counts, curated = run(tmp_path, source(tmp_path / "raw"))
    assert (counts["found"], counts["kept"]) == (found, found)
    assert_paired(curated)


@pytest.mark.parametrize(
    "stale", [{"data__file_index": [0, 7]}, {"data__file_index": [1, 0]}, {"data__chunk_index": [3, 3]}]
)
def test_a_stale_data_file_is_searched_for(tmp_path: Path, stale: dict[str, Any]) -> None:
    write_droid(tmp_path / "raw")
    path = tmp_path / "raw" / DATA
    table = pq.read_table(path)
    pq.write_table(table.slice(0, FRAMES), path)
    pq.write_table(table.slice(FRAMES), path.with_name("file-001.parquet"))
    edit(tmp_path / "raw" / EPISODES, listed(**stale))
    counts, curated = run(tmp_path, source(tmp_path / "raw"))
    assert counts["kept"] == 2
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
    counts, curated = run(tmp_path, source(tmp_path / "raw"), source(tmp_path / "good", **V21))
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
        run(tmp_path, source(tmp_path / "raw", **V21))


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


@pytest.mark.parametrize(
    "tasks",
    [[0] * FRAMES + [7] * FRAMES, [0] * FRAMES + [-1] * FRAMES, [0.0] * FRAMES + [float("nan")] * FRAMES,
     [0] * (2 * FRAMES - 1) + [2]],
)  # fmt: skip
def test_a_task_that_is_not_listed_is_refused(tmp_path: Path, tasks: list[Any]) -> None:
    write_droid(tmp_path / "raw")
    edit(tmp_path / "raw" / DATA, listed(task_index=tasks))
    counts, curated = run(tmp_path, source(tmp_path / "raw"))
    assert (counts["kept"], counts["reasons"]) == (1, {"missing_column": 1})
    assert "Task is not in the list of tasks" in curated.quarantine()[0].detail
    assert curated.rows[0].instruction == "put the pen in the cup"
