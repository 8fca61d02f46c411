"""By how much is a camera off? Rotation, place, focal length, principal point and lag of each view, with uncertainty.

Each kind of error is estimated as if it were the only one, because several look alike in pictures; what is named is the
kind that explains most. `combined` takes the estimates of many episodes together, `standing_out` says which are findings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from worldline_core.calibration.diagnosis import (
    CalibrationDoctorConfig,
    Diagnosis,
    Residual,
    ResidualLimits,
    SetDiagnosis,
)
from worldline_core.calibration.image_evidence import observable_views
from worldline_core.calibration.motion_fit import PARAMETERS, Equations, StillView, WristView, moved_camera
from worldline_core.calibration.observation import Motion, Observation
from worldline_core.calibration.reading import Reading
from worldline_core.data.episodes.episode import CameraTrack


@dataclass(frozen=True)
class Kind:
    """One kind of error.

    Attributes:
        parameters: its place among the PARAMETERS.
        unit, scale: what is reported, and the factor to it from radians, metres or shares. All that follows is in this unit.
        prior: standard deviation of each parameter before anything was measured.
        usual: typical error of a camera that was bumped or badly calibrated.
        linear: an estimate from the fine maps is final up to this size; beyond it the equations are solved again there.
        near: beyond this size the coarse maps are solved first.
        shared_still, shared_wrist: standard deviation of the error that all episodes of a source have in common, because
            the robot's shape is simplified and flow is measured too short. More episodes do not reduce it.
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

    def solved(self, equations: Equations, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Information (k, k) on these parameters alone, and the step (k,) to their best values."""
        prior = (self.scale / self.prior) ** 2
        information = equations.information[self.parameters, self.parameters]
        gradient = equations.gradient[self.parameters] - prior * theta[self.parameters]
        return information, np.linalg.solve(information + prior * np.eye(len(gradient)), gradient)


KINDS = {
    "rotation": Kind(slice(0, 3), "deg", 180 / np.pi, 15.0, 3.0, 1.2, 1.5, 0.35, 1.5),
    "translation": Kind(slice(3, 6), "mm", 1e3, 300.0, 30.0, 25.0, 30.0, 10.0, 50.0),
    "focal length": Kind(slice(6, 7), "%", 1e2, 30.0, 5.0, 0.7, 4.0, 0.5, 4.0),
    "principal point": Kind(slice(7, 9), "%", 1e2, 20.0, 2.0, 2.0, 2.5, 0.7, 3.0),
    "lag": Kind(slice(9, 10), "frames", 1.0, 3.0, 1.0, 0.3, 0.3, 0.08, 0.2),
}
HAND_REACH_M = 0.2
COARSE_CELLS, FINE_CELLS = 1.5, 0.7
"""Blur of the coarse and of the fine maps, in cells."""
SHAPE_UNKNOWN = 12.0
"""Factor on the uncertainty of the robot's shape where only tool poses are recorded: the arm behind the hand is unknown."""
FEWEST_TOGETHER = 5
"""From so many episodes on, their scatter says how certain they are together."""
ALIKE_SHARE = 0.5
"""Kinds of error that gain at least this share of the best gain cannot be told apart."""
OUTLIER_DEVIATIONS = 3.0
"""An episode so many standard deviations from the others has half its weight."""


def with_residuals(
    diagnosis: Diagnosis, observation: Observation, reading: Reading, config: CalibrationDoctorConfig
) -> Diagnosis:
    """A diagnosis with the residuals under its reading; a consistent one whose camera is found off is `off`."""
    residuals = estimate_residuals(observation, reading, config)
    off = standing_out(residuals, config.off_alone)
    verdict = "off" if off and diagnosis.verdict == "consistent" else diagnosis.verdict
    return replace(diagnosis, verdict=verdict, residuals=residuals, off=off)


def with_residuals_together(
    found: SetDiagnosis, diagnoses: Sequence[Diagnosis], config: CalibrationDoctorConfig
) -> SetDiagnosis:
    """The same for a source, from the episodes that were read as the source is."""
    alike = {d.episode_id: d.residuals for d in diagnoses if d.best.conventions == found.best.conventions}
    residuals = combined(list(alike.values()))
    off = standing_out(residuals, config.off_together if len(alike) >= FEWEST_TOGETHER else config.off_alone)
    verdict = "off" if off and found.verdict == "consistent" else found.verdict
    return replace(found, verdict=verdict, residuals=residuals, off=off)


def estimate_residuals(
    observation: Observation, reading: Reading, config: CalibrationDoctorConfig
) -> tuple[Residual, ...]:
    """The estimated error of each kind for every view whose pictures show it, under one reading of the conventions."""
    states, images = reading.steps(observation.num_images)
    frames, pictures = slice(states.start, states.stop + 1), slice(images.start, images.stop + 1)
    wrists = {arm.wrist_view: i for i, arm in enumerate(observation.arms)}
    found: list[Residual] = []
    for view in observable_views(observation, config):
        camera, motion = reading.cameras[view], observation.motion(view)
        motion = Motion(motion.flow[images], motion.change[images], motion.texture[images])
        points = reading.points[frames]
        if view not in wrists:
            shape = 1.0 if reading.whole_arms else SHAPE_UNKNOWN
            found += _of_view(view, StillView(camera, points, reading.radii, motion), shape)
        elif camera.moving:
            tool = reading.tools[frames, None, wrists[view], :3, 3]
            near = np.median(np.linalg.norm(points - tool, axis=-1), axis=0) < HAND_REACH_M
            camera = replace(camera, T_base_camera=camera.T_base_camera[frames])
            hand, radii = points[:, near], reading.radii[near]
            found += _of_view(view, WristView(camera, observation.gray[view][pictures], motion, hand, radii))
    return tuple(found)


def _of_view(view: str, evidence: StillView | WristView, shape: float = 1.0) -> list[Residual]:
    """The residuals of one view. Where an error is large, the equations are solved again at the corrected camera.

    Args:
        shape: factor on the uncertainty of the robot's shape in a view that stands still.
    """
    start = np.zeros(PARAMETERS)
    fine, coarse, found = evidence.equations(start, FINE_CELLS), None, []
    for name, kind in KINDS.items():
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
        found.append(Residual(view, name, kind.unit, estimate, information, gain, kind.prior, shared))
    return found


def combined(episodes: Sequence[Sequence[Residual]]) -> tuple[Residual, ...]:
    """Residuals of one source from those of its episodes; outliers count less, and scatter widens the interval."""
    groups: dict[tuple[str, str], list[Residual]] = {}
    for residual in (residual for residuals in episodes for residual in residuals):
        groups.setdefault((residual.view, residual.kind), []).append(residual)
    found = []
    for members in groups.values():
        first = members[0]
        estimates, weights = np.stack([m.estimate for m in members]), np.stack([m.posterior for m in members])
        total, mean = weights.sum(axis=0), np.median(estimates, axis=0)
        apart, trust = np.zeros(len(members)), np.ones(len(members))
        for _ in range(3):
            apart = np.einsum("ei,eij,ej->e", estimates - mean, weights, estimates - mean) / len(mean)
            trust = 1 / (1 + apart / OUTLIER_DEVIATIONS**2)
            total = np.einsum("e,eij->ij", trust, weights)
            mean = np.linalg.solve(total, np.einsum("e,eij,ej->i", trust, weights, estimates))
        scatter = max(1.0, float((trust * apart).sum() / max(trust.sum() - 1, 1.0)))
        together = replace(first, estimate=mean, information=total / scatter)
        found.append(replace(together, gain=together.deviations**2 / 2))
    return tuple(found)


def standing_out(residuals: Sequence[Residual], limits: ResidualLimits) -> tuple[Residual, ...]:
    """At most one error for each view, of those that are certain and large enough: among the kinds that explain the
    pictures about equally well, the one that is smallest against its usual size."""
    found: dict[str, list[Residual]] = {}
    for residual in residuals:
        enough = residual.size > getattr(limits, residual.kind.replace(" ", "_")) and residual.gain > 0
        if enough and residual.deviations > limits.deviations:
            found.setdefault(residual.view, []).append(residual)
    off = []
    for kinds in found.values():
        best = max(residual.gain for residual in kinds)
        alike = [residual for residual in kinds if residual.gain >= ALIKE_SHARE * best]
        off.append(min(alike, key=lambda residual: residual.size / KINDS[residual.kind].usual))
    return tuple(off)


def corrected_camera(camera: CameraTrack, residual: Residual) -> CameraTrack:
    """The camera with the estimated error removed."""
    kind, theta = KINDS[residual.kind], np.zeros(PARAMETERS)
    theta[kind.parameters] = np.asarray(residual.estimate) / kind.scale
    return moved_camera(camera, theta)


def consistent_text(residuals: Sequence[Residual]) -> str:
    """The largest rotation of a camera that could have gone unseen, over the views."""
    turns = [residual.within for residual in residuals if residual.kind == "rotation"]
    return f"consistent within {max(turns):.1f} deg" if turns else "consistent, but no picture says within what"


def off_text(residual: Residual) -> str:
    """Camera, kind, size and interval of an error."""
    return f"{residual.view} {residual.kind} {residual.size:.1f} ± {residual.error:.1f} {residual.unit}"


def bounds_lines(residuals: Sequence[Residual]) -> list[str]:
    """A line a view: how large an error of each kind could have gone unseen."""
    lines = []
    for view in dict.fromkeys(residual.view for residual in residuals):
        bounds = [f"{r.kind} {r.within:.1f} {r.unit}" for r in residuals if r.view == view]
        lines.append(f"{view} within: {', '.join(bounds)}")
    return lines
