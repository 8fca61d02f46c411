"""What the calibration doctor is told and what it says: thresholds, diagnoses of episodes and sources, a check's result.

Terms of a score are log-likelihoods: 0 is as a healthy recording typically is, lower is worse.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from worldline_core.config import StrictModel
from worldline_core.data.episodes.conventions import RecordedConventions

VerdictName = Literal["consistent", "off", "explained", "unexplained", "too_little_evidence"]
SetVerdictName = Literal["consistent", "off", "explained", "unexplained", "mixed", "too_little_evidence"]


class Typical(StrictModel):
    """A correlation that healthy recordings reach, and how many independent samples it stands for."""

    value: float = Field(gt=0, lt=1)
    samples: float = Field(gt=0)


class Spread(StrictModel):
    """A correlation that healthy recordings reach, and how much it scatters."""

    value: float = Field(gt=0, lt=1)
    spread: float = Field(gt=0)


class ResidualLimits(StrictModel):
    """From when on an estimated error of a camera is a finding: as large as this, and so many deviations from zero."""

    deviations: float = Field(gt=0)
    rotation: float = Field(gt=0, description="degrees")
    translation: float = Field(gt=0, description="millimetres")
    focal_length: float = Field(gt=0, description="percent")
    principal_point: float = Field(gt=0, description="percent of the image side")
    lag: float = Field(gt=0, description="frames")


class CalibrationDoctorConfig(StrictModel):
    """Lengths in metres, angles in degrees, scores in units of log-likelihood.

    The typical values are medians over the healthy training episodes of the shipped recordings
    (`benchmarks/calibration.py mistakes --typical` prints them); they hold for other recordings as far as these
    resemble them, so the decisions rest on differences between readings.
    """

    search: Literal["always", "when_suspicious"] = Field(
        default="always", description="when_suspicious: try other readings only if the recorded one looks bad"
    )
    min_margin: float = Field(default=2.5, gt=0, description="by which a mistake must beat the recording as written")
    max_gain: float = Field(
        default=20.0, gt=0, description="that one episode can lend to a reading of its whole source"
    )
    min_term: float = Field(
        default=-9.0, lt=0, description="a pose term below this is bad: no healthy recording has one"
    )
    min_flow: float = Field(default=0.6, gt=0, lt=1, description="agreement of arm flow below which it is bad")
    flow_turn_deg: float = Field(
        default=8.0, gt=0, description="spread of the angle between measured and predicted flow"
    )
    max_flow_turn_deg: float = Field(default=25.0, gt=0, description="a larger angle is bad")
    suspicion: float = Field(default=-4.0, lt=0, description="a term below this starts the search")
    complexity: float = Field(default=2.0, ge=0, description="cost of a reading that departs from the contract")
    max_lag_frames: int = Field(default=6, ge=1, le=60)
    samples: float = Field(default=20.0, gt=0, description="independent frames that a hand-eye residual stands for")
    hand_eye_m: float = Field(default=0.002, gt=0, description="hand-eye residual of a camera that is mounted")
    hand_eye_deg: float = Field(default=0.7, gt=0)
    max_hand_eye_m: float = Field(default=0.012, gt=0, description="a larger residual is bad, whatever the reading")
    mount_m: float = Field(default=0.01, gt=0, description="spread of cameras around the stated mount")
    mount_deg: float = Field(default=3.0, gt=0)
    kinematics_m: float = Field(default=0.005, gt=0, description="spread of recorded poses around forward kinematics")
    kinematics_deg: float = Field(default=2.0, gt=0)
    principal_point: float = Field(default=0.03, gt=0, description="spread around the image centre, share of the side")
    max_reach_m: float = Field(default=2.5, gt=0, description="of a tool from its base")
    max_camera_m: float = Field(default=5.0, gt=0, description="of a camera from the base")
    max_wrist_camera_m: float = Field(default=0.5, gt=0, description="of a wrist camera from its tool")
    min_image_pairs: int = Field(default=8, ge=2, description="fewer pictures are no evidence")
    arm_flow: Typical = Typical(value=0.92, samples=20)
    arm_change: Typical = Typical(value=0.74, samples=20)
    tool_flow: Typical = Typical(value=0.96, samples=14)
    tool_change: Typical = Typical(value=0.5, samples=14)
    wrist_flow: Typical = Typical(value=0.55, samples=12)
    wrist_energy: Typical = Typical(value=0.8, samples=8)
    fingers: Spread = Spread(value=0.75, spread=0.4)
    finger_links: Spread = Spread(value=0.5, spread=0.3)
    off_alone: ResidualLimits = Field(
        default=ResidualLimits(
            deviations=5.0, rotation=3.5, translation=80.0, focal_length=9.0, principal_point=7.0, lag=0.6
        ),
        description="for one episode",
    )
    off_together: ResidualLimits = Field(
        default=ResidualLimits(
            deviations=3.0, rotation=1.25, translation=25.0, focal_length=2.2, principal_point=2.0, lag=0.3
        ),
        description="for all episodes of a source",
    )


@dataclass(frozen=True)
class Explanation:
    """One way to read the recording.

    Attributes:
        conventions: how the source would have written its numbers; `apply_conventions` repairs the episode with it.
        score: log-likelihood of everything measured, under this reading; 0 is as a healthy recording typically is,
            lower is worse. Differences between readings of one episode mean something, and add up over episodes.
        evidence: the terms of the score by name ("hand-eye left_wrist", ...); each at most 0.
        other: (name, value) of a mistake that no convention speaks of: ("embodiment", the robot that fits),
            ("wrist_extrinsics", "exchanged").
    """

    conventions: RecordedConventions
    score: float
    evidence: Mapping[str, float]
    other: tuple[str, str] | None = None

    @property
    def departures(self) -> tuple[str, ...]:
        """What is read otherwise than it was written."""
        return self.conventions.departures if self.other is None else (*self.conventions.departures, self.other[0])

    @property
    def mistake(self) -> str:
        """ "none", or what departs: fields of `RecordedConventions` or `other`, joined by "+"."""
        return "+".join(self.departures) or "none"

    @property
    def text(self) -> str:
        """What departs, with values: "camera_axes: opengl, views: [head]"."""
        lines = [line.removeprefix(".") for line in self.conventions.config_lines("")]
        return ", ".join(lines + ([": ".join(self.other)] if self.other is not None else [])) or "as recorded"


@dataclass(frozen=True)
class ViewMeasures:
    """What was measured of one view, as recorded; None where the recording does not let it be measured.

    Attributes:
        hand_eye_m, hand_eye_deg: root mean square deviation of a moving camera from a fixed place in its tool's frame.
        hand_eye_action_m, hand_eye_action_deg: the same against the tool poses of the commands.
        mount_offset_m, mount_offset_deg: from the mount that the embodiment states.
        camera_lag_frames: by how much the camera's poses trail the states (refined below a frame).
        image_lag_frames: by how much the images trail the states.
        in_view_share: share of frames with a tool in the picture and in front of the camera.
        flow_agreement: correlation (-1..1) of measured image motion with the motion that calibration predicts.
        flow_turn_deg: angle by which measured image motion is turned against the predicted one.
        motion_overlap: correlation (-1..1) of the picture's change with the predicted motion of the arms.
        finger_flow: correlation (-1..1) of flow away from the tool's axis with the growth of the gripper's opening.
        principal_point_offset: distance of the principal point from the image's centre, share of the image side.
    """

    view: str
    hand_eye_m: float | None = None
    hand_eye_deg: float | None = None
    hand_eye_action_m: float | None = None
    hand_eye_action_deg: float | None = None
    mount_offset_m: float | None = None
    mount_offset_deg: float | None = None
    camera_lag_frames: float | None = None
    image_lag_frames: float | None = None
    in_view_share: float | None = None
    flow_agreement: float | None = None
    flow_turn_deg: float | None = None
    motion_overlap: float | None = None
    finger_flow: float | None = None
    principal_point_offset: float | None = None


@dataclass(frozen=True, eq=False)
class Residual:
    """By how much one camera is off in one way, if in no other: what to change so that the pictures fit best.

    Attributes:
        kind: rotation, translation (of the camera, in its own frame), focal length, principal point, lag (of the pictures).
        estimate: (k,) in `unit` (% of the focal length, or of the image's sides). information: (k, k) of it.
        gain: log-likelihood of the pictures with it, less that of the recording as written.
        prior: standard deviation of each value before anything is seen. shared: error that more episodes do not reduce.
    """

    view: str
    kind: str
    unit: str
    estimate: np.ndarray
    information: np.ndarray
    gain: float
    prior: float
    shared: float

    @property
    def posterior(self) -> np.ndarray:
        """Information (k, k) with that of the prior."""
        return self.information + np.eye(len(self.estimate)) / self.prior**2

    @property
    def covariance(self) -> np.ndarray:
        return np.linalg.inv(self.posterior) + self.shared**2 * np.eye(len(self.estimate))

    @property
    def size(self) -> float:
        return float(np.linalg.norm(self.estimate))

    @property
    def error(self) -> float:
        """Half of the 95 % interval of the size."""
        along = self.estimate / max(self.size, 1e-12)
        return 1.96 * float(np.sqrt(along @ self.covariance @ along))

    @property
    def within(self) -> float:
        """No error larger than this can have gone unseen (95 %), in whatever direction."""
        return self.size + 1.96 * float(np.sqrt(np.linalg.eigvalsh(self.covariance)[-1]))

    @property
    def deviations(self) -> float:
        """How many standard deviations of a single number are as unlikely as this estimate without an error."""
        distance = self.estimate @ np.linalg.solve(self.covariance, self.estimate)
        from scipy.special import chdtrc, ndtri  # scipy.stats takes a second to import, this a third

        return 0.0 - float(ndtri(max(float(chdtrc(len(self.estimate), distance)), 1e-300) / 2))


@dataclass(frozen=True)
class Diagnosis:
    """One episode.

    Attributes:
        verdict: consistent (as recorded is good), off (`off` names the camera and by how much), explained (`best` names
            the mistake), unexplained (as recorded is bad, and no reading of it is good), too_little_evidence.
        best: the reading to believe; "none" unless the verdict is explained.
        ranked: all readings that were tried, best score first.
        notes: what a person should know besides: what could not be observed, what the cameras follow.
        nearest: of an unexplained episode, the readings that come nearest, and what remains wrong under each.
        residuals: by how much each camera is off under `best`, in each way that the pictures show. off: those that are
            findings.
    """

    episode_id: str
    verdict: VerdictName
    best: Explanation
    ranked: tuple[Explanation, ...]
    measures: tuple[ViewMeasures, ...]
    notes: tuple[str, ...]
    nearest: tuple[str, ...] = ()
    residuals: tuple[Residual, ...] = ()
    off: tuple[Residual, ...] = ()

    @property
    def none(self) -> Explanation:
        """The recording as written."""
        return next(explanation for explanation in self.ranked if explanation.mistake == "none")

    @property
    def margin(self) -> float:
        """How much better the believed reading is than the recording as written."""
        return self.best.score - self.none.score


@dataclass(frozen=True)
class SetDiagnosis:
    """All episodes of one source: the same conventions, so that the evidence adds up.

    Attributes:
        verdict: as of an episode; mixed: the episodes contradict each other, no line is right for all of them.
        ranked: readings with the scores summed over episodes.
        votes: verdicts and mistakes of the single episodes, counted.
        nearest: of a source without an explanation, the readings that come nearest, and under how many episodes.
        config_lines: what the source's configuration must say, in place of what it says now.
        residuals, off: as of an episode, estimated from all of them.
    """

    source: str
    num_episodes: int
    verdict: SetVerdictName
    best: Explanation
    ranked: tuple[Explanation, ...]
    votes: Mapping[str, int]
    notes: tuple[str, ...]
    config_lines: tuple[str, ...] = ()
    nearest: tuple[str, ...] = ()
    residuals: tuple[Residual, ...] = ()
    off: tuple[Residual, ...] = ()


@dataclass(frozen=True)
class Finding:
    """What was found of one episode: a diagnosis, or why there is none.

    Attributes:
        reason: a quarantine reason code of an episode that cannot be read, with `detail`; None of one that can.
        config_lines: what the source's configuration must say, in place of what it says now.
        picture: path relative to the output folder.
        notes: of the check itself, beside the diagnosis' own.
    """

    episode_id: str
    source: str
    diagnosis: Diagnosis | None
    reason: str | None = None
    detail: str = ""
    config_lines: tuple[str, ...] = ()
    picture: str | None = None
    notes: tuple[str, ...] = ()

    @property
    def verdict(self) -> str:
        return "unreadable" if self.diagnosis is None else self.diagnosis.verdict


@dataclass(frozen=True)
class CalibrationCheck:
    """Everything that was found, and the folder that it was written to."""

    findings: tuple[Finding, ...]
    sets: tuple[SetDiagnosis, ...]
    output: Path

    @property
    def consistent(self) -> bool:
        """Whether nothing is wrong: some episode is consistent, and none is anything worse than silent."""
        verdicts = {finding.verdict for finding in self.findings}
        sound = not verdicts & {"off", "explained", "unexplained", "unreadable"}
        return sound and "consistent" in verdicts and all(s.verdict not in ("off", "explained") for s in self.sets)
