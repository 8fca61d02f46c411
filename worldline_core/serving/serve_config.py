"""Settings of `worldline serve`: the model, the address, the limits, and the policies that may drive."""

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
    """Configuration of `worldline serve`.

    Attributes:
        model: folder of a causal or Stage II checkpoint.
        tokenizer: its tokenizer's folder; by default the one found by the checkpoint.
        decoder: folder of a small decoder for the latents of its tokenizer.
        steps: Euler steps; by default the model's own.
        compile: torch.compile of each layer but its attention, for a GPU.
        episodes: EpisodeSet whose recordings sessions may start from.
        output: where sessions of the page are saved.
        host: address to listen at. Anything but loopback needs a token (environment variable WORLDLINE_TOKEN).
        origins: pages of other servers that may connect (http://host:port).
        max_sessions, max_clips: at a time, those of the page included; clips of all sessions together.
        max_sessions_per_connection: at a time.
        max_message_bytes: of one request or reply.
        idle_s: seconds after which an idle connection is closed, with its sessions.
        max_blocks: blocks that one session of the page keeps for rewinding and saving.
    """

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
