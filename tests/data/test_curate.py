from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from tests.data.conftest import make_sample
from tests.data.curating import reasons, record, run
from tools.corrupted import droid_annotation
from tools.corrupted.content import NUM_FRAMES
from worldline_core.data.curation.curate import curate
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.episodes.episode import Episode
from worldline_core.data.episodes.episode_index import write_index
from worldline_core.data.episodes.episode_set import EpisodeSet, EpisodeSetWriter
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.errors import DataError
from worldline_core.geometry.cameras import ImageTransform

SMALL: dict[str, Any] = {"image_size": (16, 24), "fps": 8}


def own(root: Path) -> dict[str, Any]:
    return {"kind": "episode_set", "path": str(root)}


def test_labels_of_things_are_stored_and_follow_a_resize(tmp_path: Path) -> None:
    episode, frames, masks = make_sample(0)
    labels = np.zeros((9, 32, 48), np.uint8)
    labels[:, 4:8, 6:10] = 1
    labels[:, 20:22, 30:34] = 3
    labels[:, 0, 0] = 2
    with EpisodeSetWriter(tmp_path / "raw") as writer:
        writer.add(episode, frames, masks, thing_labels={"head": labels})
    recorded = EpisodeSet.open(tmp_path / "raw")
    stored = recorded.thing_labels(0, "head")
    assert stored is not None
    assert np.array_equal(stored, labels)
    assert recorded.thing_labels(0, "left_wrist") is None
    small = run(tmp_path, own(tmp_path / "raw"), **SMALL)[1].thing_labels(0, "head")
    expected = np.zeros((9, 16, 24), np.uint8)
    expected[:, 2:4, 3:5] = 1
    expected[:, 10, 15:17] = 3
    assert small is not None
    assert np.array_equal(small, expected)  # a quarter of the first pixel is less than half of it


def test_kept_episodes_are_resized_and_calibration_follows(tmp_path: Path) -> None:
    samples = [make_sample(number) for number in range(2)]
    counts, curated = run(tmp_path, own(record(tmp_path / "raw", samples)), **SMALL)
    assert (counts["found"], counts["kept"], counts["quarantined"], counts["reasons"]) == (2, 2, 0, {})
    episode = curated.episode(0)
    assert curated.frames(0, "left_wrist").shape == (9, 16, 24, 3)
    recorded, (height, width) = samples[0][0].cameras["left_wrist"], samples[0][2]["head"].shape[1:]
    a, b = 24 / width, 16 / height
    to_small = np.array([[a, 0, (a - 1) / 2], [0, b, (b - 1) / 2], [0, 0, 1]])  # pixel centres are whole numbers
    assert np.allclose(episode.cameras["left_wrist"].K, to_small @ recorded.K)
    assert np.array_equal(episode.cameras["left_wrist"].T_base_camera, recorded.T_base_camera)
    mask = curated.robot_masks(0, "head")
    assert mask is not None
    head = samples[0][2]["head"]
    assert np.array_equal(mask, ImageTransform.of(head.shape[1:]).resize((16, 24)).masks(head))
    assert str(tmp_path) not in json.dumps([row.__dict__ for row in curated.rows])


def test_inputs_override_configured_paths(tmp_path: Path) -> None:
    raw = record(tmp_path / "raw", [make_sample(0)])
    config = CurateConfig.model_validate({"sources": [own(tmp_path / "elsewhere")]})
    assert curate(config, {"source.0": raw}, tmp_path / "out")["kept"] == 1
    with pytest.raises(DataError, match="Source folder is missing"):
        curate(config, {}, tmp_path / "out2")


def with_head(episode: Episode, **changes: Any) -> Episode:
    return replace(episode, cameras={**episode.cameras, "head": replace(episode.cameras["head"], **changes)})


def test_bad_values_are_quarantined_and_the_rest_goes_on(tmp_path: Path) -> None:
    samples = [make_sample(number, **({"fps": 5.0} if number == 6 else {})) for number in range(9)]
    episodes = [episode for episode, *_ in samples]
    episodes[1].state[4, 2] = np.nan
    episodes[2].state[3, 1] = 9.0
    episodes[3].state[:, :6] *= 200  # degrees
    episodes[4] = with_head(episodes[4], K=np.array([[40.0, 0, 20], [0, 0, 10], [0, 0, 1]]))
    sheared = episodes[5].cameras["head"].T_base_camera.copy()
    sheared[0, 0, 1] = 0.3
    episodes[5] = with_head(episodes[5], T_base_camera=sheared)
    episodes[7].state[:, 6] = 6.0
    raw = record(tmp_path / "raw", [(e, *rest) for e, (_, *rest) in zip(episodes, samples, strict=True)])
    counts, curated = run(tmp_path, own(raw), **SMALL)
    assert (counts["found"], counts["kept"], counts["quarantined"]) == (9, 2, 7)
    rows = {row.episode_id: row for row in curated.quarantine()}
    expected = (
        "nan_state",
        *["joint_out_of_range"] * 2,
        "singular_intrinsics",
        "invalid_extrinsics",
        "wrong_fps",
        "invalid_gripper",
    )
    assert reasons(curated) == {f"episode-00{n}": reason for n, reason in enumerate(expected, 1)}
    assert rows["episode-001"].numbers == {"track": "state", "first_frame": 4, "values": 1}
    assert rows["episode-002"].numbers["position_rad"] == pytest.approx(9.0)
    assert rows["episode-006"].numbers == {"wanted_fps": 8.0, "recorded_fps": 5.0}


def test_a_truncated_video_costs_only_its_own_episodes(tmp_path: Path) -> None:
    raw = record(tmp_path / "raw", [make_sample(number, num_frames=40) for number in range(4)])
    video = raw / "datasets/ur5e_pair/videos/observation.images.head/chunk-000/file-000.mp4"
    content = video.read_bytes()
    video.write_bytes(content[: int(len(content) * 0.7)])
    counts, curated = run(tmp_path, own(raw), **SMALL)
    assert (counts["found"], counts["reasons"]) == (4, {"truncated_video": counts["quarantined"]})
    assert 1 <= counts["kept"] <= 2
    (row, *_) = curated.quarantine()
    assert "file-000.mp4" in row.detail
    assert str(tmp_path) not in row.detail
    assert row.numbers["expected_frames"] == 40
    assert row.numbers["decoded_frames"] < 40


def test_missing_columns_missing_files_and_robots_without_a_description(tmp_path: Path) -> None:
    """A robot is refused where a name is given, and for Stage I alone where the recording says `none`."""
    still = np.zeros((9, 16), np.float32)
    raw = record(tmp_path / "raw", [
        make_sample(0),
        make_sample(1, embodiment="xarm7_pair", state=still, action=still, state_names=None),
        make_sample(2, embodiment="none"),
        make_sample(3, embodiment="none", views=("head",)),
        make_sample(4, embodiment="ur5e_pairs"),
    ])  # fmt: skip
    data = raw / "datasets/xarm7_pair/data/chunk-000/file-000.parquet"
    pq.write_table(pq.read_table(data).drop_columns(["action"]), data)
    (raw / "datasets/none/videos/observation.images.left_wrist/chunk-000/file-000.mp4").unlink()
    _, curated = run(tmp_path, own(raw), **SMALL)
    assert [(row.stage1_ok, row.stage2_reason) for row in curated.rows] == [(True, None), (True, "missing_kinematics")]
    rows = {row.episode_id: row for row in curated.quarantine()}
    assert reasons(curated) == {
        "episode-001": "missing_column", "episode-002": "missing_file", "episode-004": "unknown_embodiment",
    }  # fmt: skip
    assert "action" in rows["episode-001"].detail
    assert "did you mean 'ur5e_pair'?" in rows["episode-004"].detail


def test_a_scene_in_training_and_in_test_is_an_error(tmp_path: Path) -> None:
    samples = [make_sample(0, scene="kitchen"), make_sample(1, scene="kitchen", split="test")]
    raw = record(tmp_path / "raw", samples)
    with pytest.raises(DataError, match=r"(?s)both in train and in test.*kitchen"):
        run(tmp_path, own(raw), **SMALL)
    assert run(tmp_path / "second", own(raw), **SMALL, splits={"kit*": "test"})[0]["splits"] == {"test": 2}


def test_a_multiple_of_the_rate_is_thinned(tmp_path: Path) -> None:
    episode, frames, masks = make_sample(0)
    doubled = replace(episode, fps=16.0, timestamps=episode.timestamps / 2)
    raw = record(tmp_path / "raw", [(doubled, frames, masks)])
    _, curated = run(tmp_path, own(raw), **SMALL)
    read = curated.episode(0)
    assert read.fps == 8.0
    assert np.array_equal(read.state, episode.state[::2])
    wrist = episode.cameras["left_wrist"].T_base_camera
    assert np.array_equal(read.cameras["left_wrist"].T_base_camera, wrist[::2])
    assert curated.frames(0, "head").shape[0] == 5


def test_views_and_calibration_can_be_demanded(tmp_path: Path) -> None:
    episode, *pictures = make_sample(2)
    uncalibrated = replace(episode, cameras={"head": episode.cameras["head"]})
    raw = record(tmp_path / "raw", [make_sample(0), make_sample(1, views=("head",)), (uncalibrated, *pictures)])
    _, curated = run(tmp_path, own(raw), **SMALL, views=("head", "left_wrist"), require_calibration=True)
    assert reasons(curated) == {"episode-001": "missing_view", "episode-002": "missing_calibration"}
    assert curated.rows[0].views == ("head", "left_wrist")
    # Any views, one camera at least.
    assert all(row.stage2_ok for row in run(tmp_path / "all", own(raw), **SMALL)[1].rows)


@pytest.mark.parametrize("index_too", [False, True])
def test_half_the_rate_in_the_metadata_of_a_set_is_a_wrong_rate(tmp_path: Path, index_too: bool) -> None:
    """Without the check every second frame would be taken, those of the next episode among them."""
    raw = record(tmp_path / "raw", [make_sample(0), make_sample(1)])
    info = raw / "datasets/ur5e_pair/meta/info.json"
    info.write_text(json.dumps(json.loads(info.read_text()) | {"fps": 4}))
    if index_too:
        write_index(raw, [replace(row, fps=4.0) for row in EpisodeSet.open(raw).rows])
    with pytest.raises(DataError, match="2 wrong_fps"):
        run(tmp_path, own(raw), image_size=(16, 24))
    if not index_too:
        with pytest.raises(RejectedInputError, match="another frame rate"):
            EpisodeSet.open(raw).episode(0)


def test_states_and_videos_of_different_length(tmp_path: Path) -> None:
    """DROID's annotations: the second recording lacks one state, the third two, which is not what stopping leaves."""
    _, source = droid_annotation.write(tmp_path / "droid", 3, 0, np.random.default_rng(0))
    for path, lacking in zip(sorted((tmp_path / "droid/annotation/val").iterdir()), (0, 1, 2), strict=True):
        content = json.loads(path.read_text())
        content |= {name: content[name][: NUM_FRAMES - lacking] for name in ("states", "joints")}
        content["states"][0][6] = content["joints"][0][7] = 1.02
        path.write_text(json.dumps(content))
    counts, curated = run(tmp_path / "trimmed", source, trim="common")
    assert (counts["kept"], counts["trimmed"], counts["reasons"]) == (2, 1, {"length_mismatch": 1})
    whole, cut = curated.episode(0), curated.episode(1)
    assert (whole.num_frames, cut.num_frames, "trimmed" in whole.conventions) == (NUM_FRAMES, NUM_FRAMES - 1, False)
    counted = f"states {NUM_FRAMES - 1}, head {NUM_FRAMES}"
    assert cut.conventions["trimmed"] == f"the first {NUM_FRAMES - 1} frames of {counted}"
    assert whole.state[0, 7] == 0.0  # 1 is closed in the source, 0 here
    assert whole.conventions["gripper_overshoot"] == 1
    assert curated.rows[0].stage2_reason == "missing_calibration"
    counts, curated = run(tmp_path, source)
    assert (counts["kept"], counts["reasons"]) == (1, {"length_mismatch": 2})
    assert curated.quarantine()[0].numbers == {"states": NUM_FRAMES - 1, "frames": NUM_FRAMES}
