"""Instruments for recordings with exact masks that no segmenter's forgiveness reaches: the head view's own background, and still things.

The background of a pixel is its median colour in the frames in which the recording shows it free of the robot. A pixel that differs
from it shows the robot, or what a prediction invents. Pixels that the robot always covers, or on which a thing is at some time, do not
count; nor does the first frame, which is given.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from worldline_core.data.video.frames import Frames, VideoFrames
from worldline_core.evaluation.metrics import frame_iou
from worldline_core.pictures import evenly_spaced

MOST_FRAMES = 64
"""Frames of a recording that its background is taken from."""
DIFFERENCE = 40.0
"""Grey levels of the most different channel, averaged over 3 x 3 pixels, above which colours differ. On the true videos of the shipped recordings
that are not trained on, masks by this difference agree best with the exact ones there (IoU 0.84; a copy of the first frame 0.23)."""


@dataclass(frozen=True)
class Background:
    """The head view of one recording without its robot.

    Attributes:
        picture: float32 (h, w, 3).
        uncovered: bool (h, w), pixels that some frame shows free of the robot; known: those of them where never a thing is.
    """

    picture: np.ndarray
    uncovered: np.ndarray
    known: np.ndarray

    @classmethod
    def of(cls, recording: VideoFrames, robot: Frames, things: Frames | None) -> Background:
        """Take it from frames of a recording, and from exact masks and labels of as many frames."""
        chosen = set(evenly_spaced(len(recording), MOST_FRAMES))
        covered = np.stack([mask for n, mask in enumerate(robot) if n in chosen]).astype(bool)
        frames = recording[sorted(chosen)][: len(covered)]
        uncovered = np.asarray(~covered.all(axis=0))
        picture = np.zeros(frames.shape[1:], np.float32)
        for rows in _bands(len(picture)):  # a median takes eight times the memory of its pictures
            shown = np.where(covered[:, rows, :, None], np.nan, frames[:, rows].astype(np.float32))
            shown[:, ~uncovered[rows]] = 0.0
            picture[rows] = np.nanmedian(shown, axis=0)
        occupied = np.zeros_like(uncovered)
        for labels in () if things is None else things:
            occupied |= labels > 0
        return cls(picture, uncovered, uncovered & ~occupied)

    def robot_iou(self, robot: np.ndarray, frames: np.ndarray) -> np.ndarray:
        """IoU (n,) of exact masks (n, h, w) and what differs from the background in frames (n, h, w, 3); NaN where both are empty."""
        found = np.stack([differs(frame, self.picture) for frame in frames])
        return frame_iou(robot & self.known, found & self.known)

    def uncovered_iou(self, robot: np.ndarray, masks: np.ndarray) -> np.ndarray:
        """The same of a segmenter's masks (n, h, w), on uncovered pixels."""
        return frame_iou(robot & self.uncovered, masks & self.uncovered)


def _bands(height: int) -> Iterator[slice]:
    return (slice(begin, begin + 16) for begin in range(0, height, 16))


def differs(frame: np.ndarray, picture: np.ndarray) -> np.ndarray:
    """Bool (h, w): where two pictures (h, w, 3) have other colours."""
    apart = np.abs(frame.astype(np.float32) - picture).max(axis=-1)
    return cv2.blur(apart, (3, 3)) > DIFFERENCE


def invented_motion(
    labels: np.ndarray, first_labels: np.ndarray, robot: np.ndarray, frames: np.ndarray, first: np.ndarray
) -> np.ndarray:
    """Share (n,) of the pixels of things which stay where they are that a prediction shows changed; NaN where there are none.

    Args:
        labels: (n, h, w) of things in the recording, 1 for the one that the task moves; first_labels: (h, w), those of its first frame.
        robot: bool (n, h, w), in the prediction.
        frames: (n, h, w, 3), predicted, and the prediction's first.
    """
    stays = (first_labels > 1) & (labels == first_labels) & ~robot
    changed = np.stack([differs(frame, first.astype(np.float32)) for frame in frames])
    count = stays.sum(axis=(1, 2)).astype(np.float64)
    return np.divide((stays & changed).sum(axis=(1, 2)), count, out=np.full_like(count, np.nan), where=count > 0)


def sharpness(true: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    """Edges of predicted frames (n, h, w, 3) over those of the recorded ones (mean absolute Laplacian of the grey picture); above 1, the
    reciprocal: noise is no sharpness.
    """
    own, recorded = (
        np.array([np.abs(cv2.Laplacian(cv2.cvtColor(f, cv2.COLOR_RGB2GRAY), cv2.CV_32F)).mean() for f in frames])
        for frames in (predicted, true)
    )
    ratio = (own + _LEAST_EDGES) / (recorded + _LEAST_EDGES)
    return np.minimum(ratio, 1.0 / ratio)


_LEAST_EDGES = 0.1  # grey levels; what compression leaves of a plain surface
