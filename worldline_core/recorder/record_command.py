"""`worldline record`: episodes or candidate banks from a configuration file, with a manifest."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from worldline_core.config import load_config
from worldline_core.recorder.banks import RecordBanksConfig, record_banks
from worldline_core.recorder.record import RecordConfig, record
from worldline_core.store.atomic import remove_unfinished, write_json_atomic
from worldline_core.store.digest import MANIFEST_NAME, digest_folder
from worldline_core.store.store import describe_environment


def record_command(
    kind: Literal["episodes", "banks"], path: Path, overrides: Sequence[str], output: Path
) -> dict[str, Any]:
    """Record into ``output`` (a killed recording continues there) and write its manifest last.

    Raises:
        ConfigError: the configuration is not valid.
        UnavailableError: the extra ``sim`` or a GL library is missing.
    """
    if output.exists():
        remove_unfinished(output)
    if kind == "banks":
        config: RecordBanksConfig | RecordConfig = load_config(RecordBanksConfig, path=path, overrides=overrides)
        counts = record_banks(config, {}, output)
    else:
        config = load_config(RecordConfig, path=path, overrides=overrides)
        counts = record(config, {}, output)
    environment = describe_environment()
    environment["packages"]["mujoco"] = importlib.metadata.version("mujoco")
    manifest = {
        "step": f"record_{kind}",
        "version": 1,
        "config": config.model_dump(mode="json"),
        "seeds": {"seed": config.seed},
        "digest": digest_folder(output),
        "metrics": counts,
        "environment": environment,
    }
    write_json_atomic(output / MANIFEST_NAME, manifest)
    return counts
