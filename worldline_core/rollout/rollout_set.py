"""Sets of predicted videos on disk: one mp4 per view and seed, and an index."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from worldline_core.data.guards.source_paths import safe_stem
from worldline_core.data.video.clip import VideoClip, decode_video
from worldline_core.data.video.encoder import Encoding, VideoEncoder
from worldline_core.errors import ArtifactError, DataError
from worldline_core.store.artifact_files import read_table, row_schema
from worldline_core.store.atomic import atomic_path

INDEX_FILE = "index.parquet"


@dataclass(frozen=True)
class RolloutRow:
    """One predicted video."""

    episode_id: str
    method: str
    view: str
    seed: int
    path: str
    num_frames: int
    height: int
    width: int
    fps: float


_SCHEMA = row_schema(RolloutRow)


def video_path(episode_id: str, seed: int, view: str) -> str:
    """Path of a prediction in its set."""
    return f"videos/{safe_stem(episode_id)}/seed-{seed}/{view}.mp4"


class RolloutSetWriter:
    """Writes predictions one by one; :meth:`close` writes the index. Bytes depend on the frames alone."""

    def __init__(self, root: Path, method: str, fps: float, *, crf: int = 8) -> None:
        self.root = root
        self.method = method
        self.fps = fps
        self.crf = crf
        self._rows: list[RolloutRow] = []

    def has(self, episode_id: str, seed: int, views: tuple[str, ...]) -> bool:
        """True when every video of a prediction is already there (files appear only when whole)."""
        return all((self.root / video_path(episode_id, seed, view)).is_file() for view in views)

    def add(self, episode_id: str, seed: int, frames: Mapping[str, np.ndarray]) -> None:
        """Encode ``uint8 (N, H, W, 3)`` frames of every view."""
        _, height, width, _ = next(iter(frames.values())).shape
        with self.video(episode_id, seed, tuple(frames), (height, width)) as add:
            add(frames)

    @contextmanager
    def video(
        self, episode_id: str, seed: int, views: tuple[str, ...], size: tuple[int, int]
    ) -> Iterator[Callable[[Mapping[str, np.ndarray]], None]]:
        """Encode a prediction piece by piece: gives a function that takes the next frames, ``uint8 (n, H, W, 3)`` by view.

        The files appear, and are entered, when the block ends without an error.
        """
        # Full chroma and a low factor: metrics should see the prediction, not the codec.
        # Predictions are many and small: a slower search of x264 would cost more than sampling them in one step.
        encoding = Encoding(self.crf, pixel_format="yuv444p")
        with ExitStack() as stack:
            encoders: dict[str, VideoEncoder] = {}
            for view in views:
                temporary = stack.enter_context(atomic_path(self.root / video_path(episode_id, seed, view)))
                encoders[view] = stack.enter_context(VideoEncoder(temporary, size, self.fps, encoding))

            def add(frames: Mapping[str, np.ndarray]) -> None:
                for view, pictures in frames.items():
                    for picture in pictures:
                        encoders[view].add(picture)

            yield add
        for view, encoder in encoders.items():
            self.register(episode_id, seed, view, encoder.count, size)

    def register(self, episode_id: str, seed: int, view: str, num_frames: int, size: tuple[int, int]) -> None:
        """Enter a video that an earlier, interrupted call has written."""
        path = video_path(episode_id, seed, view)
        self._rows.append(RolloutRow(episode_id, self.method, view, seed, path, num_frames, *size, self.fps))

    def close(self) -> None:
        """Write the index, ordered by episode, seed and view."""
        rows = sorted(self._rows, key=lambda row: (row.episode_id, row.seed, row.view))
        table = pa.Table.from_pylist([asdict(row) for row in rows], schema=_SCHEMA)
        with atomic_path(self.root / INDEX_FILE) as temporary:
            pq.write_table(table, temporary)


class RolloutSet:
    """Read access to a finished set."""

    def __init__(self, root: Path, rows: list[RolloutRow]) -> None:
        self.root = root
        self.rows = rows
        self.method = rows[0].method
        self.fps = rows[0].fps
        self._by_key = {(row.episode_id, row.view, row.seed): row for row in rows}

    @classmethod
    def open(cls, root: Path) -> RolloutSet:
        """Open a set.

        Raises:
            ArtifactError: the index is missing or damaged, lacks a column, is empty, mixes methods or rates, or names a
                video twice.
        """
        root = Path(root)
        path = root / INDEX_FILE
        table = read_table(path)
        if table is None:
            raise ArtifactError("Not a set of rollouts", where=root, expected=INDEX_FILE, next_step="run rollout")
        try:
            table = table.select(_SCHEMA.names).cast(_SCHEMA)
        except (KeyError, pa.ArrowInvalid, pa.ArrowNotImplementedError) as error:
            raise ArtifactError(
                "The index of the rollouts has other columns", where=path, expected=_SCHEMA.names, got=str(error)
            ) from error
        rows = [RolloutRow(**row) for row in table.to_pylist()]
        methods = sorted({str(row.method) for row in rows})
        if len(methods) != 1:
            raise ArtifactError("A set of rollouts holds one method", where=path, expected="one", got=methods)
        videos, rates = {(row.episode_id, row.view, row.seed) for row in rows}, {row.fps for row in rows}
        known = not any(column.null_count for column in table.columns) and min(row.num_frames for row in rows) > 0
        if len(videos) < len(rows) or len(rates) > 1 or not known or not 0 < rows[0].fps < math.inf:
            raise ArtifactError(
                "The index of the rollouts is damaged", where=path, expected="each video once, with its frames, at one rate",
                got=f"{len(rows)} rows of {len(videos)} videos at {sorted(rates)[:3]} fps",
            )  # fmt: skip
        return cls(root, rows)

    @property
    def episode_ids(self) -> list[str]:
        return list(dict.fromkeys(row.episode_id for row in self.rows))

    def seeds(self, episode_id: str) -> list[int]:
        """Seeds an episode was predicted with, ascending."""
        return sorted({row.seed for row in self.rows if row.episode_id == episode_id})

    def views(self, episode_id: str) -> list[str]:
        return list(dict.fromkeys(row.view for row in self.rows if row.episode_id == episode_id))

    def frames(self, episode_id: str, view: str, seed: int | None = None) -> np.ndarray:
        """``uint8 (N, H, W, 3)`` RGB, the conditioning frame first; raises as :meth:`clip`."""
        clip = self.clip(episode_id, view, seed)
        return decode_video(clip.path, expected_frames=clip.num_frames)

    def clip(self, episode_id: str, view: str, seed: int | None = None) -> VideoClip:
        """The encoded video of a prediction; without a seed, of the smallest one.

        Raises:
            DataError: there is no such prediction.
            ArtifactError: its file leads out of the set.
        """
        seeds = self.seeds(episode_id)
        if seed is None and seeds:
            seed = seeds[0]
        row = None if seed is None else self._by_key.get((episode_id, view, seed))
        if row is None:
            raise DataError(
                "No such prediction",
                where=self.root,
                expected=f"seeds {seeds}, views {self.views(episode_id)}",
                got=f"episode {episode_id}, view {view}, seed {seed}",
            )
        if "\0" in row.path or not (path := (self.root / row.path).resolve()).is_relative_to(self.root.resolve()):
            raise ArtifactError("A video of the set is outside of it", where=self.root, got=row.path)
        return VideoClip.whole_file(path, row.num_frames, row.fps)
