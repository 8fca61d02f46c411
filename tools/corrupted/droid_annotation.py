"""DROID annotation JSON with defects: paths that lead elsewhere, keys that are not there, damaged JSON."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tools.corrupted.content import FPS, gripper_motion, joint_motion, pictures
from tools.corrupted.defects import FileDefect, Kind, Layout, Source, on_bytes, truncate
from worldline_core.data.video.encoder import encode_video
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematic_tree import read_tree, tool_poses
from worldline_core.geometry.transforms import euler_fixed_xyz_from_rotation

_BENT = np.array([0.0, 0.0, 0.0, -1.6, 0.0, 1.6, 0.0])
"""A Panda's elbow and wrist cannot be straight."""


def _on_record(change: Callable[[dict[str, Any]], object]) -> FileDefect:
    def spoil(path: Path, random: np.random.Generator) -> None:
        record = json.loads(path.read_text())
        change(record)
        path.write_text(json.dumps(record))

    return spoil


def _video_at(path: str) -> FileDefect:
    return _on_record(lambda record: record["videos"][0].update(video_path=path))


KINDS = (
    Kind("path_upwards", ("path_traversal",), _video_at("../../../elsewhere/0.mp4")),
    Kind("path_absolute", ("path_traversal",), _video_at("/etc/hostname")),
    Kind("path_to_nothing", ("missing_file",), _video_at("videos/none.mp4")),
    Kind("no_videos", ("missing_view",), _on_record(lambda record: record.pop("videos"))),
    Kind("json_cut", ("unreadable",), truncate),
    Kind("json_key_twice", ("unreadable",), on_bytes(lambda text, _: text.replace(b"{", b'{"states": [], ', 1))),
    Kind("json_deep", ("unreadable",), on_bytes(lambda text, _: b"[" * 200_000)),
    Kind("json_not_utf8", ("unreadable",), on_bytes(lambda text, _: text.replace(b"pick", b"p\xff\xfek"))),
)


def _add(root: Path, number: int, random: np.random.Generator) -> tuple[str, dict[str, Path]]:
    opening, motion = gripper_motion(random)[:, None], joint_motion(random, 7)
    video, annotation = root / f"videos/{number}/0.mp4", root / f"annotation/val/{number}.json"
    for path in (video, annotation):
        path.parent.mkdir(parents=True, exist_ok=True)
    encode_video(video, pictures(random), FPS, preset="ultrafast")
    joints = _BENT + 0.3 * motion
    robot = load_embodiment("droid_franka")
    tools = tool_poses(robot, read_tree(robot), np.concatenate([joints, opening], axis=1))[:, 0]
    poses = np.concatenate([tools[:, :3, 3], euler_fixed_xyz_from_rotation(tools[:, :3, :3])], axis=1)
    record = {
        "texts": ["pick the block"],
        "success": 1,
        "videos": [{"video_path": str(video.relative_to(root))}],
        "states": np.concatenate([poses, 1 - opening], axis=1).tolist(),
        "joints": np.concatenate([joints, 1 - opening], axis=1).tolist(),
    }
    annotation.write_text(json.dumps(record))
    # The subset's folder is the root itself, so the id has its parts only.
    return f"{root.name}-val-{number}", {"annotation": annotation}


def _source(root: Path, lengths: list[int]) -> Source:
    return {"kind": "droid_annotation", "views": ["head", None, None], "split": "test"}


write = Layout("droid_annotation", _add, _source, KINDS).write
