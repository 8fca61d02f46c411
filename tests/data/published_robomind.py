"""RoboMIND 1 and 2 as they are published, written with h5py and OpenCV alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np

LENGTH, HEIGHT, WIDTH = 7, 48, 64
RGB = (200, 90, 20)
GRIPPER = {"closed": 1.0, "open": 0.0}


def jpegs(seed: int, *, rgb_for_bgr: bool = False) -> list[np.ndarray]:
    """One JPEG a frame as uint8 vectors; with `rgb_for_bgr` OpenCV is handed RGB, as some of the recorders did."""
    files = []
    for n in range(LENGTH):
        image = np.full((HEIGHT, WIDTH, 3), np.roll(RGB, seed), np.uint8)
        image[seed * 12 : seed * 12 + 10, 6 * n : 6 * n + 10] = 250
        image[:, 40 * seed : 40 * seed + 8] //= 2
        given = image if rgb_for_bgr else image[..., ::-1]
        files.append(cv2.imencode(".jpg", np.ascontiguousarray(given), [cv2.IMWRITE_JPEG_QUALITY, 95])[1].reshape(-1))
    return files


def write_images(file: Any, key: str, files: list[np.ndarray]) -> None:
    images = file.create_dataset(key, (len(files),), dtype=h5py.vlen_dtype(np.uint8))
    for n, content in enumerate(files):
        images[n] = content


def wave(width: int, seed: float = 0) -> np.ndarray:
    return 0.4 * np.sin(0.3 * np.arange(LENGTH)[:, None] + np.arange(width)[None] + seed)


def franka(seed: float = 0) -> np.ndarray:
    """Within the limits of a Panda's joints."""
    return np.array([0.0, -0.3, 0.0, -2.0, 0.0, 2.0, 0.5]) + 0.3 * wave(7, seed)


def trajectory(root: Path, task: str, episode: str, *, subset: str = "train") -> Path:
    parts = ["success_episodes", *([subset] if subset else []), episode, "data", "trajectory.hdf5"]
    path = root.joinpath(task, *parts)
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def write_franka(root: Path, task: str = "bread_in_basket", episode: str = "1014_144602", seed: int = 0) -> Path:
    path = trajectory(root, task, episode)
    with h5py.File(path, "w") as file:
        file.attrs["sim"], file.attrs["compress"] = False, True
        for camera in ("camera_top", "camera_left", "camera_right"):
            write_images(file, f"observations/rgb_images/{camera}", jpegs(seed))
            write_images(file, f"observations/depth_images/{camera}", jpegs(seed))
        joints = np.hstack([franka(seed), np.linspace(0, 1.02, LENGTH)[:, None]])
        file["puppet/joint_position"], file["master/joint_position"] = joints, joints + 0.1
        file["puppet/end_effector"] = wave(6)
        file["language_raw"] = [b"Put bread into the basket"]
    return path


def write_agilex(root: Path) -> Path:
    path = trajectory(root, "10_packplate", "2024_09_28-17_07_01-172751442153328896.00")
    with h5py.File(path, "w") as file:
        file.attrs["sim"], file.attrs["compress"] = False, True
        for seed, camera in enumerate(("camera_front", "camera_left_wrist", "camera_right_wrist")):
            write_images(file, f"observations/rgb_images/{camera}", jpegs(seed, rgb_for_bgr=True))
        for number, side in enumerate(("left", "right")):
            for track, shift in (("puppet", 0.0), ("master", 0.05)):
                gripper = np.linspace(0, 0.1, LENGTH)[:, None] * (1 if track == "puppet" else 50)
                file[f"{track}/joint_position_{side}"] = np.hstack([wave(6, number) + shift, gripper])
                file[f"{track}/joint_velocity_{side}"] = wave(7)
    return path


def write_version_2(root: Path, *, hand: int = 1) -> Path:
    path = trajectory(root, "place_coke_bottle_on_tray", "0416_130751", subset="")
    with h5py.File(path, "w") as file:
        file.create_group("metadata").attrs["language_instruction"] = "place_coke_bottle_on_tray"
        file["metadata"].attrs["collector"] = "station_3"
        file["camera_observations/timestamp"] = np.arange(LENGTH) // 14 + 1_744_779_000
        for seed, camera in enumerate(("camera_front", "camera_wrist_left", "camera_wrist_right")):
            write_images(file, f"camera_observations/color_images/{camera}", jpegs(seed))
        for track, shift in (("puppet", 0.0), ("master", 0.05)):
            for number, side in enumerate(("left", "right")):
                file[f"{track}/arm_{side}_position_align/data"] = wave(8, number) + shift
                file[f"{track}/end_effector_{side}_position_align/data"] = np.tile(
                    np.linspace(0, 1, LENGTH)[:, None], hand
                )
                file[f"{track}/end_effector_{side}_pose_align/data"] = wave(7)
    return path
