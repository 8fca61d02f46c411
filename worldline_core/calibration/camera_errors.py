"""Errors of each camera (rotation, place, focal length, lag), estimated together with their uncertainty.

In a fixed view the arms' projected motion is laid over the measured motion; in a wrist view the flow of the scene that the
camera's own motion predicts, at free depths, is compared with the measured one. Both give normal equations of all
PARAMETERS at once, because several kinds of error look alike in pictures: what nothing tells apart, the bounds show.

Axis legend: n steps, r c rows and columns of cells, m cells in one row, p points on the robot, k parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from worldline_core.calibration.evidence import MIN_CHANGE, MIN_IMAGE_PAIRS, MIN_TEXTURE, observable_views
from worldline_core.calibration.observation import (
    CELL_PX,
    LONGEST_STEP_PX,
    Motion,
    Observation,
    Reading,
    cell_centres,
    cell_means,
    measured_motion,
)
from worldline_core.data.episodes.episode import CameraTrack
from worldline_core.geometry.cameras import project_points
from worldline_core.geometry.transforms import lengths, rigid_inverse

PARAMETERS = 8
"""Rotation and translation of the camera in its own frame [rad, m] (3 + 3), relative focal length (1), frames by which the
pictures trail (1)."""
LAG = PARAMETERS - 1
NUISANCE_PRIOR = np.array([0.3, 0.5, 0.5])
"""Standard deviations of the nuisance parameters: thickness of the links, factors on the predicted flow and change."""
EDGE_CELLS = 0.35
NEAR_M, MIN_STEP_PX, STILL_STEP_PX = 0.03, 0.3, 0.05
NOISE_CHANGE = 2.0
MIN_CELLS = 60
SAMPLE_CELLS_STILL, SAMPLE_CELLS_WRIST = 90.0, 2.5
"""Cells per independent measurement, because neighbours and successive steps are correlated; from healthy recordings."""
DEPTH_START_PER_M, MOST_PER_M, DEPTH_PRIOR = 4.0, 15.0, np.array([4.0, 20.0, 20.0])
"""Inverse depth of the scene before a wrist camera: a plane, its value in the middle and its slopes (priors)."""
FLOW_ERROR_PX, FLOW_ERROR_SHARE, FAINT_EDGE = 0.5, 0.1, 20.0
HAND_MARGIN_CELLS = 2.0
MOST_CELLS_A_STEP = 10.0
"""Cells of one step share its errors (of depth, of a fast motion's flow): more of them say no more."""
LEAST_INFORMATION = 1e-20
"""A parameter that a resting camera cannot show is bounded by its prior alone."""
_STEPS = np.array([0.01] * 3 + [0.0] * 3 + [0.02, 0.25])
"""Differences by which a wrist view's slopes are measured; its camera's place on the hand hardly shows."""
_STEPS_AND_PLACE = _STEPS + np.array([0.0] * 3 + [0.005] * 3 + [0.0, 0.0])
HAND_REACH_M = 0.2
BLURS_FAR, BLURS = (2.5, 2.5, 1.2, 1.2, 0.7, 0.7), (0.7, 0.7)
"""Blur of the maps in cells, one solution after another: from far away, and near."""
FAR = 12.0
"""Square of the first step, in variances, from which the search begins on coarse maps."""
ESTIMATED_AT_HZ = 8.0
"""Faster recordings are thinned: from frame to frame an arm moves less than flow can measure."""
SCALE = np.array([180 / np.pi] * 3 + [1e3] * 3 + [1e2, 1.0])
PRIOR_DEVIATION = np.array([0.35] * 3 + [0.3] * 3 + [0.2, 2.0])
LARGEST_STEP = np.array([0.12] * 3 + [0.15] * 3 + [0.1, 1.0])
SHARED_MESHES, SHARED_CAPSULES, SHARED_HAND, SHARED_WRIST = 0.4, 8.0, 24.0, 0.5
"""Variance that more episodes do not reduce, in variances of one episode: with the robot's surface, with capsules along its
links, with tools alone, and of a wrist view (flow of a close scene). From healthy recordings of other worlds, docs/calibration.md."""
SQUARES_ALONE, SQUARES_TOGETHER = 56.796, 28.048
"""Squared distance from zero of a significant error, of one episode and of a source: chi-square's of eight degrees of freedom
that are as unlikely as 6 and 3.5 standard deviations of one normal variable."""
ALIKE = 25.0
"""Kinds of error whose remaining squares are this near explain the pictures as well."""
FOCAL_KNOWN = 10.0
"""Half interval [%] above which the focal length may be what is wrong, where several kinds are alike."""
LEFT_OVER = 20.0
"""Squares that one kind of error may leave; above, several kinds are off at once."""
OUTLIER_DEVIATIONS = 3.0
"""An episode this many standard deviations from the others has half its weight; at twice that it contradicts them."""
KINDS = {"rotation": (slice(0, 3), "deg"), "translation": (slice(3, 6), "mm"),
         "focal length": (slice(6, 7), "%"), "lag": (slice(7, 8), "frames")}  # fmt: skip
"""Parameters and unit of each kind."""
_PRIOR = np.diag((PRIOR_DEVIATION * SCALE) ** -2.0)


@dataclass(frozen=True, eq=False)
class KindOfError:
    """One kind of a camera's error, whatever the other kinds are: estimate (k,) in `unit` and its covariance (k, k)."""

    kind: str
    unit: str
    estimate: np.ndarray
    covariance: np.ndarray

    def __str__(self) -> str:
        return f"{self.kind} {self.size:.1f} ± {self.half_interval:.1f} {self.unit}"

    @property
    def size(self) -> float:
        return float(np.linalg.norm(self.estimate))

    @property
    def half_interval(self) -> float:
        """Half of the 95 % interval of the size; of a vector, of its end in any direction."""
        deviations = {1: 1.96, 2: 2.45, 3: 2.80}[len(self.estimate)]
        return deviations * float(np.sqrt(np.linalg.eigvalsh(self.covariance)[-1]))

    @property
    def bound(self) -> float:
        """Upper bound (95 %) of an error that can have gone unseen."""
        return self.size + self.half_interval


def kinds_of_error(estimate: np.ndarray, covariance: np.ndarray, shown: np.ndarray | None) -> tuple[KindOfError, ...]:
    """Each kind of an estimate (8,) and its covariance (8, 8) in the units of KINDS, and by `shown` (2, 8) its effect in the picture."""
    parts = [(name, unit, np.eye(PARAMETERS)[part]) for name, (part, unit) in KINDS.items()]
    if shown is not None:
        parts.append(("in the picture", "% of the width", shown))
    return tuple(KindOfError(n, u, A @ estimate, A @ covariance @ A.T) for n, u, A in parts)


@dataclass(frozen=True, eq=False)
class CameraError:
    """The error of one camera, all kinds at once: the change that makes its pictures fit best.

    Attributes:
        solved: (8,) in the units of KINDS, rotation and translation in the camera's own frame: the best with `information`.
        information: (8, 8) of the pictures, summed over `episodes`.
        shared: variance that more episodes do not reduce, in variances of one episode.
        shown: (2, 8) displacement of the robot in the picture by each parameter [% of the width]; None in a wrist view.
        contradicting: number of episodes whose own estimates are beyond their bounds from the common one.
    """

    view: str
    solved: np.ndarray
    information: np.ndarray
    shared: float
    shown: np.ndarray | None = None
    episodes: int = 1
    contradicting: int = 0

    @cached_property
    def posterior(self) -> np.ndarray:
        """(8, 8) information with that of the prior, where the shared variance is part of every measurement's."""
        return self.information / (1 + self.episodes * self.shared) + _PRIOR

    @cached_property
    def estimate(self) -> np.ndarray:
        """(8,) in the units of KINDS: `solved`, drawn to zero where little is known."""
        pull = (self.information + _PRIOR) @ self.solved / (1 + self.episodes * self.shared)
        return np.linalg.solve(self.posterior, pull)

    @cached_property
    def kinds(self) -> tuple[KindOfError, ...]:
        """Each kind whatever the others are; beside them where it moves the robot in the picture, if that is known."""
        return kinds_of_error(self.estimate, np.linalg.inv(self.posterior), self.shown)

    @property
    def squares(self) -> float:
        """Squared distance from no error, in standard deviations."""
        return float(self.estimate @ self.posterior @ self.estimate)

    @property
    def named(self) -> tuple[str, ...]:
        """The kinds of which each alone explains the estimate about as well; all that differ from zero if none does."""
        weight = self.posterior
        pull, left = weight @ self.estimate, {}
        for name, (part, _) in KINDS.items():
            left[name] = self.squares - float(pull[part] @ np.linalg.solve(weight[part, part], pull[part]))
        best = min(left.values())
        if best <= LEFT_OVER:
            alike = [name for name in left if left[name] <= best + ALIKE]
        else:
            alike = [each.kind for each in self.kinds if each.kind in KINDS and each.size > each.half_interval]
        if "translation" in alike:  # a turn does nearly the same to a robot at one distance
            alike.append("rotation")
        # Where a turn and a shift look alike, the focal length that goes with them is known no better.
        focal = self.kinds[list(KINDS).index("focal length")]
        if best <= LEFT_OVER and len(alike) > 1 and focal.half_interval > FOCAL_KNOWN:
            alike.append(focal.kind)
        return tuple(name for name in left if name in alike)

    def __str__(self) -> str:
        named = [str(each) for each in self.kinds if each.kind in self.named]
        seen = [f" ({str(each).removeprefix(f'{each.kind} ')})" for each in self.kinds if each.kind not in KINDS]
        return f"{self.view} {' or '.join(named) or 'in several ways'}{''.join(seen)}"


@dataclass(frozen=True)
class Equations:
    """Normal equations at a guess: information (k, k), gradient (k,), and the log-likelihood there."""

    information: np.ndarray
    gradient: np.ndarray
    likelihood: float


def moved_camera(camera: CameraTrack, theta: np.ndarray) -> CameraTrack:
    """A camera changed by the parameters (k,), all but the lag."""
    change = np.eye(4)
    change[:3, :3] = cv2.Rodrigues(np.asarray(theta[:3], dtype=np.float64))[0]
    change[:3, 3] = theta[3:6]
    K = camera.K.copy()
    K[[0, 1], [0, 1]] *= 1 + theta[6]
    return replace(camera, K=K, T_base_camera=camera.T_base_camera @ change)


class StillView:
    """A fixed view: the measured motion of the arms, compared with the predicted one."""

    def __init__(
        self,
        camera: CameraTrack,
        points: np.ndarray,
        radii: np.ndarray,
        motion: Motion,
        certainty: np.ndarray | None = None,
    ) -> None:
        """points: (n + 1, p, 3), radii: (p,) [m]; motion of the n steps, and how far its flow is trusted (n, r, c), 0 to 1."""
        self.camera, self.points, self.radii = camera, points, radii
        self.certainty = np.ones(motion.change.shape, np.float32) if certainty is None else certainty
        change = np.log1p(np.maximum(motion.change - NOISE_CHANGE, 0.0))
        self.measured = np.concatenate([motion.flow, change[..., None]], axis=-1).astype(np.float32)
        self.steps = np.ones(len(self.measured), dtype=bool)

    def at(self, camera: CameraTrack) -> StillView:
        """The same measured motion, compared with what another camera predicts."""
        other = copy(self)
        other.camera = camera
        return other

    def mirrored(self) -> StillView:
        """The same robot before pictures with left and right exchanged."""
        other = copy(self)
        other.measured = self.measured[:, :, ::-1] * np.array([-1.0, 1.0, 1.0], np.float32)
        other.certainty = self.certainty[:, :, ::-1]
        return other

    @property
    def covered(self) -> np.ndarray:
        """Bool (n, r, c): cells in which the arms are predicted to move, and those beside them."""
        cover = (self._predicted(np.zeros(PARAMETERS))[3] > 0.1).astype(np.uint8)
        return np.stack([cv2.dilate(cells, np.ones((3, 3), np.uint8)) for cells in cover]).astype(bool)

    def without(self, cells: np.ndarray) -> StillView:
        """The same without what moves in some cells (n, r, c)."""
        other = copy(self)
        other.measured = self.measured * ~cells[..., None]
        return other

    def only(self, steps: np.ndarray) -> StillView:
        """The same in some steps (n,) alone: in the others nothing moves, in the pictures and in the prediction."""
        other = self.without(~steps[:, None, None])
        other.steps = steps
        return other

    def equations(self, theta: np.ndarray, blur: float) -> Equations:
        """Normal equations at `theta`, on maps with this blur [cells]."""
        size = PARAMETERS + 1
        value, shift, growth, cover = self._predicted(theta)
        measured, value = _blurred(self.measured, blur), _blurred(value, blur)
        moving = np.abs(measured).max(axis=-1) > 0.3
        active = (cover > 0.1) | moving
        down, across = (np.moveaxis(each, -1, 0).copy() for each in np.gradient(value, axis=(1, 2)))
        information, gradient, likelihood = np.zeros((size + 2, size + 2)), np.zeros(size + 2), 0.0
        for gain_index, channels in ((size, (0, 1)), (size + 1, (2,))):
            trust = np.ones(1, np.float32) if channels == (2,) else np.sqrt(self.certainty)
            predicted, seen = (trust[..., None] * each[..., channels] for each in (value, measured))
            gain = max(float((predicted * seen).sum()) / max(float((predicted**2).sum()), 1e-9), 0.05)
            error, cells = seen - gain * predicted, float((trust**2 * active).sum())
            squares = float((error**2).sum())
            weight = 1.0 / max(squares / max(cells, 1.0), 1e-9)
            left_open = squares / max(float((seen**2).sum()), 1e-9)
            # The sample count must not depend on the camera: one that covers more would seem more likely.
            likelihood -= len(channels) * float((trust**2 * moving).sum()) / 2 * np.log(max(left_open, 1e-9))
            for c, channel in enumerate(channels):
                slope = -gain * (across[channel] * shift[0] + down[channel] * shift[1])
                if channel < 2:
                    slope[:-1] += gain * cover * growth[channel]
                slope = np.ascontiguousarray((trust * slope).reshape(size, -1).T)
                scaled = gain * predicted[..., c].reshape(-1)
                residual = error[..., c].reshape(-1)
                information[:size, :size] += weight * (slope.T @ slope)
                information[:size, gain_index] += weight * (slope.T @ scaled)
                information[gain_index, gain_index] += weight * float(scaled @ scaled)
                gradient[:size] += weight * (slope.T @ residual)
                gradient[gain_index] += weight * float(scaled @ residual)
        information[size:, :size] = information[:size, size:].T
        information, gradient = information / SAMPLE_CELLS_STILL, gradient / SAMPLE_CELLS_STILL
        # The nuisance parameters are eliminated (Schur complement).
        a, b = slice(0, PARAMETERS), slice(PARAMETERS, None)
        known = information[b, b] + np.diag(NUISANCE_PRIOR**-2)
        solved = np.linalg.solve(known, np.c_[information[b, a], gradient[b]])
        return Equations(
            information[a, a] - information[a, b] @ solved[:, :-1],
            gradient[a] - information[a, b] @ solved[:, -1],
            likelihood / SAMPLE_CELLS_STILL + float(gradient[b] @ solved[:, -1]) / 2,
        )

    def agreement(self, lag: float, blur: float) -> np.ndarray:
        """(3,) sums over all cells and steps: predicted times measured flow, predicted squared, measured squared."""
        theta = np.append(np.zeros(LAG), lag)
        maps, trust = (self.measured, self._predicted(theta)[0]), np.sqrt(self.certainty)[..., None]
        seen, value = (trust * _blurred(each, blur)[..., :2] for each in maps)
        return np.array([(value * seen).sum(), (value**2).sum(), (seen**2).sum()], dtype=np.float64)

    def shown(self, theta: np.ndarray) -> np.ndarray:
        """(2, k) mean displacement of the robot in the picture by each parameter [% of the width]; none by the lag."""
        _, _, ahead, slope = projected(self.points, moved_camera(self.camera, theta))
        mean = slope[:, :, ahead].mean(axis=-1) if ahead.any() else np.zeros((2, LAG))
        return 100 / self.camera.width * np.c_[mean, np.zeros(2)]

    def _predicted(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Maps in cells: motion (n, r, c, 3), shift by each of k parameters and the links' thickness
        (2, k + 1, n, r, c) [cells], growth of the step by each parameter (2, k, n, r, c) [px], cover (n, r, c)."""
        camera = moved_camera(self.camera, theta)
        uv, depth, ahead, slope = projected(self.points, camera)
        uv = delayed(uv, float(theta[LAG]))
        step = np.diff(uv, axis=0)
        length = lengths(step)
        alive = ahead[1:] & ahead[:-1] & (length > STILL_STEP_PX) & self.steps[:, None]
        kept = (length * alive).max(axis=0) > MIN_STEP_PX
        count, (rows, columns) = len(step), self.measured.shape[1:3]
        step, length, alive = step[:, kept].astype(np.float32), length[:, kept].astype(np.float32), alive[:, kept]
        start = ((uv[:-1, kept] - (CELL_PX - 1) / 2) / CELL_PX).astype(np.float32)
        reach = (camera.K[0, 0] * self.radii[kept] / depth[:-1, kept] / CELL_PX).astype(np.float32)
        faster = np.gradient(step, axis=0) if len(step) > 1 else 0 * step
        slope = slope[:, :, :, kept]
        # A cell takes from the points near it their step, and how the parameters move the step's start and change the step.
        # Where several points meet, the fastest one counts most.
        weight = (length + 0.1) ** 2
        by_start, by_end, now = slope[:, :, :-1], slope[:, :, 1:], np.moveaxis(step, -1, 0)[:, None]
        later = np.moveaxis(-faster, -1, 0)[:, None]
        parts = [now, (by_start + by_end) / 2 / CELL_PX, -now / CELL_PX, by_end - by_start, later]
        taken = (weight * np.concatenate(parts, axis=1)).reshape(4 * PARAMETERS + 2, *length.shape)
        taken = np.concatenate([taken, weight[None]]).astype(np.float32)
        thickness, way = (weight * reach).astype(np.float32), step / CELL_PX
        square = (way**2).sum(axis=-1, keepdims=True) + 1e-6
        lines = np.concatenate([way, -(start * way).sum(axis=-1, keepdims=True)], axis=-1) / square
        row, column = np.mgrid[:rows, :columns].reshape(2, -1).astype(np.float32)
        cells = np.stack([column, row, np.ones_like(row)])
        found = np.zeros((len(taken), count, len(row)), np.float32)
        thicker, cover = np.zeros((2, count, len(row)), np.float32), np.zeros((count, len(row)), np.float32)
        for i in range(count):
            on = np.flatnonzero(alive[i])
            along = np.clip(lines[i, on] @ cells, 0.0, 1.0)  # the place on a point's step that is nearest to a cell
            x = column - start[i, on, :1] - along * way[i, on, :1]
            y = row - start[i, on, 1:] - along * way[i, on, 1:]
            distance = np.sqrt(x * x + y * y)
            inside = 1.0 / (1.0 + np.exp(np.clip((distance - reach[i, on, None]) / EDGE_CELLS, -20.0, 20.0)))
            cover[i] = 1.0 - np.prod(1.0 - inside, axis=0)
            found[:, i] = taken[:, i, on] @ inside
            inside /= np.maximum(distance, 0.3)
            thicker[:, i] = thickness[i, on] @ (inside * x), thickness[i, on] @ (inside * y)
        total = found[-1] + 1e-9
        thicker /= total
        found = (found[:-1] / total).reshape(2, -1, count, rows, columns)
        cover = cover.reshape(count, rows, columns)
        speed = np.log1p(np.minimum(lengths(np.moveaxis(found[:, 0], 0, -1)), LONGEST_STEP_PX))
        value = cover[..., None] * np.stack([*found[:, 0], speed], axis=-1)
        shift = np.concatenate([found[:, 1 : 1 + PARAMETERS], thicker.reshape(2, 1, count, rows, columns)], axis=1)
        return value, shift, found[:, 1 + PARAMETERS :], cover


def projected(points: np.ndarray, camera: CameraTrack) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Pixels (n, p, 2), depth and visibility (n, p), and the pixels' derivatives by the camera's parameters (2, k - 1, n, p)."""
    pose, K = camera.T_base_camera[0], camera.K
    seen = (points - pose[:3, 3]) @ pose[:3, :3]
    ahead = seen[..., 2] > NEAR_M
    depth = np.where(ahead, seen[..., 2], 1.0)
    x, y = seen[..., 0] / depth, seen[..., 1] / depth
    f, g = K[0, 0], K[1, 1]
    uv = np.stack([f * x + K[0, 2], g * y + K[1, 2]], axis=-1)
    none = np.zeros_like(x)
    u = f * x * y, -f * (1 + x * x), f * y, -f / depth, none, f * x / depth, f * x
    v = g * (1 + y * y), -g * x * y, -g * x, none, -g / depth, g * y / depth, g * y
    return uv, depth, ahead, np.array([u, v])


def delayed(values: np.ndarray, frames: float) -> np.ndarray:
    """A series (n, ...) delayed by this many frames, constant before its start and after its end."""
    if frames == 0.0:
        return values
    when = np.clip(np.arange(len(values)) - frames, 0, len(values) - 1)
    first = np.minimum(when.astype(int), len(values) - 2)
    part = (when - first).reshape(-1, *[1] * (values.ndim - 1))
    return values[first] * (1 - part) + values[first + 1] * part


def _blurred(maps: np.ndarray, cells: float) -> np.ndarray:
    """Maps (n, r, c, 3), blurred within each."""
    return np.stack([cv2.GaussianBlur(image, (0, 0), cells, borderType=cv2.BORDER_CONSTANT) for image in maps])


class WristView:
    """A wrist view: the measured flow of the scene, in cells with an edge and a change.

    Cells near the hand are left out: it hides the scene, and its fingers move by themselves. Flow is known across an edge
    and a guess along it, so errors are weighted by the picture's gradients.
    """

    def __init__(
        self, camera: CameraTrack, gray: np.ndarray, motion: Motion, hand: np.ndarray, radii: np.ndarray
    ) -> None:
        """camera of n + 1 poses, gray (n + 1, h, w), motion of the n steps; hand (n + 1, p, 3), radii (p,) [m]."""
        self.camera, self.differences = camera, _STEPS
        shows = (motion.texture > MIN_TEXTURE) & (motion.change > MIN_CHANGE)
        shows &= ~covered_cells(camera, hand, radii, shows.shape)
        step, row, column = np.nonzero(shows)
        self.step, self.row, self.column = step, row, column
        self.flow = motion.flow[step, row, column].astype(np.float64)
        _, self._first, self._of, count = np.unique(step, return_index=True, return_inverse=True, return_counts=True)
        self.share = np.minimum(1.0, MOST_CELLS_A_STEP / count)[self._of]
        self.uv = cell_centres(camera.height, camera.width)[row, column]
        self._pixels = np.c_[self.uv, np.ones(len(step))]
        across = (self.uv - ((camera.width - 1) / 2, (camera.height - 1) / 2)) / camera.width
        self.plane = np.c_[np.ones(len(step)), across]
        edges = []
        for image in gray[:-1]:
            x, y = (cv2.Sobel(image, cv2.CV_32F, *order, scale=1 / 8) for order in ((1, 0), (0, 1)))
            xx, xy, yy = cell_means(np.stack([x * x, x * y, y * y]))
            edges.append([[xx, xy], [xy, yy]])
        tensor = np.array(edges)[step, :, :, row, column]
        sharp = tensor / (np.trace(tensor, axis1=1, axis2=2) + FAINT_EDGE)[:, None, None]
        error_px = FLOW_ERROR_PX + FLOW_ERROR_SHARE * lengths(self.flow)
        self.certainty = sharp.astype(np.float64) / error_px[:, None, None] ** 2

    def at(self, camera: CameraTrack) -> WristView:
        """The same cells, compared with the flow that another camera predicts; its place on the hand is a parameter, too."""
        other = copy(self)
        other.camera, other.differences = camera, _STEPS_AND_PLACE
        return other

    def without(self, covered: np.ndarray) -> WristView:
        """The same view, in which some cells (r, c) of all steps count nothing."""
        other = copy(self)
        other.share = self.share * ~covered[self.row, self.column]
        return other

    def agreement(self, lag: float) -> np.ndarray:
        """(2,) sums over all cells of the logarithms of errors: with the predicted flow, and with none."""
        if len(self.step) < MIN_CELLS:
            return np.zeros(2)
        seen = self._seen(np.append(np.zeros(LAG), lag))
        left = self._errors(seen, self._depth(seen))[3]
        none = (self.flow * (self.certainty @ self.flow[..., None])[..., 0]).sum(-1)
        return np.array([self.share @ np.log1p(left), self.share @ np.log1p(none)])

    def _depth(self, seen: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        """(m,) inverse depths that explain the flow best, a plane in each step."""
        depth = np.full(len(self.step), DEPTH_START_PER_M)
        for _ in range(2):
            error, by_depth, weight, _ = self._errors(seen, depth)
            fitted = self._per_step(by_depth, weight, error[..., None])[1]
            depth = np.clip(depth + (self.plane * fitted[self._of, :, 0]).sum(-1), 0.0, MOST_PER_M)
        return depth

    def equations(self, theta: np.ndarray, _blur: float) -> Equations:
        """Normal equations at `theta`; flow is not blurred."""
        columns = np.flatnonzero(self.differences)
        information, gradient = np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS)
        if len(self.step) < MIN_CELLS:
            return Equations(information, gradient, 0.0)
        seen = self._seen(theta)
        depth = self._depth(seen)
        error, by_depth, weight, distance = self._errors(seen, depth)
        now, slopes = self._flow(seen, depth), []
        for i in columns:
            changed = theta + self.differences[i] * np.eye(PARAMETERS)[i]
            slopes.append((self._flow(self._seen(changed), depth) - now) / self.differences[i])
        both = np.stack([*slopes, error], axis=-1)
        cross, fitted = self._per_step(by_depth, weight, both)
        found = np.tensordot(both, weight @ both, ((0, 1), (0, 1)))
        found -= np.tensordot(cross, fitted, ((0, 1), (0, 1)))
        found /= SAMPLE_CELLS_WRIST
        information[np.ix_(columns, columns)] = found[:-1, :-1] + LEAST_INFORMATION * np.eye(len(columns))
        gradient[columns] = found[:-1, -1]
        return Equations(information, gradient, -float(self.share @ np.log1p(distance)) / SAMPLE_CELLS_WRIST)

    def _errors(
        self, seen: tuple[np.ndarray, np.ndarray], depth: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Measured less predicted flow (m, 2), its slope by the inverse depth (m, 2), weights (m, 2, 2), squared error (m,)."""
        now = self._flow(seen, depth)
        slope = (self._flow(seen, depth + 0.5) - now) / 0.5
        error = self.flow - now
        distance = (error * (self.certainty @ error[..., None])[..., 0]).sum(-1)
        return error, slope, self.certainty * (self.share / (1 + distance))[:, None, None], distance

    def _per_step(self, by_depth: np.ndarray, weight: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Projections (s, 3, l) of values (m, 2, l) on each step's plane of inverse depths, and the fitted planes."""
        weighted = (weight @ by_depth[..., None])[..., 0]
        square = (weighted * by_depth).sum(-1)[:, None, None] * self.plane[:, :, None] * self.plane[:, None]
        cross = self.plane[:, :, None] * (weighted[..., None] * values).sum(1)[:, None]
        square, cross = (np.add.reduceat(each, self._first, axis=0) for each in (square, cross))
        return cross, np.linalg.solve(square + np.diag(DEPTH_PRIOR**-2), cross)

    def _seen(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Homogeneous pixels (m, 3) of the cells' rays after the step, and their motion by a unit of inverse depth (m, 3)."""
        camera = moved_camera(self.camera, theta)
        turns, places = _steps_between(camera.T_base_camera, float(theta[LAG]))
        turned = camera.K @ turns @ np.linalg.inv(camera.K)
        return np.einsum("mij,mj->mi", turned[self.step], self._pixels), (places @ camera.K.T)[self.step]

    def _flow(self, seen: tuple[np.ndarray, np.ndarray], depth: np.ndarray) -> np.ndarray:
        """(m, 2) flow [px] at the inverse depths (m,) [1/m]."""
        pixels = seen[0] + depth[:, None] * seen[1]
        return pixels[:, :2] / np.maximum(pixels[:, 2:], 0.1) - self.uv


def _steps_between(poses: np.ndarray, frames: float) -> tuple[np.ndarray, np.ndarray]:
    """Rotations (n, 3, 3) and translations (n, 3) [m] between successive poses (n + 1, 4, 4), delayed by a number of frames."""
    relative = rigid_inverse(poses[1:]) @ poses[:-1]
    if frames == 0.0:
        return relative[:, :3, :3], relative[:, :3, 3]
    from scipy.spatial.transform import Rotation  # slow to import

    vectors = Rotation.from_matrix(relative[:, :3, :3]).as_rotvec()  # a loop over OpenCV's took a sixth of a diagnosis
    turns = Rotation.from_rotvec(delayed(vectors, frames)).as_matrix()
    return turns, delayed(relative[:, :3, 3], frames)


def covered_cells(camera: CameraTrack, points: np.ndarray, radii: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Bool (n, r, c): cells hidden by these points (n + 1, p, 3) at either end of a step, with a margin."""
    centres = cell_centres(camera.height, camera.width)[:, :, None]
    hidden = np.zeros((shape[0] + 1, *shape[1:]), dtype=bool)
    for i, pose in enumerate(camera.T_base_camera):
        uv, depth = project_points(points[i], camera.K, pose[None])
        ahead = depth > NEAR_M
        reach = camera.K[0, 0] * radii[ahead] / depth[ahead] + HAND_MARGIN_CELLS * CELL_PX
        hidden[i] = (((centres - uv[ahead]) ** 2).sum(-1) < reach**2).any(-1)
    return hidden[1:] | hidden[:-1]


def estimate_camera_errors(observation: Observation, reading: Reading) -> tuple[CameraError, ...]:
    """The estimated error of every view whose pictures show it, under one reading of the conventions."""
    shared = {"surfaces": SHARED_MESHES, "capsules": SHARED_CAPSULES, "hands": SHARED_HAND}[reading.shape]
    every = max(1, round(observation.episode.fps / ESTIMATED_AT_HZ))
    found: list[CameraError] = []
    for view in observable_views(observation):
        states, images = reading.steps(observation.num_images, view)
        frames = slice(states.start, states.stop + 1, every)
        gray, camera = observation.gray[view][images.start : images.stop + 1 : every], reading.cameras[view]
        if len(gray) <= MIN_IMAGE_PAIRS:
            continue
        motion = observation.motion(view)
        motion = Motion(motion.flow[images], motion.change[images], motion.texture[images])
        motion = motion if every == 1 else measured_motion(gray)
        points = reading.points[frames]
        if view not in observation.wrists:
            found.append(_estimate(view, StillView(camera, points, reading.radii, motion), shared, every))
        elif camera.moving:
            tool = reading.tools[frames, None, observation.wrists[view], :3, 3]
            near = np.median(np.linalg.norm(points - tool, axis=-1), axis=0) < HAND_REACH_M
            camera = replace(camera, T_base_camera=camera.T_base_camera[frames])
            evidence = WristView(camera, gray, motion, points[:, near], reading.radii[near])
            found.append(_estimate(view, evidence, SHARED_WRIST, every))
    return tuple(found)


def _estimate(view: str, evidence: StillView | WristView, shared: float, every: int) -> CameraError:
    """The error of one view whose pictures are `every` frames apart."""
    prior = np.diag(PRIOR_DEVIATION**-2.0)
    theta = np.zeros(PARAMETERS)
    start = evidence.equations(theta, BLURS[-1])
    far = float(np.linalg.solve(start.information + prior, start.gradient) @ start.gradient) > FAR
    for blur in BLURS_FAR if far else BLURS:
        equations = evidence.equations(theta, blur) if far or theta.any() else start
        change = np.linalg.solve(equations.information + prior, equations.gradient - prior @ theta)
        theta = theta + change / max(1.0, float(np.abs(change / LARGEST_STEP).max()))
    last = evidence.equations(theta, BLURS[-1])
    if last.likelihood < start.likelihood:  # the search lost its way: the linear answer at the start is kept
        last, theta = start, np.linalg.solve(start.information + prior, start.gradient)
    scale = np.append(SCALE[:-1], every)
    shown = evidence.shown(theta) / scale if isinstance(evidence, StillView) else None
    return CameraError(view, theta * scale, last.information / np.outer(scale, scale), shared, shown)


def combine(episodes: Sequence[Sequence[CameraError]]) -> tuple[CameraError, ...]:
    """Errors of a source's cameras from those of its episodes; outliers count less, and scatter widens the interval."""
    groups: dict[str, list[CameraError]] = {}
    for error in (error for errors in episodes for error in errors):
        groups.setdefault(error.view, []).append(error)
    found = []
    for view, members in groups.items():
        estimates, weights = np.stack([m.estimate for m in members]), np.stack([m.information for m in members])
        bounds = np.stack([m.posterior for m in members])
        pulls = np.einsum("eij,ej->ei", weights + _PRIOR, np.stack([m.solved for m in members]))
        mean, trust, apart = np.median(estimates, axis=0), np.ones(len(members)), np.zeros(len(members))
        total = weights.sum(axis=0)
        for _ in range(3):
            apart = np.einsum("ei,eij,ej->e", estimates - mean, bounds, estimates - mean) / PARAMETERS
            trust = 1 / (1 + apart / OUTLIER_DEVIATIONS**2)
            total = np.einsum("e,eij->ij", trust, weights)
            mean = np.linalg.solve(total + _PRIOR, trust @ pulls)
        scatter = max(1.0, float((trust * apart).sum() / max(trust.sum() - 1, 1.0)))
        mean = np.linalg.solve(total / scatter + _PRIOR, trust @ pulls / scatter)
        shown = None if members[0].shown is None else np.mean([m.shown for m in members if m.shown is not None], axis=0)
        contradicting = int((apart * PARAMETERS > (2 * OUTLIER_DEVIATIONS) ** 2).sum())
        shared = max(m.shared for m in members)
        found.append(CameraError(view, mean, total / scatter, shared, shown, len(members), contradicting))
    return tuple(found)
