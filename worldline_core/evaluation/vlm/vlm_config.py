"""Where a vision-language model is found, for the judges and selectors that use one."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic import Field

from worldline_core.config import StrictModel
from worldline_core.errors import ConfigError

if TYPE_CHECKING:
    from worldline_core.evaluation.vlm.message import VisionLanguageModel


class VLMConfig(StrictModel):
    """A local Qwen3-VL folder, or a server. A key is never configured: only the variable that holds it."""

    weights: Path | None = Field(default=None, description="local Qwen3-VL folder")
    url: str | None = Field(default=None, description="OpenAI-compatible server, up to and with /v1")
    model: str = Field(default="Qwen/Qwen3-VL-8B-Instruct", description="the server's name of the model")
    api_key_variable: str = "OPENAI_API_KEY"
    timeout_s: float = Field(default=120.0, gt=0)
    attempts: int = Field(default=3, ge=1)


def open_vlm(kind: Literal["qwen3_vl", "openai"], config: VLMConfig) -> VisionLanguageModel:
    """The vision-language model that the config names.

    Raises: ConfigError when its weights or its address are not configured.
    """
    if kind == "qwen3_vl":
        from worldline_core.evaluation.vlm.qwen3_vl import Qwen3VLModel

        if config.weights is None:
            raise ConfigError("No Qwen3-VL weights configured", next_step="set vlm.weights to a local folder")
        return Qwen3VLModel.load(config.weights)
    from worldline_core.evaluation.vlm.openai_compatible import OpenAICompatibleModel

    if config.url is None:
        raise ConfigError("No server configured", next_step="set vlm.url to an OpenAI-compatible server, up to /v1")
    return OpenAICompatibleModel(
        config.url,
        config.model,
        api_key_variable=config.api_key_variable,
        timeout_s=config.timeout_s,
        attempts=config.attempts,
    )
