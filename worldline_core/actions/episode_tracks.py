"""Tracks: where every end-effector is in every view, frame by frame, before any map is drawn; in memory and on disk.

Axis legend: n frames, v views, a arms, s capsules. Frames of reference: base, tool (between the fingertips, +z out
of the gripper), camera (OpenCV axes). Units: metres, pixels of the recorded frame size (centre of the first pixel
is 0), gripper opening 0 closed .. 1 open. Which samples are valid is decided in `tool_projection`.

On disk: shards `tracks-00000.safetensors` ... with entries `<episode_id>/<array>`, `index.parquet` with one row per
episode, and `tracks.json`: the width of the Gaussian that these tracks are to be drawn with. Bytes depend on the tracks
alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from einops import repeat
from jaxtyping import Bool, Float
from pydantic import Field, ValidationError
from safetensors import SafetensorError, safe_open
from torch import Tensor

from worldline_core.actions.actions_config import WristProjection
from worldline_core.actions.tool_projection import project_tools
from worldline_core.config import StrictModel
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import ArtifactError, DataError
from worldline_core.store.artifact_files import how_to_rebuild
from worldline_core.store.atomic import atomic_path, write_arrays_atomic, write_json_atomic

HEAD_VIEW = "head"
SHARD_FILE = "tracks-{:05d}.safetensors"
INDEX_FILE, DESCRIPTION_FILE = "index.parquet", "tracks.json"
SAMPLES = ("uv", "depth", "rot6d", "gripper", "valid")
"""Arrays with one entry per frame, view and arm: what action maps are rendered from."""
ARRAYS = (*SAMPLES, "T_base_tool", "T_base_camera", "K", "capsules", "capsule_radii")
_DTYPES = {"valid": np.bool_, "uv": np.float64}  # of the arrays that are not float32
_SCHEMA = pa.schema(
    [
        ("episode_id", pa.string()),
        ("shard", pa.string()),
        ("embodiment", pa.string()),
        ("num_frames", pa.int64()),
        ("views", pa.list_(pa.string())),
        ("arms", pa.list_(pa.string())),
        ("height", pa.int64()),
        ("width", pa.int64()),
        ("controls", pa.string()),
        ("camera_motion", pa.list_(pa.string())),
    ]
)


@dataclass(frozen=True)
class EpisodeTracks:
    """Tracks of one episode (or of a clip of it), numpy: float32, but uv float64.

    A float32 pixel of a frame 640 wide is off by up to 3e-5 px, which alone moves a map at 30 x 40 by 1.5e-6.

    Attributes:
        views: always the three of the project, in their order; a view that the episode lacks is never valid.
        uv, depth, rot6d, gripper, valid: (N, V, A, ...).
        T_base_tool: (N, A, 4, 4) and T_base_camera (N, V, 4, 4), from which other projections are possible.
        K: (V, 3, 3), pixels at image_size (height, width).
        camera_motion: by view, where T_base_camera comes from: "static" (first frame), "kinematics" (of the
            controls), "first_frame_mount" (kinematics, mount solved at the first frame), "recorded", or "absent".
        controls: "state", "action", or "ee_pose" where a source records tool poses.
        capsules: (N, S, 2, 3) robot parts as base-frame segments, capsule_radii (S,) in metres.
        native: (N, D) the control vectors themselves, in the layout of the embodiment's state; in memory only, and None
            for tracks that were opened without their episodes.
    """

    episode_id: str
    embodiment: str
    views: tuple[str, ...]
    arms: tuple[str, ...]
    image_size: tuple[int, int]
    controls: str
    camera_motion: tuple[str, ...]
    uv: np.ndarray
    depth: np.ndarray
    rot6d: np.ndarray
    gripper: np.ndarray
    valid: np.ndarray
    T_base_tool: np.ndarray
    T_base_camera: np.ndarray
    K: np.ndarray
    capsules: np.ndarray
    capsule_radii: np.ndarray
    native: np.ndarray | None = None

    @property
    def num_frames(self) -> int:
        return len(self.depth)

    def clip(
        self,
        frames: Sequence[int] | np.ndarray,
        *,
        wrist_projection: WristProjection = "current_camera",
        start: int | None = None,
    ) -> EpisodeTracks:
        """Tracks at these frame numbers.

        With `clip_start_camera`, wrist views are projected into the camera's pose at frame `start` (default: the
        first of `frames`): a wrist camera sees its own gripper at a constant pixel, so only so does that arm's map
        in that view carry motion. Head tracks and stored camera poses are unchanged. The poses are stored in
        float32, so these pixels are good to about 1e-4 px in a frame 640 wide.

        Raises: DataError for a frame outside of the episode.
        """
        index = np.asarray(frames, dtype=np.int64)
        first = int(index[0]) if start is None and len(index) else int(start or 0)
        if len(index) == 0 or min(index.min(), first) < 0 or max(int(index.max()), first) >= self.num_frames:
            raise DataError(
                "Frames outside of the action tracks",
                where=f"episode {self.episode_id}",
                expected=f"0..{self.num_frames - 1}",
                got=f"{index.tolist()[:4]}..., start {first}",
            )
        cut = replace(
            self,
            **{name: getattr(self, name)[index] for name in (*SAMPLES, "T_base_tool", "T_base_camera", "capsules")},
            native=None if self.native is None else self.native[index],
        )
        wrists = [i for i, view in enumerate(self.views) if view != HEAD_VIEW]
        if wrist_projection == "current_camera" or not wrists:
            return cut
        seen = project_tools(
            torch.from_numpy(cut.T_base_tool),
            torch.from_numpy(cut.gripper[:, 0]),
            torch.from_numpy(self.K[wrists]),
            torch.from_numpy(self.T_base_camera[first, wrists]),
            self.image_size,
        )
        arrays = {name: getattr(cut, name).copy() for name in ("uv", "depth", "rot6d", "valid")}
        for name, array in arrays.items():
            array[:, wrists] = getattr(seen, name).numpy().astype(array.dtype)
        return replace(cut, **arrays)


@dataclass(frozen=True)
class TrackBatch:
    """Tracks of several clips as tensors on one device; episodes with fewer arms are padded with invalid ones."""

    uv: Float[Tensor, "b t v a 2"]
    depth: Float[Tensor, "b t v a"]
    rot6d: Float[Tensor, "b t v a 6"]
    gripper: Float[Tensor, "b t v a"]
    valid: Bool[Tensor, "b t v a"]

    def to(self, device: torch.device | str) -> TrackBatch:
        """The same batch on another device."""
        return TrackBatch(*(getattr(self, name).to(device) for name in SAMPLES))


def collate_tracks(clips: Sequence[EpisodeTracks], views: Sequence[str] | None = None) -> TrackBatch:
    """Stack clips of equal length, views in the given order (default: the views of the first clip).

    Raises: DataError when a clip lacks a view, or the clips differ in length or frame size.
    """
    if not clips:
        raise DataError("No action tracks to collate", expected="at least one clip", got="none")
    order = tuple(views or clips[0].views)
    num_arms = max(len(clip.arms) for clip in clips)
    columns: dict[str, list[np.ndarray]] = {name: [] for name in SAMPLES}
    for clip in clips:
        missing = [view for view in order if view not in clip.views]
        if missing or clip.num_frames != clips[0].num_frames or clip.image_size != clips[0].image_size:
            raise DataError(
                "Action tracks do not fit together in one batch",
                where=f"episode {clip.episode_id}",
                expected=f"views {order}, {clips[0].num_frames} frames of {clips[0].image_size}",
                got=f"views {clip.views}, {clip.num_frames} frames of {clip.image_size}",
            )
        index = [clip.views.index(view) for view in order]
        for name, column in columns.items():
            values = getattr(clip, name)[:, index]
            padding = [(0, 0)] * values.ndim
            padding[2] = (0, num_arms - len(clip.arms))
            column.append(np.pad(values, padding))
    return TrackBatch(**{name: torch.from_numpy(np.stack(column)) for name, column in columns.items()})


def write_shard(root: Path, number: int, tracks: Sequence[EpisodeTracks]) -> list[dict[str, Any]]:
    """Write one shard atomically; returns its index rows."""
    arrays: dict[str, np.ndarray] = {}
    rows: list[dict[str, Any]] = []
    for episode in tracks:
        for name in ARRAYS:
            value = getattr(episode, name)
            arrays[f"{episode.episode_id}/{name}"] = np.asarray(value, dtype=_DTYPES.get(name, np.float32))
        rows.append(
            {
                "episode_id": episode.episode_id,
                "shard": SHARD_FILE.format(number),
                "embodiment": episode.embodiment,
                "num_frames": episode.num_frames,
                "views": list(episode.views),
                "arms": list(episode.arms),
                "height": episode.image_size[0],
                "width": episode.image_size[1],
                "controls": episode.controls,
                "camera_motion": list(episode.camera_motion),
            }
        )
    write_arrays_atomic(root / SHARD_FILE.format(number), arrays)
    return rows


class TracksDescription(StrictModel):
    """Contents of `tracks.json`: sigma of the Gaussian, pixels on the 384 x 512 reference canvas."""

    sigma_px_ref: float = Field(gt=0)


def write_index(root: Path, rows: Sequence[dict[str, Any]], *, sigma_px_ref: float) -> None:
    """Write the index, ordered by episode id, and the width that action maps of these tracks have."""
    write_json_atomic(root / DESCRIPTION_FILE, TracksDescription(sigma_px_ref=sigma_px_ref).model_dump())
    ordered = sorted(rows, key=lambda row: row["episode_id"])
    with atomic_path(root / INDEX_FILE) as temporary:
        pq.write_table(pa.Table.from_pylist(ordered, schema=_SCHEMA), temporary)


class ActionTracks:
    """Read access to a finished ActionTracks artifact; only the episodes asked for are read.

    Args:
        episodes: the recordings, for tracks that carry their native control vectors too.
    """

    def __init__(
        self,
        root: Path,
        rows: Sequence[dict[str, Any]],
        description: TracksDescription,
        episodes: EpisodeSet | None = None,
    ) -> None:
        self.root = root
        self.episodes = episodes
        self.sigma_px_ref = description.sigma_px_ref
        self._rows = {row["episode_id"]: row for row in rows}

    @classmethod
    def open(cls, root: Path, episodes: EpisodeSet | None = None) -> ActionTracks:
        """Open an artifact.

        Raises: ArtifactError when the index is missing or lacks a column, or `tracks.json` does not say the width.
        """
        path = Path(root) / INDEX_FILE
        if not path.is_file():
            raise ArtifactError(
                "Not an ActionTracks artifact", where=root, expected=INDEX_FILE, next_step="run render_actions"
            )
        table = pq.read_table(path)
        missing = [name for name in _SCHEMA.names if name not in table.column_names]
        if missing:
            raise ArtifactError(
                "ActionTracks index lacks columns", where=path, expected=_SCHEMA.names, got=table.column_names
            )
        return cls(Path(root), table.to_pylist(), _read_description(Path(root) / DESCRIPTION_FILE), episodes)

    @property
    def episode_ids(self) -> list[str]:
        """Ids of the episodes with tracks, in order."""
        return list(self._rows)

    def __len__(self) -> int:
        return len(self._rows)

    def calibrated_views(self, episode_id: str) -> tuple[str, ...]:
        """Views of an episode whose camera is known."""
        row = self._rows[episode_id]
        return tuple(
            view for view, motion in zip(row["views"], row["camera_motion"], strict=True) if motion != "absent"
        )

    def __contains__(self, episode_id: str) -> bool:
        return episode_id in self._rows

    def __iter__(self) -> Iterator[EpisodeTracks]:
        return (self.tracks(episode_id) for episode_id in self._rows)

    def controls(self, episode_id: str) -> str:
        """Kind of controls behind an episode's tracks: commands, measured joints, or recorded tool poses."""
        return self._rows[episode_id]["controls"]

    def tracks(self, episode_id: str) -> EpisodeTracks:
        """Tracks of one episode.

        Raises:
            DataError: there are no tracks of this episode.
            ArtifactError: the shard is missing or damaged, or holds numbers that are not finite.
        """
        if episode_id not in self._rows:
            raise DataError(
                "No action tracks of this episode",
                where=self.root,
                expected=f"one of {len(self)} episodes, such as {', '.join(self.episode_ids[:3])}",
                got=episode_id,
                next_step="see quarantine.parquet of the same artifact for the reason",
            )
        row = self._rows[episode_id]
        path = self.root / row["shard"]
        try:
            with safe_open(path, framework="numpy") as shard:
                arrays = {name: shard.get_tensor(f"{episode_id}/{name}") for name in ARRAYS}
        except (OSError, SafetensorError) as error:
            raise ArtifactError("Shard of action tracks cannot be read", where=path, got=str(error)) from error
        # Of a view without calibration K says so by not being finite; all others are, valid or not.
        if unusable := [name for name in ARRAYS if name != "K" and not np.isfinite(arrays[name]).all()]:
            raise ArtifactError(
                "Action tracks are not finite", where=f"{path}, episode {episode_id}", got=", ".join(unusable),
                next_step=how_to_rebuild(self.root),
            )  # fmt: skip
        return EpisodeTracks(
            episode_id=episode_id,
            embodiment=row["embodiment"],
            views=tuple(row["views"]),
            arms=tuple(row["arms"]),
            image_size=(row["height"], row["width"]),
            controls=row["controls"],
            camera_motion=tuple(row["camera_motion"]),
            native=None if self.episodes is None else self._native(self.episodes, episode_id, row["controls"]),
            **arrays,
        )

    def _native(self, episodes: EpisodeSet, episode_id: str, controls: str) -> np.ndarray:
        episode = episodes.episode(episodes.position(episode_id))
        return np.asarray(episode.action if controls == "action" else episode.state, np.float32)


def _read_description(path: Path) -> TracksDescription:
    try:
        return TracksDescription.model_validate_json(path.read_bytes())
    except (OSError, ValidationError) as error:
        raise ArtifactError(
            "The action tracks do not say the width of their Gaussian",
            where=path,
            expected="sigma_px_ref, pixels on the 384 x 512 reference canvas",
            got=str(error),
            next_step="run render_actions again",
        ) from error


def native_vectors(
    clips: Sequence[EpisodeTracks], views: Sequence[str], size: int
) -> Float[Tensor, "b v {size} t 1 1"]:
    """Control vectors of clips of equal length, padded with zeros to ``size`` and repeated for every view: action maps of
    one cell, for models with FiLM.

    Raises: DataError when a clip has no control vectors, or longer ones.
    """
    rows = []
    for clip in clips:
        if clip.native is None or clip.native.shape[1] > size:
            raise DataError(
                "The model is driven by control vectors that these tracks do not have",
                where=f"episode {clip.episode_id}, embodiment {clip.embodiment}",
                expected=f"up to {size} numbers a frame",
                got=None if clip.native is None else clip.native.shape[1],
                next_step="open the tracks with their episodes, or train with a larger native_size",
            )
        rows.append(np.pad(clip.native, ((0, 0), (0, size - clip.native.shape[1]))))
    return repeat(torch.from_numpy(np.stack(rows)), "b t c -> b v c t 1 1", v=len(views))
