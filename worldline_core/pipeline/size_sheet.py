"""The sheet of a preset on so many cards: memory of every stage, planned seconds a step and hours."""

from __future__ import annotations

import gc
import multiprocessing
import os
from collections.abc import Iterable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from pathlib import Path

from pydantic import ByteSize, Field
from torch._subclasses.fake_tensor import FakeTensorMode

from worldline_core.config import StrictModel
from worldline_core.errors import ConfigError
from worldline_core.model.checkpoint import DESCRIPTION, read_checkpoint_info
from worldline_core.model.world_model_config import WorldModelConfig
from worldline_core.pipeline.cards import CARDS, UTILISATION, CardName
from worldline_core.pipeline.memory_estimate import USABLE, AnyStage, Estimate, Sources, Training, gigabytes, trainings
from worldline_core.pipeline.pipeline_config import PipelineConfig
from worldline_core.pipeline.rollout_speed import BlockCost, block_costs
from worldline_core.progress import Progress
from worldline_core.shipped import project_path
from worldline_core.training.adapters import load_peft
from worldline_core.training.clip_config import FrameInput
from worldline_core.training.stage2 import stage2_model_config


class SizeSheet(StrictModel):
    """The trainings of one preset on so many devices of one kind.

    Attributes:
        project: folder that the preset's paths begin in.
        card: whose speed counts, and whose memory where `memory` does not say otherwise.
    """

    config: PipelineConfig
    project: Path
    devices: int = Field(default=1, ge=1)
    memory: ByteSize | None = None
    card: CardName | None = None

    @property
    def bytes(self) -> float:
        if self.memory is not None:
            return self.memory
        if self.card is None:
            raise ConfigError(
                "The memory of a device is not known", where="worldline plan", next_step="give --memory 24GB or --card"
            )
        return CARDS[self.card].memory

    @property
    def model(self) -> WorldModelConfig:
        """Shape of Stage I's model: that of the base checkpoint, of the backbone to import as models.base, or the configured
        one."""
        base = self.folder("base")
        if base is not None and (base / DESCRIPTION).is_file():
            return read_checkpoint_info(base).config
        if self.config.import_backbone is not None and self.config.models.base is not None:
            return self.config.import_backbone.published
        if self.config.train_stage1 is None:
            raise ConfigError(
                "The size of the model is not known.",
                where="models.base",
                expected="a base checkpoint, import_backbone, or train_stage1.model",
            )
        return self.config.train_stage1.model

    def folder(self, name: str) -> Path | None:
        """Folder of outside weights, if it is here."""
        path = getattr(self.config.models, name)
        folder = None if path is None else project_path(self.project, path)
        return folder if folder is not None and folder.is_dir() else None

    def source(self, stage: AnyStage) -> Sources:
        """The pictures and latents that a stage reads: its own frames, or those of the cache."""
        reading = stage.input if isinstance(stage.input, FrameInput) else self.config.encode_latents
        return Sources.of(self.folder("tokenizer"), self.folder("teacher"), reading.image_size)

    def _trainings(self) -> list[Training]:
        models = {name: self.model.model_copy(update={"towers": "generation"}) for name in ("train_stage2", "distill")}
        stages = [(stage, models.get(name, self.model)) for name, stage in self.config.stages.items()]
        return [training for stage, model in stages for training in trainings(stage, model, self.source(stage))]

    def row(self, number: int) -> Estimate:
        return self._trainings()[number].estimate(self.devices)

    def _finished(self, pool: Executor) -> Iterator[tuple[int, Estimate]]:
        """Lines by their numbers as they are done; those that take longest are begun first."""
        numbers = range(len(self._trainings()))
        waiting = {pool.submit(self.row, number): number for number in reversed(numbers)}
        for future in as_completed(waiting):
            yield waiting[future], future.result()

    def rows(self) -> list[Estimate]:
        """Memory of every training in the order of a run."""
        with self._processes() as pool:
            return self._rows(pool)

    def _rows(self, pool: Executor) -> list[Estimate]:
        with Progress("worldline plan", len(self._trainings()), "training") as progress:
            made: dict[int, Estimate] = {}
            for number, row in self._finished(pool):
                made[number] = row
                progress.advance()
        return [made[number] for number in sorted(made)]

    def rows_and_rollouts(self, rows: list[Estimate] | None = None) -> tuple[list[Estimate], list[BlockCost]]:
        """The same (or what `fitting_rows` returned), and of a card that is known blocks of the distilled model in one view and in all."""
        config, views = self.config, tuple(self.config.distill.views)
        with self._processes() as pool:
            if self.card is None:
                return self._rows(pool) if rows is None else rows, []
            model = stage2_model_config(config.train_stage2, self.model)
            shown = list(dict.fromkeys((views[:1], views)))
            costs = block_costs(config.distill, model, self.source(config.distill), shown, pool)
            return self._rows(pool) if rows is None else rows, costs()

    def fitting_rows(self) -> list[Estimate] | None:
        """The rows where every training fits; the first one that does not ends the work, and None is returned."""
        made: dict[int, Estimate] = {}
        with self._processes() as pool:
            for number, row in self._finished(pool):
                made[number] = row
                if not row.fits(self.bytes):
                    pool.shutdown(wait=False, cancel_futures=True)
                    return None
        return [made[number] for number in sorted(made)]

    def _processes(self) -> Executor:
        """Processes that find imported what all of them need, and never search for garbage."""
        FakeTensorMode()  # imports half of torch
        if self.config.train_stage2.lora or self.config.distill.lora:
            load_peft()
        context = multiprocessing.get_context("fork")
        return ProcessPoolExecutor(len(os.sched_getaffinity(0)), context, initializer=gc.disable)

    def as_text(self, rows: Iterable[Estimate], rollouts: Iterable[BlockCost] = ()) -> str:
        """The sheet as a Markdown table; then the rollouts."""
        devices = "1 device" if self.devices == 1 else f"{self.devices} devices"
        lines = [f"{devices} of {gigabytes(self.bytes)} GB ({USABLE:.0%} of it usable)"]
        if self.card is not None:
            speed = f"{UTILISATION:.0%} of the {CARDS[self.card].operations / 1e12:.0f} TFLOPS of {self.card} (bf16)"
            lines += ["", f"Seconds and hours are planned, not measured: operations of the longest clips at {speed}."]
        else:
            lines += ["", "--card NAME plans seconds, hours and frames a second, too."]
        timed = " s a step | hours |" if self.card is not None else ""
        lines += ["", f"| stage | parameters | GB a device | of that |{timed} fits |"]
        lines.append("|---" * (lines[-1].count("|") - 1) + "|")
        hours = 0.0
        for row in rows:
            count = f"{row.parameters / 1e9:.2f} G" if row.parameters >= 1e9 else f"{row.parameters / 1e6:.1f} M"
            fits = "yes" if row.fits(self.bytes) else "no"
            if self.card is not None:
                seconds, taken = self._times(row)
                hours += taken or 0
                timed = f" {_figure(seconds)} | {_figure(taken)} |"
            lines.append(f"| {row.title} | {count} | {gigabytes(row.total)} | {row.describe_parts()} |{timed} {fits} |")
        if self.card is not None:
            lines += ["", f"In all {_figure(hours)} hours (planned).", *self._speeds(rollouts)]
        return "\n".join(lines)

    def _speeds(self, rollouts: Iterable[BlockCost]) -> list[str]:
        if self.card is None or not (costs := list(rollouts)):
            return []
        speed = UTILISATION * CARDS[self.card].operations
        lines = ["", "| rollout | TFLOP a block | frames a second | with a small decoder |", "|---|---|---|---|"]
        for cost in costs:
            parts = f"model {cost.sampling / 1e12:.3g}, decoder {cost.decoding / 1e12:.3g}, small {cost.small_decoding / 1e12:.2g}"
            own, small = (_figure(cost.frames_per_second(speed, small=small)) for small in (False, True))
            shown = "1 view" if cost.views == 1 else f"{cost.views} views"
            lines.append(f"| {shown}, blocks of {cost.frames} frames | {parts} | {own} | {small} |")
        return lines

    def _times(self, row: Estimate) -> tuple[float | None, float | None]:
        """Planned seconds of a step, and hours of the stage; None where they cannot be said."""
        speed = UTILISATION * CARDS[self.card].operations if self.card is not None else None
        seconds = None if speed is None or row.operations is None else row.operations / speed
        if row.minutes is not None:
            return seconds, row.minutes / 60
        return seconds, None if seconds is None or row.steps is None else seconds * row.steps / 3600


def _figure(value: float | None) -> str:
    return "" if value is None else f"{value:.0f}" if value >= 10 else f"{value:.2g}"
