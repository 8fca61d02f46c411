"""The two HDF5 layouts that Unitree's tools write, written here with h5py and read by the source."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest
from pydantic import ValidationError

from tests.data.curating import (
    Damage,
    black_video,
    check_faults,
    cut,
    moved_out,
    rejected,
    replaced,
    run,
    with_nan,
    without,
)
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.sources.open import open_source
from worldline_core.data.sources.unitree_h5 import UnitreeH5SourceConfig
from worldline_core.data.video.encoder import encode_video

LENGTH, HEIGHT, WIDTH = 6, 48, 64
HEADER = "videoid,contentUrl,duration,data_dir,instruction,embodiment\n"
Write = Callable[..., Path]


ROBOTS = {
    "g1_dex1": (16, [*range(7), 14, *range(7, 14), 15], [7, 15]),
    "z1_dual": (14, list(range(14)), [6, 13]),
    "z1_dual_grippers_last": (14, [*range(6), 12, *range(6, 12), 13], [6, 13]),
    "z1_single": (7, list(range(7)), [6]),
    "aloha": (14, list(range(14)), [6, 13]),
}
"""Columns, their order in the state, and where its grippers are."""


def motors(robot: str = "g1_dex1", offset: float = 0.0) -> np.ndarray:
    """(N, columns) in the robot's order: joints within a Z1's limits, grippers of 0.2 .. 0.4, and a little motion."""
    columns, order, grippers = ROBOTS[robot]
    state = np.tile([0.3, 0.6, -0.9, 0.2, 0.1, -0.2, 0.25], 3)[:columns] + offset + 0.01 * np.arange(LENGTH)[:, None]
    state[:, grippers] = 0.28 + offset + 0.01 * np.arange(LENGTH)[:, None]
    return state[:, np.argsort(order)]


def pictures(shade: int = 0) -> np.ndarray:
    """Reddish ramps that change from frame to frame."""
    ramp = np.linspace(40, 160, WIDTH)[None, None] + 6 * np.arange(LENGTH)[:, None, None] + np.zeros((1, HEIGHT, 1))
    return ((ramp + shade)[..., None] * [1, 0.5, 0.25]).astype(np.uint8)


def write_transitions(
    root: Path, number: int = 0, shade: int = 0, dataset: str = "pack_camera", robot: str = "g1_dex1"
) -> Path:
    """One recording of UnifoLM-WMA's layout, and its rows in the table (one a camera); returns the file."""
    path = root / f"transitions/{dataset}/{number}.h5"
    path.parent.mkdir(parents=True, exist_ok=True)
    (path.parent / "meta_data").mkdir(exist_ok=True)
    with h5py.File(path, "w") as file:
        file["observation.state"], file["action"] = motors(robot), motors(robot, 0.02)
        file.attrs["state_type"] = file.attrs["action_type"] = "joint position"
        file.attrs["robot_type"] = "Unitree G1 Robot with Gripper"
    table = root / f"{dataset}.csv"
    text = table.read_text() if table.exists() else HEADER
    for camera in ("cam_left_high", "cam_right_wrist"):
        folder = root / f"videos/{dataset}/{camera}"
        folder.mkdir(parents=True, exist_ok=True)
        encode_video(folder / f"{number}.mp4", pictures(shade), 30.0, crf=5, preset="ultrafast")
        text += f'{number},x,x,{dataset}/{camera},"Pack the camera, then close the box.",Unitree G1\n'
    table.write_text(text)
    return path


def write_hdf5(root: Path, number: int = 0, shade: int = 0, robot: str = "g1_dex1") -> Path:
    """One recording as unitree_IL_lerobot converts it: pixels with blue first."""
    root.mkdir(parents=True, exist_ok=True)
    path = root / f"episode_{number}.hdf5"
    with h5py.File(path, "w") as file:
        file["observations/qpos"], file["action"] = motors(robot), motors(robot, 0.02)
        file["observations/qvel"] = np.zeros((LENGTH, 16), np.float32)
        for camera in ("cam_left_high", "cam_right_wrist"):
            chunked: Any = {"chunks": (1, HEIGHT, WIDTH, 3), "compression": "gzip"}
            file.create_dataset(f"observations/images/{camera}", data=pictures(shade)[..., ::-1], **chunked)
        file["language_raw"] = "Pack the camera, then close the box."
    return path


def settings(root: Path, **changes: Any) -> dict[str, Any]:
    gripper = {"closed": 0.2, "open": 0.4}
    declared = {
        "kind": "unitree_h5", "robot": "g1_dex1", "embodiment": "unitree_g1_29dof", "fps": 30, "gripper_state": gripper, "gripper_command": gripper,
        "views": {"head": "cam_left_high", "right_wrist": "cam_right_wrist"},
    }  # fmt: skip
    return {**declared, "path": str(root), "name": "unitree", "split": "train", **changes}


def load(root: Path, **changes: Any) -> Any:
    source = open_source(UnitreeH5SourceConfig.model_validate(settings(root, **changes)), root)
    return source.load(source.episode_ids()[0])


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("write", [write_transitions, write_hdf5])
def test_columns_are_those_of_the_robots_motors(tmp_path: Path, write: Write, robot: str) -> None:
    _, order, grippers = ROBOTS[robot]
    write(tmp_path, robot=robot)
    loaded = load(tmp_path, robot=robot, embodiment="none", channels="standard")
    for found, offset in ((loaded.episode.state, 0.0), (loaded.episode.action, 0.02)):
        expected = motors(robot, offset)[:, order]
        expected[:, grippers] = np.clip((expected[:, grippers] - 0.2) / 0.2, 0, 1)
        assert np.allclose(found, expected, atol=1e-6)
    assert [loaded.episode.state_names[place].rsplit("/")[-1] for place in grippers] == ["gripper"] * len(grippers)
    assert loaded.episode.instruction == "Pack the camera, then close the box."
    assert not loaded.episode.cameras
    for view in ("head", "right_wrist"):
        difference = np.abs(loaded.frames(view).astype(int) - pictures())
        assert difference.mean() < (4 if write is write_transitions else 1e-9)  # video, or pixels as they were


@pytest.mark.parametrize(
    ("declared", "recorded"), [("z1_dual", "z1_dual_grippers_last"), ("z1_dual_grippers_last", "z1_dual")]
)
def test_another_order_of_columns_is_named(tmp_path: Path, declared: str, recorded: str) -> None:
    write_hdf5(tmp_path, robot=recorded)
    with rejected("joint_out_of_range", f"robot: {recorded}"):
        load(tmp_path, robot=declared, embodiment="none")


@pytest.mark.parametrize(
    ("track", "closed", "opened"),
    [("gripper_state", 0.0, 0.2), ("gripper_command", 0.5, 0.4), ("gripper_command", 20, 0)],
)
def test_a_gripper_mostly_outside_of_its_range_is_refused(
    tmp_path: Path, track: str, closed: float, opened: float
) -> None:
    path = write_hdf5(tmp_path)
    if closed == 20:  # in hundredths
        replaced("action", lambda values: np.hstack([values[:, :14], 100 * values[:, 14:]]))(path)
    with rejected("invalid_gripper", "most frames"):
        load(tmp_path, **{track: {"closed": closed, "open": opened}})


@pytest.mark.parametrize("channels", ["standard", "as_written"])
@pytest.mark.parametrize("kind", ["padded", "fixed", "pixels"])
def test_aloha_recordings_are_read(tmp_path: Path, kind: str, channels: str) -> None:
    """ACT's recorder: PNG or JPEG padded to the longest (N, L), or pixels; red first with `as_written`."""
    path = write_hdf5(tmp_path, robot="aloha")
    stored = pictures()[..., ::-1] if channels == "standard" else pictures()
    with h5py.File(path, "r+") as file:
        for camera in ("cam_left_high", "cam_right_wrist"):
            del file[f"observations/images/{camera}"]
            encoded = [cv2.imencode(".png", image)[1].tobytes() for image in stored]
            longest = max(map(len, encoded)) + 5
            padded = np.stack([np.frombuffer(each.ljust(longest, b"\0"), np.uint8) for each in encoded])
            values = {"padded": padded, "fixed": np.array(encoded, f"S{longest}"), "pixels": stored}[kind]
            file[f"observations/images/{camera}"] = values
    loaded = load(tmp_path, robot="aloha", embodiment="aloha_viperx", channels=channels)
    assert np.array_equal(loaded.frames("head"), pictures())
    with pytest.raises(ValidationError, match="declare channels"):
        load(tmp_path, robot="aloha", embodiment="aloha_viperx")
    if kind == "padded":
        with pytest.raises(RejectedInputError, match="declare channels"):
            load(tmp_path, robot="z1_dual", embodiment="none")


def test_a_set_comes_through_curation(tmp_path: Path) -> None:
    for number in (2, 10):
        write_transitions(tmp_path / "raw", number, shade=7 * number)
    write_transitions(tmp_path / "raw", 0, shade=35, dataset="stack_box")
    counts, curated = run(tmp_path, settings(tmp_path / "raw"))
    assert (counts["found"], counts["reasons"]) == (3, {})
    assert {row.episode_id: row.scene for row in curated.rows} == {
        "unitree-pack_camera-2": "unitree-pack_camera",
        "unitree-pack_camera-10": "unitree-pack_camera",
        "unitree-stack_box-0": "unitree-stack_box",
    }


def video_of(path: Path) -> Path:
    return path.parents[2] / f"videos/pack_camera/cam_left_high/{path.stem}.mp4"


def other_type(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file.attrs["action_type"] = "end effector pose"


def not_in_the_table(path: Path) -> None:
    table = path.parents[2] / "pack_camera.csv"
    rows = table.read_text().splitlines(keepends=True)
    table.write_text("".join(row for row in rows if not row.startswith(f"{path.stem},")))


IMAGES = "observations/images/cam_left_high"
FAULTS: dict[Write, dict[str, tuple[Damage, str]]] = {
    write_transitions: {
        "no states": (without("observation.state"), "missing_column"),
        "NaN state": (replaced("observation.state", with_nan), "nan_state"),
        "hands": (replaced("action", lambda v: np.hstack([v, v])), "length_mismatch"),
        "a command less": (replaced("action", lambda v: v[1:]), "length_mismatch"),
        "poses for joints": (other_type, "unreadable"),
        "a file elsewhere": (moved_out, "path_traversal"),
        "no video": (lambda path: video_of(path).unlink(), "missing_file"),
        "a video elsewhere": (lambda path: moved_out(video_of(path)), "path_traversal"),
        "truncated video": (lambda path: cut(video_of(path)), "truncated_video"),
        "a frame less": (lambda path: black_video(video_of(path), LENGTH - 1, 30.0), "truncated_video"),
        "another rate": (lambda path: black_video(video_of(path), LENGTH, 15.0), "wrong_fps"),
        "not in the table": (not_in_the_table, "missing_column"),
    },
    write_hdf5: {
        "no joints": (without("observations/qpos"), "missing_column"),
        "no camera": (without(IMAGES), "missing_view"),
        "an image less": (replaced(IMAGES, lambda v: v[1:]), "length_mismatch"),
        "grey images": (replaced(IMAGES, lambda v: v[..., 0]), "unreadable"),
        "images of floats": (replaced(IMAGES, lambda v: v / 255), "unreadable"),
    },
}


@pytest.mark.parametrize("write", FAULTS)
def test_each_fault_has_its_reason_and_costs_no_other_recording(tmp_path: Path, write: Write) -> None:
    check_faults(tmp_path / "raw", settings(tmp_path), write, FAULTS[write])


def test_what_the_files_do_not_say_must_be_declared(tmp_path: Path) -> None:
    whole = settings(tmp_path)
    for name in ("robot", "fps", "embodiment", "gripper_state", "gripper_command", "views"):
        with pytest.raises(ValidationError, match=name):
            UnitreeH5SourceConfig.model_validate({key: value for key, value in whole.items() if key != name})
