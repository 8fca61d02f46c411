"""Intervals and verdict of an estimated camera, with every reason to doubt it.

A camera is sure only if it agrees with episodes that it was not fitted to, better than every rival, two halves of the
episodes give it alone, and its interval in the picture is small. In doubt it is unsure, with the reason.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from worldline_core.calibration.camera_errors import (
    PARAMETERS,
    SCALE,
    Equations,
    KindOfError,
    kinds_of_error,
    projected,
)
from worldline_core.calibration.estimate.recordings import FEWEST_FRAMES, RecordedView
from worldline_core.calibration.estimate.refine import FOCAL, FittedCamera, equations_at, inflation
from worldline_core.calibration.estimate.still_camera import (
    AGREEMENT_BLUR,
    RIVAL_APART,
    StillCamera,
    shown_by,
    tools_apart,
    tools_in_view,
)
from worldline_core.calibration.estimate.wrist_camera import LEAST_WRIST_AGREEMENT, WristCamera
from worldline_core.calibration.observation import tool_travel
from worldline_core.data.episodes.episode import CameraTrack
from worldline_core.discovery.cameras import watch
from worldline_core.geometry.cameras import Resize, project_points
from worldline_core.geometry.embodiment import RigidOffset

ZOOM_ERROR = 0.15
"""Standard deviation of the focal length, and of the distance with it, that flow of a close robot leaves; from known cameras."""
LEAST_AGREEMENT, LEAST_EPISODE = 0.5, 0.25
"""Cosine of predicted and measured flow on episodes that are held out: the median, and of one that says nothing else."""
RIVAL_DEVIATIONS = 3.0
LARGEST_HALVES_APART, LARGEST_INTERVAL = 0.035, 6.0
"""Between the tools of the two halves [widths], and of the interval in the picture [% of the width]."""
MIRRORED_GAIN = -20.0
"""Log-likelihood of all episodes above which mirrored pictures cannot be told apart."""
LEAST_FOLLOWED, FOLLOWED_MORE = 0.3, 0.1
"""Correlation of how much a view changes with an arm's motion, 0.4 to 0.9 of the arm's own episodes and views and up to 0.2 of others;
and by how much another arm's is larger where wrist views are exchanged."""
LEAST_IN_VIEW = 0.1
FEWEST_FINGER_STEPS = 20
LARGEST_WRIST_HALVES_APART, LARGEST_WRIST_INTERVAL = 0.05, 10.0
"""The same of wrist cameras, which are nearer to what they see."""
FEWEST_EPISODES = 3
LEAST_TRAVEL_M, LEAST_CHANGE = 1.5, 0.02
"""Travel of the busiest tool over all episodes together; after less, a mirrored camera can look right."""
MOVED_SHARE, MOVED_DEVIATIONS, STILL_MOVED_DEVIATIONS = 2.5, 5.0, 4.5
"""Displacement of the robot in the picture from one episode on: percent of the width, standard deviations, and the
standard deviations for still cameras. Cameras that did not move reach 2.4 (recordings with known cameras)."""
MOVED = "from episode {} on the camera stands elsewhere: give the two parts a source each"
LEAST_SPREAD = 0.5
"""Standard deviation [% of the width] of an episode's place in the picture, however much it shows."""
USUAL_AGREEMENT, CLEAR_AGREEMENT, LARGEST_SCATTER = 0.7, 0.8, 1.7
"""An agreement below the first, with episodes that contradict each other by more than these squares (usual sets: 0.4 to 0.9), is that
of another robot, unless mirrored pictures agree better than the second."""
AGREEMENT_SPREAD = 0.15
"""Standard deviation of the agreements of episodes that one camera fits."""
LARGEST_BASE_DEG, LARGEST_BASE_MM = 20.0, 300.0
"""95 % intervals above which a base is not known."""

Verdict = Literal["sure", "unsure"]


@dataclass(frozen=True, eq=False)
class ViewEstimate:
    """The camera of one view.

    Attributes:
        camera: at the recorded size of pictures; `T_base_camera` is T_tool_camera of a wrist view; None where there is none.
        intervals: each kind of error that the estimate may have, whatever the others are (95 %).
        agreement: cosine of predicted and measured flow in held-out episodes.
        reasons: why it is not sure; notes: what else is worth knowing.
        moved_at: the episode from which on the camera stands elsewhere.
    """

    view: str
    wrist: bool
    verdict: Verdict
    camera: CameraTrack | None
    lag_frames: float = 0.0
    intervals: tuple[KindOfError, ...] = ()
    agreement: float = 0.0
    rival: CameraTrack | None = None
    rival_agreement: float | None = None
    reasons: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    moved_at: str | None = None
    episodes: int = 0


@dataclass(frozen=True, eq=False)
class BasePose:
    """Pose of the second arm's base, by one view.

    Attributes:
        mount: the unknown mount, and where it is found to be.
        half_interval_deg, half_interval_mm: 95 % intervals of the pose between the bases.
        halves_deg, halves_mm: between the poses that two halves of the episodes give.
    """

    view: str
    mount: str
    placed: RigidOffset
    half_interval_deg: float
    half_interval_mm: float
    halves_deg: float
    halves_mm: float

    @property
    def reason(self) -> str | None:
        """The reason against it; None where it is known well enough."""
        if self.half_interval_deg > LARGEST_BASE_DEG or self.half_interval_mm > LARGEST_BASE_MM:
            return "more motion of both arms is needed, in depth and over the whole picture"
        if self.halves_deg > self.half_interval_deg or self.halves_mm > self.half_interval_mm:
            return f"two halves of the episodes differ by {self.halves_deg:.1f} deg and {self.halves_mm:.0f} mm"
        return None


@dataclass(frozen=True)
class SourceEstimate:
    """The estimated cameras of a source, and the folder that they were written to; `cameras` is None where none is sure, `base` where
    the description says where both arms stand."""

    source: str
    views: tuple[ViewEstimate, ...]
    output: Path
    cameras: Path | None
    base: BasePose | None = None

    @property
    def sure(self) -> bool:
        placed = self.base is None or self.base.reason is None
        return placed and all(view.verdict == "sure" for view in self.views)


def too_few(recorded: RecordedView) -> str | None:
    """Why a view has too few episodes; None where it has enough."""
    count = len(recorded.episodes)
    if count == 0:
        return f"no episode has {FEWEST_FRAMES} pictures: nothing is seen to move"
    return None if count >= FEWEST_EPISODES else f"{count} episodes: {FEWEST_EPISODES} are needed to hold some out"


def too_little(recorded: RecordedView) -> str | None:
    """Why a still view cannot be estimated at all; None where it can."""
    episodes = recorded.episodes
    travel = sum(float(np.linalg.norm(np.diff(e.tools[..., :3, 3], axis=0), axis=-1).sum(0).max()) for e in episodes)
    if travel < LEAST_TRAVEL_M:
        return f"not enough motion: a tool travels {travel:.2f} m in all episodes together, {LEAST_TRAVEL_M} needed"
    if np.median([e.rough.change.mean() for e in episodes]) < LEAST_CHANGE:
        return "nothing changes in the pictures while the robot moves: it is not in view, or the video is frozen"
    return None


def judge_still(recorded: RecordedView, found: StillCamera) -> ViewEstimate:
    """The estimate of a still view with its intervals and all reasons against it."""
    fitted, views = found.fitted, recorded.still_views(fine=True)
    tools = np.concatenate([e.tools[:, :, :3, 3].reshape(-1, 3) for e in recorded.episodes])
    depth = float(np.median(project_points(tools, fitted.camera.K, fitted.camera.T_base_camera)[1]))
    # Seen from farther away through a longer lens, a robot looks nearly the same.
    zoom = np.zeros(PARAMETERS)
    zoom[5], zoom[FOCAL] = -ZOOM_ERROR * depth, ZOOM_ERROR
    kinds = _intervals(recorded, fitted, shown_by(fitted, views), recorded.shared, zoom)
    reasons: list[str] = []
    notes: list[str] = []
    typical = float(np.median(found.agreements))
    if typical < LEAST_AGREEMENT:
        reasons.append(
            f"what moves in the pictures is not the robot of these states (agreement {typical:.2f},"
            f" {LEAST_AGREEMENT} needed): {cause_of_disagreement(recorded, None)}"
        )
    if (inside := tools_in_view(fitted.camera, recorded)) < LEAST_IN_VIEW:
        reasons.append(f"the tools are in the picture {inside:.0%} of the time")
    own = [equations_at([view], fitted.camera, fitted.lag, AGREEMENT_BLUR, recorded.shared) for view in views]
    places, known = _places(own, [view.at(fitted.camera).shown(np.zeros(PARAMETERS)) for view in views])
    moved, scatter = _moved_at(recorded, found, places, known), scatter_of(places, known)
    contradictory = moved is None and typical < USUAL_AGREEMENT and scatter > LARGEST_SCATTER
    mirrored = float(found.mirrored.sum())
    if mirrored > -MIRRORED_GAIN and (not contradictory or found.mirrored_agreement > CLEAR_AGREEMENT):
        reasons.append("mirrored pictures fit better: left and right are exchanged")
    elif contradictory:
        reasons.append(
            f"each episode puts the robot elsewhere ({scatter:.1f} times the expected squares, agreement {typical:.2f}): another"
            " robot is declared, its columns or units are others, or other things move"
        )
    elif mirrored > MIRRORED_GAIN or _deviations(-found.mirrored) < RIVAL_DEVIATIONS:
        text = "mirrored pictures fit as well: the motion shows no difference"
        # Controls are drawn at the tools' places: where these are the same, it does not matter.
        (reasons if found.mirrored_apart > RIVAL_APART else notes).append(text)
    if found.rival is not None and found.rival_agreements is not None:
        apart = 100 * tools_apart(fitted.camera, found.rival.camera, recorded)
        gain = found.agreements - found.rival_agreements
        if (deviations := _deviations(gain)) < RIVAL_DEVIATIONS:
            reasons.append(
                f"another camera, {apart:.0f} % of the width away, fits as well ({deviations:.1f} deviations)"
            )
    halves = 100 * tools_apart(found.halves[0].camera, found.halves[1].camera, recorded)
    if halves > 100 * LARGEST_HALVES_APART:
        reasons.append(f"two halves of the episodes give cameras {halves:.1f} % of the width apart")
    interval = kinds[-1].half_interval
    if interval > LARGEST_INTERVAL:
        reasons.append(f"the robot's place in the picture is known to {interval:.1f} % of the width only")
    if moved is not None:
        reasons.insert(0, MOVED.format(moved))
    low = [e.episode_id for e, a in zip(recorded.episodes, found.agreements, strict=True) if a < LEAST_EPISODE]
    if low and moved is None:
        notes.append(f"episodes that do not fit: {', '.join(low)}")
    if 2 * len(low) > len(recorded.episodes):
        reasons.append(f"{len(low)} of {len(recorded.episodes)} episodes do not fit")
    if typical < LEAST_AGREEMENT and moved is None:  # then nothing else means anything
        reasons = reasons[:1]
    estimate = _estimate(recorded, fitted, kinds, typical, reasons, wrist=False)
    agreements = found.rival_agreements
    return replace(
        estimate,
        rival=None if found.rival is None else full_size(found.rival.camera, recorded.image_size),
        rival_agreement=None if agreements is None else float(np.median(agreements)),
        notes=tuple(notes),
        moved_at=moved,
    )


def judge_wrist(recorded: RecordedView, found: WristCamera, arm: int) -> ViewEstimate:
    """The estimate of a wrist view with its intervals and all reasons against it."""
    fitted = found.fitted
    _, _, ahead, slope = projected(np.zeros((1, 1, 3)), fitted.camera)
    shown = 100 / fitted.camera.width * np.c_[slope[:, :, 0, 0], np.zeros(2)]
    kinds = _intervals(recorded, fitted, shown, found.shared, np.zeros(PARAMETERS))
    reasons: list[str] = []
    typical, known = found.agreement, int(np.isfinite(found.agreements).sum())
    if known < FEWEST_EPISODES:
        reasons.append(f"the scene's motion is seen in {known} episodes, {FEWEST_EPISODES} needed")
    elif typical < LEAST_WRIST_AGREEMENT:
        reasons.append(
            f"the scene does not move as the hand does (agreement {typical:.2f}, {LEAST_WRIST_AGREEMENT} needed):"
            f" {cause_of_disagreement(recorded, arm)}"
        )
    if found.mirrored_agreement > max(typical, LEAST_WRIST_AGREEMENT):
        reasons.append(
            f"mirrored pictures fit better (agreement {found.mirrored_agreement:.2f}): left and right are exchanged"
        )
    if found.rival_agreements is not None:
        deviations = _deviations(found.agreements - found.rival_agreements)
        if deviations < RIVAL_DEVIATIONS:
            reasons.append(
                f"a camera that is mounted otherwise fits as well ({deviations:.1f} deviations): describe about where it is"
                " (`wrist_camera`, docs/embodiments.md)"
            )
    if found.fingers < FEWEST_FINGER_STEPS:
        reasons.append(
            f"the fingers move in {found.fingers} pictures, {FEWEST_FINGER_STEPS} needed to see where the tool is"
        )
    places = [project_points(np.zeros((1, 3)), c.camera.K, c.camera.T_base_camera)[0] for c in found.halves]
    halves = 100 * float(np.linalg.norm(places[1] - places[0])) / fitted.camera.width
    if not ahead.all():
        reasons.append("the tool is behind the camera")
    elif halves > 100 * LARGEST_WRIST_HALVES_APART:
        reasons.append(f"two halves of the episodes give cameras {halves:.1f} % of the width apart")
    split = clearest_step(*_places(found.own, [shown] * len(found.own)), MOVED_SHARE)
    moved = None if split is None else recorded.episodes[split].episode_id
    if moved is not None:
        reasons.insert(0, MOVED.format(moved))
    interval = kinds[-1].half_interval
    if interval > LARGEST_WRIST_INTERVAL:
        reasons.append(f"the tool's place in the picture is known to {interval:.1f} % of the width only")
    notes = ("the mount was searched: the description has none, or another one",) if found.searched else ()
    return replace(_estimate(recorded, fitted, kinds, typical, reasons, wrist=True), notes=notes, moved_at=moved)


def cause_of_disagreement(recorded: RecordedView, arm: int | None) -> str:
    """Why the pictures do not show the robot of the states; `arm` is that of a wrist view."""
    follows = correlations(recorded)
    most = float(follows.max())
    if most < LEAST_FOLLOWED:
        return (
            f"they do not change when the robot moves (correlation {most:.2f}), so states or pictures are of other episodes,"
            " or the robot is hardly in view"
        )
    if arm is not None and most > follows[arm] + FOLLOWED_MORE:
        return (
            f"the pictures change when another arm moves (correlation {most:.2f}), not with their own ({follows[arm]:.2f}):"
            " two wrist views are exchanged"
        )
    return (
        f"they change when the robot moves (correlation {most:.2f}), but not as it does: another robot is declared, its columns"
        " or units are others, the pictures are mirrored, or the view is another camera's"
    )


def correlations(recorded: RecordedView) -> np.ndarray:
    """(a,) correlation of how much the pictures change with the motion of each arm, in the median of the episodes."""
    seen = [watch(e.gray, {str(i): m for i, m in enumerate(tool_travel(e.tools).T)}) for e in recorded.episodes]
    known = [[each.follows[str(i)] for i in range(len(each.follows))] for each in seen if each is not None]
    return np.median(known, axis=0) if known else np.zeros(recorded.episodes[0].tools.shape[1])


def _estimate(
    recorded: RecordedView,
    fitted: FittedCamera,
    kinds: tuple[KindOfError, ...],
    typical: float,
    reasons: Sequence[str],
    *,
    wrist: bool,
) -> ViewEstimate:
    return ViewEstimate(
        recorded.view,
        wrist=wrist,
        verdict="unsure" if reasons else "sure",
        camera=full_size(fitted.camera, recorded.image_size),
        lag_frames=fitted.lag * recorded.every,
        intervals=kinds,
        agreement=typical,
        reasons=tuple(reasons),
        episodes=len(recorded.episodes),
    )


def _deviations(gain: np.ndarray) -> float:
    """By how many standard deviations the gains (e,) in agreement lie above 0 in the mean; NaN are left out."""
    known = gain[np.isfinite(gain)]
    return float(known.mean() / max(known.std(ddof=1) / np.sqrt(len(known)), 1e-6)) if len(known) > 1 else 0.0


def full_size(camera: CameraTrack, image_size: tuple[int, int]) -> CameraTrack:
    """A camera of pictures of another size, with square pixels and the principal point in the middle."""
    height, width = image_size
    K = Resize((camera.height, camera.width), image_size).affine @ camera.K
    K[1, 1] = K[0, 0]
    K[0, 2], K[1, 2] = (width - 1) / 2, (height - 1) / 2
    return CameraTrack(camera.view, K, camera.T_base_camera, width, height)


def _intervals(
    recorded: RecordedView, fitted: FittedCamera, shown: np.ndarray, shared: float, systematic: np.ndarray
) -> tuple[KindOfError, ...]:
    """The errors of each kind that the estimate may have. The last is that of the robot's place in the picture, of which `shown`
    (2, 8) [% of the width] is the displacement by each parameter. `systematic` (8,) is the standard deviation of an error, in its own
    direction, that no number of pictures reduces and none shows.
    """
    scale = np.append(SCALE[:-1], recorded.every)
    covariance = np.linalg.inv(fitted.information) * inflation(len(recorded.episodes), shared)
    none, units = np.zeros(PARAMETERS), np.outer(scale, scale)
    in_the_picture = kinds_of_error(none, covariance * units, shown / scale)[-1]
    return (*kinds_of_error(none, (covariance + np.outer(systematic, systematic)) * units, None), in_the_picture)


def _places(own: Sequence[Equations], shown: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Places of the robot in the picture by each episode alone (e, 2), relative to that by all [% of the width], and covariances (e, 2, 2).

    Args:
        own: its equations at the camera of all. shown: displacement in the picture (2, 8) by each parameter.
    """
    weak = np.diag(np.array([0.2] * 3 + [0.2] * 3 + [0.02, 0.3]) ** -2.0)
    places = [A @ np.linalg.solve(e.information + weak, e.gradient) for e, A in zip(own, shown, strict=True)]
    known = [A @ np.linalg.inv(e.information + weak) @ A.T for e, A in zip(own, shown, strict=True)]
    return np.stack(places), np.stack(known) + LEAST_SPREAD**2 * np.eye(2)


def _moved_at(recorded: RecordedView, found: StillCamera, places: np.ndarray, known: np.ndarray) -> str | None:
    """The first episode that the camera of those before it does not fit; None where all have one camera."""
    split = clearest_step(places, known, MOVED_SHARE, STILL_MOVED_DEVIATIONS)
    if split is None:
        spread = np.full((len(places), 1, 1), AGREEMENT_SPREAD**2)
        split = clearest_step(found.agreements[:, None], spread, LEAST_EPISODE)
    return None if split is None else recorded.episodes[split].episode_id


def scatter_of(values: np.ndarray, covariances: np.ndarray) -> float:
    """Squares of a series (n, k) about its mean by its covariances (n, k, k), in those that are expected."""
    weights = np.linalg.inv(covariances)
    left = values - np.linalg.solve(weights.sum(axis=0), np.einsum("nij,nj->i", weights, values))
    return float(np.einsum("ni,nij,nj->", left, weights, left)) / (left.size - left.shape[1])


def clearest_step(
    values: np.ndarray, covariances: np.ndarray, least: float, deviations: float = MOVED_DEVIATIONS
) -> int | None:
    """Index at which a series (n, k) of known covariances (n, k, k) steps by `least` and by many standard `deviations`; None where
    it does not. A value counts as much as it is known, and a series that scatters more than that is known less.
    """
    best, at = deviations**2, None
    weights = np.linalg.inv(covariances)
    for k in range(2, len(values) - 1):
        parts = slice(None, k), slice(k, None)
        errors = [np.linalg.inv(weights[part].sum(axis=0)) for part in parts]
        means = [e @ np.einsum("nij,nj->i", weights[p], values[p]) for e, p in zip(errors, parts, strict=True)]
        left = np.concatenate([values[part] - mean for part, mean in zip(parts, means, strict=True)])
        scatter = max(1.0, float(np.einsum("ni,nij,nj->", left, weights, left)) / (left.size - 2 * left.shape[1]))
        step = means[1] - means[0]
        squares = float(step @ np.linalg.solve(scatter * (errors[0] + errors[1]), step))
        if np.linalg.norm(step) > least and squares > best:
            best, at = squares, k
    return at
