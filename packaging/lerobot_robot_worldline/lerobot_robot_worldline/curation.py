"""Cameras of each episode and the curation config, written beside the files that LeRobot records."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from worldline_core.errors import DataError
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.rollout.observation import image_size, project_controls
from worldline_core.rollout.recorded_starts import RecordedStart
from worldline_core.store.atomic import write_bytes_atomic

CAMERAS = "meta/cameras/{episode_index:06d}.json"


def write_cameras(
    root: Path, episode: int, start: RecordedStart, kinematics: ArmKinematics, commands: np.ndarray, fps: float
) -> None:
    """Cameras of an episode in the form of docs/sources.md.

    Args:
        root: of a LeRobotDataset.
        commands: ``(n, state size)``, what was executed at each recorded frame, that of the start first.

    Raises:
        DataError: there is no dataset.
    """
    if not (root / "meta" / "info.json").is_file():
        raise DataError(
            "No dataset to write the cameras of an episode into", where=root, expected="meta/info.json",
            next_step="give --robot.dataset_root the folder of --dataset.root",
        )  # fmt: skip
    height, width = image_size(start.images, start.cameras)
    tracks = project_controls(start.cameras, (height, width), kinematics, controls=commands, fps=fps)
    views: dict[str, Any] = {}
    for view, camera in start.cameras.items():
        poses = tracks.T_base_camera[:, tracks.views.index(view)]
        poses = poses[:1] if (poses == poses[0]).all() else poses
        views[view] = {
            "width": width, "height": height, "K": np.asarray(camera.K).tolist(),
            "maps": "camera_to_base", "axes": "opencv", "T": poses.tolist(),
        }  # fmt: skip
    path = root / CAMERAS.format(episode_index=episode)
    path.parent.mkdir(exist_ok=True)
    write_bytes_atomic(path, json.dumps({"views": views}).encode())


def write_source(
    root: Path, embodiment: str, angle_unit: str, grippers: Mapping[str, tuple[float, float]], views: Sequence[str]
) -> None:
    """``curate.yaml``: the dataset as a source of ``worldline task curate``.

    Args:
        grippers: column of the state -> its values when closed and open.
    """
    source = {
        "kind": "lerobot_v3", "path": str(root.resolve()), "embodiment": embodiment, "angle_unit": angle_unit,
        "views": {f"observation.images.{view}": view for view in views}, "calibration": CAMERAS,
        "grippers": {name: {"closed": closed, "open": opened} for name, (closed, opened) in grippers.items()},
    }  # fmt: skip
    text = yaml.safe_dump({"curate": {"sources": [source]}, "filter": {}}, sort_keys=False)
    write_bytes_atomic(root / "curate.yaml", text.encode())
