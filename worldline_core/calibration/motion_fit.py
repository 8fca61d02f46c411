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
"""Left open beside them: thickness of the links, strength of the flow and of the change that motion makes."""
EDGE_CELLS = 0.35
NEAR_M, MIN_STEP_PX, STILL_STEP_PX, LONGEST_STEP_PX = 0.03, 0.3, 0.05, 20.0
NOISE_CHANGE = 2.0
MIN_CELLS = 60
SAMPLE_CELLS_STILL, SAMPLE_CELLS_WRIST = 90.0, 2.5
"""Cells that say together what one says: neighbours and successive steps are alike. Measured on healthy recordings."""
DEPTH_START_PER_M, MOST_PER_M, DEPTH_PRIOR = 4.0, 15.0, np.array([4.0, 20.0, 20.0])
"""Inverse depth of the scene before a wrist camera: a plane, its value in the middle and its slopes (priors)."""
FLOW_ERROR_PX, FLOW_ERROR_SHARE, FAINT_EDGE = 0.5, 0.1, 20.0
HAND_MARGIN_CELLS = 2.0
_STEPS = np.array([0.01] * 3 + [0.0] * 3 + [0.02, 0.02, 0.02, 0.25])


@dataclass(frozen=True)
class Equations:
    """Normal equations at a guess: information (k, k) and gradient (k,), and the log-likelihood there."""

    information: np.ndarray
    gradient: np.ndarray
    likelihood: float


def moved_camera(camera: CameraTrack, theta: np.ndarray) -> CameraTrack:
    """A camera changed by the parameters (k,); the lag is not the camera's."""
    change = np.eye(4)
    change[:3, :3] = cv2.Rodrigues(np.asarray(theta[:3], dtype=np.float64))[0]
    change[:3, 3] = theta[3:6]
    K = camera.K.copy()
    K[[0, 1], [0, 1]] *= 1 + theta[6]
    K[:2, 2] += theta[7:9] * (camera.width, camera.height)
    return replace(camera, K=K, T_base_camera=camera.T_base_camera @ change)


class StillView:
    """A view that stands still: the motion of the arms as measured, to lay the predicted one over."""

    def __init__(self, camera: CameraTrack, points: np.ndarray, radii: np.ndarray, motion: Motion) -> None:
        """points: (n + 1, p, 3), radii: (p,) [m]; motion of the n steps."""
        self.camera, self.points, self.radii = camera, points, radii
        change = np.log1p(np.maximum(motion.change - NOISE_CHANGE, 0.0))
        self.measured = np.concatenate([motion.flow, change[..., None]], axis=-1).astype(np.float32)
        rows, columns = change.shape[1:]
        self.cells = np.mgrid[:rows, :columns].reshape(2, -1)[::-1].astype(np.float32)

    def equations(self, theta: np.ndarray, blur: float) -> Equations:
        """The predicted maps move where the parameters move their points, and change where these change speed."""
        value, shift, growth, cover = self._predicted(theta)
        measured, value = _blurred(self.measured, blur), _blurred(value, blur)
        active = (cover > 0.1) | (np.abs(measured).max(axis=-1) > 0.3)
        down, across = np.gradient(value, axis=(1, 2))
        size = PARAMETERS + 1
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
                    slope[..., :PARAMETERS] += gain * cover[..., None] * growth[..., channel, :]
                slope = slope.reshape(-1, size)
                scaled = gain * predicted[..., c].reshape(-1)
                residual = error[..., c].reshape(-1)
                information[:size, :size] += weight * (slope.T @ slope)
                cross = weight * (slope.T @ scaled)
                information[:size, gain_index] += cross
                information[gain_index, :size] += cross
                information[gain_index, gain_index] += weight * float(scaled @ scaled)
                gradient[:size] += weight * (slope.T @ residual)
                gradient[gain_index] += weight * float(scaled @ residual)
        samples = SAMPLE_CELLS_STILL
        return _without_nuisance(Equations(information / samples, gradient / samples, likelihood / samples))

    def _predicted(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Maps in cells: motion (n, r, c, 3), shift by each parameter and the links' thickness (n, r, c, 2, k + 1) [cells],
        growth of the step by each parameter (n, r, c, 2, k) [px], cover (n, r, c)."""
        camera = moved_camera(self.camera, theta)
        uv, depth, ahead, slope = _projected(self.points, camera)
        uv = _delayed(uv, float(theta[9]))
        step = np.diff(uv, axis=0)
        length = lengths(step)
        alive = ahead[1:] & ahead[:-1] & (length > STILL_STEP_PX)
        kept = (length * alive).max(axis=0) > MIN_STEP_PX
        step, length, alive = step[:, kept].astype(np.float32), length[:, kept], alive[:, kept]
        start = ((uv[:-1, kept] - (CELL_PX - 1) / 2) / CELL_PX).astype(np.float32)
        reach = (camera.K[0, 0] * self.radii[kept] / depth[:-1, kept] / CELL_PX).astype(np.float32)
        late = np.stack([step, np.gradient(step, axis=0) if len(step) > 1 else 0 * step])
        moves = np.concatenate([(slope[:-1, kept] + slope[1:, kept]) / 2, -late[0][..., None]], axis=-1)
        grows = np.concatenate([np.diff(slope[:, kept], axis=0), -late[1][..., None]], axis=-1)
        pushes = np.concatenate([moves / CELL_PX, grows], axis=-1).astype(np.float32)
        count, cells = len(step), self.cells.shape[1]
        value, cover = np.zeros((count, cells, 3), np.float32), np.zeros((count, cells), np.float32)
        shift = np.zeros((count, cells, 2, PARAMETERS + 1), np.float32)
        growth = np.zeros((count, cells, 2, PARAMETERS), np.float32)
        for i in range(count):
            on = np.flatnonzero(alive[i])
            if not len(on):
                continue
            way, far, wide = (step[i, on] / CELL_PX).T[..., None], start[i, on].T[..., None], reach[i, on, None]
            x, y = self.cells[0] - far[0], self.cells[1] - far[1]  # (p, m)
            along = np.clip((x * way[0] + y * way[1]) / (way[0] ** 2 + way[1] ** 2 + 1e-6), 0.0, 1.0)
            x -= along * way[0]
            y -= along * way[1]
            distance = np.sqrt(x * x + y * y)
            inside = 1.0 / (1.0 + np.exp(np.clip((distance - wide) / EDGE_CELLS, -20.0, 20.0)))
            share = inside * (length[i, on, None].astype(np.float32) + 0.1) ** 2  # the fastest is what is seen
            share /= share.sum(axis=0) + 1e-9
            cover[i] = 1.0 - np.prod(1.0 - inside, axis=0)
            motion = share.T @ step[i, on]
            value[i, :, :2] = cover[i, :, None] * motion
            value[i, :, 2] = cover[i] * np.log1p(np.minimum(lengths(motion), LONGEST_STEP_PX))
            pushed = (share.T @ pushes[i, on].reshape(len(on), -1)).reshape(cells, 2, 2 * PARAMETERS)
            shift[i, ..., :PARAMETERS], growth[i] = pushed[..., :PARAMETERS], pushed[..., PARAMETERS:]
            share *= wide / np.maximum(distance, 0.3)
            shift[i, :, 0, PARAMETERS], shift[i, :, 1, PARAMETERS] = (share * x).sum(axis=0), (share * y).sum(axis=0)
        shape = (count, *self.measured.shape[1:3])
        return (
            value.reshape(*shape, 3),
            shift.reshape(*shape, 2, -1),
            growth.reshape(*shape, 2, -1),
            cover.reshape(shape),
        )


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
    """What is left when the parameters after the first ones are fitted as well."""
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
        self._found: dict[bytes, Equations] = {}
        shows = (motion.texture > MIN_TEXTURE) & (motion.change > MIN_CHANGE)
        shows &= ~_covered(camera, hand, radii, shows.shape)
        step, row, column = np.nonzero(shows)
        self.step, self.flow = step, motion.flow[step, row, column].astype(np.float64)
        self.uv = cell_centres(camera.height, camera.width)[row, column]
        across = (self.uv - ((camera.width - 1) / 2, (camera.height - 1) / 2)) / camera.width
        self.plane = np.c_[np.ones(len(step)), across]
        value = gray[:-1].astype(np.float32)
        x, y = (np.stack([cv2.Sobel(v, cv2.CV_32F, *order, scale=1 / 8) for v in value]) for order in ((1, 0), (0, 1)))
        tensor = cell_means(np.stack([x * x, x * y, x * y, y * y], axis=-1))[step, row, column].reshape(-1, 2, 2)
        sharp = tensor / (np.trace(tensor, axis1=1, axis2=2) + FAINT_EDGE)[:, None, None]
        error_px = FLOW_ERROR_PX + FLOW_ERROR_SHARE * lengths(self.flow)
        self.certainty = sharp.astype(np.float64) / error_px[:, None, None] ** 2

    def equations(self, theta: np.ndarray, blur: float) -> Equations:
        """With one plane of inverse depth for each step, fitted as well."""
        del blur
        if theta.tobytes() not in self._found:
            self._found[theta.tobytes()] = self._equations(theta)
        return self._found[theta.tobytes()]

    def _equations(self, theta: np.ndarray) -> Equations:
        if len(self.step) < MIN_CELLS:
            return Equations(np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS), 0.0)
        depth = np.full(len(self.step), DEPTH_START_PER_M)
        for _ in range(2):
            error, by_depth, weight, _ = self._errors(theta, depth)
            fitted = self._per_step(by_depth, weight, error[..., None])[1]
            depth = np.clip(depth + (self.plane * fitted[self.step, :, 0]).sum(-1), 0.0, MOST_PER_M)
        error, by_depth, weight, now = self._errors(theta, depth)
        both = np.zeros((*self.flow.shape, PARAMETERS + 1))
        both[..., -1] = error
        for i in np.flatnonzero(_STEPS):
            changed = theta.copy()
            changed[i] += _STEPS[i]
            both[..., i] = (self._predicted(changed, depth) - now) / _STEPS[i]
        cross, fitted = self._per_step(by_depth, weight, both)
        found = np.einsum("mik,mil->kl", both, weight @ both) - np.einsum("nbk,nbl->kl", cross, fitted)
        likelihood = -float(np.log1p(np.einsum("mi,mij,mj->m", error, self.certainty, error)).sum())
        found, likelihood = found / SAMPLE_CELLS_WRIST, likelihood / SAMPLE_CELLS_WRIST
        return Equations(found[:-1, :-1], found[:-1, -1], likelihood)

    def _errors(self, theta: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Measured less predicted flow (m, 2), its slope by the plane of inverse depths (m, 2, 3), weights (m, 2, 2), and
        the predicted flow (m, 2)."""
        now = self._predicted(theta, depth)
        slope = (self._predicted(theta, depth + 0.5) - now) / 0.5
        error = self.flow - now
        distance = np.einsum("mi,mij,mj->m", error, self.certainty, error)
        return error, slope[..., None] * self.plane[:, None], self.certainty / (1 + distance)[:, None, None], now

    def _per_step(self, by_depth: np.ndarray, weight: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of each step: projections (n, 3, l) of values (m, 2, l) on the plane of inverse depths, and that plane fitted."""
        count = len(self.camera.T_base_camera) - 1
        square, cross = np.zeros((count, 3, 3)), np.zeros((count, 3, values.shape[-1]))
        weighted = np.swapaxes(weight @ by_depth, 1, 2)
        np.add.at(square, self.step, weighted @ by_depth)
        np.add.at(cross, self.step, weighted @ values)
        return cross, np.linalg.solve(square + np.diag(DEPTH_PRIOR**-2), cross)

    def _predicted(self, theta: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """(m, 2) flow [px] at the inverse depths (m,) [1/m]."""
        camera = moved_camera(self.camera, theta)
        moves = theta[[0, 1, 2, 3, 4, 5, 9]].tobytes()  # the others change K alone
        if moves not in self._steps:
            self._steps[moves] = _steps_between(camera.T_base_camera, float(theta[9]))
        turns, places = self._steps[moves]
        rays = np.c_[self.uv, np.ones(len(self.uv))] @ np.linalg.inv(camera.K).T
        moved = (turns[self.step] @ rays[:, :, None])[..., 0] + depth[:, None] * places[self.step]
        seen = moved @ camera.K.T
        return seen[:, :2] / np.maximum(seen[:, 2:], 0.1) - self.uv


def _steps_between(poses: np.ndarray, frames: float) -> tuple[np.ndarray, np.ndarray]:
    """Turns (n, 3, 3) and moves (n, 3) [m] of a camera from each of its poses (n + 1, 4, 4) to the next, so late."""
    relative = rigid_inverse(poses[1:]) @ poses[:-1]
    if frames == 0.0:
        return relative[:, :3, :3], relative[:, :3, 3]
    vectors = np.stack([cv2.Rodrigues(pose[:3, :3])[0][:, 0] for pose in relative])
    turns = np.stack([cv2.Rodrigues(vector)[0] for vector in _delayed(vectors, frames)])
    return turns, _delayed(relative[:, :3, 3], frames)


def _covered(camera: CameraTrack, points: np.ndarray, radii: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Bool (n, r, c): cells near what these points (n + 1, p, 3) hide at either end of a step."""
    centres = cell_centres(camera.height, camera.width)
    hidden = np.zeros((shape[0] + 1, *shape[1:]), dtype=bool)
    for i, pose in enumerate(camera.T_base_camera):
        uv, depth = project_points(points[i], camera.K, pose[None])
        ahead = depth > NEAR_M
        reach = camera.K[0, 0] * radii[ahead] / depth[ahead] + HAND_MARGIN_CELLS * CELL_PX
        hidden[i] = (lengths(centres[:, :, None] - uv[ahead]) < reach).any(-1)
    return hidden[1:] | hidden[:-1]
