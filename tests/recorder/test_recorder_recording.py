"""Pictures, determinism, resume and banks of the recorder; needs off-screen OpenGL."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch

mujoco = pytest.importorskip("mujoco", reason="the recorder needs MuJoCo (extra: sim)")

from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import DataError
from worldline_core.geometry.tensor_transforms import is_rigid
from worldline_core.recorder.attempts import SEALED_FILE, BankSpec, RecordBanksConfig, record_banks
from worldline_core.recorder.looks import SCENES
from worldline_core.recorder.record import (
    DEFECTS,
    DEFECTS_FILE,
    RecordConfig,
    RecordGroup,
    _record_job,
    plan_jobs,
    record,
)
from worldline_core.recorder.scene import sample_layout
from worldline_core.recorder.simulate import EpisodeRecorder, ExecutedMotion, Job, Recording

JOB = Job("one", "viperx_graphite", "train", "place", (1, 2, 3), num_frames=17)


@pytest.fixture(scope="module")
def recorder(rendering: None) -> Iterator[EpisodeRecorder]:
    made = EpisodeRecorder("viperx_graphite")
    yield made
    made.close()


@pytest.fixture(scope="module")
def recording(recorder: EpisodeRecorder) -> Recording:
    return recorder.record(JOB)


def digests(root: Path) -> dict[str, str]:
    files = [path for path in root.rglob("*") if path.is_file() and path.relative_to(root).parts[0] != "run"]
    return {str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


@pytest.mark.slow
def test_an_episode_is_a_function_of_its_entropy(recorder: EpisodeRecorder, recording: Recording) -> None:
    recorder.record(replace(JOB, split="test", family="press", entropy=(9,)))
    again = recorder.record(JOB)
    other = recorder.record(replace(JOB, entropy=(1, 2, 4)))
    np.testing.assert_array_equal(again.episode.state, recording.episode.state)
    for view, images in recording.frames.items():
        np.testing.assert_array_equal(again.frames[view], images)
        np.testing.assert_array_equal(again.robot_masks[view], recording.robot_masks[view])
        assert not np.array_equal(other.frames[view], images)


def test_cameras_are_exact(recorder: EpisodeRecorder) -> None:
    """A block's corners, projected with K and T_base_camera, enclose exactly the block's pixels."""
    randoms = map(np.random.default_rng, range(20))
    layouts = (sample_layout(recorder.scene.robot, "lift", random, SCENES["scene_12"]) for random in randoms)
    layout = next(layout for layout in layouts if layout.target.kind == "block" and not layout.others)
    motion = recorder.move(layout, np.random.default_rng(4), 17)
    still = ExecutedMotion(motion.state[:1], motion.action[:1], motion.qpos[:1], motion.outcome)
    # With the arms moved out of the way below the floor, nothing hides the block.
    for arm in recorder.scene.arms:
        still.qpos[0, arm.qpos[1]] = np.pi
    jitter, model = np.random.default_rng(0), recorder.scene.model
    filmed = recorder.film(layout, still, episode_id="e", scene_id="scene_05", split="train", jitter=jitter)
    address = int(model.joint("block_0").qposadr[0])
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, still.qpos[0, address + 3 : address + 7])
    half = model.geom_size[model.geom("block_0").id]
    corners = half * np.array(list(itertools.product((-1, 1), repeat=3))) @ rotation.reshape(3, 3).T
    corners += still.qpos[0, address : address + 3]
    camera = filmed.episode.cameras["head"]
    in_camera = np.linalg.inv(camera.poses([0])[0]) @ np.c_[corners, np.ones(8)].T
    pixels = (camera.K @ in_camera[:3] / in_camera[2])[:2].T
    rows, columns = np.nonzero(filmed.thing_labels["head"][0] == 1)
    seen = np.array([[columns.min(), rows.min()], [columns.max(), rows.max()]])
    # The picture shows it where the labels do: its colour is saturated.
    assert np.ptp(filmed.frames["head"][0][rows, columns].astype(int), axis=1).min() > 40
    # Pixel centres lie at whole numbers: the outermost ones are within a pixel of the outline.
    np.testing.assert_allclose(seen, [pixels.min(axis=0), pixels.max(axis=0)], atol=1.0)
    assert np.ptp(pixels, axis=0).min() > 8.0


def test_the_wrist_camera_moves_with_the_arm_and_the_head_stands(recording: Recording) -> None:
    cameras = recording.episode.cameras
    assert set(cameras) == {"head", "left_wrist", "right_wrist"}
    assert not cameras["head"].moving
    assert all(cameras[view].moving for view in ("left_wrist", "right_wrist"))
    for camera in cameras.values():
        assert bool(is_rigid(torch.from_numpy(camera.T_base_camera)).all())


@pytest.mark.slow
def test_a_killed_recording_ends_with_the_same_bytes(recorder: EpisodeRecorder, tmp_path: Path) -> None:
    groups = (RecordGroup(embodiment="xarm7_single", count=2, families=("lift", "close")),)
    defects: Any = {"xarm7_single": {"frozen_camera": 1}}
    config = RecordConfig(groups=groups, seed=5, num_frames=17, workers=1, defects=defects)
    counts = record(config, tmp_path / "whole")
    assert counts["episodes"] == 2
    # What a kill leaves behind: one finished episode, given in another order.
    _record_job((plan_jobs(config)[-1], config, tmp_path / "resumed"))
    record(config, tmp_path / "resumed")
    assert digests(tmp_path / "whole") == digests(tmp_path / "resumed")
    # And one between the last file of the set and those beside it.
    (tmp_path / "whole" / DEFECTS_FILE).unlink()
    assert record(config, tmp_path / "whole") == counts
    assert digests(tmp_path / "whole") == digests(tmp_path / "resumed")
    with pytest.raises(DataError, match=r"(?s)other episodes than.*2 of them missing, 2 others"):
        record(config.model_copy(update={"seed": 6}), tmp_path / "whole")


@pytest.mark.slow
def test_bank_outcomes_are_sealed(recorder: EpisodeRecorder, tmp_path: Path) -> None:
    spec = BankSpec(name="bank", embodiment="viperx_graphite", family="close", scene="scene_12", layout=1)
    config = RecordBanksConfig(banks=(spec,), candidates=4, num_frames=29, success_range=(0.25, 0.75), masks=False)
    record_banks(config, tmp_path / "banks")
    episodes = EpisodeSet.open(tmp_path / "banks")
    assert episodes.robot_masks(0, "head") is None
    assert {row.outcome for row in episodes.rows} == {"unknown"}
    assert [row.candidate for row in episodes.rows] == [0, 1, 2, 3]
    sealed = pq.read_table(tmp_path / "banks" / SEALED_FILE).to_pylist()
    assert {row["outcome"] for row in sealed} == {"success", "failure"}
    first = [episodes.frames(i, "head", [0])[0] for i in range(4)]
    assert all(np.abs(first[0].astype(int) - image.astype(int)).mean() < 1.0 for image in first[1:])
    actions = [episodes.episode(i).action for i in range(4)]
    np.testing.assert_array_equal(actions[0][0], actions[1][0])
    assert not np.array_equal(actions[0], actions[1])


@pytest.mark.parametrize("name", sorted(DEFECTS))
def test_defects_spoil_what_they_say(name: str, recording: Recording) -> None:
    spoiled = DEFECTS[name](recording, np.random.default_rng(0))
    episode, healthy = spoiled.episode, recording.episode
    T_base_camera = episode.cameras["head"].T_base_camera
    changed = {
        "static_lead_in": np.ptp(episode.state[:16], axis=0).max() == 0 < episode.num_frames - healthy.num_frames,
        "reset_segment": np.abs(np.diff(episode.state, axis=0)).max() > np.abs(np.diff(healthy.state, axis=0)).max(),
        "frozen_camera": np.ptp(spoiled.frames["head"][4:].astype(int), axis=0).max() == 0,
        "corrupted_frames": sum(frame.max() == 0 for frame in spoiled.frames["head"]) == 4,
        "lagged_state": np.array_equal(episode.state[4:], healthy.state[:-4]),
        "inverted_extrinsics": np.allclose(T_base_camera @ healthy.cameras["head"].T_base_camera, np.eye(4), atol=1e-9),
        "intrinsics_of_other_size": episode.cameras["head"].K[0, 0] > 3 * healthy.cameras["head"].K[0, 0],
    }
    assert changed[name]
    assert all(len(images) == episode.num_frames for images in spoiled.frames.values())
    assert recording.episode is healthy
