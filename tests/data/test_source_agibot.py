"""AgiBot World's published layout and EnerVerse-AC's clips in each of their three forms, written here and read by the source."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError
from scipy.spatial.transform import Rotation

from tests.data.curating import (
    Damage,
    black_video,
    check_faults,
    cut,
    edit,
    moved_out,
    replaced,
    run,
    with_nan,
    without,
)
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.sources.agibot import AgibotWorldSourceConfig
from worldline_core.data.sources.open import SourceConfig, open_source
from worldline_core.data.video.encoder import encode_video
from worldline_core.errors import UnavailableError

LENGTH, HEIGHT, WIDTH = 8, 48, 64
CAMERAS = ("head", "hand_left", "hand_right")
ROTATION = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
JOINTS, TURN = "state/joint/position", "state/end/orientation"
OF_JOINTS = [*range(7), *range(8, 15)]
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
    """(N, 2) of the grippers: the left one closes from 35 to 120, the right one is open."""
    return np.stack([np.linspace(35, 120, LENGTH), np.full(LENGTH, 35.0)], axis=1)


def pictures(shade: int = 0) -> np.ndarray:
    ramp = np.linspace(0, 160, WIDTH)[None, None, :, None] + 6 * np.arange(LENGTH)[:, None, None, None] + shade
    return np.broadcast_to(ramp, (LENGTH, HEIGHT, WIDTH, 3)).astype(np.uint8)


def wave(number: int = 0) -> np.ndarray:
    """(N, 14) joints of both arms."""
    return 0.4 * np.sin(np.arange(LENGTH)[:, None] / 5 + np.arange(14)[None] + number)


def write_proprioception(path: Path, joints: np.ndarray | None) -> None:
    with h5py.File(path, "w") as file:
        file["state/end/position"], file[TURN] = end_poses()
        file["state/effector/position"] = readings()
        if joints is not None:
            file["timestamp"] = 1_718_000_000_123_456_789 + np.rint(np.arange(LENGTH) * 1e9 / 30).astype(np.int64)
            file[JOINTS], file["action/joint/position"] = joints, joints + 0.01
            file["action/effector/position"] = (readings() - 35) / 85


def write_camera(folder: Path, camera: str, number: int, num_poses: int) -> None:
    intrinsic = {"fx": 50.0 + number, "fy": 66.0, "ppx": 31.5, "ppy": 23.0, "k1": -0.05, "k2": 0.01, "k3": 0.0}
    (folder / f"{camera}_intrinsic_params.json").write_text(json.dumps({"intrinsic": intrinsic}))
    poses = [{"rotation_matrix": ROTATION, "translation_vector": [0.1, 0.02 * n, 1.2]} for n in range(num_poses)]
    listed = json.dumps([{"extrinsic": pose} for pose in poses])
    (folder / f"{camera}_extrinsic_params_aligned.json").write_text(listed)


def write_episode(root: Path, task: int = 327, number: int = 648642, shade: int = 0) -> Path:
    """One episode of AgiBot World, and its row in the task's file; returns the proprioception file."""
    ids = f"{task}/{number}"
    proprio, parameters = root / f"proprio_stats/{ids}", root / f"parameters/{ids}/parameters/camera"
    for folder in (proprio, root / f"observations/{ids}/videos", parameters):
        folder.mkdir(parents=True)
    (root / "task_info").mkdir(exist_ok=True)
    path = proprio / "proprio_stats.h5"
    write_proprioception(path, wave(number))
    with h5py.File(path, "r+") as file:
        file["state/head/position"] = np.tile([0.0, 0.4363], (LENGTH, 1))
        file["state/waist/position"] = np.tile([0.5061, 0.27], (LENGTH, 1))
        file["state/joint/velocity"] = np.zeros((0,))  # the publisher writes unused fields as empty ones
    for index, camera in enumerate(CAMERAS):
        video = root / f"observations/{ids}/videos/{camera}_color.mp4"
        encode_video(video, pictures(10 * index + shade), 30.0, crf=5, preset="ultrafast")
        write_camera(parameters, camera, index, 1 if camera == "head" else LENGTH)
    listing = root / f"task_info/task_{task}.json"
    rows = json.loads(listing.read_text()) if listing.exists() else []
    step = {"start_frame": 0, "end_frame": 5, "action_text": "Grasp the peach", "skill": "Pick"}
    rows.append({
        "episode_id": number, "task_id": task, "task_name": "Pickup in the supermarket ",
        "init_scene_text": "The robot stands at the shelf", "label_info": {"action_config": [step]},
    })  # fmt: skip
    listing.write_text(json.dumps(rows))
    return path


def write_arrays(root: Path, name: str = "bundle_0", shade: int = 0) -> Path:
    """A clip as the inference script reads them."""
    folder = root / name
    folder.mkdir(parents=True)
    places, quaternions = end_poses()
    rows = np.concatenate([places, quaternions, readings()[..., None]], axis=2)
    np.save(folder / "action.npy", rows.reshape(LENGTH, 16))
    np.save(folder / "intrinsics.npy", np.array([[50.0, 0, 31.5], [0, 66, 23], [0, 0, 1]]))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = ROTATION, [0.1, 0.2, 1.2]
    np.save(folder / "extrinsics.npy", pose)
    cv2.imwrite(str(folder / "frame.png"), pictures(shade)[0])
    return folder


def write_clip(
    root: Path, name: str = "296-655235-2", shade: int = 0, *, joints: bool = True, first_frame: bool = False
) -> Path:
    """A clip as the challenges publish them: a video for training, the first frame for testing."""
    folder = root / name
    folder.mkdir(parents=True)
    write_proprioception(folder / "proprio_stats.h5", wave() if joints else None)
    write_camera(folder, "head", 0, LENGTH)
    if first_frame:
        cv2.imwrite(str(folder / "frame.png"), pictures(shade)[0])
    else:
        encode_video(folder / "head_color.mp4", pictures(shade), 30.0, crf=5, preset="ultrafast")
    return folder


def settings(root: Path, **changes: Any) -> dict[str, Any]:
    return {"kind": "agibot_world", "path": str(root), "name": "agibot", "split": "train", **changes}


def clips(root: Path, **changes: Any) -> dict[str, Any]:
    return {"kind": "enerverse_ac", "path": str(root), "name": "evac", "fps": 30, "split": "train", **changes}


def load(declared: dict[str, Any]) -> Any:
    config = TypeAdapter(SourceConfig).validate_python(declared)
    source = open_source(config, config.path)
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


def test_published_layout_comes_through_curation(tmp_path: Path) -> None:
    write_episode(tmp_path / "raw")
    write_episode(tmp_path / "raw", number=648650, shade=30)
    counts, curated = run(tmp_path, settings(tmp_path / "raw"))
    assert (counts["found"], counts["reasons"]) == (2, {})
    row, episode = curated.rows[0], curated.episode(0)
    assert (row.episode_id, row.scene, row.split) == ("agibot-327-648642", "agibot-327", "train")
    assert (row.num_frames, row.fps, row.stage1_ok, row.stage2_ok) == (LENGTH, 30.0, True, True)
    assert episode.instruction == "pickup in the supermarket"
    assert np.allclose(episode.state[:, OF_JOINTS], wave(648642), atol=1e-6)
    assert np.allclose(episode.action[:, OF_JOINTS], wave(648642) + 0.01, atol=1e-6)
    for values in (episode.state, episode.action):  # 35 open .. 120 closed, and 0 .. 1
        assert np.allclose(values[:, 7], np.linspace(1, 0, LENGTH), atol=1e-6)
        assert np.allclose(values[:, 15], 1)
    check_poses(episode)
    wrist, head = episode.cameras["left_wrist"], episode.cameras["head"]
    assert not head.moving
    assert np.allclose(wrist.T_base_camera[:, :3, 3], [[0.1, 0.02 * n, 1.2] for n in range(LENGTH)])
    assert np.allclose(wrist.T_base_camera[0, :3, :3] @ [0, 0, 1], [1, 0, 0])  # looks along the base's x
    assert np.allclose(wrist.K, [[51, 0, 31.5], [0, 66, 23], [0, 0, 1]])
    images = curated.frames(0, "right_wrist").astype(int)
    assert images.shape == (LENGTH, HEIGHT, WIDTH, 3)
    assert abs(images[3, :, 0].mean() - (18 + 20)) < 3


def video(path: Path, camera: str = "head") -> Path:
    return Path(str(path.parent).replace("proprio_stats", "observations")) / f"videos/{camera}_color.mp4"


def extrinsics(path: Path, camera: str = "head", name: str = "extrinsic_params_aligned") -> Path:
    folder = Path(str(path.parent).replace("proprio_stats", "parameters"))
    return folder / f"parameters/camera/{camera}_{name}.json"


def task_file(path: Path) -> Path:
    return path.parents[3] / f"task_info/task_{path.parent.parent.name}.json"


def leading_out(make: Callable[[Any, Path], object]) -> Damage:
    """The joints are replaced by what leads to another file."""

    def damage(path: Path) -> None:
        with h5py.File(path.parents[4] / "outside.h5", "w") as outside:
            outside["secret"] = np.zeros((LENGTH, 14))
        with h5py.File(path, "r+") as file:
            del file[JOINTS]
            make(file, path.parents[4] / "outside.h5")

    return damage


def linked(file: Any, outside: Path, name: str = JOINTS) -> None:
    file[name] = h5py.ExternalLink(str(outside), "secret")


def linked_by_a_detour(file: Any, outside: Path) -> None:
    linked(file, outside, "elsewhere")
    file[JOINTS] = h5py.SoftLink("/elsewhere")


def virtual(file: Any, outside: Path) -> None:
    layout = h5py.VirtualLayout((LENGTH, 14), "f8")
    layout[:] = h5py.VirtualSource(str(outside), "secret", (LENGTH, 14))
    file.create_virtual_dataset(JOINTS, layout)


def stored_outside(file: Any, outside: Path) -> None:
    file.create_dataset(JOINTS, (LENGTH, 14), "f8", external=[(str(outside), 0, h5py.h5f.UNLIMITED)])


def damage_chunk(path: Path) -> None:
    """The file opens, the array does not decompress."""
    with h5py.File(path, "r+") as file:
        values = file[JOINTS][()]
        del file[JOINTS]
        chunk = file.create_dataset(JOINTS, data=values, compression="gzip").id.get_chunk_info(0)
    with path.open("r+b") as stream:
        stream.seek(chunk.byte_offset)
        stream.write(b"\xff" * chunk.size)


def rewritten(file: Callable[[Path], Path], change: Callable[[Any], Any]) -> Damage:
    return lambda path: file(path).write_text(json.dumps(change(json.loads(file(path).read_text()))))


def intrinsic(key: str, value: object) -> Damage:
    return rewritten(
        lambda path: extrinsics(path, name="intrinsic_params"),
        lambda record: {"intrinsic": {**record["intrinsic"], key: value}},
    )


def pose(rotation: object) -> Damage:
    return rewritten(
        extrinsics, lambda _: [{"extrinsic": {"rotation_matrix": rotation, "translation_vector": [0] * 3}}]
    )


FAULTS: dict[str, tuple[Damage, str]] = {
    "no proprioception": (lambda path: path.unlink(), "missing_file"),
    "no task file": (lambda path: task_file(path).unlink(), "missing_file"),
    "not in task file": (rewritten(task_file, lambda _: []), "missing_column"),
    "truncated file": (cut, "unreadable"),
    "damaged chunk": (damage_chunk, "unreadable"),
    "truncated json": (lambda path: cut(extrinsics(path)), "unreadable"),
    "truncated video": (lambda path: cut(video(path)), "truncated_video"),
    "no video": (lambda path: video(path, "hand_left").unlink(), "missing_file"),
    "video of another rate": (lambda path: black_video(video(path), LENGTH, 15.0), "wrong_fps"),
    "missing key": (without("action/joint/position"), "missing_column"),
    "a group for a dataset": (
        edit(lambda file: (file.__delitem__("timestamp"), file.create_group("timestamp"))), "missing_column",
    ),
    "text for numbers": (replaced("timestamp", lambda _: np.array([b"now"] * LENGTH)), "unreadable"),
    "wrong shape": (replaced("state/end/orientation", lambda _: np.zeros((LENGTH, 4))), "length_mismatch"),
    "empty commands": (replaced("action/joint/position", lambda _: np.zeros((0,))), "length_mismatch"),
    "a state less": (replaced(JOINTS, lambda v: v[1:]), "length_mismatch"),
    "a frame more": (lambda path: black_video(video(path), LENGTH + 1, 30.0), "length_mismatch"),
    "times of another rate": (replaced("timestamp", lambda v: 2 * v - v[0]), "wrong_fps"),
    "NaN gripper": (replaced("action/effector/position", with_nan), "nan_state"),
    "NaN time": (replaced("timestamp", with_nan), "nan_state"),
    "joint beyond its limit": (replaced(JOINTS, lambda v: np.full_like(v, 3.0)), "joint_out_of_range"),
    "K of a larger image": (intrinsic("ppx", 640.0), "missing_calibration"),
    "K without focal length": (intrinsic("fx", None), "missing_column"),
    "K of zero focal length": (intrinsic("fx", 0.0), "singular_intrinsics"),
    "K not finite": (intrinsic("fy", float("nan")), "singular_intrinsics"),
    "no rotation": (pose(np.ones((3, 3)).tolist()), "invalid_extrinsics"),
    "ragged rotation": (pose([[1, 0], [0]]), "invalid_extrinsics"),
    "extrinsics without a field": (rewritten(extrinsics, lambda _: [{}]), "missing_column"),
    "video linked out of the folder": (lambda path: moved_out(video(path)), "path_traversal"),
    "array linked out of the file": (leading_out(linked), "path_traversal"),
    "array linked by a detour": (leading_out(linked_by_a_detour), "path_traversal"),
    "array gathered from another file": (leading_out(virtual), "path_traversal"),
    "array stored out of the file": (leading_out(stored_outside), "path_traversal"),
}  # fmt: skip


@pytest.mark.slow
def test_a_fault_quarantines_its_episode_alone(tmp_path: Path) -> None:
    check_faults(tmp_path / "raw", settings(tmp_path), lambda root, n: write_episode(root, n, n), FAULTS)


def test_nanoseconds_keep_their_precision(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_episode(tmp_path)
    times = load(settings(tmp_path)).episode.timestamps
    assert np.abs(times - np.rint(np.arange(LENGTH) * 1e9 / 30) * 1e-9).max() < 1e-12
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(UnavailableError, match=r"(?s)h5py.*uv sync --extra hdf5"):
        load(settings(tmp_path))


def test_only_configured_views_are_needed(tmp_path: Path) -> None:
    video(write_episode(tmp_path), "hand_left").unlink()
    loaded = load(settings(tmp_path, views=["head", "right_wrist"]))
    assert loaded.views == ("head", "right_wrist")
    assert set(loaded.episode.cameras) == {"head", "right_wrist"}
    with pytest.raises(ValidationError, match="left_wrist"):
        AgibotWorldSourceConfig.model_validate(settings(tmp_path, views=["chest"]))


def test_arrays_and_a_first_frame(tmp_path: Path) -> None:
    write_arrays(tmp_path)
    loaded = load(clips(tmp_path))
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
    counts, curated = run(tmp_path, clips(tmp_path / "raw"))
    assert (counts["found"], counts["reasons"]) == (3, {})
    assert {row.episode_id: row.scene for row in curated.rows} == {
        "evac-296-655235-2": "evac-296",  # steps of one task, of which several may be of one recording
        "evac-296-655235-3": "evac-296",
        "evac-task_1-episode_4": "evac-task_1",
    }
    with_joints, poses_only = curated.episode(0), curated.episode(1)
    check_poses(with_joints)
    check_poses(poses_only)
    assert np.allclose(with_joints.state[:, OF_JOINTS], wave(), atol=1e-6)
    assert np.allclose(with_joints.action[:, OF_JOINTS], wave() + 0.01, atol=1e-6)
    assert np.allclose(with_joints.action[:, 7], np.linspace(1, 0, LENGTH), atol=1e-6)  # 0 open .. 1 closed
    assert (with_joints.state_kind, poses_only.state_kind) == ("joints", "ee_pose")
    assert len(curated.frames(0, "head")) == (1 if first_frame else LENGTH)
    assert abs(curated.frames(0, "head")[0, :, 0].astype(int).mean()) < 3


def changed(name: str, change: Callable[[Any], Any]) -> Damage:
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


PROPRIO, POSES = "proprio_stats.h5", "head_extrinsic_params_aligned.json"
CLIP_FAULTS: dict[Write, dict[str, tuple[Damage, str]]] = {
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
        "a camera pose less": (changed(POSES, lambda poses: poses[1:]), "length_mismatch"),
        "another rate": (lambda folder: black_video(folder / "head_color.mp4", LENGTH, 15.0), "wrong_fps"),
        "a frame less": (lambda folder: black_video(folder / "head_color.mp4", LENGTH - 1, 30.0), "truncated_video"),
        "a file elsewhere": (lambda folder: moved_out(folder / PROPRIO), "path_traversal"),
    },
    write_arrays: {
        "no array of actions": (gone("action.npy"), "missing_file"),
        "narrow array": (changed("action.npy", lambda v: v[:, :14]), "length_mismatch"),
        "NaN in the array": (changed("action.npy", with_nan), "nan_state"),
        "no rotation": (changed("extrinsics.npy", lambda v: 2 * v), "invalid_extrinsics"),
        "singular K": (changed("intrinsics.npy", np.zeros_like), "singular_intrinsics"),
        "no picture": (gone("frame.png"), "missing_file"),
        "truncated picture": (cut_to("frame.png", slice(60)), "unreadable"),
        "truncated array": (cut_to("action.npy", slice(-8)), "unreadable"),
        "an array elsewhere": (lambda folder: moved_out(folder / "action.npy"), "path_traversal"),
    },
}


@pytest.mark.parametrize("write", CLIP_FAULTS)
def test_each_fault_has_its_reason_and_costs_no_other_clip(tmp_path: Path, write: Write) -> None:
    check_faults(tmp_path / "raw", clips(tmp_path), lambda root, n: write(root, f"9-9-{n}", n), CLIP_FAULTS[write])


def test_a_single_picture_is_of_the_declared_head_camera(tmp_path: Path) -> None:
    write_arrays(tmp_path)
    with pytest.raises(RejectedInputError, match="single picture"):
        load(clips(tmp_path, views=["head", "left_wrist"]))
    with pytest.raises(RejectedInputError, match=r"(?s)one pose of a camera that moves.*one pose for 8 states"):
        load(clips(tmp_path, views=["left_wrist"]))
