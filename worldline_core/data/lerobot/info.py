"""meta/info.json of a LeRobot dataset, checked once so that readers may rely on it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from worldline_core.data.guards.json_file import read_json
from worldline_core.data.guards.source_paths import AnyPath
from worldline_core.errors import DataError


def read_info(root: AnyPath, version: str, keys: Sequence[str] = ()) -> dict[str, Any]:
    """The mapping, of the wanted version, with `fps`, `features` and `keys`.

    Raises: DataError when it is unreadable, of another version, lacks a key, or holds something senseless.
    """
    where = f"{root}, meta/info.json"
    info = read_json(root / "meta" / "info.json")
    if not isinstance(info, dict):
        raise DataError("meta/info.json holds no mapping", where=str(root), got=type(info).__name__)
    found = str(info.get("codebase_version"))
    if found != version:
        raise DataError("Dataset has another version", where=str(root), expected=version, got=found)
    missing = [key for key in ("fps", "features", *keys) if key not in info]
    if missing:
        raise DataError("meta/info.json lacks a key", where=str(root), expected=", ".join(missing), got=", ".join(info))
    fps = info["fps"]
    if not isinstance(fps, int | float) or isinstance(fps, bool) or not (math.isfinite(fps) and 0 < fps <= 10_000):
        raise DataError("Frame rate is no rate", where=where, expected="a number of frames a second", got=repr(fps))
    features = info["features"]
    if not isinstance(features, dict) or not all(isinstance(feature, dict) for feature in features.values()):
        raise DataError("Features are no mapping of mappings", where=where, got=str(features)[:200])
    for key in ("data_path", "video_path"):
        if key in info and not isinstance(info[key], str | None):
            raise DataError("Path template is no text", where=f"{where}, {key}", got=repr(info[key])[:200])
    size = info.get("chunks_size", 1000)
    if not isinstance(size, int) or isinstance(size, bool) or size < 1:
        raise DataError("Chunk size is no count", where=where, expected="a whole number from 1 on", got=repr(size))
    return info


class DescribedDataset:
    """What `info.json` says of a dataset, whatever its version.

    Attributes:
        info: its content, checked by `read_info`.
    """

    info: dict[str, Any]

    @property
    def fps(self) -> float:
        return float(self.info["fps"])

    @property
    def features(self) -> dict[str, dict[str, Any]]:
        return self.info["features"]

    @property
    def video_keys(self) -> list[str]:
        return [key for key, feature in self.features.items() if feature.get("dtype") == "video"]
