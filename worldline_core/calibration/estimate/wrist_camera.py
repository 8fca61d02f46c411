"""A wrist camera from recorded episodes alone: its pose in the tool's frame and its focal length.

Two kinds of evidence, one estimate. The scene's flow is that of the camera's own motion, which the kinematics know
(`camera_errors.WristView`, at free depths): it shows rotation, focal length and lag, and the place by the lever between camera
and tool. The fingers move in the tool's frame, in which the camera stands still, so they are compared as the arms are before
a still camera (`camera_errors.StillView`): they show where the tool is in the picture.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import cv2
import numpy as np

from worldline_core.calibration.camera_errors import (
    HAND_REACH_M,
    LAG,
    NEAR_M,
    Equations,
    StillView,
    WristView,
    covered_cells,
)
from worldline_core.calibration.estimate.recordings import RecordedView, ViewOfEpisode, certainty, placed
from worldline_core.calibration.estimate.refine import LAG_PRIOR, FittedCamera, climb, inflation, total
from worldline_core.calibration.estimate.still_camera import lag_by_amounts
from worldline_core.calibration.evidence import MIN_OPENING_STEP
from worldline_core.calibration.observation import tool_travel
from worldline_core.data.episodes.episode import CameraTrack
from worldline_core.geometry.cameras import project_points
from worldline_core.geometry.transforms import pose_from_rotation, rigid_inverse, rotation_angle
from worldline_core.pictures import evenly_spaced

BEHIND_M, BESIDE_M = (0.06, 0.14), (0.05, 0.1)
"""Places of the camera: behind the tool along the hand's axis, and beside that axis."""
TURNS, ROLLS = 8, 4
LOOKS_AHEAD_M = 0.03
"""It looks at a point this far ahead of the tool."""
FRAMES_OF_SIGHT, HIDDEN_BEHIND_M, STILL_M = 6, 0.005, 1e-3
"""Frames in which it is looked at what the hand hides of itself, how far behind another point one is hidden, and the palm's motion."""
AT_REST_M = 0.012
"""Travel of a tool in a step in which the fingers' own flow is seen, unhidden by the scene's."""
MOUNT_PRIOR, SEARCHED_PRIOR = np.array([0.25] * 3 + [0.04] * 3), np.array([1.0] * 3 + [0.05] * 3)
"""Standard deviations from a described mount, and from one that was searched [rad, m]."""
WRIST_FOCALS, SEARCHED_FOCALS = (0.5, 0.75, 1.1), (0.5, 0.85)
"""Starts, in widths of the picture: 90, 67 and 49 degrees across; and of a search, in which every mount is seen with each."""
LEAST_WRIST_AGREEMENT, USUAL_WRIST_AGREEMENT = 0.3, 0.7
"""Shares of the scene's flow, in the median of held-out episodes, that a camera must explain, and that it explains in usual sets."""
EPISODES_OF_STARTS, FOLLOWED = 5, 6
"""Episodes in which starts are compared, and how many starts of a search are followed."""
MOST_COVERED, BLIND = 0.7, pose_from_rotation(np.array([0.0, 0.0, 9.0]), np.eye(3))
"""Share of the picture above which a hand covers too much of it to judge a mount; a camera far ahead of the hand, which it never sees."""
RIVAL_APART, RIVAL_TURNED = 0.05, 0.15
"""A rival shows the tool elsewhere [widths], or is turned against the best camera [rad]."""
USUAL_WRIST_FOCAL, WRIST_FOCAL_PRIOR = 0.6, 0.4
"""Focal length of usual wrist cameras in widths of the picture (80 degrees), and standard deviation of its logarithm."""
SHARED_WRIST_CAMERA, SHARED_WITH_FINE_HAND, FINE_HAND_M = 4.0, 2.0, 0.006
"""Variance that more episodes do not reduce, in variances of one episode (held things hide fingers, a hand is drawn as spheres), and
of a hand of spheres that are smaller than this; from recordings whose cameras are known."""
ZOOMS = (0.75, 1.33)
"""Focal length and distance hide each other's errors: cameras this much longer and farther are tried, too."""
ROUNDS, BLURS = 8, (1.8, 1.0)


@dataclass(frozen=True, eq=False)
class WristEvidence:
    """One episode's evidence of a camera whose pose is that in the tool's frame. `shared`: variance that more episodes do not reduce."""

    tools: np.ndarray
    scene: WristView
    fingers: StillView | None
    finger_steps: int
    shared: float

    def agreement(self, camera: CameraTrack, lag: float) -> float:
        """Share of the scene's flow that a camera explains, by the logarithms of errors; NaN where nothing is seen."""
        left, none = self.scene_errors(camera, lag)
        return 1.0 - float(left / none) if none > 0 else float("nan")

    def scene_errors(self, camera: CameraTrack, lag: float) -> np.ndarray:
        """(2,) sums of the logarithms of errors of the scene's flow, as a camera explains it and unexplained."""
        carried = replace(camera, T_base_camera=self.tools @ camera.T_base_camera)
        return self.scene.at(carried).agreement(lag)

    def at(self, camera: CameraTrack, lag: float, blur: float) -> Equations:
        theta = np.append(np.zeros(LAG), lag)
        carried = replace(camera, T_base_camera=self.tools @ camera.T_base_camera)
        found = self.scene.at(carried).equations(theta, blur)
        if self.fingers is None:
            return found
        # The pictures of the fingers have the size of the scene's times FINE: angles and metres are the same.
        size = self.fingers.camera
        fine = placed(size, camera.K[0, 0] / camera.width * size.width, camera.T_base_camera)
        return total([found, self.fingers.at(fine).equations(theta, blur)])


def wrist_evidence(recorded: RecordedView, arm: int, seen_from: CameraTrack) -> list[WristEvidence]:
    """The evidence of each episode, without what the hand hides from a camera."""
    return [_evidence(episode, recorded, arm, seen_from) for episode in recorded.episodes]


def _evidence(episode: ViewOfEpisode, recorded: RecordedView, arm: int, seen_from: CameraTrack) -> WristEvidence:
    tools = episode.tools[:, arm]
    near = _near_hand(episode, arm)
    hand, radii = episode.points[:, near], episode.radii[near]
    carried = replace(seen_from, T_base_camera=tools @ seen_from.T_base_camera)
    scene = WristView(carried, episode.rough_gray, episode.rough, hand, radii)
    fingers, moves = None, np.zeros(0, dtype=bool)
    if episode.gripper is not None:
        moves = np.abs(np.diff(episode.gripper[:, arm])) > MIN_OPENING_STEP
        moves &= tool_travel(episode.tools)[:, arm] < AT_REST_M
        if moves.any():
            points = _in_tool(hand, tools)
            seen = _seen(points, radii, seen_from)
            still = recorded.unknown_camera(fine=True)
            fingers = StillView(still, points[:, seen], radii[seen], episode.fine, certainty(episode.fine)).only(moves)
    shared = SHARED_WITH_FINE_HAND if len(radii) and np.median(radii) < FINE_HAND_M else SHARED_WRIST_CAMERA
    return WristEvidence(tools, scene, fingers, int(moves.sum()), shared)


def _near_hand(episode: ViewOfEpisode, arm: int) -> np.ndarray:
    """(p,) bool: which points of the robot belong to the hand."""
    distance = np.linalg.norm(episode.points - episode.tools[:, arm, None, :3, 3], axis=-1)
    return np.median(distance, axis=0) < HAND_REACH_M


def _in_tool(points: np.ndarray, tools: np.ndarray) -> np.ndarray:
    """Points (n, p, 3) in the frames of tools (n, 4, 4)."""
    T_tool_base = rigid_inverse(tools)
    return np.einsum("nij,npj->npi", T_tool_base[:, :3, :3], points) + T_tool_base[:, None, :3, 3]


def _seen(points: np.ndarray, radii: np.ndarray, camera: CameraTrack) -> np.ndarray:
    """(p,) bool: which of the hand's points (n, p, 3) are seen from a camera in most frames: no other point hides them, and the
    palm does not, which is what stands still in the tool's frame.
    """
    palm = np.ptp(points, axis=0).max(axis=-1) < STILL_M
    seen = np.zeros(len(radii))
    chosen = points[evenly_spaced(len(points), FRAMES_OF_SIGHT)]
    for hand in chosen:
        uv, depth = project_points(hand, camera.K, camera.T_base_camera)
        reach = np.maximum(1.0, camera.K[0, 0] * radii / np.maximum(depth, NEAR_M))
        beside = np.linalg.norm(uv[:, None] - uv, axis=-1) < reach
        nearer = (depth > NEAR_M) & (depth < depth[:, None] - HIDDEN_BEHIND_M)
        hidden = (beside & nearer).any(axis=1)
        for i in np.flatnonzero(~hidden & ~palm):
            # Few points stand for the palm: its surface is as near as their discs reach.
            before = uv[palm & (depth > NEAR_M) & (depth - radii < depth[i] - HIDDEN_BEHIND_M)].astype(np.float32)
            hidden[i] = len(before) > 2 and cv2.pointPolygonTest(cv2.convexHull(before), uv[i].tolist(), False) >= 0
        seen += ~hidden
    return seen > len(chosen) / 2


@dataclass(frozen=True, eq=False)
class WristCamera:
    """The result for one wrist view: poses are in the tool's frame.

    Attributes:
        agreements: (e,) of each episode with the camera of the half that it does not belong to; NaN where it shows nothing.
        own: equations of each episode alone at the fitted camera.
        fingers: number of steps in which the fingers' own motion is seen.
        shared: variance that more episodes do not reduce, in variances of one episode.
        searched: whether the mount was searched, not described.
        rival: the best camera of a search that is mounted otherwise.
        rival_agreements: (e,) of each episode with the rival; NaN as above.
        mirrored_agreement: the median of some episodes whose pictures are mirrored; 0 where the pictures agree as usual.
    """

    fitted: FittedCamera
    halves: tuple[FittedCamera, ...]
    agreements: np.ndarray
    own: tuple[Equations, ...]
    fingers: int
    shared: float
    searched: bool = False
    rival: FittedCamera | None = None
    rival_agreements: np.ndarray | None = None
    mirrored_agreement: float = 0.0

    @property
    def agreement(self) -> float:
        """The median of the episodes that show something; 0 where none does."""
        return _median(self.agreements)


def _median(agreements: np.ndarray) -> float:
    known = agreements[np.isfinite(agreements)]
    return float(np.median(known)) if len(known) else 0.0


def estimate_wrist(recorded: RecordedView, arm: int, T_tool_mount: np.ndarray | None) -> WristCamera:
    """The camera of a wrist view, and how well its pictures fit mirrored where they agree less than usual."""
    found = _estimate_wrist(recorded, arm, T_tool_mount)
    if found.agreement >= USUAL_WRIST_AGREEMENT:
        return found
    few = _few(recorded).mirrored()
    start = found.fitted.camera if T_tool_mount is None else mounted(recorded, T_tool_mount, WRIST_FOCALS[1])
    evidence = wrist_evidence(few, arm, start)
    fit = fit_wrist(evidence, start, found.fitted.lag, start, MOUNT_PRIOR)
    return replace(found, mirrored_agreement=_median(np.array([e.agreement(fit.camera, fit.lag) for e in evidence])))


def _few(recorded: RecordedView) -> RecordedView:
    return recorded.of(recorded.episodes[:: max(1, len(recorded.episodes) // EPISODES_OF_STARTS)])


def _estimate_wrist(recorded: RecordedView, arm: int, T_tool_mount: np.ndarray | None) -> WristCamera:
    """The camera of a wrist view, from where the description mounts it about; from all around the hand where it says nothing,
    or what it says does not fit. The focal length is not known at all.
    """
    lag = lag_by_amounts(recorded)
    few = _few(recorded)
    if T_tool_mount is not None:
        starts = [mounted(recorded, T_tool_mount, focal) for focal in WRIST_FOCALS]
        evidence = wrist_evidence(few, arm, starts[1])
        # From a lag of frames, the nearest optimum is another one.
        rough = [
            fit_wrist(evidence, s, late, starts[1], MOUNT_PRIOR) for s in starts for late in dict.fromkeys((0.0, lag))
        ]
        best = max(rough, key=lambda fit: fit.likelihood)
        found = _made_exact(recorded, arm, best, starts[1])
        if found.agreement >= LEAST_WRIST_AGREEMENT:
            return found
    starts = _searched_starts(few, arm, lag)
    rough = [(each, fit_wrist(each, start, lag, start, SEARCHED_PRIOR)) for start, each in starts]
    distinct = _distinct(rough)
    # The hand hides something else from each of them: they are compared by what the first one sees, in all episodes.
    common = wrist_evidence(recorded, arm, distinct[0].camera)
    fits = [fit_wrist(common, fit.camera, fit.lag, fit.camera, SEARCHED_PRIOR) for fit in distinct]
    fits.sort(key=lambda fit: -fit.likelihood)
    rival = next((fit for fit in fits[1:] if _apart(fit.camera, fits[0].camera)), None)
    followed = fits[:1] if rival is None else [fits[0], rival]
    exact = [_made_exact(recorded, arm, fit, None) for fit in followed]
    # What one of them hides of the scene decides too much of that likelihood: episodes that are held out have the last word.
    found, *others = sorted(exact, key=lambda each: -each.agreement)
    apart = [other for other in others if _apart(other.fitted.camera, found.fitted.camera)]
    if not apart:
        return replace(found, searched=True)
    return replace(found, searched=True, rival=apart[0].fitted, rival_agreements=apart[0].agreements)


def _made_exact(recorded: RecordedView, arm: int, rough: FittedCamera, mount: CameraTrack | None) -> WristCamera:
    """A rough camera fitted to all episodes, and to each half of them; cells that the hand hides are known now.

    Args:
        mount: the camera as the description mounts it; None where it was searched.
    """
    prior = SEARCHED_PRIOR if mount is None else MOUNT_PRIOR
    evidence = wrist_evidence(_few(recorded), arm, rough.camera)
    starts = [rough.camera, *(_zoomed(rough.camera, factor) for factor in ZOOMS)]
    zoomed = [fit_wrist(evidence, start, rough.lag, mount or start, prior) for start in starts]
    rough = max(zoomed, key=lambda fit: fit.likelihood)
    prior_at = mount or rough.camera
    evidence = wrist_evidence(recorded, arm, rough.camera)
    best = fit_wrist(evidence, rough.camera, rough.lag, prior_at, prior)
    halves = tuple(fit_wrist(evidence[i::2], best.camera, best.lag, prior_at, prior) for i in (0, 1))
    others = [halves[1 - i % 2] for i in range(len(evidence))]
    agreements = np.array([e.agreement(other.camera, other.lag) for e, other in zip(evidence, others, strict=True)])
    own = tuple(each.at(best.camera, best.lag, BLURS[-1]) for each in evidence)
    steps = sum(each.finger_steps for each in evidence)
    return WristCamera(best, halves, agreements, own, steps, evidence[0].shared)


def _zoomed(camera: CameraTrack, factor: float) -> CameraTrack:
    """A camera of a longer lens that is as much farther from the tool, which it shows at the same size."""
    back = np.eye(4)
    back[2, 3] = (1 - factor) * rigid_inverse(camera.T_base_camera)[0, 2, 3]
    return placed(camera, factor * camera.K[0, 0], camera.T_base_camera @ back)


def _searched_starts(few: RecordedView, arm: int, lag: float) -> list[tuple[CameraTrack, list[WristEvidence]]]:
    """The cameras around the hand that explain the scene's flow best, the best first, and what they see."""
    blind = mounted(few, BLIND, 1.0)  # nothing of the hand is hidden from it
    evidence = wrist_evidence(few, arm, blind)
    near = _near_hand(few.episodes[0], arm)
    hands = [_in_tool(e.points[:, near], e.tools[:, arm]).mean(axis=0) for e in few.episodes]
    hand, radii = np.mean(hands, axis=0), few.episodes[0].radii[near]
    cells = few.episodes[0].rough.change.shape[1:]
    scored = []
    for T in mounts_around(hand):
        for focal in SEARCHED_FOCALS:
            camera = mounted(few, T, focal)
            twice = replace(camera, T_base_camera=np.repeat(camera.T_base_camera, 2, axis=0))
            covered = covered_cells(twice, np.stack([hand, hand]), radii, (1, *cells))[0]
            seen = [replace(each, scene=each.scene.without(covered)) for each in evidence]
            scored.append((covered.mean() > MOST_COVERED, -explained(seen, camera, lag), camera))
    best = sorted(scored, key=lambda each: each[:2])[:FOLLOWED]
    return [(camera, wrist_evidence(few, arm, camera)) for *_, camera in best]


def explained(evidence: Sequence[WristEvidence], camera: CameraTrack, lag: float) -> float:
    """Share of the scene's flow of all episodes together that a camera explains."""
    left, none = np.sum([each.scene_errors(camera, lag) for each in evidence], axis=0)
    return 1.0 - float(left / none) if none > 0 else 0.0


def _distinct(rough: Sequence[tuple[list[WristEvidence], FittedCamera]]) -> list[FittedCamera]:
    """Cameras that are mounted apart, those that explain most of what they see first."""
    kept: list[FittedCamera] = []
    for _, fit in sorted(rough, key=lambda each: -explained(each[0], each[1].camera, each[1].lag)):
        if all(_apart(fit.camera, other.camera) for other in kept):
            kept.append(fit)
    return kept


def _apart(one: CameraTrack, other: CameraTrack) -> bool:
    places = [project_points(np.zeros((1, 3)), c.K, c.T_base_camera)[0][0] / c.width for c in (one, other)]
    turned = one.T_base_camera[0, :3, :3].T @ other.T_base_camera[0, :3, :3]
    return bool(np.linalg.norm(places[0] - places[1]) > RIVAL_APART or rotation_angle(turned) > RIVAL_TURNED)


def mounted(recorded: RecordedView, T_tool_camera: np.ndarray, focal: float) -> CameraTrack:
    """A camera at the rough size of pictures; focal length in widths."""
    camera = recorded.unknown_camera(fine=False)
    return placed(camera, focal * camera.width, T_tool_camera[None])


def fit_wrist(
    evidence: Sequence[WristEvidence], start: CameraTrack, lag: float, prior_at: CameraTrack, prior: np.ndarray
) -> FittedCamera:
    """The camera that explains all episodes best from a start; `prior` are the standard deviations of its pose from another's."""
    found = climb(
        lambda camera, lag, blur: _equations(evidence, camera, lag, blur, prior_at, prior), start, lag, BLURS, ROUNDS
    )
    return FittedCamera(*found)


def _equations(
    evidence: Sequence[WristEvidence],
    camera: CameraTrack,
    lag: float,
    blur: float,
    prior_at: CameraTrack,
    prior: np.ndarray,
) -> Equations:
    """Normal equations of all episodes at a camera, with the priors."""
    found = total([each.at(camera, lag, blur) for each in evidence])
    apart = rigid_inverse(camera.T_base_camera)[0] @ prior_at.T_base_camera[0]  # towards the prior
    towards = np.concatenate([cv2.Rodrigues(apart[:3, :3])[0][:, 0], apart[:3, 3]])
    focal = float(np.log(camera.K[0, 0] / camera.width / USUAL_WRIST_FOCAL))
    towards = np.append(towards, [-focal, -lag])
    weight = np.append(prior, [WRIST_FOCAL_PRIOR, LAG_PRIOR]) ** -2.0 * inflation(len(evidence), evidence[0].shared)
    return Equations(
        found.information + np.diag(weight),
        found.gradient + weight * towards,
        found.likelihood - float(weight @ towards**2) / 2,
    )


def mounts_around(hand: np.ndarray) -> Iterator[np.ndarray]:
    """T_tool_camera (4, 4), axes of OpenCV, of cameras beside a hand of points (p, 3) in the tool's frame, which see the tool: starts
    of the estimate where no description says where the camera is mounted.

    The hand points from its middle to the tool, or along the tool's z axis where no point of it is known.
    """
    ahead = -hand.mean(axis=0) if len(hand) else np.array([0.0, 0.0, 1.0])
    ahead /= np.linalg.norm(ahead)
    across = np.cross(ahead, np.eye(3)[np.abs(ahead).argmin()])
    across /= np.linalg.norm(across)
    plane = np.c_[across, np.cross(ahead, across)]
    for behind, beside, turn, roll in product(BEHIND_M, BESIDE_M, range(TURNS), range(ROLLS)):
        outward, down = (
            plane @ (np.cos(angle), np.sin(angle))
            for angle in (2 * np.pi * turn / TURNS, 2 * np.pi * (turn / TURNS + roll / ROLLS))
        )
        eye = beside * outward - behind * ahead
        yield _facing(eye, LOOKS_AHEAD_M * ahead, down)


def _facing(eye: np.ndarray, target: np.ndarray, down: np.ndarray) -> np.ndarray:
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(down, z)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3] = np.c_[x, np.cross(z, x), z, eye]
    return pose
