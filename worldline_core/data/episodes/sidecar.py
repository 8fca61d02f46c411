"""Facts that LeRobot has no place for, stored beside a dataset in meta/worldline/: cameras, tool poses, masks, conventions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
from pydantic import BaseModel, ConfigDict, ValidationError

from worldline_core.data.episodes.episode import ARRAYS, CameraTrack, Episode
from worldline_core.data.guards.plain_files import expect_layout, read_json, read_table
from worldline_core.data.guards.rejection import RejectedInputError, check_image_size
from worldline_core.data.guards.source_paths import is_file
from worldline_core.data.video.frames import PACKED, MadeFrames, unpacked_images
from worldline_core.errors import DataError
from worldline_core.store.atomic import write_json_atomic, write_table_atomic

FOLDER = Path("meta") / "worldline"

_CAMERAS = pa.schema(
    [
        ("episode_index", pa.int64()),
        ("view", pa.string()),
        ("K", pa.list_(pa.float64())),
        ("width", pa.int64()),
        ("height", pa.int64()),
        ("num_poses", pa.int64()),
        ("T_base_camera", pa.list_(pa.float64())),
    ]
)
# Masks are packed bits, labels of things bytes; both compressed with zlib.
_MASKS = pa.schema(
    [("episode_index", pa.int64()), ("view", pa.string()), ("shape", pa.list_(pa.int64())), ("bits", pa.binary())]
)
_PER_ARM = [name for name, stored in ARRAYS.items() if "A" in stored.axes]
_TRAJECTORIES = pa.schema(
    [
        ("episode_index", pa.int64()),
        ("num_frames", pa.int64()),
        *((name, pa.list_(pa.from_numpy_dtype(ARRAYS[name].dtype))) for name in ARRAYS if name not in _PER_ARM),
        ("num_arms", pa.int64()),
        *((name, pa.list_(pa.from_numpy_dtype(ARRAYS[name].dtype))) for name in _PER_ARM),
    ]
)


type Packed = Mapping[str, tuple[Sequence[int], bytes]]
"""By view the shape (N, H, W) of its masks or labels, and themselves as `packed_images`."""


def write_sidecar(
    root: Path,
    episodes: Sequence[Episode],
    masks: Sequence[Packed],
    things: Sequence[Packed],
    sizes: Mapping[str, tuple[int, int]],
) -> None:
    """Write the sidecar of a dataset: of each episode robot masks and labels of things; by view (height, width)."""
    folder = root / FOLDER
    cameras, trajectories = [], []
    for index, episode in enumerate(episodes):
        for view, camera in episode.cameras.items():
            cameras.append(
                {
                    "episode_index": index,
                    "view": view,
                    "K": camera.K.reshape(-1).tolist(),
                    "width": camera.width,
                    "height": camera.height,
                    "num_poses": len(camera.T_base_camera),
                    "T_base_camera": camera.T_base_camera.reshape(-1).tolist(),
                }
            )
        arms = 0 if episode.T_base_ee is None else episode.T_base_ee.shape[1]
        if arms or episode.num_video_frames != episode.num_frames:
            values = {name: array.reshape(-1).tolist() for name, array in episode.arrays().items()}
            trajectories.append({"episode_index": index, "num_frames": episode.num_frames, "num_arms": arms, **values})
    write_table_atomic(folder / "cameras.parquet", pa.Table.from_pylist(cameras, schema=_CAMERAS))
    for name, packed in (("robot_masks.parquet", masks), ("thing_labels.parquet", things)):
        rows = [
            {"episode_index": index, "view": view, "shape": shape, "bits": bits}
            for index, views in enumerate(packed)
            for view, (shape, bits) in views.items()
        ]
        if rows:
            write_table_atomic(folder / name, pa.Table.from_pylist(rows, schema=_MASKS))
    if trajectories:
        write_table_atomic(folder / "trajectories.parquet", pa.Table.from_pylist(trajectories, schema=_TRAJECTORIES))
    write_json_atomic(folder / "contract.json", contract(episodes[0], sizes))


def contract(episode: Episode, sizes: Mapping[str, tuple[int, int]]) -> dict[str, Any]:
    """Units and conventions of a dataset, stated once."""
    return {
        "version": 1,
        "embodiment": episode.embodiment,
        "fps": episode.fps,
        "views": {view: {"height": height, "width": width} for view, (height, width) in sizes.items()},
        "state_kind": episode.state_kind,
        "state_names": episode.state_names,
        "action": "none" if episode.state_kind == "none" else "commanded targets, same layout as the state",
        "units": {"angle": "rad", "length": "m", "time": "s", "image": "px"},
        "gripper": "0 closed .. 1 open",
        "camera_axes": "OpenCV: x right, y down, z forward; pixel centres at whole numbers",
        "extrinsics": "T_base_camera maps camera points to the robot base",
        "tool_axes": "origin between the fingertips, +z out of the gripper",
    }


class Contract(BaseModel):
    """Parts of a dataset's contract that are read."""

    model_config = ConfigDict(frozen=True, strict=True)

    version: Literal[1]
    state_kind: str
    state_names: list[str] | None = None


class Sidecar:
    """Read access; tables are loaded once.

    Raises: DataError where the contract is missing, of another version, or does not say what the state is.
    """

    def __init__(self, root: Path) -> None:
        self.root = root / FOLDER
        try:
            self.contract = Contract.model_validate(read_json(self.root / "contract.json"))
        except ValidationError as error:
            raise DataError(
                "Sidecar's contract is not understood",
                where=self.root,
                expected="version 1, state_kind (a text) and state_names (a list or null)",
                got=str(error),
            ) from error
        self._rows: dict[str, dict[int, list[dict[str, Any]]]] = {}

    def _of(self, name: str, schema: pa.Schema, episode_index: int, *, optional: bool) -> list[dict[str, Any]]:
        if name not in self._rows:
            path = self.root / name
            grouped: dict[int, list[dict[str, Any]]] = {}
            if is_file(path) or not optional:
                for row in read_table(path, schema.names).to_pylist():
                    grouped.setdefault(row["episode_index"], []).append(row)
            self._rows[name] = grouped
        return self._rows[name].get(episode_index, [])

    def cameras(self, episode_index: int) -> dict[str, CameraTrack]:
        """Calibrated cameras of an episode by view."""
        result: dict[str, CameraTrack] = {}
        for row in self._of("cameras.parquet", _CAMERAS, episode_index, optional=False):
            K, poses = np.asarray(row["K"], np.float64), np.asarray(row["T_base_camera"], np.float64)
            if K.size != 9 or poses.size != 16 * row["num_poses"]:
                raise RejectedInputError(
                    "invalid_extrinsics",
                    "Camera row has a wrong length",
                    where=f"{self.root}, episode {episode_index}, view {row['view']}",
                    expected=f"9 and {16 * row['num_poses']} numbers",
                    got=f"{K.size} and {poses.size}",
                )
            result[row["view"]] = CameraTrack(
                row["view"], K.reshape(3, 3), poses.reshape(-1, 4, 4), row["width"], row["height"]
            )
        return result

    def masks(self, episode_index: int, view: str) -> MadeFrames | None:
        """bool (N, H, W) robot masks, or None where the recording has none; raises as `_images`."""
        return self._images(episode_index, view, "robot_masks.parquet", bool)

    def things(self, episode_index: int, view: str) -> MadeFrames | None:
        """uint8 (N, H, W) labels of things, or None where the recording has none; raises as `_images`."""
        return self._images(episode_index, view, "thing_labels.parquet", np.uint8)

    def _images(self, episode_index: int, view: str, name: str, dtype: type) -> MadeFrames | None:
        """A view's row in a table of masks, unpacked while it is iterated.

        Raises: RejectedInputError (unreadable, too_large), some of it only then, for bytes that are no images of their shape.
        """
        where = f"{self.root}, episode {episode_index}, view {view}, {name}"
        rows = self._of(name, _MASKS, episode_index, optional=True)
        row = next((row for row in rows if row["view"] == view), None)
        if row is None:
            return None
        with expect_layout(where, PACKED):
            count, height, width = (int(size) for size in row["shape"])
            check_image_size(width, height, where)
            if count < 1:
                raise ValueError(f"{count} images")
        shape = count, height, width
        return MadeFrames(lambda: unpacked_images(row["bits"], shape, dtype, where), shape, dtype)

    def trajectory(self, episode_index: int) -> dict[str, Any]:
        """Full-length state, action and tool poses where they go beyond what the dataset holds, else nothing.

        Raises: RejectedInputError (unreadable) for numbers that do not fit their counts.
        """
        rows = self._of("trajectories.parquet", _TRAJECTORIES, episode_index, optional=True)
        if not rows:
            return {}
        row = rows[0]
        with expect_layout(f"{self.root}, episode {episode_index}, trajectory", "numbers of N frames and A arms"):
            sizes = {"N": row["num_frames"], "A": row["num_arms"], "J": -1}
            return {
                name: stored.array(row[name], sizes)
                for name, stored in ARRAYS.items()
                if name not in _PER_ARM or row[name] is not None
            }
