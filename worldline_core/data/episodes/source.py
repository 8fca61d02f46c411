"""Define the interface of all sources of episodes, the part that their configurations share, and the base of readers whose
episodes are files below a folder, under ids that are unique and storable.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from pathlib import PurePosixPath
from typing import Annotated, Any, ClassVar, Literal, Protocol

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from worldline_core.config import FrameRate, ImageSize, StrictModel
from worldline_core.data.episodes.conventions import RecordedConventions
from worldline_core.data.episodes.episode import (
    NO_EMBODIMENT,
    REPEATS_STATE,
    TRAINING_SPLITS,
    Episode,
    Outcome,
    Split,
    TaskFamily,
)
from worldline_core.data.guards.rejection import (
    RejectedInputError,
    check_length,
    check_rate,
    check_texts,
    collect_faults,
)
from worldline_core.data.guards.source_paths import AnyPath, SourceFolder, inside, relative_name
from worldline_core.data.video.clip import VideoClip, read_clip, video_size
from worldline_core.data.video.frames import MadeFrames
from worldline_core.errors import CalibrationError, ConfigError
from worldline_core.geometry.cameras import Fit
from worldline_core.geometry.embodiment import check_embodiment_name, load_embodiment
from worldline_core.geometry.lens import Distortion, DistortionModel
from worldline_core.untrusted_text import printable

Masks = np.ndarray | MadeFrames
EVALUATION_LAYOUTS = ("droid annotation", "robotwin", "worldarena")
"""Layouts, as their readers note them in an episode's conventions, that never train or select a model."""
EVALUATION_ONLY = "evaluation_only"
"""Noted in the conventions of episodes of other layouts that never do either."""
_FAR_OUTSIDE = 0.1
_DROID = re.compile(r"(?<![a-z])droid(?![a-z])", re.IGNORECASE)  # and not "android"


@dataclass(frozen=True)
class LoadedEpisode:
    """An episode at the source's own rate and image size; images are read when they are asked for, one at a time.

    Attributes:
        views: views that have images.
        images: view -> uint8 (H, W, 3) RGB per frame; asked only for views that are not in `clips`.
        robot_masks: view -> bool (N, H, W), or None where the source has none.
        distortions: lenses of the views whose images are not those of a pinhole; K is then that of the lens.
        clips: view -> its encoded video, of the views that are videos; curation decodes it once, and stores it without
            encoding where no picture changes.
        absent: view -> why, of the views that the source names and whose pictures are not there.
        with_mounted: adds the cameras that a calibration file places by the measured joints, once these are the contract's.
        thing_labels: view -> uint8 (N, H, W) as in `EpisodeSet.thing_labels`, or None where the source has none.
    """

    episode: Episode
    views: tuple[str, ...]
    images: Callable[[str], Iterable[np.ndarray]] = lambda view: ()
    robot_masks: Callable[[str], Masks | None] = lambda view: None
    distortions: Mapping[str, Distortion] = field(default_factory=dict)
    clips: Mapping[str, VideoClip] = field(default_factory=dict)
    thing_labels: Callable[[str], Masks | None] = lambda view: None
    absent: Mapping[str, RejectedInputError] = field(default_factory=dict)
    with_mounted: Callable[[LoadedEpisode], LoadedEpisode] = lambda loaded: loaded

    def __post_init__(self) -> None:
        """Raises: RejectedInputError (invalid_text): texts of every source pass here, before anything is stored."""
        views = (*self.views, *self.absent, *self.episode.cameras)
        check_texts({**self.episode.described(), "views": views}, f"episode {self.episode.episode_id}")

    def each_image(self, view: str) -> Iterator[np.ndarray]:
        """uint8 (H, W, 3) RGB per frame.

        Raises: RejectedInputError, while it is iterated, for whatever cannot be read.
        """
        if view in self.clips:
            yield from (picture.rgb for picture in read_clip(self.clips[view], calibrated=view in self.episode.cameras))
        else:
            yield from self.images(view)

    def image_size(self, view: str) -> tuple[int, int]:
        """(height, width) of a view's pictures. Raises: RejectedInputError where the first cannot be read."""
        if view in self.clips:
            return video_size(self.clips[view].path)[:2]
        first = next(iter(self.images(view)), None)
        if first is None:
            raise RejectedInputError(
                "length_mismatch", "View has no pictures", where=f"{self.episode.episode_id}, view {view}"
            )
        return first.shape[0], first.shape[1]

    def frames(self, view: str) -> np.ndarray:
        """uint8 (episode.num_video_frames, H, W, 3) RGB, all in memory.

        Raises: RejectedInputError for whatever cannot be read.
        """
        return np.stack(list(self.each_image(view)))

    def cut(self, episode: Episode, kept: Callable[[str], range]) -> LoadedEpisode:
        """These consecutive frames of each view, with the episode that they belong to.

        Raises: RejectedInputError (length_mismatch), while a view is read, for another number of pictures than states.
        """
        recorded = self.episode

        def check_count(found: int, view: str) -> None:
            where = f"episode {recorded.episode_id}, view {view}"
            check_length("Video", where, states=recorded.num_video_frames, unit="frames", found=found)

        def images(view: str) -> Iterator[np.ndarray]:
            count, wanted = 0, kept(view)
            for count, image in enumerate(self.images(view), 1):
                if count - 1 in wanted:
                    yield image
            check_count(count, view)

        def part(found: Masks | None, view: str) -> Masks | None:
            if found is not None:
                check_count(len(found), view)
            return None if found is None else found[kept(view).start : kept(view).stop]

        return replace(
            self,
            episode=episode,
            images=images,
            robot_masks=lambda view: part(self.robot_masks(view), view),
            thing_labels=lambda view: part(self.thing_labels(view), view),
            clips={view: clip.cut(kept(view).start, kept(view).stop) for view, clip in self.clips.items()},
        )


def sorted_views[T](
    views: Iterable[str], read: Callable[[str], T], faults: list[RejectedInputError]
) -> tuple[dict[str, T], dict[str, RejectedInputError]]:
    """Results of `read` by view; and the rejection of each whose pictures are not there. Others go to `faults`."""
    found: dict[str, T] = {}
    absent: dict[str, RejectedInputError] = {}
    for view in views:
        refused: list[RejectedInputError] = []
        with collect_faults(refused):
            found[view] = read(view)
        for fault in refused:
            if fault.reason in ("missing_file", "missing_view"):
                absent[view] = fault
            else:
                faults.append(fault)
    return found, absent


class EpisodeSource(Protocol):
    """A collection of recordings. `load` raises a DataError for a bad episode; the others are not touched by it.

    Attributes:
        looked_for: what makes an episode, for the message of a source that has none.
    """

    @property
    def looked_for(self) -> str: ...

    def episode_ids(self) -> list[str]: ...

    def load(self, episode_id: str) -> LoadedEpisode: ...


class SourceConfigBase(StrictModel):
    """Fields of every source."""

    path: SourceFolder = Field(description="folder of the recordings, or a URL (s3://bucket/folder)")
    name: str | None = Field(default=None, description="name of the source in the index; default: the folder's name")
    include: tuple[str, ...] | None = Field(
        default=None, description="shell patterns of the episode ids to read; null: all"
    )
    conventions: RecordedConventions = Field(
        default=RecordedConventions(),
        description="how these recordings depart from the contract; `worldline calibrate check` finds out",
    )

    license: str = Field(
        default="unknown", description="licence of the recordings: an SPDX identifier (CC-BY-4.0), or its name"
    )
    redistribution: Literal["yes", "no", "unknown"] = Field(
        default="unknown", description="whether the licence lets others have these recordings"
    )
    image_size: ImageSize | None = Field(
        default=None, description="(height, width) of this source's images; null: curate.image_size"
    )
    fit: Fit | None = Field(default=None, description="how they come to that size; null: curate.fit")
    target_fps: FrameRate | None = Field(
        default=None, description="rate of this source's episodes in the set; null: curate.fps"
    )
    stride: int | None = Field(
        default=None, ge=1, description="instead of a rate: keep every so many frames of this source"
    )
    primary_view: str | None = Field(
        default=None,
        description="task-facing view of this source; null: curate.primary_view, else what the recording says",
    )

    @model_validator(mode="after")
    def _one_rate(self) -> SourceConfigBase:
        if self.target_fps is not None and self.stride is not None:
            raise ValueError("target_fps and stride both say how frames are thinned: give one of them")
        return self

    @property
    def label(self) -> str:
        return self.name or printable(self.path.name)

    def includes(self, episode_id: str) -> bool:
        """True if the configuration asks for this episode."""
        return self.include is None or any(fnmatchcase(episode_id, pattern) for pattern in self.include)


def _described(name: str) -> str:
    if name != NO_EMBODIMENT:
        try:
            if name.endswith((".yaml", ".yml")):
                load_embodiment(name)
            else:
                check_embodiment_name(name)
        except ConfigError as error:
            next_step = f"{error.next_step}; or embodiment: {NO_EMBODIMENT}, which takes the recordings for Stage I"
            raise ValueError(f"there is no description of the robot {name} ({error.expected}); {next_step}") from error
    return name


EmbodimentName = Annotated[str, AfterValidator(_described)]
"""Field type of a configuration: a robot by its name or by the path of its file, or `none` without a description."""


class ForeignSourceConfig(SourceConfigBase):
    """Facts that foreign recordings do not state, so that the user declares them."""

    split: Split = Field(default="test", description="never train without saying so")
    scene: str | None = Field(default=None, description="scene of all episodes; default: one scene per episode folder")
    task_family: TaskFamily = "unknown"
    outcome: Outcome = "unknown"
    calibration: str | None = Field(
        default=None,
        description="file with cameras of the views, in place of the recordings' own (docs/sources.md): in the source's folder,"
        " or an absolute path",
    )

    @model_validator(mode="after")
    def _not_for_training(self) -> ForeignSourceConfig:
        if getattr(self, "evaluation_only", False) and self.split in TRAINING_SPLITS:
            raise ValueError(
                f"these recordings are for evaluation only: split {self.split} is refused, use test or ood_test"
            )
        return self

    def declared(self, scene: str) -> dict[str, Any]:
        """Fields of an `Episode` that the configuration decides.

        Args:
            scene: of the episode where the configuration names none.
        """
        return {
            "source": self.label,
            "scene": self.scene or scene,
            "task_family": self.task_family,
            "split": self.split,
        }


class EvaluationSourceConfig(ForeignSourceConfig):
    """A source that results are compared on, and that therefore never trains or selects a model."""

    evaluation_only: ClassVar[bool] = True


class LensConfig(StrictModel):
    """A lens that a format has no place for, declared by the user: OpenCV's model and coefficients."""

    model: DistortionModel
    coefficients: tuple[float, ...]

    @model_validator(mode="after")
    def _usable(self) -> LensConfig:
        try:
            _ = self.distortion
        except CalibrationError as error:
            raise ValueError(str(error)) from error
        return self

    @property
    def distortion(self) -> Distortion:
        return Distortion(self.model, self.coefficients)


class GripperRange(StrictModel):
    """Raw gripper readings at the two ends."""

    closed: float
    open: float

    @model_validator(mode="after")
    def _two_ends(self) -> GripperRange:
        if not (np.isfinite(self.closed) and np.isfinite(self.open) and self.closed != self.open):
            raise ValueError(f"closed ({self.closed}) and open ({self.open}) must be two different readings")
        return self

    def opening(self, raw: np.ndarray) -> tuple[np.ndarray, int]:
        """Opening in 0 closed .. 1 open, clipped, and how many readings lay outside.

        Raises: RejectedInputError (invalid_gripper) where a gripper (a column of (N, ...) readings) is further outside
            than a tenth of the range in most frames: the range, the unit or the column is not the gripper's.
        """
        raw = np.asarray(raw, dtype=np.float64)
        value = (raw - self.closed) / (self.open - self.closed)
        far = np.abs(value - 0.5) > 0.5 + _FAR_OUTSIDE
        if len(raw) and (far.mean(axis=0) > 0.5).any():
            raise RejectedInputError(
                "invalid_gripper",
                "Readings of a gripper are outside of the declared range in most frames",
                expected=f"{self.closed:g} closed .. {self.open:g} open",
                got=f"{raw.min():g} .. {raw.max():g}",
                next_step="declare the readings of this gripper, or the column that holds them",
                evidence={"min": float(raw.min()), "max": float(raw.max()), "share": float(far.mean(axis=0).max())},
            )
        return np.clip(value, 0.0, 1.0), int(np.count_nonzero((value < 0.0) | (value > 1.0)))


def says_droid(*names: str) -> bool:
    """True if one of the names of a dataset, its folder or its robot says that it is DROID, which is for evaluation only."""
    return any(_DROID.search(name) for name in names)


def for_evaluation_only(conventions: Mapping[str, object], *names: str) -> bool:
    """True for recordings of an evaluation-only layout, those declared so, and any whose source or robot is called DROID."""
    marked = conventions.get("layout") in EVALUATION_LAYOUTS or EVALUATION_ONLY in conventions
    return marked or says_droid(*names)


def joint_names(arms: Mapping[str, int], *, gripper: bool = True) -> tuple[str, ...]:
    """Names of state columns, from arm -> number of its joints: left/joint_1, ..., left/gripper, right/joint_1, ..."""
    last = ["gripper"] if gripper else []
    return tuple(
        f"{arm}/{name}" for arm, joints in arms.items() for name in (*(f"joint_{j + 1}" for j in range(joints)), *last)
    )


_MAX_ID_LENGTH = 512
_DIGITS = re.compile(r"(\d+)")


class EpisodeFiles[C: ForeignSourceConfig]:
    """A source whose episodes are files or folders below its own.

    An id is the label and the parts of the path that name the episode, joined by "-". Files that would share one (a-b/c and
    a/b-c both give a-b-c) get a digest of their path behind it.

    Args:
        parts_of: the parts of a path that name the episode; by default all, without the suffix.
    """

    def __init__(
        self,
        config: C,
        root: AnyPath,
        found: Iterable[AnyPath],
        parts_of: Callable[[PurePosixPath], Sequence[str]] = lambda file: file.with_suffix("").parts,
    ) -> None:
        self.config = config
        self.root = root
        names = [relative_name(file, root) for file in found]
        wanted = {file: "-".join([config.label, *map(printable, parts_of(file))]) for file in names}
        self.files = {identity: file for file, identity in unique_names(wanted).items()}

    def episode_ids(self) -> list[str]:
        return sorted(self.files, key=by_number)

    def path(self, episode_id: str) -> AnyPath:
        """File of an episode.

        Raises: RejectedInputError (path_traversal) for a link that leads out of the source's folder.
        """
        return inside(self.root, str(self.files[episode_id]))

    def episode(
        self,
        episode_id: str,
        scene: str,
        *,
        layout: str,
        state: np.ndarray,
        action: np.ndarray | None = None,
        overshoot: int = 0,
        conventions: Mapping[str, Any] | None = None,
        **fields: Any,
    ) -> Episode:
        """An episode of what a recording holds and the configuration declares; see `Episode` for the fields.

        Args:
            scene: where the configuration names none.
            action: None: no commands are recorded, the action repeats the state.
            overshoot: how many gripper readings were clipped.
        """
        notes: dict[str, Any] = {"layout": layout, "gripper_overshoot": overshoot}
        if action is None:
            action, notes["action"] = state, REPEATS_STATE
        for name in ("embodiment", "fps", "outcome"):
            if name not in fields:
                fields[name] = getattr(self.config, name)
        fields = {"instruction": "", **self.config.declared(scene), **fields}
        fields.setdefault("timestamps", np.arange(len(state)) / fields["fps"])
        with np.errstate(over="ignore"):  # what is no float32 becomes infinite, and is refused as such
            state, action = state.astype(np.float32), action.astype(np.float32)
        return Episode(
            episode_id=episode_id, state=state, action=action, conventions=notes | dict(conventions or {}), **fields
        )


def unique_names(wanted: Mapping[PurePosixPath, str]) -> dict[PurePosixPath, str]:
    """A name for each file, no two alike: the wanted one, and where several files want it, with digits of the digest of
    the path's bytes behind it; all 64 where a name was chosen to meet 8."""
    names, digits = dict(wanted), dict.fromkeys(wanted, 0)
    while len(set(names.values())) < len(names):
        count = Counter(names.values())
        for file in [file for file, name in names.items() if count[name] > 1]:
            digits[file] = 64 if digits[file] else 8
            digest = hashlib.sha256(os.fsencode(file)).hexdigest()
            names[file] = f"{wanted[file]}-{digest[: digits[file]]}"
    return names


def timed_video_size(path: AnyPath, fps: float) -> tuple[int, int]:
    """(height, width) of a video.

    Raises: RejectedInputError: wrong_fps, and as `video_size`.
    """
    height, width, rate = video_size(path)
    check_rate(rate, fps, path, tolerance=0.02)
    return height, width


def by_number(episode_id: str) -> list[int | str]:
    """Sorting key: episode2 before episode10."""
    return [int(text) if text.isdigit() else text for text in _DIGITS.split(episode_id)]


def storable(episode_id: str) -> str:
    """The id as text that every table and terminal can hold; one that already is stays as it is.

    Bytes that are no UTF-8 and control characters are written as escapes, and the middle of a very long id is left out.
    """
    text = "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in printable(episode_id))
    half = _MAX_ID_LENGTH // 2 - 2
    return text if len(text) <= _MAX_ID_LENGTH else f"{text[:half]}...{text[-half:]}"


def unique_identity(episode_id: str, source: int, taken: set[str]) -> str:
    """A storable id that is not taken yet: a repeated one gets the number of its source, and of its repetition there."""
    plain = identity = storable(episode_id) or f"unnamed#source.{source}"
    count = 0
    while identity in taken:
        count += 1
        identity = f"{plain}#source.{source}" + (f".{count}" if count > 1 else "")
    return identity


def check_id(episode_id: str, source: str) -> None:
    """Raises: RejectedInputError (invalid_id) for an id that cannot be stored as it is."""
    if storable(episode_id) != episode_id or not episode_id:
        expected = f"1 to {_MAX_ID_LENGTH} printable characters of valid UTF-8"
        raise RejectedInputError(
            "invalid_id", "Episode id cannot be stored", where=source, expected=expected, got=ascii(episode_id[:200])
        )
