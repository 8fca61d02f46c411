"""The table of `worldline plan`: memory of every training of a preset on so many devices."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from pydantic import ByteSize, Field

from worldline_core.config import StrictModel
from worldline_core.errors import ConfigError
from worldline_core.model.checkpoint import DESCRIPTION, read_checkpoint_info
from worldline_core.model.world_model_config import WorldModelConfig, cosmos3_config
from worldline_core.pipeline.memory_estimate import USABLE, AnyStage, Estimate, Sources, gigabytes, stage_rows
from worldline_core.pipeline.pipeline_config import PipelineConfig
from worldline_core.shipped import project_path
from worldline_core.training.clip_config import FrameInput


class SizeSheet(StrictModel):
    """The trainings of one preset on so many devices of one kind; ``project``: folder that the preset's paths begin in."""

    config: PipelineConfig
    project: Path
    devices: int = Field(default=8, ge=1)
    memory: ByteSize

    @property
    def model(self) -> WorldModelConfig:
        """Shape of Stage I's model: that of the base checkpoint, of the backbone to import as models.base, or the configured
        one."""
        base = self.folder("base")
        if base is not None and (base / DESCRIPTION).is_file():
            return read_checkpoint_info(base).config
        if self.config.import_backbone is not None and self.config.models.base is not None:
            return cosmos3_config(
                self.config.import_backbone.size,
                fps=self.config.import_backbone.fps,
                **self.config.import_backbone.changes,
            )
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

    def rows(self) -> Iterator[tuple[Estimate, str]]:
        """Memory of every training in the order of a run, and the setting with which it would fit."""
        generation = self.model.model_copy(update={"towers": "generation"})
        stages = (
            (self.config.train_stage1, self.model),
            (self.config.train_stage2, generation),
            (self.config.distill, generation),
        )
        for stage, model in stages:
            if stage is not None:
                yield from stage_rows(stage, model, self.source(stage), self.devices, self.memory)

    def as_text(self, rows: Iterable[tuple[Estimate, str]]) -> str:
        """The sheet as a Markdown table; the last column names the setting with which a stage would fit."""
        lines = [
            f"{self.devices} devices of {gigabytes(self.memory)} GB ({USABLE:.0%} of it usable)\n",
            "| stage | parameters | GB a device | of that | fits |",
            "|---|---|---|---|---|",
        ]
        for row, setting in rows:
            count = f"{row.parameters / 1e9:.2f} G" if row.parameters >= 1e9 else f"{row.parameters / 1e6:.1f} M"
            fits = f"no: set {setting}" if setting else "yes"
            lines.append(f"| {row.title} | {count} | {gigabytes(row.total)} | {row.describe_parts()} | {fits} |")
        return "\n".join(lines)
