"""AgiBot World's published layout, written here with h5py, json and our video encoder, read by the source."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from pydantic import ValidationError

from tests.data.curating import Damage, check_faults, cut, edit, replaced, run, with_nan, without
from worldline_core.data.sources.agibot import AgibotWorldSourceConfig
from worldline_core.data.sources.open import open_source
from worldline_core.data.video.encoder import encode_video
from worldline_core.errors import UnavailableError

LENGTH, HEIGHT, WIDTH = 8, 48, 64
CAMERAS = ("head", "hand_left", "hand_right")
START_NS = 1_718_000_000_123_456_789
JOINTS = "state/joint/position"


def quaternion_xyzw(length: int, arm: int) -> np.ndarray:
    angle = 0.3 + 0.05 * np.arange(length) + arm
    return np.stack([np.sin(angle / 2), np.zeros(length), np.zeros(length), np.cos(angle / 2)], axis=1)


def write_episode(root: Path, task: int = 327, number: int = 648642, shade: int = 0) -> Path:
    """One episode, and its row in the task's file; returns the proprioception file."""
    ids = f"{task}/{number}"
    for folder in (f"proprio_stats/{ids}", f"observations/{ids}/videos", f"parameters/{ids}/parameters/camera"):
        (root / folder).mkdir(parents=True)
    (root / "task_info").mkdir(exist_ok=True)
    wave = 0.4 * np.sin(np.arange(LENGTH)[:, None] / 5 + np.arange(14)[None] + number)
    effector = np.stack([np.linspace(35, 120, LENGTH), np.full(LENGTH, 35.0)], axis=1)
    path = root / f"proprio_stats/{ids}/proprio_stats.h5"
    with h5py.File(path, "w") as file:
        file["timestamp"] = START_NS + np.rint(np.arange(LENGTH) * 1e9 / 30).astype(np.int64)
        file[JOINTS] = wave
        file["state/effector/position"] = effector
        file["state/end/position"] = np.stack([wave[:, :3], wave[:, 3:6]], axis=1)
        file["state/end/orientation"] = np.stack([quaternion_xyzw(LENGTH, arm) for arm in (0, 1)], axis=1)
        file["state/head/position"] = np.tile([0.0, 0.4363], (LENGTH, 1))
        file["state/waist/position"] = np.tile([0.5061, 0.27], (LENGTH, 1))
        file["state/joint/velocity"] = np.zeros((0,))  # the publisher writes unused fields as empty ones
        file["action/joint/position"] = wave + 0.01
        file["action/effector/position"] = np.stack([np.linspace(0, 1, LENGTH), np.zeros(LENGTH)], axis=1)
    for index, camera in enumerate(CAMERAS):
        ramp = np.linspace(0, 160, WIDTH)[None, None, :, None] + 4 * np.arange(LENGTH)[:, None, None, None]
        frames = np.broadcast_to(ramp + 10 * index + shade, (LENGTH, HEIGHT, WIDTH, 3)).astype(np.uint8)
        encode_video(root / f"observations/{ids}/videos/{camera}_color.mp4", frames, 30.0, crf=5, preset="ultrafast")
        base = root / f"parameters/{ids}/parameters/camera/{camera}"
        intrinsic = {"fx": 50.0 + index, "fy": 66.0, "ppx": 31.5, "ppy": 23.0, "k1": -0.05, "k2": 0.01, "k3": 0.0}
        Path(f"{base}_intrinsic_params.json").write_text(json.dumps({"intrinsic": intrinsic}))
        poses = [
            {"rotation_matrix": [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], "translation_vector": [0.1, 0.02 * n, 1.2]}
            for n in range(1 if camera == "head" else LENGTH)
        ]
        Path(f"{base}_extrinsic_params_aligned.json").write_text(json.dumps([{"extrinsic": pose} for pose in poses]))
    listing = root / f"task_info/task_{task}.json"
    rows = json.loads(listing.read_text()) if listing.exists() else []
    step = {"start_frame": 0, "end_frame": 5, "action_text": "Grasp the peach", "skill": "Pick"}
    rows.append({
        "episode_id": number, "task_id": task, "task_name": "Pickup in the supermarket ",
        "init_scene_text": "The robot stands at the shelf", "label_info": {"action_config": [step]},
    })  # fmt: skip
    listing.write_text(json.dumps(rows))
    return path


def settings(root: Path, **changes: Any) -> dict[str, Any]:
    return {"kind": "agibot_world", "path": str(root), "name": "agibot", "split": "train", **changes}


def load(root: Path, **changes: Any) -> Any:
    source = open_source(AgibotWorldSourceConfig.model_validate(settings(root, **changes)), root)
    return source.load(source.episode_ids()[0])


def test_published_layout_comes_through_curation(tmp_path: Path) -> None:
    path = write_episode(tmp_path / "raw")
    write_episode(tmp_path / "raw", number=648650, shade=30)
    counts, curated = run(tmp_path, settings(tmp_path / "raw"))
    assert (counts["found"], counts["reasons"]) == (2, {})
    row, episode = curated.rows[0], curated.episode(0)
    assert (row.episode_id, row.scene, row.split) == ("agibot-327-648642", "agibot-327", "train")
    assert (row.num_frames, row.fps, row.stage1_ok, row.stage2_ok) == (LENGTH, 30.0, True, True)
    assert episode.instruction == "pickup in the supermarket"
    with h5py.File(path) as file:
        ends = np.asarray(file["state/end/position"])
        for found, key in ((episode.state, JOINTS), (episode.action, "action/joint/position")):
            assert np.allclose(found[:, [*range(7), *range(8, 15)]], file[key], atol=1e-6)
    assert np.allclose(episode.state[:, 7], np.linspace(1, 0, LENGTH), atol=1e-6)  # 35 open .. 120 closed
    assert np.allclose(episode.action[:, 7], np.linspace(1, 0, LENGTH), atol=1e-6)  # 0 open .. 1 closed
    assert np.allclose(episode.state[:, 15], 1)
    # About x by `angle`, so that the tool's z is (0, -sin, cos): the quaternion is xyzw.
    angle = 0.3 + 0.05 * np.arange(LENGTH)
    along = np.stack([np.zeros(LENGTH), -np.sin(angle), np.cos(angle)], axis=1)
    assert np.allclose(episode.T_base_ee[:, 0, :3, 3], ends[:, 0] + 0.23 * along, atol=1e-6)
    wrist, head = episode.cameras["left_wrist"], episode.cameras["head"]
    assert not head.moving
    assert np.allclose(wrist.T_base_camera[:, :3, 3], [[0.1, 0.02 * n, 1.2] for n in range(LENGTH)])
    assert np.allclose(wrist.T_base_camera[0, :3, :3] @ [0, 0, 1], [1, 0, 0])  # looks along the base's x
    assert np.allclose(wrist.K, [[51, 0, 31.5], [0, 66, 23], [0, 0, 1]])
    images = curated.frames(0, "right_wrist").astype(int)
    assert images.shape == (LENGTH, HEIGHT, WIDTH, 3)
    assert abs(images[3, :, 0].mean() - (12 + 20)) < 3


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


def huge(file: Any) -> None:
    del file["state/end/position"]
    file.create_dataset("state/end/position", (10**9, 2, 3), "f8", chunks=(1024, 2, 3), compression="gzip")


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


def link_out(path: Path) -> None:
    elsewhere = video(path).rename(path.parents[4] / "elsewhere.mp4")
    video(path).symlink_to(elsewhere)


def other_video(length: int, fps: float) -> Damage:
    frames = np.zeros((length, HEIGHT, WIDTH, 3), dtype=np.uint8)
    return lambda path: encode_video(video(path), frames, fps, preset="ultrafast")


FAULTS: dict[str, tuple[Damage, str]] = {
    "no proprioception": (lambda path: path.unlink(), "missing_file"),
    "no video": (lambda path: video(path, "hand_left").unlink(), "missing_file"),
    "no calibration": (lambda path: extrinsics(path).unlink(), "missing_file"),
    "no task file": (lambda path: task_file(path).unlink(), "missing_file"),
    "not in task file": (rewritten(task_file, lambda _: []), "missing_column"),
    "truncated file": (cut, "unreadable"),
    "damaged chunk": (damage_chunk, "unreadable"),
    "truncated json": (lambda path: cut(extrinsics(path)), "unreadable"),
    "truncated video": (lambda path: cut(video(path)), "truncated_video"),
    "missing key": (without("action/joint/position"), "missing_column"),
    "a group for a dataset": (
        edit(lambda file: (file.__delitem__("timestamp"), file.create_group("timestamp"))), "missing_column",
    ),
    "text for numbers": (replaced("timestamp", lambda _: np.array([b"now"] * LENGTH)), "unreadable"),
    "wrong shape": (replaced("state/end/orientation", lambda _: np.zeros((LENGTH, 4))), "length_mismatch"),
    "empty commands": (replaced("action/joint/position", lambda _: np.zeros((0,))), "length_mismatch"),
    "a state less": (replaced(JOINTS, lambda v: v[1:]), "length_mismatch"),
    "a pose less": (rewritten(lambda path: extrinsics(path, "hand_left"), lambda rows: rows[1:]), "length_mismatch"),
    "a frame less": (other_video(LENGTH - 1, 30.0), "truncated_video"),
    "a frame more": (other_video(LENGTH + 1, 30.0), "length_mismatch"),
    "video of another rate": (other_video(LENGTH, 15.0), "wrong_fps"),
    "times of another rate": (replaced("timestamp", lambda v: 2 * v - v[0]), "wrong_fps"),
    "NaN joint": (replaced(JOINTS, with_nan), "nan_state"),
    "NaN gripper": (replaced("action/effector/position", with_nan), "nan_state"),
    "NaN time": (replaced("timestamp", with_nan), "nan_state"),
    "pose never written": (replaced("state/end/orientation", np.zeros_like), "nan_state"),
    "dexterous hands": (replaced("state/effector/position", lambda _: np.zeros((LENGTH, 12))), "invalid_gripper"),
    "joint beyond its limit": (replaced(JOINTS, lambda v: np.full_like(v, 3.0)), "joint_out_of_range"),
    "K of a larger image": (intrinsic("ppx", 640.0), "missing_calibration"),
    "K without focal length": (intrinsic("fx", None), "missing_column"),
    "K of zero focal length": (intrinsic("fx", 0.0), "singular_intrinsics"),
    "K not finite": (intrinsic("fy", float("nan")), "singular_intrinsics"),
    "no rotation": (pose(np.ones((3, 3)).tolist()), "invalid_extrinsics"),
    "ragged rotation": (pose([[1, 0], [0]]), "invalid_extrinsics"),
    "extrinsics without a field": (rewritten(extrinsics, lambda _: [{}]), "missing_column"),
    "video linked out of the folder": (link_out, "path_traversal"),
    "array linked out of the file": (leading_out(linked), "path_traversal"),
    "array linked by a detour": (leading_out(linked_by_a_detour), "path_traversal"),
    "array gathered from another file": (leading_out(virtual), "path_traversal"),
    "array stored out of the file": (leading_out(stored_outside), "path_traversal"),
    "array that was never written": (edit(huge), "unreadable"),
}  # fmt: skip


@pytest.mark.slow
def test_a_fault_quarantines_its_episode_alone(tmp_path: Path) -> None:
    check_faults(tmp_path / "raw", settings(tmp_path), lambda root, n: write_episode(root, n, n), FAULTS)


def test_nanoseconds_keep_their_precision(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_episode(tmp_path)
    times = load(tmp_path).episode.timestamps
    assert np.abs(times - np.rint(np.arange(LENGTH) * 1e9 / 30) * 1e-9).max() < 1e-12
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(UnavailableError, match=r"(?s)h5py.*uv sync --extra hdf5"):
        load(tmp_path)


def test_only_configured_views_are_needed(tmp_path: Path) -> None:
    video(write_episode(tmp_path), "hand_left").unlink()
    loaded = load(tmp_path, views=["head", "right_wrist"])
    assert loaded.views == ("head", "right_wrist")
    assert set(loaded.episode.cameras) == {"head", "right_wrist"}
    with pytest.raises(ValidationError, match="left_wrist"):
        AgibotWorldSourceConfig.model_validate(settings(tmp_path, views=["chest"]))
