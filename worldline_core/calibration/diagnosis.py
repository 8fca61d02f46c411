"""What the calibration doctor says about an episode and about all episodes of a source, and what a check found."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from worldline_core.data.episodes.conventions import RecordedConventions

VerdictName = Literal["consistent", "explained", "unexplained", "too_little_evidence"]


@dataclass(frozen=True)
class Explanation:
    """One way to read the recording.

    Attributes:
        mistake: "none", or the name of a field of `RecordedConventions` (two joined by "+" for a pair).
        conventions: how the source would have written its numbers; `apply_conventions` repairs the episode with it.
        score: log-likelihood of everything measured, under this reading; 0 is as a healthy recording typically is,
            lower is worse. Differences between readings of one episode mean something, and add up over episodes.
        evidence: the terms of the score by name ("hand_eye left_wrist", ...); each at most 0.
        config_lines: what repairs it, for example "curate.sources[].conventions.extrinsics: base_to_camera".
    """

    mistake: str
    conventions: RecordedConventions
    score: float
    evidence: Mapping[str, float]
    config_lines: tuple[str, ...]


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


@dataclass(frozen=True)
class Diagnosis:
    """One episode.

    Attributes:
        verdict: consistent (as recorded is good), explained (`best` names the mistake), unexplained (as recorded is
            bad, and no reading of it is good), too_little_evidence.
        best: the reading to believe; "none" unless the verdict is explained.
        ranked: all readings that were tried, best score first.
        notes: what a person should know besides: what could not be observed, what the cameras follow.
    """

    episode_id: str
    verdict: VerdictName
    best: Explanation
    ranked: tuple[Explanation, ...]
    measures: tuple[ViewMeasures, ...]
    notes: tuple[str, ...]

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
        votes: verdicts and mistakes of the single episodes, counted.
        ranked: readings with the scores summed over episodes.
    """

    source: str
    num_episodes: int
    verdict: VerdictName
    best: Explanation
    ranked: tuple[Explanation, ...]
    votes: Mapping[str, int]
    notes: tuple[str, ...]


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
class SetFinding:
    """The conclusion over all episodes of a source, and the lines that repair it."""

    diagnosis: SetDiagnosis
    config_lines: tuple[str, ...]


@dataclass(frozen=True)
class CalibrationCheck:
    """Everything that was found, and the folder that it was written to."""

    findings: tuple[Finding, ...]
    sets: tuple[SetFinding, ...]
    output: Path

    @property
    def consistent(self) -> bool:
        """Whether nothing is wrong: some episode is consistent, and none is anything worse than silent."""
        verdicts = {finding.verdict for finding in self.findings}
        sound = not verdicts & {"explained", "unexplained", "unreadable"}
        return sound and "consistent" in verdicts and all(s.diagnosis.verdict != "explained" for s in self.sets)
