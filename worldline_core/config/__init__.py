"""Configuration: strict models and one strict loader."""

from worldline_core.config.base import StrictModel
from worldline_core.config.loader import apply_overrides, load_config, preset_names, preset_path, read_yaml, validate

__all__ = ["StrictModel", "apply_overrides", "load_config", "preset_names", "preset_path", "read_yaml", "validate"]
