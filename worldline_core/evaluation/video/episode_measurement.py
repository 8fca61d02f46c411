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
from worldline_core.data.episodes.episode_index import EpisodeRow
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.video.frames import MadeFrames, VideoFrames, pieces
from worldline_core.errors import DataError
from worldline_core.evaluation.metric_registry import Metric
from worldline_core.evaluation.metrics import end_effector_error, frame_iou, frames_to_unit, psnr, ssim
from worldline_core.evaluation.recordings import HEAD, TRUE_METHOD, stride_of, tool_points
from worldline_core.evaluation.segmenters.coloured_things import (
    ColouredThing,
    OwnColour,
    named_things,
    own_colour,
    thing_share,
)
from worldline_core.evaluation.segmenters.segmenter import Segmenter
from worldline_core.evaluation.video.scene_consistency import SceneFrames
from worldline_core.evaluation.video.tool_paths import ToolFinder
from worldline_core.model.lpips import LPIPS
from worldline_core.rollout.rollout_set import RolloutSet

PIECE_FRAMES = 32
"""Frames of a video in memory at once; no fewer than `own_colour` needs to find the colour of a thing."""
MOVED_IOU = 0.5
"""A thing counts as moved where the IoU of its mask with that of the first frame is below this."""
FrameValues = dict[str, list[float | None]]
"""Values of each frame by metric; None where a frame is left out."""


@dataclass(frozen=True)
class _Piece:
    """Consecutive frames of the recorded head view with their masks and tool positions."""

    frames: np.ndarray
    points: np.ndarray
    masks: Mapping[str, np.ndarray]
    first: tuple[np.ndarray, np.ndarray]
    """The video's first frame, and its mask by the first segmenter."""
    exact: np.ndarray | None
    moved: tuple[np.ndarray, np.ndarray] | None
    """Exact masks of the thing that the task moves (n, h, w), and in which frames it has moved (n,)."""


class _Video:
    """One video while it is measured: segmenters that follow it from piece to piece, and its values so far."""

    def __init__(self, pieces: Iterator[np.ndarray], segmenters: Mapping[str, Segmenter], thing: ColouredThing | None):
        self.pieces = pieces
        self.values: dict[str, list[float | None]] = defaultdict(list)
        self._streams = {suffix: segmenter.stream() for suffix, segmenter in segmenters.items()}
        self._thing = thing
        self._own: OwnColour | None = None
        self._begun = False
        self.first = np.zeros(0, dtype=np.uint8)
        self.first_mask = np.zeros(0, dtype=bool)
        self.finder = ToolFinder()
        self.places: list[np.ndarray] = []

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
        if not self._begun:
            self._own, self._begun = own_colour(frames, self._thing.colour), True
        masks = thing_share(frames, self._thing.colour, self._own) > 0.5
        self.add(object_iou_exact=_or_none(np.where(moved[1], frame_iou(moved[0], masks), np.nan)))


class EpisodeMeasurement:
    """Measures predictions of one episode.

    Args:
        segmenters: by the suffix of their metrics.
        lpips: None where it is not available.
        metrics: the metrics on request that are wanted, by name.
    """

    def __init__(
        self,
        episodes: EpisodeSet,
        tracks: ActionTracks,
        row: EpisodeRow,
        views: Sequence[str],
        segmenters: Mapping[str, Segmenter],
        lpips: LPIPS | None,
        metrics: Mapping[str, Metric],
    ) -> None:
        self.episodes, self.tracks, self.segmenters, self.lpips = episodes, tracks, segmenters, lpips
        self.row, self.episode_id = row, row.episode_id
        self.metrics = metrics
        self.finds_tools = any(metric.needs in ("tool_paths", "changed_controls") for metric in metrics.values())
        self.position = episodes.position(row.episode_id)
        self.views = [view for view in views if view in row.views]
        self.thing = next(iter(named_things(row.instruction)), None)

    def measure(self, rollouts: Mapping[str, RolloutSet]) -> dict[str, dict[str, Any]]:
        """Values of every frame, by method, for every view and seed that was predicted. Under the method ``true``: how
        accurate the segmenters' masks of robot and moved thing are on the recording itself, where it has exact masks.

        Raises: DataError when a prediction has another frame size, another rate or more frames than the recording.
        """
        strides = {method: stride_of(rollout, self.row) for method, rollout in rollouts.items()}
        found: dict[tuple[str, int, str], FrameValues] = {}
        tools: dict[tuple[str, int, str], np.ndarray] = {}
        accuracy: FrameValues | None = None
        longest = 0
        for stride in sorted(set(strides.values())):
            group = {method: rollout for method, rollout in rollouts.items() if strides[method] == stride}
            for view in self.views:
                values, own, places = self._pass(group, view, stride)
                found |= values
                tools |= places
                if view == HEAD and accuracy is None:
                    accuracy = own
        contents: dict[str, dict[str, Any]] = {}
        for method, rollout in rollouts.items():
            measured = [
                {"view": view, "seed": seed, "frames": found[method, seed, view]}
                | self._of_paths(tools.get((method, seed, view)), strides[method])
                for seed in rollout.seeds(self.episode_id)
                for view in self.views
                if (method, seed, view) in found
            ]
            frames = max((rollout.clip(self.episode_id, item["view"]).num_frames for item in measured), default=0)
            contents[method] = {"num_frames": frames, "measured": measured}
            longest = max(longest, frames)
        own = {"view": HEAD, "seed": 0, "frames": accuracy or {}}
        return contents | {TRUE_METHOD: {"num_frames": longest, "measured": [own]}}

    def _of_paths(self, found: np.ndarray | None, stride: int) -> dict[str, Any]:
        """Values of a whole video, and where its tools were found: (n, arms, 2), hundredths of the frame's height."""
        if found is None:
            return {}
        points = tool_points(self.tracks, self.episode_id, len(found), stride)
        scale = 100.0 / self.tracks.tracks(self.episode_id).image_size[0]
        true, found = scale * points, scale * found
        values = {
            name: metric.load()(true, found) for name, metric in self.metrics.items() if metric.needs == "tool_paths"
        }
        return {"video": values, "tools": [[[finite_mean([x]) for x in place] for place in frame] for frame in found]}

    def _pass(
        self, rollouts: Mapping[str, RolloutSet], view: str, stride: int
    ) -> tuple[dict[tuple[str, int, str], FrameValues], FrameValues, dict[tuple[str, int, str], np.ndarray]]:
        """For one view: values of its predictions by (method, seed, view), accuracy of masks of the recording, places of tools."""
        segmenters = self.segmenters if view == HEAD else {}
        recording = VideoFrames(self.episodes.clip(self.position, view), stride)
        videos: dict[tuple[str, int, str], _Video] = {}
        longest = 0
        for method, rollout in rollouts.items():
            if view not in rollout.views(self.episode_id):
                continue
            for seed in rollout.seeds(self.episode_id):
                predicted = VideoFrames(rollout.clip(self.episode_id, view, seed))
                if len(predicted) > len(recording):
                    raise DataError(
                        "A prediction is longer than its recording",
                        where=f"method {method}, episode {self.episode_id}, view {view}",
                        expected=f"<= {len(recording)}",
                        got=len(predicted),
                    )
                longest = max(longest, len(predicted))
                videos[method, seed, view] = _Video(pieces(predicted, PIECE_FRAMES), segmenters, self.thing)
        true = _Video(pieces(recording, PIECE_FRAMES), segmenters, self.thing)
        if not videos:
            return {}, {}, {}
        known = self._known(stride, longest) if view == HEAD else None
        for begin in range(0, longest, PIECE_FRAMES):
            frames = next(true.pieces)[: longest - begin]
            piece = None if known is None else known.next(begin, frames, true)
            if piece is not None:
                true.add_object(frames, piece.moved)
                if piece.exact is not None:
                    for suffix, masks in piece.masks.items():
                        true.add(**{f"robot_iou_exact{suffix}": _or_none(frame_iou(piece.exact, masks))})
            for (method, _, _), video in videos.items():
                predicted = next(video.pieces, None)
                if predicted is not None:
                    where = f"method {method}, episode {self.episode_id}, view {view}"
                    self._full_frame(video, predicted, frames[: len(predicted)], where)
                    if piece is not None:
                        self._robot(video, predicted, piece)
        places = {key: np.concatenate(video.places) for key, video in videos.items() if video.places}
        return {key: dict(video.values) for key, video in videos.items()}, dict(true.values), places

    def _full_frame(self, video: _Video, predicted: np.ndarray, true: np.ndarray, where: str) -> None:
        if predicted.shape != true.shape:
            raise DataError(
                "Predicted and recorded frames differ in size",
                where=where,
                expected=true.shape,
                got=predicted.shape,
                next_step="write the predictions at the recording's frame size",
            )
        p, t = (frames_to_unit(torch.from_numpy(np.ascontiguousarray(frames))) for frames in (predicted, true))
        video.add(psnr=psnr(p, t).tolist(), ssim=ssim(p, t).tolist())
        if self.lpips is not None:
            video.add(lpips=self.lpips(p, t).tolist())

    def _robot(self, video: _Video, predicted: np.ndarray, true: _Piece) -> None:
        """Metrics of predicted head frames, compared with the first as many recorded ones."""
        part = slice(0, len(predicted))
        points = true.points[part]
        errors = end_effector_error(true.frames[part], predicted, points)
        video.add(end_effector_error_px=[finite_mean(row) for row in errors])
        found = video.masks(predicted, points)
        for suffix, masks in found.items():
            video.add(**{f"robot_iou{suffix}": _or_none(frame_iou(true.masks[suffix][part], masks))})
            if true.exact is not None:
                video.add(**{f"robot_iou_exact{suffix}": _or_none(frame_iou(true.exact[part], masks))})
        video.add_object(predicted, None if true.moved is None else (true.moved[0][part], true.moved[1][part]))
        robots = true.masks[""][part]
        if self.finds_tools:
            video.places.append(video.finder.find(robots, found[""], points))
        if not video.first.size:
            video.first = predicted[0]
        scene = SceneFrames(
            true.frames[part], predicted, true.first[0], video.first, robots | found[""] | true.first[1]
        )
        for name, metric in self.metrics.items():
            if metric.needs == "frames":
                video.add(**{name: metric.load()(scene)})

    def _known(self, stride: int, count: int) -> _Known:
        """Masks and tool positions of ``count`` frames of the recorded head view, every ``stride``-th of the recording.

        Raises: DataError when fewer exact masks than frames are there.
        """
        exact, labels = (read(self.position, HEAD) for read in (self.episodes.robot_masks, self.episodes.thing_labels))
        for name, images in (("robot masks", exact), ("labels of things", labels)):
            if images is not None and len(images[::stride]) < count:
                raise DataError(
                    "A prediction is longer than its recording",
                    where=f"{name} of {self.episode_id}, view {HEAD}",
                    expected=f"<= {len(images[::stride])}",
                    got=count,
                )
        return _Known(tool_points(self.tracks, self.episode_id, count, stride), exact, labels, stride)


class _Known:
    """The recorded head view, piece by piece: projected tool centres, exact masks of the robot and of the moved thing."""

    def __init__(self, points: np.ndarray, exact: MadeFrames | None, labels: MadeFrames | None, stride: int) -> None:
        self.points = points
        self._exact = None if exact is None else pieces(exact[::stride], PIECE_FRAMES)
        self._labels = None if labels is None else pieces(labels[::stride], PIECE_FRAMES)
        self._thing_at_first = np.zeros(0, dtype=bool)

    def next(self, begin: int, frames: np.ndarray, video: _Video) -> _Piece:
        """The next recorded ``frames``, from frame ``begin`` on, with exact masks, segmenters' masks and tool positions."""
        points, moved = self.points[begin : begin + len(frames)], None
        if self._labels is not None:
            now = next(self._labels)[: len(frames)] == 1
            if begin == 0:
                self._thing_at_first = now[:1]
            stays = frame_iou(now, self._thing_at_first.repeat(len(now), 0))
            moved = now, (stays < MOVED_IOU) & now.any(axis=(1, 2))
        exact = None if self._exact is None else next(self._exact)[: len(frames)]
        masks = video.masks(frames, points)
        if not video.first.size:
            video.first, video.first_mask = frames[0], masks[""][0]
        return _Piece(frames, points, masks, (video.first, video.first_mask), exact, moved)


def finite_mean(values: Sequence[float | None] | np.ndarray) -> float | None:
    """Mean of the finite values; None if there are none."""
    finite = [float(value) for value in values if value is not None and np.isfinite(value)]
    return sum(finite) / len(finite) if finite else None


def _or_none(values: np.ndarray) -> list[float | None]:
    return [None if np.isnan(value) else float(value) for value in values]
