"""Candidate banks: one initial state, one instruction, N control sequences, and what each of them leads to.

Every candidate is executed and filmed; its outcome goes to ``sealed_outcomes.parquet`` only, so that whatever chooses
among candidates cannot read it from the index.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import Field, model_validator

from worldline_core.config import StrictModel
from worldline_core.data.episodes.episode_set import EpisodeSet, EpisodeSetWriter
from worldline_core.errors import DataError
from worldline_core.progress import Progress
from worldline_core.recorder.record import (
    EMBODIMENT_STREAM,
    SPLIT_STREAM,
    Embodiment,
    Family,
    check_recorded,
    open_recorder,
    run_in_processes,
)
from worldline_core.recorder.rendering import prepare_rendering
from worldline_core.recorder.scene_model import FRAME_RATE
from worldline_core.recorder.simulate import EpisodeRecorder, Motion
from worldline_core.recorder.things import Layout, sample_layout
from worldline_core.store.atomic import atomic_path, write_json_atomic

SEALED_FILE = "sealed_outcomes.parquet"


class BankSpec(StrictModel):
    """One bank; ``layout`` numbers its initial state."""

    name: str = Field(min_length=1)
    embodiment: Embodiment
    family: Family
    scene: str = Field(pattern="^scene_[0-9]{2}$")
    layout: int = Field(ge=0)


class BankGrid(StrictModel):
    """``count`` banks of every task with every embodiment, each from an initial state of its own; scenes take turns."""

    embodiments: tuple[Embodiment, ...] = Field(min_length=1)
    families: tuple[Family, ...] = Field(min_length=1)
    scenes: tuple[str, ...] = Field(min_length=1)
    count: int = Field(default=5, ge=1, le=10_000)

    @model_validator(mode="after")
    def _named_once(self) -> BankGrid:
        if any(len(set(names)) < len(names) for names in (self.embodiments, self.families)):
            raise ValueError("an embodiment or a task twice: banks would share their names")
        return self

    def specs(self) -> list[BankSpec]:
        """One spec per bank, named ``bank_<family>_<embodiment>_<number>``."""
        cells: list[tuple[Family, Embodiment, int]] = [
            (f, e, number) for number in range(self.count) for e in self.embodiments for f in self.families
        ]
        return [
            BankSpec(
                name=f"bank_{family}_{embodiment}_{number}",
                embodiment=embodiment,
                family=family,
                # Shifted from one number to the next, so that each cell sees several scenes.
                scene=self.scenes[(layout + number) % len(self.scenes)],
                layout=layout,
            )
            for layout, (family, embodiment, number) in enumerate(cells)
        ]


class RecordBanksConfig(StrictModel):
    """Banks of ``candidates`` control sequences each.

    Attributes:
        banks, grid: which banks; one of the two.
        workers: processes, each of which records whole banks.
        masks: also store the exact pixels of the robot and of each thing; whoever chooses among videos needs none.
        success_range: the share of a bank's candidates that succeed must lie in this range; otherwise the next initial
            state is tried (at most 20).
    """

    banks: tuple[BankSpec, ...] = ()
    grid: BankGrid | None = None
    workers: int = Field(default=1, ge=1, le=64)
    candidates: int = Field(default=32, ge=2, le=512)
    seed: int = Field(default=0, ge=0)
    num_frames: int = Field(default=33, ge=17, le=400)
    video_crf: int = Field(default=22, ge=0, le=51)
    masks: bool = True
    success_range: tuple[float, float] = (0.25, 0.75)

    @model_validator(mode="after")
    def _banks_or_grid(self) -> RecordBanksConfig:
        if bool(self.banks) == (self.grid is not None):
            raise ValueError(f"give either banks or a grid; got {'both' if self.banks else 'neither'}")
        return self

    def specs(self) -> list[BankSpec]:
        """Every bank to record."""
        return list(self.banks) if self.grid is None else self.grid.specs()


def draw_bank(recorder: EpisodeRecorder, spec: BankSpec, config: RecordBanksConfig) -> tuple[Layout, list[Motion]]:
    """Layout and executed candidates of a bank.

    Raises: DataError when none of 20 initial states gives a success rate in the wanted range.
    """
    low, high = config.success_range
    for trial in range(20):
        entropy = (config.seed, EMBODIMENT_STREAM[spec.embodiment], SPLIT_STREAM["bank"], spec.layout, trial)
        layout = sample_layout(recorder.scene.robot, spec.family, np.random.default_rng(entropy))
        motions: list[Motion] = []
        for draw in range(4 * config.candidates):
            motion = recorder.move(layout, np.random.default_rng((*entropy, draw + 1)), config.num_frames)
            if motion is not None:
                motions.append(motion)
            if len(motions) == config.candidates:
                break
        success = float(np.mean([motion.outcome == "success" for motion in motions])) if motions else 0.0
        if len(motions) == config.candidates and low <= success <= high:
            return layout, motions
    raise DataError(
        "No initial state gives the wanted success rate", where=f"bank {spec.name}", expected=str((low, high))
    )


def _record_bank(task: tuple[BankSpec, RecordBanksConfig, Path, bool]) -> list[dict[str, str]]:
    """Record a bank's missing candidates; the outcomes of all of them. Runs in a worker process."""
    spec, config, output, finished = task
    recorder = open_recorder(spec.embodiment)
    layout, motions = draw_bank(recorder, spec, config)
    sealed = [
        {"episode_id": f"{spec.name}-{candidate:03d}", "outcome": motion.outcome}
        for candidate, motion in enumerate(motions)
    ]
    if not finished:
        writer = EpisodeSetWriter(output, fps=FRAME_RATE, video_crf=config.video_crf)
        for candidate, (motion, row) in enumerate(zip(motions, sealed, strict=True)):
            if writer.has(row["episode_id"]):
                continue
            recording = recorder.film(
                layout,
                replace(motion, outcome="unknown"),
                episode_id=row["episode_id"],
                scene_id=spec.scene,
                split="bank",
                # The same small camera shift for all candidates: they share the first picture.
                jitter=np.random.default_rng((config.seed, spec.layout)),
                bank=spec.name,
                candidate=candidate,
            )
            masks, labels = (recording.robot_masks, recording.thing_labels) if config.masks else (None, None)
            writer.add(recording.episode, recording.frames, masks, thing_labels=labels)
    recorder.close()
    return sealed


def record_banks(config: RecordBanksConfig, output: Path) -> dict[str, Any]:
    """Record candidate banks into ``output`` (an EpisodeSet with sealed outcomes); finished episodes survive a kill.

    Returns the number of candidates and successes per bank.

    Raises: UnavailableError without MuJoCo; DataError when a bank cannot be drawn, or the folder holds other episodes.
    """
    prepare_rendering()
    specs, finished = config.specs(), EpisodeSetWriter.finished(output)
    tasks = [(spec, config, output, finished) for spec in specs]
    with Progress("record banks", len(specs), "bank") as progress:
        sealed: list[list[dict[str, str]]] = []
        for rows in run_in_processes(_record_bank, tasks, config.workers):
            sealed.append(rows)
            progress.advance()
    if not finished:
        EpisodeSetWriter(output, fps=FRAME_RATE, video_crf=config.video_crf).close()
    rows = sorted((row for bank in sealed for row in bank), key=lambda row: row["episode_id"])
    recorded = {row.episode_id for row in EpisodeSet.open(output).rows}
    check_recorded(output, recorded, {row["episode_id"] for row in rows})
    with atomic_path(output / SEALED_FILE) as path:
        pq.write_table(pa.Table.from_pylist(rows), path)
    summary = {"banks": len(specs), "candidates": len(rows)}
    write_json_atomic(output / "recording.json", summary)
    counts = {
        spec.name: {"candidates": len(bank), "successes": sum(row["outcome"] == "success" for row in bank)}
        for spec, bank in zip(specs, sealed, strict=True)
    }
    return {**summary, "successes": counts}
