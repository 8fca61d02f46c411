"""Names of rollout methods: how they are shown, coloured and ordered, from the words in them."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

TRUE_METHOD = "true"
"""Stands for the recorded videos among the methods of an evaluation."""

Group = Literal["shipped", "run", "baseline"]
Kind = Literal["stage2", "causal", "stage2_zero", "stage2_shuffled", "causal_zero", "causal_shuffled", "copy", "other"]

LABELS: dict[str, str] = {
    "stage2": "Stage II",
    "causal": "causal, 4 steps",
    "stage2_zero": "Stage II, no actions",
    "stage2_shuffled": "Stage II, shuffled actions",
    "causal_zero": "causal, no actions",
    "causal_shuffled": "causal, shuffled actions",
    "copy": "copy first frame",
}
COLOURS: dict[str, str] = {
    "stage2": "c0",
    "causal": "c1",
    "stage2_zero": "c4",
    "stage2_shuffled": "c3",
    "causal_zero": "c4",
    "causal_shuffled": "c3",
    "copy": "c5",
    "other": "c2",
}
GROUP_LABELS: dict[Group, str] = {"shipped": "long-trained", "run": "this run", "baseline": "baseline"}
ORDER: tuple[str, ...] = (*LABELS, "other")
BASE_LABELS = {"stage2": "Stage II", "causal": "causal"}
STEPS_NAME = re.compile(r"(?:shipped_)?(?P<base>stage2|causal)_(?P<steps>\d+)_steps")
ZERO_WORDS = frozenset({"zero", "zeroed", "none", "noaction", "noactions", "no"})
SHUFFLED_WORDS = frozenset({"shuffled", "shuffle"})


@dataclass(frozen=True)
class Method:
    """A method as the report shows it: the model and its controls (`kind`) and whose weights they are (`group`)."""

    name: str
    kind: str
    group: Group

    @property
    def label(self) -> str:
        if self.kind in LABELS:
            return LABELS[self.kind]
        found = STEPS_NAME.fullmatch(self.name)
        return f"{BASE_LABELS[found['base']]}, {found['steps']} steps" if found else self.name.replace("_", " ")

    @property
    def long_label(self) -> str:
        """Label with the group, for tables that mix weights of several origins."""
        return self.label if self.group == "baseline" else f"{self.label} ({GROUP_LABELS[self.group]})"

    @property
    def colour(self) -> str:
        return COLOURS[self.kind]

    @property
    def rank(self) -> tuple[int, int, str]:
        return ("shipped", "run", "baseline").index(self.group), ORDER.index(self.kind), self.name


def method(name: str) -> Method:
    """Reads a method's name: `shipped_stage2_shuffled`, `causal`, `stage2.zero`, `copy_first_frame`, ..."""
    words = set(re.split(r"[._\-\s]+", name.lower()))
    if "copy" in words:
        return Method(name, "copy", "baseline")
    base = "causal" if "causal" in words else "stage2" if words & {"stage2", "stageii"} else ""
    control = "_zero" if words & ZERO_WORDS else "_shuffled" if words & SHUFFLED_WORDS else ""
    # Another number of steps is another method: it must not stand under the label of the usual one.
    kind = f"{base}{control}" if base and "steps" not in words else "other"
    return Method(name, kind, "shipped" if "shipped" in words else "run")


def without_truth(names: Iterable[str]) -> list[Method]:
    """Methods that predicted, in the report's order: recorded videos, judged as a ceiling, are no method."""
    return in_order([name for name in names if name != TRUE_METHOD])


def in_order(names: list[str]) -> list[Method]:
    """Methods of several names: long-trained first, then this run's, then baselines without weights."""
    return sorted((method(name) for name in names), key=lambda m: m.rank)
