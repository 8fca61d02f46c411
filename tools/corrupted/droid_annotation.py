"""DROID annotation JSON with defects: paths that lead elsewhere, keys that are not there, damaged JSON."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tools.corrupted.content import FPS, gripper_motion, joint_motion, pictures
from tools.corrupted.defects import Kind, Label
from worldline_core.data.video.encoder import encode_video
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematic_tree import read_tree, tool_poses
from worldline_core.geometry.transforms import euler_fixed_xyz_from_rotation

_BENT = np.array([0.0, 0.0, 0.0, -1.6, 0.0, 1.6, 0.0])
"""A Panda's elbow and wrist cannot be straight."""

Record = dict[str, Any]
RecordDefect = Callable[[Record, np.random.Generator], None]


def _video_at(path: str) -> RecordDefect:
    def spoil(record: Record, random: np.random.Generator) -> None:
        record["videos"][0]["video_path"] = path

    return spoil


def _without(key: str) -> RecordDefect:
    def spoil(record: Record, random: np.random.Generator) -> None:
        del record[key]

    return spoil


KINDS = (
    Kind("path_upwards", _video_at("../../../elsewhere/0.mp4"), ("path_traversal",)),
    Kind("path_absolute", _video_at("/etc/hostname"), ("path_traversal",)),
    Kind("path_to_nothing", _video_at("videos/none.mp4"), ("missing_file",)),
    Kind("no_videos", _without("videos"), ("missing_view",)),
    Kind("no_states", _without("states"), ("missing_column",)),
)
_TEXTS: tuple[tuple[str, Callable[[str, np.random.Generator], bytes]], ...] = (
    ("json_cut", lambda text, random: text[: int(len(text) * random.uniform(0.2, 0.8))].encode()),
    ("json_key_twice", lambda text, random: text.replace("{", '{"states": [], ', 1).encode()),
    ("json_deep", lambda text, random: b"[" * 200_000),
    ("json_not_utf8", lambda text, random: text.encode().replace(b"pick", b"p\xff\xfek")),
)


def write(root: Path, healthy: int, each: int, random: np.random.Generator) -> tuple[list[Label], dict[str, Any]]:
    """One folder of annotations: labels, and the `curate.sources[]` entry that reads it."""
    labels: list[Label] = []
    (root / "annotation/val").mkdir(parents=True)

    def place(kind: str, text: bytes, reasons: tuple[str, ...] = ()) -> None:
        number = len(labels)
        (root / f"annotation/val/{number}.json").write_bytes(text)
        # The subset's folder is the root itself, so the id has its parts only.
        labels.append(
            Label(f"{root.name}-val-{number}", "droid_annotation", kind, "curate" if reasons else "kept", reasons)
        )

    def record() -> Record:
        return _record(root, str(len(labels)), random)

    for _ in range(healthy):
        place("clean", json.dumps(record()).encode())
    for _ in range(each):
        for kind in KINDS:
            spoiled = record()
            kind.spoil(spoiled, random)
            place(kind.name, json.dumps(spoiled).encode(), kind.reasons)
        for name, change in _TEXTS:
            place(name, change(json.dumps(record()), random), ("unreadable",))
    views = ["head", None, None]
    return labels, {"kind": "droid_annotation", "path": str(root), "name": root.name, "views": views, "split": "test"}


def _record(root: Path, name: str, random: np.random.Generator) -> Record:
    opening = gripper_motion(random)[:, None]
    motion = joint_motion(random, 7)
    path = root / f"videos/{name}/0.mp4"
    path.parent.mkdir(parents=True)
    encode_video(path, pictures(random), FPS, preset="ultrafast")
    joints = _BENT + 0.3 * motion
    robot = load_embodiment("droid_franka")
    tools = tool_poses(robot, read_tree(robot), np.concatenate([joints, opening], axis=1))[:, 0]
    poses = np.concatenate([tools[:, :3, 3], euler_fixed_xyz_from_rotation(tools[:, :3, :3])], axis=1)
    return {
        "texts": ["pick the block"],
        "success": 1,
        "videos": [{"video_path": str(path.relative_to(root))}],
        "states": np.concatenate([poses, 1 - opening], axis=1).tolist(),
        "joints": np.concatenate([joints, 1 - opening], axis=1).tolist(),
    }
