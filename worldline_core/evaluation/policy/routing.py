"""Instruction to task family: which evidence is asked for (appendix "Evidence-based trajectory evaluation").

Placing is a state change: what counts is where the object ends. The paper does not print its router; this one goes by
the verbs.
"""

from __future__ import annotations

import re

from worldline_core.evaluation.policy.evidence import EvidenceFamily

_STATE_CHANGE = [
    "place",
    "put",
    "set",
    "insert",
    "stack",
    "drop",
    "pour",
    "fold",
    "open",
    "close",
    "press",
    "push",
    "pull",
    "click",
    "turn",
    "rotate",
    "switch",
    "slide",
    "move",
    "hang",
    "scoop",
    "transfer",
    "sweep",
    "wipe",
    "plug",
    "screw",
    "hand",
    "give",
    "pass",
    "arrange",
    "sort",
]
_LIFT = ("lift", "pick", "raise", "hold up", "take")
_GRASP = ("grasp", "grab", "grip", "seize", "hold")


def route(instruction: str) -> EvidenceFamily:
    """The family whose evidence decides the instruction.

    The last demand wins: "pick up the cup and place it" is a state change, "grasp and lift" is a lift. An instruction
    with none of the known verbs is a state change, the family that asks for the whole instructed effect.
    """
    text = instruction.lower()
    if _contains(text, _STATE_CHANGE):
        return "state_change"
    if _contains(text, _LIFT):
        return "lift"
    return "grasp" if _contains(text, _GRASP) else "state_change"


def _contains(text: str, words: list[str] | tuple[str, ...]) -> bool:
    endings = r"(?:s|es|ed|ing|ping|ting|ding)?"
    return any(re.search(rf"\b{re.escape(word.rstrip('e'))}e?{endings}\b", text) for word in words)
