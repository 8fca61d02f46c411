"""The step ablation_table: variants as rows, the paper's metrics as columns, each number beside the paper's.

``table.parquet`` holds one value a row: mean, 95 % interval, number of trajectories (banks, for planning), the paper's number, and the
paired difference to the full model. ``table.md`` shows it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import Field

from worldline_core.config import StrictModel, read_yaml, validate
from worldline_core.errors import ArtifactError, ConfigError
from worldline_core.evaluation.paired import collect_metrics, read_scores
from worldline_core.evaluation.scores import SUMMARY_FILE, Interval, crossed_bootstrap
from worldline_core.store.artifact_files import read_json, row_schema
from worldline_core.store.atomic import atomic_path, write_bytes_atomic

VARIANTS_FILE = Path(__file__).with_name("ablations.yaml")
FULL = "full"
COLUMNS = {
    "held_out_lpips": "held out: LPIPS ↓",
    "held_out_robot_iou": "held out: robot IoU ↑",
    "held_out_object_iou": "held out: object IoU ↑",
    "held_out_tool_error": "held out: tool error [px] ↓",
    "ood_lpips": "out of domain: LPIPS ↓",
    "ood_robot_iou": "out of domain: robot IoU ↑",
    "success": "planning: success [%] ↑",
    "gain": "planning: gain [points] ↑",
}
VIDEO_COLUMNS = {
    "held_out_lpips": ("test", "lpips"),
    "held_out_robot_iou": ("test", "robot_iou"),
    "held_out_object_iou": ("test", "object_iou_exact"),
    "held_out_tool_error": ("test", "end_effector_error_px"),
    "ood_lpips": ("ood_test", "lpips"),
    "ood_robot_iou": ("ood_test", "robot_iou"),
}
"""Splits that stand for the paper's AgiBotWorld (held out) and DROID (out of domain), and their metrics."""
POLICIES = {"pi05": "π0.5", "lingbot": "LingBot-VLA"}
NOTE = (
    "Mean [95 % interval over seeds and trajectories] of n trajectories (planning: banks); in brackets the paper's number on its own data"
    " (AgiBotWorld, DROID; planning on RoboTwin with the policies " + " / ".join(POLICIES.values()) + ")."
)


class Variant(StrictModel):
    """A row: its changes to a run, and the paper's numbers.

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


def load_variants(file: Path = VARIANTS_FILE) -> dict[str, Variant]:
    """Variants by name, the full model first.

    Args:
        file: other variants than the paper's.

    Raises:
        ConfigError: a variant has unknown fields, or the full model is not the first one.
    """
    variants = {name: validate(Variant, values, where=file) for name, values in read_yaml(file).items()}
    if next(iter(variants), None) != FULL:
        raise ConfigError(
            "Variants are compared with the full model", where=file, expected=f"{FULL}: first", got=list(variants)
        )
    return variants


class AblationTableConfig(StrictModel):
    """``method``: the method of the rows; in planning it is ``banks_<method>``. ``seeds``: of the trainings of each variant."""

    method: str = "stage2"
    seeds: tuple[int, ...] = Field(default=(0,), min_length=1)
    variants: dict[str, Variant] = Field(default_factory=load_variants)
    resamples: int = Field(default=2000, ge=100)
    seed: int = Field(default=42, ge=0)


@dataclass(frozen=True)
class Cell:
    """One number of a variant: None and a ``reason`` where nothing was measured; ``paper`` has the paper's, by policy, as text."""

    variant: str
    label: str
    column: str
    mean: float | None = None
    low: float | None = None
    high: float | None = None
    count: int = 0
    paper: str = ""
    difference: float | None = None
    difference_low: float | None = None
    difference_high: float | None = None
    reason: str = ""


class _Measured(NamedTuple):
    """Interval and values by recording of each column, and reasons for what is missing."""

    intervals: dict[str, Interval]
    values: dict[str, dict[str, float]]
    reasons: dict[str, str]


def ablation_table(config: AblationTableConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """Put the evaluations ``evaluate_video.<variant>.<seed>`` and ``evaluate_planning.<variant>.<seed>`` into one table.

    Raises:
        ArtifactError: a variant has no video evaluation, or none of the method; an evaluation is of no variant.
    """
    named = {name.partition(".")[2] for name in inputs}
    wanted = [f"{name}.{seed}" for name in config.variants for seed in config.seeds]
    if not named <= set(wanted) or any(f"evaluate_video.{name}" not in inputs for name in wanted):
        raise ArtifactError(
            "The evaluations are not those of the variants",
            expected=[f"evaluate_video.{name}" for name in wanted],
            got=sorted(inputs),
            next_step="run `worldline ablations` with the same preset",
        )
    measured = {
        name: [_read(f"{name}.{seed}", config.method, inputs) for seed in config.seeds] for name in config.variants
    }
    full = measured.get(FULL, [])
    cells = {
        name: [_cell(config, name, column, measured[name], [] if name == FULL else full) for column in COLUMNS]
        for name in config.variants
    }
    rows = [asdict(cell) for row in cells.values() for cell in row]
    with atomic_path(output / "table.parquet") as temporary:
        pq.write_table(pa.Table.from_pylist(rows, schema=row_schema(Cell)), temporary)
    reasons = sorted({f"{COLUMNS[c.column]}: {c.reason}" for row in cells.values() for c in row if c.reason})
    write_bytes_atomic(output / "table.md", _markdown(cells.values(), reasons).encode())
    return {"variants": list(cells), "cells": len(rows), "measured": sum(row["mean"] is not None for row in rows)}


def _read(name: str, method: str, inputs: Mapping[str, Path]) -> _Measured:
    folder, planning = inputs[f"evaluate_video.{name}"], inputs.get(f"evaluate_planning.{name}")
    summary = read_json(folder / SUMMARY_FILE)
    if method not in summary.get("methods", ()):
        raise ArtifactError(
            "The evaluation has no such method", where=folder, expected=method, got=summary.get("methods")
        )
    known, series = collect_metrics({"evaluate_video": folder}), read_scores(folder)
    found = _Measured({}, {}, {})
    for column, (split, metric) in VIDEO_COLUMNS.items():
        key = f"video/{split}/{method}/{metric}"
        if key in known:
            found.intervals[column], found.values[column] = known[key], series[key]
        else:
            none = f"no recordings of the split {split}" if split not in summary["metrics"] else "not measured"
            found.reasons[column] = summary["unavailable"].get(metric, none)
    if planning is None:
        found.reasons.update(dict.fromkeys(("success", "gain"), "this run plans over no banks"))
        return found
    budgets = read_json(planning / SUMMARY_FILE)["methods"][f"banks_{method}"]["budgets"]
    most = budgets[max(budgets, key=int)]
    for column in ("success", "gain"):
        mean, low, high = (100 * most[column][key] for key in ("mean", "low", "high"))
        found.intervals[column] = Interval(mean, low, high, most[column]["count"])
        found.values[column] = {bank: 100 * value for bank, value in most["banks"].items()}
    return found


def _cell(
    config: AblationTableConfig, name: str, column: str, own: Sequence[_Measured], full: Sequence[_Measured]
) -> Cell:
    variant = config.variants[name]
    numbers = [variant.paper.get(column), *(variant.paper.get(f"{column}_{policy}") for policy in POLICIES)]
    paper = " / ".join(f"{value:g}" for value in numbers if value is not None)
    if any(column.endswith(metric) for metric in variant.without):
        return Cell(name, variant.label, column, paper=paper, reason="does not compare with the other rows")
    if any(column not in one.intervals for one in own):
        return Cell(name, variant.label, column, paper=paper, reason=own[0].reasons[column])
    options = {"resamples": config.resamples, "seed": config.seed}
    values, of_full = ([one.values[column] for one in side if column in one.values] for side in (own, full))
    found = own[0].intervals[column] if len(own) == 1 else crossed_bootstrap(values, **options)
    pairs = [(first, second) for first, second in zip(values, of_full, strict=False) if first.keys() & second.keys()]
    differences = [{key: first[key] - second[key] for key in first.keys() & second.keys()} for first, second in pairs]
    apart = crossed_bootstrap(differences, **options) if differences else None
    bounds = (None, None, None) if apart is None else (apart.mean, apart.low, apart.high)
    return Cell(name, variant.label, column, found.mean, found.low, found.high, found.count, paper, *bounds)


def _markdown(rows: Iterable[Sequence[Cell]], reasons: Sequence[str]) -> str:
    def text(cell: Cell) -> str:
        digits = 1 if cell.column in ("success", "gain") else 3
        if cell.mean is None:
            return f"not measured ({cell.paper or 'none'})"
        own = f"{cell.mean:.{digits}f} [{cell.low:.{digits}f}, {cell.high:.{digits}f}], n={cell.count}"
        if cell.difference is not None:
            bounds = f"[{cell.difference_low:+.{digits}f}, {cell.difference_high:+.{digits}f}]"
            own += f"; less the full model {cell.difference:+.{digits}f} {bounds}"
        return f"{own} ({cell.paper or 'none'})"

    lines = [("variant", *COLUMNS.values()), ("---",) * (1 + len(COLUMNS))]
    lines += [(row[0].label, *map(text, row)) for row in rows]
    table = ["| " + " | ".join(line) + " |" for line in lines]
    return "\n".join([*table, "", NOTE, *(f"- not measured, {reason}" for reason in reasons), ""])
