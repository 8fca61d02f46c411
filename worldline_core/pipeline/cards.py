"""Graphics cards that a plan knows: memory, and how fast they multiply and read."""

from __future__ import annotations

from typing import Annotated, NamedTuple

from pydantic import AfterValidator, ByteSize, TypeAdapter, ValidationError

from worldline_core.errors import ConfigError


class Card(NamedTuple):
    """One card as its vendor states it.

    Attributes:
        memory: bytes.
        operations: multiplications and additions a second in bfloat16, summed in float32, without sparsity.
        bandwidth: bytes a second.
    """

    memory: float
    operations: float
    bandwidth: float


CARDS = {
    "RTX 3090": Card(24e9, 71e12, 936e9),
    "RTX 4090": Card(24e9, 165.2e12, 1008e9),
    "RTX 5090": Card(32e9, 209.5e12, 1792e9),
    "RTX A6000": Card(48e9, 154.8e12, 768e9),
    "L40S": Card(48e9, 362e12, 864e9),
    "RTX PRO 6000": Card(96e9, 503.8e12, 1792e9),
    "A100": Card(80e9, 312e12, 2039e9),
    "H100": Card(80e9, 989e12, 3350e9),
    "H200": Card(141e9, 989e12, 4800e9),
    "B200": Card(180e9, 2250e12, 8000e9),
}
"""By name; of several forms (A100, H100) the one of 80 GB for servers (SXM)."""
PRESETS = {"edge-80gb": 80e9, "edge-48gb": 48e9, "edge-24gb": 24e9, "my_robot": 0.0}
"""Presets for a robot of one's own on one card, by the memory that each needs, the largest first."""
UTILISATION = 0.35
"""Share of a card's operations that a plan counts on, in training and in rollouts."""


def find_card(name: str) -> str:
    """A card's name as `CARDS` has it: "4090" and "rtx4090" are RTX 4090.

    Raises: ConfigError: no card, or several, have this name.
    """
    wanted = _letters(name)
    found = [card for card in CARDS if _letters(card) == wanted]
    found = found or [card for card in CARDS if wanted and _letters(card).endswith(wanted)]
    if len(found) != 1:
        raise ConfigError(
            "Not a card that the plan knows", where="card", expected=", ".join(CARDS), got=name,
            next_step="take one with about as much memory and speed, or give its memory alone (24GB)",
        )  # fmt: skip
    return found[0]


def card_memory(text: str) -> float:
    """Bytes of "24GB", or of a card by its name."""
    try:
        return TypeAdapter(ByteSize).validate_python(text)
    except ValidationError:
        return CARDS[find_card(text)].memory


def preset_for(memory: float) -> str:
    """The largest of `PRESETS` that is made for so many bytes."""
    return next(preset for preset, needed in PRESETS.items() if needed <= memory)


def _letters(name: str) -> str:
    return "".join(letter for letter in name.lower() if letter.isalnum()).removeprefix("nvidia").removeprefix("geforce")


CardName = Annotated[str, AfterValidator(find_card)]
