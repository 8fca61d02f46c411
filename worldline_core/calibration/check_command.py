"""`worldline calibrate check` without the command line: what to look at, where to write, what to print."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from worldline_core.calibration.check import check_calibration
from worldline_core.calibration.findings import CalibrationCheck
from worldline_core.calibration.listing import chosen_episodes, episodes_of_artifact, episodes_of_config
from worldline_core.errors import ConfigError

OUTPUT_ROOT = Path("artifacts") / "calibration"


def check_command(
    config: Path | None,
    artifact: Path | None,
    *,
    overrides: Sequence[str] = (),
    episodes: Sequence[str] = (),
    output: Path | None = None,
    pictures: bool = True,
) -> CalibrationCheck:
    """Check the sources of a configuration file, or an EpisodeSet.

    Args:
        overrides: `a.b=value`, changes of the file.
        episodes: ids to look at; none: all.
        output: default `artifacts/calibration/<name of the file or folder>`.

    Raises:
        ConfigError: neither or both of file and folder are given, or the file has a mistake.
        DataError: the source cannot be opened, or has no such episode.
    """
    descriptions: dict[str, str] = {}
    if artifact is not None and config is None:
        if overrides:
            raise ConfigError("--set changes a configuration file, and none is given", got=", ".join(overrides))
        listed, name = episodes_of_artifact(artifact), artifact.resolve().name
    elif config is not None and artifact is None:
        (listed, descriptions), name = episodes_of_config(config, overrides), config.stem
    else:
        raise ConfigError("Give a source's configuration file or an EpisodeSet", got=f"{config}, {artifact}")
    chosen = chosen_episodes(listed, episodes)
    return check_calibration(chosen, output or OUTPUT_ROOT / name, descriptions=descriptions, pictures=pictures)
