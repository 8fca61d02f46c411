"""Write an EpisodeSet episode by episode.

Episodes are encoded into run/episodes/ as they come (whole or absent), and joined into datasets by `close`. Episodes may be
added in any order, by several processes over the same folder, and again after a kill: the set depends on the
episodes alone.
"""

from __future__ import annotations

import json
import shutil
import uuid
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

import numpy as np

from worldline_core.data.episodes.episode import (
    ARRAYS,
    LABELS,
    NO_EMBODIMENT,
    VIEWS,
    CameraTrack,
    Episode,
    EpisodeDescription,
    Split,
)
from worldline_core.data.episodes.episode_index import (
    INDEX_FILE,
    EpisodeRow,
    QuarantineRow,
    nothing_kept,
    write_index,
    write_quarantine,
)
from worldline_core.data.episodes.fingerprint import fingerprint
from worldline_core.data.episodes.lerobot_writer import EpisodeVideo, write_dataset
from worldline_core.data.episodes.sidecar import Packed, write_sidecar
from worldline_core.data.episodes.view_recording import (
    RECORDED_SIZE,
    VideoMode,
    VideoSettings,
    ViewImages,
    recorded_size,
    store_view,
)
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.guards.source_paths import safe_name
from worldline_core.data.video.encoder import PixelFormat
from worldline_core.data.video.frames import Frames, packed_images
from worldline_core.data.video.thumbnails import ViewThumbnails
from worldline_core.errors import ConfigError, DataError
from worldline_core.geometry.embodiment import load_embodiment, own_embodiment
from worldline_core.store.atomic import write_bytes_atomic, write_json_atomic

VIDEOS_FILE = "videos.json"
"""Counts of the set's videos that were copied as recorded and that were encoded, and their codecs."""
EMBODIMENTS_FOLDER = "embodiments"
"""Robots of the recordings that do not ship with the project."""


def part_name(episode_id: str) -> str:
    """Folder name of an episode: any id is allowed, the name is safe and unique."""
    return sha256(episode_id.encode()).hexdigest()[:32]


class Part:
    """One waiting episode. Its description is read at once (`part["split"]`, `part["fingerprint"]`), its arrays when asked for."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.description: dict[str, Any] = json.loads((folder / "part.json").read_text())

    def __getitem__(self, key: str) -> Any:
        return self.description[key]

    @cached_property
    def _arrays(self) -> dict[str, np.ndarray]:
        with np.load(self.folder / "arrays.npz", allow_pickle=False) as stored:
            return {key: stored[key] for key in stored.files}

    @cached_property
    def episode(self) -> Episode:
        """The episode as the set stores it: its times follow from its rate."""
        arrays: dict[str, Any] = self._arrays
        cameras = {
            view: CameraTrack(view, arrays[f"K.{view}"], arrays[f"pose.{view}"], width, height)
            for view, (width, height) in self["cameras"].items()
        }
        return Episode(
            **EpisodeDescription.arguments(self.description),
            **{name: arrays[name] for name in ARRAYS if name in arrays},
            timestamps=np.arange(self["num_frames"]) / self["fps"],
            cameras=cameras,
            video_frames=self["video_frames"],
        )

    @cached_property
    def videos(self) -> dict[str, EpisodeVideo]:
        """By view: first the project's own in their order, then any others by name."""
        found = self["videos"]
        return {
            view: EpisodeVideo(
                path=self.folder / f"{view}.mp4",
                histogram=self._arrays[f"histogram.{view}"],
                **found[view] | {"size": tuple(found[view]["size"])},
            )
            for view in sorted(found, key=lambda view: (VIEWS.index(view) if view in VIEWS else len(VIEWS), view))
        }

    def packed(self, kind: Literal["masks", "things"]) -> Packed:
        return {view: (shape, self._arrays[f"{kind}.{view}"].tobytes()) for view, shape in self[kind].items()}

    @property
    def signature(self) -> tuple[Any, ...]:
        """Episodes with equal signatures fit into one LeRobot dataset."""
        episode = self.episode
        videos = tuple((view, video.size, video.codec, video.pixel_format) for view, video in self.videos.items())
        columns = episode.state.shape[1]
        return episode.embodiment, episode.fps, videos, columns, episode.state_names, episode.state_kind


class EpisodeSetWriter:
    """Collects episodes and quarantined inputs below `root`.

    Args:
        root: the set's folder; work in progress is in root/run/.
        video_crf: x264 quality; 18 is visually exact, 28 small.
        video_mode: "auto" copies encoded videos in which nothing changes, "encode" encodes every picture.
        key_frame_interval: frames from one key frame of an encoded video to the next.

    Raises: DataError when the folder already holds a finished set.
    """

    def __init__(
        self,
        root: Path,
        video_crf: int = 18,
        video_preset: str = "veryfast",
        pixel_format: PixelFormat = "yuv420p",
        video_mode: VideoMode = "auto",
        key_frame_interval: int = VideoSettings.key_frame_interval,
    ) -> None:
        if self.finished(root):
            raise DataError("Folder already holds a finished EpisodeSet", where=root, next_step="write to a new folder")
        self.root = root
        self.video = VideoSettings(video_crf, video_preset, pixel_format, key_frame_interval, video_mode)
        self._work = root / "run" / "episodes"
        self._parts = self._work / "parts"
        self._rejected = self._work / "rejected"
        self._parts.mkdir(parents=True, exist_ok=True)
        self._rejected.mkdir(parents=True, exist_ok=True)

    @staticmethod
    def finished(root: Path) -> bool:
        """True if `close` has completed in this folder."""
        return (root / INDEX_FILE).exists() and not (root / "run" / "episodes").is_dir()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()

    def has(self, episode_id: str) -> bool:
        """True if the episode was already added or quarantined, for example before a kill."""
        name = part_name(episode_id)
        return (self._parts / name).is_dir() or (self._rejected / f"{name}.json").is_file()

    def add(
        self,
        episode: Episode,
        frames: Mapping[str, np.ndarray | ViewImages],
        robot_masks: Mapping[str, Frames] | None = None,
        described: Callable[[Mapping[str, ViewThumbnails]], Episode] | None = None,
        thing_labels: Mapping[str, Frames] | None = None,
    ) -> None:
        """Add one episode.

        Args:
            frames: by view, uint8 (N, H, W, 3) RGB with N = episode.num_video_frames, or what is read, picture by
                picture, while it is written.
            robot_masks: by view, bool (N, H, W).
            described: gives the episode as it is stored, where its description depends on what its views show.
            thing_labels: by view, uint8 (N, H, W): 1 what the task moves, 2 where it goes, 3.. other things, 0 none.

        Raises: DataError when frames, masks, cameras and states do not belong together; RejectedInputError for
            recordings that cannot be read or do not belong to the states.
        """
        where = f"episode {episode.episode_id}"
        if not frames:
            raise DataError("Episode has no images", where=where, expected="at least one view", got="none")
        safe_name(episode.embodiment, "Embodiment")
        views: dict[str, ViewImages] = {}
        for view, images in frames.items():
            safe_name(view, "View")
            if isinstance(images, np.ndarray):
                if images.dtype != np.uint8 or images.ndim != 4 or images.shape[3] != 3:
                    raise DataError(
                        "Images have a wrong size or type",
                        where=f"{where}, view {view}",
                        expected="uint8 (N, H, W, 3)",
                        got=f"{images.dtype} {images.shape}",
                    )
                images = ViewImages(images.__iter__, episode.num_video_frames)
            views[view] = images
        robot_masks, thing_labels = robot_masks or {}, thing_labels or {}
        final = self._parts / part_name(episode.episode_id)
        # Not by the process id, which the containers that share a store have in common.
        working = self._parts / f".{final.name}.{uuid.uuid4().hex}"
        working.mkdir(parents=True)
        try:
            stored: dict[str, EpisodeVideo] = {}
            thumbnails: dict[str, ViewThumbnails] = {}
            enlarged: dict[str, str] = {}
            for view, recorded in views.items():
                path, before = working / f"{view}.mp4", recorded_size(episode.conventions, view)
                stored[view], thumbnails[view], size = store_view(recorded, path, episode.fps, self.video, before)
                if size != stored[view].size:
                    enlarged[f"{RECORDED_SIZE}{view}"] = f"{size[0]}x{size[1]}"
            _check_sizes(episode, stored, robot_masks, thing_labels)
            if described is not None:
                episode = described(thumbnails)
            others = {name: value for name, value in episode.conventions.items() if not name.startswith(RECORDED_SIZE)}
            episode = replace(episode, conventions=others | enlarged)
            arrays = {name: values.astype(ARRAYS[name].dtype) for name, values in episode.arrays().items()}
            for view, camera in episode.cameras.items():
                arrays[f"K.{view}"] = camera.K.astype(np.float64)
                arrays[f"pose.{view}"] = camera.T_base_camera.astype(np.float64)
            arrays |= {f"masks.{view}": packed_images(masks, bool, 9) for view, masks in robot_masks.items()}
            arrays |= {f"things.{view}": packed_images(labels, np.uint8, 6) for view, labels in thing_labels.items()}
            arrays |= {f"histogram.{view}": kept.histogram for view, kept in stored.items()}
            with (working / "arrays.npz").open("wb") as stream:
                np.savez(stream, allow_pickle=False, **arrays)
            description = {
                **episode.described(),
                "fps": float(episode.fps),
                "num_frames": episode.num_frames,
                "video_frames": episode.num_video_frames,
                "videos": {
                    view: {name: getattr(kept, name) for name in ("size", "codec", "pixel_format", "copied")}
                    for view, kept in stored.items()
                },
                "cameras": {view: [camera.width, camera.height] for view, camera in episode.cameras.items()},
                "masks": {view: list(mask.shape) for view, mask in robot_masks.items()},
                "things": {view: list(labels.shape) for view, labels in thing_labels.items()},
                "fingerprint": fingerprint(episode, thumbnails),
            }
            (working / "part.json").write_text(json.dumps(description, sort_keys=True))
            shutil.rmtree(final, ignore_errors=True)
            working.rename(final)
        finally:
            shutil.rmtree(working, ignore_errors=True)

    def quarantine(
        self, episode_id: str, source: str, reason: str, detail: str, evidence: Mapping[str, Any] | None = None
    ) -> None:
        """Note an input that did not get through."""
        row = QuarantineRow(episode_id, source, reason, detail, json.dumps(dict(evidence or {}), sort_keys=True))
        write_json_atomic(self._rejected / f"{part_name(episode_id)}.json", asdict(row))

    def recorded(self, episode_id: str) -> Part | QuarantineRow | None:
        """Outcome of an episode so far; None when it was neither added nor quarantined."""
        name = part_name(episode_id)
        if (self._parts / name).is_dir():
            return Part(self._parts / name)
        rejected = self._rejected / f"{name}.json"
        return QuarantineRow(**json.loads(rejected.read_text())) if rejected.is_file() else None

    def kept(self) -> list[Part]:
        """Episodes added so far, by id."""
        found = [Part(path) for path in self._parts.iterdir() if not path.name.startswith(".")]
        return sorted(found, key=lambda part: part["episode_id"])

    def rejected(self) -> list[QuarantineRow]:
        """Inputs quarantined so far, by id."""
        files = sorted(path for path in self._rejected.glob("*.json") if not path.name.startswith("."))
        rows = [QuarantineRow(**json.loads(path.read_text())) for path in files]
        return sorted(rows, key=lambda row: row.episode_id)

    def assign_splits(self, splits: Mapping[str, Split]) -> None:
        """Give added episodes their splits, where these depend on the whole set."""
        for part in self.kept():
            split = splits.get(part["episode_id"], part["split"])
            if split != part["split"]:
                write_json_atomic(part.folder / "part.json", part.description | {"split": split})

    def discard(self, episode_id: str) -> None:
        """Take back an added episode (before it is quarantined instead)."""
        shutil.rmtree(self._parts / part_name(episode_id), ignore_errors=True)

    def close(self) -> None:
        """Assemble datasets, index and quarantine.

        Raises: DataError when nothing was kept; the quarantine is written all the same.
        """
        parts, rejected = self.kept(), self.rejected()
        if not parts:
            next_step = "repair the recordings or the source's configuration; the table has the reason of each episode"
            raise nothing_kept("No episode was kept", self.root, rejected, next_step)
        groups: dict[tuple[Any, ...], list[Part]] = {}
        for part in parts:
            groups.setdefault(part.signature, []).append(part)
        rows: list[EpisodeRow] = []
        used: Counter[str] = Counter()
        for members in groups.values():
            embodiment = members[0].episode.embodiment
            used[embodiment] += 1
            name = embodiment if used[embodiment] == 1 else f"{embodiment}_{used[embodiment]}"
            dataset = self.root / "datasets" / name
            # LeRobot has no frames without images: the sidecar holds the states that go on after them.
            filmed = [part.episode.cut(0, part.episode.num_video_frames) for part in members]
            write_dataset(dataset, filmed, [part.videos for part in members])
            masks, things = ([part.packed(kind) for part in members] for kind in ("masks", "things"))
            sizes = {view: video.size for view, video in members[0].videos.items()}
            write_sidecar(dataset, [part.episode for part in members], masks, things, sizes)
            rows += [_row(part, f"datasets/{name}", index) for index, part in enumerate(members)]
        copy_embodiments((row.embodiment for row in rows), self.root / EMBODIMENTS_FOLDER)
        write_json_atomic(self.root / VIDEOS_FILE, _count_videos(parts))
        write_quarantine(self.root, rejected)
        write_index(self.root, sorted(rows, key=lambda row: row.episode_id))
        # Renamed first: a kill while deleting must not leave a folder that looks like unfinished work.
        leftovers = self._work.with_name("episodes.finished")
        shutil.rmtree(leftovers, ignore_errors=True)
        self._work.rename(leftovers)
        shutil.rmtree(leftovers)


def _count_videos(parts: Sequence[Part]) -> dict[str, Any]:
    videos = [video for part in parts for video in part["videos"].values()]
    copied = sum(video["copied"] for video in videos)
    codecs = Counter(f"{video['codec']} {video['pixel_format']}" for video in videos)
    return {"copied": copied, "encoded": len(videos) - copied, "codecs": dict(sorted(codecs.items()))}


def _row(part: Part, dataset: str, episode_index: int) -> EpisodeRow:
    episode, views = part.episode, tuple(part.videos)
    reason = None if set(views) & set(episode.cameras) else "missing_calibration"
    if reason is None and episode.embodiment == NO_EMBODIMENT and episode.T_base_ee is None:
        reason = "missing_kinematics"
    if episode.state_kind == "none":
        reason = "missing_actions"
    return EpisodeRow(
        **{name: getattr(episode, name) for name in LABELS},
        dataset=dataset,
        episode_index=episode_index,
        start=0,
        stop=episode.num_frames,
        num_frames=episode.num_frames,
        video_frames=episode.num_video_frames,
        views=views,
        stage1_ok=episode.primary_view in views,
        stage2_ok=reason is None,
        stage2_reason=reason,
        conventions=json.dumps(dict(episode.conventions), sort_keys=True),
    )


def _check_sizes(
    episode: Episode,
    stored: Mapping[str, EpisodeVideo],
    robot_masks: Mapping[str, Frames],
    thing_labels: Mapping[str, Frames],
) -> None:
    where = f"episode {episode.episode_id}"
    for view, kept in stored.items():
        camera = episode.cameras.get(view)
        if camera is not None and (camera.height, camera.width) != kept.size:
            raise RejectedInputError(
                "missing_calibration",
                "Camera is calibrated for another image size",
                where=f"{where}, view {view}",
                expected=f"{kept.size[0]}x{kept.size[1]}",
                got=f"{camera.height}x{camera.width}",
                next_step="use CameraTrack.resized so that K follows the resize",
                evidence={"view": view, "images": list(kept.size), "calibrated": [camera.height, camera.width]},
            )
    for what, images in (("Robot masks", robot_masks), ("Labels of things", thing_labels)):
        for view, values in images.items():
            expected = (episode.num_video_frames, *stored[view].size) if view in stored else "a view with images"
            if values.shape != expected:
                raise DataError(
                    f"{what} do not match the images",
                    where=f"{where}, view {view}",
                    expected=expected,
                    got=values.shape,
                )


def copy_embodiments(names: Iterable[str], folder: Path) -> None:
    """Write files of robots that do not ship with the project, and their descriptions, into a folder.

    Raises: ConfigError: a description is not beside or below its YAML file.
    """
    for name in sorted(set(names)):
        if (path := own_embodiment(name)) is None:
            continue
        embodiment = load_embodiment(name)
        relative = Path(embodiment.description.file)
        if relative.is_absolute() or ".." in relative.parts:
            raise ConfigError("A description is not beside its robot's file", where=path, got=str(relative))
        write_bytes_atomic(folder / f"{name}.yaml", path.read_bytes())
        if embodiment.description_path.is_file():
            write_bytes_atomic(folder / relative, embodiment.description_path.read_bytes())
