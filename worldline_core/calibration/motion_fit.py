"""How well a camera's calibration predicts the motion in its pictures, as least squares around a guess of its errors.

In a view that stands still the arms' projected motion is laid over the measured motion (optical flow and change of the
picture). In a wrist view the flow of the scene that the camera's own motion predicts, at depths that are left open, is
compared with the measured one. Both give normal equations of the PARAMETERS.

Axis legend: n steps, r c rows and columns of cells, m cells in one row, p points on the robot, k parameters.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from worldline_core.calibration.image_evidence import MIN_CHANGE, MIN_TEXTURE
from worldline_core.calibration.observation import CELL_PX, Motion, cell_centres, cell_means
from worldline_core.data.episodes.episode import CameraTrack
from worldline_core.geometry.cameras import project_points
from worldline_core.geometry.transforms import lengths, rigid_inverse

PARAMETERS = 10
"""Rotation and translation of the camera in its own frame [rad, m] (3 + 3), relative focal length (1), principal point in
shares of the image's sides (2), frames by which the pictures trail (1)."""
NUISANCE_PRIOR = np.array([0.3, 0.5, 0.5])
"""Standard deviations of what is fitted besides: thickness of the links, and factors on the predicted flow and change."""
EDGE_CELLS = 0.35
NEAR_M, MIN_STEP_PX, STILL_STEP_PX, LONGEST_STEP_PX = 0.03, 0.3, 0.05, 20.0
NOISE_CHANGE = 2.0
MIN_CELLS = 60
SAMPLE_CELLS_STILL, SAMPLE_CELLS_WRIST = 90.0, 2.5
"""So many cells count as one independent measurement, because neighbours and successive steps are correlated. Measured on
healthy recordings."""
DEPTH_START_PER_M, MOST_PER_M, DEPTH_PRIOR = 4.0, 15.0, np.array([4.0, 20.0, 20.0])
"""Inverse depth of the scene before a wrist camera: a plane, its value in the middle and its slopes (priors)."""
FLOW_ERROR_PX, FLOW_ERROR_SHARE, FAINT_EDGE = 0.5, 0.1, 20.0
HAND_MARGIN_CELLS = 2.0
LEAST_INFORMATION = 1e-20
"""Information on a parameter that a view cannot show because its camera rests: only the prior bounds it."""
_STEPS = np.array([0.01] * 3 + [0.0] * 3 + [0.02, 0.02, 0.02, 0.25])


@dataclass(frozen=True)
class Equations:
    """Normal equations at a guess: information (k, k) and gradient (k,), and the log-likelihood there."""

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
    """A view that stands still: the measured motion of the arms, which the predicted one is compared with."""

    def __init__(self, camera: CameraTrack, points: np.ndarray, radii: np.ndarray, motion: Motion) -> None:
        """points: (n + 1, p, 3), radii: (p,) [m]; motion of the n steps."""
        self.camera, self.points, self.radii = camera, points, radii
        change = np.log1p(np.maximum(motion.change - NOISE_CHANGE, 0.0))
        self.measured = np.concatenate([motion.flow, change[..., None]], axis=-1).astype(np.float32)
        self._by_blur: dict[float, np.ndarray] = {}
        self._maps: dict[tuple[bytes, int, int], tuple[np.ndarray, ...]] = {}

    def equations(self, theta: np.ndarray, blur: float, wanted: slice = slice(PARAMETERS)) -> Equations:
        """The predicted maps move where the parameters move their points, and change where these change speed.

        Args:
            wanted: parameters whose equations are computed; those of the others are zero.
        """
        parameters, size = np.arange(PARAMETERS)[wanted], PARAMETERS + 1
        key = theta.tobytes(), wanted.start, wanted.stop
        if key not in self._maps:  # the start is looked at with more than one blur
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
        count, (rows, columns) = len(step), self.measured.shape[1:3]
        row, column = np.mgrid[:rows, :columns].reshape(2, -1).astype(np.float32)
        cells = np.stack([column, row, np.ones_like(row)])
        value, cover = np.zeros((count, rows, columns, 3), np.float32), np.zeros((count, rows, columns), np.float32)
        shift = np.zeros((count, rows, columns, 2, len(wanted) + 1), np.float32)
        growth = np.zeros((count, rows, columns, 2, len(wanted)), np.float32)
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
    """Pixels (n, p, 2), depth and whether ahead (n, p), and the pixels' slope by the camera's parameters (n, p, 2, k - 1)."""
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
    """A series (n, ...) as it was so many frames before, at rest before it starts and after it ends."""
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
    """Equations of the PARAMETERS alone, with the nuisance parameters fitted (Schur complement)."""
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
    """A view from a hand: the flow of the scene as measured, in the cells that show an edge and change.

    Cells near the hand itself are left out: it hides the scene, and its fingers move by themselves. Across an edge flow is
    known, along it it is a guess: errors are weighted by the picture's gradients.
    """

    def __init__(
        self, camera: CameraTrack, gray: np.ndarray, motion: Motion, hand: np.ndarray, radii: np.ndarray
    ) -> None:
        """camera of n + 1 poses, gray (n + 1, h, w), motion of the n steps; hand (n + 1, p, 3), radii (p,) [m]."""
        self.camera = camera
        self._steps: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}
        self._found: dict[tuple[bytes, int, int], Equations] = {}
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
        """With one plane of inverse depth for each step, fitted as well.

        Args:
            wanted: parameters whose equations are computed; those of the others are zero.
        """
        del blur
        key = theta.tobytes(), wanted.start, wanted.stop
        if key not in self._found:
            self._found[key] = self._equations(theta, np.arange(PARAMETERS)[wanted])
        return self._found[key]

    def _equations(self, theta: np.ndarray, wanted: np.ndarray) -> Equations:
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
        wanted = wanted[_STEPS[wanted] > 0]
        both = np.empty((*self.flow.shape, len(wanted) + 1))
        both[..., -1] = error
        now = self._flow(seen, depth)
        for column, i in enumerate(wanted):
            changed = theta.copy()
            changed[i] += _STEPS[i]
            both[..., column] = (self._flow(self._seen(changed), depth) - now) / _STEPS[i]
        cross, fitted = self._per_step(by_depth, weight, both)
        found = np.tensordot(both, weight @ both, ((0, 1), (0, 1)))
        found -= np.tensordot(cross, fitted, ((0, 1), (0, 1)))
        found /= SAMPLE_CELLS_WRIST
        information[np.ix_(wanted, wanted)] = found[:-1, :-1] + LEAST_INFORMATION * np.eye(len(wanted))
        gradient[wanted] = found[:-1, -1]
        return Equations(information, gradient, -float(np.log1p(distance).sum()) / SAMPLE_CELLS_WRIST)

    def _errors(
        self, seen: tuple[np.ndarray, np.ndarray], depth: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Measured less predicted flow (m, 2), its slope by the inverse depth (m, 2), weights (m, 2, 2), and the squared
        error in its deviations (m,)."""
        now = self._flow(seen, depth)
        slope = (self._flow(seen, depth + 0.5) - now) / 0.5
        error = self.flow - now
        distance = (error * (self.certainty @ error[..., None])[..., 0]).sum(-1)
        return error, slope, self.certainty / (1 + distance)[:, None, None], distance

    def _per_step(self, by_depth: np.ndarray, weight: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of each step that has cells: projections (s, 3, l) of values (m, 2, l) on the plane of inverse depths, and that
        plane fitted."""
        weighted = (weight @ by_depth[..., None])[..., 0]
        square = self._sums((weighted * by_depth).sum(-1)[:, None, None] * self.plane[:, :, None] * self.plane[:, None])
        cross = self._sums(self.plane[:, :, None] * (weighted[..., None] * values).sum(1)[:, None])
        return cross, np.linalg.solve(square + np.diag(DEPTH_PRIOR**-2), cross)

    def _sums(self, values: np.ndarray) -> np.ndarray:
        """(s, ...) of values (m, ...), whose cells lie step by step."""
        return np.add.reduceat(values, self._first, axis=0)

    def _seen(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where the cells' rays end after the step, as homogeneous pixels (m, 3), and by how much a unit of inverse depth
        moves these (m, 3)."""
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
    """Rotations (n, 3, 3) and translations (n, 3) [m] of a camera from each of its poses (n + 1, 4, 4) to the next, delayed
    by so many frames."""
    relative = rigid_inverse(poses[1:]) @ poses[:-1]
    if frames == 0.0:
        return relative[:, :3, :3], relative[:, :3, 3]
    vectors = np.stack([cv2.Rodrigues(pose[:3, :3])[0][:, 0] for pose in relative])
    turns = np.stack([cv2.Rodrigues(vector)[0] for vector in _delayed(vectors, frames)])
    return turns, _delayed(relative[:, :3, 3], frames)


def _covered(camera: CameraTrack, points: np.ndarray, radii: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Bool (n, r, c): cells that these points (n + 1, p, 3) hide at either end of a step, with a margin."""
    rows, columns = (np.arange(count) * CELL_PX + (CELL_PX - 1) / 2 for count in shape[1:])
    hidden = np.zeros((shape[0] + 1, *shape[1:]), dtype=bool)
    for i, pose in enumerate(camera.T_base_camera):
        uv, depth = project_points(points[i], camera.K, pose[None])
        ahead = depth > NEAR_M
        reach = camera.K[0, 0] * radii[ahead] / depth[ahead] + HAND_MARGIN_CELLS * CELL_PX
        down, across = (rows[:, None] - uv[ahead, 1]) ** 2, (columns[:, None] - uv[ahead, 0]) ** 2
        hidden[i] = (down[:, None] + across < reach**2).any(-1)
    return hidden[1:] | hidden[:-1]
