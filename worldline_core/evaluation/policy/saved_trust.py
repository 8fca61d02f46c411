"""``trust.safetensors``: a calibration of trust, made where outcomes are known and used where they are not.

The header says what it was made with: the judge, the embodiments, and of every method the checkpoint and how it was sampled.
Verdicts on other videos, of another judge or on other robots were never compared with outcomes, so they get no probability. The
tensors are the training recordings that novelty is measured against (:mod:`worldline_core.evaluation.policy.novelty`).
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import ConfigDict, Field, ValidationError
from safetensors import SafetensorError, safe_open

from worldline_core.config import StrictModel
from worldline_core.errors import ArtifactError, ConfigError
from worldline_core.evaluation.policy.novelty import KnownRecordings
from worldline_core.evaluation.policy.trust import Calibration
from worldline_core.store.artifact_files import digest_folder, is_artifact, read_manifest
from worldline_core.store.atomic import write_arrays_atomic

TRUST_FILE = "trust.safetensors"
_HEADER = "worldline_trust"


class JudgedBy(StrictModel):
    """A judge: its name, and the views, segmenter and weights (a digest) that it sees by."""

    judge: str
    views: tuple[str, ...]
    segmenter: str
    segmenter_weights: str | None


class PredictedBy(StrictModel):
    """What made videos: a checkpoint (its digest), and how it was sampled; ``steps`` None: as many as are usual for it."""

    checkpoint: str | None
    sampler: str
    steps: int | None
    shift: float = 1.0
    actions: str = "true"
    stride: int = 1


class SavedMethod(StrictModel):
    """Calibration of one method's verdicts: weights of the intercept and of each signal."""

    predicted_by: PredictedBy
    signals: tuple[str, ...]
    weights: tuple[float, ...]


class SavedTrust(StrictModel):
    """A saved calibration, and the training recordings that it measures novelty against, which are no part of the header."""

    model_config = ConfigDict(arbitrary_types_allowed=True)

    format: Literal[1]
    judged_by: JudgedBy
    embodiments: tuple[str, ...]
    least_trust: float
    training_recordings: int
    methods: dict[str, SavedMethod]
    controls: KnownRecordings = Field(exclude=True)
    setups: KnownRecordings = Field(exclude=True)

    def write(self, folder: Path) -> None:
        """Write ``trust.safetensors``."""
        known = {"controls": self.controls, "setups": self.setups}
        arrays = {f"{what}/{name}": array for what, found in known.items() for name, array in found.arrays().items()}
        write_arrays_atomic(folder / TRUST_FILE, arrays, {_HEADER: self.model_dump_json()})

    @classmethod
    def read(cls, path: Path) -> SavedTrust:
        """Read the file, or that of an evaluate_policy artifact.

        Raises: ArtifactError when it is not there, or not such a file.
        """
        file = path / TRUST_FILE if path.is_dir() else path
        if not file.is_file():
            raise ArtifactError(
                "There is no saved calibration of trust", where=file,
                next_step="run evaluate_policy with trust on recordings with known outcomes, and name its folder",
            )  # fmt: skip
        try:
            with safe_open(file, framework="np") as opened:
                header = json.loads((opened.metadata() or {}).get(_HEADER, ""))
                arrays = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
            known = {
                what: KnownRecordings.of_arrays(
                    {name.partition("/")[2]: array for name, array in arrays.items() if name.startswith(f"{what}/")}
                )
                for what in ("controls", "setups")
            }
            saved = cls.model_validate({**header, **known})
        except (SafetensorError, ValidationError, ValueError, KeyError, TypeError) as error:
            raise ArtifactError("Not a saved calibration of trust", where=file, got=error) from error
        wrong = [name for name, found in saved.methods.items() if len(found.weights) != 1 + len(found.signals)]
        if wrong or not all(np.isfinite(array).all() for array in arrays.values()):
            raise ArtifactError("A saved calibration of trust is damaged", where=file, got=wrong or "not finite")
        return saved

    def require(self, judged_by: JudgedBy, embodiments: Iterable[str]) -> None:
        """Raises: ConfigError when the verdicts are of another judge, or on robots that it was not made with."""
        if judged_by != self.judged_by:
            raise ConfigError(
                "A saved calibration of trust is of another judge", where="trust",
                expected=self.judged_by.model_dump(), got=judged_by.model_dump(),
                next_step="judge as it was made, or calibrate with this judge where outcomes are known",
            )  # fmt: skip
        if others := sorted(set(embodiments) - set(self.embodiments)):
            raise ConfigError(
                "A saved calibration of trust was not made with these robots", where="trust",
                expected=f"some of {', '.join(self.embodiments)}", got=", ".join(others),
                next_step="calibrate where outcomes of these robots are known, or leave their episodes out",
            )  # fmt: skip

    def calibration_of(self, predicted_by: PredictedBy | None) -> Calibration | str:
        """The calibration of verdicts on such videos, or the reason why there is none."""
        for method in self.methods.values():
            if method.predicted_by == predicted_by:
                return Calibration(method.signals, np.array(method.weights))
        made = "; ".join(f"{name}: {_told(found.predicted_by)}" for name, found in self.methods.items()) or "none"
        asked = "videos of an unknown model" if predicted_by is None else _told(predicted_by)
        return f"the saved calibration is of other videos than these ({asked}); it has {made}"


def _told(made: PredictedBy) -> str:
    checkpoint = "no checkpoint" if made.checkpoint is None else f"checkpoint {made.checkpoint[:12]}"
    return (
        f"{checkpoint}, {made.sampler}, {'usual' if made.steps is None else made.steps} steps, {made.actions} actions"
    )


def content_digest(folder: Path) -> str:
    """Digest of a folder of weights, as manifests of what was made with it state it."""
    return str(read_manifest(folder)["digest"]) if is_artifact(folder) else digest_folder(folder, everything=True)


def predicted_by(rollouts: Path) -> PredictedBy | None:
    """What made the videos of a finished RolloutSet; None where that is not written (imported videos)."""
    manifest: dict[str, Any] = read_manifest(rollouts)
    config = manifest.get("config", {})
    if "sampler" not in config:
        return None
    told = {name: config[name] for name in PredictedBy.model_fields if name in config}
    return PredictedBy(checkpoint=manifest.get("inputs", {}).get("checkpoint", {}).get("digest"), **told)
