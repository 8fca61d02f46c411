"""Errors of each camera (rotation, place, focal length, principal point, lag), estimated with their uncertainty.

In a fixed view the arms' projected motion is laid over the measured motion; in a wrist view the flow of the scene that the
camera's own motion predicts, at free depths, is compared with the measured one. Both give normal equations of the
PARAMETERS. Each kind of error is estimated as if it were the only one, because several look alike in pictures; the kind
that explains most is named.

Axis legend: n steps, r c rows and columns of cells, m cells in one row, p points on the robot, k parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from worldline_core.calibration.evidence import MIN_CHANGE, MIN_TEXTURE, observable_views
from worldline_core.calibration.observation import CELL_PX, Motion, Observation, Reading, cell_centres, cell_means
from worldline_core.data.episodes.episode import CameraTrack
from worldline_core.geometry.cameras import project_points
from worldline_core.geometry.transforms import lengths, rigid_inverse

PARAMETERS = 10
"""Rotation and translation of the camera in its own frame [rad, m] (3 + 3), relative focal length (1), principal point in
shares of the image's sides (2), frames by which the pictures trail (1)."""
NUISANCE_PRIOR = np.array([0.3, 0.5, 0.5])
"""Standard deviations of the nuisance parameters: thickness of the links, factors on the predicted flow and change."""
EDGE_CELLS = 0.35
NEAR_M, MIN_STEP_PX, STILL_STEP_PX, LONGEST_STEP_PX = 0.03, 0.3, 0.05, 20.0
NOISE_CHANGE = 2.0
MIN_CELLS = 60
SAMPLE_CELLS_STILL, SAMPLE_CELLS_WRIST = 90.0, 2.5
"""Cells per independent measurement, because neighbours and successive steps are correlated; from healthy recordings."""
DEPTH_START_PER_M, MOST_PER_M, DEPTH_PRIOR = 4.0, 15.0, np.array([4.0, 20.0, 20.0])
"""Inverse depth of the scene before a wrist camera: a plane, its value in the middle and its slopes (priors)."""
FLOW_ERROR_PX, FLOW_ERROR_SHARE, FAINT_EDGE = 0.5, 0.1, 20.0
HAND_MARGIN_CELLS = 2.0
LEAST_INFORMATION = 1e-20
"""A parameter that a resting camera cannot show is bounded by its prior alone."""
_STEPS = np.array([0.01] * 3 + [0.0] * 3 + [0.02, 0.02, 0.02, 0.25])
HAND_REACH_M = 0.2
COARSE_CELLS, FINE_CELLS = 1.5, 0.7
"""Blur of the maps, in cells."""
SHAPE_UNKNOWN = 12.0
"""Factor on the uncertainty of the robot's shape without joints: the arm behind the hand is unknown."""
DEVIATIONS_ALONE, DEVIATIONS_TOGETHER = 5.0, 3.0
"""Standard deviations from zero of a significant error, of one episode and of a source."""
SIMILAR_GAIN = 0.5
"""Kinds of error with at least this share of the best gain are indistinguishable."""
OUTLIER_DEVIATIONS = 3.0
"""An episode this many standard deviations from the others has half its weight."""


@dataclass(frozen=True, eq=False)
class CameraError:
    """One kind of error of one camera, estimated as the only one: the change that makes its pictures fit best.

    Attributes:
        kind: one of ERROR_KINDS; rotation and translation in the camera's own frame.
        estimate: (k,) in `unit` (% of the focal length, or of the image's sides).
        information: (k, k) of the estimate.
        gain: log-likelihood of the pictures with it, less that of the recording as written.
        prior, shared: standard deviations before any evidence, and of the error that more episodes do not reduce.
    """

    view: str
    kind: str
    unit: str
    estimate: np.ndarray
    information: np.ndarray
    gain: float
    prior: float
    shared: float

    def __str__(self) -> str:
        return f"{self.view} {self.kind} {self.size:.1f} ± {self.half_interval:.1f} {self.unit}"

    @property
    def posterior(self) -> np.ndarray:
        """(k, k) information with that of the prior."""
        return self.information + np.eye(len(self.estimate)) / self.prior**2

    @property
    def covariance(self) -> np.ndarray:
        return np.linalg.inv(self.posterior) + self.shared**2 * np.eye(len(self.estimate))

    @property
    def size(self) -> float:
        return float(np.linalg.norm(self.estimate))

    @property
    def half_interval(self) -> float:
        """Half of the 95 % interval of the size."""
        along = self.estimate / max(self.size, 1e-12)
        return 1.96 * float(np.sqrt(along @ self.covariance @ along))

    @property
    def bound(self) -> float:
        """Upper bound (95 %) of an error in any direction that can have gone unseen."""
        return self.size + 1.96 * float(np.sqrt(np.linalg.eigvalsh(self.covariance)[-1]))

    @property
    def deviations(self) -> float:
        """Number of standard deviations of a normal variable that is as unlikely as this estimate without an error."""
        distance = self.estimate @ np.linalg.solve(self.covariance, self.estimate)
        from scipy.special import chdtrc, ndtri  # scipy.stats takes a second to import, this a third

        return 0.0 - float(ndtri(max(float(chdtrc(len(self.estimate), distance)), 1e-300) / 2))


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
    K[:2, 2] += theta[7:9] * (camera.width, camera.height)
    return replace(camera, K=K, T_base_camera=camera.T_base_camera @ change)


class StillView:
    """A fixed view: the measured motion of the arms, compared with the predicted one."""

    def __init__(self, camera: CameraTrack, points: np.ndarray, radii: np.ndarray, motion: Motion) -> None:
        """points: (n + 1, p, 3), radii: (p,) [m]; motion of the n steps."""
        self.camera, self.points, self.radii = camera, points, radii
        change = np.log1p(np.maximum(motion.change - NOISE_CHANGE, 0.0))
        self.measured = np.concatenate([motion.flow, change[..., None]], axis=-1).astype(np.float32)
        self._by_blur: dict[float, np.ndarray] = {}
        self._maps: dict[tuple[bytes, int, int], tuple[np.ndarray, ...]] = {}

    def equations(self, theta: np.ndarray, blur: float, wanted: slice = slice(PARAMETERS)) -> Equations:
        """Normal equations of the `wanted` parameters, zero for the others."""
        parameters, size = np.arange(PARAMETERS)[wanted], PARAMETERS + 1
        key = theta.tobytes(), wanted.start, wanted.stop
        if key not in self._maps:  # the start is evaluated with more than one blur
            self._maps[key] = self._predicted(theta, parameters)
        value, shift, growth, cover = self._maps[key]
        if blur not in self._by_blur:
            self._by_blur[blur] = _blurred(self.measured, blur)
        measured, value = self._by_blur[blur], _blurred(value, blur)
        active = (cover > 0.1) | (np.abs(measured).max(axis=-1) > 0.3)
        down, across = np.gradient(value, axis=(1, 2))
        columns = np.append(parameters, PARAMETERS)
        information, gradient, likelihood = np.zeros((size + 2, size + 2)), np.zeros(size + 2), 0.0
        for gain_index, channels in ((size, (0, 1)), (size + 1, (2,))):
            predicted, seen = value[..., channels], measured[..., channels]
            gain = max(float((predicted * seen).sum()) / max(float((predicted**2).sum()), 1e-9), 0.05)
            error = seen - gain * predicted
            weight = 1.0 / max(float((error**2).sum()) / max(int(active.sum()), 1), 1e-9)
            left_open = float((error**2).sum()) / max(float((seen**2).sum()), 1e-9)
            likelihood -= len(channels) * int(active.sum()) / 2 * np.log(max(left_open, 1e-9))
            for c, channel in enumerate(channels):
                slope = -gain * (
                    across[..., channel, None] * shift[..., 0, :] + down[..., channel, None] * shift[..., 1, :]
                )
                if channel < 2:
                    slope[..., :-1] += gain * cover[..., None] * growth[..., channel, :]
                slope = slope.reshape(-1, len(columns))
                scaled = gain * predicted[..., c].reshape(-1)
                residual = error[..., c].reshape(-1)
                information[np.ix_(columns, columns)] += weight * (slope.T @ slope)
                cross = weight * (slope.T @ scaled)
                information[columns, gain_index] += cross
                information[gain_index, columns] += cross
                information[gain_index, gain_index] += weight * float(scaled @ scaled)
                gradient[columns] += weight * (slope.T @ residual)
                gradient[gain_index] += weight * float(scaled @ residual)
        samples = SAMPLE_CELLS_STILL
        return _without_nuisance(Equations(information / samples, gradient / samples, likelihood / samples))

    def _predicted(
        self, theta: np.ndarray, wanted: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Maps in cells: motion (n, r, c, 3), shift by each of k wanted parameters and the links' thickness
        (n, r, c, 2, k + 1) [cells], growth of the step by each parameter (n, r, c, 2, k) [px], cover (n, r, c)."""
        camera = moved_camera(self.camera, theta)
        uv, depth, ahead, slope = _projected(self.points, camera)
        uv = _delayed(uv, float(theta[9]))
        step = np.diff(uv, axis=0)
        length = lengths(step)
        alive = ahead[1:] & ahead[:-1] & (length > STILL_STEP_PX)
        kept = (length * alive).max(axis=0) > MIN_STEP_PX
        count, (rows, columns) = len(step), self.measured.shape[1:3]
        value, cover = np.zeros((count, rows, columns, 3), np.float32), np.zeros((count, rows, columns), np.float32)
        shift = np.zeros((count, rows, columns, 2, len(wanted) + 1), np.float32)
        growth = np.zeros((count, rows, columns, 2, len(wanted)), np.float32)
        if not kept.any():  # nothing of the robot moves before such a camera
            return value, shift, growth, cover
        step, length, alive = step[:, kept].astype(np.float32), length[:, kept].astype(np.float32), alive[:, kept]
        start = ((uv[:-1, kept] - (CELL_PX - 1) / 2) / CELL_PX).astype(np.float32)
        reach = (camera.K[0, 0] * self.radii[kept] / depth[:-1, kept] / CELL_PX).astype(np.float32)
        faster = np.gradient(step, axis=0) if len(step) > 1 else 0 * step
        slope = slope[:, kept]
        moves = np.concatenate([(slope[:-1] + slope[1:]) / 2, -step[..., None]], axis=-1)[..., wanted]
        grows = np.concatenate([np.diff(slope, axis=0), -faster[..., None]], axis=-1)[..., wanted]
        # A cell takes from the points near it their step, and how the parameters move the step's start and change the step.
        # Where several points meet, the fastest one counts most.
        weight = (length + 0.1) ** 2
        taken = np.concatenate([step[..., None], moves / CELL_PX, grows], axis=-1).reshape(*step.shape[:2], -1)
        taken = np.concatenate([taken * weight[..., None], weight[..., None]], axis=-1).astype(np.float32)
        thickness, way = (weight * reach).astype(np.float32), step / CELL_PX
        square = (way**2).sum(axis=-1, keepdims=True) + 1e-6
        lines = np.concatenate([way, -(start * way).sum(axis=-1, keepdims=True)], axis=-1) / square
        row, column = np.mgrid[:rows, :columns].reshape(2, -1).astype(np.float32)
        cells = np.stack([column, row, np.ones_like(row)])
        for i in range(count):
            on = np.flatnonzero(alive[i])
            if not len(on):
                continue
            (across, down), far = way[i, on].T[..., None], start[i, on].T[..., None]
            along = lines[i, on] @ cells  # (p, m): the place on a point's step that is nearest to a cell
            np.clip(along, 0.0, 1.0, out=along)
            x, y = column - far[0], row - far[1]
            x -= along * across
            y -= along * down
            distance = np.sqrt(x * x + y * y)
            inside = (distance - reach[i, on, None]) / EDGE_CELLS
            inside = 1.0 / (1.0 + np.exp(np.clip(inside, -20.0, 20.0, out=inside), out=inside))
            covered = (1.0 - np.prod(1.0 - inside, axis=0)).reshape(rows, columns)
            found = inside.T @ taken[i, on]
            total = found[:, -1:] + 1e-9
            inside /= np.clip(distance, 0.3, None, out=distance)
            thicker = np.stack([thickness[i, on] @ np.multiply(inside, away, out=away) for away in (x, y)], axis=-1)
            shift[i, ..., -1] = (thicker / total).reshape(rows, columns, 2)
            found = (found[:, :-1] / total).reshape(rows, columns, 2, -1)
            motion = found[..., 0]
            cover[i] = covered
            value[i, ..., :2] = covered[..., None] * motion
            value[i, ..., 2] = covered * np.log1p(np.minimum(lengths(motion), LONGEST_STEP_PX))
            shift[i, ..., :-1], growth[i] = found[..., 1 : 1 + len(wanted)], found[..., 1 + len(wanted) :]
        return value, shift, growth, cover


def _projected(points: np.ndarray, camera: CameraTrack) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Pixels (n, p, 2), depth and visibility (n, p), and the pixels' derivatives by the camera's parameters (n, p, 2, k - 1)."""
    pose, K = camera.T_base_camera[0], camera.K
    seen = (points - pose[:3, 3]) @ pose[:3, :3]
    ahead = seen[..., 2] > NEAR_M
    depth = np.where(ahead, seen[..., 2], 1.0)
    x, y = seen[..., 0] / depth, seen[..., 1] / depth
    f, g, none, one = K[0, 0], K[1, 1], np.zeros_like(x), np.ones_like(x)
    uv = np.stack([f * x + K[0, 2], g * y + K[1, 2]], axis=-1)
    u = [f * x * y, -f * (1 + x * x), f * y, -f / depth, none, f * x / depth, f * x, camera.width * one, none]
    v = [g * (1 + y * y), -g * x * y, -g * x, none, -g / depth, g * y / depth, g * y, none, camera.height * one]
    return uv, depth, ahead, np.stack([np.stack(u, axis=-1), np.stack(v, axis=-1)], axis=-2)


def _delayed(values: np.ndarray, frames: float) -> np.ndarray:
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


def _without_nuisance(equations: Equations) -> Equations:
    """Equations of the PARAMETERS alone: the nuisance parameters are eliminated (Schur complement)."""
    a, b = slice(0, PARAMETERS), slice(PARAMETERS, None)
    information, gradient = equations.information, equations.gradient
    known = information[b, b] + np.diag(NUISANCE_PRIOR**-2)
    solved = np.linalg.solve(known, np.c_[information[b, a], gradient[b]])
    return Equations(
        information[a, a] - information[a, b] @ solved[:, :-1],
        gradient[a] - information[a, b] @ solved[:, -1],
        equations.likelihood + float(gradient[b] @ solved[:, -1]) / 2,
    )


class WristView:
    """A wrist view: the measured flow of the scene, in cells with an edge and a change.

    Cells near the hand are left out: it hides the scene, and its fingers move by themselves. Flow is known across an edge
    and a guess along it, so errors are weighted by the picture's gradients.
    """

    def __init__(
        self, camera: CameraTrack, gray: np.ndarray, motion: Motion, hand: np.ndarray, radii: np.ndarray
    ) -> None:
        """camera of n + 1 poses, gray (n + 1, h, w), motion of the n steps; hand (n + 1, p, 3), radii (p,) [m]."""
        self.camera = camera
        self._steps: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}
        shows = (motion.texture > MIN_TEXTURE) & (motion.change > MIN_CHANGE)
        shows &= ~_covered(camera, hand, radii, shows.shape)
        step, row, column = np.nonzero(shows)
        self.step, self.flow = step, motion.flow[step, row, column].astype(np.float64)
        _, self._first, self._of = np.unique(step, return_index=True, return_inverse=True)
        self.uv = cell_centres(camera.height, camera.width)[row, column]
        across = (self.uv - ((camera.width - 1) / 2, (camera.height - 1) / 2)) / camera.width
        self.plane = np.c_[np.ones(len(step)), across]
        value = gray[:-1].astype(np.float32)
        x, y = (np.stack([cv2.Sobel(v, cv2.CV_32F, *order, scale=1 / 8) for v in value]) for order in ((1, 0), (0, 1)))
        tensor = cell_means(np.stack([x * x, x * y, x * y, y * y], axis=-1))[step, row, column].reshape(-1, 2, 2)
        sharp = tensor / (np.trace(tensor, axis1=1, axis2=2) + FAINT_EDGE)[:, None, None]
        error_px = FLOW_ERROR_PX + FLOW_ERROR_SHARE * lengths(self.flow)
        self.certainty = sharp.astype(np.float64) / error_px[:, None, None] ** 2

    def equations(self, theta: np.ndarray, blur: float, wanted: slice = slice(PARAMETERS)) -> Equations:
        """Normal equations of the `wanted` parameters, zero for the others; flow is not blurred."""
        columns = np.arange(PARAMETERS)[wanted]
        information, gradient = np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS)
        if len(self.step) < MIN_CELLS:
            return Equations(information, gradient, 0.0)
        seen = self._seen(theta)
        depth = np.full(len(self.step), DEPTH_START_PER_M)
        for _ in range(2):
            error, by_depth, weight, _ = self._errors(seen, depth)
            fitted = self._per_step(by_depth, weight, error[..., None])[1]
            depth = np.clip(depth + (self.plane * fitted[self._of, :, 0]).sum(-1), 0.0, MOST_PER_M)
        error, by_depth, weight, distance = self._errors(seen, depth)
        columns = columns[_STEPS[columns] > 0]
        both = np.empty((*self.flow.shape, len(columns) + 1))
        both[..., -1] = error
        now = self._flow(seen, depth)
        for column, i in enumerate(columns):
            changed = theta.copy()
            changed[i] += _STEPS[i]
            both[..., column] = (self._flow(self._seen(changed), depth) - now) / _STEPS[i]
        cross, fitted = self._per_step(by_depth, weight, both)
        found = np.tensordot(both, weight @ both, ((0, 1), (0, 1)))
        found -= np.tensordot(cross, fitted, ((0, 1), (0, 1)))
        found /= SAMPLE_CELLS_WRIST
        information[np.ix_(columns, columns)] = found[:-1, :-1] + LEAST_INFORMATION * np.eye(len(columns))
        gradient[columns] = found[:-1, -1]
        return Equations(information, gradient, -float(np.log1p(distance).sum()) / SAMPLE_CELLS_WRIST)

    def _errors(
        self, seen: tuple[np.ndarray, np.ndarray], depth: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Measured less predicted flow (m, 2), its slope by the inverse depth (m, 2), weights (m, 2, 2), squared error (m,)."""
        now = self._flow(seen, depth)
        slope = (self._flow(seen, depth + 0.5) - now) / 0.5
        error = self.flow - now
        distance = (error * (self.certainty @ error[..., None])[..., 0]).sum(-1)
        return error, slope, self.certainty / (1 + distance)[:, None, None], distance

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
        moves = theta[[0, 1, 2, 3, 4, 5, 9]].tobytes()  # the others change K alone
        if moves not in self._steps:
            self._steps[moves] = _steps_between(camera.T_base_camera, float(theta[9]))
        turns, places = self._steps[moves]
        turned = camera.K @ turns @ np.linalg.inv(camera.K)
        pixels = np.c_[self.uv, np.ones(len(self.uv))]
        return np.einsum("mij,mj->mi", turned[self.step], pixels), (places @ camera.K.T)[self.step]

    def _flow(self, seen: tuple[np.ndarray, np.ndarray], depth: np.ndarray) -> np.ndarray:
        """(m, 2) flow [px] at the inverse depths (m,) [1/m]."""
        pixels = seen[0] + depth[:, None] * seen[1]
        return pixels[:, :2] / np.maximum(pixels[:, 2:], 0.1) - self.uv


def _steps_between(poses: np.ndarray, frames: float) -> tuple[np.ndarray, np.ndarray]:
    """Rotations (n, 3, 3) and translations (n, 3) [m] between successive poses (n + 1, 4, 4), delayed by a number of frames."""
    relative = rigid_inverse(poses[1:]) @ poses[:-1]
    if frames == 0.0:
        return relative[:, :3, :3], relative[:, :3, 3]
    vectors = np.stack([cv2.Rodrigues(pose[:3, :3])[0][:, 0] for pose in relative])
    turns = np.stack([cv2.Rodrigues(vector)[0] for vector in _delayed(vectors, frames)])
    return turns, _delayed(relative[:, :3, 3], frames)


def _covered(camera: CameraTrack, points: np.ndarray, radii: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Bool (n, r, c): cells hidden by these points (n + 1, p, 3) at either end of a step, with a margin."""
    rows, columns = (np.arange(count) * CELL_PX + (CELL_PX - 1) / 2 for count in shape[1:])
    hidden = np.zeros((shape[0] + 1, *shape[1:]), dtype=bool)
    for i, pose in enumerate(camera.T_base_camera):
        uv, depth = project_points(points[i], camera.K, pose[None])
        ahead = depth > NEAR_M
        reach = camera.K[0, 0] * radii[ahead] / depth[ahead] + HAND_MARGIN_CELLS * CELL_PX
        down, across = (rows[:, None] - uv[ahead, 1]) ** 2, (columns[:, None] - uv[ahead, 0]) ** 2
        hidden[i] = (down[:, None] + across < reach**2).any(-1)
    return hidden[1:] | hidden[:-1]


@dataclass(frozen=True)
class ErrorKind:
    """One kind of error.

    Attributes:
        unit, scale: unit of all that follows, and its factor from radians, metres or shares.
        prior: standard deviation of each parameter before any evidence.
        usual: typical error of a camera that was bumped or badly calibrated.
        linear, near: beyond `linear` the equations are solved again at the estimate, beyond `near` on coarse maps first.
        shared_still, shared_wrist: standard deviation of the error common to all episodes of a source, because the robot's
            shape is simplified and flow is measured too short.
        off_alone, off_together: smallest size to be reported, of one episode and of all episodes of a source.
    """

    parameters: slice
    unit: str
    scale: float
    prior: float
    usual: float
    linear: float
    near: float
    shared_still: float
    shared_wrist: float
    off_alone: float
    off_together: float

    def solved(self, equations: Equations, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Information (k, k) on these parameters, and the step (k,) to their best values."""
        prior = (self.scale / self.prior) ** 2
        information = equations.information[self.parameters, self.parameters]
        gradient = equations.gradient[self.parameters] - prior * theta[self.parameters]
        return information, np.linalg.solve(information + prior * np.eye(len(gradient)), gradient)


ERROR_KINDS = {
    "rotation": ErrorKind(slice(0, 3), "deg", 180 / np.pi, 15.0, 3.0, 1.2, 1.5, 0.35, 1.5, 3.5, 1.25),
    "translation": ErrorKind(slice(3, 6), "mm", 1e3, 300.0, 30.0, 25.0, 30.0, 10.0, 50.0, 80.0, 25.0),
    "focal length": ErrorKind(slice(6, 7), "%", 1e2, 30.0, 5.0, 0.7, 4.0, 0.5, 4.0, 9.0, 2.2),
    "principal point": ErrorKind(slice(7, 9), "%", 1e2, 20.0, 2.0, 2.0, 2.5, 0.7, 3.0, 7.0, 2.0),
    "lag": ErrorKind(slice(9, 10), "frames", 1.0, 3.0, 1.0, 0.3, 0.3, 0.08, 0.2, 0.6, 0.3),
}


def estimate_camera_errors(observation: Observation, reading: Reading) -> tuple[CameraError, ...]:
    """The estimated error of each kind for every view whose pictures show it, under one reading of the conventions."""
    states, images = reading.steps(observation.num_images)
    frames, pictures = slice(states.start, states.stop + 1), slice(images.start, images.stop + 1)
    found: list[CameraError] = []
    for view in observable_views(observation):
        camera, motion = reading.cameras[view], observation.motion(view)
        motion = Motion(motion.flow[images], motion.change[images], motion.texture[images])
        points = reading.points[frames]
        if view not in observation.wrists:
            shape = 1.0 if reading.whole_arms else SHAPE_UNKNOWN
            found += _estimate(view, StillView(camera, points, reading.radii, motion), shape)
        elif camera.moving:
            tool = reading.tools[frames, None, observation.wrists[view], :3, 3]
            near = np.median(np.linalg.norm(points - tool, axis=-1), axis=0) < HAND_REACH_M
            camera = replace(camera, T_base_camera=camera.T_base_camera[frames])
            hand, radii = points[:, near], reading.radii[near]
            found += _estimate(view, WristView(camera, observation.gray[view][pictures], motion, hand, radii))
    return tuple(found)


def _estimate(view: str, evidence: StillView | WristView, shape: float = 1.0) -> list[CameraError]:
    """The errors of one view; `shape` is a factor on the uncertainty of the robot's shape in a fixed view.

    Where an error is large, the equations are solved again at the corrected camera.
    """
    start = np.zeros(PARAMETERS)
    fine, coarse, found = evidence.equations(start, FINE_CELLS), None, []
    for name, kind in ERROR_KINDS.items():
        information, change = kind.solved(fine, start)
        if not information.any():
            continue
        theta, last = start.copy(), fine
        blurs = (FINE_CELLS, FINE_CELLS)
        if np.linalg.norm(change) * kind.scale > kind.near:
            coarse = coarse or evidence.equations(start, COARSE_CELLS)
            _, change = kind.solved(coarse, start)
            blurs = (COARSE_CELLS, *blurs)
        for blur in blurs:
            size = max(float(np.linalg.norm(change)) * kind.scale, 1e-9)
            if size < kind.linear:
                break
            theta[kind.parameters] += change * min(1.0, 2 * kind.prior / size)
            last = evidence.equations(theta, blur, kind.parameters)
            information, change = kind.solved(last, theta)
        estimate = (theta[kind.parameters] + change) * kind.scale
        shared = kind.shared_wrist if isinstance(evidence, WristView) else kind.shared_still * shape
        gain = last.likelihood - fine.likelihood + float(change @ information @ change) / 2
        information = information / kind.scale**2
        found.append(CameraError(view, name, kind.unit, estimate, information, gain, kind.prior, shared))
    return found


def combine(episodes: Sequence[Sequence[CameraError]]) -> tuple[CameraError, ...]:
    """Errors of a source's cameras from those of its episodes; outliers count less, and scatter widens the interval."""
    groups: dict[tuple[str, str], list[CameraError]] = {}
    for error in (error for errors in episodes for error in errors):
        groups.setdefault((error.view, error.kind), []).append(error)
    found = []
    for members in groups.values():
        estimates, weights = np.stack([m.estimate for m in members]), np.stack([m.posterior for m in members])
        total, mean = weights.sum(axis=0), np.median(estimates, axis=0)
        apart, trust = np.zeros(len(members)), np.ones(len(members))
        for _ in range(3):
            apart = np.einsum("ei,eij,ej->e", estimates - mean, weights, estimates - mean) / len(mean)
            trust = 1 / (1 + apart / OUTLIER_DEVIATIONS**2)
            total = np.einsum("e,eij->ij", trust, weights)
            mean = np.linalg.solve(total, np.einsum("e,eij,ej->i", trust, weights, estimates))
        scatter = max(1.0, float((trust * apart).sum() / max(trust.sum() - 1, 1.0)))
        together = replace(members[0], estimate=mean, information=total / scatter)
        found.append(replace(together, gain=together.deviations**2 / 2))
    return tuple(found)


def significant(errors: Sequence[CameraError], *, together: bool = False) -> tuple[CameraError, ...]:
    """At most one certain and large error for each view: among the kinds that explain its pictures about equally well, the
    smallest against its usual size. `together`: the errors are those of a source, not of one episode."""
    found: dict[str, list[CameraError]] = {}
    deviations = DEVIATIONS_TOGETHER if together else DEVIATIONS_ALONE
    for error in errors:
        kind = ERROR_KINDS[error.kind]
        large = error.size > (kind.off_together if together else kind.off_alone) and error.gain > 0
        if large and error.deviations > deviations:
            found.setdefault(error.view, []).append(error)
    off = []
    for kinds in found.values():
        best = max(error.gain for error in kinds)
        alike = [error for error in kinds if error.gain >= SIMILAR_GAIN * best]
        off.append(min(alike, key=lambda error: error.size / ERROR_KINDS[error.kind].usual))
    return tuple(off)


def corrected_camera(camera: CameraTrack, error: CameraError) -> CameraTrack:
    """The camera without the estimated error."""
    kind, theta = ERROR_KINDS[error.kind], np.zeros(PARAMETERS)
    theta[kind.parameters] = error.estimate / kind.scale
    return moved_camera(camera, theta)
