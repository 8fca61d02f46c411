"""RoboTwin 2's published HDF5 layout, written here with h5py and OpenCV, read by the source; never for training."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest
from pydantic import ValidationError

from tests.data.curating import Damage, check_faults, replaced, run, with_nan, without
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.errors import ConfigError

LENGTH, HEIGHT, WIDTH = 6, 48, 64
CAMERAS = ("front_camera", "head_camera", "left_camera", "right_camera")
RED, GREEN, BLUE = 200, 90, 20


def camera_pose(number: int) -> np.ndarray:
    """Camera-to-world, OpenCV axes: looks along the world's y, moves along x."""
    pose = np.tile(np.eye(4), (LENGTH, 1, 1))
    pose[:, :3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    pose[:, :3, 3] = [[0.1 * number + 0.01 * n, -0.4, 1.3] for n in range(LENGTH)]
    return pose


def write_episode(root: Path, number: int = 0) -> Path:
    folder = root / "beat_block_hammer" / "demo_clean"
    path = folder / "data" / f"episode{number}.hdf5"
    path.parent.mkdir(parents=True, exist_ok=True)
    wave = 0.3 * np.sin(np.arange(LENGTH)[:, None] + np.arange(6)[None] + number)
    with h5py.File(path, "w") as file:
        for index, arm in enumerate(("left", "right")):
            half = np.sqrt(0.5)
            # wxyz: a quarter turn about z takes x to y.
            pose = np.tile([0.3 * index, -0.2, 0.9, half, 0, 0, half], (LENGTH, 1))
            pose[:, 0] += 0.02 * np.arange(LENGTH) + 0.001 * number
            file[f"endpose/{arm}_endpose"] = pose
            file[f"endpose/{arm}_gripper"] = np.linspace(0, 1, LENGTH)
            file[f"joint_action/{arm}_arm"] = wave + index
            file[f"joint_action/{arm}_gripper"] = np.linspace(0, 1, LENGTH)
        file["joint_action/vector"] = np.zeros((LENGTH, 14))
        file["pointcloud"] = np.zeros((LENGTH, 0))
        for index, camera in enumerate(CAMERAS):
            group = f"observation/{camera}"
            image = np.full((HEIGHT, WIDTH, 3), (RED, GREEN, BLUE), dtype=np.uint8)
            # As the publisher does: OpenCV is handed RGB and takes it for BGR; shorter files are padded with zeros.
            encoded = [cv2.imencode(".jpg", np.roll(image, n, 1) // (1 + index))[1].tobytes() for n in range(LENGTH)]
            longest = max(map(len, encoded)) + 3
            file.create_dataset(f"{group}/rgb", data=np.array(encoded, dtype=f"S{longest}"))
            to_world = camera_pose(index)
            file[f"{group}/intrinsic_cv"] = np.tile([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]], (LENGTH, 1, 1))
            file[f"{group}/extrinsic_cv"] = np.linalg.inv(to_world)[:, :3]
            file[f"{group}/cam2world_gl"] = to_world @ np.diag([1.0, -1, -1, 1])
    instructions = folder / "instructions" / f"episode{number}.json"
    instructions.parent.mkdir(exist_ok=True)
    instructions.write_text(json.dumps({"seen": ["Hit the block.", "Strike it."], "unseen": ["Beat it."]}))
    return path


def settings(root: Path, **changes: Any) -> dict[str, Any]:
    return {"kind": "robotwin", "path": str(root), "name": "robotwin", "fps": 10, **changes}


def test_published_layout_comes_through_curation(tmp_path: Path) -> None:
    write_episode(tmp_path / "raw")
    write_episode(tmp_path / "raw", 1)
    counts, curated = run(tmp_path, settings(tmp_path / "raw"))
    assert (counts["found"], counts["splits"]) == (2, {"test": 2})
    row, episode = curated.rows[0], curated.episode(0)
    assert row.episode_id == "robotwin-beat_block_hammer-demo_clean-data-episode0"
    assert (row.num_frames, row.fps, row.stage2_ok) == (LENGTH, 10.0, True)
    assert episode.instruction == "hit the block"
    wave = 0.3 * np.sin(np.arange(LENGTH)[:, None] + np.arange(6)[None])
    assert np.allclose(episode.state[:, [*range(6), *range(7, 13)]], np.hstack([wave, wave + 1]), atol=1e-6)
    assert np.allclose(episode.state[:, [6, 13]], np.linspace(0, 1, LENGTH)[:, None], atol=1e-6)
    assert episode.state_names[5:8] == ("left/joint_6", "left/gripper", "right/joint_1")
    # The gripper points along the end pose's x, which the quarter turn laid along the world's y.
    assert np.allclose(episode.T_base_ee[:, 0, :3, 3], [[0.02 * n, -0.2 + 0.12, 0.9] for n in range(LENGTH)])
    assert np.allclose(episode.T_base_ee[:, :, :3, 2], [0, 1, 0])
    assert np.allclose(np.linalg.det(episode.T_base_ee[..., :3, :3]), 1)
    for index, view in ((1, "head"), (2, "left_wrist"), (3, "right_wrist")):
        assert np.allclose(episode.cameras[view].T_base_camera, camera_pose(index))
    colour = curated.frames(0, "head").reshape(-1, 3).mean(axis=0)
    assert np.abs(colour - np.array([RED, GREEN, BLUE]) // 2).max() < 6


def shifted(values: np.ndarray) -> np.ndarray:
    values[:, 0, 3] += 0.01
    return values


def zoomed(values: np.ndarray) -> np.ndarray:
    values[2, 0, 0] *= 1.1
    return values


HEAD = "observation/head_camera"
FAULTS: dict[str, tuple[Damage, str]] = {
    "no end poses": (without("endpose"), "missing_column"),
    "no camera": (without(HEAD), "missing_view"),
    "no calibration": (without(f"{HEAD}/extrinsic_cv"), "missing_column"),
    "an image less": (replaced(f"{HEAD}/rgb", lambda images: images[1:]), "length_mismatch"),
    "a joint row less": (replaced("joint_action/right_arm", lambda joints: joints[1:]), "length_mismatch"),
    "quaternions missing": (replaced("endpose/left_endpose", lambda poses: poses[:, :6]), "length_mismatch"),
    "NaN": (replaced("joint_action/left_arm", with_nan), "nan_state"),
    "pose never written": (replaced("endpose/right_endpose", np.zeros_like), "nan_state"),
    "camera matrices disagree": (replaced(f"{HEAD}/cam2world_gl", shifted), "invalid_extrinsics"),
    "extrinsics the other way round": (
        replaced(f"{HEAD}/extrinsic_cv", lambda _: camera_pose(1)[:, :3]), "invalid_extrinsics",
    ),
    "zoom": (replaced(f"{HEAD}/intrinsic_cv", zoomed), "singular_intrinsics"),
    "no image": (replaced(f"{HEAD}/rgb", lambda images: np.array([b"jpeg"] * LENGTH)), "unreadable"),
    "raw images": (replaced(f"{HEAD}/rgb", lambda _: np.zeros((LENGTH, HEIGHT, WIDTH, 3), np.uint8)), "unreadable"),
    "instructions of another form": (
        lambda path: (path.parents[1] / "instructions" / f"{path.stem}.json").write_text("[]"), "missing_column",
    ),
}  # fmt: skip


def test_a_fault_quarantines_its_episode_alone(tmp_path: Path) -> None:
    check_faults(tmp_path / "raw", settings(tmp_path), write_episode, FAULTS)


@pytest.mark.parametrize("split", ["train", "validation"])
def test_evaluation_sources_are_refused_as_training_data(tmp_path: Path, split: str) -> None:
    for source in (
        settings(tmp_path, split=split),
        {"kind": "droid_annotation", "path": str(tmp_path), "split": split},
    ):
        with pytest.raises(ValidationError, match=f"evaluation only: split {split} is refused"):
            CurateConfig.model_validate({"sources": [source]})
    write_episode(tmp_path / "raw")
    with pytest.raises(ConfigError, match=r"(?s)evaluation only.*beat_block_hammer.*" + split):
        run(tmp_path, settings(tmp_path / "raw"), splits={"robotwin-*": split})
