"""AgiBot World's published layout with defects: HDF5, mp4 and camera parameters of each episode."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tools.corrupted import files
from tools.corrupted.content import FPS, NUM_FRAMES, gripper_motion, joint_motion, pictures
from tools.corrupted.labels import Kind, Label
from worldline_core.data.sources.hdf5 import require_h5py
from worldline_core.data.video.encoder import encode_video

_CAMERAS = ("head", "hand_left", "hand_right")
_BASES = 4
_TASK = 327


@dataclass(frozen=True)
class _Episode:
    root: Path
    number: int

    @property
    def folders(self) -> list[Path]:
        return [
            self.root / part / str(_TASK) / str(self.number) for part in ("proprio_stats", "observations", "parameters")
        ]

    @property
    def arrays(self) -> Path:
        return self.folders[0] / "proprio_stats.h5"

    def video(self, random: np.random.Generator) -> Path:
        return self.folders[1] / f"videos/{random.choice(_CAMERAS)}_color.mp4"

    def parameters(self, camera: str, kind: str) -> Path:
        return self.folders[2] / f"parameters/camera/{camera}_{kind}.json"


def _on_video(defect: files.FileDefect) -> Callable[[_Episode, np.random.Generator], None]:
    return lambda episode, random: defect(episode.video(random), random)


def _on_file(defect: files.FileDefect) -> Callable[[_Episode, np.random.Generator], None]:
    return lambda episode, random: defect(episode.arrays, random)


def _on_arrays(change: Callable[[Any, np.random.Generator], None]) -> Callable[[_Episode, np.random.Generator], None]:
    def spoil(episode: _Episode, random: np.random.Generator) -> None:
        with require_h5py().File(episode.arrays, "r+") as file:
            change(file, random)

    return spoil


def _on_intrinsics(**values: float) -> Callable[[_Episode, np.random.Generator], None]:
    def spoil(episode: _Episode, random: np.random.Generator) -> None:
        path = episode.parameters(str(random.choice(_CAMERAS)), "intrinsic_params")
        record = json.loads(path.read_text())
        record["intrinsic"] |= values
        path.write_text(json.dumps(record))

    return spoil


def _on_extrinsics(
    change: Callable[[list[Any], np.random.Generator], list[Any]],
) -> Callable[[_Episode, np.random.Generator], None]:
    def spoil(episode: _Episode, random: np.random.Generator) -> None:
        path = episode.parameters(str(random.choice(_CAMERAS)), "extrinsic_params_aligned")
        path.write_text(json.dumps(change(json.loads(path.read_text()), random)))

    return spoil


def _sheared(listed: list[Any], random: np.random.Generator) -> list[Any]:
    listed[int(random.integers(len(listed)))]["extrinsic"]["rotation_matrix"][0][1] += float(random.uniform(0.05, 0.5))
    return listed


def _mirrored(listed: list[Any], random: np.random.Generator) -> list[Any]:
    for item in listed:
        item["extrinsic"]["rotation_matrix"][0] = [-value for value in item["extrinsic"]["rotation_matrix"][0]]
    return listed


def _no_parameters(episode: _Episode, random: np.random.Generator) -> None:
    episode.parameters(str(random.choice(_CAMERAS)), "intrinsic_params").unlink()


def _not_finite(file: Any, random: np.random.Generator) -> None:
    name = str(random.choice(["state/joint/position", "action/joint/position", "state/end/position"]))
    values = file[name][()]
    values.reshape(-1)[int(random.integers(values.size))] = np.nan
    file[name][...] = values


def _no_dataset(file: Any, random: np.random.Generator) -> None:
    del file[str(random.choice(["state/joint/position", "action/effector/position", "timestamp"]))]


def _hands(file: Any, random: np.random.Generator) -> None:
    del file["state/effector/position"]
    file["state/effector/position"] = random.uniform(0, 1, (NUM_FRAMES, 12))


def _external_link(file: Any, random: np.random.Generator) -> None:
    del file["state/joint/position"]
    file["state/joint/position"] = require_h5py().ExternalLink("../../../elsewhere.h5", "/state")


def _huge(file: Any, random: np.random.Generator) -> None:
    del file["state/joint/position"]
    file.create_dataset("state/joint/position", shape=(10**12, 14), chunks=(1024, 14), dtype="f8", fillvalue=0)


def _other_length(file: Any, random: np.random.Generator) -> None:
    values = file["state/joint/position"][()]
    del file["state/joint/position"]
    file["state/joint/position"] = values[: -int(random.integers(1, 6))]


def _slow_clock(file: Any, random: np.random.Generator) -> None:
    times = file["timestamp"][()]
    file["timestamp"][...] = times[0] + ((times - times[0]) * random.uniform(1.2, 1.6)).astype(np.int64)


KINDS = (
    Kind("video_truncated", _on_video(files.truncate), ("truncated_video",)),
    Kind("video_missing", _on_video(files.missing), ("missing_file",)),
    Kind("arrays_truncated", _on_file(files.truncate), ("unreadable",)),
    Kind("arrays_garbage", _on_file(files.garbage), ("unreadable",)),
    Kind("arrays_missing", _on_file(files.missing), ("missing_file",)),
    Kind("arrays_linked_out", _on_file(files.link_out), ("path_traversal",)),
    Kind("dataset_missing", _on_arrays(_no_dataset), ("missing_column",)),
    Kind("dataset_linked_out", _on_arrays(_external_link), ("path_traversal",)),
    Kind("dataset_huge", _on_arrays(_huge), ("out_of_memory", "unreadable")),
    Kind("dataset_of_other_length", _on_arrays(_other_length), ("length_mismatch",)),
    Kind("dexterous_hands", _on_arrays(_hands), ("invalid_gripper",)),
    Kind("values_not_finite", _on_arrays(_not_finite), ("nan_state",)),
    Kind("clock_slow", _on_arrays(_slow_clock), ("wrong_fps",)),
    Kind("intrinsics_singular", _on_intrinsics(fx=0.0), ("singular_intrinsics",)),
    Kind("intrinsics_not_finite", _on_intrinsics(fy=float("nan")), ("singular_intrinsics",)),
    Kind("intrinsics_of_other_size", _on_intrinsics(ppx=320.0, ppy=240.0), ("missing_calibration",)),
    Kind("calibration_missing", _no_parameters, ("missing_file", "missing_calibration")),
    Kind("rotation_sheared", _on_extrinsics(_sheared), ("invalid_extrinsics",)),
    Kind("rotation_mirrored", _on_extrinsics(_mirrored), ("invalid_extrinsics",)),
    Kind("extrinsics_cut", _on_extrinsics(lambda listed, random: [*listed, *listed[:2]]), ("length_mismatch",)),
)


KIND_COUNT = len(KINDS)
"""How many recordings `write` adds for each of `each`."""


def write(root: Path, healthy: int, each: int, random: np.random.Generator) -> tuple[list[Label], dict[str, Any]]:
    """One folder of one task: labels, and the `curate.sources[]` entry that reads it."""
    labels: list[Label] = []

    def add(kind: str, reasons: tuple[str, ...] = ()) -> _Episode:
        number = 100_000 + len(labels)
        stage = "curate" if reasons else "kept"
        labels.append(Label(f"{root.name}-{_TASK}-{number}", "agibot_world", kind, stage, reasons))
        return _Episode(root, number)

    for _ in range(healthy):
        _write_episode(add("clean"), random)
    bases = [_Episode(root.parent / f"{root.name}_bases", number) for number in range(_BASES)]
    for base in bases:
        _write_episode(base, random)
    for kind in KINDS:
        for number in range(each):
            episode = add(kind.name, kind.reasons)
            for source, target in zip(bases[number % _BASES].folders, episode.folders, strict=True):
                shutil.copytree(source, target)
            kind.spoil(episode, random)
    shutil.rmtree(bases[0].root)
    rows = [
        {"episode_id": 100_000 + number, "task_id": _TASK, "task_name": "Pick up the block", "label_info": {}}
        for number in range(len(labels))
    ]
    (root / "task_info").mkdir()
    (root / f"task_info/task_{_TASK}.json").write_text(json.dumps(rows))
    source = {"kind": "agibot_world", "path": str(root), "name": root.name, "fps": FPS, "split": "train"}
    return labels, source


def _write_episode(episode: _Episode, random: np.random.Generator) -> None:
    for folder in episode.folders:
        folder.mkdir(parents=True)
    motion = joint_motion(random, 14)
    opening = np.stack([gripper_motion(random) for _ in range(2)], axis=1)
    half = 0.5 * joint_motion(random, 2)
    orientation = np.stack([np.sin(half), np.zeros_like(half), np.zeros_like(half), np.cos(half)], axis=-1)
    with require_h5py().File(episode.arrays, "w") as file:
        file["timestamp"] = 1_718_000_000_000_000_000 + np.rint(np.arange(NUM_FRAMES) * 1e9 / FPS).astype(np.int64)
        file["state/joint/position"] = motion
        file["state/effector/position"] = 120 - 85 * opening
        file["state/end/position"] = np.stack([motion[:, :3], motion[:, 3:6]], axis=1)
        file["state/end/orientation"] = orientation
        file["action/joint/position"] = motion + 0.002
        file["action/effector/position"] = 1 - opening
    for index, camera in enumerate(_CAMERAS):
        video = episode.folders[1] / f"videos/{camera}_color.mp4"
        video.parent.mkdir(parents=True, exist_ok=True)
        encode_video(video, pictures(random), FPS, preset="ultrafast")
        intrinsic = {"fx": 80.0 + index, "fy": 81.0, "ppx": 47.5, "ppy": 35.5}
        path = episode.parameters(camera, "intrinsic_params")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps({"intrinsic": intrinsic}))
        poses = [
            {"rotation_matrix": [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], "translation_vector": [0.1, 0.01 * n, 1.2]}
            for n in range(1 if camera == "head" else NUM_FRAMES)
        ]
        path = episode.parameters(camera, "extrinsic_params_aligned")
        path.write_text(json.dumps([{"extrinsic": pose} for pose in poses]))
