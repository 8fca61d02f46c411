"""Search for a still camera over the whole sphere: starts for the estimate, without a guess by the user.

A camera is scored by how well the robot's projected motion agrees with the measured flow: both are vector maps on the
picture's cells, one for each step, and the score is the cosine between them over all cells and steps. A wrong camera lets
things move at another place, at another time or another way, so its maps cancel out and the score is near zero.

Axis legend: b cameras, n steps, p points on the robot, r c rows and columns of cells.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import torch
from einops import rearrange
from torch import Tensor

from worldline_core.calibration.observation import CELL_PX
from worldline_core.geometry.transforms import rotation_about_axis

AZIMUTHS, ELEVATIONS_DEG, ROLLS_DEG = 20, (-5.0, 10.0, 25.0, 40.0, 55.0, 70.0, 85.0), (-12.0, 0.0, 12.0, 180.0)
FOCALS = (0.65, 1.0, 1.6)
"""Focal lengths in widths of the picture: 75, 53 and 35 degrees across."""
SCALES = (0.7, 1.0, 1.4)
"""Distances beside the one at which the predicted motion is as large in the picture as the measured one."""
STEPS, POINTS = 80, 32
"""Numbers of steps, those with most motion, and of points, spread over what moves."""
ROUGH_STEPS = 40
BLURS = (1.5, 1.5, 1.1, 0.8, 0.8)
"""Blur of the maps in cells, one round of random changes after another."""
KEPT, CHILDREN = (60, 40, 24, 16, 12), 16
"""Cameras kept of the round before, and changes of each."""
STARTS, APART_DEG, APART_FOCAL = 12, (10.0, 8.0, 6.0, 6.0, 6.0), 0.25
USUAL_FOCAL, FOCAL_SPREAD, FOCAL_COST = 1.0, 0.5, 0.01
"""A picture hardly tells a long focal length from a longer one; the score of an unusual one is lower by this much."""
NEAR_M, BATCH = 0.05, 64
LONGEST_STEP_CELLS = 3.0


@dataclass(frozen=True, eq=False)
class MotionOfSteps:
    """Steps of several episodes: where points on the robot are before and after (n, p, 3), and the flow (n, r, c, 2) [px]
    that a still view of `width` pixels shows."""

    before: np.ndarray
    after: np.ndarray
    flow: np.ndarray
    width: int
    height: int

    def first(self, count: int) -> MotionOfSteps:
        return replace(self, before=self.before[:count], after=self.after[:count], flow=self.flow[:count])

    def chosen(self, count: int) -> MotionOfSteps:
        """The steps with most measured motion in a mixed order, and points that move and are far from each other."""
        travel = np.linalg.norm(self.after - self.before, axis=-1)
        seen = np.linalg.norm(self.flow, axis=-1).sum(axis=(1, 2))
        order = np.argsort(-np.sqrt(seen * travel.sum(axis=1)), kind="stable")
        steps = np.random.default_rng(0).permutation(order[: 2 * count])[:count]
        points = _spread(self.before[steps], travel[steps].mean(axis=0))
        return MotionOfSteps(
            self.before[np.ix_(steps, points)], self.after[np.ix_(steps, points)], self.flow[steps], self.width, self.height
        )  # fmt: skip


def _spread(places: np.ndarray, travel: np.ndarray) -> np.ndarray:
    """Indices of points (n, p, 3) that move, each as far from the others as possible over all steps."""
    moving = np.flatnonzero(travel > 0.1 * travel.max())
    tracks = places[:: max(1, len(places) // 12), moving]
    chosen = [int(travel[moving].argmax())]
    distance = np.linalg.norm(tracks - tracks[:, chosen], axis=-1).mean(axis=0)
    while len(chosen) < min(POINTS, len(moving)):
        chosen.append(int((distance * np.sqrt(travel[moving])).argmax()))
        distance = np.minimum(distance, np.linalg.norm(tracks - tracks[:, chosen[-1:]], axis=-1).mean(axis=0))
    return moving[np.sort(chosen)]


@dataclass(frozen=True, eq=False)
class FoundCamera:
    """A focal length in widths of the picture, and T_base_camera (4, 4)."""

    focal: float
    T_base_camera: np.ndarray


class _Scorer:
    """Scores cameras by the agreement of the flow that they predict with the measured one."""

    def __init__(self, motion: MotionOfSteps, blur: float) -> None:
        self.width, self.height, self.blur = motion.width, motion.height, blur
        self.before, self.after = (torch.tensor(each, dtype=torch.float32) for each in (motion.before, motion.after))
        flow = torch.tensor(rearrange(motion.flow, "n r c two -> n two r c"), dtype=torch.float32)
        self.rows, self.columns = flow.shape[2:]
        self.down, self.across = _blur_matrix(self.rows, blur), _blur_matrix(self.columns, blur)
        flow = flow * (LONGEST_STEP_CELLS * CELL_PX / flow.norm(dim=1, keepdim=True).clamp_min(1e-6)).clamp_max(1.0)
        self.wanted = self._blurred(flow)

    def _blurred(self, maps: Tensor) -> Tensor:
        """Maps (..., r, c), blurred within each; nothing is outside."""
        return self.down @ maps @ self.across

    def scores(self, focal: Tensor, pose: Tensor) -> Tensor:
        """(b,) of focal lengths (b,) and T_base_camera (b, 4, 4)."""
        found = [self._batch(focal[i : i + BATCH], pose[i : i + BATCH]) for i in range(0, len(focal), BATCH)]
        return torch.cat(found) - FOCAL_COST * ((focal / USUAL_FOCAL).log() / FOCAL_SPREAD).square()

    def _batch(self, focal: Tensor, pose: Tensor) -> Tensor:
        start, depth = self._pixels(self.before, focal, pose)
        end, later = self._pixels(self.after, focal, pose)
        step = end - start
        ahead = (depth > NEAR_M) & (later > NEAR_M)
        length = step.norm(dim=-1).clamp_min(1e-6)
        step = step * (LONGEST_STEP_CELLS * CELL_PX / length).clamp_max(1.0)[..., None]
        cell = (((start + end) / 2 - (CELL_PX - 1) / 2) / CELL_PX).round()
        column, row = cell[..., 0], cell[..., 1]
        inside = ahead & (column >= 0) & (column < self.columns) & (row >= 0) & (row < self.rows) & (length > 0.05)
        batch, steps = start.shape[:2]
        cells = self.rows * self.columns
        place = (row.clamp(0, self.rows - 1) * self.columns + column.clamp(0, self.columns - 1)).long()
        place = place + cells * torch.arange(batch * steps).view(batch, steps, 1)
        weight = torch.where(inside, length.clamp_max(12.0) + 0.1, torch.zeros(()))
        maps = torch.zeros(batch * steps * cells, 3)
        maps.index_add_(0, place.flatten(), torch.cat([weight[..., None] * step, weight[..., None]], -1).flatten(0, 2))
        maps = rearrange(maps, "(bn r c) k -> bn k r c", r=self.rows, c=self.columns)
        maps = self._blurred(maps)
        value = maps[:, :2] / (maps[:, 2:] + 0.15)
        value = rearrange(value, "(b n) two r c -> b n two r c", b=batch)
        dot = (value * self.wanted).sum(dim=(1, 2, 3, 4))
        return dot / (value.square().sum(dim=(1, 2, 3, 4)).sqrt() * self.wanted.norm() + 1e-6)

    def _pixels(self, points: Tensor, focal: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
        """(b, n, p, 2) and depth (b, n, p) of points (n, p, 3)."""
        turned = torch.einsum("npi,bij->bnpj", points, pose[:, :3, :3])
        place = torch.einsum("bi,bij->bj", pose[:, :3, 3], pose[:, :3, :3])
        seen = turned - place[:, None, None]
        depth = seen[..., 2]
        uv = self.width * focal[:, None, None, None] * seen[..., :2] / depth.clamp_min(NEAR_M)[..., None]
        return uv + torch.tensor([(self.width - 1) / 2, (self.height - 1) / 2]), depth


def _blur_matrix(size: int, cells: float) -> Tensor:
    """(size, size): a row of this many cells, blurred."""
    place = torch.arange(size, dtype=torch.float32)
    weight = torch.exp(-0.5 * ((place[:, None] - place) / cells).square())
    return weight / weight.sum(dim=1).max()


def search_cameras(motion: MotionOfSteps) -> list[FoundCamera]:
    """The best cameras that differ from each other, the best first: from a grid over the sphere, improved by random changes."""
    chosen, random = motion.chosen(STEPS), np.random.default_rng(0)
    focal, pose = _grid(chosen)
    found = _Scorer(chosen.first(ROUGH_STEPS), BLURS[0]).scores(focal, pose)
    for number, (blur, count, apart) in enumerate(zip(BLURS, KEPT, APART_DEG, strict=True)):
        kept = _apart(focal, pose, found, count, apart)
        focal, pose = focal[kept], pose[kept]
        tried = _changed(focal, pose, random, 0.7**number, chosen)
        focal, pose = torch.cat([focal, tried[0]]), torch.cat([pose, tried[1]])
        found = _Scorer(chosen, blur).scores(focal, pose)
    kept = _apart(focal, pose, found, STARTS, APART_DEG[-1])
    return [FoundCamera(float(focal[i]), pose[i].double().numpy()) for i in kept]


def _apart(focal: Tensor, pose: Tensor, score: Tensor, count: int, degrees: float) -> list[int]:
    """Indices of the best cameras, the best first, whose rotations, or focal lengths, differ."""
    kept: list[int] = []
    logs = focal.log()
    for i in score.argsort(descending=True).tolist():
        if len(kept) == count:
            break
        others = pose[kept, :3, :3]
        trace = (others * pose[i, :3, :3]).sum(dim=(1, 2)) if kept else torch.zeros(0)
        near = torch.rad2deg(((trace - 1) / 2).clamp(-1, 1).acos()) < degrees
        if not bool((near & ((logs[kept] - logs[i]).abs() < APART_FOCAL)).any()):
            kept.append(i)
    return kept


def _changed(
    focal: Tensor, pose: Tensor, random: np.random.Generator, size: float, motion: MotionOfSteps
) -> tuple[Tensor, Tensor]:
    """CHILDREN random changes of each camera: a turn about what it looks at, a shift in the picture, distance, focal length."""
    middle = motion.before.reshape(-1, 3).mean(axis=0)
    focals, poses = [], []
    for f, T in zip(focal.tolist(), pose.double().numpy(), strict=True):
        for _ in range(CHILDREN):
            scale = size * random.choice([1.0, 0.4])
            vector = random.normal(0, 0.25 * scale, 3)
            turn = rotation_about_axis(vector, float(np.linalg.norm(vector)))
            R = T[:3, :3] @ turn
            seen = (middle - T[:3, 3]) @ T[:3, :3]
            zoom = np.exp(random.normal(0, 0.25 * scale))
            # Focal length and distance change together, so that the size in the picture stays; or the distance alone.
            far = np.exp(random.normal(0, 0.15 * scale)) * zoom
            seen = far * (seen + seen[2] / f * np.append(random.normal(0, 0.06 * scale, 2), 0.0))
            new = np.eye(4)
            new[:3, :3], new[:3, 3] = R, middle - R @ seen
            focals.append(float(np.clip(f * zoom, 0.4, 3.0)))
            poses.append(new)
    return torch.tensor(focals, dtype=torch.float32), torch.tensor(np.stack(poses), dtype=torch.float32)


def _grid(motion: MotionOfSteps) -> tuple[Tensor, Tensor]:
    """Cameras all around what moves, which see it as large and where the measured motion is."""
    weight = np.linalg.norm(motion.after - motion.before, axis=-1)
    middle = np.average(motion.before.reshape(-1, 3), axis=0, weights=weight.reshape(-1))
    radius = float(np.sqrt(np.average(((motion.before - middle) ** 2).sum(-1), weights=weight)))
    amount = np.linalg.norm(motion.flow, axis=-1).sum(axis=0)
    row, column = np.indices(amount.shape)
    at = np.array([np.average(column, weights=amount), np.average(row, weights=amount)])
    spread = np.sqrt(np.average((column - at[0]) ** 2 + (row - at[1]) ** 2, weights=amount)) * CELL_PX / motion.width
    centre = np.array([(motion.width - 1) / 2, (motion.height - 1) / 2])
    away = (at * CELL_PX + (CELL_PX - 1) / 2 - centre) / motion.width
    focals, poses = [], []
    angles = product(np.arange(AZIMUTHS) * 2 * np.pi / AZIMUTHS, np.radians(ELEVATIONS_DEG), np.radians(ROLLS_DEG))
    for azimuth, rise, roll in angles:
        R = looking_down(azimuth, rise) @ rotation_about_axis(np.array([0.0, 0.0, 1.0]), roll)
        for f, scale in product(FOCALS, SCALES):
            # In a picture the spread is of two of three directions.
            distance = scale * f * radius * np.sqrt(2 / 3) / max(float(spread), 0.02)
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = R, middle - R @ (distance * np.append(away / f, 1.0))
            focals.append(f)
            poses.append(pose)
    return torch.tensor(focals, dtype=torch.float32), torch.tensor(np.stack(poses), dtype=torch.float32)


def looking_down(azimuth: float, elevation: float) -> np.ndarray:
    """R_base_camera (3, 3) of an upright camera that stands at this azimuth and elevation and looks at the middle."""
    z = -np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    x = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    return np.stack([x, np.cross(z, x), z], axis=1)
