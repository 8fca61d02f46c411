"""The step ablation_table: variants as rows, the paper's metrics as columns, each number beside the paper's.

``table.parquet`` holds one value a row: mean, 95 % interval, number of trajectories (banks, for planning), the paper's number, and the
paired difference to the full model. ``table.md`` shows it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import Field

from worldline_core.config import StrictModel, read_yaml, validate
from worldline_core.errors import ArtifactError, ConfigError
from worldline_core.evaluation.paired import read_scores
from worldline_core.evaluation.scores import SUMMARY_FILE, crossed_bootstrap
from worldline_core.pages.page import render
from worldline_core.store.artifact_files import read_json, row_schema
from worldline_core.store.atomic import atomic_path, write_bytes_atomic

VARIANTS_FILE = Path(__file__).with_name("ablations.yaml")
FULL = "full"
VIDEO_COLUMNS = {
    "held_out_lpips": ("held out: LPIPS ↓", "test", "lpips"),
    "held_out_robot_iou": ("held out: robot IoU ↑", "test", "robot_iou"),
    "held_out_object_iou": ("held out: object IoU ↑", "test", "object_iou_exact"),
    "held_out_tool_error": ("held out: tool error [px] ↓", "test", "end_effector_error_px"),
    "ood_lpips": ("out of domain: LPIPS ↓", "ood_test", "lpips"),
    "ood_robot_iou": ("out of domain: robot IoU ↑", "ood_test", "robot_iou"),
}
"""Headings, splits that stand for the paper's AgiBotWorld (held out) and DROID (out of domain), and their metrics."""
PLANNING_COLUMNS = {"success": "planning: success [%] ↑", "gain": "planning: gain [points] ↑"}
COLUMNS = {name: heading for name, (heading, *_) in VIDEO_COLUMNS.items()} | PLANNING_COLUMNS
POLICIES = {"pi05": "π0.5", "lingbot": "LingBot-VLA"}


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
    """Variants by name, the full model first; those of the paper, or of a file of others.

    Raises: ConfigError: a variant has unknown fields, or the full model is not the first one.
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


type _Measured = tuple[dict[str, dict[str, float]], dict[str, str]]
"""Values by recording (bank) of each column, and reasons for what is missing."""


def ablation_table(config: AblationTableConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """Put the evaluations ``evaluate_video.<variant>.<seed>`` and ``evaluate_planning.<variant>.<seed>`` into one table.

    Raises: ArtifactError: a variant has no video evaluation, or none of the method; an evaluation is of no variant.
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
    cells = [[_cell(config, name, column, measured) for column in COLUMNS] for name in config.variants]
    rows = [cell for row in cells for cell in row]
    with atomic_path(output / "table.parquet") as temporary:
        pq.write_table(pa.Table.from_pylist([asdict(cell) for cell in rows], schema=row_schema(Cell)), temporary)
    reasons = sorted({f"{COLUMNS[cell.column]}: {cell.reason}" for cell in rows if cell.reason})
    policies = " / ".join(POLICIES.values())
    text = render("report/ablation_table.md", columns=COLUMNS, cells=cells, reasons=reasons, policies=policies)
    write_bytes_atomic(output / "table.md", text.encode())
    return {"variants": [*config.variants], "cells": len(rows), "measured": sum(cell.mean is not None for cell in rows)}


def _read(name: str, method: str, inputs: Mapping[str, Path]) -> _Measured:
    folder, planning = inputs[f"evaluate_video.{name}"], inputs.get(f"evaluate_planning.{name}")
    summary, series = read_json(folder / SUMMARY_FILE), read_scores(folder)
    values, reasons = dict[str, dict[str, float]](), dict[str, str]()
    if method not in summary.get("methods", ()):
        raise ArtifactError(
            "The evaluation has no such method", where=folder, expected=method, got=summary.get("methods")
        )
    for column, (_, split, metric) in VIDEO_COLUMNS.items():
        if (found := series.get(f"video/{split}/{method}/{metric}")) is not None:
            values[column] = found
        else:
            none = f"no recordings of the split {split}" if split not in summary["metrics"] else "not measured"
            reasons[column] = summary["unavailable"].get(metric, none)
    if planning is None:
        return values, reasons | dict.fromkeys(PLANNING_COLUMNS, "this run plans over no banks")
    planned = read_json(planning / SUMMARY_FILE)
    budgets = planned["methods"][f"banks_{method}"]["budgets"]
    success = budgets[max(budgets, key=int)]["banks"]
    values["success"] = {bank: 100 * value for bank, value in success.items()}
    values["gain"] = {b: 100 * (value - planned["banks"][b]["direct_success"]) for b, value in success.items()}
    return values, reasons


def _cell(config: AblationTableConfig, name: str, column: str, measured: Mapping[str, Sequence[_Measured]]) -> Cell:
    variant = config.variants[name]
    numbers = [variant.paper.get(column), *(variant.paper.get(f"{column}_{policy}") for policy in POLICIES)]
    paper = " / ".join(f"{value:g}" for value in numbers if value is not None)
    if any(column.endswith(metric) for metric in variant.without):
        return Cell(name, variant.label, column, paper=paper, reason="does not compare with the other rows")
    if reason := next((reasons[column] for _, reasons in measured[name] if column in reasons), ""):
        return Cell(name, variant.label, column, paper=paper, reason=reason)
    own, full = ([values.get(column, {}) for values, _ in measured.get(side, ())] for side in (name, FULL))
    pairs = [(first, second) for first, second in zip(own, full, strict=False) if first.keys() & second.keys()]
    differences = [{key: first[key] - second[key] for key in first.keys() & second.keys()} for first, second in pairs]
    found = crossed_bootstrap(own, resamples=config.resamples, seed=config.seed)
    bounds = None, None, None
    if differences and name != FULL:
        apart = crossed_bootstrap(differences, resamples=config.resamples, seed=config.seed)
        bounds = apart.mean, apart.low, apart.high
    return Cell(name, variant.label, column, found.mean, found.low, found.high, found.count, paper, *bounds)
