"""What a calibration check found: one finding an episode, one a source."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from worldline_core.calibration.diagnosis import Diagnosis, SetDiagnosis


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
