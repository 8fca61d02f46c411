"""Pose between the bases of two arms, from a still view in which both move.

Each arm alone leads to the camera in the frame of its own base. Both are one camera: focal length and lag are common, what
moves where only the other arm is does not count, and T_first_second = T_first_camera T_camera_second.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from worldline_core.calibration.camera_errors import LARGEST_STEP, Equations, StillView, moved_camera
from worldline_core.calibration.estimate.recordings import LoadedViews, RecordedView, placed, recorded_views
from worldline_core.calibration.estimate.refine import FOCAL, climb, inflation, summed_equations, with_prior
from worldline_core.calibration.estimate.still_camera import FINE_BLURS, estimate_still
from worldline_core.calibration.estimate.verdict import ZOOM_ERROR, BasePose, ViewEstimate, too_few, too_little
from worldline_core.data.episodes.episode import CameraTrack
from worldline_core.errors import DataError
from worldline_core.geometry.cameras import project_points
from worldline_core.geometry.embodiment import Embodiment, RigidOffset
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.geometry.transforms import quaternion_wxyz_from_rotation, rigid_inverse, rotation_angle_deg

OF_FIRST, OF_SECOND = np.r_[0:6, 12:14], np.r_[6:14]
"""Parameters of each arm's equations among all: the camera's pose in either frame, focal length, lag."""
LARGEST_STEPS = np.concatenate([LARGEST_STEP[:FOCAL], LARGEST_STEP])
ROUNDS = 8
DEVIATIONS_95 = 2.8
"""Standard deviations within which 95 % of vectors of three normal components lie."""

APART_M = 1000.0
"""Between the arms as they are read: which point belongs to which arm is seen from its place."""

Cameras = tuple[CameraTrack, CameraTrack]
Arms = Sequence[tuple[StillView, StillView]]


def place_second_arm(loaded: LoadedViews, robot: Embodiment, count: int) -> tuple[Embodiment, BasePose]:
    """A robot of which one mount is unknown, with that mount as the still views of about `count` episodes show it.

    Raises: DataError as `recorded_views`, or where no still view can show it.
    """
    unknown = str(robot.description.unknown_mount)
    ((known, there),) = ((n, m) for n, m in robot.description.mounts.items() if isinstance(m, RigidOffset))
    apart = robot.with_mounts({known: RigidOffset(), unknown: RigidOffset(translation=(APART_M, 0.0, 0.0))})
    wrists = {arm.camera_view for arm in robot.arms}
    found: list[BasePose] = []
    reasons: list[str] = []
    for view, recorded in recorded_views(_joints_alone(loaded), ArmKinematics(apart), count).items():
        if view in wrists:
            continue
        arms = each_arm(recorded)
        reason = too_few(recorded) or too_little(arms[0]) or too_little(arms[1])
        if reason is None:
            fitted = fit_pair(*arms)
            found.append(base_pose(view, unknown, there.matrix(), arms, fitted))
        else:
            reasons.append(f"{view}: {reason}")
    if not found:
        raise DataError(
            "The place of an arm's base cannot be found", where=f"embodiment {robot.name}, mount {unknown}",
            expected="a still view in which both arms move", got="; ".join(reasons) or "wrist views alone",
        )  # fmt: skip
    best = min(found, key=lambda each: each.half_interval_mm)
    return robot.with_mounts({known: there, unknown: best.placed}), best


def _joints_alone(loaded: LoadedViews) -> LoadedViews:
    """Episodes without recorded tool poses, which say nothing of the second base's frame."""
    for episode, images in loaded:
        if episode.state_kind != "joints":
            raise DataError(
                "An arm's base is found from joints", where=f"episode {episode.episode_id}", got=episode.state_kind
            )
        yield replace(episode, T_base_ee=None), images


def with_base(estimate: ViewEstimate, base: BasePose) -> ViewEstimate:
    """A view's estimate with the found base: a still camera sees both arms."""
    if estimate.wrist or base.reason is None:
        return estimate
    return replace(estimate, verdict="unsure", reasons=(*estimate.reasons, f"the base of {base.mount}: {base.reason}"))


def each_arm(recorded: RecordedView) -> tuple[RecordedView, RecordedView]:
    """A view of two arms that are read APART_M apart along x, as each arm alone moves in its own frame."""
    arms: list[RecordedView] = []
    for offset in (0.0, APART_M):
        episodes = []
        for episode in recorded.episodes:
            points = np.abs(episode.points[0, :, 0] - offset) < APART_M / 2
            tools = np.abs(episode.tools[0, :, 0, 3] - offset) < APART_M / 2
            own = replace(
                episode, points=episode.points[:, points].copy(), radii=episode.radii[points], tools=episode.tools[:, tools].copy()
            )  # fmt: skip
            own.points[..., 0] -= offset
            own.tools[..., 0, 3] -= offset
            episodes.append(own)
        arms.append(recorded.of(episodes))
    return arms[0], arms[1]


@dataclass(frozen=True, eq=False)
class FittedPair:
    """The camera in the frames of both bases, its parameters' covariance, and T_first_second of two halves of the episodes."""

    cameras: Cameras
    covariance: np.ndarray
    halves: tuple[np.ndarray, np.ndarray]


def fit_pair(first: RecordedView, second: RecordedView) -> FittedPair:
    """One camera by the same pictures and the motion of each arm in its own frame."""
    found = estimate_still(first).fitted, estimate_still(second).fitted
    views = list(zip(first.still_views(fine=True), second.still_views(fine=True), strict=True))
    lag = (found[0].lag + found[1].lag) / 2
    return refine_pair(views, (first, second), (found[0].camera, found[1].camera), lag)


def refine_pair(views: Arms, arms: tuple[RecordedView, RecordedView], cameras: Cameras, lag: float) -> FittedPair:
    """The same from one camera for each arm, which may differ in focal length."""
    focal = float(np.sqrt(cameras[0].K[0, 0] * cameras[1].K[0, 0]))
    depths = [_depth(arm, camera) for arm, camera in zip(arms, cameras, strict=True)]
    cameras = _zoomed(cameras[0], focal, depths[0]), _zoomed(cameras[1], focal, depths[1])
    shared = arms[0].shared
    alone = [_alone(a.at(cameras[0]), b.at(cameras[1])) for a, b in views]
    cameras, lag, _ = _fit(alone, cameras, lag, shared)
    alone = [_alone(a.at(cameras[0]), b.at(cameras[1])) for a, b in views]
    cameras, lag, equations = _fit(alone, cameras, lag, shared)
    one, other = (_between(_fit(alone[part::2], cameras, lag, shared)[0]) for part in (0, 1))
    return FittedPair(cameras, np.linalg.inv(equations.information) * inflation(len(alone), shared), (one, other))


def base_pose(
    view: str, mount: str, T_world_first: np.ndarray, arms: tuple[RecordedView, RecordedView], fitted: FittedPair
) -> BasePose:
    """The unknown mount by one view, with its intervals."""
    T = T_world_first @ _between(fitted.cameras)
    turn, shift = _deviations(fitted, [_depth(a, c) for a, c in zip(arms, fitted.cameras, strict=True)])
    apart = rigid_inverse(fitted.halves[0]) @ fitted.halves[1]
    return BasePose(
        view,
        mount,
        RigidOffset(
            translation=tuple(T[:3, 3].tolist()), rotation_wxyz=tuple(quaternion_wxyz_from_rotation(T[:3, :3]).tolist())
        ),
        DEVIATIONS_95 * float(np.degrees(turn)),
        DEVIATIONS_95 * 1e3 * shift,
        float(rotation_angle_deg(apart[:3, :3])),
        1e3 * float(np.linalg.norm(apart[:3, 3])),
    )


def _depth(arm: RecordedView, camera: CameraTrack) -> float:
    """Median distance of the tools before a camera [m]."""
    tools = np.concatenate([e.tools[:, :, :3, 3].reshape(-1, 3) for e in arm.episodes])
    return float(np.median(project_points(tools, camera.K, camera.T_base_camera)[1]))


def _zoomed(camera: CameraTrack, focal: float, depth: float) -> CameraTrack:
    """A camera of another focal length [px] that sees a robot at this depth as large as before."""
    change = np.eye(4)
    change[2, 3] = depth * (1 - focal / camera.K[0, 0])
    return placed(camera, focal, camera.T_base_camera @ change)


def _alone(first: StillView, second: StillView) -> tuple[StillView, StillView]:
    """Two arms before one camera, each without the motion where only the other one moves."""
    a, b = first.covered, second.covered
    return first.without(b & ~a), second.without(a & ~b)


def _between(cameras: Cameras) -> np.ndarray:
    """T_first_second."""
    return cameras[0].T_base_camera[0] @ rigid_inverse(cameras[1].T_base_camera)[0]


def _moved(cameras: Cameras, change: np.ndarray) -> Cameras:
    return moved_camera(cameras[0], change[OF_FIRST]), moved_camera(cameras[1], change[OF_SECOND])


def _fit(views: Arms, start: Cameras, lag: float, shared: float) -> tuple[Cameras, float, Equations]:
    """The camera in both frames that explains all episodes best, from a start."""

    def equations(cameras: Cameras, lag: float, blur: float) -> Equations:
        size = len(LARGEST_STEPS)
        information, gradient, likelihood = np.zeros((size, size)), np.zeros(size), 0.0
        for arm, columns in enumerate((OF_FIRST, OF_SECOND)):
            one = summed_equations([both[arm] for both in views], cameras[arm], lag, blur)
            information[np.ix_(columns, columns)] += one.information
            gradient[columns] += one.gradient
            likelihood += one.likelihood
        found = Equations(information, gradient, likelihood)
        return with_prior(found, cameras[0], lag, inflation(len(views), shared))

    return climb(equations, start, lag, FINE_BLURS, ROUNDS, _moved, LARGEST_STEPS)


def _deviations(fitted: FittedPair, depths: Sequence[float]) -> tuple[float, float]:
    """Largest standard deviations of the rotation between the bases [rad] and of the second base's place [m]."""
    apart = np.zeros((6, len(fitted.covariance)))  # of the second frame against the first one, in the camera's
    apart[:, :6], apart[:, 6:12] = np.eye(6), -np.eye(6)
    zoom = np.zeros(6)  # from farther away through a longer lens, both arms look nearly the same
    zoom[5] = -ZOOM_ERROR * (depths[0] - depths[1])
    known = apart @ fitted.covariance @ apart.T + np.outer(zoom, zoom)
    x, y, z = rigid_inverse(fitted.cameras[1].T_base_camera)[0, :3, 3]
    place = np.c_[np.array([[0, z, -y], [-z, 0, x], [y, -x, 0]]), np.eye(3)]
    turn, shift = (float(np.linalg.eigvalsh(C)[-1]) ** 0.5 for C in (known[:3, :3], place @ known @ place.T))
    return turn, shift
