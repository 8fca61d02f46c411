"""The step ablation_table: variants as rows, the paper's metrics as columns, each number beside the paper's.

``table.parquet`` and ``table.json`` hold one value a row: mean, 95 % interval, number of trajectories (banks, for planning),
the paper's number, and the paired difference to the full model. ``table.md`` and ``index.html`` show them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from markupsafe import Markup
from pydantic import Field

from worldline_core.config import StrictModel, read_yaml, validate
from worldline_core.errors import ArtifactError
from worldline_core.evaluation.scores import SCORES_FILE, paired_difference
from worldline_core.pages.page import Table, interval, number, render
from worldline_core.store.artifact_files import read_json, read_rows, row_schema
from worldline_core.store.atomic import atomic_path, write_bytes_atomic, write_json_atomic

VARIANTS_FILE = Path(__file__).with_name("ablations.yaml")
FULL = "full"
SPLITS = {"held_out": "test", "ood": "ood_test"}
"""Groups of the paper's columns (AgiBotWorld, DROID) and the splits that play their part."""
COLUMNS = {
    "held_out_lpips": "held out: LPIPS ↓",
    "held_out_robot_iou": "held out: robot IoU ↑",
    "ood_lpips": "out of domain: LPIPS ↓",
    "ood_robot_iou": "out of domain: robot IoU ↑",
    "success": "planning: success [%] ↑",
    "gain": "planning: gain [points] ↑",
}
POLICIES = {"pi05": "π0.5", "lingbot": "LingBot-VLA"}


class Variant(StrictModel):
    """A row: what it changes in a run, and what the paper reports of it.

    Attributes:
        changes: ``a.b=value`` lines; rollout: fields of every rollout's configuration.
        matched_compute: Stage II gets the compute that the full model spends on both stages.
        without: metrics that do not compare with the other rows' (LPIPS of one view with that of three).
    """

    label: str
    changes: tuple[str, ...] = ()
    rollout: dict[str, Any] = Field(default_factory=dict)
    matched_compute: bool = False
    without: tuple[str, ...] = ()
    paper: dict[str, float] = Field(default_factory=dict)


def load_variants() -> dict[str, Variant]:
    """The paper's variants by name, the full model first."""
    return {name: validate(Variant, values, where=VARIANTS_FILE) for name, values in read_yaml(VARIANTS_FILE).items()}


class AblationTableConfig(StrictModel):
    """``method``: of the rows, in the video evaluations; in those of planning it is ``banks_<method>``."""

    method: str = "stage2"
    variants: dict[str, Variant] = Field(default_factory=load_variants)
    resamples: int = Field(default=2000, ge=100)
    seed: int = Field(default=42, ge=0)


@dataclass(frozen=True)
class Cell:
    """One measured number of a variant; ``paper`` holds the paper's by policy ("" where it has one alone), as JSON text."""

    variant: str
    label: str
    column: str
    mean: float | None
    low: float | None
    high: float | None
    count: int
    paper: str
    difference: float | None
    difference_low: float | None
    difference_high: float | None
    reason: str
    """Why nothing was measured; empty where something was."""


def ablation_table(config: AblationTableConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """Put the evaluations ``evaluate_video.<variant>`` and ``evaluate_planning.<variant>`` into one table.

    Raises:
        ArtifactError: a variant has no video evaluation, or none of the method; an evaluation is of no variant.
    """
    named = {name.partition(".")[2] for name in inputs}
    missing = [name for name in config.variants if f"evaluate_video.{name}" not in inputs]
    if missing or not named <= config.variants.keys():
        raise ArtifactError(
            "The evaluations are not those of the variants",
            expected=[f"evaluate_video.{name}" for name in config.variants],
            got=sorted(inputs),
            next_step="run `worldline ablations` with the same preset",
        )
    reference = _Evaluated.of(FULL, config, inputs) if FULL in config.variants else None
    cells = [
        cell
        for name, variant in config.variants.items()
        for cell in _row(config, name, variant, _Evaluated.of(name, config, inputs), reference)
    ]
    with atomic_path(output / "table.parquet") as temporary:
        pq.write_table(pa.Table.from_pylist([asdict(cell) for cell in cells], schema=row_schema(Cell)), temporary)
    write_json_atomic(output / "table.json", {"columns": COLUMNS, "cells": [asdict(cell) for cell in cells]})
    write_bytes_atomic(output / "table.md", markdown_table(config, cells).encode())
    _write_page(config, cells, output)
    measured = sum(cell.mean is not None for cell in cells)
    return {"variants": list(config.variants), "cells": len(cells), "measured": measured}


@dataclass(frozen=True)
class _Evaluated:
    """What was measured of a variant: intervals by column, values of each trajectory, and reasons for what was not."""

    intervals: Mapping[str, Mapping[str, float]]
    values: Mapping[str, Mapping[str, float]]
    reasons: Mapping[str, str]

    @classmethod
    def of(cls, name: str, config: AblationTableConfig, inputs: Mapping[str, Path]) -> _Evaluated:
        folder = inputs[f"evaluate_video.{name}"]
        summary = read_json(folder / "summary.json")
        if config.method not in summary.get("methods", ()):
            raise ArtifactError(
                "The evaluation has no such method", where=folder, expected=config.method, got=summary.get("methods")
            )
        intervals: dict[str, Mapping[str, float]] = {}
        values: dict[str, dict[str, float]] = {}
        reasons: dict[str, str] = {}
        rows = [row for row in read_rows(folder / SCORES_FILE) if row["method"] == config.method]
        for group, split in SPLITS.items():
            for metric in ("lpips", "robot_iou"):
                column = f"{group}_{metric}"
                found = summary["metrics"].get(split, {}).get(config.method, {}).get(metric)
                if found is None:
                    none = f"no recordings of the split {split}" if split not in summary["metrics"] else "not measured"
                    reasons[column] = summary["unavailable"].get(metric, none)
                    continue
                intervals[column] = found
                values[column] = _means(row for row in rows if (row["split"], row["metric"]) == (split, metric))
        planning = inputs.get(f"evaluate_planning.{name}")
        if planning is None:
            reasons |= dict.fromkeys(("success", "gain"), "this run plans over no banks")
            return cls(intervals, values, reasons)
        budgets = read_json(planning / "summary.json")["methods"][f"banks_{config.method}"]["budgets"]
        most = max(budgets, key=int)
        for column in ("success", "gain"):
            intervals[column] = {
                key: value if key == "count" else 100 * value
                for key, value in budgets[most][column].items()
                if key in ("mean", "low", "high", "count")
            }
            values[column] = {bank: 100 * value for bank, value in budgets[most]["banks"].items()}
        return cls(intervals, values, reasons)


def _means(rows: Iterator[dict[str, Any]]) -> dict[str, float]:
    """Mean over views and seeds of each trajectory."""
    found: dict[str, list[float]] = {}
    for row in rows:
        found.setdefault(row["episode_id"], []).append(row["value"])
    return {name: sum(values) / len(values) for name, values in found.items()}


def _row(
    config: AblationTableConfig, name: str, variant: Variant, own: _Evaluated, full: _Evaluated | None
) -> Iterator[Cell]:
    for column in COLUMNS:
        left_out = any(column.endswith(metric) for metric in variant.without)
        found = None if left_out else own.intervals.get(column)
        reason = "does not compare with the other rows" if left_out else own.reasons.get(column, "")
        difference = None
        if found is not None and full is not None and name != FULL and column in full.values:
            difference = paired_difference(
                own.values[column], full.values[column], resamples=config.resamples, seed=config.seed
            )
        paper = [variant.paper.get(column), *(variant.paper.get(f"{column}_{policy}") for policy in POLICIES)]
        yield Cell(
            name, variant.label, column,
            *((None, None, None, 0) if found is None else (found["mean"], found["low"], found["high"], int(found["count"]))),
            " / ".join(f"{value:g}" for value in paper if value is not None),
            *((None, None, None) if difference is None else (difference.mean, difference.low, difference.high)),
            reason,
        )  # fmt: skip


def markdown_table(config: AblationTableConfig, cells: Sequence[Cell]) -> str:
    """The table as text: this run's mean, interval and count, then the paper's number in brackets."""
    lines = ["| variant | " + " | ".join(COLUMNS.values()) + " |", "|---" * (1 + len(COLUMNS)) + "|"]
    for name, variant in config.variants.items():
        shown = [_shown(cell) for cell in cells if cell.variant == name]
        lines.append(f"| {variant.label} | " + " | ".join(shown) + " |")
    reasons = sorted({f"{COLUMNS[cell.column]}: {cell.reason}" for cell in cells if cell.reason})
    return "\n".join([*lines, "", NOTE, *(f"- not measured, {reason}" for reason in reasons), ""])


NOTE = (
    "Mean [95 % interval] of n trajectories (planning: banks); in brackets the paper's number on its own data"
    " (AgiBotWorld, DROID; planning on RoboTwin with the policies " + " / ".join(POLICIES.values()) + ")."
)


def _digits(column: str) -> int:
    return 1 if column in ("success", "gain") else 3


def _shown(cell: Cell) -> str:
    own = "not measured"
    if cell.mean is not None and cell.low is not None and cell.high is not None:
        digits = _digits(cell.column)
        own = f"{cell.mean:.{digits}f} [{cell.low:.{digits}f}, {cell.high:.{digits}f}], n={cell.count}"
    return f"{own} ({cell.paper or 'none'})"


def _write_page(config: AblationTableConfig, cells: Sequence[Cell], output: Path) -> None:
    def table(caption: str, content: Mapping[str, Sequence[object]]) -> Table:
        rows = [[variant.label, *content[name]] for name, variant in config.variants.items()]
        return Table(("Variant", *COLUMNS.values()), rows, range(1, 1 + len(COLUMNS)), caption, dense=True)

    own: dict[str, list[object]] = {name: [] for name in config.variants}
    paper: dict[str, list[object]] = {name: [] for name in config.variants}
    apart: dict[str, list[object]] = {name: [] for name in config.variants}
    for cell in cells:
        digits = _digits(cell.column)
        measured = {"mean": cell.mean, "low": cell.low, "high": cell.high}
        shown = None if cell.mean is None else interval({k: v for k, v in measured.items() if v is not None}, digits)
        own[cell.variant].append(None if shown is None else Markup("{} n={}").format(shown, number(cell.count)))
        paper[cell.variant].append(cell.paper or None)
        bounds = {"mean": cell.difference, "low": cell.difference_low, "high": cell.difference_high}
        values = {k: v for k, v in bounds.items() if v is not None}
        apart[cell.variant].append(interval(values, digits, signed=True) if values else None)
    reasons = sorted({f"{COLUMNS[cell.column]}: {cell.reason}" for cell in cells if cell.reason})
    tables = [table("This run", own), table("The paper", paper), table("This run, less the full model", apart)]
    page = render("report/ablations.html", title="Ablations", lead=NOTE, tables=tables, reasons=reasons)
    write_bytes_atomic(output / "index.html", page.encode())
