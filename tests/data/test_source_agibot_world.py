"""AgiBot World's published layout, written here with h5py, json and our video encoder, read by the source."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

h5py = pytest.importorskip("h5py", reason="the extra `hdf5` is not installed")

from damaged_hdf5 import Damage, cut, edit, kept_beside, replaced, with_nan, without

from worldline_core.data.curation.curate import curate
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.sources.agibot import AgibotWorldSourceConfig
from worldline_core.data.sources.open import open_source
from worldline_core.data.video.encoder import encode_video
from worldline_core.errors import UnavailableError

LENGTH, HEIGHT, WIDTH = 8, 48, 64
CAMERAS = ("head", "hand_left", "hand_right")
START_NS = 1_718_000_000_123_456_789


def quaternion_xyzw(length: int, arm: int) -> np.ndarray:
    angle = 0.3 + 0.05 * np.arange(length) + arm
    return np.stack([np.sin(angle / 2), np.zeros(length), np.zeros(length), np.cos(angle / 2)], axis=1)


def write_episode(root: Path, task: int = 327, number: int = 648642, shade: int = 0) -> Path:
    """One episode, and its row in the task's file; returns the proprioception file."""
    ids = f"{task}/{number}"
    for folder in (
        f"proprio_stats/{ids}",
        f"observations/{ids}/videos",
        f"parameters/{ids}/parameters/camera",
        "task_info",
    ):
        (root / folder).mkdir(parents=True, exist_ok=True)
    wave = 0.4 * np.sin(np.arange(LENGTH)[:, None] / 5 + np.arange(14)[None] + number)
    effector = np.stack([np.linspace(35, 120, LENGTH), np.full(LENGTH, 35.0)], axis=1)
    path = root / f"proprio_stats/{ids}/proprio_stats.h5"
    with h5py.File(path, "w") as file:
        file["timestamp"] = START_NS + np.rint(np.arange(LENGTH) * 1e9 / 30).astype(np.int64)
        file["state/joint/position"] = wave
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
    rows.append(
        {
            "episode_id": number,
            "task_id": task,
            "task_name": "Pickup in the supermarket ",
            "init_scene_text": "The robot stands at the shelf",
            "label_info": {"action_config": [step]},
        }
    )
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
    counts = curate(CurateConfig.model_validate({"sources": [settings(tmp_path / "raw")]}), {}, tmp_path / "out")
    assert (counts["found"], counts["kept"], counts["reasons"]) == (2, 2, {})
    curated = EpisodeSet.open(tmp_path / "out")
    row, episode = curated.rows[0], curated.episode(0)
    assert (row.episode_id, row.scene, row.split) == ("agibot-327-648642", "agibot-327", "train")
    assert (row.num_frames, row.fps, row.stage1_ok, row.stage2_ok) == (LENGTH, 30.0, True, True)
    assert episode.instruction == "pickup in the supermarket"
    with h5py.File(path) as file:
        joints = np.asarray(file["state/joint/position"])
        ends = np.asarray(file["state/end/position"])
        commands = np.asarray(file["action/joint/position"])
    assert np.allclose(episode.state[:, [*range(7), *range(8, 15)]], joints, atol=1e-6)
    assert np.allclose(episode.action[:, [*range(7), *range(8, 15)]], commands, atol=1e-6)
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


PROPRIO = "proprio_stats/327/648642/proprio_stats.h5"


def edit_h5(root: Path, change: Callable[[Any], object]) -> None:
    edit(change)(root / PROPRIO)


def values_of(key: str, make: Callable[[np.ndarray], Any]) -> Damage:
    return lambda root: replaced(key, make)(root / PROPRIO)


def parameters(root: Path, name: str) -> Path:
    return root / f"parameters/327/648642/parameters/camera/{name}.json"


def external_link(root: Path) -> None:
    with h5py.File(root.parent / "outside.h5", "w") as outside:
        outside["secret"] = np.zeros((LENGTH, 14))

    def change(file: Any) -> None:
        del file["state/joint/position"]
        file["state/joint/position"] = h5py.ExternalLink("../../../../outside.h5", "secret")

    edit_h5(root, change)


def linked_twice(root: Path) -> None:
    """A soft link to what an external link leads to."""
    external_link(root)

    def change(file: Any) -> None:
        file.move("state/joint/position", "elsewhere")
        file["state/joint/position"] = h5py.SoftLink("/elsewhere")

    edit_h5(root, change)


def virtual(root: Path) -> None:
    external_link(root)
    layout = h5py.VirtualLayout((LENGTH, 14), "f8")
    layout[:] = h5py.VirtualSource(str(root.parent / "outside.h5"), "secret", (LENGTH, 14))

    def change(file: Any) -> None:
        del file["state/joint/position"]
        file.create_virtual_dataset("state/joint/position", layout)

    edit_h5(root, change)


def external_storage(root: Path) -> None:
    (root.parent / "outside.bin").write_bytes(bytes(LENGTH * 14 * 8))

    def change(file: Any) -> None:
        del file["state/joint/position"]
        where = [(str(root.parent / "outside.bin"), 0, h5py.h5f.UNLIMITED)]
        file.create_dataset("state/joint/position", (LENGTH, 14), "f8", external=where)

    edit_h5(root, change)


def huge(root: Path) -> None:
    def change(file: Any) -> None:
        del file["state/end/position"]
        file.create_dataset("state/end/position", (10**9, 2, 3), "f8", chunks=(1024, 2, 3), compression="gzip")

    edit_h5(root, change)


def damage_chunk(root: Path) -> None:
    """The data of one compressed array overwritten: the file opens, the array does not decompress."""
    path = root / "proprio_stats/327/648642/proprio_stats.h5"
    with h5py.File(path, "r+") as file:
        values = file["state/joint/position"][()]
        del file["state/joint/position"]
        dataset = file.create_dataset("state/joint/position", data=values, compression="gzip")
        chunk = dataset.id.get_chunk_info(0)
        offset, size = chunk.byte_offset, chunk.size
    with path.open("r+b") as stream:
        stream.seek(offset)
        stream.write(b"\xff" * size)


def rewrite(path: Path, change: Callable[[Any], Any]) -> None:
    path.write_text(json.dumps(change(json.loads(path.read_text()))))


def set_intrinsic(key: str, value: object) -> Damage:
    return lambda root: rewrite(
        parameters(root, "head_intrinsic_params"), lambda record: {"intrinsic": {**record["intrinsic"], key: value}}
    )


def link_out(root: Path) -> None:
    video = root / "observations/327/648642/videos/head_color.mp4"
    shutil.move(video, root.parent / "elsewhere.mp4")
    video.symlink_to(root.parent / "elsewhere.mp4")


def other_video(length: int, fps: float) -> Damage:
    def change(root: Path) -> None:
        frames = np.zeros((length, HEIGHT, WIDTH, 3), dtype=np.uint8)
        encode_video(root / "observations/327/648642/videos/head_color.mp4", frames, fps, preset="ultrafast")

    return change


FAULTS: dict[str, tuple[Damage, str]] = {
    "no proprioception": (lambda root: shutil.rmtree(root / "proprio_stats"), "missing_file"),
    "no video": (lambda root: (root / "observations/327/648642/videos/hand_left_color.mp4").unlink(), "missing_file"),
    "no calibration": (lambda root: parameters(root, "head_extrinsic_params_aligned").unlink(), "missing_file"),
    "no task file": (lambda root: shutil.rmtree(root / "task_info"), "missing_file"),
    "not in task file": (lambda root: rewrite(root / "task_info/task_327.json", lambda _: []), "missing_column"),
    "truncated file": (
        lambda root: cut(root / PROPRIO),
        "unreadable",
    ),
    "damaged chunk": (damage_chunk, "unreadable"),
    "truncated json": (lambda root: cut(parameters(root, "head_extrinsic_params_aligned")), "unreadable"),
    "truncated video": (
        lambda root: cut(root / "observations/327/648642/videos/head_color.mp4"),
        "truncated_video",
    ),
    "missing key": (lambda root: without("action/joint/position")(root / PROPRIO), "missing_column"),
    "a group for a dataset": (
        lambda root: edit_h5(root, lambda f: (f.__delitem__("timestamp"), f.create_group("timestamp"))),
        "missing_column",
    ),
    "text for numbers": (
        values_of("timestamp", lambda _: np.array([b"now"] * LENGTH)),
        "unreadable",
    ),
    "wrong shape": (
        values_of("state/end/orientation", lambda _: np.zeros((LENGTH, 4))),
        "length_mismatch",
    ),
    "empty commands": (
        values_of("action/joint/position", lambda _: np.zeros((0,))),
        "length_mismatch",
    ),
    "a state less": (
        values_of("state/joint/position", lambda _: np.zeros((LENGTH - 1, 14))),
        "length_mismatch",
    ),
    "a pose less": (
        lambda root: rewrite(parameters(root, "hand_left_extrinsic_params_aligned"), lambda rows: rows[1:]),
        "length_mismatch",
    ),
    "a frame less": (other_video(LENGTH - 1, 30.0), "truncated_video"),
    "a frame more": (other_video(LENGTH + 1, 30.0), "length_mismatch"),
    "video of another rate": (other_video(LENGTH, 15.0), "wrong_fps"),
    "times of another rate": (
        values_of("timestamp", lambda _: START_NS + np.arange(LENGTH, dtype=np.int64) * 66_666_667),
        "wrong_fps",
    ),
    "NaN joint": (values_of("state/joint/position", with_nan), "nan_state"),
    "NaN gripper": (values_of("action/effector/position", with_nan), "nan_state"),
    "NaN time": (values_of("timestamp", with_nan), "nan_state"),
    "pose never written": (
        values_of("state/end/orientation", lambda _: np.zeros((LENGTH, 2, 4))),
        "nan_state",
    ),
    "dexterous hands": (
        values_of("state/effector/position", lambda _: np.zeros((LENGTH, 12))),
        "invalid_gripper",
    ),
    "joint beyond its limit": (
        values_of("state/joint/position", lambda _: np.full((LENGTH, 14), 3.0)),
        "joint_out_of_range",
    ),
    "K of a larger image": (set_intrinsic("ppx", 640.0), "missing_calibration"),
    "K without focal length": (set_intrinsic("fx", None), "missing_column"),
    "K of zero focal length": (set_intrinsic("fx", 0.0), "singular_intrinsics"),
    "K not finite": (set_intrinsic("fy", float("nan")), "singular_intrinsics"),
    "no rotation": (
        lambda root: rewrite(
            parameters(root, "head_extrinsic_params_aligned"),
            lambda rows: [
                {"extrinsic": {"rotation_matrix": np.ones((3, 3)).tolist(), "translation_vector": [0, 0, 0]}}
            ],
        ),
        "invalid_extrinsics",
    ),
    "ragged rotation": (
        lambda root: rewrite(
            parameters(root, "head_extrinsic_params_aligned"),
            lambda rows: [{"extrinsic": {"rotation_matrix": [[1, 0], [0]], "translation_vector": [0, 0, 0]}}],
        ),
        "invalid_extrinsics",
    ),
    "extrinsics without a field": (
        lambda root: rewrite(parameters(root, "head_extrinsic_params_aligned"), lambda rows: [{}]),
        "missing_column",
    ),
    "video linked out of the folder": (link_out, "path_traversal"),
    "array linked out of the file": (external_link, "path_traversal"),
    "array linked by a detour": (linked_twice, "path_traversal"),
    "array gathered from another file": (virtual, "path_traversal"),
    "array stored out of the file": (external_storage, "path_traversal"),
    "array that was never written": (huge, "unreadable"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_quarantines_its_episode_alone(tmp_path: Path, fault: str) -> None:
    damage, reason = FAULTS[fault]
    write_episode(tmp_path / "raw")
    damage(tmp_path / "raw")
    write_episode(tmp_path / "raw", task=400, number=1, shade=30)  # a sound neighbour
    assert kept_beside(settings(tmp_path / "raw"), tmp_path / "out", reason) == "agibot-400-1"


def test_videos_are_decoded_only_when_asked_for(tmp_path: Path) -> None:
    write_episode(tmp_path)
    other_video(LENGTH - 1, 30.0)(tmp_path)
    loaded = load(tmp_path)
    assert loaded.frames("left_wrist").shape == (LENGTH, HEIGHT, WIDTH, 3)
    with pytest.raises(RejectedInputError, match="truncated") as caught:
        loaded.frames("head")
    assert caught.value.evidence == {"expected_frames": LENGTH, "decoded_frames": LENGTH - 1}


def test_nanoseconds_keep_their_precision(tmp_path: Path) -> None:
    write_episode(tmp_path)
    times = load(tmp_path).episode.timestamps
    assert np.abs(times - np.rint(np.arange(LENGTH) * 1e9 / 30) * 1e-9).max() < 1e-12


def test_without_h5py_the_source_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_episode(tmp_path)
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(UnavailableError, match=r"(?s)h5py.*uv sync --extra hdf5"):
        load(tmp_path)


def test_only_configured_views_are_needed(tmp_path: Path) -> None:
    write_episode(tmp_path)
    (tmp_path / "observations/327/648642/videos/hand_left_color.mp4").unlink()
    loaded = load(tmp_path, views=["head", "right_wrist"])
    assert loaded.views == ("head", "right_wrist")
    assert set(loaded.episode.cameras) == {"head", "right_wrist"}
    with pytest.raises(ValidationError, match="left_wrist"):
        AgibotWorldSourceConfig.model_validate(settings(tmp_path, views=["chest"]))
