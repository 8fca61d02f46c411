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
    LAG,
    PARAMETERS,
    SCALE,
    KindOfError,
    StillView,
    kinds_of_error,
    projected,
)
from worldline_core.calibration.estimate.recordings import FEWEST_FRAMES, RecordedView
from worldline_core.calibration.estimate.refine import FOCAL, FittedCamera, equations_at, inflation
from worldline_core.calibration.estimate.still_camera import (
    AGREEMENT_BLUR,
    StillCamera,
    shown_by,
    tools_apart,
    tools_in_view,
)
from worldline_core.calibration.estimate.wrist_camera import LEAST_WRIST_AGREEMENT, SHARED_WRIST_CAMERA, WristCamera
from worldline_core.data.episodes.episode import CameraTrack
from worldline_core.geometry.cameras import Resize, project_points

ZOOM_ERROR = 0.15
"""Standard deviation of the focal length, and of the distance with it, that flow of a close robot leaves; from known cameras."""
LEAST_AGREEMENT, LEAST_EPISODE = 0.5, 0.25
"""Cosine of predicted and measured flow on episodes that are held out: the median, and of one that says nothing else."""
RIVAL_DEVIATIONS = 3.0
LARGEST_HALVES_APART, LARGEST_INTERVAL = 0.035, 6.0
"""Between the tools of the two halves [widths], and of the interval in the picture [% of the width]."""
MIRRORED_GAIN = -20.0
"""Log-likelihood above which mirrored pictures cannot be told apart; of usual sets it is -90 to -260."""
LEAST_IN_VIEW = 0.1
FEWEST_FINGER_STEPS = 20
LARGEST_WRIST_HALVES_APART, LARGEST_WRIST_INTERVAL = 0.05, 10.0
"""The same of wrist cameras, which are nearer to what they see."""
FEWEST_EPISODES = 3
LEAST_TRAVEL_M, LEAST_CHANGE = 1.5, 0.02
"""Travel of the busiest tool over all episodes together; after less, a mirrored camera can look right."""
MOVED_SHARE, MOVED_DEVIATIONS = 2.5, 5.0
"""Displacement of the robot in the picture from one episode on: shares of the width, standard deviations."""

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


@dataclass(frozen=True)
class SourceEstimate:
    """The estimated cameras of a source, and the folder that they were written to; `cameras` is None where none is sure."""

    source: str
    views: tuple[ViewEstimate, ...]
    output: Path
    cameras: Path | None

    @property
    def sure(self) -> bool:
        return all(view.verdict == "sure" for view in self.views)


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
    typical = float(np.median(found.agreements))
    if typical < LEAST_AGREEMENT:
        reasons.append(
            f"what moves in the pictures is not the robot of these states (agreement {typical:.2f},"
            f" {LEAST_AGREEMENT} needed): it is hardly in view, the states or the robot are others, or the view is"
        )
    if (inside := tools_in_view(fitted.camera, recorded)) < LEAST_IN_VIEW:
        reasons.append(f"the tools are in the picture {inside:.0%} of the time")
    if found.mirrored > MIRRORED_GAIN:
        how = (
            "better: left and right are exchanged" if found.mirrored > 0 else "as well: the motion shows no difference"
        )
        reasons.append(f"mirrored pictures fit {how}")
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
    moved = _moved_at(recorded, found, views)
    if moved is not None:
        reasons.append(f"from episode {moved} on the camera stands elsewhere: give the two parts a source each")
    low = [e.episode_id for e, a in zip(recorded.episodes, found.agreements, strict=True) if a < LEAST_EPISODE]
    notes = (f"episodes that do not fit: {', '.join(low)}",) if low and moved is None else ()
    if 2 * len(low) > len(recorded.episodes):
        reasons.append(f"{len(low)} of {len(recorded.episodes)} episodes do not fit")
    if typical < LEAST_AGREEMENT:  # then nothing else means anything
        reasons, moved = reasons[:1], None
    estimate = _estimate(recorded, fitted, kinds, typical, reasons, wrist=False)
    agreements = found.rival_agreements
    return replace(
        estimate,
        rival=None if found.rival is None else full_size(found.rival.camera, recorded.image_size),
        rival_agreement=None if agreements is None else float(np.median(agreements)),
        notes=notes,
        moved_at=moved,
    )


def judge_wrist(recorded: RecordedView, found: WristCamera) -> ViewEstimate:
    """The estimate of a wrist view with its intervals and all reasons against it."""
    fitted = found.fitted
    _, _, ahead, slope = projected(np.zeros((1, 1, 3)), fitted.camera)
    shown = 100 / fitted.camera.width * np.c_[slope[:, :, 0, 0], np.zeros(2)]
    kinds = _intervals(recorded, fitted, shown, SHARED_WRIST_CAMERA, np.zeros(PARAMETERS))
    reasons: list[str] = []
    typical, known = found.agreement, int(np.isfinite(found.agreements).sum())
    if known < FEWEST_EPISODES:
        reasons.append(f"the scene's motion is seen in {known} episodes, {FEWEST_EPISODES} needed")
    elif typical < LEAST_WRIST_AGREEMENT:
        reasons.append(
            f"the scene does not move as the hand does (agreement {typical:.2f}, {LEAST_WRIST_AGREEMENT} needed): the"
            " states, the robot or the arm are others, or the view is no wrist camera of this arm"
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
    interval = kinds[-1].half_interval
    if interval > LARGEST_WRIST_INTERVAL:
        reasons.append(f"the tool's place in the picture is known to {interval:.1f} % of the width only")
    notes = ("the mount was searched: the description has none, or another one",) if found.searched else ()
    return replace(_estimate(recorded, fitted, kinds, typical, reasons, wrist=True), notes=notes)


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


def _moved_at(recorded: RecordedView, found: StillCamera, views: Sequence[StillView]) -> str | None:
    """The first episode that the camera of those before it does not fit; None where all have one camera."""
    fitted, count = found.fitted, len(views)
    places, weak = np.zeros((count, 2)), np.diag(np.array([0.2] * 3 + [0.2] * 3 + [0.02, 0.3]) ** -2.0)
    for i, view in enumerate(views):
        own = equations_at([view], fitted.camera, fitted.lag, AGREEMENT_BLUR, recorded.shared)
        change = np.linalg.solve(own.information + weak, own.gradient)
        change[LAG] = 0.0
        places[i] = view.at(fitted.camera).shown(np.zeros(PARAMETERS)) @ change
    split = _clearest_split(places, MOVED_SHARE)
    if split is None:
        split = _clearest_split(found.agreements[:, None], LEAST_EPISODE)
    return None if split is None else recorded.episodes[split].episode_id


def _clearest_split(values: np.ndarray, least: float) -> int | None:
    """Index at which a series (n, k) steps by `least` and by many standard deviations of what remains; None where it does not."""
    best, at = 0.0, None
    for k in range(2, len(values) - 1):
        before, after = values[:k], values[k:]
        step = float(np.linalg.norm(np.median(after, axis=0) - np.median(before, axis=0)))
        spread = np.median(np.abs(np.concatenate([before - np.median(before, 0), after - np.median(after, 0)])))
        error = 1.48 * max(float(spread), least / 20) * np.sqrt(1 / k + 1 / (len(values) - k))
        if step > least and step / error > max(best, MOVED_DEVIATIONS):
            best, at = step / error, k
    return at
