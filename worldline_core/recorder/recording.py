"""A recording of any kind: episodes, candidate banks or compared policies, as a step of the pipeline or into a folder."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Self, cast

from pydantic import model_validator

from worldline_core.config import StrictModel, load_config, read_yaml
from worldline_core.errors import DataError
from worldline_core.recorder.attempts import RecordBanksConfig, RecordPoliciesConfig, record_banks, record_policies
from worldline_core.recorder.record import RecordConfig, record
from worldline_core.store.artifact_files import MANIFEST_NAME, write_manifest
from worldline_core.store.atomic import remove_unfinished
from worldline_core.store.store import describe_environment, folder_lock


class RecordingConfig(StrictModel):
    """One of the three kinds of recordings."""

    episodes: RecordConfig | None = None
    banks: RecordBanksConfig | None = None
    policies: RecordPoliciesConfig | None = None

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        if sum(config is not None for config in (self.episodes, self.banks, self.policies)) != 1:
            raise ValueError("give episodes, banks or policies, one of the three")
        return self

    def record(self, output: Path) -> dict[str, Any]:
        """Record into ``output``, or continue there; returns counts. Raises as `record`, `record_banks`, `record_policies`."""
        if self.episodes is not None:
            return record(self.episodes, output)
        if self.policies is not None:
            return record_policies(self.policies, output)
        return record_banks(cast("RecordBanksConfig", self.banks), output)


def load_recording(path: Path, overrides: Sequence[str] = ()) -> RecordingConfig:
    """Read a file of one recording; its keys say of which kind."""
    keys = read_yaml(path).keys()
    if "policies" in keys:
        return RecordingConfig(policies=load_config(RecordPoliciesConfig, path=path, overrides=overrides))
    if "banks" in keys:
        return RecordingConfig(banks=load_config(RecordBanksConfig, path=path, overrides=overrides))
    return RecordingConfig(episodes=load_config(RecordConfig, path=path, overrides=overrides))


def record_artifact(config: RecordingConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """The step `record`."""
    del inputs
    return config.record(output)


def record_into(config: RecordingConfig, output: Path) -> dict[str, Any]:
    """Record into a folder outside of a store, or continue a killed recording there; the manifest is written last.

    Raises:
        DataError: the folder holds a finished recording.
        ArtifactError: another command is recording into it.
    """
    with folder_lock(output):
        if (output / MANIFEST_NAME).exists():
            raise DataError("Folder already holds a recording", where=output, next_step="record into a new folder")
        remove_unfinished(output)
        counts = config.record(output)
        environment = describe_environment()
        environment["packages"]["mujoco"] = importlib.metadata.version("mujoco")
        facts = {"step": "record", "version": 1, "config": config.model_dump(mode="json"), "metrics": counts}
        write_manifest(output, {**facts, "environment": environment})
        return counts
