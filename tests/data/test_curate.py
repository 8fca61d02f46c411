from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from worldline_core.data.curation.curate import curate
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.episodes.episode_index import read_index, read_quarantine, write_index
from worldline_core.data.episodes.episode_set import EpisodeSet, EpisodeSetWriter
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.video.encoder import encode_video
from worldline_core.errors import DataError
from worldline_core.geometry.cameras import ImageTransform
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematic_tree import read_tree, tool_poses
from worldline_core.geometry.transforms import euler_fixed_xyz_from_rotation

Make = Callable[..., tuple]


def record(root: Path, samples: list[tuple]) -> Path:
    with EpisodeSetWriter(root, video_crf=8) as writer:
        for episode, frames, masks in samples:
            writer.add(episode, frames, masks)
    return root


def config(*sources: Path, **changes: Any) -> CurateConfig:
    listed = [{"kind": "episode_set", "path": str(path)} for path in sources]
    return CurateConfig.model_validate({"sources": listed, "image_size": (16, 24), "fps": 8, **changes})


def files_of(root: Path) -> dict[str, bytes]:
    return {
        str(p.relative_to(root)): p.read_bytes()
        for p in sorted(root.rglob("*"))
        if p.is_file() and p.relative_to(root).parts[0] != "run"
    }


def reasons_of(root: Path) -> dict[str, str]:
    return {row.episode_id: row.reason for row in EpisodeSet.open(root).quarantine()}


def test_labels_of_things_are_stored_and_follow_a_resize(tmp_path: Path, sample: Make) -> None:
    episode, frames, masks = sample(0)
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
    curate(config(tmp_path / "raw"), {}, tmp_path / "out")
    small = EpisodeSet.open(tmp_path / "out").thing_labels(0, "head")
    expected = np.zeros((9, 16, 24), np.uint8)
    expected[:, 2:4, 3:5] = 1
    expected[:, 10, 15:17] = 3
    # A quarter of the first pixel is less than half of it.
    assert small is not None
    assert np.array_equal(small, expected)


def test_kept_episodes_are_resized_and_calibration_follows(tmp_path: Path, sample: Make) -> None:
    samples = [sample(number) for number in range(2)]
    counts = curate(config(record(tmp_path / "raw", samples)), {}, tmp_path / "out")
    assert (counts["found"], counts["kept"], counts["quarantined"], counts["reasons"]) == (2, 2, 0, {})
    curated = EpisodeSet.open(tmp_path / "out")
    episode = curated.episode(0)
    assert curated.frames(0, "left_wrist").shape == (9, 16, 24, 3)
    expected = samples[0][0].cameras["left_wrist"].resized(24, 16)
    assert np.allclose(episode.cameras["left_wrist"].K, expected.K)
    assert np.array_equal(episode.cameras["left_wrist"].T_base_camera, expected.T_base_camera)
    mask = curated.robot_masks(0, "head")
    assert mask is not None
    head = samples[0][2]["head"]
    assert np.array_equal(mask, ImageTransform.of(head.shape[1:]).resize((16, 24)).masks(head))
    assert str(tmp_path) not in json.dumps([row.__dict__ for row in curated.rows])


def test_inputs_override_configured_paths(tmp_path: Path, sample: Make) -> None:
    raw = record(tmp_path / "raw", [sample(0)])
    assert curate(config(tmp_path / "elsewhere"), {"source.0": raw}, tmp_path / "out")["kept"] == 1
    with pytest.raises(DataError, match="Source folder is missing"):
        curate(config(tmp_path / "elsewhere"), {}, tmp_path / "out2")


def test_bad_values_are_quarantined_and_the_rest_goes_on(tmp_path: Path, sample: Make) -> None:
    nan = sample(1)
    nan[0].state[4, 2] = np.nan
    far = sample(2)
    far[0].state[3, 1] = 9.0
    degrees = sample(3)
    degrees[0].state[:, :6] *= 200
    K = np.array([[40.0, 0, 20], [0, 0, 10], [0, 0, 1]])
    base = sample(4)
    singular = (
        replace(base[0], cameras={**base[0].cameras, "head": replace(base[0].cameras["head"], K=K)}),
        *base[1:],
    )
    base = sample(5)
    sheared = base[0].cameras["head"].T_base_camera.copy()
    sheared[0, 0, 1] = 0.3
    skewed = (
        replace(base[0], cameras={**base[0].cameras, "head": replace(base[0].cameras["head"], T_base_camera=sheared)}),
        *base[1:],
    )
    slow = sample(6, fps=5.0)
    gripper = sample(7)
    gripper[0].state[:, 6] = 60.0 / 10
    raw = record(tmp_path / "raw", [sample(0), nan, far, degrees, singular, skewed, slow, gripper, sample(8)])
    counts = curate(config(raw), {}, tmp_path / "out")
    assert counts["found"] == 9
    assert counts["kept"] == 2
    assert counts["kept"] + counts["quarantined"] == counts["found"]
    assert reasons_of(tmp_path / "out") == {
        "episode-001": "nan_state",
        "episode-002": "joint_out_of_range",
        "episode-003": "joint_out_of_range",
        "episode-004": "singular_intrinsics",
        "episode-005": "invalid_extrinsics",
        "episode-006": "wrong_fps",
        "episode-007": "invalid_gripper",
    }
    rows = {row.episode_id: row for row in EpisodeSet.open(tmp_path / "out").quarantine()}
    assert rows["episode-001"].numbers == {"track": "state", "first_frame": 4, "values": 1}
    assert rows["episode-002"].numbers["position_rad"] == pytest.approx(9.0)
    assert rows["episode-006"].numbers == {"wanted_fps": 8.0, "recorded_fps": 5.0}


def test_a_truncated_video_costs_only_its_own_episodes(tmp_path: Path, sample: Make) -> None:
    raw = record(tmp_path / "raw", [sample(number, num_frames=40) for number in range(4)])
    video = raw / "datasets/ur5e_pair/videos/observation.images.head/chunk-000/file-000.mp4"
    content = video.read_bytes()
    video.write_bytes(content[: int(len(content) * 0.7)])
    counts = curate(config(raw), {}, tmp_path / "out")
    assert counts["reasons"] == {"truncated_video": counts["quarantined"]}
    assert 1 <= counts["kept"] <= 2
    assert counts["kept"] + counts["quarantined"] == counts["found"] == 4
    (row, *_) = EpisodeSet.open(tmp_path / "out").quarantine()
    assert "file-000.mp4" in row.detail
    assert str(tmp_path) not in row.detail
    assert row.numbers["expected_frames"] == 40
    assert row.numbers["decoded_frames"] < 40


def test_a_missing_column_and_a_missing_file(tmp_path: Path, sample: Make) -> None:
    samples = [
        sample(0),
        sample(
            1,
            embodiment="xarm7_pair",
            state=np.zeros((9, 16), np.float32),
            action=np.zeros((9, 16), np.float32),
            state_names=None,
        ),
        sample(2, embodiment="none"),
    ]
    raw = record(tmp_path / "raw", samples)
    data = raw / "datasets/xarm7_pair/data/chunk-000/file-000.parquet"
    pq.write_table(pq.read_table(data).drop_columns(["action"]), data)
    (raw / "datasets/none/videos/observation.images.left_wrist/chunk-000/file-000.mp4").unlink()
    counts = curate(config(raw), {}, tmp_path / "out")
    assert (counts["found"], counts["kept"]) == (3, 1)
    assert reasons_of(tmp_path / "out") == {"episode-001": "missing_column", "episode-002": "missing_file"}
    detail = EpisodeSet.open(tmp_path / "out").quarantine()[0].detail
    assert "action" in detail


def test_robots_that_nobody_describes(tmp_path: Path, sample: Make) -> None:
    """Refused where a name is given, for Stage I where the recording says `none`."""
    raw = record(tmp_path / "raw", [sample(0), sample(1, embodiment="ur5e_pairs"), sample(2, embodiment="none")])
    counts = curate(config(raw), {}, tmp_path / "out")
    assert counts["reasons"] == {"unknown_embodiment": 1}
    curated = EpisodeSet.open(tmp_path / "out")
    (refused,) = curated.quarantine()
    assert refused.episode_id == "episode-001"
    assert "did you mean 'ur5e_pair'?" in refused.detail
    assert [(row.stage1_ok, row.stage2_reason) for row in curated.rows] == [(True, None), (True, "missing_kinematics")]


def test_an_escaping_path_in_the_metadata_is_refused(tmp_path: Path, sample: Make) -> None:
    raw = record(tmp_path / "raw", [sample(0), sample(1, embodiment="none")])
    path = raw / "datasets/none/meta/info.json"
    info = json.loads(path.read_text())
    info["video_path"] = "../../../{video_key}/file-{file_index:03d}.mp4"
    path.write_text(json.dumps(info))
    curate(config(raw), {}, tmp_path / "out")
    assert reasons_of(tmp_path / "out") == {"episode-001": "path_traversal"}
    rows = read_index(raw)
    write_index(raw, [replace(rows[0], dataset="../../elsewhere"), rows[1]])
    info["video_path"] = "{video_key.__class__}/x.mp4"
    path.write_text(json.dumps(info))
    said = (
        r"(?s)No episode was kept.*out2/quarantine\.parquet.*2 quarantined \(2 path_traversal\).*the first, episode-000"
    )
    with pytest.raises(DataError, match=said):
        curate(config(raw), {}, tmp_path / "out2")
    assert len(read_quarantine(tmp_path / "out2")) == 2  # where a user looks first, though there is no set


def test_equal_content_is_kept_once(tmp_path: Path, sample: Make) -> None:
    copy = sample(0)
    raw = record(tmp_path / "raw", [sample(0), (replace(copy[0], episode_id="again"), *copy[1:]), sample(1)])
    other = record(tmp_path / "other", [sample(1)])
    counts = curate(config(raw, other), {}, tmp_path / "out")
    assert counts["found"] == 4
    assert counts["kept"] + counts["quarantined"] == 4
    reasons = reasons_of(tmp_path / "out")
    assert reasons == {"episode-000": "duplicate", "episode-001#source.1": "duplicate_id"}
    assert counts["reasons"] == {"duplicate": 1, "duplicate_id": 1}


def test_a_scene_in_training_and_in_test_is_an_error(tmp_path: Path, sample: Make) -> None:
    samples = [sample(0, scene="kitchen"), sample(1, scene="kitchen", split="test")]
    raw = record(tmp_path / "raw", samples)
    with pytest.raises(DataError, match=r"(?s)both in train and in test.*kitchen"):
        curate(config(raw), {}, tmp_path / "out")
    counts = curate(config(raw, splits={"kit*": "test"}), {}, tmp_path / "out2")
    assert counts["splits"] == {"test": 2}


def test_a_multiple_of_the_rate_is_thinned(tmp_path: Path, sample: Make) -> None:
    episode, frames, masks = sample(0)
    doubled = replace(episode, fps=16.0, timestamps=episode.timestamps / 2)
    raw = record(tmp_path / "raw", [(doubled, frames, masks)])
    curate(config(raw), {}, tmp_path / "out")
    read = EpisodeSet.open(tmp_path / "out").episode(0)
    assert read.fps == 8.0
    assert np.array_equal(read.state, episode.state[::2])
    wrist = episode.cameras["left_wrist"].T_base_camera
    assert np.array_equal(read.cameras["left_wrist"].T_base_camera, wrist[::2])
    assert EpisodeSet.open(tmp_path / "out").frames(0, "head").shape[0] == 5


def test_views_and_calibration_can_be_demanded(tmp_path: Path, sample: Make) -> None:
    one_view = sample(1, views=("head",))
    bare = sample(2)
    uncalibrated = (replace(bare[0], cameras={"head": bare[0].cameras["head"]}), *bare[1:])
    raw = record(tmp_path / "raw", [sample(0), one_view, uncalibrated])
    curate(config(raw, views=("head", "left_wrist"), require_calibration=True), {}, tmp_path / "out")
    assert reasons_of(tmp_path / "out") == {"episode-001": "missing_view", "episode-002": "missing_calibration"}
    assert EpisodeSet.open(tmp_path / "out").rows[0].views == ("head", "left_wrist")
    curate(config(raw), {}, tmp_path / "all")
    assert all(row.stage2_ok for row in EpisodeSet.open(tmp_path / "all").rows)  # any views, one camera at least


def test_unsteady_frame_times_are_a_wrong_rate(tmp_path: Path, sample: Make) -> None:
    from worldline_core.data.mcap.exported import write_episode_mcap

    folder = tmp_path / "raw"
    for number in range(2):
        episode, frames, _ = sample(number)
        if number == 1:
            episode = replace(episode, timestamps=episode.timestamps * 1.25)
        write_episode_mcap(folder / f"{number}.mcap", episode, frames)
    source = {"kind": "mcap", "path": str(folder)}
    curate(CurateConfig.model_validate({"sources": [source]}), {}, tmp_path / "out")
    assert reasons_of(tmp_path / "out") == {"episode-001": "wrong_fps"}
    (row,) = EpisodeSet.open(tmp_path / "out").quarantine()
    assert row.numbers["measured_fps"] == pytest.approx(6.4)


@pytest.mark.parametrize("index_too", [False, True])
def test_half_the_rate_in_the_metadata_of_a_set_is_a_wrong_rate(tmp_path: Path, sample: Make, index_too: bool) -> None:
    """Without the check every second frame would be taken, those of the next episode among them."""
    raw = record(tmp_path / "raw", [sample(0), sample(1)])
    info = raw / "datasets/ur5e_pair/meta/info.json"
    info.write_text(json.dumps(json.loads(info.read_text()) | {"fps": 4}))
    if index_too:
        write_index(raw, [replace(row, fps=4.0) for row in EpisodeSet.open(raw).rows])
    with pytest.raises(DataError, match="2 wrong_fps"):
        curate(config(raw, fps=None), {}, tmp_path / "out")
    if not index_too:
        with pytest.raises(RejectedInputError, match="another frame rate"):
            EpisodeSet.open(raw).episode(0)


def test_states_and_videos_of_different_length(tmp_path: Path) -> None:
    """DROID-style annotations: the second episode has one state fewer than frames."""
    rng = np.random.default_rng(0)
    for number, states in (("0", 6), ("1", 5)):
        record_path = tmp_path / "droid/annotation/val" / f"{number}.json"
        record_path.parent.mkdir(parents=True, exist_ok=True)
        videos = []
        for view in range(3):
            path = tmp_path / "droid/videos/val" / number / f"{view}.mp4"
            path.parent.mkdir(parents=True, exist_ok=True)
            encode_video(path, rng.integers(0, 255, (6, 16, 24, 3), dtype=np.uint8), 5)
            videos.append({"video_path": str(path.relative_to(tmp_path / "droid"))})
        gripper = np.linspace(0, 1.02, states)[:, None]
        bent = np.array([0.0, 0.0, 0.0, -1.6, 0.0, 1.6, 0.0])  # a Panda's elbow and wrist cannot be straight
        joints = np.concatenate([bent + 0.1 * rng.normal(size=(states, 7)), gripper], axis=1)
        robot = load_embodiment("droid_franka")
        tools = tool_poses(robot, read_tree(robot), joints)[:, 0]
        angles = euler_fixed_xyz_from_rotation(tools[:, :3, :3])
        pose = np.concatenate([tools[:, :3, 3], angles, gripper], axis=1)
        described = {
            "texts": ["pick"],
            "success": 1,
            "videos": videos,
            "states": pose.tolist(),
            "joints": joints.tolist(),
        }
        record_path.write_text(json.dumps(described))
    source = {"kind": "droid_annotation", "path": str(tmp_path / "droid")}
    trimming = CurateConfig.model_validate({"sources": [source], "trim": "common"})
    counts = curate(trimming, {}, tmp_path / "trimmed")
    assert (counts["kept"], counts["trimmed"]) == (2, 1)
    whole, cut = (EpisodeSet.open(tmp_path / "trimmed").episode(i) for i in range(2))
    assert (whole.num_frames, cut.num_frames, "trimmed" in whole.conventions) == (6, 5, False)
    assert cut.conventions["trimmed"] == "the first 5 frames of states 5, head 6, exterior_2 6, right_wrist 6"
    states = json.loads((tmp_path / "droid/annotation/val/0.json").read_text())
    states |= {name: values[:4] for name, values in states.items() if name in ("states", "joints")}
    far = tmp_path / "droid/annotation/val/2.json"
    far.write_text(json.dumps(states))
    counts = curate(trimming, {}, tmp_path / "far")
    assert counts["reasons"] == {"length_mismatch": 1}  # two frames are not what stopping leaves
    far.unlink()
    counts = curate(CurateConfig.model_validate({"sources": [source]}), {}, tmp_path / "out")
    assert (counts["found"], counts["kept"], counts["reasons"]) == (2, 1, {"length_mismatch": 1})
    curated = EpisodeSet.open(tmp_path / "out")
    assert curated.quarantine()[0].numbers == {"states": 5, "frames": 6}
    episode = curated.episode(0)
    assert episode.state[0, 7] == 1.0  # 0 open in the source is 1 open here
    assert episode.state[-1, 7] == 0.0
    assert episode.conventions["gripper_overshoot"] == 1
    assert curated.rows[0].stage2_reason == "missing_calibration"


@pytest.mark.slow
def test_a_killed_curation_continues_to_the_same_bytes(tmp_path: Path, sample: Make) -> None:
    bad = sample(3)
    bad[0].state[0, 0] = np.inf
    copy = sample(0)
    samples = [sample(n, num_frames=33, height=96, width=144) for n in range(4, 16)]
    samples += [bad, sample(0), (replace(copy[0], episode_id="copy"), *copy[1:])]
    raw = record(tmp_path / "raw", samples)
    settings = config(raw)
    curate(settings, {}, tmp_path / "undisturbed")
    script = (
        "import sys; from pathlib import Path; from worldline_core.data.curation.curate import curate; from worldline_core.data.curation.curate_config import CurateConfig;"
        "curate(CurateConfig.model_validate_json(sys.argv[1]), {}, Path(sys.argv[2]))"
    )
    killed = tmp_path / "killed"
    process = subprocess.Popen([sys.executable, "-c", script, settings.model_dump_json(), str(killed)])
    parts = killed / "run" / "episodes" / "parts"
    deadline = time.monotonic() + 120
    while process.poll() is None and time.monotonic() < deadline:
        if parts.is_dir() and sum(not p.name.startswith(".") for p in parts.iterdir()) >= 3:
            os.kill(process.pid, signal.SIGKILL)
            break
        time.sleep(0.002)
    process.wait()
    assert process.returncode == -signal.SIGKILL
    counts = curate(settings, {}, killed)
    assert files_of(killed) == files_of(tmp_path / "undisturbed")
    assert counts == curate(settings, {}, killed)  # finished work is recognised
    assert counts["reasons"] == {"duplicate": 1, "nan_state": 1}
