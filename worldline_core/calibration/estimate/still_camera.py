"""A still camera from recorded episodes alone: searched for everywhere, made exact, and compared with its rivals.

What moves in the pictures is the robot. The search gives cameras that agree with the measured flow; each is made exact on
some episodes, those that end at different places are rivals, and the best is made exact on all. Two halves of the episodes
are fitted alone: their difference is what chance does, and each judges the other's episodes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from worldline_core.calibration.camera_errors import LAG, PARAMETERS, StillView, delayed
from worldline_core.calibration.estimate.camera_search import FoundCamera, MotionOfSteps, search_cameras
from worldline_core.calibration.estimate.recordings import RecordedView, near_changes, placed
from worldline_core.calibration.estimate.refine import FittedCamera, fit_still
from worldline_core.data.episodes.episode import CameraTrack
from worldline_core.geometry.cameras import inside_image, project_points

ROUGH_BLURS, FINE_BLURS, ROUGH_EPISODES = (2.5, 1.2), (1.8, 0.7), 5
AGREEMENT_BLUR = 1.2
STARTS_REFINED = 6
RIVAL_APART = 0.04
"""Share of the picture's width between the tools of two cameras that are rivals, not one."""
LARGEST_LAG_S, LAG_STEP, LAG_CLEAR = 0.8, 0.5, 0.03
ROBOT_NEAR_M = 0.05


@dataclass(frozen=True, eq=False)
class StillCamera:
    """The result for one still view.

    Attributes:
        fitted: the camera at the fine size of pictures; None where nothing could be searched for.
        halves: of the even and of the odd episodes.
        agreements: (e,) of each episode with the camera of the half that it does not belong to.
        rival: the best camera elsewhere, and its agreements.
        mirrored: (e,) gain in log-likelihood of mirrored pictures at the rough size; mirrored_agreement: their median agreement;
            mirrored_apart: median distance [widths] of the places that the tools would then have in the picture.
    """

    fitted: FittedCamera
    halves: tuple[FittedCamera, ...]
    agreements: np.ndarray
    rival: FittedCamera | None
    rival_agreements: np.ndarray | None
    mirrored: np.ndarray
    mirrored_agreement: float
    mirrored_apart: float


def estimate_still(recorded: RecordedView) -> StillCamera:
    """The camera of a view that stands still, its rivals, and what each episode says of them."""
    lag = lag_by_amounts(recorded)
    motion = recorded.motion(lag)
    found = search_cameras(motion)
    episodes = recorded.episodes
    few = recorded.of(episodes[:: max(1, len(episodes) // ROUGH_EPISODES)])
    rough_views = few.still_views(fine=False)
    camera = recorded.unknown_camera(fine=False)
    rough = [
        fit_still(rough_views, _at(camera, each), lag, ROUGH_BLURS, 5, recorded.shared)
        for each in found[:STARTS_REFINED]
    ]
    distinct = _distinct(rough, recorded)
    mirrored_views = [view.mirrored() for view in rough_views]
    mirrored = [
        fit_still(mirrored_views, _at(camera, each), lag, ROUGH_BLURS, 5, recorded.shared)
        for each in search_cameras(_mirrored(motion))[: STARTS_REFINED // 3]
    ]
    rough_views = recorded.still_views(fine=False)
    own = _settled(rough_views, distinct[0], recorded.shared)
    mirrored_views = [view.mirrored() for view in rough_views]
    other = _settled(mirrored_views, max(mirrored, key=lambda fit: fit.likelihood), recorded.shared)
    gains = _likelihoods(mirrored_views, other) - _likelihoods(rough_views, own)
    agreed = float(np.median([agreement(view, other) for view in mirrored_views]))
    apart = tools_apart(own.camera, unmirrored(other.camera), recorded)
    views = recorded.still_views(fine=True)
    fine = recorded.unknown_camera(fine=True)
    fits = [
        fit_still(views, _enlarged(each.camera, fine), each.lag, FINE_BLURS, 6, recorded.shared)
        for each in distinct[:2]
    ]
    fits.sort(key=lambda fit: -fit.likelihood)
    best = fits[0]
    halves, agreements = _by_halves(views, best, recorded.shared)
    rival = next((fit for fit in fits[1:] if tools_apart(best.camera, fit.camera, recorded) > RIVAL_APART), None)
    rivals = None if rival is None else np.array([agreement(view, rival) for view in views])
    return StillCamera(best, halves, agreements, rival, rivals, gains, agreed, apart)


def refine_with_masks(masked: RecordedView, found: StillCamera) -> StillCamera:
    """The same camera and rival by what moves within the robot's masks."""
    views, rival = masked.still_views(fine=True), found.rival
    best = fit_still(views, found.fitted.camera, found.fitted.lag, FINE_BLURS, 6, masked.shared)
    halves, agreements = _by_halves(views, best, masked.shared)
    rivals = None if rival is None else np.array([agreement(view, rival) for view in views])
    return replace(found, fitted=best, halves=halves, agreements=agreements, rival_agreements=rivals)


def _by_halves(
    views: Sequence[StillView], best: FittedCamera, shared: float
) -> tuple[tuple[FittedCamera, ...], np.ndarray]:
    """The cameras of the even and of the odd episodes, and the agreement of each episode with that of the other half."""
    halves = tuple(
        fit_still(views[part::2], best.camera, best.lag, FINE_BLURS[-1:], 6, shared)
        for part in (0, 1)
        if views[part::2]
    )
    others = halves[::-1] if len(halves) == 2 else (best, best)
    agreements = np.array([agreement(view, others[i % 2]) for i, view in enumerate(views)])
    return halves, agreements


def _settled(views: Sequence[StillView], fit: FittedCamera, shared: float) -> FittedCamera:
    """Refine a fit to some episodes on all of them, at the rough size."""
    return fit_still(views, fit.camera, fit.lag, ROUGH_BLURS[-1:], 5, shared)


def _likelihoods(views: Sequence[StillView], fit: FittedCamera) -> np.ndarray:
    """(e,) log-likelihood of each episode at the rough size."""
    theta = np.append(np.zeros(LAG), fit.lag)
    return np.array([view.at(fit.camera).equations(theta, ROUGH_BLURS[-1]).likelihood for view in views])


def agreement(view: StillView, fitted: FittedCamera) -> float:
    """Cosine between the flow that a camera predicts and the measured flow of one episode."""
    dot, predicted, measured = view.at(fitted.camera).agreement(fitted.lag, AGREEMENT_BLUR)
    return float(dot / max(np.sqrt(predicted * measured), 1e-9))


def tools_apart(one: CameraTrack, other: CameraTrack, recorded: RecordedView) -> float:
    """Median distance between the tools' places in two cameras' pictures, in widths; those in neither picture do not count."""
    tools = np.concatenate([e.tools[:, :, :3, 3].reshape(-1, 3) for e in recorded.episodes])
    (a, near), (b, near_b) = (project_points(tools, c.K / c.width, c.T_base_camera) for c in (one, other))
    size = (one.height, one.width)
    shown = (inside_image(a * one.width, size) & (near > 0)) | (inside_image(b * one.width, size) & (near_b > 0))
    return float(np.median(np.linalg.norm(a - b, axis=1)[shown])) if shown.any() else np.inf


def unmirrored(camera: CameraTrack) -> CameraTrack:
    """Convert the camera of mirrored pictures to that of the original pictures."""
    flip = np.array([[-1.0, 0.0, camera.width - 1.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    return replace(camera, K=flip @ camera.K)


def tools_in_view(camera: CameraTrack, recorded: RecordedView) -> float:
    """Share of the tools' places that are in the picture."""
    tools = np.concatenate([e.tools[:, :, :3, 3].reshape(-1, 3) for e in recorded.episodes])
    uv, depth = project_points(tools, camera.K, camera.T_base_camera)
    return float((inside_image(uv, (camera.height, camera.width)) & (depth > ROBOT_NEAR_M)).mean())


def lag_by_amounts(recorded: RecordedView) -> float:
    """Frames by which the pictures trail the states, from how much moves in either; 0 where that is not clear."""
    reach = LARGEST_LAG_S / recorded.frame_s
    lags = np.arange(-np.floor(reach / LAG_STEP), np.floor(reach / LAG_STEP) + 1) * LAG_STEP
    totals = np.zeros(len(lags))
    for episode in recorded.episodes:
        seen = np.linalg.norm(near_changes(episode.rough).flow, axis=-1).mean(axis=(1, 2))
        travel = np.linalg.norm(np.diff(episode.points, axis=0), axis=-1).mean(axis=1)
        inner = slice(int(reach), len(seen) - int(reach)) if len(seen) > 4 * reach else slice(None)
        for i, lag in enumerate(lags):
            late = delayed(travel, float(lag))[inner]
            spread = seen[inner].std() * late.std()
            totals[i] += (
                len(late) * ((seen[inner] - seen[inner].mean()) * (late - late.mean())).mean() / max(spread, 1e-9)
            )
    totals /= sum(len(e.gray) for e in recorded.episodes)
    return float(lags[totals.argmax()]) if totals.max() > totals[len(lags) // 2] + LAG_CLEAR else 0.0


def _at(camera: CameraTrack, found: FoundCamera) -> CameraTrack:
    return placed(camera, found.focal * camera.width, found.T_base_camera[None])


def _enlarged(camera: CameraTrack, fine: CameraTrack) -> CameraTrack:
    return placed(fine, camera.K[0, 0] / camera.width * fine.width, camera.T_base_camera)


def _mirrored(motion: MotionOfSteps) -> MotionOfSteps:
    """The same robot before pictures with left and right exchanged."""
    return replace(motion, flow=motion.flow[:, :, ::-1] * np.array([-1.0, 1.0]))


def _distinct(fits: Sequence[FittedCamera], recorded: RecordedView) -> list[FittedCamera]:
    """Those that put the tools elsewhere than every better one, the best first."""
    kept: list[FittedCamera] = []
    for fit in sorted(fits, key=lambda each: -each.likelihood):
        if all(tools_apart(fit.camera, other.camera, recorded) > RIVAL_APART for other in kept):
            kept.append(fit)
    return kept


def shown_by(fitted: FittedCamera, views: Sequence[StillView]) -> np.ndarray:
    """(2, 8) mean displacement of the robot in the picture by each parameter [% of the width]."""
    theta = np.zeros(PARAMETERS)
    return np.mean([view.at(fitted.camera).shown(theta) for view in views], axis=0)
