"""ActionTracks on disk: shards of safetensors and an index by episode.

Layout: `tracks-00000.safetensors` ... with entries `<episode_id>/<array>`, `index.parquet` with one row an episode.
Bytes depend on the tracks alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from worldline_core.actions.episode_tracks import EpisodeTracks
from worldline_core.errors import ArtifactError, DataError
from worldline_core.store.atomic import atomic_path, write_bytes_atomic

INDEX_FILE = "index.parquet"
ARRAYS = (
    "uv", "depth", "rot6d", "gripper", "valid", "T_base_tool", "T_base_camera", "K", "capsules", "capsule_radii",
)  # fmt: skip
_DTYPES = {"valid": np.bool_, "uv": np.float64}
"""Of the arrays that are not float32."""
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


def shard_name(number: int) -> str:
    """File name of a shard."""
    return f"tracks-{number:05d}.safetensors"


def write_shard(root: Path, number: int, tracks: Sequence[EpisodeTracks]) -> list[dict[str, Any]]:
    """Write one shard atomically; returns its index rows."""
    arrays: dict[str, np.ndarray] = {}
    rows: list[dict[str, Any]] = []
    for episode in tracks:
        for name in ARRAYS:
            value = getattr(episode, name)
            arrays[f"{episode.episode_id}/{name}"] = np.ascontiguousarray(value, dtype=_DTYPES.get(name, np.float32))
        rows.append(
            {
                "episode_id": episode.episode_id,
                "shard": shard_name(number),
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
    write_bytes_atomic(root / shard_name(number), save(arrays))
    return rows


def write_index(root: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Write the index, ordered by episode id."""
    ordered = sorted(rows, key=lambda row: row["episode_id"])
    with atomic_path(root / INDEX_FILE) as temporary:
        pq.write_table(pa.Table.from_pylist(ordered, schema=_SCHEMA), temporary)


class ActionTracks:
    """Read access to a finished ActionTracks artifact; only the episodes asked for are read."""

    def __init__(self, root: Path, rows: Sequence[dict[str, Any]]) -> None:
        self.root = root
        self._rows = {row["episode_id"]: row for row in rows}

    @classmethod
    def open(cls, root: Path) -> ActionTracks:
        """Open an artifact.

        Raises: ArtifactError when the index is missing or lacks a column.
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
        return cls(Path(root), table.to_pylist())

    @property
    def episode_ids(self) -> list[str]:
        """Ids of the episodes with tracks, in order."""
        return list(self._rows)

    def __len__(self) -> int:
        return len(self._rows)

    def __contains__(self, episode_id: str) -> bool:
        return episode_id in self._rows

    def __iter__(self) -> Iterator[EpisodeTracks]:
        return (self.tracks(episode_id) for episode_id in self._rows)

    def tracks(self, episode_id: str) -> EpisodeTracks:
        """Tracks of one episode.

        Raises:
            DataError: there are no tracks of this episode.
            ArtifactError: the shard is missing or damaged.
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
        return EpisodeTracks(
            episode_id=episode_id,
            embodiment=row["embodiment"],
            views=tuple(row["views"]),
            arms=tuple(row["arms"]),
            image_size=(row["height"], row["width"]),
            controls=row["controls"],
            camera_motion=tuple(row["camera_motion"]),
            **arrays,
        )
