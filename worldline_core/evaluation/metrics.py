"""Formulas of the metrics of predicted videos, by frame or over a path (docs/evaluation.md). The caller takes means over time, per
trajectory and view.

Full frame: appendix "Full-frame metrics" of the paper. The conditioning frame counts like every other. Robot-mask IoU, head view only:
appendix "Robot-mask IoU".

Background, for recordings with exact masks: the median colour of a pixel in the frames in which the recording shows it free of the
robot. A pixel that differs from it shows the robot, or what a prediction invents. Pixels that the robot always covers, or on which a
thing is at some time, do not count; nor does the first frame, which is given.

On request: HSD, nDTW and DYN follow EWMBench (arXiv 2505.09694): reciprocals of distances, in hundredths of the frame's height, of the arms
that move. Tools cannot be found more precisely than about one hundredth, so a perfect path scores 1 instead of infinity.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from einops import rearrange, reduce
from jaxtyping import Float
from scipy.spatial.distance import cdist, directed_hausdorff
from scipy.stats import wasserstein_distance
from torch import Tensor
from torch.nn import functional

from worldline_core.data.video.frames import Frames, VideoFrames
from worldline_core.errors import DataError
from worldline_core.pictures import evenly_spaced

# Frames are stored in 8 bits. Rounding alone leaves a mean squared error of 1/12 grey level squared, so a smaller
# error cannot be distinguished from none: PSNR ends there (58.9 dB) instead of at infinity, and a mean over time stays finite.
QUANTISATION_MSE = 1.0 / (12.0 * 255.0**2)
MAX_PSNR_DB = -10.0 * math.log10(QUANTISATION_MSE)

SSIM_WINDOW = 11
_SSIM_FRAMES = 8
_WINDOW_SIGMA = 1.5
_K1, _K2 = 0.01, 0.03


def psnr(predicted: Float[Tensor, "n 3 h w"], true: Float[Tensor, "n 3 h w"]) -> Float[Tensor, " n"]:
    """Peak signal-to-noise ratio of each frame [dB]; intensities in [0, 1]; at most MAX_PSNR_DB.

    Raises: DataError when the shapes differ.
    """
    _check(predicted, true)
    squared_error = reduce((predicted - true).square(), "n c h w -> n", "mean")
    return -10.0 * torch.log10(squared_error.clamp(min=QUANTISATION_MSE))


def ssim(predicted: Float[Tensor, "n 3 h w"], true: Float[Tensor, "n 3 h w"]) -> Float[Tensor, " n"]:
    """Structural similarity of each frame (Wang et al. 2004): Gaussian window 11, sigma 1.5, mean over channels.

    Intensities in [0, 1]. Only window positions fully inside the frame count, as in scikit-image.

    Raises: DataError when the shapes differ or a frame is smaller than the window.
    """
    return reduce(ssim_map(predicted, true), "n c h w -> n", "mean")


def ssim_map(predicted: Float[Tensor, "n 3 h w"], true: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 3 y x"]:
    """Structural similarity at each position of the window, y = h - 10, x = w - 10; as :func:`ssim`."""
    _check(predicted, true)
    if min(predicted.shape[-2:]) < SSIM_WINDOW:
        raise DataError(
            "Frame smaller than the SSIM window", expected=f">= {SSIM_WINDOW}", got=str(tuple(predicted.shape))
        )
    offsets = torch.arange(SSIM_WINDOW, dtype=predicted.dtype, device=predicted.device) - SSIM_WINDOW // 2
    gaussian = torch.exp(-offsets.square() / (2 * _WINDOW_SIGMA**2))
    gaussian = gaussian / gaussian.sum()
    # Some frames at a time: their moments stay in a processor's cache, which halves the time.
    pieces = zip(predicted.split(_SSIM_FRAMES), true.split(_SSIM_FRAMES), strict=True)
    return torch.cat([_likeness(p, t, gaussian) for p, t in pieces])


def _likeness(
    predicted: Float[Tensor, "n c h w"], true: Float[Tensor, "n c h w"], gaussian: Float[Tensor, " k"]
) -> Float[Tensor, "n c y x"]:
    channels = predicted.shape[1]
    rows = gaussian.view(1, 1, SSIM_WINDOW, 1).expand(channels, 1, SSIM_WINDOW, 1)
    columns = gaussian.view(1, 1, 1, SSIM_WINDOW).expand(channels, 1, 1, SSIM_WINDOW)
    # Variances are differences of squares: taken around mid-grey they keep their digits in single precision.
    p, t = predicted - 0.5, true - 0.5
    moments = torch.cat([p, t, p.square(), t.square(), p * t], dim=1)
    rows, columns = (kernel.repeat(5, 1, 1, 1) for kernel in (rows, columns))
    smoothed = functional.conv2d(functional.conv2d(moments, rows, groups=5 * channels), columns, groups=5 * channels)
    mean_p, mean_t, square_p, square_t, product = smoothed.chunk(5, dim=1)
    variance_p, variance_t = square_p - mean_p.square(), square_t - mean_t.square()
    covariance = product - mean_p * mean_t
    mean_p, mean_t = mean_p + 0.5, mean_t + 0.5
    c1, c2 = _K1**2, _K2**2
    return ((2 * mean_p * mean_t + c1) * (2 * covariance + c2)) / (
        (mean_p.square() + mean_t.square() + c1) * (variance_p + variance_t + c2)
    )


def frames_to_unit(frames: Tensor) -> Float[Tensor, "n 3 h w"]:
    """uint8 frames (n, h, w, 3) to float32 in [0, 1], channels first."""
    return rearrange(frames.to(torch.float32) / 255.0, "n h w c -> n c h w")


def _check(predicted: Tensor, true: Tensor) -> None:
    if predicted.shape != true.shape or predicted.ndim != 4:
        raise DataError(
            "Predicted and true frames differ in shape",
            expected=f"(n, 3, h, w) = {tuple(true.shape)}",
            got=str(tuple(predicted.shape)),
            next_step="predict at the recording's frame size, one frame for each recorded one",
        )


def frame_iou(true: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    """Intersection over union (n,) float64 of masks bool (n, h, w); NaN where both are empty.

    Raises: DataError for masks of different shape or another type.
    """
    if true.shape != predicted.shape or true.ndim != 3 or true.dtype != bool or predicted.dtype != bool:
        raise DataError(
            "Robot masks do not fit each other",
            expected=f"bool (n, h, w), both {true.shape}",
            got=f"{true.dtype} {true.shape} and {predicted.dtype} {predicted.shape}",
        )
    intersection = np.count_nonzero(true & predicted, axis=(1, 2)).astype(np.float64)
    union = np.count_nonzero(true | predicted, axis=(1, 2)).astype(np.float64)
    return np.divide(intersection, union, out=np.full_like(union, np.nan), where=union > 0)


# The background of the head view, and still things

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
        # In bands: a median takes eight times the memory of its pictures.
        for rows in (slice(begin, begin + 16) for begin in range(0, len(picture), 16)):
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


# On request

OUTLINE_FRACTION = 0.1  # half side of the outline, of the frame's height
STEP_FRACTION = 0.1  # farthest way of a tool from one frame to the next, of the frame's height
RESOLUTION = 1.0  # smallest distance that can be measured, hundredths of the height
LEAST_PATH = 5.0  # diagonal of the box around the path of an arm that moves, hundredths of the height
LEAST_FOUND = 0.2  # share of the true path's frames in which a tool must be found (EWMBench's)
LEAST_MOTION = 0.1  # mean speed and acceleration of a tool that rests, hundredths of the height a frame
MIN_DIFFERENCE = 3.0  # difference of two controls that the videos can show, hundredths of the height
_NEARER = 1e-3  # of equal places the nearer one: a hundredth of a pixel's difference at ten pixels' distance
STILL_LEVELS = 10  # a pixel of the recording within so many grey levels of its first frame has not moved
LEAST_STILL_SHARE = 0.05  # of the frame


class ToolFinder:
    """Finds the tools in one predicted video, whose frames come in pieces.

    The true mask shows the gripper's outline around the projected tool; the place in the predicted mask where this outline differs in
    the fewest pixels is where the tool is found. The search begins at the first frame, which both videos share, and continues from the
    place of the frame before, at most STEP_FRACTION of the height further: later controls play no part. How far this can be trusted is
    measured with exact masks (docs/evaluation.md).
    """

    def __init__(self) -> None:
        self._last: np.ndarray | None = None

    def find(self, true: np.ndarray, predicted: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Places (n, arms, 2) u, v [px] in the next frames; NaN where the true place is unknown or no robot is there.

        Args:
            true, predicted: bool (n, h, w), masks of the same frames.
            points: (n, arms, 2) true places [px], NaN where unknown.
        """
        found = np.full(points.shape, np.nan)
        if self._last is None:
            self._last = np.full(points.shape[1:], np.nan)
        for frame, arm in np.argwhere(np.isfinite(points).all(axis=-1)):
            start = self._last[arm] if np.isfinite(self._last[arm]).all() else points[frame, arm]
            place = _fit(true[frame], predicted[frame], points[frame, arm], start)
            if place is not None:
                found[frame, arm] = self._last[arm] = place
        return found


def _fit(true: np.ndarray, predicted: np.ndarray, point: np.ndarray, start: np.ndarray) -> np.ndarray | None:
    """Place u, v [px] in ``predicted`` near ``start`` where the outline around ``point`` in ``true`` fits best."""
    height = len(true)
    half, step = (max(2, round(fraction * height)) for fraction in (OUTLINE_FRACTION, STEP_FRACTION))
    (u, v), (x, y) = np.rint(point).astype(int), np.rint(start).astype(int)
    outline = _around(true, u, v, half)
    if not outline.any():
        return None
    region = _around(predicted, x, y, half + step)
    differing = cv2.matchTemplate(region, outline, cv2.TM_SQDIFF)
    offsets = np.arange(-step, step + 1)
    differing += _NEARER * (offsets[:, None] ** 2 + offsets[None] ** 2)
    row, column = np.unravel_index(int(np.argmin(differing)), differing.shape)
    # What rounding took from the true place belongs to the found one, too.
    return np.array([x + offsets[column], y + offsets[row]]) + point - np.rint(point)


def _around(mask: np.ndarray, u: int, v: int, half: int) -> np.ndarray:
    """uint8 (2 half + 1, 2 half + 1) of a mask around a pixel; zeros outside of the frame. OpenCV takes 20 times as long for float32."""
    height, width = mask.shape
    cut = np.zeros((2 * half + 1, 2 * half + 1), dtype=np.uint8)
    rows, columns = (slice(max(0, c - half), max(0, min(size, c + half + 1))) for c, size in ((v, height), (u, width)))
    top, left = rows.start - (v - half), columns.start - (u - half)
    part = mask[rows, columns]
    cut[top : top + part.shape[0], left : left + part.shape[1]] = part
    return cut


def hausdorff_score(true: np.ndarray, found: np.ndarray) -> float | None:
    """HSD: 1 / max(h(A, B), h(B, A)), h the directed Hausdorff distance of two paths' points."""

    def distance(a: np.ndarray, b: np.ndarray) -> float:
        return max(directed_hausdorff(a, b)[0], directed_hausdorff(b, a)[0])

    return _over_arms(true, found, distance)


def time_warping_score(true: np.ndarray, found: np.ndarray) -> float | None:
    """nDTW: 1 / (D / n), D the least sum of distances over all monotone alignments, n the steps of the true path."""
    return _over_arms(true, found, lambda a, b: time_warping_distance(a, b) / len(a))


def dynamics_score(true: np.ndarray, found: np.ndarray) -> float | None:
    """DYN: 1 / (1 + (W(v) / mean(v) + W(a) / mean(a)) / 2), W the Wasserstein-1 distance of the true and the found
    distribution of speed v and of acceleration a, the means those of the true path."""

    def distance(a: np.ndarray, b: np.ndarray) -> float:
        total = 0.0
        for order in (1, 2):
            own, other = (np.linalg.norm(np.diff(path, n=order, axis=0), axis=-1) for path in (a, b))
            total += wasserstein_distance(own, other) / max(float(own.mean()), LEAST_MOTION)
        return 1.0 + total / 2

    return _over_arms(true, found, distance, least=3)


def time_warping_distance(first: np.ndarray, second: np.ndarray) -> float:
    """Dynamic time warping (Sakoe and Chiba 1978, steps (1, 0), (0, 1), (1, 1)) of paths (n, 2) and (m, 2)."""
    cost = cdist(first, second)
    total = np.full((len(first) + 1, len(second) + 1), np.inf)
    total[0, 0] = 0.0
    for i, j in np.ndindex(cost.shape):
        total[i + 1, j + 1] = cost[i, j] + min(total[i, j], total[i, j + 1], total[i + 1, j])
    return float(total[-1, -1])


def _over_arms(
    true: np.ndarray, found: np.ndarray, distance: Callable[[np.ndarray, np.ndarray], float], least: int = 1
) -> float | None:
    """Mean over the arms that move of 1 / distance of the true and the found path; None where no arm moves.

    An arm that is hardly found, or in fewer than ``least`` frames, scores 0.
    """
    scores = []
    for arm in range(true.shape[1]):
        known = np.isfinite(true[:, arm]).all(axis=-1)
        path = true[known, arm]
        if len(path) < least or np.linalg.norm(np.ptp(path, axis=0)) < LEAST_PATH:
            continue
        seen = known & np.isfinite(found[:, arm]).all(axis=-1)
        hardly = seen.sum() < max(least, LEAST_FOUND * len(path))
        scores.append(0.0 if hardly else 1.0 / max(distance(path, found[seen, arm]), RESOLUTION))
    return sum(scores) / len(scores) if scores else None


@dataclass(frozen=True)
class ControlledPair:
    """Two predictions of one start by one model, under the true and under changed controls.

    Attributes (all (n, arms, 2), hundredths of the frame's height, NaN where unknown):
        true: where the true controls put the tools.
        found, found_changed: where they are in the two predictions.
        changed: where the changed controls put them; None where that is not known.
    """

    true: np.ndarray
    found: np.ndarray
    found_changed: np.ndarray
    changed: np.ndarray | None


def action_following(pair: ControlledPair) -> float | None:
    """d' / (d + d'), d and d' the mean distances of the tools found under the true and the changed controls from where
    the true controls put them; 0.5 where both are below the resolution."""
    distances = np.linalg.norm(np.stack([pair.found, pair.found_changed]) - pair.true, axis=-1)
    seen = np.isfinite(distances).all(axis=0)
    if not seen.any():
        return None
    own, changed = (max(float(values[seen].mean()), RESOLUTION) for values in distances)
    return changed / (own + changed)


def counterfactual_direction(pair: ControlledPair) -> float | None:
    """Share of frames and arms in which found - found' and true - changed make an angle below 90 degrees.

    Only where the controls put a tool MIN_DIFFERENCE apart; a difference of the videos of zero points nowhere: it
    counts half.
    """
    if pair.changed is None:
        return None
    wanted, shown = pair.true - pair.changed, pair.found - pair.found_changed
    apart = np.isfinite(shown).all(axis=-1) & (np.linalg.norm(np.nan_to_num(wanted), axis=-1) >= MIN_DIFFERENCE)
    if not apart.any():
        return None
    agreement = np.sign((wanted[apart] * shown[apart]).sum(axis=-1))
    return float((agreement.mean() + 1) / 2)


@dataclass(frozen=True)
class SceneFrames:
    """Some frames of a recorded and a predicted head view.

    Attributes:
        true, predicted: uint8 (n, h, w, 3).
        true_first, predicted_first: the videos' first frames (h, w, 3).
        robots: bool (n, h, w), where a robot is in the true or the predicted frame, or was in the first one.
    """

    true: np.ndarray
    predicted: np.ndarray
    true_first: np.ndarray
    predicted_first: np.ndarray
    robots: np.ndarray


def scene_consistency(frames: SceneFrames) -> list[float | None]:
    """SSIM of each predicted frame with the prediction's first one, over the positions of the window in which the
    recording stays as it was in its first frame and no robot is; None where hardly any place is still."""
    change = np.abs(frames.true.astype(np.int16) - frames.true_first).max(axis=-1)
    moving = ((change > STILL_LEVELS) | frames.robots).astype(np.uint8)
    kernel = np.ones((SSIM_WINDOW, SSIM_WINDOW), dtype=np.uint8)
    inner = SSIM_WINDOW // 2
    still = np.stack([cv2.dilate(mask, kernel) == 0 for mask in moving])[:, inner:-inner, inner:-inner]
    now = frames_to_unit(torch.from_numpy(np.ascontiguousarray(frames.predicted)))
    first = frames_to_unit(torch.from_numpy(frames.predicted_first[None].copy())).expand_as(now)
    likeness = reduce(ssim_map(now, first), "n c h w -> n h w", "mean").numpy()
    return [
        float(values[places].mean()) if places.mean() >= LEAST_STILL_SHARE else None
        for values, places in zip(likeness, still, strict=True)
    ]
