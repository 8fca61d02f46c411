"""All predictions of one episode measured frame by frame, in one pass over its recording.

Videos are read side by side, some frames at a time, so memory depends neither on their length nor on how many there are.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from worldline_core.actions.episode_tracks import ActionTracks
from worldline_core.actions.tool_error import background_of, end_effector_error, moving_part
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.data.episodes.episode_index import EpisodeRow
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.video.frames import VideoFrames, pieces
from worldline_core.errors import DataError
from worldline_core.evaluation.metric_registry import Metric
from worldline_core.evaluation.metrics import (
    Background,
    SceneFrames,
    ToolFinder,
    frame_iou,
    frames_to_unit,
    invented_motion,
    psnr,
    sharpness,
    ssim,
)
from worldline_core.evaluation.recordings import HEAD, stride_of, tool_points
from worldline_core.evaluation.scores import TRUE_METHOD
from worldline_core.evaluation.segmenters.coloured_things import (
    ColouredThing,
    OwnColour,
    named_things,
    own_colour,
    thing_share,
)
from worldline_core.evaluation.segmenters.kinematic_masks import kinematic_masks
from worldline_core.evaluation.segmenters.segmenter import Segmenter
from worldline_core.model.lpips import LPIPS
from worldline_core.rollout.rollout_set import RolloutSet

PIECE_FRAMES = 32
"""Frames of a video in memory at once; no fewer than `own_colour` needs to find the colour of a thing."""
MOVED_IOU = 0.5
"""A thing counts as moved where the IoU of its mask with that of the first frame is below this."""
FrameValues = dict[str, list[float | None]]
"""Values of each frame by metric; None where a frame is left out."""
Key = tuple[str, int, str]
"""Method, seed and view of a prediction."""


@dataclass(frozen=True)
class _Piece:
    """Consecutive frames of the recorded head view with masks and tool positions.

    Attributes:
        first: the video's first frame, and its mask by the first segmenter.
        moved: exact masks of the thing that the task moves (n, h, w), and in which frames it has moved (n,).
        labels: of things (n, h, w), and of the first frame (h, w).
        still: background of a static camera (h, w, 3) float32.
        begin: number of the first of these frames.
    """

    frames: np.ndarray
    points: np.ndarray
    masks: Mapping[str, np.ndarray]
    first: tuple[np.ndarray, np.ndarray]
    exact: np.ndarray | None
    moved: tuple[np.ndarray, np.ndarray] | None
    labels: tuple[np.ndarray, np.ndarray] | None
    background: Background | None
    still: np.ndarray | None
    begin: int


@dataclass(frozen=True)
class _MovingPart:
    """A head view without a camera, in which the part that has moved most stands for the tool."""

    first: np.ndarray
    background: np.ndarray

    @classmethod
    def of(cls, recording: VideoFrames) -> _MovingPart:
        return cls(recording[[0]][0], background_of(len(recording), lambda frames: recording[frames]))

    def errors(self, true: np.ndarray, predicted: np.ndarray) -> list[float | None]:
        points = np.stack([moving_part(self.first, frame, self.background) for frame in true])
        return [finite_mean(row) for row in end_effector_error(true, predicted, points, self.background)]


class _Video:
    """One video while it is measured: segmenters that follow it from piece to piece, and its values so far."""

    def __init__(self, frames: VideoFrames, segmenters: Mapping[str, Segmenter], thing: ColouredThing | None) -> None:
        self.frames, self.pieces = frames, pieces(frames, PIECE_FRAMES)
        self.values: FrameValues = defaultdict(list)
        self.finder = ToolFinder()
        self.places: list[np.ndarray] = []
        self.first: np.ndarray | None = None
        self._streams = {suffix: segmenter.stream() for suffix, segmenter in segmenters.items()}
        self._thing = thing
        self._own: OwnColour | None = None

    def masks(self, frames: np.ndarray, points: np.ndarray) -> dict[str, np.ndarray]:
        """Robot masks of the next frames, by the suffix of a segmenter's metrics."""
        return {suffix: stream(frames, points) for suffix, stream in self._streams.items()}

    def add(self, **values: Sequence[float | None]) -> None:
        """Append values of the next frames, by metric."""
        for name, found in values.items():
            self.values[name] += found

    def add_object(self, frames: np.ndarray, moved: tuple[np.ndarray, np.ndarray] | None) -> None:
        """IoU of the thing that the task moves; frames in which it has not moved, or is hidden, are left out."""
        if self._thing is None or moved is None:
            return
        if "object_iou_exact" not in self.values:
            self._own = own_colour(frames, self._thing.colour)
        masks = thing_share(frames, self._thing.colour, self._own) > 0.5
        self.add(object_iou_exact=_null_if_nan(np.where(moved[1], frame_iou(moved[0], masks), np.nan)))


class EpisodeMeasurement:
    """Measures predictions of one episode.

    Args:
        tracks: None measures full frames and the part that moves, as of an episode without tracks.
        segmenters: by the suffix of their metrics.
        lpips: None where it is not available.
        metrics: metrics on request, by name.
    """

    def __init__(
        self,
        episodes: EpisodeSet,
        tracks: ActionTracks | None,
        row: EpisodeRow,
        views: Sequence[str],
        segmenters: Mapping[str, Segmenter],
        lpips: LPIPS | None,
        metrics: Mapping[str, Metric],
    ) -> None:
        self.tracks = tracks if tracks and row.episode_id in tracks else None
        self.episodes, self.segmenters, self.lpips = episodes, segmenters if self.tracks else {}, lpips
        self.row, self.episode_id = row, row.episode_id
        self.metrics = metrics
        self.finds_tools = any(metric.needs in ("tool_paths", "changed_controls") for metric in metrics.values())
        self.position = episodes.position(row.episode_id)
        self.views = [view for view in views if view in row.views]
        self.thing = next(iter(named_things(row.instruction)), None)

    def measure(self, rollouts: Mapping[str, RolloutSet]) -> dict[str, dict[str, Any]]:
        """Values of every frame, by method, for every view and seed that was predicted. Under the method ``true``: accuracy of the
        segmenters' masks of robot and moved thing on the recording itself: against its exact masks, or the robot's alone against
        kinematic ones.

        Raises: DataError when a prediction has another frame size, another rate or more frames than the recording.
        """
        strides = {method: stride_of(rollout, self.row) for method, rollout in rollouts.items()}
        videos: dict[Key, _Video] = {}
        accuracy: FrameValues | None = None
        for stride in sorted(set(strides.values())):
            group = {method: rollout for method, rollout in rollouts.items() if strides[method] == stride}
            for view in self.views:
                found, own = self._pass(group, view, stride)
                videos |= found
                if view == HEAD and accuracy is None:
                    accuracy = own
        contents: dict[str, dict[str, Any]] = {}
        for method, rollout in rollouts.items():
            measured = [
                {"view": view, "seed": seed, "frames": dict(videos[method, seed, view].values)}
                | self._path_values(videos[method, seed, view].places, strides[method])
                for seed in rollout.seeds(self.episode_id)
                for view in self.views
                if (method, seed, view) in videos
            ]
            frames = max((rollout.clip(self.episode_id, item["view"]).num_frames for item in measured), default=0)
            contents[method] = {"num_frames": frames, "measured": measured}
        longest = max((content["num_frames"] for content in contents.values()), default=0)
        own = {"view": HEAD, "seed": 0, "frames": accuracy or {}}
        return contents | {TRUE_METHOD: {"num_frames": longest, "measured": [own]}}

    def _path_values(self, places: Sequence[np.ndarray], stride: int) -> dict[str, Any]:
        """Values of a whole video, and where its tools were found: (n, arms, 2), hundredths of the frame's height."""
        if not places or self.tracks is None:
            return {}
        scale = 100.0 / self.tracks.tracks(self.episode_id).image_size[0]
        found = scale * np.concatenate(places)
        true = scale * tool_points(self.tracks, self.episode_id, len(found), stride)
        values = {
            name: metric.load()(true, found) for name, metric in self.metrics.items() if metric.needs == "tool_paths"
        }
        return {"video": values, "tools": [[_null_if_nan(place) for place in frame] for frame in found]}

    def _pass(
        self, rollouts: Mapping[str, RolloutSet], view: str, stride: int
    ) -> tuple[dict[Key, _Video], FrameValues]:
        """One view: its measured predictions, and the accuracy of masks of the recording."""
        segmenters = self.segmenters if view == HEAD else {}
        recording = VideoFrames(self.episodes.clip(self.position, view), stride)
        videos: dict[Key, _Video] = {}
        longest = 0
        for method, rollout in rollouts.items():
            if view not in rollout.views(self.episode_id):
                continue
            for seed in rollout.seeds(self.episode_id):
                predicted = VideoFrames(rollout.clip(self.episode_id, view, seed))
                _require_length(
                    len(recording), len(predicted), f"method {method}, episode {self.episode_id}, view {view}"
                )
                longest = max(longest, len(predicted))
                videos[method, seed, view] = _Video(predicted, segmenters, self.thing)
        true = _Video(recording, segmenters, self.thing)
        known = None
        if view == HEAD and videos and self.tracks is not None:
            known = self._recorded_pieces(self.tracks, true, stride, longest)
        moving = _MovingPart.of(recording) if view == HEAD and videos and self.tracks is None else None
        for begin in range(0, longest, PIECE_FRAMES):
            piece = None if known is None else next(known)
            frames = next(true.pieces)[: longest - begin] if piece is None else piece.frames
            for (method, _, _), video in videos.items():
                predicted = next(video.pieces, None)
                if predicted is not None:
                    where = f"method {method}, episode {self.episode_id}, view {view}"
                    self._add_full_frame(video, predicted, frames[: len(predicted)], where)
                    if piece is not None:
                        self._add_robot(video, predicted, piece)
                    elif moving is not None:
                        video.add(end_effector_error_px=moving.errors(frames[: len(predicted)], predicted))
        return videos, dict(true.values)

    def _recorded_pieces(self, tracks: ActionTracks, true: _Video, stride: int, count: int) -> Iterator[_Piece]:
        """The first ``count`` frames of the recorded head view piece by piece; adds the accuracy of masks to ``true``.

        Raises: DataError when fewer exact masks than frames are there.
        """
        exact, labels = (
            None if images is None else images[::stride]
            for images in (
                self.episodes.robot_masks(self.position, HEAD),
                self.episodes.thing_labels(self.position, HEAD),
            )
        )
        for name, images in (("robot masks", exact), ("labels of things", labels)):
            if images is not None:
                _require_length(len(images), count, f"{name} of {self.episode_id}, view {HEAD}")
        points = tool_points(tracks, self.episode_id, count, stride)
        background, still = None, None
        if tracks.tracks(self.episode_id).camera_motion[VIEWS.index(HEAD)] == "static":
            still = background_of(len(true.frames), lambda frames: true.frames[frames])
            background = None if exact is None else Background.of(true.frames, exact, labels)
        exact_pieces, label_pieces = (None if x is None else pieces(x, PIECE_FRAMES) for x in (exact, labels))
        first: tuple[np.ndarray, np.ndarray] | None = None
        first_labels: np.ndarray | None = None
        for begin in range(0, count, PIECE_FRAMES):
            frames = next(true.pieces)[: count - begin]
            own_points, moved, labelled = points[begin : begin + len(frames)], None, None
            if label_pieces is not None:
                own_labels = np.asarray(next(label_pieces)[: len(frames)])
                given = own_labels[0].copy() if first_labels is None else first_labels
                labelled, thing, first_labels = (own_labels, given), own_labels == 1, given
                stays = frame_iou(thing, np.repeat(given[None] == 1, len(thing), axis=0))
                moved = thing, (stays < MOVED_IOU) & thing.any(axis=(1, 2))
            robot = None if exact_pieces is None else next(exact_pieces)[: len(frames)]
            masks = true.masks(frames, own_points)
            if first is None:  # copies: views would keep the whole first piece
                first = frames[0].copy(), masks[""][0].copy()
            true.add_object(frames, moved)
            name, mask = "exact", robot
            if mask is None:
                index = np.arange(begin, begin + len(frames)) * stride
                name, mask = "kinematic", kinematic_masks(tracks.tracks(self.episode_id), HEAD, index, frames)
            if mask is not None:
                accuracy = {f"robot_iou_{name}{suffix}": frame_iou(mask, own) for suffix, own in masks.items()}
                if background is not None and robot is not None:
                    accuracy["robot_iou_difference"] = background.robot_iou(robot, frames)
                    accuracy["robot_iou_difference"][: int(begin == 0)] = np.nan
                true.add(**{name: _null_if_nan(values) for name, values in accuracy.items()})
            yield _Piece(frames, own_points, masks, first, robot, moved, labelled, background, still, begin)

    def _add_full_frame(self, video: _Video, predicted: np.ndarray, true: np.ndarray, where: str) -> None:
        if predicted.shape != true.shape:
            raise DataError(
                "Predicted and recorded frames differ in size", where=where, expected=true.shape, got=predicted.shape,
                next_step="write the predictions at the recording's frame size",
            )  # fmt: skip
        p, t = (frames_to_unit(torch.from_numpy(np.ascontiguousarray(frames))) for frames in (predicted, true))
        video.add(psnr=psnr(p, t).tolist(), ssim=ssim(p, t).tolist(), sharpness=sharpness(true, predicted).tolist())
        if self.lpips is not None:
            video.add(lpips=self.lpips(p, t).tolist())

    def _add_robot(self, video: _Video, predicted: np.ndarray, true: _Piece) -> None:
        """Metrics of predicted head frames, compared with the first as many recorded ones."""
        part = slice(0, len(predicted))
        points = true.points[part]
        errors = end_effector_error(true.frames[part], predicted, points, true.still)
        video.add(end_effector_error_px=[finite_mean(row) for row in errors])
        found = video.masks(predicted, points)
        for suffix, masks in found.items():
            video.add(**{f"robot_iou{suffix}": _null_if_nan(frame_iou(true.masks[suffix][part], masks))})
            if true.exact is not None:
                video.add(**{f"robot_iou_exact{suffix}": _null_if_nan(frame_iou(true.exact[part], masks))})
        first = video.first = predicted[0].copy() if video.first is None else video.first
        self._add_uncovered(video, predicted, found[""], true)
        video.add_object(predicted, None if true.moved is None else (true.moved[0][part], true.moved[1][part]))
        robots = true.masks[""][part]
        if self.finds_tools:
            video.places.append(video.finder.find(robots, found[""], points))
        scene = SceneFrames(true.frames[part], predicted, true.first[0], first, robots | found[""] | true.first[1])
        for name, metric in self.metrics.items():
            if metric.needs == "frames":
                video.add(**{name: metric.load()(scene)})

    def _add_uncovered(self, video: _Video, predicted: np.ndarray, masks: np.ndarray, true: _Piece) -> None:
        """Metrics that need exact masks or labels, without the given first frame."""
        part, given = slice(0, len(predicted)), int(true.begin == 0)
        found: dict[str, np.ndarray] = {}
        if true.background is not None and true.exact is not None:
            found["robot_iou_uncovered"] = true.background.uncovered_iou(true.exact[part], masks)
            found["robot_iou_difference"] = true.background.robot_iou(true.exact[part], predicted)
        if true.labels is not None and video.first is not None:
            labels, first_labels = true.labels
            found["invented_motion"] = invented_motion(labels[part], first_labels, masks, predicted, video.first)
        for name, values in found.items():
            values[:given] = np.nan
            video.add(**{name: _null_if_nan(values)})


def _require_length(recorded: int, predicted: int, where: str) -> None:
    if predicted > recorded:
        raise DataError(
            "A prediction is longer than its recording", where=where, expected=f"<= {recorded}", got=predicted
        )


def finite_mean(values: Sequence[float | None] | np.ndarray) -> float | None:
    """Mean of the finite values; None if there are none."""
    finite = [float(value) for value in values if value is not None and np.isfinite(value)]
    return sum(finite) / len(finite) if finite else None


def _null_if_nan(values: np.ndarray) -> list[float | None]:
    return [None if np.isnan(value) else float(value) for value in values]
