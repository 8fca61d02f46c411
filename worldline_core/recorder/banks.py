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
from pydantic import Field
from tqdm import tqdm

from worldline_core.config import StrictModel
from worldline_core.data.episodes.episode_set import EpisodeSetWriter
from worldline_core.errors import DataError
from worldline_core.recorder.record import EMBODIMENT_STREAM, SPLIT_STREAM, Embodiment, open_recorder
from worldline_core.recorder.rendering import prepare_rendering
from worldline_core.recorder.scene_model import FRAME_RATE
from worldline_core.recorder.simulate import Motion, TaskLayout, WorldRecorder
from worldline_core.store.atomic import atomic_path, write_json_atomic

SEALED_FILE = "sealed_outcomes.parquet"


class BankSpec(StrictModel):
    """One bank; ``layout`` numbers its initial state."""

    name: str = Field(min_length=1)
    embodiment: Embodiment
    family: str = Field(pattern="^(lift|place|state_change|close|press|carry)$")
    scene: str = Field(pattern="^scene_[0-9]{2}$")
    layout: int = Field(ge=0)


class RecordBanksConfig(StrictModel):
    """Banks of ``candidates`` control sequences each.

    Attributes:
        success_range: the share of a bank's candidates that succeed must lie in this range; otherwise the next initial
            state is tried (at most 20).
    """

    banks: tuple[BankSpec, ...] = Field(min_length=1)
    candidates: int = Field(default=32, ge=2, le=512)
    seed: int = Field(default=0, ge=0)
    num_frames: int = Field(default=33, ge=17, le=400)
    video_crf: int = Field(default=22, ge=0, le=51)
    success_range: tuple[float, float] = (0.25, 0.75)


def draw_bank[L: TaskLayout](
    recorder: WorldRecorder[L], spec: BankSpec, config: RecordBanksConfig
) -> tuple[L, list[Motion]]:
    """Layout and executed candidates of a bank.

    Raises: DataError when none of 20 initial states gives a success rate in the wanted range.
    """
    low, high = config.success_range
    for trial in range(20):
        entropy = (config.seed, EMBODIMENT_STREAM[spec.embodiment], SPLIT_STREAM["bank"], spec.layout, trial)
        layout = recorder.layout(spec.family, np.random.default_rng(entropy))
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


def record_banks(config: RecordBanksConfig, output: Path) -> dict[str, Any]:
    """Record candidate banks into ``output`` (an EpisodeSet with sealed outcomes); finished episodes survive a kill.

    Returns the number of candidates and successes per bank.

    Raises: UnavailableError without MuJoCo; DataError when a bank cannot be drawn.
    """
    prepare_rendering()
    writer = EpisodeSetWriter(output, fps=FRAME_RATE, video_crf=config.video_crf)
    sealed: list[dict[str, str]] = []
    counts: dict[str, dict[str, int]] = {}
    total = len(config.banks) * config.candidates
    with tqdm(total=total, desc="record banks", unit="candidate", disable=None) as progress:
        for spec in config.banks:
            recorder = open_recorder(spec.embodiment)
            layout, motions = draw_bank(recorder, spec, config)
            for candidate, motion in enumerate(motions):
                episode_id = f"{spec.name}-{candidate:03d}"
                sealed.append({"episode_id": episode_id, "outcome": motion.outcome})
                if not writer.has(episode_id):
                    recording = recorder.film(
                        layout,
                        replace(motion, outcome="unknown"),
                        episode_id=episode_id,
                        scene_id=spec.scene,
                        split="bank",
                        # The same small camera shift for all candidates: they share the first picture.
                        jitter=np.random.default_rng((config.seed, spec.layout)),
                        bank=spec.name,
                        candidate=candidate,
                    )
                    writer.add(
                        recording.episode, recording.frames, recording.robot_masks, thing_labels=recording.thing_labels
                    )
                progress.update()
            recorder.close()
            wins = sum(motion.outcome == "success" for motion in motions)
            counts[spec.name] = {"candidates": len(motions), "successes": wins}
    writer.close()
    table = pa.Table.from_pylist(sorted(sealed, key=lambda row: row["episode_id"]))
    with atomic_path(output / SEALED_FILE) as path:
        pq.write_table(table, path)
    summary = {"banks": len(counts), "candidates": sum(c["candidates"] for c in counts.values())}
    write_json_atomic(output / "recording.json", summary)
    return {**summary, "successes": counts}
