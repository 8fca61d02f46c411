"""Runs compared over seeds: means, intervals, and whether the reference is better, as `train_small_world` writes them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from scipy.stats import t as student

from worldline_core.report.ablation_table import FULL, load_variants

COLUMNS = {
    "robot_iou": ("robot IoU", 1),
    "object_iou": ("object IoU", 1),
    "area": ("outcome area", 1),
    "area_head": ("outcome area, head view alone", 1),
    "error_head": ("squared latent error, head view", -1),
    "drift_last": ("error over copying, last block of 129 frames", -1),
    "sharpness": ("sharpness", 1),
    "unseen_robot_iou": ("robot IoU, unseen body or camera", 1),
}
"""Heading of each measured figure, and 1 where more is better, else -1."""
PAPER = {"robot_iou": "held_out_robot_iou", "unseen_robot_iou": "ood_robot_iou"}
"""Figures that the paper gives too, and their names there."""

Figures = Mapping[str, float]
Measured = Mapping[str, Mapping[int, Figures]]
"""By run and seed, the figures of `COLUMNS` that were measured."""


@dataclass(frozen=True)
class Spread:
    """A mean over seeds with its 95 % interval (Student's t; None for a single seed)."""

    mean: float
    low: float | None
    high: float | None
    count: int

    @classmethod
    def of(cls, values: Sequence[float]) -> Spread:
        """Of one value for each seed."""
        mean, count = float(np.mean(values)), len(values)
        if count < 2:
            return cls(mean, None, None, count)
        half = float(student.ppf(0.975, count - 1) * np.std(values, ddof=1) / np.sqrt(count))
        return cls(mean, mean - half, mean + half, count)

    def text(self, *, signed: bool = False) -> str:
        sign = "+" if signed else ""
        bounds = "" if self.low is None else f" ({self.low:{sign}.3f} to {self.high:{sign}.3f})"
        return f"{self.mean:{sign}.3f}{bounds}"


@dataclass(frozen=True)
class Comparison:
    """How much better the reference is than a run, by one figure, seed by seed: positive is better for the reference.

    ``verdict`` on "the reference is better": "holds" or "opposite" where the interval leaves out zero, else "open".
    """

    run: str
    figure: str
    difference: Spread
    verdict: str


def compared(measured: Measured, reference: str) -> list[Comparison]:
    """The reference against every other run, over the seeds that both have."""
    found: list[Comparison] = []
    for run in measured.keys() - {reference} if reference in measured else ():
        seeds = sorted(measured[run].keys() & measured[reference].keys())
        for figure, (_, sign) in COLUMNS.items():
            pairs = [(measured[reference][seed], measured[run][seed]) for seed in seeds]
            differences = [
                sign * (full[figure] - own[figure]) for full, own in pairs if figure in full and figure in own
            ]
            if differences:
                spread = Spread.of(differences)
                found.append(Comparison(run, figure, spread, _verdict(spread)))
    return sorted(found, key=lambda one: (list(measured).index(one.run), list(COLUMNS).index(one.figure)))


def _verdict(difference: Spread) -> str:
    if difference.low is None or difference.high is None or difference.low <= 0 <= difference.high:
        return "open"
    return "holds" if difference.low > 0 else "opposite"


def table(measured: Measured, reference: str) -> dict[str, object]:
    """All figures, by run and seed and over the seeds, and comparisons, as JSON values."""
    rows = {
        run: {
            figure: asdict(Spread.of(values))
            for figure in COLUMNS
            if (values := [found[figure] for found in seeds.values() if figure in found])
        }
        for run, seeds in measured.items()
    }
    return {
        "reference": reference,
        "seeds": {run: dict(sorted(seeds.items())) for run, seeds in measured.items()},
        "runs": rows,
        "compared": [asdict(one) for one in compared(measured, reference)],
    }


def markdown(measured: Measured, reference: str) -> str:
    """The same as text: what was measured, then how much better the reference is, and the paper's difference beside it."""
    shown = [figure for figure in COLUMNS if any(figure in f for seeds in measured.values() for f in seeds.values())]
    heads = " | ".join(COLUMNS[figure][0] for figure in shown)
    lines = [f"| run | seeds | {heads} |", "|---" * (2 + len(shown)) + "|"]
    for run, seeds in measured.items():
        cells = []
        for figure in shown:
            values = [found[figure] for found in seeds.values() if figure in found]
            cells.append(Spread.of(values).text() if values else "")
        lines.append(f"| {run} | {len(seeds)} | " + " | ".join(cells) + " |")
    if len(measured) == 1:
        return "\n".join([*lines, ""])
    title = f"How much better `{reference}` is, by seeds (95 % interval of Student's t), and whether that holds:"
    lines += ["", title, ""]
    paper = {figure: name for figure, name in PAPER.items() if figure in shown}
    beside = " | ".join(f"the paper: {COLUMNS[figure][0]}" for figure in paper)
    lines += [f"| than | {heads} | {beside} |", "|---" * (1 + len(shown) + len(paper)) + "|"]
    variants = load_variants()
    differences = compared(measured, reference)
    for run in measured:
        cells = []
        for figure in shown:
            one = next((d for d in differences if (d.run, d.figure) == (run, figure)), None)
            cells.append("" if one is None else f"{one.difference.text(signed=True)}: {one.verdict}")
        for name in paper.values():
            known = run in variants and name in variants[run].paper
            cells.append(f"{variants[FULL].paper[name] - variants[run].paper[name]:+.3f}" if known else "")
        if run != reference:
            lines.append(f"| {run} | " + " | ".join(cells) + " |")
    return "\n".join([*lines, ""])
