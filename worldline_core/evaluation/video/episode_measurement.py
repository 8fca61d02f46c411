"""All metrics of one episode's predictions, frame by frame; recorded frames and their masks are made once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from worldline_core.actions.episode_tracks import ActionTracks
from worldline_core.errors import DataError
from worldline_core.evaluation.metrics import end_effector_error, frame_iou, frames_to_unit, psnr, ssim
from worldline_core.evaluation.recordings import Recordings, tool_points
from worldline_core.evaluation.segmenters.segmenter import Segmenter
from worldline_core.model.lpips import LPIPS
from worldline_core.rollout.rollout_set import RolloutSet

HEAD = "head"
FrameValues = dict[str, list[float | None]]


class EpisodeMeasurement:
    """Measures predictions of one episode.

    Args:
        segmenters: by name; the first one's metrics carry no suffix, another's carry ``[name]``.
        lpips: None where it is not available.
    """

    def __init__(
        self,
        recordings: Recordings,
        tracks: ActionTracks,
        episode_id: str,
        views: Sequence[str],
        segmenters: Mapping[str, Segmenter],
        lpips: LPIPS | None,
    ) -> None:
        self.recordings = recordings
        self.tracks = tracks
        self.episode_id = episode_id
        self.views = recordings.views(episode_id, views)
        self.segmenters = segmenters
        self.lpips = lpips
        self._frames: dict[tuple[str, int], np.ndarray] = {}
        self._masks: dict[tuple[str, int], np.ndarray] = {}

    def measure(self, method: str, rollout: RolloutSet) -> dict[str, Any]:
        """Values of every frame, for every view and seed that was predicted.

        Raises: DataError when the prediction has another frame size or more frames than the recording.
        """
        measured: list[dict[str, Any]] = []
        num_frames = 0
        for seed in rollout.seeds(self.episode_id):
            for view in self.views:
                predicted = rollout.frames(self.episode_id, view, seed)
                num_frames = len(predicted)
                true = self._true_frames(view, num_frames)
                if predicted.shape != true.shape:
                    raise DataError(
                        "Predicted and recorded frames differ in size",
                        where=f"method {method}, episode {self.episode_id}, view {view}",
                        expected=true.shape,
                        got=predicted.shape,
                        next_step="write the predictions at the recording's frame size",
                    )
                values = self._full_frame(predicted, true)
                if view == HEAD:
                    values |= self._robot(predicted, true)
                measured.append({"view": view, "seed": seed, "frames": values})
        return {"num_frames": num_frames, "measured": measured}

    def segmenter_accuracy(self, num_frames: int) -> dict[str, Any]:
        """The segmenters' masks of the true frames against the exact ones, where the recording has them."""
        exact = self.recordings.robot_masks(self.episode_id, HEAD, num_frames)
        values: FrameValues = {}
        if exact is not None:
            for name in self.segmenters:
                iou = frame_iou(exact, self._true_masks(name, num_frames))
                values[f"robot_iou_exact{self._suffix(name)}"] = _or_none(iou)
        return {"num_frames": num_frames, "measured": [{"view": HEAD, "seed": 0, "frames": values}]}

    def _full_frame(self, predicted: np.ndarray, true: np.ndarray) -> FrameValues:
        p, t = (frames_to_unit(torch.from_numpy(np.ascontiguousarray(frames))) for frames in (predicted, true))
        values: FrameValues = {"psnr": psnr(p, t).tolist(), "ssim": ssim(p, t).tolist()}
        if self.lpips is not None:
            values["lpips"] = self.lpips(p, t).tolist()
        return values

    def _robot(self, predicted: np.ndarray, true: np.ndarray) -> FrameValues:
        count = len(predicted)
        points = tool_points(self.tracks, self.episode_id, HEAD, count)
        errors = end_effector_error(true, predicted, points)
        values: FrameValues = {"end_effector_error_px": [finite_mean(row) for row in errors]}
        exact = self.recordings.robot_masks(self.episode_id, HEAD, count)
        for name, segmenter in self.segmenters.items():
            masks = segmenter.segment(predicted, points)
            values[f"robot_iou{self._suffix(name)}"] = _or_none(frame_iou(self._true_masks(name, count), masks))
            if exact is not None:
                values[f"robot_iou_exact{self._suffix(name)}"] = _or_none(frame_iou(exact, masks))
        return values

    def _suffix(self, name: str) -> str:
        return "" if name == next(iter(self.segmenters)) else f"[{name}]"

    def _true_frames(self, view: str, count: int) -> np.ndarray:
        if (view, count) not in self._frames:
            self._frames[view, count] = self.recordings.frames(self.episode_id, view, count)
        return self._frames[view, count]

    def _true_masks(self, name: str, count: int) -> np.ndarray:
        if (name, count) not in self._masks:
            points = tool_points(self.tracks, self.episode_id, HEAD, count)
            self._masks[name, count] = self.segmenters[name].segment(self._true_frames(HEAD, count), points)
        return self._masks[name, count]


def finite_mean(values: Sequence[float | None] | np.ndarray) -> float | None:
    """Mean of the values that are there; None without any."""
    finite = [float(value) for value in values if value is not None and np.isfinite(value)]
    return sum(finite) / len(finite) if finite else None


def _or_none(values: np.ndarray) -> list[float | None]:
    return [None if np.isnan(value) else float(value) for value in values]
