"""The sheet of `worldline plan`: the machine that a run is planned for, one row a stage, as a table or as JSON."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Self

from worldline_core.errors import ConfigError
from worldline_core.model.step_cost import CARDS, Card
from worldline_core.training.stage_memory import USABLE, gigabytes


@dataclass(frozen=True)
class Machine:
    """What a run is planned for. Attributes: devices, bytes of each, its data sheet, the share of its peak that is reached."""

    devices: int
    memory: float
    card: Card
    utilisation: float

    @classmethod
    def of(cls, devices: int, memory: str, card: str, utilisation: float) -> Self:
        """From what the command line says.

        Raises:
            ConfigError: an unknown card, or a number that means nothing.
        """
        size = re.fullmatch(r"(\d+(?:\.\d+)?) ?(GB|GiB|TB)", memory)
        if card not in CARDS:
            raise ConfigError("Unknown card", where="--card", expected=", ".join(CARDS), got=card)
        if size is None:
            raise ConfigError("Not an amount of memory", where="--memory", expected="80GB, 80GiB", got=memory)
        if devices < 1 or not 0 < utilisation <= 1:
            got = f"{devices}, {utilisation}"
            raise ConfigError("Nothing can be planned", where="--gpus, --utilisation", expected=">= 1, (0, 1]", got=got)
        unit = {"GB": 10**9, "GiB": 2**30, "TB": 10**12}[size[2]]
        return cls(devices, float(size[1]) * unit, CARDS[card], utilisation)


@dataclass(frozen=True)
class Row:
    """One stage of the sheet.

    Attributes:
        parts: bytes a device by what they are; their sum is ``total``.
        seconds: of one step (of one prediction, one clip); hours: of all of them, where their number is known.
        instead: the setting that would fit, where this does not.
        facts: what else is worth knowing, by name.
    """

    title: str
    parameters: int
    parts: Mapping[str, float]
    seconds: float
    hours: float | None
    fits: bool
    instead: str = ""
    facts: Mapping[str, Any] = field(default_factory=dict[str, Any])

    @property
    def total(self) -> float:
        """Most bytes at once on one device."""
        return sum(self.parts.values())


def as_json(machine: Machine, rows: Sequence[Row]) -> dict[str, Any]:
    """The sheet for programs: bytes, seconds, hours."""
    stages = [
        {
            "stage": row.title, "parameters": row.parameters, "bytes": dict(row.parts), "total_bytes": row.total,
            "fits": row.fits, "instead": row.instead, "seconds": row.seconds, "hours": row.hours, "facts": dict(row.facts),
        }
        for row in rows
    ]  # fmt: skip
    return {
        "devices": machine.devices, "memory_bytes": machine.memory, "usable": USABLE,
        "utilisation": machine.utilisation, "peak_flops": machine.card.flops, "stages": stages,
    }  # fmt: skip


def as_text(machine: Machine, rows: Sequence[Row]) -> str:
    """The sheet as a table of Markdown, GB a device; what does not fit is named below it, with what would."""
    lines = [
        f"{machine.devices} devices of {gigabytes(machine.memory)} GB ({USABLE:.0%} of it usable), "
        f"{machine.utilisation:.0%} of {machine.card.flops / 1e12:.0f} TFLOP/s",
        "",
        "| stage | parameters | GB a device | of that | seconds | hours | fits |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        parts = ", ".join(f"{name} {gigabytes(size)}" for name, size in row.parts.items())
        hours = "" if row.hours is None else f"{row.hours:.3g}"
        seconds = f"{row.seconds:.3g}" if row.seconds else ""
        lines.append(
            f"| {row.title} | {_short(row.parameters)} | {gigabytes(row.total)} | {parts} | {seconds} | {hours} | "
            f"{'yes' if row.fits else 'NO'} |"
        )
    lines.append("")
    for row in rows:
        facts = "; ".join(f"{name}: {_shown(name, value)}" for name, value in row.facts.items())
        lines.append(f"- {row.title}: {facts}" + ("" if row.fits else f". It does not fit: set {row.instead}"))
    return "\n".join(lines)


def _short(count: int) -> str:
    return f"{count / 1e9:.2f} G" if count >= 1e9 else f"{count / 1e6:.1f} M"


def _shown(name: str, value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{amount} ({key} frames)" for key, amount in value.items())
    if "bytes" in name:
        return f"{gigabytes(value)} GB"
    return f"{value:.3g}" if isinstance(value, float) else str(value)
