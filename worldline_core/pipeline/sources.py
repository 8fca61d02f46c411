"""The folders that curation reads, as inputs of its cache key: a changed recording means new work."""

from __future__ import annotations

from pathlib import Path

from worldline_core.config.base import StrictModel
from worldline_core.scale.remote import is_remote


def source_inputs(config: StrictModel, project: Path) -> dict[str, Path]:
    """``source.<n>`` -> folder or location in an object store, in the order of the configuration. Relative folders are
    taken from ``project``."""
    sources = getattr(config, "sources", ())
    return {
        f"source.{number}": source.path if is_remote(source.path) else project / source.path
        for number, source in enumerate(sources)
    }
