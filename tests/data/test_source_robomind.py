"""RoboMIND 1 and 2 in their published layouts, written here with h5py and OpenCV, read by the source."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest
from pydantic import ValidationError

from tests.data.curating import Damage, check_faults, edit, replaced, run, with_nan, without
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.sources.hdf5 import open_hdf5
from worldline_core.errors import DataError

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


def settings(root: Path, layout: str = "h5_franka_3rgb", **changes: Any) -> dict[str, Any]:
    source = {"kind": "robomind", "path": str(root), "name": "robomind", "layout": layout, "fps": 10}
    return {**source, "gripper_state": GRIPPER, "split": "train", **changes}


def test_franka_of_version_1(tmp_path: Path) -> None:
    write_franka(tmp_path / "h5_franka_3rgb")
    write_franka(tmp_path / "h5_franka_3rgb", "close_drawer", "1014_144602", seed=1)
    counts, curated = run(tmp_path, settings(tmp_path / "h5_franka_3rgb"))
    assert (counts["found"], counts["kept"]) == (2, 2)
    row, episode = curated.rows[0], curated.episode(0)
    assert row.episode_id == "robomind-bread_in_basket-success_episodes-train-1014_144602"
    assert (row.scene, row.outcome) == ("robomind-bread_in_basket", "success")
    assert row.instruction == "put bread into the basket"
    assert (row.embodiment, row.fps, row.num_frames, row.stage2_ok) == ("franka_panda", 10.0, LENGTH, False)
    assert np.allclose(episode.state[:, :7], franka(), atol=1e-6)
    assert np.allclose(episode.state[:, 7], 1 - np.linspace(0, 1.02, LENGTH).clip(0, 1), atol=1e-6)
    assert np.array_equal(episode.state, episode.action)
    assert episode.conventions["action"] == "repeats the state"
    assert episode.conventions["gripper_overshoot"] == 1
    assert episode.state_names == (*(f"right/joint_{i}" for i in range(1, 8)), "right/gripper")
    colour = np.median(curated.frames(0, "head").reshape(-1, 3), axis=0)
    assert np.abs(colour - RGB).max() < 8


def test_agilex_of_version_1(tmp_path: Path) -> None:
    write_agilex(tmp_path / "h5_agilex_3rgb")
    readings = {"gripper_state": {"closed": 0, "open": 0.1}, "gripper_command": {"closed": 0, "open": 5}}
    _, curated = run(tmp_path, settings(tmp_path / "h5_agilex_3rgb", "h5_agilex_3rgb", **readings))
    episode = curated.episode(0)
    assert curated.rows[0].views == ("head", "left_wrist", "right_wrist")
    for start, number in ((0, 0), (7, 1)):
        assert np.allclose(episode.state[:, start : start + 6], wave(6, number), atol=1e-6)
        assert np.allclose(episode.action[:, start : start + 6], wave(6, number) + 0.05, atol=1e-6)
        for values in (episode.state, episode.action):
            assert np.allclose(values[:, start + 6], np.linspace(0, 1, LENGTH), atol=1e-6)
    assert np.abs(np.median(curated.frames(0, "head").reshape(-1, 3), axis=0) - RGB).max() < 8


def test_a_robot_with_hands_has_joints_alone(tmp_path: Path) -> None:
    path = trajectory(tmp_path / "raw", "plate_push", "2024-11-13-16-52-40")
    with h5py.File(path, "w") as file:
        write_images(file, "observations/rgb_images/camera_top", jpegs(0, rgb_for_bgr=True))
        file["puppet/joint_position"], file["puppet/end_effector"] = wave(14), wave(12)
    _, curated = run(tmp_path, settings(tmp_path / "raw", "h5_tienkung_xsens_1rgb", gripper_state=None))
    episode = curated.episode(0)
    assert np.allclose(episode.state, wave(14), atol=1e-6)
    assert episode.state_names[6:8] == ("left/joint_7", "right/joint_1")


def test_version_2(tmp_path: Path) -> None:
    write_version_2(tmp_path / "franka")
    declared = {"gripper_command": GRIPPER, "channels": "standard", "fps": 14}
    _, curated = run(tmp_path, settings(tmp_path / "franka", "v2_franka", **declared))
    episode = curated.episode(0)
    assert curated.rows[0].episode_id == "robomind-place_coke_bottle_on_tray-success_episodes-0416_130751"
    assert curated.rows[0].instruction == "place coke bottle on tray"
    assert episode.conventions["collector"] == "station_3"
    assert episode.state.shape == (LENGTH, 16)
    assert np.allclose(episode.state[:, 8:15], wave(8, 1)[:, :7], atol=1e-6)
    assert np.allclose(episode.action[:, :7], wave(8)[:, :7] + 0.05, atol=1e-6)
    assert np.allclose(episode.state[:, [7, 15]], np.linspace(1, 0, LENGTH)[:, None], atol=1e-6)


@pytest.mark.parametrize("channels", ["standard", "as_written"])
@pytest.mark.parametrize("fixed", [False, True])
def test_bare_pixels_are_read_by_their_size(tmp_path: Path, channels: str, fixed: bool) -> None:
    """As the publisher's reader does: frames of 480 x 640 or 720 x 1280, in the order in which it decodes JPEG files."""
    path = write_franka(tmp_path / "raw")
    frames = np.zeros((LENGTH, 480, 640, 3), np.uint8)
    frames[:, :400, 100:] = RGB  # black at the end
    stored = frames[..., ::-1] if channels == "standard" else frames
    with h5py.File(path, "r+") as file:
        key = "observations/rgb_images/camera_top"
        del file[key]
        contents = [image.tobytes() for image in stored]
        if fixed:
            file[key] = np.array(contents, f"S{480 * 640 * 3}")
        else:
            write_images(file, key, [np.frombuffer(content, np.uint8) for content in contents])
    _, curated = run(tmp_path, settings(tmp_path / "raw", channels=channels))
    assert np.abs(curated.frames(0, "head")[:, 200, 400].astype(int) - RGB).max() < 8


def test_instructions_of_the_table(tmp_path: Path) -> None:
    write_franka(tmp_path / "raw")
    write_franka(tmp_path / "raw", "close_drawer", seed=1)
    (tmp_path / "raw/instr.csv").write_text(',task,instruction\n0,bread_in_basket,"take bread, put it in"\n1,x,y\n')
    counts, curated = run(tmp_path, settings(tmp_path / "raw", instructions="instr.csv"))
    assert counts["reasons"] == {"missing_column": 1}
    assert curated.rows[0].instruction == "take bread, put it in"


def image(make: Callable[[np.ndarray], np.ndarray], frame: int = 3) -> Damage:
    def change(file: Any) -> None:
        images = file["observations/rgb_images/camera_top"]
        images[frame] = make(images[frame])

    return edit(change)


def smaller(content: np.ndarray) -> np.ndarray:
    decoded = cv2.imdecode(content, cv2.IMREAD_COLOR)
    return cv2.imencode(".jpg", decoded[::2, ::2])[1].reshape(-1)


JOINTS = "puppet/joint_position"
FAULTS: dict[str, tuple[Damage, str]] = {
    "no joints": (without(JOINTS), "missing_column"),
    "joints of another robot": (replaced(JOINTS, lambda v: v[:, :7]), "length_mismatch"),
    "a joint that is no number": (replaced(JOINTS, with_nan), "nan_state"),
    "one state fewer": (replaced(JOINTS, lambda v: v[:-1]), "length_mismatch"),
    "no such camera": (without("observations/rgb_images/camera_top"), "missing_view"),
    "an image that is none": (image(lambda v: v[::-1].copy()), "unreadable"),
    "an image of another size": (image(smaller), "unreadable"),
    "joints in degrees": (replaced(JOINTS, lambda v: np.rad2deg(v) * [*[1] * 7, 0]), "joint_out_of_range"),
}


def test_a_fault_quarantines_its_episode_alone(tmp_path: Path) -> None:
    check_faults(
        tmp_path / "raw", settings(tmp_path), lambda root, n: write_franka(root, episode=f"1014_{n}", seed=n), FAULTS
    )


def test_a_dexterous_hand_is_no_gripper(tmp_path: Path) -> None:
    write_version_2(tmp_path / "raw", hand=6)
    with pytest.raises(DataError, match="invalid_gripper"):
        run(tmp_path, settings(tmp_path / "raw", "v2_franka", gripper_command=GRIPPER, channels="standard"))


@pytest.mark.parametrize(
    ("layout", "changes", "missing"),
    [
        ("h5_franka_3rgb", {"gripper_state": None}, "gripper_state"),
        ("h5_agilex_3rgb", {}, "gripper_command"),
        ("h5_franka_1rgb", {}, "channels"),
        ("v2_ur", {"gripper_command": GRIPPER}, "channels"),
    ],
)
def test_what_is_not_said_must_be_declared(tmp_path: Path, layout: str, changes: dict[str, Any], missing: str) -> None:
    with pytest.raises(ValidationError, match=rf"does not say it of {layout}, so declare {missing}"):
        CurateConfig.model_validate({"sources": [settings(tmp_path, layout, **changes)]})


def test_texts_and_attributes(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        file["scalar"], file["single"], file["many"] = "wipe", [b"w\xc3\xa4sch"], [b"a", b"b"]
        file.attrs["count"] = np.int64(3)
        file.create_group("group").attrs["list"] = [1, 2]
    with open_hdf5(tmp_path / "a.hdf5") as file:
        assert (file.text("scalar"), file.text("single"), file.text("none")) == ("wipe", "wäsch", None)
        assert file.attribute("/", "count") == "3"
        assert file.attribute("/", "other") is file.attribute("no", "x") is None
        with pytest.raises(DataError, match="no single text"):
            file.text("many")
        with pytest.raises(DataError, match="Entry is no text"):
            file.attribute("group", "list")
