"""The folders that curation reads, as inputs of its cache key: a changed recording means new work."""

from __future__ import annotations

from pathlib import Path

from worldline_core.config.base import StrictModel


def source_inputs(config: StrictModel, project: Path) -> dict[str, Path]:
    """``source.<n>`` -> folder, in the order of the configuration. Relative folders are taken from ``project``."""
    sources = getattr(config, "sources", ())
    return {f"source.{number}": project / source.path for number, source in enumerate(sources)}
