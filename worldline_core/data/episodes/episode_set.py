"""EpisodeSet: an index over LeRobot v3 datasets with cameras, embodiment and outcome of each episode."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from worldline_core.data.episodes.episode import ARRAYS, LABELS, Episode
from worldline_core.data.episodes.episode_index import EpisodeRow, QuarantineRow, read_index, read_quarantine
from worldline_core.data.episodes.episode_set_writer import EMBODIMENTS_FOLDER, EpisodeSetWriter
from worldline_core.data.episodes.sidecar import Sidecar
from worldline_core.data.episodes.view_recording import recorded_size
from worldline_core.data.guards.plain_files import parse_json
from worldline_core.data.guards.rejection import check_rate
from worldline_core.data.guards.source_paths import inside
from worldline_core.data.lerobot.dataset import IMAGE_PREFIX, LeRobotV3Dataset
from worldline_core.data.video.clip import VideoClip, decode_frames, read_clip
from worldline_core.data.video.frames import MadeFrames
from worldline_core.data.video.thumbnails import ThumbnailMaker, ViewThumbnails, cache_path, read_thumbnails
from worldline_core.errors import DataError
from worldline_core.geometry.embodiment import carry_embodiments
from worldline_core.scale.account import InputRow
from worldline_core.scale.mapping import EpisodeWork
from worldline_core.store.remote import is_remote

__all__ = ["EpisodeRow", "EpisodeSet", "EpisodeSetWriter", "QuarantineRow"]


class EpisodeSet:
    """Read access to a set. Rows are ordered by episode id; positions 0..len-1 name them."""

    def __init__(self, root: Path, rows: Sequence[EpisodeRow], *, allow_linked: bool = True) -> None:
        self.root = root
        self.rows = list(rows)
        self._allow_linked = allow_linked
        self._position = {row.episode_id: position for position, row in enumerate(self.rows)}
        self._datasets: dict[str, tuple[LeRobotV3Dataset, Sidecar]] = {}

    @classmethod
    def open(cls, root: Path | str, *, allow_linked: bool = True) -> EpisodeSet:
        """Open a set.

        Args:
            root: its folder.
            allow_linked: whether rows may point to datasets in another artifact (by a relative path).

        Raises:
            DataError: the index is missing or incomplete.
            ConfigError: the set has a description of a robot whose name is another one's here.
        """
        root = Path(root) if isinstance(root, str) else root
        if not is_remote(root):
            carry_embodiments(sorted(root.glob(f"{EMBODIMENTS_FOLDER}/*.yaml")))
        return cls(root, read_index(root), allow_linked=allow_linked)

    def __len__(self) -> int:
        return len(self.rows)

    def position(self, episode_id: str) -> int:
        """Position of an episode.

        Raises: DataError when the set has no such episode.
        """
        if episode_id not in self._position:
            raise DataError(
                "No such episode in the set", where=self.root, got=episode_id, expected=f"one of {len(self)} ids"
            )
        return self._position[episode_id]

    def quarantine(self) -> list[QuarantineRow]:
        """Inputs that did not get into this set."""
        return read_quarantine(self.root)

    def select(self, *, split: str | Sequence[str] | None = None) -> list[int]:
        """Positions of the rows of these splits; None means all."""
        splits = None if split is None else {split} if isinstance(split, str) else set(split)
        return [position for position, row in enumerate(self.rows) if splits is None or row.split in splits]

    def dataset_path(self, i: int) -> Path:
        """Folder of the LeRobot dataset that holds row i.

        Raises: DataError for an absolute path, or one outside of the set where links are not allowed.
        """
        relative = self.rows[i].dataset
        if Path(relative).is_absolute():
            raise DataError("Index row has an absolute path", where=self.root, expected="a relative path", got=relative)
        if not self._allow_linked or is_remote(self.root):  # a published set holds its datasets
            return inside(self.root, relative)
        return Path(os.path.normpath(self.root / relative))

    def _open(self, i: int) -> tuple[LeRobotV3Dataset, Sidecar]:
        key = self.rows[i].dataset
        if key not in self._datasets:
            path = self.dataset_path(i)
            self._datasets[key] = LeRobotV3Dataset(path), Sidecar(path)
        stated, where = self._datasets[key][0].fps, f"{key}/meta/info.json, episode {self.rows[i].episode_id}"
        check_rate(stated, self.rows[i].fps, where, tolerance=1e-6, what="Dataset")
        return self._datasets[key]

    def episode(self, i: int) -> Episode:
        """Arrays and description of row i, cut to its segment.

        Raises: DataError when the stored data is incomplete; RejectedInputError (wrong_fps) when dataset and index state
            different rates.
        """
        row = self.rows[i]
        dataset, sidecar = self._open(i)
        length = int(dataset.row(row.episode_index)["length"])
        arrays = sidecar.trajectory(row.episode_index)
        if sidecar.contract.state_kind == "none":
            arrays |= dict.fromkeys(("state", "action"), np.zeros((length, 0), dtype=np.float32))
        elif "state" not in arrays:
            for name, column in (("state", "observation.state"), ("action", "action")):
                arrays[name] = dataset.column(row.episode_index, column).astype(ARRAYS[name].dtype, copy=False)
        names = sidecar.contract.state_names
        whole = Episode(
            **{name: getattr(row, name) for name in LABELS},
            **arrays,
            timestamps=np.arange(len(arrays["state"]), dtype=np.float64) / row.fps,
            cameras=sidecar.cameras(row.episode_index),
            state_names=None if names is None else tuple(names),
            state_kind=sidecar.contract.state_kind,
            video_frames=None if length == len(arrays["state"]) else length,
            conventions=_conventions(row),
        )
        if not 0 <= row.start < row.stop <= whole.num_frames:
            raise DataError(
                "Index row is outside of its episode",
                where=f"{self.root}, episode {row.episode_id}",
                expected=f"0 <= start < stop <= {whole.num_frames}",
                got=f"{row.start}..{row.stop}",
            )
        return whole if (row.start, row.stop) == (0, whole.num_frames) else whole.cut(row.start, row.stop)

    def frames(self, i: int, view: str, indices: Sequence[int] | None = None) -> np.ndarray:
        """uint8 (len, H, W, 3) RGB frames of a view.

        Args:
            indices: frame numbers counted from the start of the row's segment; None for all that have images.

        Raises: DataError when the view, the file or a frame is missing, or the video is truncated.
        """
        row, clip = self.rows[i], self.clip(i, view)
        if indices is not None and not all(0 <= index < row.video_frames for index in indices):
            raise DataError(
                "Frame index outside of the episode",
                where=f"episode {row.episode_id}",
                expected=f"0 <= index < {row.video_frames}",
                got=str(list(indices)),
            )
        return decode_frames(clip, indices)

    def clip(self, i: int, view: str) -> VideoClip:
        """The encoded video of a view of row i, cut to its segment, for callers that decode it themselves.

        Raises: DataError when the view is missing.
        """
        row = self.rows[i]
        if view not in row.views:
            raise DataError(
                "Episode has no such view", where=f"episode {row.episode_id}", expected=", ".join(row.views), got=view
            )
        dataset, _ = self._open(i)
        whole = dataset.clip(row.episode_index, IMAGE_PREFIX + view)
        return replace(whole, num_frames=row.video_frames, skip=row.start)

    def thumbnails(self, i: int, view: str) -> ViewThumbnails:
        """Small grey images of a view of row i: the ones that curation stored, or, with the same result, made from its video.

        Raises: DataError when the view or the file is missing, or the video is truncated.
        """
        row = self.rows[i]
        clip = self.clip(i, view)
        whole = replace(clip, skip=0, num_frames=int(self._open(i)[0].row(row.episode_index)["length"]))
        dataset = self.dataset_path(i)
        stored = None
        if isinstance(clip.path, Path) and clip.path.is_relative_to(dataset.parents[1]):
            stored = read_thumbnails(cache_path(dataset.parents[1], clip.path), clip.path)
        if stored is None or len(stored) != whole.num_frames:
            maker = ThumbnailMaker(row.fps, recorded_size(_conventions(row), view))
            for picture in read_clip(whole):
                maker.add(picture.luma, full_range=picture.full_range)
            stored = maker.thumbnails()
        return stored.cut(row.start, row.start + row.video_frames)

    def robot_masks(self, i: int, view: str) -> MadeFrames | None:
        """bool (N, H, W) masks of a view where the recording has them, else None; a few of them are unpacked at a time."""
        row = self.rows[i]
        masks = self._open(i)[1].masks(row.episode_index, view)
        return None if masks is None else masks[row.start : row.start + row.video_frames]

    def thing_labels(self, i: int, view: str) -> MadeFrames | None:
        """uint8 (N, H, W): 1 what the task moves, 2 where it goes, 3.. other things, 0 none; None where not recorded."""
        row = self.rows[i]
        labels = self._open(i)[1].things(row.episode_index, view)
        return None if labels is None else labels[row.start : row.start + row.video_frames]


@dataclass(frozen=True)
class EpisodeSetWork[R: InputRow](EpisodeWork[int, R]):
    """Work on the episodes of a set, each named by its position in it.

    Attributes:
        folder: of the set.
    """

    folder: Path

    @cached_property
    def episodes(self) -> EpisodeSet:
        return EpisodeSet.open(self.folder)


class ShardFilesWork[R: InputRow](EpisodeSetWork[R]):
    """Work whose shards become a file each. The facts of a shard's episodes are in `run/` until all shards are done.

    Attributes:
        shard_file: pattern of their names.
    """

    shard_file: ClassVar[str]

    def remaining(self, number: int, episodes: Sequence[int]) -> Sequence[int]:
        done = self.summary_path(number).is_file() and (self.output / self.shard_file.format(number)).is_file()
        return () if done else episodes

    def summary(self, number: int) -> dict[str, Any]:
        """Outputs that `finish_shard` wrote for a shard's episodes."""
        return json.loads(self.summary_path(number).read_text(encoding="utf-8"))

    def summary_path(self, number: int) -> Path:
        """File that `finish_shard` writes."""
        return self.output / "run" / f"shard-{number:05d}.json"


def _conventions(row: EpisodeRow) -> dict[str, str | float | int]:
    found = parse_json(row.conventions, f"index, conventions of episode {row.episode_id}")
    if not isinstance(found, dict):
        raise DataError("Conventions are no mapping", where=f"episode {row.episode_id}", got=row.conventions[:200])
    return found
