"""The finished artifacts that a report is made of, found by the name of their step."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from worldline_core.errors import ArtifactError

JsonObject = dict[str, Any]


@dataclass(frozen=True)
class ReportInputs:
    """Artifact folders by name: a step (`curate`) or a step and a variant (`rollout.stage2`, `curate.banks`)."""

    folders: Mapping[str, Path]

    def get(self, name: str) -> Path | None:
        """The folder of a name, or None."""
        return self.folders.get(name)

    def variants(self, step: str) -> dict[str, Path]:
        """All folders of a step: variant -> folder; the plain name has the variant ""."""
        found = {"": self.folders[step]} if step in self.folders else {}
        prefix = f"{step}."
        found |= {
            name.removeprefix(prefix): path for name, path in sorted(self.folders.items()) if name.startswith(prefix)
        }
        return found

    def manifest(self, name: str) -> JsonObject:
        """An artifact's manifest, or an empty object for a folder without one."""
        folder = self.folders.get(name)
        return read_json(folder / "manifest.json") if folder is not None else {}


def read_json(path: Path) -> JsonObject:
    """A JSON object from a file; an absent file is an empty object.

    Raises:
        ArtifactError: the file is not a JSON object.
    """
    if not path.is_file():
        return {}
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ArtifactError(
            "A JSON file is damaged", where=path, got=str(error), next_step="rebuild the artifact"
        ) from error
    if not isinstance(value, dict):
        raise ArtifactError("A JSON file has a wrong form", where=path, expected="an object", got=type(value).__name__)
    return value


def read_json_lines(path: Path) -> list[JsonObject]:
    """The objects of a `.jsonl` file. A last line that a kill cut short is left out.

    Raises:
        ArtifactError: a line before the last is not a JSON object.
    """
    rows: list[JsonObject] = []
    lines = [line for line in path.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
    for index, line in enumerate(lines):
        try:
            value = json.loads(line)
        except json.JSONDecodeError as error:
            if index == len(lines) - 1:
                break
            raise ArtifactError("A line is not JSON", where=f"{path}:{index + 1}", got=line[:80]) from error
        if not isinstance(value, dict):
            raise ArtifactError("A line is not an object", where=f"{path}:{index + 1}", got=line[:80])
        rows.append(value)
    return rows


def read_table(path: Path, columns: Sequence[str] | None = None) -> pa.Table | None:
    """A Parquet table, or some of its columns; None where there is no file.

    Raises:
        ArtifactError: the file cannot be read.
    """
    if not path.is_file():
        return None
    try:
        return pq.read_table(path, columns=None if columns is None else list(columns))
    except (pa.ArrowInvalid, OSError) as error:
        raise ArtifactError(
            "A Parquet file is damaged", where=path, got=str(error), next_step="rebuild the artifact"
        ) from error


def read_rows(path: Path) -> list[JsonObject]:
    """The rows of a Parquet table as objects; no file means no rows."""
    found = read_table(path)
    return [] if found is None else found.to_pylist()
