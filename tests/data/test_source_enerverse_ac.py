"""Clips of EnerVerse-AC, in each of their three forms, written here and read by the source."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.data.curating import Damage, check_faults, replaced, run, with_nan, without
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.sources.agibot import EnerverseAcSourceConfig
from worldline_core.data.sources.open import open_source
from worldline_core.data.video.encoder import encode_video

LENGTH, HEIGHT, WIDTH = 8, 48, 64
CAMERA_POSE = {"rotation_matrix": [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], "translation_vector": [0.1, 0.2, 1.2]}
Write = Callable[..., Path]


def end_poses() -> tuple[np.ndarray, np.ndarray]:
    """Places (N, 2, 3) [m] and quaternions xyzw (N, 2, 4): both arms turn about different axes."""
    time = np.arange(LENGTH) / 30
    places = np.stack([[0.4 + 0.1 * time, 0.2 + 0 * time, 0.9 - time], [0.5 - time, -0.3 + 0 * time, 1 + 0 * time]])
    turns = [
        Rotation.from_euler(axes, np.outer(0.4 + time, angles))
        for axes, angles in (("xyz", [1, 0.3, 2]), ("zyx", [1, -2, 0.5]))
    ]
    return places.transpose(2, 0, 1), np.stack([turn.as_quat() for turn in turns], axis=1)


def readings() -> np.ndarray:
    """Of the grippers (N, 2): the left one closes from 35 to 120, the right one is open."""
    return np.stack([np.linspace(35, 120, LENGTH), np.full(LENGTH, 35.0)], axis=1)


def pictures(shade: int = 0) -> np.ndarray:
    ramp = np.linspace(0, 160, WIDTH)[None, None, :, None] + 6 * np.arange(LENGTH)[:, None, None, None] + shade
    return np.broadcast_to(ramp, (LENGTH, HEIGHT, WIDTH, 3)).astype(np.uint8)


def write_arrays(root: Path, name: str = "bundle_0", shade: int = 0) -> Path:
    """As the inference script reads them."""
    folder = root / name
    folder.mkdir(parents=True)
    places, quaternions = end_poses()
    rows = np.concatenate([places, quaternions, readings()[..., None]], axis=2)
    np.save(folder / "action.npy", rows.reshape(LENGTH, 16))
    np.save(folder / "intrinsics.npy", np.array([[50.0, 0, 31.5], [0, 66, 23], [0, 0, 1]]))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = CAMERA_POSE["rotation_matrix"], CAMERA_POSE["translation_vector"]
    np.save(folder / "extrinsics.npy", pose)
    cv2.imwrite(str(folder / "frame.png"), pictures(shade)[0])
    return folder


def write_clip(
    root: Path, name: str = "296-655235-2", shade: int = 0, *, joints: bool = True, first_frame: bool = False
) -> Path:
    """As the challenges publish them: a video for training, the first frame for testing."""
    folder = root / name
    folder.mkdir(parents=True)
    places, quaternions = end_poses()
    with h5py.File(folder / "proprio_stats.h5", "w") as file:
        file["state/end/position"], file["state/end/orientation"] = places, quaternions
        file["state/effector/position"] = readings()
        if joints:
            wave = 0.3 * np.sin(np.arange(LENGTH)[:, None] / 5 + np.arange(14)[None])
            file["timestamp"] = 1_718_000_000_000_000_000 + np.rint(np.arange(LENGTH) * 1e9 / 30).astype(np.int64)
            file["state/joint/position"], file["action/joint/position"] = wave, wave + 0.01
            file["action/effector/position"] = (readings() - 35) / 85
    intrinsic = {"fx": 50.0, "fy": 66.0, "ppx": 31.5, "ppy": 23.0}
    (folder / "head_intrinsic_params.json").write_text(json.dumps({"intrinsic": intrinsic}))
    poses = [{"extrinsic": CAMERA_POSE}] * LENGTH
    (folder / "head_extrinsic_params_aligned.json").write_text(json.dumps(poses))
    if first_frame:
        cv2.imwrite(str(folder / "frame.png"), pictures(shade)[0])
    else:
        encode_video(folder / "head_color.mp4", pictures(shade), 30.0, crf=5, preset="ultrafast")
    return folder


def settings(root: Path, **changes: Any) -> dict[str, Any]:
    return {"kind": "enerverse_ac", "path": str(root), "name": "evac", "fps": 30, "split": "train", **changes}


def load(root: Path, **changes: Any) -> Any:
    source = open_source(EnerverseAcSourceConfig.model_validate(settings(root, **changes)), root)
    return source.load(source.episode_ids()[0])


def check_poses(episode: Any) -> None:
    """Tools lie 0.23 m along the end links' +z, camera and openings as they were written."""
    places, quaternions = end_poses()
    for arm in range(2):
        turn = Rotation.from_quat(quaternions[:, arm]).as_matrix()
        assert np.allclose(episode.T_base_ee[:, arm, :3, :3], turn, atol=1e-6)
        assert np.allclose(episode.T_base_ee[:, arm, :3, 3], places[:, arm] + 0.23 * turn[:, :, 2], atol=1e-6)
    assert np.allclose(episode.gripper[:, 0], np.linspace(1, 0, LENGTH))
    assert np.allclose(episode.gripper[:, 1], 1)
    camera = episode.cameras["head"]
    assert np.allclose(camera.K, [[50, 0, 31.5], [0, 66, 23], [0, 0, 1]])
    assert np.allclose(camera.T_base_camera[0, :3, :3] @ [0, 0, 1], [1, 0, 0])  # looks along the base's x


def test_arrays_and_a_first_frame(tmp_path: Path) -> None:
    write_arrays(tmp_path)
    loaded = load(tmp_path)
    check_poses(loaded.episode)
    assert (loaded.episode.state_kind, loaded.episode.video_frames) == ("ee_pose", 1)
    assert loaded.episode.state_names[6:9] == ("left/qw", "left/gripper", "right/x")
    assert np.allclose(loaded.episode.state[:, [7, 15]], loaded.episode.gripper)
    assert np.array_equal(loaded.episode.action, loaded.episode.state)
    assert str(loaded.episode.conventions["action"]).startswith("repeats the state")
    assert np.array_equal(loaded.frames("head")[0][..., ::-1], cv2.imread(str(tmp_path / "bundle_0/frame.png")))


@pytest.mark.parametrize("first_frame", [True, False])
def test_clips_come_through_curation(tmp_path: Path, first_frame: bool) -> None:
    write_clip(tmp_path / "raw", first_frame=first_frame)
    write_clip(tmp_path / "raw", "296-655235-3", 30, joints=False, first_frame=first_frame)
    write_clip(tmp_path / "raw", "task_1/episode_4", 60, first_frame=first_frame)
    counts, curated = run(tmp_path, settings(tmp_path / "raw"))
    assert (counts["found"], counts["reasons"]) == (3, {})
    assert {row.episode_id: row.scene for row in curated.rows} == {
        "evac-296-655235-2": "evac-296",  # steps of one task, of which several may be of one recording
        "evac-296-655235-3": "evac-296",
        "evac-task_1-episode_4": "evac-task_1",
    }
    with_joints, poses_only = curated.episode(0), curated.episode(1)
    check_poses(with_joints)
    check_poses(poses_only)
    wave = 0.3 * np.sin(np.arange(LENGTH)[:, None] / 5 + np.arange(14)[None])
    assert np.allclose(with_joints.state[:, [*range(7), *range(8, 15)]], wave, atol=1e-6)
    assert np.allclose(with_joints.action[:, [*range(7), *range(8, 15)]], wave + 0.01, atol=1e-6)
    assert np.allclose(with_joints.action[:, 7], np.linspace(1, 0, LENGTH), atol=1e-6)  # 0 open .. 1 closed
    assert (with_joints.state_kind, poses_only.state_kind) == ("joints", "ee_pose")
    assert len(curated.frames(0, "head")) == (1 if first_frame else LENGTH)
    assert abs(curated.frames(0, "head")[0, :, 0].astype(int).mean()) < 3


def rewritten(name: str, change: Callable[[Any], Any]) -> Damage:
    def damage(folder: Path) -> None:
        path = folder / name
        if name.endswith(".npy"):
            np.save(path, change(np.load(path)))
        else:
            path.write_text(json.dumps(change(json.loads(path.read_text()))))

    return damage


def h5(damage: Damage) -> Damage:
    return lambda folder: damage(folder / "proprio_stats.h5")


def gone(name: str) -> Damage:
    return lambda folder: (folder / name).unlink()


def cut_to(name: str, part: slice) -> Damage:
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[part])


def link_out(name: str) -> Damage:
    return lambda folder: (folder / name).symlink_to((folder / name).rename(folder.parents[1] / name))


def video(length: int, fps: float) -> Damage:
    frames = np.zeros((length, HEIGHT, WIDTH, 3), np.uint8)
    return lambda folder: encode_video(folder / "head_color.mp4", frames, fps, preset="ultrafast")


PROPRIO, TURN, POSES = "proprio_stats.h5", "state/end/orientation", "head_extrinsic_params_aligned.json"
FAULTS: dict[Write, dict[str, tuple[Damage, str]]] = {
    write_clip: {
        "no proprioception": (gone(PROPRIO), "missing_file"),
        "no video": (gone("head_color.mp4"), "missing_file"),
        "no intrinsics": (gone("head_intrinsic_params.json"), "missing_file"),
        "no end poses": (h5(without("state/end/position")), "missing_column"),
        "no commands of the grippers": (h5(without("action/effector/position")), "missing_column"),
        "NaN place": (h5(replaced("state/end/position", with_nan)), "nan_state"),
        "turn without direction": (h5(replaced(TURN, np.zeros_like)), "nan_state"),
        "NaN joint": (h5(replaced("state/joint/position", with_nan)), "nan_state"),
        "hands": (h5(replaced("state/effector/position", lambda v: np.repeat(v, 6, axis=1))), "invalid_gripper"),
        "a joint less": (h5(replaced("state/joint/position", lambda v: v[:, 1:])), "length_mismatch"),
        "a command less": (h5(replaced("action/joint/position", lambda v: v[1:])), "length_mismatch"),
        "a camera pose less": (rewritten(POSES, lambda poses: poses[1:]), "length_mismatch"),
        "another rate": (video(LENGTH, 15.0), "wrong_fps"),
        "a frame less": (video(LENGTH - 1, 30.0), "truncated_video"),
        "a file elsewhere": (link_out(PROPRIO), "path_traversal"),
    },
    write_arrays: {
        "no array of actions": (gone("action.npy"), "missing_file"),
        "narrow array": (rewritten("action.npy", lambda v: v[:, :14]), "length_mismatch"),
        "NaN in the array": (rewritten("action.npy", with_nan), "nan_state"),
        "no rotation": (rewritten("extrinsics.npy", lambda v: 2 * v), "invalid_extrinsics"),
        "singular K": (rewritten("intrinsics.npy", np.zeros_like), "singular_intrinsics"),
        "no picture": (gone("frame.png"), "missing_file"),
        "truncated picture": (cut_to("frame.png", slice(60)), "unreadable"),
        "truncated array": (cut_to("action.npy", slice(-8)), "unreadable"),
        "an array elsewhere": (link_out("action.npy"), "path_traversal"),
    },
}


@pytest.mark.parametrize("write", FAULTS)
def test_each_fault_has_its_reason_and_costs_no_other_clip(tmp_path: Path, write: Write) -> None:
    check_faults(tmp_path / "raw", settings(tmp_path), lambda root, n: write(root, f"9-9-{n}", n), FAULTS[write])


def test_a_single_picture_is_of_the_declared_head_camera(tmp_path: Path) -> None:
    write_arrays(tmp_path)
    with pytest.raises(RejectedInputError, match="single picture"):
        load(tmp_path, views=["head", "left_wrist"])
    with pytest.raises(RejectedInputError, match=r"(?s)one pose of a camera that moves.*one pose for 8 states"):
        load(tmp_path, views=["left_wrist"])
