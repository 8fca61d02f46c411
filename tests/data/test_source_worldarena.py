"""WorldArena's two layouts, written here with h5py, NumPy and OpenCV, read by the source; never for training."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest
import yaml

from tests.data.curating import Damage, check_faults, replaced, run, with_nan, without
from worldline_core.data.video.encoder import encode_video

T, HEIGHT, WIDTH = 6, 48, 64
TASK = "fixed_scene_task"


def track(number: int) -> np.ndarray:
    rows = 0.3 * np.sin(np.arange(T)[:, None] + np.arange(14) + number)
    rows[:, [6, 13]] = np.linspace(0, 1, T)[:, None]
    return rows


def pictures(number: int, scale: int = 1) -> np.ndarray:
    frames = np.full((T, HEIGHT * scale, WIDTH * scale, 3), 60 + 20 * (number % 8), np.uint8)
    for frame in range(T):
        frames[frame, : HEIGHT // 2, 8 * frame : 8 * frame + 8] = (200, 90, 20)
    return frames


def write_picture(path: Path, picture: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), picture[..., ::-1])


def write_instruction(root: Path, number: int) -> None:
    path = root / f"instructions/{TASK}/episode{number}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"instruction": f"Move bottle {number}."}))


def write_track_1(root: Path, number: int = 1, *, within: str = f"{TASK}/", video: bool = True, scale: int = 1) -> Path:
    """One episode of track 1 as its repository and its dataset's card describe it; returns the trajectory."""
    path = root / f"data/{within}episode{number}.hdf5"
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        file["joint_action/vector"] = track(number)
        file["pointcloud"] = np.zeros((T, 0))
    write_picture(root / f"first_frame/{TASK}/episode{number}.png", pictures(number)[0])
    write_instruction(root, number)
    if video:
        place = root / f"video/{TASK if within else ''}/episode{number}.mp4"
        place.parent.mkdir(parents=True, exist_ok=True)
        encode_video(place, pictures(number, scale), 24, crf=0, pixel_format="yuv444p")
    return path


def write_track_2(root: Path, number: int = 1) -> None:
    for folder, values in (("actions", track(number)), ("states", np.zeros((T, 16)))):
        path = root / folder / TASK / f"episode{number}.npy"
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, values)
    write_picture(root / f"images/{TASK}/episode{number}.png", pictures(number)[0])
    write_instruction(root, number)


def settings(root: Path, **changes: Any) -> dict[str, Any]:
    return {"kind": "worldarena", "path": str(root), "name": "worldarena", **changes}


@pytest.mark.parametrize("within", [f"{TASK}/", "_traj_data/", f"_traj_data/{TASK}/"])
def test_track_1_gives_its_first_frame_and_true_video(tmp_path: Path, within: str) -> None:
    for number in (1, 2):
        write_track_1(tmp_path / "raw", number, within=within, scale=2)
    counts, curated = run(tmp_path, settings(tmp_path / "raw"))
    assert (counts["found"], counts["splits"]) == (2, {"test": 2})
    row, episode = curated.rows[1], curated.episode(1)
    assert row.episode_id == ("worldarena-episode2" if within == "_traj_data/" else f"worldarena-{TASK}-episode2")
    assert (row.num_frames, row.video_frames, row.fps, row.views) == (T, T, 24.0, ("head",))
    assert episode.instruction == "move bottle 2"
    assert episode.commanded
    assert np.allclose(episode.action, track(2), atol=1e-6)
    assert (episode.state_names[6], episode.state_names[7]) == ("left/gripper", "right/joint_1")
    shown = curated.frames(1, "head")
    assert shown.shape == (T, 2 * HEIGHT, 2 * WIDTH, 3)
    first = cv2.resize(pictures(2)[0], (2 * WIDTH, 2 * HEIGHT), interpolation=cv2.INTER_CUBIC)
    for found, wanted in zip(shown, [first, *pictures(2, 2)[1:]], strict=True):
        assert np.abs(found.astype(int) - wanted).mean() < 4


@pytest.mark.parametrize("write", [lambda root: write_track_1(root, video=False), write_track_2])
def test_an_episode_without_a_true_video_shows_its_first_frame(tmp_path: Path, write: Any) -> None:
    write(tmp_path / "raw")
    _, curated = run(tmp_path, settings(tmp_path / "raw", fps=8))
    row = curated.rows[0]
    assert (row.num_frames, row.video_frames, row.fps) == (T, 1, 8.0)
    assert np.abs(curated.frames(0, "head")[0].astype(int) - pictures(1)[0]).mean() < 4
    assert np.allclose(curated.episode(0).action, track(1), atol=1e-6)


def test_the_camera_of_a_file_is_that_of_all_episodes(tmp_path: Path) -> None:
    write_track_1(tmp_path / "raw", scale=2)
    entry = {
        "width": WIDTH, "height": HEIGHT, "K": [[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]], "maps": "camera_to_base",
        "axes": "opencv", "T": np.eye(4).tolist(),
    }  # fmt: skip
    (tmp_path / "raw/cameras.yaml").write_text(yaml.safe_dump({"views": {"head": entry}}))
    _, curated = run(tmp_path, settings(tmp_path / "raw", calibration="cameras.yaml"))
    assert np.allclose(curated.episode(0).cameras["head"].K[0], [120, 0, 63.5])


FAULTS: dict[str, tuple[Damage, str]] = {
    "no trajectory": (without("joint_action"), "missing_column"),
    "another robot": (replaced("joint_action/vector", lambda rows: rows[:, :7]), "length_mismatch"),
    "NaN": (replaced("joint_action/vector", with_nan), "nan_state"),
    "a gripper in millimetres": (replaced("joint_action/vector", lambda rows: 80 * rows + 20), "invalid_gripper"),
    "a row less than the video": (replaced("joint_action/vector", lambda rows: rows[1:]), "length_mismatch"),
    "no first frame": (lambda path: picture_of(path).unlink(), "missing_file"),
    "a first frame of other proportions": (
        lambda path: write_picture(picture_of(path), np.zeros((48, 48, 3), np.uint8)), "contradicting_tracks",
    ),
    "another rate": (
        lambda path: encode_video(beside(path, "video", ".mp4"), pictures(0), 30), "wrong_fps",
    ),
    "no instruction": (lambda path: beside(path, "instructions", ".json").write_text('{"seen": []}'), "missing_column"),
}  # fmt: skip


def beside(path: Path, kind: str, suffix: str) -> Path:
    return path.parents[2] / kind / TASK / f"{path.stem}{suffix}"


def picture_of(path: Path) -> Path:
    return beside(path, "first_frame", ".png")


def test_a_fault_quarantines_its_episode_alone(tmp_path: Path) -> None:
    check_faults(tmp_path / "raw", settings(tmp_path), write_track_1, FAULTS)
