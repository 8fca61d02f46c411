"""A wrist camera from recorded episodes alone: its pose in the tool's frame and its focal length.

Two kinds of evidence, one estimate. The scene's flow is that of the camera's own motion, which the kinematics know
(`camera_errors.WristView`, at free depths): it shows rotation, focal length and lag, and the place by the lever between camera
and tool. The fingers move in the tool's frame, in which the camera stands still, so they are compared as the arms are before
a still camera (`camera_errors.StillView`): they show where the tool is in the picture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from worldline_core.calibration.camera_errors import (
    HAND_REACH_M,
    LAG,
    PARAMETERS,
    Equations,
    StillView,
    WristView,
)
from worldline_core.calibration.estimate.recordings import RecordedView, ViewOfEpisode, certainty
from worldline_core.calibration.estimate.refine import LAG_PRIOR, FittedCamera, climb
from worldline_core.calibration.evidence import MIN_OPENING_STEP
from worldline_core.calibration.observation import tool_travel
from worldline_core.data.episodes.episode import CameraTrack
from worldline_core.geometry.transforms import rigid_inverse

AT_REST_M = 0.012
"""Travel of a tool in a step in which the fingers' own flow is seen, unhidden by the scene's."""
MOUNT_PRIOR = np.array([0.25] * 3 + [0.04] * 3)
"""Standard deviations from a described mount [rad, m]."""
WRIST_FOCALS = (0.5, 0.75, 1.1)
"""Starts, in widths of the picture: 90, 67 and 49 degrees across."""
WRIST_FOCAL_PRIOR = 0.5
ROUNDS, BLURS = 8, (1.8, 1.0)


@dataclass(frozen=True, eq=False)
class WristEvidence:
    """One episode's evidence of a camera whose pose is that in the tool's frame."""

    tools: np.ndarray
    scene: WristView
    fingers: StillView | None
    finger_steps: int

    def agreement(self, fitted: FittedCamera) -> float:
        """Share of the scene's flow that a camera explains, by the logarithms of errors; NaN where nothing is seen."""
        carried = replace(fitted.camera, T_base_camera=self.tools @ fitted.camera.T_base_camera)
        left, none = self.scene.at(carried).agreement(fitted.lag)
        return 1.0 - float(left / none) if none > 0 else float("nan")

    def at(self, camera: CameraTrack, lag: float, blur: float) -> Equations:
        theta = np.zeros(PARAMETERS)
        theta[LAG] = lag
        carried = replace(camera, T_base_camera=self.tools @ camera.T_base_camera)
        found = self.scene.at(carried).equations(theta, blur)
        if self.fingers is None:
            return found
        # The pictures of the fingers have the size of the scene's times FINE: angles and metres are the same.
        size = self.fingers.camera
        K = size.K.copy()
        K[0, 0] = K[1, 1] = camera.K[0, 0] / camera.width * size.width
        other = self.fingers.at(replace(size, K=K, T_base_camera=camera.T_base_camera)).equations(theta, blur)
        return Equations(
            found.information + other.information, found.gradient + other.gradient, found.likelihood + other.likelihood
        )


def wrist_evidence(recorded: RecordedView, arm: int, start: CameraTrack) -> list[WristEvidence]:
    """The evidence of each episode; cells near the hand, as seen from `start`, are left out of the scene."""
    return [_evidence(episode, recorded, arm, start) for episode in recorded.episodes]


def _evidence(episode: ViewOfEpisode, recorded: RecordedView, arm: int, start: CameraTrack) -> WristEvidence:
    tools = episode.tools[:, arm]
    T_tool_base = rigid_inverse(tools)
    distance = np.linalg.norm(episode.points - tools[:, None, :3, 3], axis=-1)
    near = np.median(distance, axis=0) < HAND_REACH_M
    hand = episode.points[:, near]
    carried = replace(start, T_base_camera=tools @ start.T_base_camera)
    scene = WristView(carried, episode.rough_gray, episode.rough, hand, episode.radii[near])
    fingers, moves = None, np.zeros(0, dtype=bool)
    if episode.gripper is not None:
        moves = np.abs(np.diff(episode.gripper[:, arm])) > MIN_OPENING_STEP
        moves &= tool_travel(episode.tools)[:, arm] < AT_REST_M
        if moves.any():
            in_tool = np.einsum("nij,npj->npi", T_tool_base[:, :3, :3], hand) + T_tool_base[:, None, :3, 3]
            camera = recorded.unknown_camera(fine=True)
            fingers = StillView(camera, in_tool, episode.radii[near], episode.fine, certainty(episode.fine))
            fingers.measured[~moves] = 0.0
    return WristEvidence(tools, scene, fingers, int(moves.sum()))


@dataclass(frozen=True, eq=False)
class WristCamera:
    """The result for one wrist view: poses are in the tool's frame.

    Attributes:
        agreements: (e,) of each episode with the camera of the half that it does not belong to; NaN where it shows nothing.
        fingers: number of steps in which the fingers' own motion is seen.
    """

    fitted: FittedCamera
    halves: tuple[FittedCamera, ...]
    agreements: np.ndarray
    fingers: int


def estimate_wrist(recorded: RecordedView, arm: int, T_tool_mount: np.ndarray) -> WristCamera:
    """The camera of a wrist view, from where the description mounts it about; its focal length is not known at all."""
    starts = [mounted(recorded, T_tool_mount, focal) for focal in WRIST_FOCALS]
    evidence = wrist_evidence(recorded, arm, starts[1])
    few = evidence[:: max(1, len(evidence) // 5)]
    rough = [fit_wrist(few, start, 0.0, start) for start in starts]
    best = max(rough, key=lambda fit: fit.likelihood)
    prior_at = starts[1]
    # Cells that the hand covers are known better now.
    evidence = wrist_evidence(recorded, arm, best.camera)
    best = fit_wrist(evidence, best.camera, best.lag, prior_at)
    halves = tuple(fit_wrist(evidence[i::2], best.camera, best.lag, prior_at) for i in (0, 1))
    agreements = np.array([each.agreement(halves[1 - i % 2]) for i, each in enumerate(evidence)])
    return WristCamera(best, halves, agreements, sum(each.finger_steps for each in evidence))


def mounted(recorded: RecordedView, T_tool_camera: np.ndarray, focal: float) -> CameraTrack:
    """A camera at the rough size of pictures; focal length in widths."""
    camera = recorded.unknown_camera(fine=False)
    K = camera.K.copy()
    K[0, 0] = K[1, 1] = focal * camera.width
    return replace(camera, K=K, T_base_camera=T_tool_camera[None])


def fit_wrist(evidence: Sequence[WristEvidence], start: CameraTrack, lag: float, prior_at: CameraTrack) -> FittedCamera:
    """The camera that explains all episodes best from a start, with the prior of its pose around another."""
    return climb(lambda camera, lag, blur: _equations(evidence, camera, lag, blur, prior_at), start, lag, BLURS, ROUNDS)


def _equations(
    evidence: Sequence[WristEvidence],
    camera: CameraTrack,
    lag: float,
    blur: float,
    prior_at: CameraTrack,
) -> Equations:
    """Normal equations of all episodes at a camera, with the priors."""
    found = [each.at(camera, lag, blur) for each in evidence]
    information = sum((each.information for each in found), np.zeros((PARAMETERS, PARAMETERS)))
    gradient = sum((each.gradient for each in found), np.zeros(PARAMETERS))
    likelihood = sum(each.likelihood for each in found)
    apart = rigid_inverse(camera.T_base_camera)[0] @ prior_at.T_base_camera[0]  # towards the prior
    towards = np.concatenate([cv2.Rodrigues(apart[:3, :3])[0][:, 0], apart[:3, 3]])
    focal = float(np.log(camera.K[0, 0] / prior_at.K[0, 0]))
    towards = np.append(towards, [-focal, -lag])
    weight = np.append(MOUNT_PRIOR, [WRIST_FOCAL_PRIOR, LAG_PRIOR]) ** -2.0
    return Equations(
        information + np.diag(weight), gradient + weight * towards, likelihood - float(weight @ towards**2) / 2
    )
