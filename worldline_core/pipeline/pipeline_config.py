"""The configuration of a whole run: one section a verb. A preset is one YAML file of this form."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, Self, cast

from pydantic import Field, model_validator

from worldline_core.actions.actions_config import RenderActionsConfig
from worldline_core.config import StrictModel, load_config, read_config, value_at
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.distillation.distill_config import DistillConfig
from worldline_core.errors import ConfigError, UnavailableError
from worldline_core.evaluation.evaluation_config import (
    JudgeConfig,
    PlanningConfig,
    PolicyEvaluationConfig,
    SegmenterConfig,
    VideoEvaluationConfig,
)
from worldline_core.filters.filter_config import FilterConfig
from worldline_core.model.world_model_config import ImportBackboneConfig
from worldline_core.pipeline.cards import CardName
from worldline_core.recorder.attempts import RecordingConfig
from worldline_core.report.context import ReportConfig
from worldline_core.rollout.rollout_config import ImportRolloutsConfig, RolloutConfig
from worldline_core.scale.mapping import RunnerConfig
from worldline_core.shipped import project_path
from worldline_core.store.remote import is_remote
from worldline_core.training.clip_config import SUBSET, EncodeLatentsConfig, FrameInput
from worldline_core.training.training_config import Stage1Config, Stage2Config, StageConfig, TokenizerConfig

logger = logging.getLogger(__name__)


class ModelPaths(StrictModel):
    """Folders of the weights that a run starts from or compares with (relative to the project)."""

    tokenizer: Path | None = None
    base: Path | None = None
    teacher: Path | None = None
    segmenter: Path | None = None
    judge: Path | None = None
    stage2: Path | None = Field(
        default=None, description="long-trained Stage II checkpoint to report beside this run's"
    )
    causal: Path | None = Field(default=None, description="long-trained causal checkpoint to report beside this run's")


GIVEN = {"base": "base", "shipped_stage2": "stage2", "shipped_causal": "causal"}
"""Checkpoints that a rollout may name and a run does not make, and the field of `ModelPaths` with the folder of each."""


class RolloutRun(StrictModel):
    """One named set of predicted videos: of a model or a baseline (``config``), or ``imported`` from a folder ``videos``."""

    checkpoint: Literal["base", "stage1", "stage2", "causal", "shipped_stage2", "shipped_causal"] | None = Field(
        default=None,
        description="this run's checkpoints, or the long-trained ones; none for a baseline without a model",
    )
    episodes: Literal["recordings", "banks"] = "recordings"
    config: RolloutConfig | None = None
    videos: Path | None = Field(default=None, description="folder of another simulator's videos")
    imported: ImportRolloutsConfig | None = None

    @model_validator(mode="after")
    def _one_origin(self) -> Self:
        if (self.config is None) == (self.imported is None) or (self.videos is None) != (self.imported is None):
            raise ValueError("give either config, or videos and imported")
        return self


def _drop_unusable_rollouts(values: dict[str, Any], written: Mapping[str, Any]) -> None:
    """Take away the rollouts whose models or banks are not there, and that the user has not written."""
    rollouts, own, models = (
        found.get(name) or {} for found, name in ((values, "rollouts"), (written, "rollouts"), (values, "models"))
    )
    if not all(isinstance(part, Mapping) for part in (rollouts, own, models)):
        return  # validation names it
    there = {checkpoint: models.get(name) for checkpoint, name in GIVEN.items()} | {
        "stage1": values.get("train_stage1")
    }
    if values.get("render_actions") is None:
        there |= {"shipped_stage2": None, "shipped_causal": None}

    def usable(run: object) -> bool:
        if not isinstance(run, Mapping):
            return True
        banks = run.get("episodes") != "banks" or values.get("curate_banks") is not None
        return banks and there.get(str(run.get("checkpoint")), True) is not None

    left_out = [name for name, run in rollouts.items() if name not in own and not usable(run)]
    if left_out:
        logger.info("rollouts left out, whose models or banks are not there: %s", ", ".join(left_out))
        values["rollouts"] = {name: run for name, run in rollouts.items() if name not in left_out}


class PipelineConfig(StrictModel):
    """Everything that `worldline pipeline` does."""

    card: CardName | None = Field(
        default=None, description="what the sizes are made for; only `worldline plan` reads it"
    )
    models: ModelPaths
    import_backbone: ImportBackboneConfig | None = Field(default=None, description="only for `task import_backbone`")
    record: dict[str, RecordingConfig] = Field(
        default={},
        description="recordings that this run makes; a source `{kind: recording, recording: NAME}` reads one",
    )
    curate: CurateConfig
    curate_banks: CurateConfig | None = None
    filter: FilterConfig
    render_actions: RenderActionsConfig | None = Field(
        default=None,
        description="null: no recording has a camera; models take control vectors (train_stage2.native_size)",
    )
    encode_latents: EncodeLatentsConfig
    train_tokenizer: TokenizerConfig | None = Field(default=None, description="null: models.tokenizer is used")
    train_segmenter: SegmenterConfig | None = Field(default=None, description="null: models.segmenter is used")
    train_judge: JudgeConfig | None = Field(default=None, description="null: models.judge is used, if any")
    train_stage1: Stage1Config | None = Field(default=None, description="null: Stage II starts from models.base")
    train_stage2: Stage2Config
    distill: DistillConfig
    rollouts: dict[str, RolloutRun] = Field(default={})
    evaluate_video: VideoEvaluationConfig | None = Field(default=None, description="none: predictions are judged only")
    evaluate_policy: PolicyEvaluationConfig | None = Field(
        default=None, description="none: predictions are not judged, where recordings say no outcome"
    )
    evaluate_planning: PlanningConfig | None = None
    report: ReportConfig = ReportConfig()
    runner: RunnerConfig = Field(
        default=RunnerConfig(), description="where work on many episodes runs; changes no result and no cache key"
    )

    @classmethod
    def load(cls, preset: str | None, path: Path | None = None, overrides: Sequence[str] = ()) -> Self:
        """Read a preset, or a file of the same form instead, and apply ``a.b=value`` overrides.

        Rollouts of the preset go with the models and banks that the file or an override takes away.
        """
        preset = None if path else preset
        return load_config(cls, preset=preset, path=path, overrides=overrides, prune=_drop_unusable_rollouts)

    @classmethod
    def lacking(cls, preset: str | None, path: Path | None) -> list[str]:
        """Sections that a preset or a file lacks to describe a whole run."""
        found = read_config(preset, path)
        return [name for name, field in cls.model_fields.items() if field.is_required() and name not in found]

    @property
    def caches_latents(self) -> bool:
        """True if a training reads latents of `encode_latents`."""
        return any(not isinstance(stage.input, FrameInput) for stage in self.stages.values())

    @property
    def stages(self) -> dict[str, Stage1Config | Stage2Config | DistillConfig]:
        """The trainings of the model by their sections."""
        first = {} if self.train_stage1 is None else {"train_stage1": self.train_stage1}
        return {**first, "train_stage2": self.train_stage2, "distill": self.distill}

    def recordings(self) -> list[tuple[str, RecordingConfig]]:
        """Names and settings of the recordings that the run's sources read."""
        curated = [config for config in (self.curate, self.curate_banks) if config is not None]
        names = {name for config in curated for name in config.recordings.values()}
        return [(name, config) for name, config in self.record.items() if name in names]

    def sources_of[T](self, curated: CurateConfig, recorded: Mapping[str, T]) -> dict[str, T | Path]:
        """Folders or object-store locations of the sources, numbered in the order of the configuration.

        They are inputs of curation's cache key: a changed recording means new work.
        """
        return source_folders(curated) | {str(n): recorded[name] for n, name in curated.recordings.items()}

    def clips_of[T](self, stage: StageConfig | DistillConfig, made: Mapping[str, T]) -> dict[str, T]:
        """The input that gives a training its clips: cached latents, or the tokenizer that encodes the videos."""
        if isinstance(stage.input, FrameInput):
            return {"tokenizer": made["tokenizer"]}
        return {"latents": made["encode_latents"]}

    def masks_of[T](self, data: Mapping[str, T]) -> dict[str, T]:
        """The inputs of train_segmenter; none where it learns kinematic masks and nothing is drawn."""
        kinematic = self.train_segmenter is not None and self.train_segmenter.labels == "kinematic"
        names = ("episodes", "tracks") if kinematic else ("episodes",)
        return {name: data[name] for name in names} if set(names) <= data.keys() else {}

    def rollouts_in_order(self) -> list[tuple[str, RolloutRun]]:
        """Names and settings of the rollouts, first those that wait for no training: Prefect starts tasks in this order."""
        return sorted(self.rollouts.items(), key=lambda item: item[1].checkpoint in ("stage1", "stage2", "causal"))

    def rollouts_of[T](self, predicted: Mapping[str, T], *, banks: bool) -> dict[str, T]:
        """Those of the predicted rollouts that are of recordings, or of candidate banks."""
        return {name: made for name, made in predicted.items() if (self.rollouts[name].episodes == "banks") == banks}

    def checkpoints[T](self, trained: Mapping[str, T]) -> dict[str | None, T | Path | None]:
        """Checkpoints by the names that rollouts use: trained by this run or given; None for baselines."""
        own = {"stage1": "train_stage1", "stage2": "train_stage2", "causal": "distill"}
        made: dict[str | None, T | Path | None] = {name: trained[step] for name, step in own.items() if step in trained}
        folders = self.model_folders()
        given = {checkpoint: folders[model] for checkpoint, model in GIVEN.items() if model in folders}
        return {None: None, **given, **made}

    def model_folders(self) -> dict[str, Path]:
        """Folders of the weights that the run starts from or compares with, those that it names."""
        named = self.models.model_dump().items()
        return {name: project_path(Path.cwd(), path) for name, path in named if path is not None}

    def check_night(self) -> None:
        """Raises ConfigError where a night predicts by no model that exists: it could never become worse."""
        checkpoints = self.checkpoints({})
        if not any(
            run.imported or (run.checkpoint and run.checkpoint in checkpoints) for run in self.rollouts.values()
        ):
            raise ConfigError(
                "A night of this preset measures no model: it trains none, and rolls out none that is there",
                where="rollouts",
                expected="a rollout of " + " or ".join(filter(None, checkpoints))
                if any(checkpoints)
                else "models.stage2",
                got={name: run.checkpoint for name, run in self.rollouts.items()},
                next_step="take the preset demo or tiny, or name a model and a rollout of it",
            )

    def videos_folder(self, run: RolloutRun) -> Path:
        """Folder of an imported rollout's videos."""
        return project_path(Path.cwd(), cast("Path", run.videos))

    @model_validator(mode="after")
    def _references_exist(self) -> PipelineConfig:
        if self.models.tokenizer is None and self.train_tokenizer is None:
            raise ValueError("models.tokenizer or train_tokenizer: one of the two is needed")
        learned = {
            "evaluate_policy.judge": self.evaluate_policy and self.evaluate_policy.judge,
            "evaluate_planning.selector": self.evaluate_planning and self.evaluate_planning.selector,
        }
        if (
            self.models.judge is None
            and self.train_judge is None
            and (asks := [k for k in learned if learned[k] == "learned"])
        ):
            raise ValueError(f"{', '.join(asks)}: learned: models.judge or train_judge: one of the two is needed")
        for config in (self.curate, self.curate_banks):
            for number, name in ({} if config is None else config.recordings).items():
                if name not in self.record:
                    raise ValueError(f"sources[{number}] reads the recording {name}: record has {sorted(self.record)}")
        for name, run in self.rollouts.items():
            if run.episodes == "banks" and self.curate_banks is None:
                raise ValueError(f"rollouts.{name} needs curate_banks")
            if run.checkpoint in GIVEN and getattr(self.models, GIVEN[run.checkpoint]) is None:
                raise ValueError(f"rollouts.{name} needs models.{GIVEN[run.checkpoint]}")
            if run.checkpoint == "stage1" and self.train_stage1 is None:
                raise ValueError(f"rollouts.{name} needs train_stage1")
        if self.render_actions is None:
            if self.train_stage2.native_size is None or self.curate_banks is not None:
                raise ValueError(
                    "render_actions: without it nothing is drawn: set train_stage2.native_size, and curate_banks to null"
                )
            mapped = [
                name for name, run in self.rollouts.items() if run.checkpoint in ("shipped_stage2", "shipped_causal")
            ]
            if mapped:
                raise ValueError(
                    f"render_actions: without it no action maps drive rollouts.{', rollouts.'.join(mapped)}"
                )
        if self.train_stage1 is None and self.models.base is None:
            raise ValueError("train_stage1: without it Stage II starts from models.base, and there is none")
        return self

    @model_validator(mode="after")
    def _distillation_sees_the_size_of_stage2(self) -> PipelineConfig:
        trained, seen = (
            stage.input.image_size if isinstance(stage.input, FrameInput) else self.encode_latents.image_size
            for stage in (self.train_stage2, self.distill)
        )
        if trained != seen:
            raise ValueError(
                f"distill reads frames of {list(seen)}, and train_stage2, whose model it distills, of {list(trained)}: "
                f"set distill.input.image_size (for cached latents encode_latents.image_size) to {list(trained)}"
            )
        return self

    @model_validator(mode="after")
    def _latents_reach_as_far_as_clips(self) -> PipelineConfig:
        """Refuse what training would refuse after all latents are encoded."""
        encoded = self.encode_latents.clip_frames
        for name, stage in self.stages.items():
            longest = 0 if isinstance(stage.input, FrameInput) else max(stage.clips.lengths)
            if encoded is not None and longest > encoded:
                raise ValueError(f"{name}.clips.lengths: {longest} frames, encode_latents.clip_frames: {encoded}")
        return self

    @model_validator(mode="after")
    def _distilled_views_are_trained(self) -> PipelineConfig:
        """Refuse what distillation would refuse after Stage II, and what latents lack; without `distill.views` take those they have."""
        wanted = self.distill.views
        known = {"train_stage2.clips.view_weights": self.train_stage2.clips.shown_views(wanted)}
        names = {*(self.distill.clips.view_weights or ()), *(self.distill.teacher_forcing.view_weights or ())}
        trained = (self.train_stage2.clips.view_weights or {}).get(SUBSET, 0) > 0
        if SUBSET in names and not trained and len(self.train_stage2.clips.shown_views(wanted)) > 1:
            raise ValueError(
                "distill shows subsets of the views: set train_stage2.clips.view_weights to learn them first"
            )
        if not isinstance(self.distill.input, FrameInput):
            known["encode_latents.views"] = self.encode_latents.views
        if "views" not in self.distill.model_fields_set:
            fitting = [view for view in wanted if all(view in views for views in known.values())]
            if fitting != wanted:
                distill = self.distill.model_dump(exclude_unset=True) | {"views": fitting}
                return self.model_copy(update={"distill": DistillConfig.model_validate(distill)})
        for key, views in known.items():
            if missing := [view for view in wanted if view not in views]:
                raise ValueError(
                    f"distill.views asks for {missing}, which {key} leaves out: set distill.views to the others"
                )
        return self


_OUTSIDE = {
    "models.tokenizer": "download the folder vae of nvidia/Cosmos3-Nano, in diffusers format",
    "models.base": "worldline task import_backbone --preset cosmos3-nano --input diffusers=weights/Cosmos3-Nano, and link "
    "the printed folder there",
    "models.teacher": "download facebook/vjepa2-vitg-fpc64-384, or set train_stage2.relational and models.teacher to null",
    "train_stage1.text.path": "download the folder text_tokenizer of nvidia/Cosmos3-Nano",
    "distill.lpips_weights": "download alexnet-owt-7be5be79.pth (torchvision) and alex.pth (lpips), or set it to null",
    "evaluate_video.lpips_weights": "download alexnet-owt-7be5be79.pth (torchvision) and alex.pth (lpips), or set it to null",
    "evaluate_video.sam3_weights": "accept the licence of facebook/sam3 and download it, or choose other segmenters",
    "evaluate_policy.sam3_weights": "accept the licence of facebook/sam3 and download it, or choose another segmenter",
    "evaluate_policy.vlm.weights": "download Qwen/Qwen3-VL-8B-Instruct, or choose judge: openai or measured",
    "evaluate_planning.sam3_weights": "accept the licence of facebook/sam3 and download it, or choose another segmenter",
    "evaluate_planning.vlm.weights": "download Qwen/Qwen3-VL-8B-Instruct, or choose selector: openai or measured",
}
"""Folders of weights that a run reads, by the key that names each, and how to come by the published ones."""


def check_weights(config: PipelineConfig, project: Path) -> None:
    """Refuse a run that would end for want of weights, before its first step: some of them are opened days later.

    Raises: UnavailableError: a folder that the configuration names is not there, or empty; the message lists all of them.
    """
    missing: list[str] = []
    advice: list[str] = []
    values = config.model_dump()
    named = {
        key: value_at(values, *key.split(".")) for key in (*(f"models.{name}" for name in values["models"]), *_OUTSIDE)
    }
    for name, run in values["rollouts"].items():
        named[f"rollouts.{name}.config.sampler.text.path"] = value_at(run, "config", "sampler", "text", "path")
    for key, path in named.items():
        if path is None:
            continue
        folder = project_path(project, Path(path))
        if not folder.is_dir() or not any(folder.iterdir()):
            missing.append(f"{key}: {path}")
            step = _OUTSIDE.get("train_stage1.text.path" if key.endswith(".text.path") else key, "check the path")
            advice += [step] if step not in advice else []
    if missing:
        raise UnavailableError(
            "Weights that this run reads are not here",
            where=project,
            expected="a folder with files for each",
            got="; ".join(missing),
            next_step="; ".join(advice),
        )


def check_recordings(config: PipelineConfig, project: Path) -> None:
    """Refuse a run whose recordings are not there, before anything is started.

    Raises: UnavailableError when the folder of a source is missing; the message lists all of them.
    """
    missing = [
        f"{section}.sources[{number}].path: {source.path}"
        for section, curate in (("curate", config.curate), ("curate_banks", config.curate_banks))
        for number, source in enumerate(() if curate is None else curate.sources)
        if number not in curate.recordings  # pyright: ignore[reportOptionalMemberAccess]
        and not is_remote(source.path)
        and not project_path(project, source.path).exists()
    ]
    if missing:
        raise UnavailableError(
            "Recordings that this run reads are not here",
            where=project,
            got="; ".join(missing),
            next_step="correct the paths, or fetch or record what belongs there (the comments of a configuration say how)",
        )


def source_folders(config: CurateConfig) -> dict[str, Path]:
    """Folders or object-store locations of the sources that are not recordings of the run itself, by their numbers."""
    return {
        str(number): source.path if is_remote(source.path) else project_path(Path.cwd(), source.path)
        for number, source in enumerate(config.sources)
        if number not in config.recordings
    }
