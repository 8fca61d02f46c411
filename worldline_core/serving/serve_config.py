"""Settings of `worldline serve` (docs/serve.md): the model, the address, the limits, and the policies that may drive."""

from __future__ import annotations

import ipaddress
from pathlib import Path

from pydantic import Field

from worldline_core.config import StrictModel
from worldline_core.policies.openpi import PolicyConfig
from worldline_core.processor import bfloat16_by_default
from worldline_core.shipped import SHIPPED

PROTOCOL = 1
"""Version of the messages."""
TOKEN_VARIABLE = "WORLDLINE_TOKEN"  # noqa: S105  # the variable's name


class ServeConfig(StrictModel):
    """Configuration of `worldline serve`; ``max_clips`` counts those of all sessions together, ``max_blocks`` those of one page."""

    model: Path = SHIPPED / "models" / "causal"
    tokenizer: Path | None = None
    decoder: Path | None = None
    device: str = "cpu"
    bfloat16: bool = Field(default_factory=bfloat16_by_default)
    steps: int | None = Field(None, ge=1)
    compile: bool = False
    episodes: Path = SHIPPED / "recordings"
    output: Path = Path("artifacts") / "play"
    host: str = "127.0.0.1"
    port: int = Field(8010, ge=0, le=65535)
    origins: tuple[str, ...] = ()
    max_connections: int = Field(128, ge=1)
    max_sessions: int = Field(64, ge=1)
    max_clips: int = Field(256, ge=1)
    max_sessions_per_connection: int = Field(16, ge=1)
    max_message_bytes: int = Field(64 << 20, ge=1 << 16)
    idle_s: float = Field(300.0, gt=0)
    max_blocks: int = Field(300, ge=1)
    policies: dict[str, PolicyConfig] = Field(default_factory=dict)


def is_loopback(host: str) -> bool:
    """True for a host name or address of this machine alone."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False
