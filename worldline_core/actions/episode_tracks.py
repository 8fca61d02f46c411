"""Tracks: where every end-effector is in every view, frame by frame, before any map is drawn; in memory and on disk.

Axis legend: n frames, v views, a arms, s capsules. Frames of reference: base, tool (between the fingertips, +z out
of the gripper), camera (OpenCV axes). Units: metres, pixels of the recorded frame size (centre of the first pixel
is 0), gripper opening 0 closed .. 1 open.

On disk: shards `tracks-00000.safetensors` ... with entries `<episode_id>/<array>`, and `index.parquet` with one row per
episode. Bytes depend on the tracks alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from jaxtyping import Bool, Float
from safetensors import SafetensorError, safe_open
from torch import Tensor

from worldline_core.actions.actions_config import SIGMA_PX_REFERENCE
from worldline_core.data.episodes.episode import VIEWS, Episode
from worldline_core.data.episodes.episode_index import read_quarantine
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import ArtifactError, ConfigError, DataError
from worldline_core.store.artifact_files import how_to_rebuild
from worldline_core.store.atomic import write_arrays_atomic, write_table_atomic

HEAD_VIEW, NO_CALIBRATION = "head", "no_calibration"
SHARD_FILE, INDEX_FILE = "tracks-{:05d}.safetensors", "index.parquet"
SAMPLES = ("uv", "depth", "rot6d", "gripper", "valid")
"""Arrays with one entry per frame, view and arm: what action maps are rendered from."""
ARRAYS = (*SAMPLES, "T_base_tool", "T_base_camera", "K", "capsules", "capsule_radii")
_DTYPES = {"valid": np.bool_, "uv": np.float64}  # of the arrays that are not float32
_LABELS = ("episode_id", "embodiment", "views", "arms", "image_size", "controls", "camera_motion")
_COLUMNS = pa.schema(
    [
        *((name, pa.string()) for name in ("episode_id", "shard", "embodiment", "controls")),
        *((name, pa.list_(pa.string())) for name in ("views", "arms", "camera_motion")),
        ("image_size", pa.list_(pa.int64())),
        ("num_frames", pa.int64()),
        ("sigma_px_ref", pa.float64()),
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

    @property
    def calibrated_views(self) -> tuple[str, ...]:
        """Views whose camera is known."""
        return _calibrated(self.views, self.camera_motion)

    @property
    def controls_label(self) -> str:
        """The kind of the projected controls in words: commands, or what was measured where none were recorded."""
        return {"action": "commands", "state": "measured joints", "ee_pose": "measured tool poses"}[self.controls]

    def clip(self, frames: Sequence[int] | np.ndarray) -> EpisodeTracks:
        """Tracks at these frame numbers.

        Raises: DataError for a frame outside of the episode.
        """
        index = self.index(frames)
        return replace(
            self,
            **{name: getattr(self, name)[index] for name in (*SAMPLES, "T_base_tool", "T_base_camera", "capsules")},
            native=None if self.native is None else self.native[index],
        )

    def index(self, frames: Sequence[int] | np.ndarray) -> np.ndarray:
        """Frame numbers as an array; raises as `clip`."""
        index = np.asarray(frames, dtype=np.int64)
        if len(index) == 0 or index.min() < 0 or index.max() >= self.num_frames:
            raise DataError(
                "Frames outside of the action tracks",
                where=f"episode {self.episode_id}",
                expected=f"0..{self.num_frames - 1}",
                got=f"{index.tolist()[:4]}...",
            )
        return index


@dataclass(frozen=True)
class TrackBatch:
    """Tracks of several clips as tensors on one device; episodes with fewer arms are padded with invalid ones.

    ``native``: their control vectors padded with zeros, and ``camera``: which views have one; for models that take vectors.
    """

    uv: Float[Tensor, "b t v a 2"]
    depth: Float[Tensor, "b t v a"]
    rot6d: Float[Tensor, "b t v a 6"]
    gripper: Float[Tensor, "b t v a"]
    valid: Bool[Tensor, "b t v a"]
    native: Float[Tensor, "b t d"] | None = None
    camera: Bool[Tensor, "b t v"] | None = None

    def to(self, device: torch.device | str) -> TrackBatch:
        """The same batch on another device."""
        moved: dict[str, Any] = {
            name: None if value is None else value.to(device) for name, value in vars(self).items()
        }
        return TrackBatch(**moved)


def drawn_size(clips: Sequence[EpisodeTracks]) -> tuple[int, int]:
    """(height, width) that the pixels of clips belong to: of those with a camera, if any."""
    return next((clip.image_size for clip in clips if clip.calibrated_views), clips[0].image_size)


def collate_tracks(
    clips: Sequence[EpisodeTracks],
    views: Sequence[str] | None = None,
    native_size: int | None = None,
    frames: Sequence[Sequence[int]] | None = None,
) -> TrackBatch:
    """Stack clips of equal length, views in the given order (default: the views of the first clip).

    Args:
        native_size: of the control vectors; None: without them.
        frames: those that are taken of each clip; None: all.

    Raises: DataError when a clip lacks a view, a frame or a vector of this size, or the clips differ in length or frame size.
    """
    if not clips:
        raise DataError("No action tracks to collate", expected="at least one clip", got="none")
    order, size = tuple(views or clips[0].views), drawn_size(clips)
    num_arms = max(len(clip.arms) for clip in clips)
    columns: dict[str, list[np.ndarray]] = {name: [] for name in SAMPLES}
    if native_size is not None:
        columns |= {"native": [], "camera": []}
    taken = [clip.index(range(clip.num_frames) if frames is None else frames[n]) for n, clip in enumerate(clips)]
    for clip, index in zip(clips, taken, strict=True):
        missing = [view for view in order if view not in clip.views]
        other_size = clip.image_size != size and bool(clip.calibrated_views)
        if missing or len(index) != len(taken[0]) or other_size:
            raise DataError(
                "Action tracks do not fit together in one batch",
                where=f"episode {clip.episode_id}",
                expected=f"views {order}, {len(taken[0])} frames of {size}",
                got=f"views {clip.views}, {len(index)} frames of {clip.image_size}",
            )
        if native_size is not None:
            known = np.array([view in clip.calibrated_views for view in order])
            columns["native"].append(_native(clip, order, native_size)[index])
            columns["camera"].append(np.tile(known, (len(index), 1)))
        slots = [clip.views.index(view) for view in order]
        for name in SAMPLES:
            values = getattr(clip, name)[index[:, None], slots]
            if num_arms > len(clip.arms):
                padding = [(0, 0)] * values.ndim
                padding[2] = (0, num_arms - len(clip.arms))
                values = np.pad(values, padding)
            columns[name].append(values)
    return TrackBatch(**{name: torch.from_numpy(np.stack(column)) for name, column in columns.items()})


def _calibrated(views: Sequence[str], camera_motion: Sequence[str]) -> tuple[str, ...]:
    return tuple(view for view, motion in zip(views, camera_motion, strict=True) if motion != "absent")


def _native(clip: EpisodeTracks, views: Sequence[str], size: int) -> np.ndarray:
    """Control vectors (n, size), padded with zeros. Raises: DataError when a clip that needs some has none, or longer ones."""
    if clip.native is None and set(views) <= set(clip.calibrated_views):
        return np.zeros((clip.num_frames, size), np.float32)
    if clip.native is None or clip.native.shape[1] > size:
        raise DataError(
            "The model is driven by control vectors that these tracks do not have",
            where=f"episode {clip.episode_id}, embodiment {clip.embodiment}",
            expected=f"up to {size} numbers a frame",
            got=None if clip.native is None else clip.native.shape[1],
            next_step="open the tracks with their episodes, or train with a larger native_size",
        )
    return np.pad(clip.native, ((0, 0), (0, size - clip.native.shape[1]))).astype(np.float32)


def write_shard(root: Path, number: int, tracks: Sequence[EpisodeTracks]) -> list[dict[str, Any]]:
    """Write one shard atomically; returns its index rows."""
    arrays: dict[str, np.ndarray] = {}
    rows: list[dict[str, Any]] = []
    for episode in tracks:
        for name in ARRAYS:
            value = getattr(episode, name)
            arrays[f"{episode.episode_id}/{name}"] = np.asarray(value, dtype=_DTYPES.get(name, np.float32))
        labels = {name: getattr(episode, name) for name in _LABELS}
        rows.append({**labels, "shard": SHARD_FILE.format(number), "num_frames": episode.num_frames})
    write_arrays_atomic(root / SHARD_FILE.format(number), arrays)
    return rows


def write_index(root: Path, rows: Sequence[dict[str, Any]], *, sigma_px_ref: float) -> None:
    """Write the index, ordered by episode id.

    Args:
        sigma_px_ref: width of the Gaussian that these tracks are drawn with, pixels on the 384 x 512 reference canvas.
    """
    ordered = sorted(rows, key=lambda row: row["episode_id"])
    listed = [row | {"sigma_px_ref": sigma_px_ref} for row in ordered]
    write_table_atomic(root / INDEX_FILE, pa.Table.from_pylist(listed, schema=_COLUMNS))


class ActionTracks:
    """Read access to a finished ActionTracks artifact; only the episodes asked for are read.

    Args:
        episodes: the recordings, for tracks that carry their native control vectors too. A row without a ``shard`` has nothing else.
    """

    def __init__(self, root: Path, rows: Sequence[dict[str, Any]], episodes: EpisodeSet | None = None) -> None:
        self.root = root
        self.episodes = episodes
        self.sigma_px_ref = float(rows[0]["sigma_px_ref"])
        self._rows = {row["episode_id"]: row for row in rows}

    @property
    def rows(self) -> list[dict[str, Any]]:
        """Rows of the index."""
        return list(self._rows.values())

    @property
    def drawn(self) -> bool:
        """Maps can be drawn of some episodes: there is more than control vectors."""
        return any(row["shard"] is not None for row in self._rows.values())

    @classmethod
    def open(cls, root: Path, episodes: EpisodeSet | None = None) -> ActionTracks:
        """Open an artifact.

        Raises: ArtifactError when there is no index of tracks.
        """
        path = Path(root) / INDEX_FILE
        try:
            return cls(Path(root), pq.read_table(path).select(_COLUMNS.names).to_pylist(), episodes)
        except (OSError, KeyError, pa.ArrowException) as error:
            raise ArtifactError(
                "Not an ActionTracks artifact", where=path, expected=", ".join(_COLUMNS.names), got=str(error),
                next_step="run render_actions",
            ) from error  # fmt: skip

    @property
    def episode_ids(self) -> list[str]:
        """Ids of the episodes with tracks, in order."""
        return list(self._rows)

    def __len__(self) -> int:
        return len(self._rows)

    def calibrated_views(self, episode_id: str) -> tuple[str, ...]:
        """Views of an episode whose camera is known."""
        row = self._rows[episode_id]
        return _calibrated(row["views"], row["camera_motion"])

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
        episode = None if self.episodes is None else self.episodes.episode(self.episodes.position(episode_id))
        native = None if episode is None else _native_controls(episode, row["controls"])
        if row["shard"] is None:
            return _without_cameras(cast("Episode", episode), row["controls"])
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
        labels = {name: tuple(row[name]) if isinstance(row[name], list) else row[name] for name in _LABELS}
        return EpisodeTracks(**labels, **arrays, native=native)


def open_controls(
    inputs: Mapping[str, Path], episodes: EpisodeSet, *, vectors: bool, controls: str = "action"
) -> ActionTracks:
    """The input ``tracks``; for a model that takes control vectors with these, and also those of recordings without tracks: of no
    arm, in no view.

    Args:
        controls: kind of the vectors where there are no tracks: "action" (commands), or what was measured.

    Raises:
        ConfigError: a model of action maps alone is given no tracks.
        DataError: no recording has such controls.
    """
    if not vectors and "tracks" not in inputs:
        raise ConfigError(
            "Action maps are drawn from action tracks", expected="an input named tracks", got=", ".join(sorted(inputs)),
            next_step="run render_actions and give its folder as --input tracks=FOLDER",
        )  # fmt: skip
    tracks = ActionTracks.open(Path(inputs["tracks"])) if "tracks" in inputs else None
    if tracks is not None and not vectors:
        return tracks
    rows = [] if tracks is None else tracks.rows
    kind = rows[0]["controls"] if rows else controls
    known = {row["episode_id"] for row in rows}
    if tracks is not None:  # what was refused for another reason than its cameras is no vector either
        known |= {row.episode_id for row in read_quarantine(tracks.root) if row.reason != NO_CALIBRATION}
    for position, row in enumerate(episodes.rows):
        if row.episode_id not in known and _has_controls(episodes.episode(position), kind):
            absent = {"views": list(VIEWS), "camera_motion": ["absent"] * len(VIEWS), "shard": None, "controls": kind}
            rows.append({"episode_id": row.episode_id, "sigma_px_ref": SIGMA_PX_REFERENCE, **absent})
    if not rows:
        raise DataError(
            "No recording has the controls that the model is driven by", where=episodes.root, expected=kind,
            got=f"none in {len(episodes)} recordings", next_step="declare actions or states in the source",
        )  # fmt: skip
    return ActionTracks(episodes.root if tracks is None else tracks.root, rows, episodes)


def _has_controls(episode: Episode, kind: str) -> bool:
    return episode.commanded if kind == "action" else episode.state_kind != "none"


def _native_controls(episode: Episode, kind: str) -> np.ndarray:
    return np.asarray(episode.action if kind == "action" else episode.state, np.float32)


def _without_cameras(episode: Episode, kind: str) -> EpisodeTracks:
    """Tracks of no arm in no view, which carry the control vectors alone."""
    n, v, identity = episode.num_frames, len(VIEWS), np.eye(4, dtype=np.float32)
    return EpisodeTracks(
        episode_id=episode.episode_id, embodiment=episode.embodiment, views=VIEWS, arms=(), image_size=(1, 1), controls=kind,
        camera_motion=("absent",) * v, uv=np.zeros((n, v, 0, 2)), depth=np.zeros((n, v, 0), np.float32),
        rot6d=np.zeros((n, v, 0, 6), np.float32), gripper=np.zeros((n, v, 0), np.float32),
        valid=np.zeros((n, v, 0), np.bool_), T_base_tool=np.zeros((n, 0, 4, 4), np.float32),
        T_base_camera=np.tile(identity, (n, v, 1, 1)), K=np.full((v, 3, 3), np.nan, np.float32),
        capsules=np.zeros((n, 0, 2, 3), np.float32), capsule_radii=np.zeros(0, np.float32),
        native=_native_controls(episode, kind),
    )  # fmt: skip
