"""One recorded episode: what the robot did, when, where its cameras were, and its task text in one spelling.

Frames of reference: `base` is the robot base of the embodiment; camera frames follow OpenCV (x right, y down, z
forward). Units: metres, radians, seconds, pixels. Gripper opening: 0 closed .. 1 open.
"""

from __future__ import annotations

import json
import re
import unicodedata
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal, get_args

import numpy as np
from pydantic import TypeAdapter

from worldline_core.data.guards.rejection import RejectedInputError, check_columns, check_length
from worldline_core.errors import DataError
from worldline_core.geometry.cameras import ImageTransform

VIEWS = ("head", "left_wrist", "right_wrist")
NO_EMBODIMENT = "none"
"""Embodiment of recordings whose robot has no description: there is no forward kinematics of their joints."""
TaskFamily = Literal["grasp", "lift", "place", "state_change", "unknown"]
Outcome = Literal["success", "failure", "unknown"]
Split = Literal["train", "validation", "test", "ood_test", "bank"]
TRAINING_SPLITS = ("train", "validation")
"""Splits that train or select a model."""
StateKind = Literal["joints", "ee_pose", "none"]
REPEATS_STATE = "repeats the state"
"""Beginning of the note `action` in an episode's conventions where its source records no commands."""
MOUNTED = "calibrated_mounts"
"""Note in an episode's conventions: the wrist views whose mount a calibration file gives, whatever the robot's description says."""


@dataclass(frozen=True)
class CameraTrack:
    """Pinhole camera of one view.

    Attributes:
        K: (3, 3) float64, pixels at width x height.
        T_base_camera: (N, 4, 4) float64 for a moving camera or (1, 4, 4) for a fixed one; maps camera points to base.
    """

    view: str
    K: np.ndarray
    T_base_camera: np.ndarray
    width: int
    height: int

    def __post_init__(self) -> None:
        if self.K.shape != (3, 3):
            raise DataError("Camera matrix has a wrong shape", where=self.view, expected="(3, 3)", got=self.K.shape)
        shape = self.T_base_camera.shape
        if len(shape) != 3 or shape[1:] != (4, 4) or shape[0] < 1:
            raise DataError("Camera poses have a wrong shape", where=self.view, expected="(N or 1, 4, 4)", got=shape)

    @property
    def moving(self) -> bool:
        return self.T_base_camera.shape[0] > 1

    def poses(self, frames: Sequence[int] | np.ndarray) -> np.ndarray:
        """T_base_camera (len, 4, 4) at frame numbers; a fixed camera repeats its pose.

        Raises: DataError for a frame past the end of a moving camera's track.
        """
        index = np.asarray(frames, dtype=np.int64)
        if not self.moving:
            return np.repeat(self.T_base_camera, len(index), axis=0)
        if len(index) and (index.min() < 0 or index.max() >= len(self.T_base_camera)):
            raise DataError(
                "Frame outside of the camera track",
                where=self.view,
                expected=f"0..{len(self.T_base_camera) - 1}",
                got=f"{index.min()}..{index.max()}",
            )
        return self.T_base_camera[index]

    def resized(self, width: int, height: int) -> CameraTrack:
        """The same camera at another image size; K follows the resize.

        Pixel centres are at integer coordinates, so u' = (u + 1/2) s - 1/2.
        """
        return self.transformed(ImageTransform.of((self.height, self.width)).resize((height, width)))

    def transformed(self, transform: ImageTransform) -> CameraTrack:
        """The same camera with its image resized, cropped, padded or letterboxed; K follows."""
        height, width = transform.image_size
        return replace(self, K=transform.intrinsics(self.K), width=width, height=height)

    def cut(self, start: int, stop: int, step: int = 1) -> CameraTrack:
        """The camera over frames start..stop (exclusive), every `step`-th."""
        return replace(self, T_base_camera=self.T_base_camera[start:stop:step]) if self.moving else self


@dataclass(frozen=True)
class Stored:
    """Storage of an array of an episode: its dtype, and its axes (N frames, J state columns, A arms, or a size)."""

    dtype: type[np.floating]
    axes: tuple[str | int, ...]

    def array(self, values: np.ndarray | Sequence[float], sizes: Mapping[str, int]) -> np.ndarray:
        """Numbers in row order as an array of these axes; raises a ValueError where they do not fit."""
        return np.asarray(values, self.dtype).reshape(
            [sizes[axis] if isinstance(axis, str) else axis for axis in self.axes]
        )


ARRAYS = {
    "state": Stored(np.float32, ("N", "J")),
    "action": Stored(np.float32, ("N", "J")),
    "T_base_ee": Stored(np.float64, ("N", "A", 4, 4)),
    "gripper": Stored(np.float64, ("N", "A")),
}
"""Arrays of an `Episode` that are stored, and how."""


@dataclass(frozen=True, kw_only=True)
class EpisodeLabels:
    """Labels of an episode. Under these names they are in the index of a set and in every file that holds an episode."""

    episode_id: str
    source: str
    embodiment: str
    scene: str
    task_family: str
    instruction: str
    outcome: str
    split: str
    fps: float
    bank: str | None = None
    candidate: int | None = None
    primary_view: str = "head"


@dataclass(frozen=True, kw_only=True)
class EpisodeDescription(EpisodeLabels):
    """All that is said about an episode in words.

    Attributes:
        state_names: (J,) names of the state columns.
        conventions: units and frames as the source declares them, and notes such as counted gripper overshoot.
    """

    state_names: tuple[str, ...] | None = None
    state_kind: str = "joints"
    conventions: Mapping[str, str | float | int | bool] = field(default_factory=dict)

    def described(self) -> dict[str, Any]:
        """The fields as JSON values: what MCAP files and episodes that wait for their set hold."""
        names = None if self.state_names is None else list(self.state_names)
        values = {name: getattr(self, name) for name in _DESCRIPTION}
        return values | {"state_names": names, "conventions": dict(self.conventions)}

    @staticmethod
    def arguments(found: Mapping[str, Any]) -> dict[str, Any]:
        """The reverse, for `Episode`; raises a ValueError naming a field that is missing or of another type."""
        description = _ADAPTER.validate_json(json.dumps({name: found[name] for name in _DESCRIPTION}), strict=True)
        return {name: getattr(description, name) for name in _DESCRIPTION}


@dataclass(frozen=True, kw_only=True)
class Episode(EpisodeDescription):
    """The record of one episode: what every file, table and reader of episodes is made from. Images live apart.

    Attributes:
        state, action: (N, J). With state_kind "joints": for each arm in order (left, right; a single arm is right) joint
            positions [rad] then gripper opening. With "ee_pose": xyz [m], quaternion xyzw, gripper. With "none" (plain
            videos, for Stage I alone): no columns, (N, 0).
        action: commanded targets, same layout; the state once more where no commands are recorded (`commanded`).
        timestamps: (N,) float64 seconds from the first frame; a set stores the rate alone.
        cameras: by view; empty when a source publishes no calibration.
        T_base_ee: (N, A, 4, 4) measured tool poses (between the fingertips, +z out of the gripper) where a source
            records them; None where they come from kinematics. Commanded poses always come from kinematics.
        gripper: (N, A) opening, given together with T_base_ee.
        video_frames: number of leading frames with images (None: all N). Some samples publish more states than images.
    """

    state: np.ndarray
    action: np.ndarray
    timestamps: np.ndarray
    cameras: dict[str, CameraTrack] = field(default_factory=dict)
    T_base_ee: np.ndarray | None = None
    gripper: np.ndarray | None = None
    video_frames: int | None = None

    def __post_init__(self) -> None:
        where, shape = f"episode {self.episode_id}", self.state.shape
        frames = len(self.timestamps)
        if not 0.01 <= self.fps <= 10_000:  # as `FrameRate`; NaN too
            raise RejectedInputError(
                "wrong_fps", "Frame rate is not usable", where=where, expected="0.01 to 10,000 fps", got=self.fps
            )
        if len(shape) != 2 or shape[0] != frames or frames == 0:
            raise DataError("State has a wrong shape", where=where, expected=f"({frames} > 0, J)", got=shape)
        check_columns(shape[1], where)
        if self.action.shape != shape:
            raise RejectedInputError(
                "length_mismatch",
                "Action and state differ in shape",
                where=where,
                expected=shape,
                got=self.action.shape,
            )
        if self.state_names is not None and len(self.state_names) != shape[1]:
            raise DataError(
                "State names do not match the state", where=where, expected=shape[1], got=len(self.state_names)
            )
        for view, camera in self.cameras.items():
            if camera.moving:
                found = len(camera.T_base_camera)
                check_length("Camera track", f"{where}, view {view}", states=frames, unit="poses", found=found)
        if self.video_frames is not None and not 0 <= self.video_frames <= frames:
            check_length("Images", where, states=frames, unit="images", found=self.video_frames)
        if self.T_base_ee is not None and (self.T_base_ee.ndim != 4 or len(self.T_base_ee) != frames):
            raise DataError(
                "Tool poses have a wrong shape", where=where, expected=f"({frames}, A, 4, 4)", got=self.T_base_ee.shape
            )
        for name, kind in (
            ("task_family", TaskFamily),
            ("outcome", Outcome),
            ("split", Split),
            ("state_kind", StateKind),
        ):
            value, allowed = getattr(self, name), get_args(kind)
            if value not in allowed:
                raise DataError(f"Unknown {name}", where=where, expected=" | ".join(allowed), got=repr(value))
        if (self.state_kind == "none") != (shape[1] == 0):
            raise DataError(
                "State has no columns" if shape[1] == 0 else "State has columns, but is said to be none",
                where=where,
                expected="state_kind none for an episode without states, and only for one",
                got=f"state_kind {self.state_kind}, state {shape}",
            )

    def __len__(self) -> int:
        return len(self.timestamps)

    @property
    def num_frames(self) -> int:
        return len(self.timestamps)

    @property
    def num_video_frames(self) -> int:
        return self.num_frames if self.video_frames is None else self.video_frames

    @property
    def commanded(self) -> bool:
        """True if commands are recorded; if not, the source says so in the conventions, and the action repeats the state."""
        noted = self.conventions.get("action", "")
        return self.state_kind != "none" and not str(noted).startswith(REPEATS_STATE)

    @property
    def calibrated_mounts(self) -> list[str]:
        """Wrist views whose mount a calibration file gives."""
        return str(self.conventions.get(MOUNTED, "")).split(", ")

    def cut(self, start: int, stop: int, step: int = 1) -> Episode:
        """The episode over frames start..stop (exclusive), every `step`-th; time starts at 0 again."""
        times = self.timestamps[start:stop:step]
        with_images = max(0, min(stop, self.num_video_frames) - start)
        return replace(
            self,
            fps=self.fps / step,
            timestamps=times - times[0],
            cameras={view: camera.cut(start, stop, step) for view, camera in self.cameras.items()},
            video_frames=None if self.video_frames is None else -(-with_images // step),
            **{name: values[start:stop:step] for name, values in self.arrays().items()},
        )

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays of `ARRAYS` that the episode has, by name."""
        found = {name: getattr(self, name) for name in ARRAYS}
        return {name: values for name, values in found.items() if values is not None}


LABELS = tuple(each.name for each in fields(EpisodeLabels))
_DESCRIPTION = tuple(each.name for each in fields(EpisodeDescription))
_ADAPTER = TypeAdapter(EpisodeDescription)


RAW_INSTRUCTION = "raw_instruction"
_INVISIBLE = ("Cf", "Cc")
_OUTCOME_WORDS = re.compile(
    r"\b((un)?success(ful|fully)?|succeed(s|ed|ing)?|fail(s|ed|ing|ure|ures)?)\b", re.IGNORECASE
)
_QUOTES = dict.fromkeys(map(ord, "\u2018\u2019\u201a\u201b\u2032"), "'") | dict.fromkeys(
    map(ord, "\u201c\u201d\u201e\u201f\u2033"), '"'
)
_TRAILING = ".!,;: "
_PAIRS = {'"': '"', "'": "'", "(": ")", "[": "]", "<": ">"}
_PLACEHOLDERS = (
    "n/a", "na", "none", "null", "nan", "unknown", "todo", "tbd", "test", "task", "instruction", "no instruction",
    "no language", "no description", "default", "default task", "dummy", "placeholder", "untitled", "-", "?", "...",
)  # fmt: skip


def normalised_text(text: str) -> str:
    """One spelling: Unicode NFKC, plain quotes, single spaces, no enclosing quotes or brackets, no end punctuation, one case.

    A text of placeholders or of punctuation alone gives "".
    """
    text = unicodedata.normalize("NFKC", text).translate(_QUOTES)
    # Line breaks and tabs are control characters too, and part words.
    text = "".join(" " if c.isspace() else c for c in text if c.isspace() or unicodedata.category(c) not in _INVISIBLE)
    text = re.sub(r" +", " ", text).strip()
    while len(text) > 1 and _PAIRS.get(text[0]) == text[-1] and text[0] not in text[1:-1]:
        text = text[1:-1].strip()
    if text.lower() in _PLACEHOLDERS:
        return ""
    stripped = text.rstrip(_TRAILING)
    if stripped.lower() in _PLACEHOLDERS or not any(c.isalnum() for c in stripped):
        return ""
    return _lowered(stripped)


def _lowered(text: str) -> str:
    """Lower case, but for abbreviations; a text that is all in capitals is shouted, not abbreviated."""
    if text.isupper():
        return text.lower()
    return " ".join(
        word if re.fullmatch(r"[A-Z0-9]{2,4}[.,;:!?]?", word) and any(c.isalpha() for c in word) else word.lower()
        for word in text.split(" ")
    )


def one_annotation(annotations: Sequence[str]) -> str:
    """The annotation of an episode that most annotators gave, as it was written; of equally frequent ones the first. Annotations count as equal when their normalised texts are; "" where none says anything."""
    texts = [(text, raw) for raw in annotations if (text := normalised_text(raw))]
    if not texts:
        return ""
    counts = Counter(text for text, _ in texts)
    return max(texts, key=lambda pair: counts[pair[0]])[1]  # max keeps the first of equals


def with_instruction(episode: Episode) -> Episode:
    """The episode with its instruction normalised; the raw text stays in its conventions where it differs."""
    text = normalised_text(episode.instruction)
    if text == episode.instruction:
        return episode
    conventions = {RAW_INSTRUCTION: episode.instruction} | dict(episode.conventions)
    return replace(episode, instruction=text, conventions=conventions)


def mentions_outcome(instruction: str) -> bool:
    """True if a task text speaks of how the attempt ended: such a text would tell a model what it is to predict."""
    return _OUTCOME_WORDS.search(instruction) is not None
